"""Which Gaussians a pinhole tile must look at, and the walk of its pixels along that list.

A frame is cut into 8x8-pixel tiles. Every Gaussian is listed in each tile of its screen bounds, where these are large
only in those in which a pixel may be hit; tiles are grouped and ordered by one sort of packed 64-bit keys. `center`
order sorts by (depth of the mean, index); `ray` order by t* at the tile's center, which walk.py makes exact.
"""

from __future__ import annotations

import dataclasses
import math

import drjit as dr

from drgs import runtime
from drgs.guards import memory
from drgs.tracing import projection as layout

__all__ = ["TILE", "Lists", "build", "depth_order"]

TILE = 8
_FAR = 3.0e38
_NOWHERE = 2**64 - 1
_LARGE = 8  # tiles of a box, on average


@dataclasses.dataclass
class Lists:
    """Gaussians by tile.

    Attributes:
        index: (pairs,) Gaussian of each entry; a tile's entries are contiguous and ordered.
        start, end: (tiles,) range of each tile.
        ahead: (pairs,) `ray` order only: no hit of this entry or a later one of its tile has a smaller key.
        columns, rows: Tiles in x and y.
        pairs: Number of entries.
    """

    index: object
    start: object
    end: object
    ahead: object
    columns: int
    rows: int
    pairs: int


