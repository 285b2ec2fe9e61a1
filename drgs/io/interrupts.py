"""Ctrl-C, SIGTERM and SIGHUP end a command within two seconds, with one line; a fit finishes its step and saves first.

Python runs the handler of a signal once the main thread is back from native code, which may be minutes later. A second
thread hears of signals at once, and ends the process if the main thread does not answer. Timeouts and shells send the
same signal twice: one that comes within a second is no second one, not even while the process ends by the first.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
# seconds that the main thread is given to return from native code; a command ends within two. Chosen
_ANSWER_SECONDS = 0.7
_SAME_SIGNAL_SECONDS = 1.0  # seconds within which a second signal counts as the same; chosen


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP; ends a program as Ctrl-C does.

    Attributes:
        signum: Number of the signal.
    """

    def __init__(self, signum: int, text: str = ""):
        super().__init__(*([text] if text else []))
        self.signum = signum


class _Handlers:
    """The signals of this process while a command, or the loop of a fit, runs."""

    def __init__(self, leave: Callable[[int], None] | None):
        self.leave = leave
        self.signum: int | None = None
        # When the first signal came, by the main thread and by the second one.
        self.first: float | None = None
        self.heard: float | None = None
        self.waits = self.is_native = self.is_answered = False

    def on_signal(self, signum: int, _frame: object) -> None:
        """Python's handler, in the main thread."""
        self.is_answered = True
        now = time.monotonic()
        is_first = self.first is None
        if self.first is None:
            self.first = now
            self.signum = signum
        is_again = now - self.first >= _SAME_SIGNAL_SECONDS
        if not (is_again or is_first and not self.waits):
            return
        if self.leave is None and self.is_native:
            return  # raised by `in_native_code`, once no native frame is in the way
        if self.leave is not None and (self.is_native or is_again):
            self.leave(signum)
        raise self.error()

    def watch(self, pipe: int, leave: Callable[[int], None]) -> None:
        """Hear of a signal when it comes, in a second thread, and leave if the main thread does not answer."""
        while (received := os.read(pipe, 64)) and 0 not in received:
            numbers = [number for number in received if number in _SIGNALS]
            if not numbers:
                continue
            began = time.monotonic()
            self.heard = began if self.heard is None else self.heard
            is_again = began - self.heard >= _SAME_SIGNAL_SECONDS
            while not self.is_answered or is_again:
                if self.waits and not is_again:
                    break
                if time.monotonic() - began > _ANSWER_SECONDS:
                    leave(numbers[-1])
                time.sleep(0.02)

    def error(self, text: str = "") -> KeyboardInterrupt:
        """The exception for the signal that came."""
        if self.signum is None or self.signum == signal.SIGINT:
            return KeyboardInterrupt(*([text] if text else []))
        return Terminated(self.signum, text)


_active: _Handlers | None = None


@contextlib.contextmanager
def handled(clean: Callable[[], None], say: Callable[[KeyboardInterrupt], str]) -> Iterator[None]:
    """For the length of a command: its signals raise `KeyboardInterrupt` or `Terminated`, or end the process.

    Args:
        clean: Removes what the process would leave behind; called before it is ended.
        say: What is printed then.
    """

    def leave(signum: int) -> None:
        clean()
        shown = b"\r\x1b[?25h\x1b[K" if os.isatty(2) else b""  # a bar may have hidden the cursor
        text = say(KeyboardInterrupt() if signum == signal.SIGINT else Terminated(signum))
        with contextlib.suppress(OSError):
            os.write(2, shown + text.encode())  # sys.stderr may be a bar's, whose lock another thread holds
        os._exit(128 + signum)  # without C++'s destructors and stack traces

    with _installed(leave) as handlers:
        if handlers is None:
            yield
            return
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        watcher = threading.Thread(target=handlers.watch, args=(reader, leave), daemon=True)
        watcher.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)
            os.write(writer, b"\0")
            watcher.join()
            os.close(reader)
            os.close(writer)


