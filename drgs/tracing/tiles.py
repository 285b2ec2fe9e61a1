"""Which Gaussians a pinhole tile must look at, and the walk of its pixels along that list.

A frame is cut into 8x8-pixel tiles. Every Gaussian is listed in each tile of its screen bounds, where these are large
only in those in which a pixel may be hit; tiles are grouped and ordered by one sort of packed 64-bit keys. `center`
order sorts by (depth of the mean, index); `ray` order by t* at the tile's center, which walk.py makes exact.
"""

from __future__ import annotations

import dataclasses

import drjit as dr
import torch

from drgs import runtime
from drgs.guards import memory
from drgs.settings import RenderSettings
from drgs.tracing import records as layout
from drgs.tracing.kernels import HitModel, Ray
from drgs.tracing.projection import Projected
from drgs.tracing.protocols import Float, Int32, Lib, Mask, UInt32, UInt64
from drgs.tracing.responses import RESPONSES
from drgs.tracing.walk import ListStream, Part
from drgs.tracing.weights import PIXELS, Weights, signed

__all__ = ["TILE", "Lists", "TileTraversal", "build", "depth_order"]

TILE = 8
_FAR = 3.0e38
_NOWHERE = 2**64 - 1
_LARGE = 8  # tiles of a box, on average


class TileTraversal:
    """The pixels of a pinhole camera, each along the list of its tile; a `Traversal`.

    Args:
        pinhole: Opaque Float64 (fx, skew, cx, fy, cy).
    """

    world = False

    def __init__(
        self, lib: Lib, settings: RenderSettings, projected: Projected, pinhole: list[Float], width: int, height: int
    ) -> None:
        self.lib, self.settings, self.projected = lib, settings, projected
        self.width, self.height, self.rays = width, height, width * height
        self.certificate: dict = {}
        self.pinhole = [lib.Float(v) for v in pinhole]
        dr.make_opaque(*self.pinhole)

    def start(self, model: HitModel, records: Float, carried: list[Float], basis: int) -> None:
        """Build the lists."""
        self.model, self.records, self.carried, self.basis = model, records, carried, basis
        self.lists = build(self.lib, self.projected, self.settings, self.width, self.height, records)
        self.certificate["pairs"] = self.lists.pairs

    def parts(self, share: int) -> list[Part]:
        """All pixels as one part."""
        count = self.lists.columns * self.lists.rows
        return [self._part(share, dr.arange(self.lib.UInt32, count * (TILE * TILE // share)) // (TILE * TILE // share))]

    def weighed(self, share: int, size: int) -> list[Part]:
        """All pixels, in parts of consecutive tiles whose weights take `size` bytes, or a tile's more, and are held."""
        lib, per_tile, made, begin, first = self.lib, TILE * TILE // share, [], 0, 0
        lengths = signed(self.lists.end).long() - signed(self.lists.start).long()
        ends, index = lengths.cumsum(0), signed(self.lists.index)
        while begin < len(lengths):
            end = int(torch.searchsorted(ends, first + size // (4 * PIXELS), right=True))
            end = min(max(end, begin + 1), len(lengths))
            last = int(ends[end - 1])
            lane = dr.arange(lib.UInt32, (end - begin) * per_tile)
            part = self._part(share, lane // per_tile + dr.opaque(lib.UInt32, begin))
            pixels = self._pixels(torch.arange(begin, end, device=lengths.device))
            part.weights = Weights(lib, index[first:last], lengths[begin:end], first, pixels)
            part.columns = [lane % per_tile + 16 * k for k in range(share)]
            made.append(part)
            begin, first = end, last
        return made

    def _pixels(self, tiles: torch.Tensor) -> torch.Tensor:
        """(tiles, 64) row-major pixels in the order of lanes, -1 outside of the image."""
        k = torch.arange(TILE * TILE, device=tiles.device)
        x = (tiles % self.lists.columns)[:, None] * TILE + k // 16 % 2 * 4 + k % 4
        y = (tiles // self.lists.columns)[:, None] * TILE + k // 32 * 4 + k % 16 // 4
        return torch.where((x < self.width) & (y < self.height), y * self.width + x, -1)

    def _part(self, share: int, tile: UInt32) -> Part:
        """The pixels of tiles, one a lane, `share` a lane."""
        lib, lists = self.lib, self.lists
        per_tile = TILE * TILE // share
        inner = dr.arange(lib.UInt32, dr.width(tile)) % per_tile
        block, k = inner // 16, inner % 16
        # 16 consecutive lanes, a packet, are 4x4 pixels.
        x = (tile % lists.columns) * TILE + (block % 2) * 4 + k % 4
        y = (tile // lists.columns) * TILE + (block // 2) * 4 + k // 4
        corners = [(0, 0), (4, 0), (0, 4), (4, 4)] if share == 4 else [(0, 0)]
        pixels = [(x + a, y + b) for a, b in corners]
        inside = [(px < self.width) & (py < self.height) for px, py in pixels]
        flat = [py * self.width + px for px, py in pixels]
        rays = [
            self._ray(lib.Float(px) + 0.5, lib.Float(py) + 0.5, f, i)
            for (px, py), f, i in zip(pixels, flat, inside, strict=True)
        ]
        some = inside[0]
        for other in inside[1:]:
            some = some | other
        start = dr.gather(lib.UInt32, lists.start, tile)
        end = dr.select(some, dr.gather(lib.UInt32, lists.end, tile), start)
        stream = ListStream(lib, lists.index, start, end, lists.ahead)
        return Part(lib, self.model, self.records, rays, flat, inside, stream, self.settings.order == "ray")

    def _ray(self, x: Float, y: Float, flat: UInt32, inside: Mask) -> Ray:
        """Through a point of the image; |d| is that of the direction with d_z = 1."""
        fx, skew, cx, fy, cy = self.pinhole
        v = (y - cy) / fy
        u = (x - cx - skew * v) / fx
        length = dr.sqrt(dr.fma(u, u, dr.fma(v, v, 1)))
        carried = [dr.gather(self.lib.Float, c, flat, inside) for c in self.carried]
        return Ray(x, y, length, carried, self.basis)


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

    index: UInt32
    start: UInt32
    end: UInt32
    ahead: Float | None
    columns: int
    rows: int
    pairs: int


def build(lib: Lib, projected: Projected, settings: RenderSettings, width: int, height: int, record: Float) -> Lists:
    """List the Gaussians of each tile.

    Args:
        lib: Dr.Jit types.
        projected: `Projected` of the view.
        record: Flat record buffer.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    x0, y0, x1, y1 = projected.bounds
    # Pixel p has its center at p + 0.5. The clip keeps the conversion to int32 defined.
    limit = lambda v, hi: lib.Int32(dr.clip(v, -1.0, hi + 1.0))  # noqa: E731
    ix0, iy0 = limit(dr.ceil(x0 - 0.5), width), limit(dr.ceil(y0 - 0.5), height)
    ix1, iy1 = limit(dr.floor(x1 - 0.5), width), limit(dr.floor(y1 - 0.5), height)
    # Bounds that are NaN (parameters beyond float64) list the Gaussian nowhere.
    seen = projected.alive & (ix1 >= 0) & (ix0 < width) & (iy1 >= 0) & (iy0 < height) & (x0 <= x1) & (y0 <= y1)
    tx0, ty0 = dr.maximum(ix0, 0) // TILE, dr.maximum(iy0, 0) // TILE
    tx1, ty1 = dr.minimum(ix1, width - 1) // TILE, dr.minimum(iy1, height - 1) // TILE
    seen &= (ix0 <= ix1) & (iy0 <= iy1)
    amount = dr.select(seen, lib.UInt32((tx1 - tx0 + 1) * (ty1 - ty0 + 1)), 0)
    count = dr.width(projected.key)
    gaussian = dr.arange(lib.UInt32, count)
    dr.eval(amount, tx0, tx1, ty0, ty1, projected.key)
    order = gaussian
    if settings.order != "ray":
        # Emitting in depth order leaves 32 bits for the rank, so ties fall by index and nothing is quantized.
        order = depth_order(lib, projected.key, gaussian)
        amount = dr.gather(lib.UInt32, amount, order)
    total64 = dr.sum(lib.UInt64(amount))[0]
    if total64 >= 2**32:
        raise ValueError(
            f"render: the tile lists must have fewer than 2^32 entries, got {total64}; lower extent or image size"
        )
    pairs = int(total64)
    what = f"{pairs} entries of tile lists ({count} Gaussians, {width}x{height} pixels)"
    memory.require("render", memory.PAIR * pairs, what, "lower extent or image size", runtime.backend().name == "cuda")
    start, end = dr.zeros(lib.UInt32, columns * rows), dr.zeros(lib.UInt32, columns * rows)
    nothing = Lists(dr.zeros(lib.UInt32, 1), start, end, dr.zeros(lib.Float, 1), columns, rows, 0)
    if pairs == 0:
        return nothing
    offset = dr.cumsum(amount) - amount
    keys = dr.full(lib.UInt64, _NOWHERE, pairs)
    # A box holds many tiles that its ellipse misses, most of all where a Gaussian reaches behind the camera. Small
    # boxes hold few, and looking for them costs more than they do.
    large = pairs > _LARGE * int(dr.sum(dr.select(seen, lib.UInt32(1), 0))[0])
    bits = max(1, (columns * rows - 1).bit_length()), max(1, (count - 1).bit_length())
    box = [dr.gather(lib.Int32, b, order) for b in (tx0, tx1, ty0, ty1)]
    loaded = [dr.gather(lib.Float, record, order * layout.RECORD + k) for k in range(layout.EXT2 + 1)]
    tiles = _Tiles(lib, settings, loaded)
    _emit(lib, keys, gaussian, amount, offset, box, columns, bits, tiles, large, settings.order == "ray")
    if large:
        kept = dr.compress(keys != _NOWHERE)
        pairs = dr.width(kept)
        if pairs == 0:
            return nothing
        keys = dr.gather(lib.UInt64, keys, kept)
    keys = dr.sort(keys)
    if settings.order == "ray":
        tile = lib.UInt32(keys >> (64 - bits[0]))
        index = lib.UInt32(keys & ((1 << bits[1]) - 1))
    else:
        tile = lib.UInt32(keys >> 32)
        index = dr.gather(lib.UInt32, order, lib.UInt32(keys & 0xFFFFFFFF))
    entry = dr.arange(lib.UInt32, pairs)
    before = dr.gather(lib.UInt32, tile, entry - 1, entry > 0)
    after = dr.gather(lib.UInt32, tile, entry + 1, entry + 1 < pairs)
    dr.scatter(start, entry, tile, (entry == 0) | (before != tile))
    dr.scatter(end, entry + 1, tile, (entry + 1 == pairs) | (after != tile))
    dr.eval(index, start, end)
    ahead = None
    if settings.order == "ray":
        ahead = dr.gather(lib.Float, projected.lower, index)
        dr.eval(ahead)
        ahead = _suffix_minimum(lib, ahead, start, end)
    return Lists(index, start, end, ahead, columns, rows, pairs)


def depth_order(lib: Lib, key: Float, gaussian: UInt32) -> UInt32:
    """Gaussians by (key, index)."""
    # IEEE bits order like unsigned integers once negative floats are flipped.
    bits = dr.reinterpret_array(lib.UInt32, key)
    bits = dr.select(bits >> 31 != 0, ~bits, bits | 0x80000000)
    order = lib.UInt32(dr.sort((lib.UInt64(bits) << 32) | lib.UInt64(gaussian)) & 0xFFFFFFFF)
    dr.eval(order)
    return order


class _Tiles:
    """Of pairs of a Gaussian and a tile: whether there is a pixel center that may be hit, and how far away.

    Args:
        loaded: The first entries of each lane's record.
    """

    def __init__(self, lib: Lib, settings: RenderSettings, loaded: list[Float]) -> None:
        self.lib, self.r, self.response = lib, loaded, RESPONSES[settings.response]
        self.limit = loaded[layout.EXT2]
        if settings.alpha_min > 0:
            least = dr.opaque(lib.Float, self.response.least_strength(settings.alpha_min))
            needed = 2 * dr.log(loaded[layout.ALPHA] / least)
            # What float32 rounds must not lose a hit: 1e-4 is a hundred times as much.
            self.limit = dr.minimum(self.limit, needed + 1e-4 * abs(needed) + 1e-4)

    def center(self, x: Int32, y: Int32) -> tuple[Float, Float]:
        """Of tile (x, y), from the anchor."""
        r = self.r
        return (self.lib.Float(x) + 0.5) * TILE - r[layout.AX], (self.lib.Float(y) + 0.5) * TILE - r[layout.AY]

    def depth(self, dx: Float, dy: Float) -> Float:
        """t* there, at least 0: orders the list, decides nothing."""
        return self.response.depth(self.r, dx, dy)

    def may_hit(self, dx: Float, dy: Float) -> Mask:
        """False only where no pixel center of the tile around there has a hit."""
        return self.response.may_hit(self.r, dx, dy, 0.5 * (TILE - 1), self.limit)


def _emit(
    lib: Lib,
    keys: UInt64,
    gaussian: UInt32,
    amount: UInt32,
    offset: UInt32,
    box: list[Int32],
    columns: int,
    bits: tuple[int, int],
    tiles: _Tiles,
    large: bool,
    by_depth: bool,
) -> None:
    """Write the sort key of every (tile, Gaussian) pair; of those that may have a hit, if boxes are `large`."""
    x0, x1, y0, _ = box
    tile_bits, index_bits = bits
    depth_bits = 64 - tile_bits - index_bits

    def body(k: UInt32, x: Int32, y: Int32) -> tuple[UInt32, Int32, Int32]:
        """Write one pair, and step to the next tile of the box, row by row."""
        tile = lib.UInt32(y * columns + x)
        dx, dy = tiles.center(x, y)
        if by_depth:
            quantized = lib.UInt64(dr.reinterpret_array(lib.UInt32, tiles.depth(dx, dy)))
            quantized = quantized >> (31 - depth_bits) if depth_bits < 31 else quantized << (depth_bits - 31)
            key = (lib.UInt64(tile) << (64 - tile_bits)) | (quantized << index_bits) | lib.UInt64(gaussian)
        else:
            key = (lib.UInt64(tile) << 32) | lib.UInt64(gaussian)
        dr.scatter(keys, key, offset + k, tiles.may_hit(dx, dy) if large else True)
        wrap = x >= x1
        return k + 1, dr.select(wrap, x0, x + 1), dr.select(wrap, y + 1, y)

    with dr.suspend_grad():  # lists have no derivative
        dr.while_loop(
            (dr.zeros(lib.UInt32, dr.width(gaussian)), lib.Int32(x0), lib.Int32(y0)), lambda k, x, y: k < amount, body
        )
    dr.eval(keys)


def _suffix_minimum(lib: Lib, values: Float, start: UInt32, end: UInt32) -> Float:
    """Running minimum of each tile's range from its end; one lane a tile."""
    out = dr.zeros(lib.Float, dr.width(values))

    def body(i: UInt32, low: Float) -> tuple[UInt32, Float]:
        low = dr.minimum(low, dr.gather(lib.Float, values, i - 1))
        dr.scatter(out, low, i - 1)
        return i - 1, low

    with dr.suspend_grad():  # bounds have no derivative
        dr.while_loop((lib.UInt32(end), dr.full(lib.Float, _FAR, dr.width(end))), lambda i, low: i > start, body)
    dr.eval(out)
    return out