def build(t, projected, settings, width: int, height: int, record) -> Lists:
    """List the Gaussians of each tile.

    Args:
        t: Dr.Jit types.
        projected: `Projected` of the view.
        record: Flat record buffer.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    x0, y0, x1, y1 = projected.bounds
    # Pixel p has its center at p + 0.5. The clip keeps the conversion to int32 defined.
    limit = lambda v, hi: t.Int32(dr.clip(v, -1.0, hi + 1.0))  # noqa: E731
    ix0, iy0 = limit(dr.ceil(x0 - 0.5), width), limit(dr.ceil(y0 - 0.5), height)
    ix1, iy1 = limit(dr.floor(x1 - 0.5), width), limit(dr.floor(y1 - 0.5), height)
    # Bounds that are NaN (parameters beyond float64) list the Gaussian nowhere.
    seen = projected.alive & (ix1 >= 0) & (ix0 < width) & (iy1 >= 0) & (iy0 < height) & (x0 <= x1) & (y0 <= y1)
    tx0, ty0 = dr.maximum(ix0, 0) // TILE, dr.maximum(iy0, 0) // TILE
    tx1, ty1 = dr.minimum(ix1, width - 1) // TILE, dr.minimum(iy1, height - 1) // TILE
    seen &= (ix0 <= ix1) & (iy0 <= iy1)
    amount = dr.select(seen, t.UInt32((tx1 - tx0 + 1) * (ty1 - ty0 + 1)), 0)
    count = dr.width(projected.key)
    gaussian = dr.arange(t.UInt32, count)
    dr.eval(amount, tx0, tx1, ty0, ty1, projected.key)
    order = gaussian
    if settings.order != "ray":
        # Emitting in depth order leaves 32 bits for the rank, so ties fall by index and nothing is quantized.
        order = depth_order(t, projected.key, gaussian)
        amount = dr.gather(t.UInt32, amount, order)
    total64 = dr.sum(t.UInt64(amount))[0]
    if total64 >= 2**32:
        raise ValueError(
            f"render: the tile lists must have fewer than 2^32 entries, got {total64}; lower extent or image size"
        )
    pairs = int(total64)
    what = f"{pairs} entries of tile lists ({count} Gaussians, {width}x{height} pixels)"
    memory.require("render", memory.PAIR * pairs, what, "lower extent or image size", runtime.backend().name == "cuda")
    start, end = dr.zeros(t.UInt32, columns * rows), dr.zeros(t.UInt32, columns * rows)
    nothing = Lists(dr.zeros(t.UInt32, 1), start, end, dr.zeros(t.Float, 1), columns, rows, 0)
    if pairs == 0:
        return nothing
    offset = dr.cumsum(amount) - amount
    keys = dr.full(t.UInt64, _NOWHERE, pairs)
    # A box holds many tiles that its ellipse misses, most of all where a Gaussian reaches behind the camera. Small
    # boxes hold few, and looking for them costs more than they do.
    large = pairs > _LARGE * int(dr.sum(dr.select(seen, t.UInt32(1), 0))[0])
    bits = max(1, (columns * rows - 1).bit_length()), max(1, (count - 1).bit_length())
    box = [dr.gather(t.Int32, b, order) for b in (tx0, tx1, ty0, ty1)]
    loaded = [dr.gather(t.Float, record, order * layout.RECORD + k) for k in range(layout.EXT2 + 1)]
    meets = _Meets(t, settings, loaded)
    _emit(t, keys, gaussian, amount, offset, box, columns, bits, meets, large, settings.order == "ray")
    if large:
        kept = dr.compress(keys != _NOWHERE)
        pairs = dr.width(kept)
        if pairs == 0:
            return nothing
        keys = dr.gather(t.UInt64, keys, kept)
    keys = dr.sort(keys)
    if settings.order == "ray":
        tile = t.UInt32(keys >> (64 - bits[0]))
        index = t.UInt32(keys & ((1 << bits[1]) - 1))
    else:
        tile = t.UInt32(keys >> 32)
        index = dr.gather(t.UInt32, order, t.UInt32(keys & 0xFFFFFFFF))
    entry = dr.arange(t.UInt32, pairs)
    before = dr.gather(t.UInt32, tile, entry - 1, entry > 0)
    after = dr.gather(t.UInt32, tile, entry + 1, entry + 1 < pairs)
    dr.scatter(start, entry, tile, (entry == 0) | (before != tile))
    dr.scatter(end, entry + 1, tile, (entry + 1 == pairs) | (after != tile))
    dr.eval(index, start, end)
    ahead = None
    if settings.order == "ray":
        ahead = dr.gather(t.Float, projected.lower, index)
        dr.eval(ahead)
        ahead = _suffix_minimum(t, ahead, start, end)
    return Lists(index, start, end, ahead, columns, rows, pairs)


def depth_order(t, key, gaussian):
    """Gaussians by (key, index)."""
    # IEEE bits order like unsigned integers once negative floats are flipped.
    bits = dr.reinterpret_array(t.UInt32, key)
    bits = dr.select(bits >> 31 != 0, ~bits, bits | 0x80000000)
    order = t.UInt32(dr.sort((t.UInt64(bits) << 32) | t.UInt64(gaussian)) & 0xFFFFFFFF)
    dr.eval(order)
    return order


class _Meets:
    """Whether a tile has a pixel center that may be hit: bounds over the tile of what `kernels.Model` tests.

    Args:
        t: Dr.Jit types.
        settings: Of the render.
        r: The first entries of each lane's record.
    """

    def __init__(self, t, settings, r):
        self.t, self.r, self.response = t, r, settings.response
        self.limit = r[layout.EXT2]
        if settings.alpha_min > 0:
            least = -math.log1p(-settings.alpha_min) if self.response == "integral" else settings.alpha_min
            needed = 2 * dr.log(r[layout.ALPHA] / dr.opaque(t.Float, least))
            self.limit = dr.minimum(self.limit, needed + 1e-4 * abs(needed) + 1e-4)

    def center(self, x, y):
        """Of tile (x, y), from the anchor."""
        t, r = self.t, self.r
        return (t.Float(x) + 0.5) * TILE - r[layout.AX], (t.Float(y) + 0.5) * TILE - r[layout.AY]

    def direction(self, dx, dy):
        """The three parts of d' there."""
        L, r = layout, self.r
        return [dr.fma(r[L.E2], dx, dr.fma(r[L.E3], dy, 1)), dr.fma(r[L.E4], dx, r[L.E5] * dy), r[L.E6] * dy]

    def depth(self, dx, dy):
        """t* there, at least 0: orders the list, decides nothing."""
        L, r = layout, self.r
        d = self.direction(dx, dy)
        along = dr.fma(r[L.H1], d[0], dr.fma(r[L.H2], d[1], r[L.H3] * d[2]))
        depth = along * dr.rcp(dr.fma(d[0], d[0], dr.fma(d[1], d[1], d[2] * d[2])))
        return dr.select(depth > 0, dr.minimum(depth, _FAR), 0)

    def __call__(self, dx, dy):
        """False only where rho^2 <= limit has no solution in the tile, or (`peak`) all of it is behind the camera."""
        L, r, half = layout, self.r, 0.5 * (TILE - 1)

        def least(a, b, c):  # of |a x + b y + c| over the tile, rounding taken off
            parts = a * dx, b * dy, c
            rounding = 1e-6 * (abs(parts[0]) + abs(parts[1]) + abs(c))
            return dr.maximum(abs(parts[0] + parts[1] + parts[2]) - half * (abs(a) + abs(b)) - rounding, 0)

        m1, m2 = least(r[L.R11], r[L.R12], r[L.R13]), least(r[L.R21], r[L.R22], r[L.R23])
        outside = dr.fma(m1, m1, m2 * m2)
        if self.response == "ewa":
            return ~(outside > 1.0001 * self.limit)
        d = self.direction(dx, dy)
        slopes = (r[L.E2], r[L.E3]), (r[L.E4], r[L.E5]), (0.0, r[L.E6])
        most = [abs(v) + half * (abs(a) + abs(b)) for v, (a, b) in zip(d, slopes, strict=True)]
        length2 = dr.fma(most[0], most[0], dr.fma(most[1], most[1], most[2] * most[2]))
        met = ~(outside > 1.0001 * self.limit * length2)
        if self.response == "peak":
            h = r[L.H1], r[L.H2], r[L.H3]
            along = [a * b for a, b in zip(h, d, strict=True)]
            rise = [sum(a * b[k] for a, b in zip(h, slopes, strict=True)) for k in range(2)]
            rounding = 1e-6 * sum(abs(x) for x in along)
            met &= ~(sum(along) + half * (abs(rise[0]) + abs(rise[1])) + rounding <= 0)
        return met


