"""How large an image is by its header, before anything of that size is allocated: PNG, JPEG, TIFF, BMP and WebP."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

__all__ = ["can_hold", "is_whole", "png_has_alpha", "stated_size"]

_PIXELS_A_BYTE = 8_256  # deflate makes one byte of at most 1,032, each of at most 8 pixels of one bit
_WEBP_SIDE = 1 << 14  # pixels: 14 bits
_PNG = b"\x89PNG\r\n\x1a\n"
# Frame headers are C0..CF, except the tables C4 (Huffman), C8 (reserved) and CC (arithmetic).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_SCAN = (0xDA,)
_DIRECTORY = 4096  # entries of a TIFF that are looked at


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
