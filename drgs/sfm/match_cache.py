"""Triangulated points of photographs with given poses, kept from one fit to the next of the same photographs.

Matching takes minutes. Its points depend on the photographs, their masks and cameras and on the code alone: a hash
of all these names the file in the user's cache, so that a photograph that changes is matched anew.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import logging
import os
import re
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drgs.data.checks import check_npz
from drgs.data.views import View
from drgs.io.atomic import hidden_file, is_left_over
from drgs.sfm.guided import Triangulated

_LARGEST = 256 << 20  # bytes of all files; those of a hundred photographs have about 5 MiB
_CHUNK = 1 << 20  # bytes that are hashed at once
_OURS = re.compile(r"[0-9a-f]{40}\.npz")
_LEFT = 86_400  # seconds after which what a killed process has not finished is removed

_log = logging.getLogger(__name__)


def cached(views: list[View], triangulate: Callable[[], Triangulated]) -> Triangulated:
    """The points of earlier photographs that are the same as these, else what `triangulate` returns, which is kept.

    A file that is damaged, or that drgs did not make, is not read; where nothing can be kept, nothing is.

    Args:
        views: Views with images.
        triangulate: Matches the views and triangulates, which takes minutes.
    """
    try:
        digest = _digest(views)
        file = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "drgs" / "matches" / f"{digest}.npz"
    except (OSError, RuntimeError) as error:  # a photograph that cannot be read, a user without a home
        _log.info("matches are not kept: %s", error)
        return triangulate()
    kept = _read(file, len(views))
    if kept is None:
        kept = triangulate()
        _write(file, kept)
    return kept


def _digest(views: list[View]) -> str:
    """Hash of all that triangulation depends on: content of photographs and masks, cameras, and the code."""
    digest = hashlib.blake2b(_code(), digest_size=20)
    for view in views:
        for field in dataclasses.fields(view.camera):
            value = getattr(view.camera, field.name)
            value = value.detach().cpu().numpy() if hasattr(value, "detach") else value
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        digest.update(repr((view.background, view.keeps_lens, view.mask_path is None)).encode())
        if view.frame is not None:  # a video has gigabytes
            status = view.frame.path.stat()
            row = view.frame.path.resolve(), status.st_size, status.st_mtime_ns, view.frame.index
            digest.update(repr(row).encode())
        for path in (view.image_path, view.mask_path):
            if path is not None:
                digest.update(_content(path))
    return digest.hexdigest()


def _read(path: Path, count: int) -> Triangulated | None:
    """What a file holds of so many views; None where it is not there, damaged, or not of ours."""
    if not path.is_file():
        return None
    try:
        if sorted(check_npz(path)) != ["colors", "points", "shown"]:
            raise ValueError("other arrays")
        with np.load(path, allow_pickle=False) as arrays:
            points, colors, packed = arrays["points"], arrays["colors"], arrays["shown"]
        number = len(points)
        wanted = [((number, 3), np.float64), ((number, 3), np.float32), ((count, -(-number // 8)), np.uint8)]
        if [(array.shape, array.dtype) for array in (points, colors, packed)] != wanted:
            raise ValueError("arrays of other shapes")
        if not (np.isfinite(points).all() and np.isfinite(colors).all()):
            raise ValueError("numbers that are not finite")
        os.utime(path)  # used last
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        _log.info("%s is not used: %s", path, error)
        return None
    _log.info("points are those of an earlier fit to the same photographs (%s)", path)
    return Triangulated(points, colors, np.unpackbits(packed, axis=1, count=number).astype(bool))


def _write(path: Path, kept: Triangulated) -> None:
    """Keep points, if there is a place for them, and delete what was used longest ago."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with hidden_file(str(path.parent.resolve()), path.name) as hidden:
            with open(hidden, "wb") as file:
                np.savez(file, points=kept.points, colors=kept.colors, shown=np.packbits(kept.shown, axis=1))
            os.replace(hidden, path)
        _bound(path.parent)
    except OSError as error:
        _log.info("matches are not kept: %s", error)


def _bound(folder: Path) -> None:
    """Delete the files that were used longest ago until the others are small enough; no file that is not of ours."""
    files = []
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another process deletes, too
            status = path.lstat()
            if _OURS.fullmatch(path.name):
                files.append((status.st_mtime, status.st_size, path))
            elif is_left_over(path) and time.time() - status.st_mtime > _LEFT:
                path.unlink()
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= _LARGEST:
            break
        with contextlib.suppress(OSError):
            path.unlink()
            total -= size


def _content(path: Path) -> bytes:
    """Hash of a file."""
    digest = hashlib.blake2b(digest_size=20)
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.digest()


@functools.cache
def _code() -> bytes:
    """Hash of the modules that read photographs and match them, and of the version of their features."""
    import cv2

    digest = hashlib.blake2b(cv2.__version__.encode(), digest_size=20)
    package = Path(__file__).parents[1]
    rooms = (*sorted((package / "data").glob("*.py")), *sorted((package / "sfm").glob("*.py")))
    for path in (*rooms, *sorted((package / "cameras").glob("*.py"))):
        digest.update(_content(path))
    return digest.digest()
