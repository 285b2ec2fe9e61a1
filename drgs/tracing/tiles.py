"""Which Gaussians a tile must look at, and the walk of its pixels along that list.

A frame is cut into 8x8-pixel tiles. Every Gaussian is listed in each tile of its screen bounds, where these are large
only in those in which a pixel may be hit; tiles are grouped and ordered by one sort of packed 64-bit keys. `center`
order sorts by (depth of the mean, index); in `ray` order lists stay in that of the indices, and the hits of each pixel
are sorted (rows.py).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import drjit as dr
import torch

from drgs import runtime
from drgs.runtime import memory
from drgs.settings import RenderSettings
from drgs.tracing import records as layout
from drgs.tracing.arrays import Float, Int32, Lib, Mask, UInt32, UInt64
from drgs.tracing.free_rays import FreeRays
from drgs.tracing.kernels import HitModel
from drgs.tracing.lens_rays import LensRays, pinhole_length
from drgs.tracing.primitives import TOLERANCE_LISTED, TOLERANCE_UNLISTED, Patch, Projected, Ray, trimmed_extent2
from drgs.tracing.records import load_record
from drgs.tracing.responses import response_of
from drgs.tracing.rows import MemoryBudget, SortedHits, SortedRows
from drgs.tracing.sort_keys import ascending
from drgs.tracing.walk import ListStream, Part, Slots, pixels_a_lane
from drgs.tracing.weights import PIXELS, Weights, signed

# Pixels a side. With 4, 100,000 Gaussians in 512x512 pixels have 1.55 M entries to sort in place of 0.6 M.
TILE = 8
TABLES = 128 << 20
"""Bytes of the rows of pixels that are sorted at a time, and of a table that the adjoint fills in exact order
(information: twice that, with a semantic channel four times); a single tile's may have more.
"""
_MAX_GPU_BANDS = 8
"""On a card bands are up to so many times as wide, because many lanes must run at once: as many times as
`_BYTES_PER_BAND` fits into its memory. To sort the hits of a band torch takes up to a tenth of that.
"""
_BYTES_PER_BAND = 10 << 30  # bytes
# offsets, px, of the pixels that share a lane
_LANE_PIXELS = {1: [(0, 0)], 2: [(0, 0), (0, 4)], 4: [(0, 0), (4, 0), (0, 4), (4, 4)]}
NO_KEY = 2**64 - 1  # key of no entry: sorted behind all others
# bytes of the orders of all pixels that are held, because derivatives need them again; chosen
_MAX_ORDER_BYTES = 128 << 20
_TEST_TILES_FROM = 8  # tiles of a box, on average, from which on each tile is tested against the ellipse
_TEST_BLOCKS_FROM = 16  # likewise, from which on blocks of tiles are tested first
_BLOCK = 8  # tiles along the edge of a block


class TileTraversal:
    """The pixels of a camera, each along the list of its tile; a `Traversal`.

    Args:
        pinhole: Opaque Float64 (fx, skew, cx, fy, cy).
        lens: The camera's, if it is no pinhole; of rays without a common origin `FreeRays`.
        trimmed: In `ray` order, bound the tails of the Gaussians that a tile lists in place of those of all.
    """

    def __init__(
        self,
        lib: Lib,
        settings: RenderSettings,
        projected: Projected | Any,
        pinhole: list[Float],
        width: int,
        height: int,
        trimmed: bool,
        lens: LensRays | None = None,
    ) -> None:
        self.lib = lib
        self.settings = settings
        self.projected = projected
        self.trimmed = trimmed and is_trimmed(settings)
        self.width = width
        self.height = height
        self.rays = width * height
        self.certificate: dict = {}
        self.lens = lens
        self.world = lens is not None and lens.world
        self.holes = None if lens is None else lens.known
        self.pinhole = [lib.Float(v) for v in pinhole]
        dr.make_opaque(*self.pinhole)

    def start(self, model: HitModel, records: Float, carried: list[Float], basis: int, replayed: bool) -> None:
        """Build the lists."""
        size = self.width, self.height
        lists = build(self.lib, self.projected, self.settings, *size, records, self.trimmed, self.lens)
        self.look(model, records, carried, basis, lists)
        self.certificate["pairs"] = self.lists.pairs
        self.budget = MemoryBudget(order_bytes() if replayed else 0)
        if self.settings.order == "ray":
            self.certificate |= {"rays": self.rays, "redone": 0}  # rows hold every hit

    def look(self, model: HitModel, records: Float, carried: list[Float], basis: int, lists: Lists) -> None:
        """Take lists that are built: arguments of `start`, and these."""
        self.model = model
        self.records = records
        self.carried = carried
        self.basis = basis
        self.shifted = len(carried) > basis
        self.lists = lists

    def parts(self, share: int) -> list[Part]:
        """All pixels as one part; in `ray` order as `weighed`, for tables of two numbers."""
        if self.settings.order == "ray":
            return [self._band_part(share, band) for band in self._bands(_room(TABLES) // 2)]
        count = self.lists.columns * self.lists.rows
        per_tile = TILE * TILE // share
        return [self._part(share, dr.arange(self.lib.UInt32, count * per_tile) // per_tile)]

    def weighed(self, share: int, size: int) -> list[Part]:
        """All pixels, in parts of consecutive tiles whose weights take `size` bytes, or a tile's more, and are held."""
        index = signed(self.lists.index)
        size = min(size, _room(TABLES) // 2) if self.settings.order == "ray" else size
        parts = []
        for band in self._bands(size):
            pixels = self._pixels(torch.arange(band.begin, band.end, device=band.lengths.device))
            weights = Weights(self.lib, index[band.first : band.last], band.lengths, pixels)
            parts.append(self._band_part(share, band, weights))
        return parts

    def _bands(self, size: int) -> Iterator[_Band]:
        """Consecutive tiles whose entries, a float in each pixel, take `size` bytes, or a tile's more."""
        lengths = signed(self.lists.end - self.lists.start).long()
        ends = lengths.cumsum(0)
        begin = 0
        first = 0
        while begin < len(lengths):
            end = int(torch.searchsorted(ends, first + size // (4 * PIXELS), right=True))
            end = min(max(end, begin + 1), len(lengths))
            last = int(ends[end - 1])
            yield _Band(begin, end, first, last, lengths[begin:end])
            begin, first = end, last

    def _band_part(self, share: int, band: _Band, weights: Weights | None = None) -> Part:
        """The pixels of a band: along the lists of their tiles, in `ray` order along rows of their own hits."""
        lib = self.lib
        if self.settings.order != "ray":
            return self._band_in_lists(band, share, weights=weights)
        size = band.slots
        what = f"rows of the hits in {band.end - band.begin} tiles of {band.last - band.first} entries"
        memory.require("render", 8 * size, what, "lower extent", runtime.backend().name == "cuda")
        tiles = dr.arange(lib.UInt32, band.end - band.begin) + dr.opaque(lib.UInt32, band.begin)
        cut = None if self.lists.cut is None else dr.gather(lib.Float, self.lists.cut, tiles)
        found_by = functools.partial(self._band_in_lists, band, pixels_a_lane())
        hits = SortedHits(lib, found_by, self.lists.index, band.lengths, cut, self.budget)
        in_lists = functools.partial(self._band_in_lists, band, pixels_a_lane(self.basis))
        return self._band_in_lists(band, share, hits, in_lists, weights)

    def whole_band(self, share: int, hits: SortedRows | None = None) -> Part:
        """All pixels: along the lists of their tiles, or along rows of their own hits, which are sorted."""
        count = self.lists.columns * self.lists.rows
        band = _Band(0, count, 0, self.lists.pairs, torch.empty(0))
        in_lists = None if hits is None else functools.partial(self._band_in_lists, band, pixels_a_lane(self.basis))
        return self._band_in_lists(band, share, hits, in_lists)

    def _band_in_lists(
        self,
        band: _Band,
        share: int,
        hits: SortedHits | SortedRows | None = None,
        in_lists: Callable[[], Part] | None = None,
        weights: Weights | None = None,
    ) -> Part:
        """The pixels of a band in the order of its tiles' lists, or along their own `hits`."""
        lib = self.lib
        per_tile = PIXELS // share
        lane = dr.arange(lib.UInt32, (band.end - band.begin) * per_tile)
        columns = [lane % per_tile + per_tile * k for k in range(share)]
        # Opaque: another band is no other kernel.
        slots = Slots(dr.opaque(lib.UInt32, band.first), band.slots, columns)
        tile = lane // per_tile + dr.opaque(lib.UInt32, band.begin)
        return self._part(share, tile, hits, slots, in_lists, weights)

    def _pixels(self, tiles: torch.Tensor) -> torch.Tensor:
        """(tiles, pixels) row-major pixels in the order of lanes, -1 outside of the image."""
        k = torch.arange(TILE * TILE, device=tiles.device)
        x = (tiles % self.lists.columns)[:, None] * TILE + k // 16 % 2 * 4 + k % 4
        y = (tiles // self.lists.columns)[:, None] * TILE + k // 32 * 4 + k % 16 // 4
        return torch.where((x < self.width) & (y < self.height), y * self.width + x, -1)

    def _part(
        self,
        share: int,
        tile: UInt32,
        hits: SortedHits | SortedRows | None = None,
        slots: Slots | None = None,
        in_lists: Callable[[], Part] | None = None,
        weights: Weights | None = None,
    ) -> Part:
        """The pixels of tiles, given per lane, 1, 2 or 4 a lane, along the tiles' lists or their own `hits`."""
        lib, lists = self.lib, self.lists
        per_tile = TILE * TILE // share
        inner = dr.arange(lib.UInt32, dr.width(tile)) % per_tile
        block = inner // 16
        k = inner % 16
        # 16 consecutive lanes, a packet, are 4x4 pixels.
        x = (tile % lists.columns) * TILE + (block % 2) * 4 + k % 4
        y = (tile // lists.columns) * TILE + (block // 2) * 4 + k // 4
        corners = _LANE_PIXELS[share]
        pixels = [(x + a, y + b) for a, b in corners]
        inside = [(px < self.width) & (py < self.height) for px, py in pixels]
        flat = [py * self.width + px for px, py in pixels]
        if self.holes is not None:
            inside = [
                ok & (dr.gather(lib.UInt32, self.holes, at, ok) != 0) for ok, at in zip(inside, flat, strict=True)
            ]
        rays = [
            self._ray(lib.Float(px) + 0.5, lib.Float(py) + 0.5, f, i)
            for (px, py), f, i in zip(pixels, flat, inside, strict=True)
        ]
        some = inside[0]
        for other in inside[1:]:
            some = some | other
        start = dr.gather(lib.UInt32, lists.start, tile)
        end = dr.select(some, dr.gather(lib.UInt32, lists.end, tile), start)
        return Part(
            lib,
            self.model,
            self.records,
            rays,
            flat,
            inside,
            hits or ListStream(lib, lists.index, start, end),
            ordered=False,
            slots=slots,
            in_lists=in_lists,
            weights=weights,
        )

    def _ray(self, x: Float, y: Float, flat: UInt32, inside: Mask) -> Ray:
        """Through a point of the image; |d| is that of the direction with d_z = 1."""
        carried = [dr.gather(self.lib.Float, c, flat, inside) for c in self.carried]
        if self.world:
            return Ray(carried=carried, basis=self.basis)
        if self.lens is not None:
            return self.lens.ray(self.pinhole, flat, inside, carried, self.basis, self.shifted)
        return Ray(x, y, pinhole_length(self.pinhole, x, y), carried, self.basis, shifted=self.shifted)


def is_trimmed(settings: RenderSettings) -> bool:
    """Whether the tails of the Gaussians that a tile lists are bounded in place of those of all."""
    # The bound is of tails of at most alpha exp(-rho^2 / 2), and a ray that ends behind so many hits counts them.
    bounded = settings.extent is None and settings.max_hits is None and response_of(settings).at_most_alpha
    return settings.order == "ray" and bounded


def is_one_band(entries: int) -> bool:
    """Whether the rows of all pixels are sorted at once, whose lists have so many entries."""
    return entries <= _room(TABLES) // 2 // (4 * PIXELS)


def order_bytes() -> int:
    """Bytes of orders that may be held for derivatives."""
    return _room(_MAX_ORDER_BYTES)


class _Band(NamedTuple):
    """Consecutive tiles that are walked together.

    Attributes:
        begin, end: First tile, and that behind the last one.
        first, last: First entry of their lists, and that behind the last one.
        lengths: (tiles,) int64 lengths of the lists.
    """

    begin: int
    end: int
    first: int
    last: int
    lengths: torch.Tensor

    @property
    def slots(self) -> int:
        """Size of a table of these entries in each pixel; one entry more than there are, so that it is never empty."""
        return (self.last - self.first + 1) * PIXELS


@dataclasses.dataclass
class Lists:
    """Gaussians by tile.

    Attributes:
        index: (pairs,) Gaussian of each entry; a tile's entries are contiguous and ordered.
        start, end: (tiles,) range of each tile.
        columns, rows: Tiles in x and y.
        pairs: Number of entries.
        cut: (tiles,) what is taken off the squared extent of each entry (`trimmed_extent2`); None: nothing.
        tile: (pairs,) of each entry, while lists are built.
    """

    index: UInt32
    start: UInt32
    end: UInt32
    columns: int
    rows: int
    pairs: int
    cut: Float | None = None
    tile: UInt32 | Any = None


def build(
    lib: Lib,
    projected: Projected,
    settings: RenderSettings,
    width: int,
    height: int,
    record: Float,
    trimmed: bool = False,
    lens: LensRays | None = None,
) -> Lists:
    """List the Gaussians of each tile.

    Args:
        projected: `Projected` of the view.
        record: Flat record buffer.
        trimmed: Leave tails out.
        lens: The camera's, if it is no pinhole.
    """
    seen, amount, x, y = screen_boxes(lib, projected, width, height)
    count = dr.width(projected.key)
    gaussian = dr.arange(lib.UInt32, count)
    dr.eval(amount, x, y, projected.key)
    # Emitting in depth order leaves 32 bits for the rank, so ties fall by index and nothing is quantized.
    order = gaussian if settings.order == "ray" else depth_order(lib, projected.key, gaussian)
    boxes_seen = int(dr.sum(dr.select(seen, lib.UInt32(1), 0))[0])
    found = listed(lib, settings, width, height, record, order, amount, x, y, boxes_seen, lens)
    if trimmed and found.pairs:
        return shorter(lib, found, settings, record, count, lens)
    return dataclasses.replace(found, tile=None)  # nothing reads it any more, and lists are kept for the gradient


def screen_boxes(
    lib: Lib, projected: Projected, width: int, height: int
) -> tuple[Mask, UInt32, tuple[Int32, Int32], tuple[Int32, Int32]]:
    """Which Gaussians are on the image, how many tiles the box of each holds, and its first and last column and row."""
    x0, y0, x1, y1 = projected.bounds
    # Pixel p has its center at p + 0.5. The clip keeps the conversion to int32 defined.
    limit = lambda v, hi: lib.Int32(dr.clip(v, -1.0, hi + 1.0))  # noqa: E731
    ix0, iy0 = limit(dr.ceil(x0 - 0.5), width), limit(dr.ceil(y0 - 0.5), height)
    ix1, iy1 = limit(dr.floor(x1 - 0.5), width), limit(dr.floor(y1 - 0.5), height)
    # Bounds that are NaN (parameters beyond float64) list the Gaussian nowhere.
    seen = projected.alive & (ix1 >= 0) & (ix0 < width) & (iy1 >= 0) & (iy0 < height) & (x0 <= x1) & (y0 <= y1)
    tx0, ty0 = dr.maximum(ix0, 0) // TILE, dr.maximum(iy0, 0) // TILE
    tx1 = dr.minimum(ix1, width - 1) // TILE
    ty1 = dr.minimum(iy1, height - 1) // TILE
    seen &= (ix0 <= ix1) & (iy0 <= iy1)
    amount = dr.select(seen, lib.UInt32((tx1 - tx0 + 1) * (ty1 - ty0 + 1)), 0)
    return seen, amount, (tx0, tx1), (ty0, ty1)


def listed(
    lib: Lib,
    settings: RenderSettings,
    width: int,
    height: int,
    record: Float,
    order: UInt32,
    amount: UInt32,
    x: Sequence[Int32],
    y: Sequence[Int32],
    boxes_seen: int,
    lens: LensRays | None = None,
) -> Lists:
    """The Gaussians of each tile, in a given order, by their boxes.

    Args:
        order: (N,) Gaussians in the order of the lists.
        amount, x, y: (N,) of `screen_boxes`, by Gaussian.
        boxes_seen: How many boxes hold a tile.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    count = dr.width(amount)
    gaussian = dr.arange(lib.UInt32, count)
    if settings.order != "ray":
        amount = dr.gather(lib.UInt32, amount, order)
    start = dr.zeros(lib.UInt32, columns * rows)
    end = dr.zeros(lib.UInt32, columns * rows)
    nothing = Lists(dr.zeros(lib.UInt32, 1), start, end, columns, rows, 0)
    x, y = ([dr.gather(lib.Int32, b, order) for b in along] for along in (x, y))
    boxes = _Boxes(lib, gaussian, x, y, amount)
    what = f"({count} Gaussians, {width}x{height} pixels)"
    # A box holds many tiles that its ellipse misses, most of all where a Gaussian reaches behind the camera. Small
    # boxes hold few, and looking for them costs more than they do.
    tested = is_tested(boxes.pairs, boxes_seen)
    loaded = _entries(lib, record, order)
    if tested is None and lens is None:
        across = -(-columns // _BLOCK)
        found = boxes.of_blocks().keys(across, _Tiles(lib, settings, loaded, size=_BLOCK * TILE), what)
        if not dr.width(found):
            return nothing
        boxes = boxes.within(found, across)
        loaded = _entries(lib, record, dr.gather(lib.UInt32, order, boxes.gaussian))
    tiles = None if tested is False else _Tiles(lib, settings, loaded, lens=lens)
    keys = boxes.keys(columns, tiles, what)
    pairs = dr.width(keys)
    if pairs == 0:
        return nothing
    keys = ascending(lib, keys)
    tile = lib.UInt32(keys >> 32)
    index = dr.gather(lib.UInt32, order, lib.UInt32(keys & 0xFFFFFFFF))
    dr.eval(tile, index)
    _ranges(lib, tile, start, end)
    return Lists(index, start, end, columns, rows, pairs, tile=tile)


def shorter(
    lib: Lib,
    lists: Lists,
    settings: RenderSettings,
    record: Float,
    count: int,
    lens: LensRays | None = None,
) -> Lists:
    """Shorter lists: an extent that bounds the tails of all N Gaussians together is longer than a tile needs, which
    lists n of them. Squared extents that are less by 2 ln(N / n), but no less than the least, keep the bound for n.

    Args:
        record: Flat record buffer.
        count: N.
        lens: The camera's, if it is no pinhole.
    """
    tile = lists.tile
    cut, mask = remaining(lib, lists, settings, record, count, lens)
    kept = dr.compress(dr.full(lib.Bool, True, lists.pairs) & mask)
    start = dr.zeros(lib.UInt32, dr.width(cut))
    end = dr.zeros(lib.UInt32, dr.width(cut))
    if dr.width(kept) == 0:
        return Lists(lists.index, start, end, lists.columns, lists.rows, 0, cut)
    index = dr.gather(lib.UInt32, lists.index, kept)
    tile = dr.gather(lib.UInt32, tile, kept)
    dr.eval(index, tile, cut)
    _ranges(lib, tile, start, end)
    return Lists(index, start, end, lists.columns, lists.rows, dr.width(kept), cut)


def remaining(
    lib: Lib, lists: Lists, settings: RenderSettings, record: Float, count: int, lens: LensRays | None = None
) -> tuple[Float, Mask]:
    """What is taken off squared extents on each tile, and whether an entry is left then (arguments of `shorter`)."""
    listed = lib.Float(lists.end - lists.start)
    more = 1 if settings.tolerance is None else TOLERANCE_LISTED / TOLERANCE_UNLISTED
    cut = 2 * dr.log(dr.opaque(lib.Float, count * more) / dr.maximum(listed, 1))
    loaded = load_record(lib, record, lists.index, lib.Bool(True))
    tiles = _Tiles(lib, settings, loaded, dr.gather(lib.Float, cut, lists.tile), lens)
    x, y = lib.Int32(lists.tile % lists.columns), lib.Int32(lists.tile // lists.columns)
    return cut, tiles.may_hit(x, y)


def keys_of_boxes(
    lib: Lib,
    settings: RenderSettings,
    columns: int,
    record: Float,
    order: UInt32,
    amount: UInt32,
    x: Sequence[Int32],
    y: Sequence[Int32],
    pairs: int,
    is_tested: bool,
) -> UInt64:
    """Keys as `_Boxes.all_keys` has them, of a pinhole, for no fewer pairs than there are.

    Args:
        columns: Tiles in x.
        record, order, amount, x, y: Arguments of `listed`.
        is_tested: Leave out pairs without a hit.
    """
    gaussian = dr.arange(lib.UInt32, dr.width(amount))
    x, y = ([dr.gather(lib.Int32, b, order) for b in along] for along in (x, y))
    boxes = _Boxes(lib, gaussian, x, y, dr.gather(lib.UInt32, amount, order), pairs)
    return boxes.all_keys(columns, _Tiles(lib, settings, _entries(lib, record, order)) if is_tested else None)


def _entries(lib: Lib, record: Float, gaussian: UInt32) -> list[Float]:
    """The record of each Gaussian, of which only what is used is read."""
    return [dr.gather(lib.Float, record, gaussian * layout.RECORD + k) for k in range(layout.RECORD)]


def lists_of_keys(lib: Lib, keys: UInt64, order: UInt32, columns: int, rows: int) -> Lists:
    """Lists from sorted keys, with `NO_KEY` behind them: entries there are of Gaussian 0, and in no tile."""
    there = keys != NO_KEY
    tile = dr.select(there, lib.UInt32(keys >> 32), columns * rows)
    index = dr.gather(lib.UInt32, order, lib.UInt32(keys & 0xFFFFFFFF), there)
    start = dr.zeros(lib.UInt32, columns * rows + 1)
    end = dr.zeros(lib.UInt32, columns * rows + 1)
    dr.eval(tile, index)
    _ranges(lib, tile, start, end)
    own = dr.arange(lib.UInt32, columns * rows)
    start, end = (dr.gather(lib.UInt32, x, own) for x in (start, end))
    return Lists(index, start, end, columns, rows, dr.width(keys), tile=tile)


def is_tested(pairs: int, boxes: int) -> bool | None:
    """Whether pairs of a tile and a Gaussian are tested, in how many boxes they are; None: blocks of tiles are, too."""
    return None if pairs > _TEST_BLOCKS_FROM * boxes else pairs > _TEST_TILES_FROM * boxes


def _ranges(lib: Lib, group: UInt32, start: UInt32, end: UInt32) -> None:
    """Write where each group of consecutive entries starts and ends."""
    pairs = dr.width(group)
    entry = dr.arange(lib.UInt32, pairs)
    before = dr.gather(lib.UInt32, group, entry - 1, entry > 0)
    # A number that Dr.Jit knows is part of a kernel: each count would be a kernel of its own, compiled, and kept in
    # memory and on disk for good.
    count = dr.opaque(lib.UInt32, pairs)
    after = dr.gather(lib.UInt32, group, entry + 1, entry + 1 < count)
    dr.scatter(start, entry, group, (entry == 0) | (before != group))
    dr.scatter(end, entry + 1, group, (entry + 1 == count) | (after != group))
    dr.eval(start, end)


def depth_order(lib: Lib, key: Float, gaussian: UInt32) -> UInt32:
    """Gaussians by (key, index)."""
    order = lib.UInt32(ascending(lib, depth_words(lib, key, gaussian)) & 0xFFFFFFFF)
    dr.eval(order)
    return order


def depth_words(lib: Lib, key: Float, gaussian: UInt32) -> UInt64:
    """Numbers that order like (key, index), the index in their lower half."""
    # IEEE bits order like unsigned integers once negative floats are flipped.
    bits = dr.reinterpret_array(lib.UInt32, key)
    bits = dr.select(bits >> 31 != 0, ~bits, bits | 0x80000000)
    return (lib.UInt64(bits) << 32) | lib.UInt64(gaussian)


class _Tiles:
    """Whether a Gaussian may hit a pixel center of a tile, for pairs of these.

    Args:
        loaded: The first entries of each lane's record.
        cut: What is taken off squared extents (`trimmed_extent2`); None: nothing.
        lens: The camera's, if it is no pinhole.
        size: Pixels along the edge of a tile, or of a block of tiles.
    """

    def __init__(
        self,
        lib: Lib,
        settings: RenderSettings,
        loaded: list[Float],
        cut: Float | None = None,
        lens: LensRays | None = None,
        size: int = TILE,
    ) -> None:
        self.lib = lib
        self.size = size
        self.lens = lens
        self.r = loaded
        self.response = response_of(settings)
        world = lens is not None and lens.world
        self.limit = trimmed_extent2(settings, loaded[layout.W_EXT2 if world else layout.EXT2], cut)
        if settings.alpha_min > 0:
            least = dr.opaque(lib.Float, self.response.least_strength(settings.alpha_min))
            needed = 2 * dr.log(loaded[layout.W_ALPHA if world else layout.ALPHA] / least)
            # What float32 rounds must not lose a hit: 1e-4 is a hundred times as much.
            self.limit = dr.minimum(self.limit, needed + 1e-4 * abs(needed) + 1e-4)

    def patch(self, x: Int32, y: Int32) -> Patch:
        """The rays of tile (x, y)."""
        if self.lens is not None:
            return self.lens.patch(self.r, x, y)
        at = (self.lib.Float(v) + 0.5 for v in (x, y))
        dx, dy = (v * self.size - self.r[k] for v, k in zip(at, (layout.AX, layout.AY), strict=True))
        half = 0.5 * (self.size - 1)
        return Patch(dx, dy, 1, (half, half))

    def may_hit(self, x: Int32, y: Int32) -> Mask:
        """False only where no pixel center of tile (x, y) has a hit."""
        if isinstance(self.lens, FreeRays):
            return self.lens.may_meet(self.r, x, y, self.limit)
        return self.response.may_hit(self.r, self.patch(x, y), self.limit)


class _Boxes:
    """Boxes of tiles, or of blocks of tiles, each of one Gaussian.

    Args:
        gaussian: (boxes,) place of the Gaussian in the order of the lists.
        x, y: First and last column, first and last row, (boxes,) each.
        amount: (boxes,) how many tiles a box holds; 0: it is none.
        pairs: Number of tiles that all boxes hold, or more; None: it is counted.
    """

    def __init__(
        self,
        lib: Lib,
        gaussian: UInt32,
        x: Sequence[Int32],
        y: Sequence[Int32],
        amount: UInt32 | None = None,
        pairs: int | None = None,
    ) -> None:
        self.lib = lib
        self.gaussian = gaussian
        self.x, self.y = tuple(x), tuple(y)
        self.amount = _area(lib, x, y) if amount is None else amount
        dr.eval(self.gaussian, self.x, self.y, self.amount)
        self.pairs = int(dr.sum(lib.UInt64(self.amount))[0]) if pairs is None else pairs

    def of_blocks(self) -> _Boxes:
        """The boxes of blocks that hold these."""
        x, y = ([v // _BLOCK for v in along] for along in (self.x, self.y))
        return _Boxes(self.lib, self.gaussian, x, y, dr.select(self.amount > 0, _area(self.lib, x, y), 0))

    def within(self, keys: UInt64, across: int) -> _Boxes:
        """What lies of these boxes in each of some blocks, of which `across` are side by side."""
        lib = self.lib
        gaussian = lib.UInt32(keys & 0xFFFFFFFF)
        block = lib.Int32(keys >> 32)
        parts: list[tuple[Int32, Int32]] = []
        for (low, high), first in zip((self.x, self.y), (block % across, block // across), strict=True):
            low, high = (dr.gather(lib.Int32, v, gaussian) for v in (low, high))
            first = first * _BLOCK
            parts.append((dr.maximum(low, first), dr.minimum(high, first + _BLOCK - 1)))
        x, y = parts
        return _Boxes(lib, gaussian, x, y)

    def keys(self, columns: int, tiles: _Tiles | None, what: str) -> UInt64:
        """The sort key of every pair of a tile and a Gaussian, the tile first; of those that may have a hit.

        Args:
            columns: Tiles in x.
            tiles: Says which may have one; None: all.
            what: The scene and the image, as messages name them.
        """
        check_pairs(self.pairs, what)
        if self.pairs == 0:
            return dr.zeros(self.lib.UInt64, 0)
        keys = self.all_keys(columns, tiles)
        return keys if tiles is None else dr.gather(self.lib.UInt64, keys, dr.compress(keys != NO_KEY))

    def all_keys(self, columns: int, tiles: _Tiles | None) -> UInt64:
        """The keys in the order of the boxes, `NO_KEY` in place of those of pairs that have no hit, and behind them."""
        lib = self.lib
        offset = dr.cumsum(self.amount) - self.amount
        keys = dr.full(lib.UInt64, NO_KEY, self.pairs)
        x0, x1 = self.x

        def body(k: UInt32, x: Int32, y: Int32) -> tuple[UInt32, Int32, Int32]:
            """Write one pair, and step to the next tile of the box, row by row."""
            tile = lib.UInt32(y * columns + x)
            key = (lib.UInt64(tile) << 32) | lib.UInt64(self.gaussian)
            dr.scatter(keys, key, offset + k, True if tiles is None else tiles.may_hit(x, y))
            wrap = x >= x1
            return k + 1, dr.select(wrap, x0, x + 1), dr.select(wrap, y + 1, y)

        start = dr.zeros(lib.UInt32, dr.width(self.gaussian)), lib.Int32(x0), lib.Int32(self.y[0])
        with dr.suspend_grad():  # lists have no derivative
            dr.while_loop(start, lambda k, x, y: k < self.amount, body)
        dr.eval(keys)
        return keys


def check_pairs(pairs: int, what: str) -> None:
    """Refuse lists that are too long for their numbers, or for the memory.

    Args:
        what: The scene and the image, as messages name them.
    """
    advice = "lower extent or image size"
    if pairs >= 2**32:
        raise ValueError(f"render: the tile lists must have fewer than 2^32 entries, got {pairs} {what}; {advice}")
    what = f"{pairs} entries of tile lists {what}"
    memory.require("render", memory.PAIR * pairs, what, advice, runtime.backend().name == "cuda")


def _room(size: int) -> int:
    """Bytes that bands of tiles may hold."""
    if runtime.backend().name != "cuda":
        return size
    whole = memory.of_card()
    return size * (_MAX_GPU_BANDS if whole is None else min(max(whole // _BYTES_PER_BAND, 1), _MAX_GPU_BANDS))


def _area(lib: Lib, x: Sequence[Int32], y: Sequence[Int32]) -> UInt32:
    """Number of tiles between the first and the last column and row."""
    return lib.UInt32((x[1] - x[0] + 1) * (y[1] - y[0] + 1))
