"""Damage to files of Gaussians beyond what packs them: gzip and Zstandard streams, WebP images and the chunks of a GLB
are unpacked, damaged, and packed again, so that readers come as far as to what is damaged.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from random import Random

from fuzz_mutators import damaged, json_of

__all__ = ["glb_of", "spz_of", "webp_of"]

_HEAD_4 = 32  # bytes of the header of an SPZ of version 4
_MOST = 1 << 18  # of what is unpacked: an input may hold a bomb of an earlier damage
_FIELDS = ((4, "<I"), (8, "<I"), (12, "B"), (13, "B"), (14, "B"), (15, "B"), (16, "<I"))  # of the header of an SPZ


def spz_of(data: bytes, draw: Random) -> bytes:
    """Another header, or other arrays, within the stream or streams that they are packed in."""
    if data[:2] == b"\x1f\x8b":
        body = _gunzipped(data)
        if body is None:
            return damaged(data, draw)
        packed = gzip.compress(_sequence(body, draw), draw.choice((0, 1, 6)), mtime=0)
        what = draw.random()
        if what < 0.05:  # two members, as gzip allows
            return packed + gzip.compress(body[:20], mtime=0)
        return packed[: -draw.choice((1, 4, 8))] if what < 0.1 else packed
    if data[:4] == b"NGSP" and data[4:8] == b"\x04\0\0\0":
        return _frames(data, draw)
    return _sequence(data, draw)


def _sequence(body: bytes, draw: Random) -> bytes:
    """An SPZ that is not packed: another field of its header, or whatever else."""
    if len(body) < 20 or draw.random() < 0.4:
        return damaged(body, draw)
    at, layout = draw.choice(_FIELDS[:-1])
    most = (1 << 8 * struct.calcsize(layout)) - 1
    value = draw.choice((0, 1, 2, 3, 4, 5, 23, 24, 128, 255, 1000, 1 << 24, most, draw.randrange(most)))
    out = bytearray(body)
    struct.pack_into(layout, out, at, min(value, most))
    return bytes(out)


def _frames(data: bytes, draw: Random) -> bytes:
    """Version 4: one stream is another one, with a table that says so, or the table or the header lies."""
    import zstandard

    head = data[:_HEAD_4]
    if len(head) < _HEAD_4:
        return damaged(data, draw)
    number = head[15]
    at = struct.unpack_from("<I", head, 16)[0]
    extensions = data[_HEAD_4:at]
    frames = []
    start = at + 16 * number
    for i in range(number):
        if at + 16 * i + 16 > len(data):
            return damaged(data, draw)
        length, size = struct.unpack_from("<QQ", data, at + 16 * i)
        frames.append((data[start : start + length], size))
        start += length
    what = draw.random()
    if not frames or what < 0.2:
        return _sequence(data, draw)
    i = draw.randrange(len(frames))
    frame, size = frames[i]
    if what < 0.7:
        try:
            body = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(frame)).read(_MOST)
        except zstandard.ZstdError:
            body = frame
        body = damaged(body, draw)
        packer = zstandard.ZstdCompressor(draw.choice((1, 19)), write_content_size=draw.random() < 0.7)
        frames[i] = packer.compress(body), draw.choice((size, len(body)))
    elif what < 0.8:
        frames[i] = damaged(frame, draw), size
    elif what < 0.9:
        frames[i] = frame, draw.choice((0, size + 1, 2 * size, 1 << 31, (1 << 64) - 1))
    else:  # records of an extension, that may be known
        kind = draw.choice((0xADBE0002, 0xADBE0001, draw.randrange(1 << 32)))
        extensions += struct.pack("<II", kind, draw.choice((0, 4, 4, 1 << 31))) + draw.randbytes(4)
        head = head[:14] + bytes([head[14] | 2]) + head[15:]
    head = head[:16] + struct.pack("<I", _HEAD_4 + len(extensions)) + head[20:]
    table = b"".join(struct.pack("<QQ", len(frame), size % 2**64) for frame, size in frames)
    return head + extensions + table + b"".join(frame for frame, _ in frames)


def _gunzipped(data: bytes) -> bytes | None:
    try:
        return zlib.decompressobj(wbits=31).decompress(data, _MOST)
    except zlib.error:
        return None


def webp_of(data: bytes, draw: Random) -> bytes:
    """Another picture: pixels that are damaged, another size or without alpha, packed again, lossy or not."""
    from PIL import Image

    if draw.random() < 0.3:
        return damaged(data, draw)
    try:
        image = Image.open(io.BytesIO(data))
        if image.width * image.height * 4 > _MOST:
            return damaged(data, draw)
        image = image.convert("RGBA")
    except Exception:  # noqa: BLE001 (Pillow raises whatever its decoders do)
        return damaged(data, draw)
    width, height = image.size
    if draw.random() < 0.3:
        width = max(1, width + draw.choice((-1, 1, 64, -width)))
        height = max(1, height + draw.choice((-1, 1, 0, 64)))
    size = 4 * width * height
    pixels = damaged(image.tobytes(), draw)[:size]
    pixels += bytes([draw.choice((0, 255))]) * (size - len(pixels))
    made = Image.frombytes("RGBA", (width, height), pixels)
    if draw.random() < 0.2:
        made = made.convert(draw.choice(("RGB", "L")))
    out = io.BytesIO()
    made.save(out, "WEBP", lossless=draw.random() < 0.95, exact=True, method=0)
    return out.getvalue()


def glb_of(data: bytes, draw: Random) -> bytes:
    """Another document, or another buffer, in chunks of the lengths that are stated."""
    chunks = []
    at = 12
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 8 + size
    if data[:4] != b"glTF" or not chunks:
        return damaged(data, draw)
    i = draw.randrange(len(chunks))
    what = draw.random()
    kind, body = chunks[i]
    if what < 0.85:
        body = json_of(body, draw) if kind == b"JSON" else damaged(body, draw)
        pad = b" " if kind == b"JSON" else b"\0"
        chunks[i] = kind, body + pad * (-len(body) % 4)
    elif what < 0.9:
        del chunks[i]
    elif what < 0.95:
        chunks.append(chunks[i])
    else:
        chunks[i] = draw.choice((b"JSON", b"BIN\0", b"zzzz")), body
    body = b"".join(struct.pack("<I4s", len(body), kind) + body for kind, body in chunks)
    return data[:8] + struct.pack("<I", 12 + len(body)) + body
