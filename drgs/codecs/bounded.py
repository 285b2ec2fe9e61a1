"""Decompression that stops at the size that a header states: no claimed size is allocated unchecked."""

from __future__ import annotations

import io
import lzma
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np

from drgs.checks.arguments import said
from drgs.io.foreign import is_file

_DAMAGED = "it is truncated or damaged, copy it again"
# characters of names, and of what libraries say
_NAME = 200
_PIECE = 1 << 20  # bytes of a stream that are unpacked at once
_ZIP_ERRORS = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, NotImplementedError, OSError, OverflowError,
    RuntimeError, ValueError,
)  # fmt: skip


_FEXTRA, _FNAME, _FCOMMENT = 4, 8, 16  # flags of gzip's header (RFC 1952)


def gzipped(data: bytes, comment: str = "") -> bytes:
    """A gzip stream without a time: same data, same bytes; with a comment in its header, in ASCII."""
    packer = zlib.compressobj(6, zlib.DEFLATED, 31)
    stream = packer.compress(data) + packer.flush()
    if not comment:
        return stream
    return stream[:3] + bytes([stream[3] | _FCOMMENT]) + stream[4:10] + comment.encode("ascii") + b"\0" + stream[10:]


def gzip_comment(data: bytes) -> str:
    """The comment in the header of a gzip stream; empty where there is none, or data are no such stream."""
    if data[:3] != b"\x1f\x8b\x08" or len(data) < 10 or not data[3] & _FCOMMENT:
        return ""
    flags, at = data[3], 10
    if flags & _FEXTRA:
        at += 2 + int.from_bytes(data[at : at + 2], "little")
    if flags & _FNAME:
        at = data.find(b"\0", at) + 1
    return data[at : max(at, data.find(b"\0", at))].decode("latin-1")


class GzipReader:
    """A gzip stream that is read piece by piece."""

    def __init__(self, path: Path, data: bytes):
        self._path = path
        self._rest = data
        self._stream = zlib.decompressobj(wbits=31)

    def read(self, count: int) -> bytes:
        """Exactly so many bytes.

        Raises:
            ValueError: If the stream is damaged or ends before.
        """
        if count == 0:
            return b""
        try:
            out = self._stream.decompress(self._rest, count)
        except zlib.error as error:
            raise ValueError(f"{self._path}: must be a gzip stream, got {error}; {_DAMAGED}") from None
        self._rest = self._stream.unconsumed_tail
        if len(out) < count:
            raise ValueError(f"{self._path}: must unpack to {count} more bytes, got {len(out)}; {_DAMAGED}")
        return out

    def rest(self, limit: int) -> bytes:
        """The remaining bytes, at most so many.

        Raises:
            ValueError: If there is more, or the stream does not end.
        """
        try:
            out = self._stream.decompress(self._rest, limit + 1)
        except zlib.error as error:
            raise ValueError(f"{self._path}: must be a gzip stream, got {error}; {_DAMAGED}") from None
        if len(out) > limit:
            raise ValueError(f"{self._path}: must end where its header says, unpacks to more; export it again")
        if not self._stream.eof:
            raise ValueError(f"{self._path}: must be a whole gzip stream, its end is missing; {_DAMAGED}")
        return out


def unzstd(path: Path, frame: bytes, size: int) -> bytes:
    """The content of a Zstandard frame, which must be of exactly `size` bytes.

    Raises:
        ValueError: If it is not, the frame is damaged, or the package `zstandard` is missing.
    """
    try:
        import zstandard
    except ImportError:
        raise ValueError(
            f"{path}: version 4 of SPZ needs the package zstandard, which is missing; pip install 'drgs[spz]'"
        ) from None
    if size == 0:
        return b""
    try:
        # Of the stream, and not of one call: that would allocate what the frame claims, or the requested size.
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(io.BytesIO(frame)) as stream:
            found = bytearray()
            while len(found) <= size and (part := stream.read(min(size + 1 - len(found), _PIECE))):
                found += part
    except zstandard.ZstdError as error:
        text = "a window above 128 MiB" if "too much memory" in str(error) else error
        raise ValueError(f"{path}: must be a Zstandard frame, got {text}; {_DAMAGED}") from None
    out = bytes(found)
    if len(out) != size:
        got = f"{len(out)}" if len(out) < size else "more"
        raise ValueError(f"{path}: a stream must unpack to {size} bytes, got {got}; {_DAMAGED}")
    return out


