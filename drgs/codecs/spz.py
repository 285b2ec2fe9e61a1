"""SPZ, Niantic's format: about 64 bytes a Gaussian of SH degree 3 before its general compression. Versions 2, 3 and 4.

Decoded here, by NumPy, zlib and (version 4) zstandard: `spz` on PyPI has no wheel for Python 3.11, and `gsply` brings
numba. The layout is that of nianticlabs/spz (README.md, src/cc/load-spz.cc at 031fd04; version 4: extensions/README.md
at 144d251 and its files).

    version 2, 3   one gzip stream: a header of 16 bytes, then positions, alphas, colors, scales, rotations and SH
    version 4      a header of 32 bytes, extensions, sizes of the streams, then the same as Zstandard frames

Positions are 24-bit fixed point, log scales steps of 1/16 from -10, alphas and colors bytes; a color is 0.5 + 0.15 c of
its SH coefficient c. Rotations of version 2 are x, y and z in bytes; later, the three smaller components in 10 bits.
SH are (byte - 128) / 128.

The offset that positions are relative to is in the comment of gzip's header (RFC 1952, FCOMMENT), which what unpacks
gzip skips: `offset X Y Z`, in the axes of the file.

Axes: SPZ states right, up, back; PLY files of 3DGS have right, down, front. Between the two, y and z turn their signs,
and with them those of quaternions and SH (Niantic's converter does the same). Files exist whose writer left that out:
`as_stored` keeps what they hold.
"""

from __future__ import annotations

import logging
import math
import struct
import zlib
from pathlib import Path

import numpy as np

from drgs.cameras.origins import origin_of_text
from drgs.codecs.bounded import GzipReader, gzip_comment, gzipped, unzstd
from drgs.codecs.codec import Codec
from drgs.codecs.ply import note_antialiased
from drgs.codecs.ply_headers import offset_line
from drgs.codecs.values import SH_COUNTS, assembled, check_count, flipped, logits_of_bytes, quats_of_smallest, spread
from drgs.ellipsoids import Gaussians

_AXES = (1, -1, -1)  # signs of x, y and z between SPZ and PLY
_COLOR_SCALE = 0.15  # the format holds the DC coefficient times 0.15
_ANTIALIASED, _EXTENDED = 1, 2  # flags
_HARMLESS = {0xADBE0002}  # extensions that change no value: limits of an orbit
_POSITION_BITS = 12  # of a position behind the point, as Niantic's writer has it; readers exist that take no more
_MOST_BITS = 23
# Steps of positions, in the size of a scene, which is hundreds of pixels wide: above the first, a pixel, there are more
# bits, above the second it is refused.
_COARSE_STEP, _COARSEST_STEP = 1e-3, 1e-2
_LEAST_LOG_SCALE, _LOG_SCALES = -10.0, 16.0  # logarithm that byte 0 stands for, bytes a unit of it
_QUAT_SCALE = 511 * 2**0.5  # a component of at most sqrt(1/2), in 9 bits
_STEP_TOLERANCE = 1e-4  # of a step: what float32 rounds off at most, some times over
_log = logging.getLogger(__name__)
_DAMAGED = "it is truncated or damaged, copy it again"


