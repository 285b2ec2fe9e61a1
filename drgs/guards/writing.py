"""Writing where there may be no room or no permission: errors that name the file."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

__all__ = ["check_room", "is_full", "named"]

_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
_CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS)
_LEAST_ROOM = 1e6  # bytes that a library's database or log takes before it holds anything


def named(path: Path, error: OSError) -> OSError:
    """An error of writing in a sentence with the file's name: the system's has none, or that of a hidden file."""
    if error.strerror is None:
        return error  # is such a sentence, about a file that is written beside this one
    advice = "free some space" if error.errno in _FULL else "allow it" if error.errno in _CLOSED else ""
    if not advice:
        return error
    sentence = OSError(f"{path}: must be written, got: {error.strerror}; {advice} or choose another folder")
    sentence.errno = error.errno
    return sentence


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
