"""Rays of a view that have no camera center in common, as tiles read them: a rolling shutter's, or the caller's own.

Hits are found from records of the world, as on `bvh`, and rays carry their origin and direction, so that derivatives
by the poses of a shutter are torch's, through these rays. Lists of tiles are those of a camera in the middle of all
origins, no farther from any than `reach`, that sees ellipsoids grown by as much (silhouettes.py); which tiles of a
large box a Gaussian may meet is decided from the tile's own bundle of rays.

A bundle is all rays (o + a) + t (d + b) with a and b in boxes around 0. With p the vector from the mean to where the
ray o + t d is nearest to it, at t0, every product of the ray and the Gaussian is n_k . ((p + a + t0 b) x (d + b)), n_k
the rows of the cofactor matrix of W = S^-1 R^T, and

    n . (p x b) <= |n x p| . |b|,   n . ((a + t0 b) x d) <= |d x n| . (|a| + |t0| |b|),   |n| |a + t0 b| |b|

bound what the boxes add to n . (p x d). Of rho^2 = |W p x W d|^2 / |W d|^2 this is a lower bound for all of the bundle.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from drgs.cameras import Camera
from drgs.cameras.lenses import LENS_MODELS
from drgs.tracing import records as layout
from drgs.tracing.arrays import Float, Int32, Lib, Mask, UInt32
from drgs.tracing.lens_rays import NARROW, LensRays, guides_of, tile_boxes
from drgs.tracing.records import cross, dot

_ROUNDING = 4e-7  # of float32, relative, in a difference of two numbers: a few units in the last place


class FreeRays(LensRays):
    """The rays of one view, by tile, and the table of where they are on the image.

    Args:
        camera: Its K and size; guides are its pixels.
        tile: Pixels of a tile in a row.
        origins, directions: (P, 3) in the world of the records; unit directions, NaN where a pixel has no ray.
        pose: (3, 4) from that world to the axes of the camera in the middle, where all bounds are taken.
        holes: (P,) 0 where a pixel has no ray; None if all have one.
    Attributes:
        reach: How far off that camera's center rays start at most.
    """

    world = True

    def __init__(
        self,
        lib: Lib,
        camera: Camera,
        tile: int,
        origins: np.ndarray,
        directions: np.ndarray,
        pose: np.ndarray,
        holes: UInt32 | None,
    ) -> None:
        self.lib = lib
        self.tiles = -(-camera.width // tile)
        self.known = holes
        known = slice(None) if holes is None else np.isfinite(directions[:, 0])
        center = -pose[:, 3] @ pose[:, :3]
        off = origins[known] - center
        self.reach = float(np.sqrt(np.einsum("pk,pk->p", off, off).max(initial=0.0)))
        # Not `@` for all pixels: the threads of NumPy's BLAS spin on the cores that render next.
        local = np.einsum("pk,jk->pj", directions, pose[:, :3])
        self.wide = bool((local[known, 2] < NARROW).any())
        self.guide = LENS_MODELS[camera.model].guide if self.wide else "plane"
        if self.wide and self.guide == "plane":
            self.guide = "fisheye"
        shape = camera.height, camera.width, 6
        boxes = tile_boxes(np.concatenate([origins, directions], 1).reshape(shape), tile, False)
        # A tile without any ray meets nothing, whatever its box: its pixels are left out.
        self.boxes = [lib.Float(np.ascontiguousarray(np.nan_to_num(x))) for x in boxes.T]
        self.set_displacements(camera, guides_of(self.guide, camera.K, local))
        dr.make_opaque(*self.boxes)

    def may_meet(self, r: list[Float], x: Int32, y: Int32, limit: Float) -> Mask:
        """False only where no ray of tile (x, y) has rho^2 <= limit for the world record r."""
        tile = self.lib.UInt32(y * self.tiles + x)
        box = [dr.gather(self.lib.Float, b, tile) for b in self.boxes]
        o, d, spread_o, spread_d = box[:3], box[3:6], box[6:9], box[9:]
        rows = [r[layout.W_ROWS + 3 * k : layout.W_ROWS + 3 * k + 3] for k in range(3)]
        to = [r[layout.W_MEAN + k] - o[k] for k in range(3)]
        t0 = dot(to, d) / dr.maximum(dot(d, d), 1e-20)
        p = [dr.fma(t0, d[k], -to[k]) for k in range(3)]
        rounded = _ROUNDING * (abs(to[0]) + abs(to[1]) + abs(to[2]) + abs(o[0]) + abs(o[1]) + abs(o[2]))
        spread_a = [dr.fma(abs(t0), b, a) + rounded for a, b in zip(spread_o, spread_d, strict=True)]
        both = dr.sqrt(dot(spread_a, spread_a) * dot(spread_d, spread_d))
        least = self.lib.Float(0)
        most = self.lib.Float(0)
        for k in range(3):
            n = [r[layout.W_COFACTOR + k] * x for x in rows[k]]
            c = cross(d, n)  # n . (p x d) = p . (d x n)
            e = cross(n, p)
            middle = dot(p, c)
            off = dot([abs(v) for v in c], spread_a) + dot([abs(v) for v in e], spread_d)
            off += dr.sqrt(dot(n, n)) * both
            rounding = _ROUNDING * dot([abs(v) for v in p], [abs(v) for v in c])
            least = dr.fma(q := dr.maximum(abs(middle) - off - rounding, 0), q, least)
            w = [r[layout.W_INVERSE + k] * x for x in rows[k]]
            along = abs(dot(w, d)) + dot([abs(v) for v in w], spread_d)
            most = dr.fma(along, along, most)
        # 1.0001 is more than float32 rounds.
        return ~(least > 1.0001 * limit * most)