def load_spz(path: Path, as_stored: bool = False) -> Gaussians:
    """Gaussians of an SPZ file.

    Args:
        path: The file; versions 2 and 3 may be packed with gzip or not.
        as_stored: Keep the file's own axes, in place of those of PLY files.
    Raises:
        ValueError: If it is damaged, of another version, or has extensions that may change what values mean.
    """
    data = path.read_bytes()
    if data[:4] == b"NGSP" and data[4:8] == struct.pack("<I", 4):
        count, degree, bits, parts = _streams(path, data)
        version = 4
    else:
        version, count, degree, bits, parts = _sequence(path, data)
    positions, alphas, colors, scales, rotations, sh = parts
    if degree > 3:
        _log.warning("%s: left out the SH coefficients of degree 4, there is no such color here", path)
    bytes_of = {name: np.frombuffer(x, np.uint8) for name, x in (("p", positions), ("c", colors), ("s", scales))}
    # Three bytes, the lowest first, of a whole number with a sign.
    fixed = bytes_of["p"].reshape(count, 3, 3).astype(np.int32)
    fixed = fixed[..., 0] | fixed[..., 1] << 8 | fixed[..., 2] << 16
    means = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / 2.0**bits
    dc = (bytes_of["c"].reshape(count, 1, 3) / 255.0 - 0.5) / _COLOR_SCALE
    stored = np.frombuffer(sh, np.uint8).reshape(count, (degree + 1) ** 2 - 1, 3)
    higher = (stored[:, : SH_COUNTS[min(degree, 3)] - 1].astype(np.float32) - 128) / 128
    quats = _first_three(rotations) if version == 2 else _smallest_three(rotations)
    made = assembled(
        path,
        means,
        quats,
        bytes_of["s"].reshape(count, 3) / _LOG_SCALES + _LEAST_LOG_SCALE,
        logits_of_bytes(np.frombuffer(alphas, np.uint8)),
        np.concatenate([dc.astype(np.float32), higher], axis=1),
    )
    word, _, text = gzip_comment(data).partition(" ")
    if word == "offset":
        made = made.replace(origin=origin_of_text(f"{path}: offset", text))
    return made if as_stored else flipped(made, _AXES)


def _sizes(path: Path, version: int, count: int, degree: int, bits: int) -> list[int]:
    """Bytes of positions, alphas, colors, scales, rotations and SH."""
    if degree > 4 or bits > 23:
        raise ValueError(
            f"{path}: an SPZ file must have SH of degree 0 to 4 and up to 23 fractional bits, got {degree} and {bits}; "
            f"{_DAMAGED}"
        )
    each = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * ((degree + 1) ** 2 - 1))
    return [count * x for x in each]


def _check_version(path: Path, magic: bytes, version: int) -> None:
    if magic != b"NGSP":
        raise ValueError(f"{path}: must be an SPZ file, got {magic!r}; {_DAMAGED}")
    if version not in (2, 3):
        raise ValueError(
            f"{path}: SPZ must be of version 2, 3 or 4, got {version}; "
            "export it again, e.g. as a PLY with SuperSplat (superspl.at/editor)"
        )


def _sequence(path: Path, data: bytes) -> tuple[int, int, int, int, list[bytes]]:
    """Version, count, SH degree, fractional bits and arrays of version 2 or 3."""
    packed = data[:2] == b"\x1f\x8b"
    reader = GzipReader(path, data)
    head = reader.read(16) if packed else data[:16]
    if len(head) < 16:
        raise ValueError(f"{path}: an SPZ file must have a header of 16 bytes, got {len(head)}; {_DAMAGED}")
    magic, version, count, degree, bits, flags, _ = struct.unpack("<4sIIBBBB", head)
    _check_version(path, magic, version)
    sizes = _sizes(path, version, count, degree, bits)
    total = sum(sizes)
    # DEFLATE packs at most 1032 to 1 (zlib's documentation, "Maximum Compression Factor").
    if total > (1032 * len(data) if packed else len(data) - 16):
        raise ValueError(f"{path}: the header claims {count} Gaussians, the file holds {len(data)} bytes; {_DAMAGED}")
    check_count(path, count, SH_COUNTS[min(degree, 3)])
    body = reader.read(total) if packed else data[16 : 16 + total]
    extended = bool(flags & _EXTENDED)
    rest = reader.rest(1 << 16 if extended else 0) if packed else data[16 + total :]
    if extended:
        _check_extensions(path, rest)
    elif rest:
        raise ValueError(f"{path}: must end where its header says, holds {len(rest)} bytes more; export it again")
    if flags & _ANTIALIASED:
        note_antialiased(path)
    ends = np.cumsum([0, *sizes]).tolist()
    return version, count, degree, bits, [body[a:b] for a, b in zip(ends, ends[1:], strict=False)]


