"""Sums by Gaussian: floats that stand side by side in a buffer, added to in packets.

All that a hit adds to its Gaussian, the gradient of a record or squares of derivatives, is one row of a buffer. On the
CPU every thread has a copy of it, which need not be added to atomically, and 16 floats of a row are added at once: a
third of the time of one atomic addition a float, after a sum over the lanes that meet the same Gaussian.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr

from drgs.tracing.arrays import Float, Lib, Mask, UInt32

_PACKET_FLOATS = 16  # floats that are added at once, at most
_SINGLY_UP_TO = 2  # floats of a packet up to which adding them one by one is faster
_MAX_COPY_BYTES = 256 << 20  # bytes that the copies of a buffer, one a thread, may take; chosen


def add_row(
    lib: Lib,
    buffer: Float,
    values: Sequence[Float | None],
    row: UInt32,
    stride: int,
    first: int,
    active: Mask,
    mode: dr.ReduceMode,
) -> None:
    """Add `values` to `buffer[row * stride + first + k]`; None is 0.

    Args:
        stride: Floats of a row.
        first: Place of the first value in its row.
        mode: How floats are added up where there are no copies: on a device, and where they are too large.
    """
    if not _has_copies(buffer):
        width = 1
    else:
        width = math.gcd(stride, first, _PACKET_FLOATS)
        mode = dr.ReduceMode.Expand
    for k in range(0, len(values), width):
        packet = values[k : k + width]
        used = [j for j, x in enumerate(packet) if x is not None]
        if len(used) <= _SINGLY_UP_TO or width == 1:
            for j in used:
                dr.scatter_add(buffer, packet[j], row * stride + (first + k + j), active, mode=mode)
            continue
        full = [lib.Float(0) if x is None else x for x in packet]
        full += [lib.Float(0)] * (width - len(full))
        at = row * (stride // width) + (first + k) // width
        dr.scatter_add(buffer, lib.ArrayXf(full), at, active, mode=mode)


def _has_copies(buffer: Float) -> bool:
    """Whether every thread may have a copy of a buffer."""
    return dr.backend_v(buffer) == dr.JitBackend.LLVM and 4 * dr.width(buffer) * dr.thread_count() <= _MAX_COPY_BYTES
