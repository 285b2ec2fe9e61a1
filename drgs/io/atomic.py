"""Files and folders that are being written: hidden until they are whole, gone when their block or the process ends,
removed after a killed one; and errors of writing that name the file.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

PATTERN = re.compile(r"\.drgs\..+\.[a-z0-9_]{8}\.tmp(\.[a-z0-9]+)?")
"""What they are called, and nothing else is."""

_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
_CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS)
_LEAST_ROOM = 1e6  # bytes that a library's database or log takes before it holds anything

_unfinished: set[str] = set()  # paths of what this process is writing


@contextlib.contextmanager
def hidden_file(folder: str, name: str, suffix: str = "") -> Iterator[str]:
    """The name of an empty private file; after the block it is renamed, or removed.

    Args:
        folder: Path of the folder that it is in, without links.
        name: What it will be called.
        suffix: That its name must end with, for a library that goes by it.
    """
    handle, hidden = tempfile.mkstemp(prefix=f".drgs.{name}.", suffix=f".tmp{suffix}", dir=folder)
    os.close(handle)
    _unfinished.add(hidden)
    try:
        yield hidden
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(hidden)
        raise
    finally:
        _unfinished.discard(hidden)


@contextlib.contextmanager
def temporary_folder(kind: str, parent: str | os.PathLike | None = None) -> Iterator[Path]:
    """A folder that is gone after the block, or when the process is interrupted.

    Args:
        kind: Part of its name.
        parent: Folder that it is put into; default the system's place for such.
    Raises:
        OSError: Of the block: where there is no room left, in a sentence that names `parent`.
    """
    shown = Path(tempfile.gettempdir() if parent is None else parent)
    try:
        name = tempfile.mkdtemp(prefix=f".drgs.{kind}.", suffix=".tmp", dir=os.path.realpath(shown))
    except OSError as error:
        raise named(shown, error) from None
    _unfinished.add(name)
    try:
        yield Path(name)
    except OSError as error:
        # That of a write has no name; one of another folder around this one is named there.
        if is_full(error) and str(error.filename or name).startswith(name):
            raise named(shown, error) from None
        raise
    finally:
        delete(Path(name))
        _unfinished.discard(name)


def is_left_over(path: Path) -> bool:
    """Whether another process left it, in a folder that this one alone writes into."""
    return PATTERN.fullmatch(path.name) is not None and str(path) not in _unfinished


def delete_all() -> None:
    """Remove everything that this process has not finished."""
    for name in list(_unfinished):
        delete(Path(name))


def delete(path: Path) -> None:
    """Remove a file or a folder, also one that native code is still writing into."""
    for _ in range(5):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
        if not os.path.lexists(path):
            return
        time.sleep(0.02)


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
