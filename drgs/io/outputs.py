"""Which files a command may write: never an input, never a file that drgs did not make, in a folder that it locks.

A folder that a command writes into is locked first, before anything is loaded: `lock_folder` finds out that it can be
written, locks it, and compares what is there with what will be written. `.drgs.jsonl` in it records every file that we
put there with its SHA-256 hash, before the file appears: what is there under its name with another hash is somebody
else's, or was edited, and stays. The same is checked again when a file is put in its place.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import os
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from drgs.io import atomic, locks
from drgs.io.atomic import named
from drgs.io.journal import Journal

JOURNAL = ".drgs.jsonl"
_MAX_JSON = 64 << 20  # bytes; a longer file is none that a command wrote as its report
_KEEP_HASH_BYTES = 1 << 20  # bytes that take long enough to hash that the result is kept

_log = logging.getLogger(__name__)
_held: dict[Path, LockedFolder] = {}
_hashes: dict[tuple, str] = {}  # of checkpoints, which are moved and linked


class LockedFolder:
    """A folder that this process alone writes into, until `release`; also a `with` block.

    Attributes:
        path: The folder, without links.
        command: Name of the command that writes.
    """

    def __init__(self, path: Path, command: str):
        self.path = path
        self.command = command
        self._thread = threading.get_ident()
        self._depth = 1
        self._inputs: list[Path] = []
        self._new: list[Path] = []  # folders that were created for it, from the outside in
        self._written: dict[str, dict[str, str]] = {}  # name -> hash -> command

    def __enter__(self) -> LockedFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def check(self, names: Iterable[str]) -> None:
        """See to it that files may be written.

        Args:
            names: Relative to the folder.
        Raises:
            ValueError: If one is an input, or is there and was not made by this command.
        """
        for name in names:
            target = self.path / name
            if not os.path.lexists(target):
                continue
            _refuse_inputs(target, self._inputs)
            if not self.is_ours(target):
                raise ValueError(
                    f"{target}: must not be replaced, it is not as `drgs {self.command}` left it or is somebody "
                    "else's; move it away or choose another output (-o)"
                )

    def is_ours(self, path: Path, by: tuple[str, ...] | None = None) -> bool:
        """Whether a file, a link or everything in a folder is as drgs wrote it.

        Args:
            path: Path of a file in the folder.
            by: Commands that may have written it; default any.
        """
        if path.is_dir() and not path.is_symlink():
            return all(self.is_ours(child, by) for child in path.iterdir())
        if not path.is_symlink() and not path.is_file():
            return False
        written = self._written.get(self._name_of(path))
        command = written.get(_fingerprint(path)) if written else None
        if command is None and path.suffix == ".json":
            command = _author_of(path)
            command = command if command == self.command else None
        if command is None and path.suffix == ".jsonl" and _is_log(path):
            command = self.command
        return command is not None and (by is None or command in by)

    def _name_of(self, path: Path) -> str:
        """Name in the folder of a path that leads there, be it from the working directory or through a link."""
        return (path.parent.resolve() / path.name).relative_to(self.path).as_posix()

    def record(self, name: str, content: str | os.PathLike, command: str | None = None) -> None:
        """Write down that a command is about to put a file into the folder.

        Args:
            name: Relative to the folder.
            content: A file or link with the same content.
            command: Default the one that holds the folder.
        """
        row = {"file": name, "sha256": _fingerprint(Path(content)), "command": command or self.command}
        known = self._written.setdefault(name, {})
        if known.get(row["sha256"]) == row["command"]:
            return
        known[row["sha256"]] = row["command"]
        Journal(self.path / JOURNAL).append(row)

    def record_existing(self, names: Iterable[str], command: str) -> None:
        """Record the files of a folder without a record as a command's own: a copy without hidden files."""
        if not (self.path / JOURNAL).exists():
            for name in names:
                if (self.path / name).is_file():
                    self.record(name, self.path / name, command)

    def record_planned(self, path: Path, name: str) -> None:
        """Record what `put` will move, for which there may be no room: before what it replaces is removed."""
        for part in (path, *(path.rglob("*") if path.is_dir() and not path.is_symlink() else ())):
            if part.is_symlink() or part.is_file():
                self.record((Path(name) / part.relative_to(path)).as_posix(), part)

    def put(self, path: Path, name: str) -> None:
        """Move a finished file, link or folder into the folder, where nothing must be of that name."""
        self.record_planned(path, name)
        if os.path.lexists(self.path / name):
            raise ValueError(f"{self.path / name}: must not be replaced, it has appeared meanwhile; move it away")
        os.rename(path, self.path / name)

    def remove(self, path: Path) -> None:
        """Delete a file, a link or a folder of files, each of which drgs has written.

        Raises:
            ValueError: If one is not, or if an input is among them; then nothing is deleted.
        """
        if not os.path.lexists(path):
            return
        self.check([self._name_of(path)])
        if path.is_dir() and not path.is_symlink():
            for input_path in self._inputs:
                if path in (input_path, *input_path.parents):
                    raise ValueError(f"{input_path}: must not be an input and be replaced; choose another output (-o)")
            for child in path.iterdir():
                self.remove(child)
            path.rmdir()
        else:
            path.unlink()

    def check_all(self, by: tuple[str, ...]) -> list[Path]:
        """What is in the folder, all of which the given commands must have written.

        Raises:
            ValueError: If they have not.
        """
        ours = JOURNAL, locks.NAME
        content = [x for x in self.path.iterdir() if x.name not in ours and not atomic.PATTERN.fullmatch(x.name)]
        for path in content:
            if not self.is_ours(path, by):
                raise ValueError(
                    f"{path}: must not be deleted, `drgs {self.command}` did not make it or it was changed; "
                    "move it away or choose another output (-o)"
                )
        return content

    def clear(self, by: tuple[str, ...]) -> None:
        """Delete everything in the folder, if all of it is by these commands (`check_all`)."""
        for path in self.check_all(by):
            self.remove(path)

    def remove_unfinished(self, *folders: str) -> None:
        """Delete unfinished files of processes that were killed here, in the folder and in the given ones in it."""
        for folder in (self.path, *(self.path / name for name in folders)):
            for path in folder.iterdir() if folder.is_dir() else ():
                if atomic.is_left_over(path):
                    _log.info("%s: removed, an interrupted command left it unfinished", path)
                    atomic.delete(path)

    def release(self) -> None:
        """Unlock the folder; it is removed if it was created for the command and nothing came into it."""
        self._depth -= 1
        if self._depth:
            return
        _held.pop(self.path, None)
        locks.release(self.path)
        with contextlib.suppress(OSError):
            if self._new and {path.name for path in self.path.iterdir()} <= {JOURNAL}:
                (self.path / JOURNAL).unlink(missing_ok=True)
        for path in reversed(self._new):
            with contextlib.suppress(OSError):
                path.rmdir()

    def _read(self) -> None:
        """Read the journal, and shorten it to what is still so."""
        path = self.path / JOURNAL
        rows = Journal(path).rows(_check_row, skip_damaged=True)  # an edited row is none of ours
        for row in rows:
            self._written.setdefault(row["file"], {})[row["sha256"]] = row["command"]
        if len(rows) > 2 * len(self._written) + 100:
            kept = [row for row in rows if _is_there(self.path / row["file"], row["sha256"])]
            with replacing(path, checked=False) as name:
                Path(name).write_text("".join(json.dumps(row) + "\n" for row in kept))


