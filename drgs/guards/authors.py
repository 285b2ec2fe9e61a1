"""Whose a file is: by its content, which a journal recorded (outputs.py), or by the command that it says it is of."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

__all__ = ["author_of", "fingerprint", "is_log", "is_there"]

_MAX_JSON = 64 << 20  # bytes; a longer file is none that a command wrote as its report
_LARGE = 1 << 20  # bytes that take long enough to hash that the result is kept

_hashes: dict[tuple, str] = {}  # of checkpoints, which are moved and linked


def fingerprint(path: Path) -> str:
    """The SHA-256 hash of a file's content; of a link, where it points to."""
    if path.is_symlink():
        return f"link to {os.readlink(path)}"
    status = path.stat()
    key = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
    if key in _hashes:
        return _hashes[key]
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if status.st_size > _LARGE:  # small ones are quick, and might be replaced within a tick of the clock
        _hashes[key] = digest
    return digest


def is_there(path: Path, digest: str) -> bool:
    """Whether a path is a file or link with this fingerprint."""
    return os.path.lexists(path) and not (path.is_dir() and not path.is_symlink()) and fingerprint(path) == digest


def author_of(path: Path) -> str | None:
    """The command that a JSON file of ours says it is of."""
    try:
        if path.stat().st_size > _MAX_JSON:
            return None
        value = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return value.get("command") if isinstance(value, dict) and isinstance(value.get("schema"), int) else None


def is_log(path: Path) -> bool:
    """Whether the first line is an event of `drgs.files.Run.log`."""
    try:
        with path.open("rb") as file:
            value = json.loads(file.readline(_MAX_JSON))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(value, dict) and isinstance(value.get("schema"), int) and "event" in value
