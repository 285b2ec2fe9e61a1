"""Image files: how large they are by their headers, before anything of that size is allocated, and their pixels.

PNG, JPEG, TIFF, BMP and WebP are decoded by OpenCV, in this process, once their headers have been compared with their
files; HEIC and AVIF, as phones make them, by a process of its own (heif_decoding.py).

Headers are read here and not by Pillow, which allocates the canvas of a WebP when it opens one (2 GB of a file of 90
bytes), takes the last of two sizes of a JPEG, and does not look whether the chunks of a PNG lie within its file.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import mmap
import os
import re
import struct
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drgs.data.reader_process import Child
from drgs.io.foreign import refuse_foreign
from drgs.runtime import memory

HEIF_SUFFIXES = (".heic", ".heif", ".hif", ".avif")
_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"avif", b"avis")

_decoder = Child("drgs.data.heif_decoding", "a photograph that can be decoded", "convert it to JPEG, or leave it out")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", *HEIF_SUFFIXES)
_MAX_PIXELS = 2**31  # what an int of OpenCV holds
# What OpenCV, libpng, libjpeg, libtiff and FFmpeg begin their lines with; OpenCV ends some with an empty one.
_DECODER = re.compile(
    rb"^\[ *(WARN|ERROR|INFO)|^\[[\w, ]+ @ 0x|^OpenCV|^Truncating packet|"  # OpenCV, FFmpeg
    rb"^libpng|JPEG|TIFF|JFIF|SOS|marker|Huffman|^bogus|^\r?\n$",
    re.IGNORECASE,
)

_log = logging.getLogger(__name__)


def list_images(folder: Path) -> list[Path]:
    """Image files directly in a folder, by name; hidden files are left out."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image; only the header is read, where it says so, and whether a PNG or JPEG ends.

    Raises:
        ValueError: Not an image, of no or more than 2^31 pixels, or of more than its file can hold, or cut off.
    """
    if is_heif(path):
        return heif_size(path)
    if not is_whole(path):
        raise _ends_early(path)
    stated = stated_size(path)
    width, height = stated or read_image(path).shape[1::-1]
    if not 1 <= width * height <= _MAX_PIXELS or (stated and not can_hold(path, width, height)):
        raise ValueError(
            f"{path}: an image must have 1 to 2^31 pixels, as many as its {path.stat().st_size} bytes can hold, its "
            f"header says {width}x{height}; it is damaged, copy it again"
        )
    return width, height


def is_damaged(path: Path) -> bool:
    """Whether an image file that is there can be no photograph of a data set: not an image, empty, or cut off.

    Raises:
        ValueError: The file is of another kind, of which it is said what to do, e.g. a Git LFS pointer.
        MissingReader: The package that reads it is missing, so that nobody knows.
    """
    if not is_heif(path):  # which is an image here
        refuse_foreign(path, "an image")
    try:
        image_size(path)
    except MissingReader:
        raise
    except ValueError:
        return True
    return False


def read_image(path: Path) -> np.ndarray:
    """Decode an image as stored: (H,W) or (H,W,C), its own bit depth, channels in RGB order, EXIF
    rotation ignored.

    Poses and intrinsics belong to the stored pixels, hence no rotation. Of HEIC and AVIF, whose container says how
    they are turned, these are the pixels that are shown, in 8 bits.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not an image that can be decoded, or one whose data end early.
    """
    import cv2

    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be an image, found none; check the path")
    if is_heif(path):
        return read_heif(path)
    if not is_whole(path):
        raise _ends_early(path)
    if stated_size(path):
        width, height = image_size(path)
        what = f"its {width}x{height} pixels"  # 8 bits and 3 channels, decoded and in the order of RGB
        memory.require(f"{path}", 6 * width * height, what, "reduce the image, and w, h, fl_x, ... with it")
    with native_stderr() as complaints:
        try:
            data = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            data = None
    if data is None:
        refuse_foreign(path, "an image")
        raise ValueError(f"{path}: must be an image, could not be decoded; copy or convert it again")
    # The decoder fills with gray what is missing, and goes on.
    for line in complaints:
        if "premature end" in line.lower():
            raise _ends_early(path)
        if "corrupt" in line.lower():
            _log.warning("%s: is damaged, part of it may be wrong (%s); copy it again", path, line.strip())
            break
    if data.ndim == 3:
        order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}.get(data.shape[2])
        if order is None:
            data = data[..., 0]
        else:
            data = np.ascontiguousarray(data[..., order])
    return data


def unit_range(data: np.ndarray, path: Path) -> np.ndarray:
    """Image data as float32 in [0,1], by its bit depth."""
    if data.dtype == np.uint8:
        return data.astype(np.float32) / np.float32(255)
    if data.dtype == np.uint16:
        return data.astype(np.float32) / np.float32(65535)
    if data.dtype.kind == "f":
        # Images of floats may hold light beyond white, which no rendering is compared with.
        return np.clip(data.astype(np.float32), 0.0, 1.0)
    raise ValueError(f"{path}: an image must have 8 or 16 bits or floats a channel, got {data.dtype}; convert it")


def _ends_early(path: Path) -> ValueError:
    return ValueError(f"{path}: must be a whole image, its data end early; it is truncated or damaged, copy it again")


@contextlib.contextmanager
def native_stderr() -> Iterator[list[str]]:
    """Collect the lines that decoders print on stderr, for one message of ours in their place.

    What others print meanwhile, such as a progress line of another thread, is passed on.
    """
    lines: list[str] = []
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed
        yield lines
        return
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            for raw in file.read().splitlines(keepends=True):
                if _DECODER.search(raw):
                    lines.append(raw.decode("utf-8", "replace"))
                else:
                    os.write(2, raw)


# ---------------------------------------------------------------- HEIC and AVIF


class MissingReader(ValueError):
    """The package that reads a photograph is missing: nothing is wrong with the photograph."""


def check_readers(paths: Iterable[Path]) -> None:
    """Raise `MissingReader` if the package that reads one of some photographs is missing; only beginnings are read."""
    for path in paths:
        with contextlib.suppress(OSError):  # whoever decodes it says what is wrong with the file
            if is_heif(path):
                _need_library(path)


def is_heif(path: Path) -> bool:
    """Whether a file begins as HEIC or AVIF, whatever it is called: phones also name them .jpg."""
    with path.open("rb") as file:
        head = file.read(12)
    return head[4:8] == b"ftyp" and head[8:] in _BRANDS


def heif_size(path: Path) -> tuple[int, int]:
    """(width, height) of the photograph as it is shown; no pixel is decoded.

    Raises:
        ValueError: damaged, too large, or pillow-heif is missing.
    """
    _need_library(path)
    width, height = _decoder.call("size", path)
    return width, height


def read_heif(path: Path) -> np.ndarray:
    """(H, W), (H, W, 3) or (H, W, 4) uint8, RGB: the photograph as it is shown. Of 10 bits and more, the highest 8.

    Raises:
        ValueError: damaged, too large, or pillow-heif is missing.
    """
    _need_library(path)
    return _decoder.call("pixels", path)


def heif_as_jpeg(path: Path, quality: int) -> bytes:
    """The photograph as it is shown as JPEG, with its EXIF, for a library that reads nothing else.

    Args:
        path: HEIC or AVIF.
        quality: 1 to 100.
    Raises:
        ValueError: As `read_heif`.
    """
    _need_library(path)
    return _decoder.call("jpeg", path, quality).tobytes()


def _need_library(path: Path) -> None:
    """Raise ValueError without pillow-heif."""
    if importlib.util.find_spec("pillow_heif") is None:
        raise MissingReader(
            f"{path}: HEIC and AVIF photographs need the package pillow-heif, which is missing; "
            "pip install 'drgs[heic]', or convert them to JPEG"
        )


# ---------------------------------------------------------------- headers

_PIXELS_A_BYTE = 8_256  # deflate makes one byte of at most 1,032, each of at most 8 pixels of one bit
_WEBP_SIDE = 1 << 14  # pixels: 14 bits
_PNG = b"\x89PNG\r\n\x1a\n"
# Frame headers are C0..CF, except the tables C4 (Huffman), C8 (reserved) and CC (arithmetic).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_SCAN = (0xDA,)  # start of scan (SOS): pixels follow
_DIRECTORY = 4096  # entries of a TIFF directory that are read; chosen


def stated_size(path: Path) -> tuple[int, int] | None:
    """(width, height) as the header of an image says; None where it says none, or the format is another one."""
    with path.open("rb") as file:
        head = file.read(32)
        for begins, reader in _READERS:
            if head.startswith(begins):
                try:
                    return reader(head, file)
                except struct.error:  # it ends in the middle
                    return None
    return None


def png_has_alpha(path: Path) -> bool:
    """Whether a file is a PNG whose header states an alpha channel (color types 4 and 6)."""
    with path.open("rb") as file:
        head = file.read(26)
    return head.startswith(_PNG) and len(head) == 26 and head[25] in (4, 6)


def can_hold(path: Path, width: int, height: int) -> bool:
    """Whether a file is large enough for so many pixels; a WebP has no such bound, but one of its sides."""
    with path.open("rb") as file:
        if file.read(4) == b"RIFF":
            return max(width, height) <= _WEBP_SIDE
    return width * height <= _PIXELS_A_BYTE * path.stat().st_size


def is_whole(path: Path) -> bool:
    """Whether the chunks of a PNG lie within its file, since OpenCV allocates what they claim, and a JPEG has an end;
    of others, yes. No pixel is decoded.
    """
    with path.open("rb") as file:
        head = file.read(8)
        if head.startswith(b"\xff\xd8"):
            return _has_end(file)
        if head != _PNG:
            return True
        size = path.stat().st_size
        at = 8
        while at + 12 <= size:
            file.seek(at)
            length, kind = struct.unpack(">I4s", file.read(8))
            at += 12 + length
            if kind == b"IEND":
                break
    return at <= size


def _png(head: bytes, file: Any) -> tuple[int, int] | None:
    return struct.unpack(">II", head[16:24]) if head[12:16] == b"IHDR" else None


def _bmp(head: bytes, file: Any) -> tuple[int, int] | None:
    is_old = head[14:15] == b"\x0c"
    width, height = struct.unpack("<HH" if is_old else "<ii", head[18:22] if is_old else head[18:26])
    return width, abs(height)  # rows from the top have a negative one


def _webp(head: bytes, file: Any) -> tuple[int, int] | None:
    if head[12:16] == b"VP8X":  # a canvas
        return 1 + int.from_bytes(head[24:27], "little"), 1 + int.from_bytes(head[27:30], "little")
    if head[12:16] == b"VP8L":
        (bits,) = struct.unpack("<I", head[21:25])
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if head[12:16] == b"VP8 ":
        width, height = struct.unpack("<HH", head[26:30])
        return width & 0x3FFF, height & 0x3FFF
    return None


def _tiff(head: bytes, file: Any) -> tuple[int, int] | None:
    """(width, height) in the first directory of a TIFF, also of a BigTIFF; None where it does not say."""
    order = "<" if head[:2] == b"II" else ">"
    is_big = 43 in head[2:4]
    place, number, length = ("Q", "Q", 20) if is_big else ("I", "H", 12)
    (start,) = struct.unpack_from(f"{order}{place}", head, 8 if is_big else 4)
    if start >= 1 << 63:  # no place in a file
        return None
    file.seek(start)
    (count,) = struct.unpack(f"{order}{number}", file.read(struct.calcsize(number)))
    found: dict[int, int] = {}
    for _ in range(min(count, _DIRECTORY)):
        entry = file.read(length)
        tag, kind = struct.unpack(f"{order}HH", entry[:4])
        if tag in (256, 257):
            layout = {3: "H", 16: "Q"}.get(kind, "I")
            found.setdefault(tag, *struct.unpack_from(f"{order}{layout}", entry, 12 if is_big else 8))  # as libtiff
    return (found[256], found[257]) if len(found) == 2 else None


def _jpeg(head: bytes, file: Any) -> tuple[int, int] | None:
    """(width, height) in the frame header of a JPEG; None if there is none."""
    if _jpeg_segment(file, _JPEG_FRAMES) is None:
        return None
    height, width = struct.unpack(">HH", file.read(5)[1:5])
    return (width, height) if width and height else None


def _has_end(file: Any) -> bool:
    """Whether the marker of the end follows the first scan of a JPEG; also where there is no scan."""
    try:
        start = _jpeg_segment(file, _JPEG_SCAN)
    except struct.error:
        return True
    if start is None:
        return True
    # From the end, where it is, or before what phones append; the data of a scan have 00 or a restart marker after FF.
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return data.rfind(b"\xff\xd9") >= start


def _jpeg_segment(file: Any, kinds: Collection[int]) -> int | None:
    """Place behind the marker and the length of the first segment of one of some kinds, where the file is then; None if
    there is none.
    """
    file.seek(2)
    while True:
        marker = file.read(2)
        if len(marker) < 2 or marker[0] != 0xFF:
            return None
        if marker[1] == 0xFF:  # fill byte: the second byte may start the marker
            file.seek(-1, 1)
            continue
        (length,) = struct.unpack(">H", file.read(2))
        if marker[1] in kinds:
            return file.tell()
        file.seek(length - 2, 1)


_READERS: tuple[tuple[bytes, Callable[[bytes, Any], tuple[int, int] | None]], ...] = (
    (_PNG, _png),
    (b"\xff\xd8", _jpeg),
    (b"BM", _bmp),
    (b"RIFF", _webp),
    (b"II*\0", _tiff),
    (b"MM\0*", _tiff),
    (b"II+\0", _tiff),
    (b"MM\0+", _tiff),
)