def lock_folder(
    folder: str | os.PathLike, command: str, names: Iterable[str] = (), inputs: Iterable[str | os.PathLike] = ()
) -> LockedFolder:
    """Make a folder if it is missing, lock it, and see to it that it can be written; before anything is loaded.

    Within one thread a locked folder can be locked again; the first command's name stays.

    Args:
        folder: What -o says.
        command: Name of the command, for people and for the record of what it wrote.
        names: Files that will be written; more may be checked later (`LockedFolder.check`).
        inputs: Files and folders that are read; those that do not exist are left out.
    Raises:
        ValueError: If it is no folder that can be written, another process writes there, or a name is taken by an
            input or a file that drgs did not make.
    """
    path = Path(os.path.realpath(folder))
    held = _held.get(path)
    if held is not None and held._thread == threading.get_ident():
        held._depth += 1
    else:
        held = _locked(Path(folder), path, command, held)
    held._inputs += [Path(os.path.realpath(x)) for x in inputs if os.path.exists(x)]
    try:
        held.check(names)
    except BaseException:
        held.release()
        raise
    return held


def check_file(
    path: str | os.PathLike,
    command: str,
    inputs: Iterable[str | os.PathLike] = (),
    is_ours: Callable[[Path], bool] | None = None,
) -> None:
    """The same for a command that writes one file.

    Args:
        path: The file.
        command: Name of the command.
        inputs: Files and folders that are read, as `lock_folder` takes them.
        is_ours: Whether a file is one that the command wrote; default: a JSON file that says so.
    Raises:
        ValueError: If it cannot be written, is an input, or is there and was not made by this command.
    """
    path = Path(path)
    if path.is_dir():
        kind, example = ("", "") if is_ours else ("JSON ", f", e.g. {path / f'{command}.json'}")
        raise ValueError(f"{path}: must be a {kind}file, is a folder; name a file in it{example}")
    if os.path.lexists(path):
        _refuse_inputs(path, [Path(os.path.realpath(x)) for x in inputs if os.path.exists(x)])
        if path.is_symlink() or not (is_ours(path) if is_ours else _author_of(path) == command):
            raise ValueError(
                f"{path}: must not be replaced, `drgs {command}` did not make it; move it away or choose another output"
            )
    new = _make(path.parent, path.parent)
    try:
        with tempfile.NamedTemporaryFile(prefix=".drgs.", suffix=".tmp", dir=path.parent):
            pass
    except OSError as error:
        raise _unwritable(path.parent, error) from None
    finally:
        for folder in reversed(new):  # as long as nothing has been computed, nothing is left
            folder.rmdir()


