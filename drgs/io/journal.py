"""Finished steps as JSON lines, from which a killed command resumes.

One format for the log of a run (`log.jsonl`), the rows of a study and the record of what drgs wrote into a folder
(`.drgs.jsonl`). A line is one JSON object and is written whole, in one call: a process that is killed, or a power cut,
leaves at most a last line without its newline. Such a tail is left out when the file is read, and cut off before the
next line is appended. Every other line that cannot be read is an error that names it. Processes that append to the same
file take turns (`fcntl.flock`, which the system gives back when a process dies).
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from drgs.io.atomic import named
from drgs.io.json_files import parse_json
from drgs.io.locks import exclusive

SCHEMA = 1
"""Version of journals, checkpoints and reports that commands write; raised when a reader must change."""


class Journal:
    """A file of JSON lines.

    Args:
        path: The file; made by the first `append`.
        default: JSON form of other objects, as `json.dumps` takes it.
        durable: Whether `append` waits until the disk has the line, so that it outlives a power cut, too.
    """

    def __init__(self, path: Path, default: Callable[[Any], Any] | None = None, durable: bool = False) -> None:
        self.path = path
        self._default = default
        self._durable = durable

    def append(self, row: Mapping[str, Any], unless: Callable[[list[dict[str, Any]]], bool] | None = None) -> None:
        """Add a line, in one write.

        Args:
            row: What it says, JSON.
            unless: Called with all rows while no other process can append; True: the line is not needed.
        Raises:
            OSError: If there is no room for all of it, which leaves the file as it was, or no permission.
            ValueError: If `unless` is given and the file is damaged.
        """
        line = json.dumps(row, default=self._default).encode() + b"\n"
        try:
            with self.path.open("a+b", buffering=0) as file, exclusive(file.fileno()):
                if unless is not None and unless(self.rows()):
                    return
                whole = _cut_tail(file.fileno())
                try:
                    if file.write(line) < len(line):  # as much as there was room for
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                    if self._durable:
                        os.fsync(file.fileno())
                except OSError:
                    with contextlib.suppress(OSError):
                        file.truncate(whole)
                    raise
        except OSError as error:
            raise named(self.path, error) from None

    def rows(
        self, check: Callable[[Any], Any] | None = None, what: str = "a row", skip_damaged: bool = False
    ) -> list[dict[str, Any]]:
        """All lines but a tail that a killed process left; none of a file that is not there.

        Args:
            check: Gets every row, and raises ValueError, KeyError or TypeError where it is none.
            what: What a row is, for the message.
            skip_damaged: Leave out other lines that cannot be read, too, instead of raising.
        Raises:
            ValueError: If a line is damaged.
        """
        found = []
        for number, line in _lines(self.path):
            try:
                row = parse_json(line, f"{self.path}, line {number}")
                if check is not None:
                    check(row)
            except (ValueError, KeyError, TypeError) as error:
                if skip_damaged:
                    continue
                if check is None:
                    raise
                raise ValueError(f"{self.path}: line {number} must be {what}, is not ({error}); remove it") from None
            else:
                found.append(row)
        return found


def check_schema(where: Path, value: Any, allowed: Sequence[int], what: str, advice: str) -> None:
    """Refuse a JSON object of another version than its reader knows.

    Args:
        where: The file, for the message.
        value: What was read.
        allowed: Versions that are read.
        what: Name of the field in the message.
        advice: What to do about it.
    Raises:
        ValueError: If it is no object, or its `schema` is none of these.
    """
    found = value.get("schema") if isinstance(value, dict) else type(value).__name__
    if isinstance(found, bool) or found not in allowed:
        versions = " or ".join(map(str, allowed))
        raise ValueError(f"{where}: {what} must be {versions}, got {repr(found)[:40]}; {advice}")


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Number, from 1, and bytes of the lines that end with a newline and are not empty."""
    lines = path.read_bytes().split(b"\n")[:-1] if path.exists() else []
    return ((number, line) for number, line in enumerate(lines, 1) if line.strip())


def _cut_tail(handle: int) -> int:
    """Cut off what follows the last newline; the size of the file then."""
    size = os.fstat(handle).st_size
    if size and os.pread(handle, 1, size - 1) != b"\n":
        size = os.pread(handle, size, 0).rfind(b"\n") + 1
        os.ftruncate(handle, size)
    return size