def _emit(t, keys, gaussian, amount, offset, box, columns, bits, meets, large, by_depth):
    """Write the sort key of every (tile, Gaussian) pair; of those that may have a hit, if boxes are `large`."""
    x0, x1, y0, _ = box
    tile_bits, index_bits = bits
    depth_bits = 64 - tile_bits - index_bits

    def body(k, x, y):
        tile = t.UInt32(y * columns + x)
        dx, dy = meets.center(x, y)
        if by_depth:
            quantized = t.UInt64(dr.reinterpret_array(t.UInt32, meets.depth(dx, dy)))
            quantized = quantized >> (31 - depth_bits) if depth_bits < 31 else quantized << (depth_bits - 31)
            key = (t.UInt64(tile) << (64 - tile_bits)) | (quantized << index_bits) | t.UInt64(gaussian)
        else:
            key = (t.UInt64(tile) << 32) | t.UInt64(gaussian)
        dr.scatter(keys, key, offset + k, meets(dx, dy) if large else True)
        wrap = x >= x1
        return k + 1, dr.select(wrap, x0, x + 1), dr.select(wrap, y + 1, y)

    with dr.suspend_grad():
        dr.while_loop(
            (dr.zeros(t.UInt32, dr.width(gaussian)), t.Int32(x0), t.Int32(y0)), lambda k, x, y: k < amount, body
        )
    dr.eval(keys)


def _suffix_minimum(t, values, start, end):
    """Running minimum of each tile's range from its end; one lane a tile."""
    out = dr.zeros(t.Float, dr.width(values))

    def body(i, low):
        low = dr.minimum(low, dr.gather(t.Float, values, i - 1))
        dr.scatter(out, low, i - 1)
        return i - 1, low

    with dr.suspend_grad():
        dr.while_loop((t.UInt32(end), dr.full(t.Float, _FAR, dr.width(end))), lambda i, low: i > start, body)
    dr.eval(out)
    return out
