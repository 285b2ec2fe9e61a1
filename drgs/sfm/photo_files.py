"""Photographs as COLMAP needs them: whole, large enough, with names that its model can hold, in formats it decodes.

Those that are not are left out by `drgs sfm` and `drgs capture`, with a line that names the user's own file, before any
feature is looked for.
"""

from __future__ import annotations

import logging
import re
import shutil
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from drgs.data.images import IMAGE_SUFFIXES, MissingReader, heif_as_jpeg, is_heif, read_image

_QUALITY = 98  # of JPEG, for what has been compressed before
_LONGEST = 251  # bytes of a name, where file systems allow 255 and COLMAP wants .png behind it
_SHOWN = 5  # names that a message repeats
_FAULTS = 20  # photographs that the log says what is wrong with
_SMALLEST = 16  # pixels: COLMAP 4's detector with affine shapes crashes over images with 15 rows or columns

_KNOWN = 4096  # photographs of which is remembered what decoding them has shown

_log = logging.getLogger(__name__)
_decoded: dict[tuple[Path, int, int], tuple[int, int] | str] = {}  # by file, size in bytes and time of change


def check_names(folder: Path, names: Sequence[str], masked: bool = False) -> None:
    """Refuse names that are too long for masks, whose names are those and `.png`. Say which photographs are hidden, and
    left out.

    Raises:
        ValueError: There is one.
    """
    for name in names:
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


def usable_photos(
    photos: Sequence[Path],
    where: Path,
    fewest: int = 0,
    max_image_size: int = 1600,
    decode: Callable[[Path], np.ndarray] = read_image,
) -> list[Path]:
    """Those photographs that features can be found in; all are decoded. The log names the others.

    Args:
        photos: Files.
        where: What was named, for the message.
        fewest: How many there must be.
        max_image_size: Pixels on the longer side that features are found at; 0 for the photographs' own.
        decode: As `read_image`, which it may keep the pictures of.
    Raises:
        ValueError: The package that reads one is missing, or fewer are left; the message then says what is wrong with
            the first of the others.
    """
    return leave_out(photos, lambda photo: photo_fault(photo, max_image_size, decode), where, fewest)


def leave_out(
    photos: Sequence[Path], fault_of: Callable[[Path], str], where: Path, fewest: int = 0, what: str = "photos"
) -> list[Path]:
    """Those photographs, or other files, that have no fault; the log names the others.

    Args:
        photos, where, fewest: The arguments of `usable_photos`.
        fault_of: What is wrong with one, a line that names it; empty where nothing is.
        what: What they are, for the message.
    Raises:
        ValueError: Fewer are left.
    """
    faults_of = {photo: fault_of(photo) for photo in photos}
    kept = [photo for photo in photos if not faults_of[photo]]
    faults = [fault for fault in faults_of.values() if fault]
    if faults and len(kept) < fewest:
        raise ValueError(f"{where}: must hold at least {fewest} {what} that can be used, got {len(kept)}; {faults[0]}")
    for fault in faults[:_FAULTS]:
        _log.warning("left out: %s", fault)
    if len(faults) > _FAULTS:
        _log.warning("%s: %d more %s are left out for such reasons", where, len(faults) - _FAULTS, what)
    return kept


def entry_fault(path: Path) -> str:
    """Why an entry of a folder is no photograph or video, a line that names it; empty where it may be one: a file whose
    name a COLMAP model can hold. It is not opened.
    """
    if any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in path.name):
        return (
            f"{path.parent}: the name of a photo must be one line of UTF-8 without control characters, got "
            f"{path.name[:80]!r}; rename this photo"
        )
    if path.is_file():
        return ""
    if not path.exists():
        kind = f"a link to {path.readlink()}, where nothing is" if path.is_symlink() else "not there"
    else:
        kind = "a folder" if path.is_dir() else "a pipe or a device"
    return f"{path}: must be a file, is {kind}; restore or remove it"


def photo_fault(path: Path, max_image_size: int = 1600, decode: Callable[[Path], np.ndarray] = read_image) -> str:
    """Why features cannot be found in a photograph, a line that names it; empty where they can. It is decoded, once.

    Args:
        path: The photograph.
        max_image_size: Pixels on the longer side that features are found at; 0 for its own.
        decode: As `read_image`.
    Raises:
        MissingReader: The package that reads it is missing.
    """
    if fault := entry_fault(path):
        return fault
    path = own_file(path)
    status = path.stat()
    key = path, status.st_size, status.st_mtime_ns
    if key not in _decoded:
        while len(_decoded) >= _KNOWN:
            _decoded.pop(next(iter(_decoded)))
        _decoded[key] = _size_or_fault(path, decode)
    found = _decoded[key]
    if isinstance(found, str):
        return found
    shrunk = min(1.0, max_image_size / max(found)) if max_image_size else 1.0
    if shrunk * min(found) < _SMALLEST:
        size = f"{found[0]}x{found[1]}" + (f" at {max_image_size} pixels along the longer side" if shrunk < 1 else "")
        return (
            f"{path}: a photo must be {_SMALLEST} pixels high and wide to have features, is {size}; take a larger one"
        )
    return ""


def _size_or_fault(path: Path, decode: Callable[[Path], np.ndarray]) -> tuple[int, int] | str:
    """(width, height) of a photograph that can be decoded, else what the reader says."""
    try:
        height, width = decode(path).shape[:2]
    except MissingReader:
        raise
    except (ValueError, OSError) as error:
        return str(error) if isinstance(error, ValueError) else f"{path}: must be readable, got: {error.strerror}"
    return width, height


def own_file(path: Path) -> Path:
    """The file that the user knows, where a path is a link that drgs may have made to it."""
    return path.resolve() if path.is_symlink() and path.exists() else path


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