def _streams(path: Path, data: bytes) -> tuple[int, int, int, list[bytes]]:
    """Count, SH degree, fractional bits and arrays of version 4."""
    if len(data) < 32:
        raise ValueError(f"{path}: SPZ version 4 must have a header of 32 bytes, got {len(data)}; {_DAMAGED}")
    count, degree, bits, flags, number, table = struct.unpack_from("<IBBBBI", data, 8)
    sizes = _sizes(path, 4, count, degree, bits)
    wanted = 5 if degree == 0 else 6
    at = table + 16 * number
    if number != wanted or table < 32 or at > len(data):
        raise ValueError(f"{path}: must have {wanted} streams and a table of their sizes, got {number}; {_DAMAGED}")
    if flags & _EXTENDED:
        _check_extensions(path, data[32:table])
    spans = []
    for i, size in enumerate(sizes[:wanted]):
        packed, unpacked = struct.unpack_from("<QQ", data, table + 16 * i)
        # Blocks of Zstandard hold at most 128 KiB, and take at least 4 bytes.
        if unpacked != size or packed > len(data) - at or size > (1 << 15) * packed:
            raise ValueError(
                f"{path}: stream {i} must be of {size} bytes for {count} Gaussians and within the file, "
                f"claims {unpacked} (packed {packed}); {_DAMAGED}"
            )
        spans.append((at, at + packed, size))
        at += packed
    check_count(path, count, SH_COUNTS[min(degree, 3)])
    parts = [unzstd(path, data[begin:end], size) for begin, end, size in spans]
    if flags & _ANTIALIASED:
        note_antialiased(path)
    return count, degree, bits, [*parts, b""][:6]


def _check_extensions(path: Path, data: bytes) -> None:
    """Raise ValueError unless all records (type, length, content) are known to change no value."""
    at = 0
    while at + 8 <= len(data):
        kind, length = struct.unpack_from("<II", data, at)
        if kind not in _HARMLESS:
            raise ValueError(
                f"{path}: has the SPZ extension {kind:#010x}, which may change what values mean; export it without"
            )
        at += 8 + length
    if at != len(data):
        raise ValueError(f"{path}: SPZ extensions must be whole records, are not; {_DAMAGED}")


def _first_three(data: bytes) -> np.ndarray:
    """(N, 4) wxyz of bytes x, y, z; w >= 0 makes the length 1."""
    xyz = np.frombuffer(data, np.uint8).reshape(-1, 3) / 127.5 - 1.0
    return quats_of_smallest(np.zeros(len(xyz), int), xyz)


def _smallest_three(data: bytes) -> np.ndarray:
    """(N, 4) wxyz of 2 bits for the largest of x, y, z, w, and sign and 9 bits for each of the others."""
    packed = np.frombuffer(data, "<u4")
    others = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
    values = (others & 511) / _QUAT_SCALE * np.where(others & 512, -1, 1)
    return quats_of_smallest((packed >> 30).astype(int), values)[:, [3, 0, 1, 2]]


def encode_spz(g: Gaussians) -> bytes:
    """An SPZ file of version 3 of Gaussians in the axes of PLY files; their features are left out.

    Twelve bits behind the point, more for a scene that is small, as in kilometres, or as many as the farthest mean
    leaves; SH in all 8 bits, not in the 5 and 4 that Niantic's writer keeps. What is out of the format's range goes to
    its end, and the log says how much that is.

    Raises:
        ValueError: If a mean is farther than 2^23 from 0, or steps of positions are more than a hundredth of the size
            of the scene, or half of the Gaussians are smaller or larger than the format knows.
    """
    g = flipped(g, _AXES)
    means = g.means.numpy().astype(np.float64)
    _check_scales(g)
    bits = _position_bits(g)
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    positions = np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 3, 4)[..., :3]
    clipped: dict[str, int] = {}
    # float64: a logit that was read from a byte must go back to that byte.
    opacities = 255 * g.logit_opacities.double().sigmoid().numpy()
    sh = g.sh.numpy()
    parts = (
        positions,
        _bytes("", opacities, clipped),
        _bytes("colors", (sh[:, 0] * _COLOR_SCALE + 0.5) * 255, clipped),
        _bytes("log scales", (g.log_scales.numpy().astype(np.float64) - _LEAST_LOG_SCALE) * _LOG_SCALES, clipped),
        _packed_quats(g.quats.numpy().astype(np.float64)),
        _bytes("SH coefficients", sh[:, 1:] * 128 + 128, clipped),
    )
    for name, count in clipped.items():
        _log.warning("SPZ: %d %s were out of its range and went to its end", count, name)
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, len(g), g.sh_degree, bits, 0, 0)
    body = header + b"".join(np.ascontiguousarray(x).tobytes() for x in parts)
    return gzipped(body, offset_line(g.origin) if g.origin.any() else "")


