"""Files of Gaussians as other programs write them, byte by byte from their layouts; nothing here is drgs's own code.

Every function takes the bytes that a file holds and returns the file. What they mean is said in the tests.
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile

import numpy as np


def spz_body(positions, alphas, colors, scales, rotations, sh) -> bytes:
    """Arrays of an SPZ: (N, 3) whole numbers of 24 bits, then bytes as they are."""
    fixed = b"".join(int(v & 0xFFFFFF).to_bytes(3, "little") for v in np.asarray(positions).reshape(-1).tolist())
    parts = (alphas, colors, scales, rotations, sh)
    return fixed + b"".join(x if isinstance(x, bytes) else np.ascontiguousarray(x).tobytes() for x in parts)


def spz_file(version: int, degree: int, body: bytes, count: int, bits: int = 12, flags: int = 0, packed=True) -> bytes:
    """Versions 1 to 3."""
    data = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0) + body
    return gzip.compress(data, mtime=0) if packed else data


def spz_file_4(
    degree: int, parts: list[bytes], count: int, bits: int = 12, extensions: bytes = b"", flags: int = 0
) -> bytes:
    """Version 4: a Zstandard frame for each array."""
    import zstandard

    frames = [zstandard.ZstdCompressor().compress(part) for part in parts]
    flags |= 2 if extensions else 0
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, bits, flags, len(parts), 32 + len(extensions))
    table = b"".join(struct.pack("<QQ", len(f), len(p)) for f, p in zip(frames, parts, strict=True))
    return head + extensions + table + b"".join(frames)


def splat_file(means, scales, rgba, quats) -> bytes:
    """32 bytes a Gaussian."""
    rows = zip(means, scales, rgba, quats, strict=True)
    return b"".join(struct.pack("<3f3f4B4B", *m, *s, *c, *q) for m, s, c, q in rows)


def ksplat_file(level: int, degree: int, sections: list[dict], span=(-1.5, 1.5), count: int | None = None) -> bytes:
    """Sections of {means, scales, quats, rgba, sh, centers, full, capacity, partial, block}; 16-bit means where level
    > 0; sh as stored.
    """
    total = sum(len(s["means"]) for s in sections) if count is None else count
    head = bytearray(4096)
    struct.pack_into("<BB", head, 0, 0, 1)
    struct.pack_into("<IIIIH", head, 4, len(sections), len(sections), total, total, level)
    struct.pack_into("<ff", head, 36, *span)
    headers, data = b"", b""
    mean, real, harmonic = ("<f4", "<f4", "<f4") if level == 0 else ("<u2", "<f2", "<f2" if level == 1 else "u1")
    for s in sections:
        n, centers, partial = len(s["means"]), s.get("centers", []), s.get("partial", [])
        header = bytearray(1024)
        struct.pack_into("<IIIIfH", header, 0, n, n, s.get("capacity", 0), len(centers), s.get("block", 5.0), 12)
        struct.pack_into("<I", header, 24, 32767 if level else 1)
        struct.pack_into("<IIH", header, 32, s.get("full", 0), len(partial), degree)
        headers += bytes(header)
        data += np.asarray(partial, "<u4").tobytes() + np.asarray(centers, "<f4").tobytes()
        for i in range(n):
            data += np.asarray(s["means"][i], mean).tobytes() + np.asarray(s["scales"][i], real).tobytes()
            data += np.asarray(s["quats"][i], real).tobytes() + bytes(int(x) for x in s["rgba"][i])
            data += np.asarray(s["sh"][i], harmonic).tobytes()
    return bytes(head) + headers + data


def packed_ply_file(chunks: np.ndarray, vertices: np.ndarray, sh: np.ndarray | None = None, colors=True) -> bytes:
    """SuperSplat's compressed PLY: (C, 18 or 12) float ranges, (N, 4) uint32, (N, 9, 24 or 45) bytes."""
    names = [f"{end}_{x}" for end in ("min", "max") for x in "xyz"]
    names += [f"{end}_scale_{x}" for end in ("min", "max") for x in "xyz"]
    names += [f"{end}_{x}" for end in ("min", "max") for x in "rgb"] if colors else []
    lines = ["ply", "format binary_little_endian 1.0", "comment made by a test", f"element chunk {len(chunks)}"]
    lines += [f"property float {name}" for name in names] + [f"element vertex {len(vertices)}"]
    lines += [f"property uint packed_{x}" for x in ("position", "rotation", "scale", "color")]
    if sh is not None:
        lines += [f"element sh {len(sh)}"] + [f"property uchar f_rest_{i}" for i in range(sh.shape[1])]
    body = chunks.astype("<f4").tobytes() + vertices.astype("<u4").tobytes()
    return ("\n".join(lines) + "\nend_header\n").encode() + body + (b"" if sh is None else sh.astype("u1").tobytes())


def webp(pixels: np.ndarray, lossless: bool = True) -> bytes:
    """An image that keeps RGB also where alpha is 0."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", lossless=lossless, exact=True)
    return file.getvalue()


def texture(values: np.ndarray, width: int = 8) -> bytes:
    """A WebP image of (N, C) bytes, row by row, padded with zeros; alpha 255 where C is less than 4."""
    height = -(-len(values) // width)
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return webp(pixels.reshape(height, width, 4))


def sog_files(meta: dict, images: dict[str, bytes]) -> dict[str, bytes]:
    """Names and contents of a scene."""
    return {"meta.json": json.dumps(meta).encode(), **images}


def zipped(files: dict[str, bytes], prefix: str = "", method: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of them."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(prefix + name, content)
    return data.getvalue()


def glb_file(document: dict, buffer: bytes) -> bytes:
    """A binary glTF."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    buffer += bytes(-len(buffer) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(buffer))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
