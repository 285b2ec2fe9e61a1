"""Writing where there may be no room or no permission: errors that name the file, and lines that are whole."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

__all__ = ["append_line", "check_room", "is_full", "named"]

_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
_CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS)
_LEAST_ROOM = 1e6  # bytes that a library's database or log takes before it holds anything


def append_line(path: Path, value: dict, **options: Any) -> None:
    """Append a JSON object to a file of lines in one write: a process that is killed leaves at most half of the last.

    Args:
        path: The file.
        value, options: What `json.dumps` takes.
    Raises:
        OSError: If there is no room for all of it, which leaves the file as it was, or no permission.
    """
    line = json.dumps(value, **options).encode() + b"\n"
    try:
        with path.open("ab", buffering=0) as file:
            whole = file.tell()
            if file.write(line) < len(line):  # as much as there was room for
                file.truncate(whole)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        raise named(path, error) from None


def named(path: Path, error: OSError) -> OSError:
    """An error of writing in a sentence with the file's name: the system's has none, or that of a hidden file."""
    if error.strerror is None:
        return error  # is such a sentence, about a file that is written beside this one
    advice = "free some space" if error.errno in _FULL else "allow it" if error.errno in _CLOSED else ""
    if not advice:
        return error
    told = OSError(f"{path}: must be written, got: {error.strerror}; {advice} or choose another folder")
    told.errno = error.errno
    return told


def check_room(folder: Path, needed: float = 0.0) -> None:
    """Refuse to let a library write that ends the process, or writes half a file, where the disk becomes full.

    Args:
        folder: Folder that it will write into.
        needed: Bytes that it may take.
    Raises:
        OSError: If there are fewer.
    """
    free, needed = shutil.disk_usage(folder).free, max(needed, _LEAST_ROOM)
    if free < needed:
        text = f"{free / 1e6:.1f} MB of free space where the next step may take {needed / 1e6:.1f} MB"
        raise OSError(errno.ENOSPC, text, os.fspath(folder))


def is_full(error: BaseException) -> bool:
    """Whether an error says that there is no room left: it will be there for whatever is tried next."""
    return isinstance(error, OSError) and error.errno in _FULL