def _position_bits(g: Gaussians) -> int:
    """Bits of a position behind the point; errors as of `encode_spz`."""
    far = float(g.means.abs().max()) if len(g) else 0.0
    size = spread(g)[1] if len(g) else 1.0
    wanted = _POSITION_BITS
    if 2.0**-wanted > _COARSE_STEP * size:  # as fine as 12 bits of a scene of size 1
        wanted = min(_POSITION_BITS + math.ceil(-math.log2(size)), _MOST_BITS)
    bits = next((b for b in range(wanted, -1, -1) if round(far * 2**b) < 1 << 23), None)
    if bits is None:
        raise ValueError(f"save_gaussians: SPZ holds means up to 2^23 from 0, got {far:g}; scale them or write a PLY")
    if 2.0**-bits > _COARSEST_STEP * size:
        raise ValueError(
            f"save_gaussians: SPZ must hold positions in steps of a hundredth of a scene at most, got {2.0**-bits:.2g} "
            f"for one of size {size:.2g} that reaches to {far:.2g}; write a .ply or .sog, or scale the scene"
        )
    if bits > _POSITION_BITS:
        _log.info("SPZ: %d bits behind the point, 12 are too few for a scene of size %.2g", bits, size)
    return bits


def _check_scales(g: Gaussians) -> None:
    """Raise ValueError if half of the Gaussians, by their largest standard deviation, are out of the format's range."""
    low, high = _LEAST_LOG_SCALE, _LEAST_LOG_SCALE + 255 / _LOG_SCALES
    middle = float(g.log_scales.amax(1).median()) if len(g) else low
    if not low <= middle <= high:
        raise ValueError(
            f"save_gaussians: SPZ must have standard deviations of {np.exp(low):.2g} to {np.exp(high):.2g} units, "
            f"got {np.exp(middle):.2g} (median); write a .ply or .sog, or scale the scene"
        )


def _bytes(name: str, values: np.ndarray, clipped: dict[str, int]) -> np.ndarray:
    """The nearest bytes; what is more than half a step out of range is counted."""
    rounded = np.rint(values)
    outside = int(((rounded < 0) | (rounded > 255)).sum())
    if outside:
        clipped[name] = outside
    return np.clip(rounded, 0, 255).astype(np.uint8)


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """(N,) uint32 that `_smallest_three` reads; rotations that came from such a file get the bits that they had.

    Two components that are about as large as each other may change places by rounding. What was stored are whole steps.
    """
    q = quats / np.abs(quats).max(axis=1, keepdims=True, initial=0.0)  # first, so that no square under- or overflows
    q = (q / np.linalg.norm(q, axis=1, keepdims=True))[:, [1, 2, 3, 0]]
    steps = np.abs(q) * _QUAT_SCALE
    largest = steps.argmax(1)
    uneven = np.abs(steps - np.rint(steps))
    for i in range(4):
        is_stored = np.delete(uneven, i, axis=1).max(1) < _STEP_TOLERANCE
        largest = np.where(is_stored & (steps[:, i] > steps.max(1) - 2), i, largest)
    q *= np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -1, 1)
    others = q[np.arange(4)[None, :] != largest[:, None]].reshape(-1, 3)
    # Where the component left out is second by a step, the largest is above sqrt(1/2), and 9 bits end at 511.
    magnitude = np.minimum(np.floor(np.abs(others) * _QUAT_SCALE + 0.5), 511).astype(np.uint32)
    codes = magnitude | np.where(np.signbit(others), 512, 0).astype(np.uint32)
    shifted = largest.astype(np.uint32) << 30 | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]
    return shifted.astype("<u4")


def _is_spz(path: Path, head: bytes) -> bool:
    """Whether it begins with the mark of SPZ, packed with gzip or not."""
    if not head.startswith(b"\x1f\x8b"):
        return head.startswith(b"NGSP")
    try:
        return zlib.decompressobj(wbits=31).decompress(head, 16).startswith(b"NGSP")
    except zlib.error:
        return False


SPZ = Codec(
    ".spz",
    load_spz,
    _is_spz,
    load_as_stored=lambda path: load_spz(path, as_stored=True),
    encode=encode_spz,
    keeps_origin=True,
)
