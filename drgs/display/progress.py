"""Progress on stderr: a bar on a terminal, and where stderr is a file or a pipe a line now and then.

Bars nest; the innermost one is shown. A thread writes the lines, so that work which stays away from Python for minutes
(COLMAP, a kernel that is compiled, a slow view) is reported as well.
"""

from __future__ import annotations

import bisect
import contextlib
import math
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

FIRST = 1.0  # seconds after which a stage is worth its first line
EVERY = 2.0  # seconds between two lines at first; they become rarer, up to LEAST_OFTEN
LEAST_OFTEN = 30.0  # seconds between two lines of a long stage
_OF_STAGE, _OF_COMMAND = 0.2, 0.05  # of the time since a stage, and the command, began: between two lines. Chosen
_STEADY_AFTER = 24  # steps after which a rate is believed: kernels are compiled in a fit's first ones. Chosen
_bars: list[Bar] = []  # that are open, the innermost last
_output: _Lines | _Terminal | Any = None  # None while none of them is shown


def duration(seconds: float) -> str:
    """A time in words, as exact as an estimate is: `40 s`, `12 min`, `1.5 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class Bar:
    """How far something is, for the length of a `with` block.

    Args:
        label: Name of the stage.
        total: Number of steps; None: unknown.
        show: Whether it is shown; None: if the bar around it is, so that library functions may have bars.
        done: Number of steps done before, which took no time.
        lines_only: Whether it is left out on a terminal.
    """

    def __init__(
        self, label: str, total: int | None = None, show: bool | None = None, done: int = 0, lines_only: bool = False
    ) -> None:
        self.label = label
        self.total = total
        self.done = done
        self.text = ""
        self.is_drawn = not lines_only
        self.is_reported = False
        self._show = show
        self._before = done
        self._marks: list[tuple[int, float]] = []  # steps done, and when

    def __enter__(self) -> Bar:
        self.began = time.monotonic()
        self._marks = [(self.done, self.began)]
        self.is_shown: bool = bool(_bars and _bars[-1].is_shown) if self._show is None else self._show
        _open(self)
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is None and self.is_reported and self.total is not None:
            self.note(self.line())
        _close(self)

    def advance(self) -> None:
        """One step more."""
        self.update(self.done + 1)

    def update(self, done: int, total: int | None = None, label: str | None = None, text: str | None = None) -> None:
        """Set what is given.

        Args:
            done: Number of steps done.
            total: Number of steps.
            label: Name of the stage. Another one is another stage, whose time starts now.
            text: What else to say, e.g. how good the result is so far.
        """
        if label is not None and label != self.label:
            if self.is_reported and self.total is not None:
                self.note(self.line())
            self.label = label
            self.began = time.monotonic()
            self.is_reported = False
            self._before = done
            self._marks = [(done, self.began)]
        if done != self.done:
            self._marks = self._marks if done > self.done else []  # begun anew
            self.done = done
            self._marks.append((done, time.monotonic()))
        self.total = self.total if total is None else total
        self.text = self.text if text is None else text
        if self.is_shown:
            _output.draw(self)

    def stage(self, label: str, done: int, total: int) -> None:
        """`update` as functions call it that report several stages."""
        self.update(done, total, label)

    def note(self, text: str) -> None:
        """A line that stays: above the bar, or by itself."""
        if self.is_shown:
            _output.note(text)

    def line(self) -> str:
        """The bar in words."""
        now = time.monotonic()
        parts = [f"{self.done} of {self.total}"] if self.total else []
        parts += [self.text] if self.text else []
        parts.append(f"{now - self.began:.0f} s")
        if self.total and self.done < self.total and (left := self._left(now)) >= 1:
            parts.append(f"about {left:.0f} s left")
        return f"{self.label}: {', '.join(parts)}"

    def _left(self, now: float) -> float:
        """Seconds until all steps are done, by the later half of those done so far; 0 where these say nothing yet."""
        steps = self.done - self._before
        if not self.total or steps < max(1, min(_STEADY_AFTER, self.total // 10)):
            return 0.0
        done, reached = self._marks[-1]
        first, began = self._marks[bisect.bisect_right(self._marks, (self._before + steps // 2, math.inf)) - 1]
        return (reached - began) / max(done - first, 1) * (self.total - done) - (now - reached)


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Show no bar within the block, neither those there are nor new ones: the program only waits for another one."""
    shown = [bar for bar in _bars if bar.is_shown]
    with Bar("", show=False):
        for bar in shown:
            bar.is_shown = False
        try:
            yield
        finally:
            for bar in shown:
                bar.is_shown = True


