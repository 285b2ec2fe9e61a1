"""Damage to files by what their formats are made of: PLY, safetensors, NumPy, zip archives and PNG keep their lengths
and check sums, so that readers come as far as to what is damaged.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Sequence
from random import Random

from fuzz_mutators import WORDS, damaged, json_lines, json_of, lines_of, text_of
from fuzz_packed import glb_of, spz_of, webp_of

__all__ = ["mutate"]

_LARGEST = 1 << 20  # bytes of an input
_PLY_KINDS = (b"char", b"uchar", b"short", b"uint", b"int", b"float", b"double", b"float32", b"int8", b"half")


def mutate(data: bytes, suffix: str, draw: Random, others: Sequence[bytes] = ()) -> bytes:
    """A damaged copy of a file.

    Args:
        data: Bytes of the file.
        suffix: Suffix of its name, which says what it is made of.
        draw: Generator that decides.
        others: Other files of this kind, to be spliced with.
    """
    damage = _STRUCTURED.get(suffix)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        if damage is not None and draw.random() < 0.6:
            data = damage(data, draw)
        else:
            data = damaged(data, draw, others)
    return data[:_LARGEST]


def _ply(data: bytes, draw: Random) -> bytes:
    """Another header before the same rows, or other rows behind the same header."""
    head, end, body = data.partition(b"end_header\n")
    lines = head.split(b"\n")[:-1]
    if not end or len(lines) < 2 or draw.random() < 0.3:
        return head + end + damaged(body, draw)
    i = draw.randrange(len(lines))
    words = lines[i].split()
    what = draw.randrange(5)
    if what == 0 and words[:1] == [b"element"]:
        words[-1] = draw.choice((*WORDS[:12], b"%d" % draw.randrange(100)))
        lines[i] = b" ".join(words)
    elif what <= 1 and words[:1] == [b"property"]:
        kind = draw.choice(_PLY_KINDS)
        kept = words[-1] if draw.random() < 0.7 else draw.choice((b"x", b"red", b"", b"f_rest_44", b"semantic_0"))
        lines[i] = draw.choice((b"property " + kind, b"property list uchar " + kind)) + b" " + kept
    elif what == 2:
        kinds = (b"ascii", b"binary_little_endian", b"binary_big_endian", b"text", b"")
        lines[1] = b"format " + draw.choice(kinds) + draw.choice((b" 1.0", b" 2.0", b""))
    elif what == 3:
        row = (b"element vertex 3", b"element face 2", b"property list int int x", b"comment a", b"obj_info", b"junk")
        lines.insert(i, draw.choice(row))
    else:
        lines = lines_of(b"\n".join(lines), draw).split(b"\n")
    return b"\n".join(lines) + b"\n" + end + body


def _safetensors(data: bytes, draw: Random) -> bytes:
    """Another header of JSON, of the length that is stated."""
    size = int.from_bytes(data[:8], "little")
    if not 0 < size <= len(data) - 8:
        return damaged(data, draw)
    head = data[8 : 8 + size]
    body = data[8 + size :]
    if draw.random() < 0.4:
        return data[: 8 + size] + damaged(body, draw)
    try:
        value = json.loads(head)
        inner = value.get("__metadata__", {}).get("drgs")
        if inner and draw.random() < 0.7:  # our own header within
            value["__metadata__"]["drgs"] = json_of(inner.encode(), draw).decode("utf-8", "replace")
            head = json.dumps(value).encode()
        else:
            head = json_of(head, draw)
    except (ValueError, AttributeError, TypeError, RecursionError):
        head = text_of(head, draw)
    return len(head).to_bytes(8, "little") + head + body


def _npy(data: bytes, draw: Random) -> bytes:
    """Another header behind the magic of NumPy, of the length that is stated."""
    size = int.from_bytes(data[8:10], "little")
    if draw.random() < 0.4 or len(data) < 10 + size:
        return data[: 10 + size] + damaged(data[10 + size :], draw)
    head = text_of(data[10 : 10 + size], draw)
    if draw.random() < 0.3:
        kinds = (b"<f8", b">f4", b"|O", b"<i8", b"|b1", b"<c16", b"<U4", b"<M8[s]", b"|V8", b"<f2", b"<f16")
        head = re.sub(rb"'[<>|=]?[a-zA-Z]\d+'", b"'" + draw.choice(kinds) + b"'", head)
    return data[:8] + len(head).to_bytes(2, "little") + head + data[10 + size :]


def _zip(data: bytes, draw: Random) -> bytes:
    """An archive in which one part is damaged, renamed, gone, packed, or there twice; its index and check sums hold."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = [(part.filename, archive.read(part)) for part in archive.infolist()]
    except Exception:  # noqa: BLE001 (zipfile raises a dozen kinds of them)
        return damaged(data, draw)
    if not parts:
        return damaged(data, draw)
    i = draw.randrange(len(parts))
    how = zipfile.ZIP_STORED
    name, content = parts[i]
    what = draw.random()
    if what < 0.75:
        inside = _STRUCTURED.get(f".{name.rpartition('.')[2]}", damaged)
        parts[i] = name, inside(content, draw)
    elif what < 0.8:
        parts[i] = draw.choice(("../x", "", "/x", f"{name}x", parts[0][0])), content
    elif what < 0.87:
        del parts[i]
    elif what < 0.93:
        how = draw.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    else:
        parts.append((name, damaged(content, draw)))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", how) as archive:
        for name, content in parts:
            archive.writestr(zipfile.ZipInfo(name or "x"), content, how)
    return out.getvalue()


def _png(data: bytes, draw: Random) -> bytes:
    """Chunks that are damaged, gone, or there twice, with check sums that hold."""
    chunks = []
    at = 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    if not chunks:
        return damaged(data, draw)
    i = draw.randrange(len(chunks))
    what = draw.random()
    kind, body = chunks[i]
    if kind == b"IDAT" and what < 0.4:
        try:
            chunks[i] = kind, zlib.compress(damaged(zlib.decompress(body), draw), draw.choice((0, 6)))
        except zlib.error:
            return damaged(data, draw)
    elif what < 0.7:
        chunks[i] = kind, damaged(body, draw)
    elif what < 0.8:
        del chunks[i]
    elif what < 0.9:
        chunks.insert(i, chunks[draw.randrange(len(chunks))])
    else:
        chunks[i] = draw.choice((b"PLTE", b"tRNS", b"eXIf", b"acTL", b"fcTL", b"iCCP", b"IDAT", b"zzzz")), body
    parts = [len(c[1]).to_bytes(4, "big") + c[0] + c[1] + zlib.crc32(c[0] + c[1]).to_bytes(4, "big") for c in chunks]
    return data[:8] + b"".join(parts)


_STRUCTURED: dict[str, Callable[[bytes, Random], bytes]] = {
    ".json": json_of,
    ".jsonl": json_lines,
    ".txt": text_of,
    ".ply": _ply,
    ".safetensors": _safetensors,
    ".npy": _npy,
    **dict.fromkeys((".npz", ".pt", ".pth", ".sog"), _zip),
    ".png": _png,
    ".webp": webp_of,
    ".spz": spz_of,
    ".glb": glb_of,
}
