"""Which Gaussians a pinhole tile must look at, and the walk of its pixels along that list.

A frame is cut into 8x8-pixel tiles. Every Gaussian is listed in each tile that its screen bounds touch, tiles are
grouped and ordered by one sort of packed 64-bit keys. `center` order sorts by (depth of the mean, index); `ray` order
by t* at the tile's center, which walk.py makes exact on each ray.
"""

from __future__ import annotations

import dataclasses

import drjit as dr

from drgs import projection as layout

__all__ = ["TILE", "Lists", "build", "depth_order"]

TILE = 8
_FAR = 3.0e38


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


def build(t, projected, settings, width: int, height: int, record=None) -> Lists:
    """List the Gaussians of each tile.

    Args:
        t: Dr.Jit types.
        projected: `Projected` of the view.
        record: Flat record buffer; `ray` order only, to sort by t* at the center of each tile.
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
    start, end = dr.zeros(t.UInt32, columns * rows), dr.zeros(t.UInt32, columns * rows)
    if pairs == 0:
        empty = dr.zeros(t.UInt32, 1)
        return Lists(empty, start, end, dr.zeros(t.Float, 1), columns, rows, 0)
    offset = dr.cumsum(amount) - amount
    keys = dr.zeros(t.UInt64, pairs)
    bits = max(1, (columns * rows - 1).bit_length()), max(1, (count - 1).bit_length())
    box = [dr.gather(t.Int32, b, order) for b in (tx0, tx1, ty0, ty1)]
    _emit(t, keys, gaussian, amount, offset, box, columns, bits, record if settings.order == "ray" else None)
    dr.eval(keys)
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


def _emit(t, keys, gaussian, amount, offset, box, columns, bits, record):
    """Write the sort key of every (tile, Gaussian) pair."""
    x0, x1, y0, _ = box
    tile_bits, index_bits = bits
    depth_bits = 64 - tile_bits - index_bits

    def body(k, x, y):
        tile = t.UInt32(y * columns + x)
        if record is None:
            key = (t.UInt64(tile) << 32) | t.UInt64(gaussian)
        else:
            depth = _center_depth(t, record, gaussian, x, y, k < amount)
            quantized = t.UInt64(dr.reinterpret_array(t.UInt32, depth))
            quantized = quantized >> (31 - depth_bits) if depth_bits < 31 else quantized << (depth_bits - 31)
            key = (t.UInt64(tile) << (64 - tile_bits)) | (quantized << index_bits) | t.UInt64(gaussian)
        dr.scatter(keys, key, offset + k)
        wrap = x >= x1
        return k + 1, dr.select(wrap, x0, x + 1), dr.select(wrap, y + 1, y)

    with dr.suspend_grad():
        dr.while_loop(
            (dr.zeros(t.UInt32, dr.width(gaussian)), t.Int32(x0), t.Int32(y0)), lambda k, x, y: k < amount, body
        )


def _center_depth(t, record, gaussian, x, y, active):
    """t* on the ray through the center of tile (x, y), at least 0: orders the list, decides nothing."""
    r = [dr.gather(t.Float, record, gaussian * layout.RECORD + k, active) for k in range(layout.H3 + 1)]
    dx, dy = (t.Float(x) + 0.5) * TILE - r[layout.AX], (t.Float(y) + 0.5) * TILE - r[layout.AY]
    d1 = dr.fma(r[layout.E2], dx, dr.fma(r[layout.E3], dy, 1))
    d2 = dr.fma(r[layout.E4], dx, r[layout.E5] * dy)
    d3 = r[layout.E6] * dy
    along = dr.fma(r[layout.H1], d1, dr.fma(r[layout.H2], d2, r[layout.H3] * d3))
    depth = along * dr.rcp(dr.fma(d1, d1, dr.fma(d2, d2, d3 * d3)))
    return dr.select(depth > 0, dr.minimum(depth, _FAR), 0)


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