@contextlib.contextmanager
def between_steps() -> Iterator[Callable[[], bool]]:
    """Yields a function that says whether a signal came: the block is to end itself once its state can be saved.

    A second signal raises at once. If the block ends without asking, the signal is raised then.
    """
    with _installed(None) if _active is None else contextlib.nullcontext(_active) as handlers:
        if handlers is None:  # signals reach the main thread only
            yield lambda: False
            return
        handlers.waits = True
        try:
            yield lambda: handlers.first is not None
        finally:
            handlers.waits = False
        if handlers.first is not None:
            raise handlers.error()


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Part of a block of `between_steps` that may be left anywhere: everything worth keeping has been saved."""
    handlers = _active
    if handlers is None or not handlers.waits:
        yield
        return
    if handlers.first is not None:
        raise handlers.error()
    handlers.waits = False
    try:
        yield
    finally:
        handlers.waits = True


@contextlib.contextmanager
def in_native_code() -> Iterator[None]:
    """Calls that take long, and call back into Python where nothing may be raised: a signal ends the command there."""
    handlers = _active
    if handlers is None or handlers.is_native or threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers.is_native = True
    try:
        yield
    finally:
        handlers.is_native = False
    if handlers.first is not None and not handlers.waits:
        raise handlers.error()


def interruption(text: str = "") -> KeyboardInterrupt:
    """The exception for the signal that came, with a text for people."""
    return _active.error(text) if _active is not None and _active.first is not None else KeyboardInterrupt(text)


def leave() -> None:
    """End the process at once, with the command's line, if a signal came: another thread is in native code, which
    nothing ends, and which must not go on while the libraries that it is in are taken down.
    """
    if _active is not None and _active.leave is not None and _active.signum is not None:
        _active.leave(_active.signum)


def exit_code(error: KeyboardInterrupt) -> int:
    """Exit status of an interrupted program, as shells have it: 128 + the signal's number."""
    return 128 + (error.signum if isinstance(error, Terminated) else signal.SIGINT)


def reinstall() -> None:
    """Put Python's handlers back after a library has replaced them behind its back: pycolmap prints a C++ stack."""
    if threading.current_thread() is threading.main_thread():
        for signum in _SIGNALS:
            if (handler := signal.getsignal(signum)) is not None:
                signal.signal(signum, handler)


@contextlib.contextmanager
def _installed(leave: Callable[[int], None] | None) -> Iterator[_Handlers | None]:
    """Our handlers, in the main thread; a signal that is ignored (nohup) stays ignored."""
    global _active
    if threading.current_thread() is not threading.main_thread():
        yield None
        return
    outer = _active
    _active = _Handlers(leave)
    before = {s: signal.getsignal(s) for s in _SIGNALS}
    for signum, handler in before.items():
        if handler not in (signal.SIG_IGN, None):
            signal.signal(signum, _active.on_signal)
    try:
        yield _active
    finally:
        for signum, handler in before.items():
            if handler is not None:
                signal.signal(signum, handler)
        if leave is not None and _active.first is not None:
            _ignore_again(_active.first)
        _active = outer


def _ignore_again(first: float) -> None:
    """A command has ended by a signal: the same one, sent twice, is not to kill what is left of its process.

    Python's own handlers are gone once it shuts down, where large libraries take long: there the signals are ignored.

    Args:
        first: Time at which the signal came, in seconds of `time.monotonic`.
    """

    def again(signum: int, _frame: object) -> None:
        if time.monotonic() - first >= _SAME_SIGNAL_SECONDS:
            signal.signal(signum, before[signum])
            signal.raise_signal(signum)

    def ignore() -> None:
        for signum in before:
            if signal.getsignal(signum) is again:
                signal.signal(signum, signal.SIG_IGN)

    before = {s: signal.getsignal(s) for s in _SIGNALS}
    before = {s: handler for s, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for signum in before:
        signal.signal(signum, again)
    atexit.register(ignore)