def release_all() -> None:
    """Unlock what a command has locked, at its end."""
    for held in reversed(list(_held.values())):
        held._depth = 1
        held.release()


def clean() -> None:
    """Remove what is unfinished, and the locks; for a process that is about to end in the middle of its work."""
    atomic.delete_all()
    release_all()


@contextlib.contextmanager
def replacing(path: str | os.PathLike, suffix: str = "", checked: bool = True) -> Iterator[str]:
    """The name of a hidden file beside `path`, which it becomes once the block ends; missing folders are made.

    A process that dies leaves the old file, or none, and at most the hidden one.

    Args:
        path: The file.
        suffix: That the hidden name must end with, for a library that goes by it.
        checked: Refuse, in a locked folder, to replace what drgs did not make, and record what it made.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        parent = os.path.realpath(path.parent)
        with atomic.hidden_file(parent, path.name, suffix) as name:
            yield name
            umask = os.umask(0)  # hidden files are private; what we write is to be shared as any other
            os.umask(umask)
            os.chmod(name, 0o666 & ~umask)
            held = _holder_of(Path(parent)) if checked else None
            if held is not None:
                inside = (Path(parent) / path.name).relative_to(held.path).as_posix()
                held.check([inside])
                held.record(inside, name)
            os.replace(name, path)
    except OSError as error:
        raise named(path, error) from None


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """A binary file that appears under its name only once it is complete; missing folders are made.

    A process that dies leaves the old file, or none, and at most a hidden `.drgs.NAME.*.tmp` beside it.
    """
    with replacing(path) as name, open(name, "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def write_whole(path: str | os.PathLike, data: bytes) -> None:
    """Write a file atomically, as `atomic_write`."""
    with atomic_write(path) as file:
        file.write(data)


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Write JSON atomically, with settings dataclasses as objects and paths as text; NaN is refused."""
    text = json.dumps(value, indent=2, default=json_form, allow_nan=False)
    write_whole(path, text.encode() + b"\n")


