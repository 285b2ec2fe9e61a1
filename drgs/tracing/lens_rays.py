"""The rays of a camera with a lens, as tiles read them, and where on its image a part of the screen is.

A lens only says which ray each pixel has. Everything here is made from that table of rays, those that
`Camera.pixel_directions` gives, not from the lens model: it holds for every model, where its polynomial turns back and
where its inverse is an approximation, too.

A hit (peak.py) is a linear function of the ray's direction around an anchor. Narrow lenses, all of whose rays
are less than `NARROW` off the axis, have pixels of the pinhole camera with the same K: a pixel's ray is a point of
that image, and w = 1. Wide ones have directions d; a Gaussian's anchor is on the side of a cube around the camera that
its mean is seen through, and (x, y, w) are the components of d along that side's axes. Either is kept in two floats, of
which the first is subtracted from the anchor (or from w times it, in one rounding) exactly.

Bounds. Each ray has a guide: a place in the plane, in pixels, that is near its pixel, by a map under which a Gaussian's
box is known (silhouettes.py). A pixel is its guide plus a displacement, which varies slowly: the table of the least and
largest displacement of all rays with guides in a cell, for cells of any size that is a power of two, turns a box of
guides into one of pixels that misses none of the rays.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any

import drjit as dr
import numpy as np

from drgs.cameras import Camera
from drgs.cameras.lenses import LENS_MODELS, Guide
from drgs.tracing import records as layout
from drgs.tracing.arrays import Float, Int32, Lib, Mask, UInt32
from drgs.tracing.pose import local_rays
from drgs.tracing.primitives import Patch, Ray

NARROW = 0.17  # least d_z of the unit directions of a narrow lens: 80 degrees off the axis (cos 80 = 0.17)
_CELL_PIXELS = 4  # pixels, about, across the smallest cells of a table of displacements; chosen
_MAX_CELLS = 1024  # cells in a row of it; chosen: bounds memory
_MAX_TABLE_BYTES = 256 << 20  # bytes of tables that are kept for the next view; chosen
# Guide -> the model and coefficients of the lens under which it is what a direction is seen at.
_GUIDING_LENSES: dict[Guide, tuple[str, tuple[float, ...]]] = {
    "plane": ("pinhole", ()),
    "fisheye": ("opencv_fisheye", (0.0, 0.0, 0.0, 0.0)),
    "panorama": ("equirectangular", ()),
}
_held: OrderedDict[tuple, LensRays] = OrderedDict()
_lock = threading.Lock()


def lens_of(lib: Lib, camera: Camera, tile: int) -> LensRays | None:
    """The rays of a camera's lens, for tiles of so many pixels; None of a pinhole, whose rays need no table.

    Cameras of one lens share a table, wherever they are; the last ones are kept.
    """
    if not camera.is_distorted:
        return None
    key = lib.Float, camera.model, camera.distortion, camera.K.tobytes(), camera.width, camera.height, tile
    with _lock:
        lens = _held.pop(key, None)
    if lens is None:
        lens = LensRays(lib, camera, tile)
    with _lock:
        _held[key] = lens
        while sum(x.size for x in _held.values()) > _MAX_TABLE_BYTES and len(_held) > 1:
            _held.popitem(last=False)
    return lens


class LensRays:
    """The rays of a lens, by pixel and by tile, and its table of displacements.

    To make them takes about half a second a million pixels, once for all cameras of a lens (`lens_of`).

    Args:
        camera: Its pose plays no role.
        tile: Pixels of a tile in a row.
    Attributes:
        guide: What guides are of: pixels of the pinhole camera, the equidistant fisheye, or longitude and latitude.
        wide: Rays are directions, not pixels of a pinhole camera.
        low, high: (2,) least and largest such pixel, of narrow lenses.
        known: (P,) 0 where OpenCV finds no ray for a pixel, but what is no number; None where there is none of these.
        size: Bytes of all tables.
    """

    world = False
    reach = 0.0

    def __init__(self, lib: Lib, camera: Camera, tile: int) -> None:
        self.lib = lib
        self.guide: Guide = LENS_MODELS[camera.model].guide
        self.tiles = -(-camera.width // tile)
        d = local_rays(camera)
        known = _finite(d)
        # What stands for a ray must be a number; `TileTraversal` leaves these out.
        self.known = None if known.all() else lib.UInt32(known.astype(np.uint32))
        self.wide = bool((d[known, 2] < NARROW).any())
        K = camera.K
        values = d if self.wide else pixels_of(K, d[:, :2] / d[:, 2:])
        if not self.wide:
            self.low = np.floor([x[known].min(initial=0.0) for x in values.T])
            self.high = np.floor([x[known].max(initial=0.0) for x in values.T])
        # Pixels and anchors are centers of pixels, whose difference is exact.
        first = values.astype(np.float32) if self.wide else (np.floor(values) + 0.5).astype(np.float32)
        rest = (values - first).astype(np.float32)
        self.columns = [lib.Float(np.ascontiguousarray(x)) for x in (*first.T, *rest.T)]
        self.columns = [dr.select(dr.isfinite(x), x, 0) for x in self.columns]
        boxes = tile_boxes(values.reshape(camera.height, camera.width, -1), tile, not self.wide)
        self.boxes = [lib.Float(np.ascontiguousarray(x)) for x in boxes.T]
        self.set_displacements(camera, guides_of(self.guide, K, d))
        dr.make_opaque(*self.columns, *self.boxes)
        arrays = [*self.columns, *self.boxes, self.cells]
        self.size = 4 * sum(dr.width(x) for x in arrays)

    def set_displacements(self, camera: Camera, guides: np.ndarray) -> None:
        """Make the table of least and largest displacements from guides (P, 2) to pixels."""
        lib = self.lib
        size = np.array([camera.width, camera.height], np.float64)
        image = np.empty((camera.height, camera.width, 2))
        image[..., 0] = np.arange(camera.width) + 0.5
        image[..., 1] = (np.arange(camera.height) + 0.5)[:, None]
        pixels = image.reshape(-1, 2)
        known = _finite(guides)
        if not known.all():
            guides, pixels = guides[known], pixels[known]
        # Rays with guides far from the image are counted to the cells at the edge.
        low = np.maximum([x.min(initial=np.inf) for x in guides.T], -size)
        high = np.minimum([x.max(initial=-np.inf) for x in guides.T], 2 * size)
        span = np.maximum(high - low, 1.0)
        count = np.clip(np.ceil(span / _CELL_PIXELS), 1, _MAX_CELLS).astype(np.int64)
        self.corner = low
        self.per_pixel = count / span
        cell = np.floor((np.clip(guides, low, high) - low) * self.per_pixel).astype(np.int64)
        cell = np.clip(cell, 0, count - 1)
        with np.errstate(over="ignore"):  # beyond float32 a displacement is infinite: no bound
            moved = (pixels - guides).astype(np.float32)
        # float32 rounds: outwards.
        bounds = np.concatenate([np.nextafter(moved, -np.inf), -np.nextafter(moved, np.inf)], 1)
        index = cell[:, 1] * count[0] + cell[:, 0]
        level = np.full((4, count[0] * count[1]), np.inf, np.float32)
        for least, x in zip(level, bounds.T, strict=True):
            np.minimum.at(least, index, x)
        levels = [level.reshape(4, count[1], count[0])]
        while levels[-1][0].size > 1:
            x = levels[-1]
            odd = ((0, 0), (0, x.shape[1] % 2), (0, x.shape[2] % 2))
            x = np.pad(x, odd, constant_values=np.inf)
            x = np.minimum(x[:, ::2], x[:, 1::2])
            levels.append(np.minimum(x[:, :, ::2], x[:, :, 1::2]))
        self.count = count
        self.cells = lib.Float(np.concatenate([x.reshape(4, -1).T.reshape(-1) for x in levels]))
        starts = np.cumsum([0, *(x[0].size for x in levels)])[:-1]
        self.starts = lib.UInt32(starts.astype(np.uint32))
        self.strides = lib.UInt32(np.array([x.shape[2] for x in levels], np.uint32))
        dr.make_opaque(self.cells, self.starts, self.strides)

    def pixels(self, guides: list[Float]) -> list[Float]:
        """Bounds x0, y0, x1, y1 of all pixels that rays with guides within bounds x0, y0, x1, y1 belong to; inverted
        ones where there are none.

        Args:
            guides: (N,) Float64 each; detached.
        """
        lib = self.lib
        at: list[Int32] = []
        for k, x in enumerate(guides):
            axis = k % 2
            corner, scale, most = (
                dr.opaque(lib.Float64, float(v[axis])) for v in (self.corner, self.per_pixel, self.count - 1)
            )
            # As far as the table reaches; a bound that is no number becomes one here, but not in what is returned.
            at.append(lib.Int32(dr.fmax(dr.fmin(dr.floor((x - corner) * scale), most), 0)))
        extent = lib.UInt32(dr.maximum(dr.maximum(at[2] - at[0], at[3] - at[1]), 1))
        # Of the size at which two cells in a row are enough.
        level = 32 - dr.lzcnt(extent - 1)
        level = dr.select(extent > 1, level, 0)
        start, stride = (dr.gather(lib.UInt32, x, level) for x in (self.starts, self.strides))
        least = [lib.Float(dr.inf)] * 4
        for x in (at[0], at[2]):
            for y in (at[1], at[3]):
                cell = start + (lib.UInt32(y) >> level) * stride + (lib.UInt32(x) >> level)
                found = dr.gather(lib.ArrayXf, self.cells, cell, shape=(4, dr.width(cell)))
                least = [dr.minimum(a, b) for a, b in zip(least, found, strict=True)]
        return [
            guides[0] + lib.Float64(least[0]),
            guides[1] + lib.Float64(least[1]),
            guides[2] - lib.Float64(least[2]),
            guides[3] - lib.Float64(least[3]),
        ]

    def ray(
        self, pinhole: list[Float], flat: UInt32, inside: Mask, carried: list[Float], basis: int, shifted: bool
    ) -> Ray:
        """The ray of a pixel."""
        lib = self.lib
        values = [dr.gather(lib.Float, x, flat, inside) for x in self.columns]
        if self.wide:
            # Beyond the image there is no direction, but what follows must be numbers.
            values[2] = dr.select(inside, values[2], 1)
            return Ray(
                length=lib.Float(1), direction=values[:3], low=values[3:], carried=carried, basis=basis, shifted=shifted
            )
        x, y, *low = values
        length = pinhole_length(pinhole, x + low[0], y + low[1])
        return Ray(x, y, length, low=low, carried=carried, basis=basis, shifted=shifted)

    def patch(self, r: list[Float], x: Int32, y: Int32) -> Patch:
        """The rays of tile (x, y), from the anchor of a record."""
        lib = self.lib
        tile = lib.UInt32(y * self.tiles + x)
        box = [dr.gather(lib.Float, b, tile) for b in self.boxes]
        if not self.wide:
            return Patch(box[0] - r[layout.AX], box[1] - r[layout.AY], 1, (box[2], box[3]))
        ax, ay = r[layout.AX], r[layout.AY]
        i, j, w = on_side(r[layout.SIDE], box[:3])
        return Patch(dr.fma(-ax, w, i), dr.fma(-ay, w, j), w, tuple(on_side(r[layout.SIDE], box[3:])), (ax, ay))


def on_side(side: Float, d: list[Any]) -> tuple[Any, Any, Any]:
    """Components of a vector along the axes of a side of the cube: 0, 1, 2 for those that x, y and z are normal to."""
    x, y, z = d
    first, last = side == 0, side == 2
    pick = lambda a, b, c: dr.select(last, a, dr.select(first, b, c))  # noqa: E731
    return pick(x, y, z), pick(y, z, x), pick(z, x, y)


def pinhole_length(pinhole: list[Float], x: Float, y: Float) -> Float:
    """|d| of a pinhole ray of direction d with d_z = 1."""
    fx, skew, cx, fy, cy = pinhole
    v = (y - cy) / fy
    u = (x - cx - skew * v) / fx
    return dr.sqrt(dr.fma(u, u, dr.fma(v, v, 1)))


def guides_of(guide: Guide, K: np.ndarray, d: np.ndarray) -> np.ndarray:
    """(P, 2) guides of directions (P, 3) in camera axes, in pixels."""
    model, coefficients = _GUIDING_LENSES[guide]
    return pixels_of(K, LENS_MODELS[model].project(d, coefficients))


def _finite(values: np.ndarray) -> np.ndarray:
    """(P,) bool: rows of (P, C) whose numbers all are finite; by columns, which is faster than along short rows."""
    return np.logical_and.reduce([np.isfinite(x) for x in values.T])


def pixels_of(K: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """(P, 2) of K times points of a plane."""
    x = K[0, 0] * plane[:, 0] + K[0, 1] * plane[:, 1] + K[0, 2]
    return np.stack([x, K[1, 1] * plane[:, 1] + K[1, 2]], 1)


def tile_boxes(values: np.ndarray, tile: int, centers: bool) -> np.ndarray:
    """(tiles, 2 C) float32 middle of what the pixels of each tile have, and how far it reaches from there.

    Args:
        values: (H, W, C), NaN where there is no ray.
        tile: Pixels in a row.
        centers: Middles are centers of pixels.
    """
    height, width, channels = values.shape
    rows, columns = -(-height // tile), -(-width // tile)
    padded = np.full((rows * tile, columns * tile, channels), np.nan)
    padded[:height, :width] = values
    # Rows first: these are long runs in memory.
    lines = padded.reshape(rows, tile, -1)
    least, most = (
        reduce(reduce(lines, 1).reshape(rows * columns, tile, channels), 1)
        for reduce in (np.fmin.reduce, np.fmax.reduce)
    )
    middle = 0.5 * (least + most)
    middle = (np.floor(middle) + 0.5 if centers else middle).astype(np.float32)
    half = np.nextafter(np.maximum(most - middle, middle - least).astype(np.float32), np.float32(np.inf))
    return np.concatenate([middle, half], 1).astype(np.float32)
