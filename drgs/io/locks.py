"""One writer a folder: a lock file that names its process, and is taken over from a process that no longer runs.

`filelock` is not used: its lock is the system's (`flock`), which says neither which command on which machine holds it
nor, on file systems of a network, anything about other machines; its lock that is a file stays after a crash. Here a
process that died on this machine is recognized by its number and the time at which it began, and one of another machine
is named and never overruled. `exclusive` is the system's lock, for the instant in which a file is changed.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

from drgs.io.json_files import parse_json

NAME = ".drgs.lock"
"""Name of the lock in the folder that is being written."""

_MAX_BYTES = 4096  # bytes of a lock file that are read: ours has a line
_UNWRITTEN_SECONDS = 2.0  # seconds after which a lock without content is of a process that was killed while it wrote it


class InUse(ValueError):
    """Another process writes into the folder, or may."""


def acquire(folder: Path, command: str) -> str | None:
    """Become the only writer of a folder.

    Args:
        folder: Exists; the lock is a file in it.
        command: What it is locked for, for people.
    Returns:
        Whose lock was taken over because its process no longer runs, in words; else None.
    Raises:
        InUse: If another process writes there, or one of another machine may.
        OSError: If the folder cannot be written.
    """
    path = folder / NAME
    stale = None
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    text = json.dumps({**_this_process(), "command": command, "since": now}) + "\n"
    with _one_at_a_time(folder):
        while True:
            owner = _owner(path)
            if owner is not None:
                _refuse_if_running(folder, path, owner)
                stale = _in_words(owner)
                path.unlink(missing_ok=True)
            try:
                handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
            except FileExistsError:  # another machine was faster
                continue
            try:
                with os.fdopen(handle, "w") as file:
                    file.write(text)
            except OSError:
                path.unlink(missing_ok=True)
                raise
            return stale


def release(folder: Path) -> None:
    """Remove this process's lock; another process's is left alone."""
    path = folder / NAME
    with contextlib.suppress(OSError):
        owner = _owner(path)
        if owner and all(owner.get(key) == value for key, value in _this_process().items()):
            path.unlink()


def host_of(folder: Path) -> str | None:
    """The machine whose process writes into a folder; None if none does, or it is unknown."""
    host = (_owner(folder / NAME) or {}).get("host")
    return host if isinstance(host, str) else None


def _refuse_if_running(folder: Path, path: Path, owner: dict) -> None:
    this = _this_process()
    if not owner:
        if time.time() - path.stat().st_mtime < _UNWRITTEN_SECONDS:
            raise InUse(f"{folder}: must not be written by two commands at once, another one begins; wait for it")
        return
    where = f"{folder}: must not be written by two commands at once, {_in_words(owner)} writes there"
    if (owner.get("host"), owner.get("space")) != (this["host"], this["space"]):
        raise InUse(f"{where}; choose another folder, or delete {path} if that process no longer runs")
    if owner.get("started") == _started(owner.get("pid")):
        raise InUse(f"{where}; wait for it, end it, or choose another folder")


def _owner(path: Path) -> dict | None:
    """The content of a lock; None: there is none, {}: it cannot be read."""
    try:
        value = parse_json(path.read_bytes()[:_MAX_BYTES], str(path))
    except FileNotFoundError:
        return None
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def _in_words(owner: dict) -> str:
    if not owner:
        return "a process that is not named"
    return f"`drgs {owner.get('command')}` (process {owner.get('pid')} on {owner.get('host')}, {owner.get('since')})"


def _this_process() -> dict:
    """The number of a process means something on one machine, in one container, until it is given to the next one."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:  # not Linux
        space = None
    return {"pid": os.getpid(), "host": os.uname().nodename, "space": space, "started": _started(os.getpid())}


def _started(pid: object) -> str | None:
    """Start time of a process of this machine, in the system's own unit; None if there is none of this number."""
    if not isinstance(pid, int) or pid <= 0:
        return None
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:  # not Linux
        import subprocess

        command = ["ps", "-o", "lstart=", "-p", str(pid)]
        try:
            return subprocess.run(command, capture_output=True, text=True, timeout=10).stdout.strip() or None
        except (OSError, subprocess.SubprocessError):
            return "unknown"  # then a lock is believed
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else f"{boot} {fields[19]}"  # a zombie writes nothing any more


@contextlib.contextmanager
def exclusive(handle: int) -> Iterator[None]:
    """Let one process of this machine at a time into the block, by the system's lock of an open file or folder, which
    ends with the process. On a file system that has no such locks nothing is locked.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    is_locked = False
    with contextlib.suppress(OSError):
        fcntl.flock(handle, fcntl.LOCK_EX)
        is_locked = True
    try:
        yield
    finally:
        if is_locked:
            fcntl.flock(handle, fcntl.LOCK_UN)


@contextlib.contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Else two that find the same stale lock might each remove the other's new one. Only processes of this machine may
    remove a lock, so that this is enough; other machines are kept out by the exclusive creation of the file.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        with exclusive(handle):
            yield
    finally:
        os.close(handle)