class Archive:
    """Files that belong together: in a zip archive, or in a folder. Nothing is unpacked to disk.

    Attributes:
        path: The archive or the folder.
    """

    def __init__(self, path: Path):
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        self._prefix = ""
        if path.is_dir():
            return
        try:
            self._zip = zipfile.ZipFile(path)
            found = [name for name in self._zip.namelist() if name.rpartition("/")[2] == "meta.json"]
        except _ZIP_ERRORS as error:
            raise ValueError(f"{path}: must be a zip archive, got {said(error)}; {_DAMAGED}") from None
        if found:
            self._prefix = min(found, key=len).removesuffix("meta.json")

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def read(self, name: str, limit: int) -> bytes:
        """A file, by a name without folders, of at most `limit` bytes.

        Raises:
            ValueError: If the name leads elsewhere, or the file is missing, damaged or longer.
        """
        is_name = name.isprintable() and len(name) < _NAME and name not in ("", ".", "..")
        if not is_name or "/" in name or "\\" in name:
            raise ValueError(f"{self.path}: files must be named without a folder, got {name[:80]!r}; export it again")
        data = self._from_folder(name, limit) if self._zip is None else self._from_zip(name, limit)
        if len(data) > limit:
            raise ValueError(
                f"{self.path}: {name} must be at most {limit} bytes for what meta.json says, is longer; export it again"
            )
        return data

    def _from_folder(self, name: str, limit: int) -> bytes:
        file = self.path / name
        if not is_file(file):
            raise FileNotFoundError(f"{file}: must be beside meta.json, found none; copy the whole folder")
        if file.is_symlink() and file.resolve().parent != self.path.resolve():
            raise ValueError(f"{file}: must not lead out of its folder; copy the file there")
        with file.open("rb") as stream:
            return stream.read(limit + 1)

    def _from_zip(self, name: str, limit: int) -> bytes:
        assert self._zip is not None
        try:
            with self._zip.open(self._prefix + name) as member:
                return member.read(limit + 1)  # of what it unpacks to, whatever the directory claims
        except KeyError:
            raise ValueError(f"{self.path}: must hold {name}, holds none; export it again") from None
        except _ZIP_ERRORS as error:
            raise ValueError(f"{self.path}: {name} must be readable, got {said(error)}; {_DAMAGED}") from None


def pixels_of_webp(where: str, data: bytes, least: int, most: int) -> np.ndarray:
    """(H, W, 4) uint8 RGBA of a lossless WebP image, every byte as it was stored, also where alpha is 0.

    Args:
        where: File and image, for messages.
        data: The file.
        least, most: How many pixels it may have; compared with its header before anything is decoded.
    Raises:
        ValueError: If it is no lossless WebP image or of another size.
    """
    import cv2  # a base dependency; its bytes are those of libwebp (tests/test_codecs.py compares them with Pillow's)

    width, height = _webp_size(where, data)
    if not least <= width * height <= most:
        raise ValueError(
            f"{where}: must have {least} to {most} pixels, has {width}x{height}; it is of another scene, copy it again"
        )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.dtype != np.uint8 or image.shape[:2] != (height, width) or image.ndim != 3:
        raise ValueError(f"{where}: must be a readable WebP image, is none; {_DAMAGED}")
    if image.shape[2] == 3:
        # OpenCV has blue first; an image without alpha is opaque.
        return np.dstack([image[..., ::-1], np.full((height, width), 255, np.uint8)])
    return np.ascontiguousarray(image[..., [2, 1, 0, 3]])


def webp_of_pixels(pixels: np.ndarray) -> bytes:
    """A lossless WebP image of (H, W, 4) uint8 RGBA.

    Colors behind an alpha of 0 are kept where OpenCV can say so (from 4.13 on), else they are forgotten.
    """
    import cv2

    how = [cv2.IMWRITE_WEBP_QUALITY, 101]  # above 100: without loss
    if hasattr(cv2, "IMWRITE_WEBP_LOSSLESS_PRESERVE_COLOR"):
        how = [cv2.IMWRITE_WEBP_LOSSLESS_MODE, cv2.IMWRITE_WEBP_LOSSLESS_PRESERVE_COLOR]
    done, data = cv2.imencode(".webp", np.ascontiguousarray(pixels[..., [2, 1, 0, 3]]), how)
    if not done:
        raise ValueError(f"save_gaussians: a WebP image must be at most 16,383 pixels wide, is {pixels.shape[1]}")
    return data.tobytes()


def _webp_size(where: str, data: bytes) -> tuple[int, int]:
    """Width and height of a lossless WebP image, from its header."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise ValueError(f"{where}: must be a WebP image, got {data[:12]!r}; export it again")
    at = 12
    while at + 13 <= len(data):
        kind = data[at : at + 4]
        length = int.from_bytes(data[at + 4 : at + 8], "little")
        if kind == b"VP8 ":
            raise ValueError(f"{where}: must be a lossless WebP image, is a lossy one; export it again without loss")
        if kind == b"VP8L":
            bits = int.from_bytes(data[at + 9 : at + 13], "little")
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        if kind == b"ANIM":
            break
        at += 8 + length + length % 2
    raise ValueError(f"{where}: must be a lossless WebP image, is none; {_DAMAGED}")