def _open(bar: Bar) -> None:
    global _output
    _bars.append(bar)
    if bar.is_shown:
        if _output is None:
            _output = _Terminal() if sys.stderr.isatty() else _Lines()
        _output.draw(bar)


def _close(bar: Bar) -> None:
    global _output
    _bars.remove(bar)
    if bar.is_shown:
        _output.erase(bar)
        if not any(other.is_shown for other in _bars):
            _output.end()
            _output = None


class _Lines:
    """Lines of the innermost bar, from a thread."""

    def __init__(self) -> None:
        self._began = self._last = time.monotonic()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="drgs progress", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._is_over.wait(min(0.25, FIRST)):
            now = time.monotonic()
            for bar in [bar for bar in _bars if bar.is_shown][-1:]:
                is_due = now - self._last >= self.pause(bar, now)
                if is_due or (not bar.is_reported and now - bar.began >= FIRST):
                    bar.is_reported = True
                    self.note(bar.line())

    def pause(self, bar: Bar, now: float) -> float:
        """Seconds from the last line to the next: short early in a stage, so that no new work seems to stand still."""
        return min(LEAST_OFTEN, max(EVERY, _OF_STAGE * (now - bar.began), _OF_COMMAND * (now - self._began)))

    def draw(self, bar: Bar) -> None:
        """The thread does."""

    def erase(self, bar: Bar) -> None:
        """Lines stay."""

    def note(self, text: str) -> None:
        self._last = time.monotonic()
        sys.stderr.write(text + "\n")  # one call: lines of two threads do not mix
        sys.stderr.flush()

    def end(self) -> None:
        self._is_over.set()
        self._thread.join()


class _Terminal:
    """The innermost bar, drawn by rich."""

    def __init__(self) -> None:
        from rich import progress
        from rich.console import Console

        self._bars = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(bar_width=20),
            progress.TextColumn("{task.fields[count]}", markup=False),
            progress.TextColumn("{task.fields[text]}", markup=False),
            progress.TimeRemainingColumn(elapsed_when_finished=True),
            console=Console(stderr=True),
            transient=True,
            redirect_stdout=sys.stdout.isatty(),  # what goes to a file stays there
        )
        self._tasks: dict[Bar, Any] = {}

    def draw(self, bar: Bar) -> None:
        if not bar.is_drawn:
            return
        if bar not in self._tasks:
            self._tasks[bar] = self._bars.add_task(bar.label, total=bar.total, completed=bar.done, count="", text="")
            self._bars.start()
        count = "" if bar.total is None else f"{bar.done}/{bar.total}"
        self._bars.update(
            self._tasks[bar], completed=bar.done, total=bar.total, description=bar.label, count=count, text=bar.text
        )
        self._show_innermost()

    def erase(self, bar: Bar) -> None:
        if bar in self._tasks:
            self._bars.remove_task(self._tasks.pop(bar))
            self._show_innermost()
            if not self._tasks:
                self._bars.stop()

    def note(self, text: str) -> None:
        self._bars.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def end(self) -> None:
        self._bars.stop()

    def _show_innermost(self) -> None:
        drawn = [bar for bar in _bars if bar in self._tasks]
        for bar in drawn:
            self._bars.update(self._tasks[bar], visible=bar is drawn[-1])
