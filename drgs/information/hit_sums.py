"""J^T of images by the geometry of some Gaussians, summed up hit by hit in one traversal of the view.

A hit of Gaussian n on pixel p moves channel c there by g_pc s_pj along geometry j of n and, where colors depend on the
mean, by w_p dc_nc / dmu_j (jacobian.py). Along an image u this adds to the slope of j

    s_pj sum_c g_pc u_pc + sum_c w_p dc_nc / dmu_j u_pc

for which the rows of the hit are made once, whatever the number of images. The traversal may be one that is walked for
something else, such as the diagonal: what it does besides is little where few of the Gaussians are wanted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import torch

from drgs.information.jacobian import GEOMETRY, Row
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.bridge import to_drjit
from drgs.tracing.protocols import Sink
from drgs.tracing.records import packed_size
from drgs.tracing.sums import add_row

if TYPE_CHECKING:
    from drgs.information.replay import Replay, Walk

_WIDTH = packed_size(GEOMETRY)  # floats of an image and a Gaussian
_NOWHERE = 0xFFFFFFFF  # place of a Gaussian that is not wanted


class HitSums:
    """J^T of K images by the geometry of some Gaussians.

    Attributes:
        images: (K, pixels, C) float32 cotangents of the rows of a replay: three colors, then semantic channels.
        wanted: (M,) int64, ascending: the Gaussians.
        is_full: The hits of the view have been added.
    """

    def __init__(self, images: torch.Tensor, which: torch.Tensor) -> None:
        """
        Args:
            images: The same as the attribute.
            which: (N,) bool, which Gaussians are wanted.
        """
        self.images = images
        self.wanted = which.nonzero()[:, 0]
        self.is_full = False
        places = torch.full(which.shape, -1, dtype=torch.int32, device=which.device)  # the bits of _NOWHERE
        places[self.wanted] = torch.arange(len(self.wanted), dtype=torch.int32, device=which.device)
        self._places = places
        self._buffer: Float | None = None

    def sink(self, replay: Replay, walk: Walk) -> _Along:
        """The sink for the rows of one walk of a view; its `buffer` is to be evaluated afterwards."""
        lib, home = replay.lib, replay.call.home
        if self._buffer is None:
            self._buffer = dr.zeros(lib.Float, max(1, len(self.images) * len(self.wanted) * _WIDTH))
        first = 0 if walk.first else walk.start
        channels = slice(first, first + (walk.channels.outputs if walk.first else walk.channels.channels))
        images = self.images[..., channels].to(home)
        places = lib.UInt32(lib.Int32(self._places.to(home)))
        self.is_full = True
        return _Along(lib, walk, images, places, self._buffer)

    def geometry(self) -> torch.Tensor:
        """(K, M, 10) slopes by the geometry of the Gaussians that are wanted; rotations in place of quats."""
        K, M = len(self.images), len(self.wanted)
        if self._buffer is None:
            return torch.zeros(K, M, GEOMETRY)
        rows = self._buffer.torch()[: K * M * _WIDTH].reshape(M, K, _WIDTH)
        return rows[..., :GEOMETRY].permute(1, 0, 2)


class _Along(Sink):
    """The sink of one walk.

    Args:
        walk: The walk.
        images: (K, pixels, C) of the channels that it composites and that weigh.
        places: (N,) of each Gaussian in the buffer, `_NOWHERE` where it is not wanted.
        buffer: (M K _WIDTH) added to.
    """

    needs_color = False

    def __init__(self, lib: Lib, walk: Walk, images: torch.Tensor, places: UInt32, buffer: Float) -> None:
        self.walk = walk
        self.places = places
        self.buffer = buffer
        count, pixels, self.width = images.shape
        # Four channels are read at once.
        self.fours = -(-self.width // 4)
        padded = torch.nn.functional.pad(images, (0, 4 * self.fours - self.width))
        self.images = to_drjit(lib, padded.reshape(-1)).array
        # Opaque: another number of either is no other kernel.
        self.count, self.pixels = (dr.opaque(lib.UInt32, x) for x in (count, pixels))

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """Add the rows of a hit, if its Gaussian is wanted, along every image."""
        place = dr.gather(lib.UInt32, self.places, index, hits)
        own = [[row.slopes, row.g[len(row.g) - self.width :], row.color_by_mean or []] for row in rows]
        dr.if_stmt((place, own), hits & (place != _NOWHERE), self._add, lambda place, own: place)
        return states

    def _add(self, place: UInt32, own: list[list]) -> UInt32:
        """Add rows of one Gaussian, slopes, channels' slopes and what its color does of each ray, image by image."""
        lib = self.walk.part.lib

        def body(k: UInt32, place: UInt32, own: list[list]) -> tuple[UInt32, UInt32, list[list]]:
            totals = [lib.Float(0)] * GEOMETRY
            for (slopes, g, color_by_mean), pixel, inside in zip(
                own, self.walk.part.flat, self.walk.part.inside, strict=True
            ):
                at = (k * self.pixels + pixel) * self.fours
                u: list[Float] = []
                for four in range(self.fours):
                    u += list(dr.gather(lib.ArrayXf, self.images, at + four, inside, shape=(4, dr.width(pixel))))
                u = u[: self.width]
                z = sum((x * y for x, y in zip(g, u, strict=True)), lib.Float(0))
                totals = [dr.fma(x, z, total) for x, total in zip(slopes, totals, strict=True)]
                for by_mean, x in zip(color_by_mean if self.walk.first else [], u, strict=False):
                    totals[:3] = [dr.fma(y, x, total) for y, total in zip(by_mean, totals, strict=False)]
            row = place * self.count + k
            add_row(lib, self.buffer, totals, row, _WIDTH, 0, lib.Bool(True), self.walk.part.reduction)
            return k + 1, place, own

        loop = (lib.UInt32(0), place, own)
        return dr.while_loop(loop, lambda k, place, own: k < self.count, body)[1]