def json_form(value: Any) -> Any:
    """The JSON form of a settings dataclass, a path or a NumPy value; TypeError for anything else."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"no JSON form of {type(value).__name__}")


def _locked(folder: Path, path: Path, command: str, held: LockedFolder | None) -> LockedFolder:
    """A folder, created and locked, with its journal read; all undone if that fails."""
    if held is not None:
        raise ValueError(f"{folder}: must not be written by two threads at once; choose another folder")
    locked, new = LockedFolder(path, command), _make(folder, path)
    locked._new = new
    try:
        stale = locks.acquire(path, command)
        if stale is not None:
            _log.warning("%s: %s ended without unlocking it, goes on here", folder, stale)
        _held[path] = locked
        locked._read()
        locked.remove_unfinished()
    except BaseException as error:
        if path in _held:
            locked.release()
        for x in reversed(new):
            with contextlib.suppress(OSError):
                x.rmdir()
        if isinstance(error, OSError):
            raise _unwritable(folder, error) from None
        raise
    return locked


def _check_row(row: dict) -> None:
    """Raise unless it is a row that `LockedFolder.record` wrote."""
    for key in ("file", "sha256", "command"):
        if not isinstance(row[key], str) or "\0" in row[key]:
            raise ValueError(f"{key} must be a text")


def _make(folder: Path, path: Path) -> list[Path]:
    """Make a folder; those that were missing, from the outside in."""
    missing = [x for x in (path, *path.parents) if not os.path.lexists(x)][::-1]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(folder, error) from None
    return missing


def _unwritable(folder: Path, error: OSError) -> ValueError:
    reason = error.strerror or error
    return ValueError(f"{folder}: the output must be a folder that can be written, got: {reason}; choose another")


def _refuse_inputs(target: Path, inputs: list[Path]) -> None:
    for path in inputs:
        with contextlib.suppress(OSError):
            if os.path.samefile(path, target):  # through links of either kind
                raise ValueError(f"{target}: must not be read and replaced, it is an input; choose another output (-o)")


def _holder_of(folder: Path) -> LockedFolder | None:
    """The innermost locked folder that a folder is in."""
    return next((_held[x] for x in (folder, *folder.parents) if x in _held), None)


def _fingerprint(path: Path) -> str:
    """The SHA-256 hash of a file's content; of a link, where it points to."""
    if path.is_symlink():
        return f"link to {os.readlink(path)}"
    status = path.stat()
    key = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
    if key in _hashes:
        return _hashes[key]
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if status.st_size > _KEEP_HASH_BYTES:  # small ones are quick, and might be replaced within a tick of the clock
        _hashes[key] = digest
    return digest


def _is_there(path: Path, digest: str) -> bool:
    """Whether a path is a file or link with this fingerprint."""
    return os.path.lexists(path) and not (path.is_dir() and not path.is_symlink()) and _fingerprint(path) == digest


def _author_of(path: Path) -> str | None:
    """The command that a JSON file of ours says it is of."""
    try:
        if path.stat().st_size > _MAX_JSON:
            return None
        value = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return value.get("command") if isinstance(value, dict) and isinstance(value.get("schema"), int) else None


def _is_log(path: Path) -> bool:
    """Whether the first line is an event of `drgs.files.Run.log`; without any, the disk was full before the first."""
    try:
        if path.stat().st_size == 0:
            return True
        with path.open("rb") as file:
            value = json.loads(file.readline(_MAX_JSON))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(value, dict) and isinstance(value.get("schema"), int) and "event" in value
