"""A process beside this one for a library in C++ that reads files from elsewhere: where a file makes it crash, that
process ends, and this one says so in a line.

Questions and answers are lines of JSON on a socket, arrays lie in memory that both map. There is one process for all
files; it starts with the first question and ends with this process.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import logging
import math
import mmap
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

_ERRORS: dict[str, type[Exception]] = {kind.__name__: kind for kind in (ValueError, FileNotFoundError, MemoryError)}

_SHOWN = 120  # characters of a library's own message

_log = logging.getLogger(__name__)


class Child:
    """The process; started when it is needed, and again after it has ended.

    Args:
        module: That it runs; calls `serve`.
        wanted: What a file must be, for messages, e.g. "a video that can be decoded".
        advice: What to do with a file that makes it crash.
    """

    def __init__(self, module: str, wanted: str, advice: str) -> None:
        self._module = module
        self._wanted = wanted
        self._advice = advice
        self._lock = threading.Lock()
        self._process = None
        self._owner = 0
        self._socket: Any = None
        self._file: Any = None
        self._shared: Any = None

    @property
    def pid(self) -> int | None:
        """Number of the process; None where there is none."""
        return self._process.pid if self._process is not None and self._owner == os.getpid() else None

    def call(self, what: str, path: Path, *rest: Any, progress: Callable[[int], None] = lambda _: None) -> Any:
        """Call a function of the module in its process and return its result, a value of JSON or an array.

        Args:
            what: Name of the function.
            path: Its first argument: the file that is read.
            rest: More arguments, values of JSON.
            progress: Called with the numbers that the function reports while it runs.
        Raises:
            ValueError: The process ended over this file.
            Exception: What the function raises.
        """
        with self._lock:
            if self.pid is None:
                self._start()
            try:
                self._file.write(json.dumps([os.getcwd(), what, str(path), *rest]).encode() + b"\n")
                self._file.flush()
                while True:
                    answer = json.loads(self._file.readline() or b"null")
                    if answer is None:
                        raise BrokenPipeError
                    if "progress" not in answer:
                        break
                    progress(answer["progress"])
                array = self._shared.array(answer["shape"]).copy() if "shape" in answer else None
            except (BrokenPipeError, ConnectionResetError):
                code = self._process.wait()
                self.end()
                how = signal.Signals(-code).name if code < 0 else f"code {code}"
                raise ValueError(
                    f"{path}: must be {self._wanted}, the process that reads it ended with {how}; {self._advice}"
                ) from None
            except BaseException:  # an interrupt: what would be answered now belongs to no question
                self.end()
                raise
        for text in answer["warnings"]:
            _log.warning("%s", text)
        if "error" in answer:
            raise _ERRORS[answer["error"]](answer["text"])
        return answer.get("value") if array is None else array

    def _start(self) -> None:
        """Start the process with the modules of this one, out of reach of Ctrl-C."""
        self._socket, other = socket.socketpair()
        self._shared = _Shared(_memory())
        paths = os.pathsep.join(path for path in sys.path if path)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", self._module, str(other.fileno()), str(self._shared.fd)],
            pass_fds=[other.fileno(), self._shared.fd],
            stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": paths},
            process_group=0,
        )
        other.close()
        self._file = self._socket.makefile("rwb")
        self._owner = os.getpid()
        atexit.register(self.end)

    def end(self) -> None:
        """End the process, if there is one."""
        if self.pid is not None:
            self._process.kill()
            self._process.wait()
            with contextlib.suppress(OSError):
                self._file.close()
            self._socket.close()
            os.close(self._shared.fd)
            atexit.unregister(self.end)
        self._process = None


def serve(functions: dict[str, Callable[..., Any]]) -> None:
    """Answer the questions of a `Child` until it is gone: the main function of its module.

    Args:
        functions: Functions by name; they get a path, the other arguments, and `report`, which takes a number.
    """
    for name in (signal.SIGINT, signal.SIGTERM):  # a fit that gets one saves first, and may need this process
        signal.signal(name, signal.SIG_IGN)
    warnings = _WarningCollector()
    logging.getLogger().addHandler(warnings)
    file = socket.socket(fileno=int(sys.argv[1])).makefile("rwb")
    shared = _Shared(int(sys.argv[2]))

    def report(number: int) -> None:
        file.write(json.dumps({"progress": number}).encode() + b"\n")
        file.flush()

    for line in file:
        folder, what, path, *rest = json.loads(line)
        os.chdir(folder)  # that paths are relative to
        answer: dict[str, Any] = {}
        try:
            value = functions[what](Path(path), *rest, report=report)
            if isinstance(value, np.ndarray):
                answer["shape"] = value.shape
                shared.array(value.shape)[...] = value
            else:
                answer["value"] = value
        except tuple(_ERRORS.values()) as error:
            answer = {"error": type(error).__name__, "text": str(error)}
        except Exception as error:  # whatever a library raises over a file
            text = " ".join(f"{type(error).__name__}: {error}".split())[:_SHOWN]
            answer = {"error": "ValueError", "text": f"{path}: must be readable, got {text}; copy it again"}
        file.write(json.dumps({**answer, "warnings": warnings.taken()}).encode() + b"\n")
        file.flush()


class _Shared:
    """Memory that both processes map; it only grows.

    Args:
        fd: Descriptor of the file.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._map = None

    def array(self, shape: Sequence[int]) -> np.ndarray:
        """The first bytes of it as an array of uint8."""
        size = math.prod(shape)
        if self._map is None or len(self._map) < size:
            if os.fstat(self.fd).st_size < size:
                os.ftruncate(self.fd, size)
            self._map = mmap.mmap(self.fd, max(size, 1)) if size else None
        return np.frombuffer(self._map or b"", np.uint8, size).reshape(shape)


def _memory() -> int:
    """A file without a name, in memory where there are such files."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("drgs")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class _WarningCollector(logging.Handler):
    """A log handler that keeps warnings."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self._texts.append(record.getMessage())

    def taken(self) -> list[str]:
        """Warnings since the last call."""
        texts = self._texts
        self._texts = []
        return texts
