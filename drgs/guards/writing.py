"""Writing where there may be no room or no permission: errors that name the file, and lines that are whole."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import Any

__all__ = ["append_line", "is_full", "named"]

_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
_CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS)


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
    advice = "free some space" if error.errno in _FULL else "allow it" if error.errno in _CLOSED else ""
    if not advice:
        return error
    told = OSError(f"{path}: must be written, got: {error.strerror}; {advice} or choose another folder")
    told.errno = error.errno
    return told


def is_full(error: BaseException) -> bool:
    """Whether an error says that there is no room left: it will be there for whatever is tried next."""
    return isinstance(error, OSError) and error.errno in _FULL
