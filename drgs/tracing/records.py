"""Records: the floats of a Gaussian in one view that hits read, side by side in one buffer.

`projection.py` and the responses fill them, the loops over hits read them. A record is of the screen (cameras of any
lens, traversal `tiles`) or of the world (any ray, `bvh`).
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr

from drgs.tracing.arrays import Float, Lib, Mask, UInt32

# Layout of a screen record (floats). ALPHA holds the opacity, or what stands for it in the response (its `strength`).
RECORD = 24
AX, AY, R11, R12, R13, R21, R22, R23, E2, E3, E4, E5, E6, H1, H2, H3, NORM, ALPHA, EXT2, RGB = range(20)
SIDE = 22  # of the cube, under a wide lens (lens_rays.py)
# A world record: mean (3), R^T by rows (9), `Activated.inverse` and `cofactor` (3 each), which make W and its cofactor
# matrix of it, opacity, extent^2, rgb (3), and `Activated.norm`.
W_MEAN = 0
W_ROWS = 3
W_INVERSE = 12
W_COFACTOR = 15
W_ALPHA = 18
W_EXT2 = 19
W_RGB = 20
W_NORM = 23


def dot(a: Sequence[Float], b: Sequence[Float]) -> Float:
    """Dot product of two lists of three."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence[Float], b: Sequence[Float]) -> list[Float]:
    """Cross product of two lists of three."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def count_of(record: list[Float]) -> int:
    """Number of Gaussians of a list of records (constants have width 1)."""
    return max(dr.width(x) for x in record)


def pack_records(lib: Lib, record: list[Float]) -> Float:
    """Interleave the entries of records, (N,) each, into one buffer of stride RECORD."""
    count = count_of(record)
    i = dr.arange(lib.UInt32, count)
    spread = [x if dr.width(x) == count else x + dr.zeros(lib.Float, count) for x in record]
    spread += [dr.zeros(lib.Float, count)] * (RECORD - len(record))
    buffer = dr.zeros(lib.Float, count * RECORD)
    dr.scatter(buffer, lib.ArrayXf(spread), i)
    return buffer


def load_record(lib: Lib, buffer: Float, index: UInt32, active: Mask) -> list[Float]:
    """The record of a Gaussian."""
    return list(dr.gather(lib.ArrayXf, buffer, index, active, shape=(RECORD, dr.width(index))))


def packed_size(count: int) -> int:
    """Floats a Gaussian in a packed buffer of `count`: whole packets of 16."""
    return -(-count // 16) * 16


def pack(lib: Lib, columns: list[Float], count: int) -> Float:
    """Interleave per-Gaussian floats: `packed_size(len(columns))` of each of `count` Gaussians together."""
    size = packed_size(len(columns))
    i = dr.arange(lib.UInt32, count)
    zero = dr.zeros(lib.Float, count)
    buffer = dr.zeros(lib.Float, count * size)
    columns = [x + zero for x in columns] + [zero] * (size - len(columns))
    for k in range(0, size, 16):
        dr.scatter(buffer, lib.ArrayXf(columns[k : k + 16]), i * (size // 16) + k // 16)
    return buffer


def load_packed(lib: Lib, buffer: Float, size: int, index: UInt32, active: Mask) -> list[Float]:
    """The `size` floats of a Gaussian from a buffer of `pack`."""
    values = []
    for k in range(size // 16):
        values += list(dr.gather(lib.ArrayXf, buffer, index * (size // 16) + k, active, shape=(16, dr.width(index))))
    return values
