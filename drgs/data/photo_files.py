"""Photographs as COLMAP needs them: under names that its model can hold, in formats that it decodes."""

from __future__ import annotations

import logging
import re
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drgs.data.checks import IMAGE_SUFFIXES, read_image
from drgs.data.heif import heif_as_jpeg, is_heif

__all__ = ["check_names", "link_or_copy", "readable_photos"]

_QUALITY = 98  # of JPEG, for what has been compressed before
_LONGEST = 251  # bytes of a name, where file systems allow 255 and COLMAP wants .png behind it
_SHOWN = 5  # names that a message repeats

_log = logging.getLogger(__name__)


def check_names(folder: Path, names: list[str], masked: bool = False) -> None:
    """Refuse names that a COLMAP model cannot hold: with line breaks or other control characters, or bytes that are not
    UTF-8; with masks, whose names are those and `.png`, also too long ones. Say which photographs are hidden, and left
    out.

    Raises:
        ValueError: There is one.
    """
    for name in names:
        if any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in name):
            raise ValueError(
                f"{folder}: the name of a photo must be one line of UTF-8 without control characters, got "
                f"{name[:80]!r}; rename this photo"
            )
        if masked and len(name.encode()) > _LONGEST:
            raise ValueError(
                f"{folder}: with masks, the name of a photo must have at most {_LONGEST} bytes, got "
                f"{len(name.encode())}: {name[:40]}...; rename this photo and its mask"
            )
    # Those of ._ are no photographs, but what macOS notes about them on other systems.
    hidden = [p.name for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and re.match(r"\.(?!_)", p.name)]
    if hidden:
        shown = ", ".join(sorted(hidden)[:_SHOWN]) + (", ..." if len(hidden) > _SHOWN else "")
        _log.warning("%s: %d hidden photos are left out (%s); rename them to use them", folder, len(hidden), shown)


def readable_photos(folder: Path, names: list[str], target: Path, progress: Callable[[str, int, int], None]) -> Path:
    """A folder where COLMAP can read all photographs under their names.

    Args:
        folder, names: The photographs.
        target: Folder that is made if some of them are HEIC, AVIF or WebP: these become JPEG there, whatever their
            names say, with their EXIF (which of WebP is lost), and the others links.
        progress: Called with ("decoding", done, total) where there are such.
    Returns:
        `target`, or `folder` if COLMAP reads all of it.
    Raises:
        ValueError: One cannot be decoded, or pillow-heif is missing.
    """
    import cv2

    foreign = [name for name in names if is_heif(folder / name) or _is_webp(folder / name)]
    if not foreign:
        return folder
    target.mkdir()
    for name in set(names) - set(foreign):
        link_or_copy(folder / name, target / name)
    for done, name in enumerate(foreign):
        progress("decoding", done, len(foreign))
        if is_heif(folder / name):
            (target / name).write_bytes(heif_as_jpeg(folder / name, _QUALITY))
        else:
            pixels = np.ascontiguousarray(read_image(folder / name)[..., 2::-1])  # without alpha, in OpenCV's order
            _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            (target / name).write_bytes(encoded.tobytes())
    progress("decoding", len(foreign), len(foreign))
    return target


def link_or_copy(file: Path, target: Path) -> None:
    """Make a new file that is another one: a link, or a copy where the file system has none."""
    try:
        target.symlink_to(file.resolve())
    except OSError:
        shutil.copyfile(file, target)


def _is_webp(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(12)
    return head[:4] == b"RIFF" and head[8:] == b"WEBP"
