"""Feature images as products of matrices: the weights of a tile's list in its pixels, times the features of the list.

What hits composite is linear in what they are colored with, so that D channels need no D sums along every ray. The
traversal that composites the colors writes the weight w of every entry of a tile's list in every pixel of the tile; of
these W (entries, 64)

    F = W^T f          the feature image in the tile, f (entries, D) the features of the list
    dL/df = W dL/dF    summed over the tiles that list a Gaussian
    s = f (dL/dF)^T    (entries, 64): what the features add to the derivative of the loss by each weight

are dense products, which a processor does at its full speed. The adjoint of the colors reads s, one number a hit,
instead of D features and D cotangents. Weights are held for as many tiles at a time as `MATRIX` bytes have room for;
products take those entries that any pixel of the tile composites, `_PRODUCT_BYTES` bytes of their features at a time.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import torch

from drgs.tracing.arrays import Float, Lib, UInt32

PIXELS = 64  # pixels of a tile, 8 x 8
MATRIX = 128 << 20
"""Bytes of the weights that are held at once; more where the list of a single tile has more."""
_PRODUCT_BYTES = 1 << 20  # bytes of the features of the entries that one product takes: a core's cache; chosen
_GROUPING_SLACK = 8  # tiles of one product: the most entries may be more than the fewest by 1/8, or by as many entries


@dataclasses.dataclass
class _Group:
    """Tiles with about the same number of entries that count: a batch of equal matrices.

    Attributes:
        tiles: (tiles,) their numbers.
        rows: (tiles, entries) rows in the buffer; those left over are the last row, which is 0.
        index: Gaussians, laid out as `rows` are.
        pixels: (tiles 64) row-major pixels, 0 where outside of the image.
        inside: (tiles 64) bool: inside of the image.
    """

    tiles: torch.Tensor
    rows: torch.Tensor
    index: torch.Tensor
    pixels: torch.Tensor
    inside: torch.Tensor

    def slices(self, width: int) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """(rows, Gaussians) of as many entries at a time as there is room for."""
        tiles, entries = self.rows.shape
        step = max(1, _PRODUCT_BYTES // (4 * width * tiles))
        for k in range(0, entries, step):
            yield self.rows[:, k : k + step].reshape(-1), self.index[:, k : k + step].reshape(-1)


class Weights:
    """The weights of some tiles: how they lie in a buffer, and products with them.

    Args:
        index: (entries,) int32, Gaussians of the tiles' lists, one list behind the other.
        lengths: (T,) int64 of the lists.
        pixels: (T, 64) int64: row-major pixel, -1 outside of the image.
    Attributes:
        kept: A buffer that the adjoint may use again, or None.
    """

    def __init__(self, lib: Lib, index: torch.Tensor, lengths: torch.Tensor, pixels: torch.Tensor) -> None:
        self.lib = lib
        self.lengths = lengths
        self.pixels = pixels.clamp_min(0)  # any pixel will do outside, where nothing is added
        self.inside = pixels >= 0
        self.index = torch.cat([index, index.new_zeros(1)])  # of the row that is 0, too
        self.rows = len(index)
        self.kept: Float | None = None
        self._groups: list[_Group] | None = None
        self._width = 0

    def zeros(self) -> Float:
        """A buffer."""
        return dr.zeros(self.lib.Float, (self.rows + 1) * PIXELS)

    def image(self, buffer: Float, features: torch.Tensor, out: torch.Tensor) -> None:
        """Add W^T f to the pixels of `out` (pixels, D); `features` is (N, D)."""
        flat = _matrix(buffer)
        width = features.shape[1]
        for group in self._grouped(width):
            tiles = len(group.rows)
            total = features.new_zeros(tiles, PIXELS, width)
            for rows, index in group.slices(width):
                W, f = flat.index_select(0, rows), features.index_select(0, index)
                torch.baddbmm(total, W.view(tiles, -1, PIXELS).mT, f.view(tiles, -1, width), out=total)
            total = total.view(-1, width)
            if bool(group.inside.all()):
                out.index_add_(0, group.pixels, total)
            else:
                out.index_add_(0, group.pixels[group.inside], total[group.inside])

    def push(self, buffer: Float, moved: list[Float], f: torch.Tensor, df: list[torch.Tensor], out: list) -> None:
        """Add dW^T f + W^T df to the images `out` of tangents, the latter alone without buffers `moved` of dW."""
        for change, image in zip(moved, out, strict=False):
            self.image(change, f, image)
        for slopes, image in zip(df, out, strict=True):
            if bool(slopes.any()):
                self.image(buffer, slopes, image)

    def gradient(
        self, buffer: Float, cotangent: torch.Tensor, out: torch.Tensor, features: torch.Tensor | None
    ) -> tuple[Float, Float] | None:
        """Add W dL/dF to the rows of `out` (N, D); `cotangent` dL/dF is (pixels, D).

        Args:
            features: (N, D), or None: nothing is returned.
        Returns:
            s = f (dL/dF)^T, laid out like the weights, 0 where these are; and (T 64) float64 sums of w s over entries.
        """
        flat = _matrix(buffer)
        width = cotangent.shape[1]
        scalars = None if features is None else _matrix(self.zeros())
        totals = cotangent.new_zeros(len(self.lengths), PIXELS, dtype=torch.float64)
        for group in self._grouped(width):
            g = _gathered(cotangent, group)
            for rows, index in group.slices(width):
                W = flat.index_select(0, rows).view(len(g), -1, PIXELS)
                out.index_add_(0, index, torch.bmm(W, g).view(-1, width))
                if features is None or scalars is None:
                    continue
                s = torch.bmm(features.index_select(0, index).view(len(g), -1, width), g.mT)
                scalars.index_copy_(0, rows, s.view(-1, PIXELS))
                # The adjoint subtracts these products again, hit by hit: what float32 left would be all that remains.
                totals.index_add_(0, group.tiles, W.double().mul_(s).sum(1))
        return None if scalars is None else (self.lib.Float(scalars.view(-1)), self.lib.Float64(totals.view(-1)))

    def survey(self, buffer: Float) -> None:
        """Find out which entries any pixel composites; products need it."""
        self._touched = _matrix(buffer)[:-1].sum(1).nonzero()[:, 0]  # weights are >= 0
        self._groups = None

    def _bounds(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(T,) where each tile's entries begin and end among those that any pixel composites."""
        ends = torch.searchsorted(self._touched, self.lengths.cumsum(0))
        return torch.cat([ends.new_zeros(1), ends[:-1]]), ends

    def _grouped(self, width: int) -> list[_Group]:
        """The tiles in groups, those with most entries first; tiles without any are in none."""
        if self._groups is not None and self._width == width:
            return self._groups
        starts, ends = self._bounds()
        # Stable: how tiles are grouped decides how sums are split, which must not change from run to run.
        counts, tiles = torch.sort(ends - starts, descending=True, stable=True)
        touched = torch.cat([self._touched, self._touched.new_full((1,), self.rows)])
        ascending = counts.flip(0)
        filled = int((counts > 0).sum())
        k = 0
        self._groups = []
        self._width = width
        while k < filled:
            most = int(counts[k])
            fewest = max(most - max(most // _GROUPING_SLACK, _GROUPING_SLACK), 1)
            similar = len(tiles) - int(torch.searchsorted(ascending, fewest)) - k
            count = max(
                min(similar, _PRODUCT_BYTES // (4 * width * max(most, PIXELS))), 1
            )  # rows of features, or of pixels
            own = tiles[k : k + count]
            j = torch.arange(most, device=tiles.device)
            at = torch.where(j < counts[k : k + count, None], starts[own, None] + j, -1)  # -1: the row that is 0
            inside = self.inside[own].view(-1)
            if count == 1:
                # A single product is split between threads, and rounds by their number; one of two is not. The other
                # one is of nothing.
                own = own.expand(2)
                at = torch.cat([at, torch.full_like(at, -1)])
                inside = torch.cat([inside, torch.zeros_like(inside)])
            rows = touched[at]
            index = self.index[rows].long()  # what int32 would take to add is twice the time
            self._groups.append(_Group(own, rows, index, self.pixels[own].view(-1), inside))
            k += count
        return self._groups


def _gathered(cotangent: torch.Tensor, group: _Group) -> torch.Tensor:
    """(tiles, 64, D): the cotangents of a group's pixels, 0 where they do not count."""
    g = cotangent.index_select(0, group.pixels)
    if not bool(group.inside.all()):
        g[~group.inside] = 0
    return g.view(len(group.rows), PIXELS, -1)


def without_graph(method: Callable) -> Callable:
    """A method whose operations of torch are of numbers: no graph records them and no transform of torch sees them."""

    @functools.wraps(method)
    def call(*args: Any, **kwargs: Any) -> Any:
        with torch.no_grad(), torch._C._DisableFuncTorch():
            return method(*args, **kwargs)

    return call


def in_rows(flat: Float, width: int) -> torch.Tensor:
    """A flat array in torch, `width` floats a row."""
    return flat.torch().view(-1, width)


def _matrix(buffer: Float) -> torch.Tensor:
    return in_rows(buffer, PIXELS)


def signed(x: UInt32) -> torch.Tensor:
    """The same bits as int32 in torch, which knows few operations of unsigned integers."""
    return x.torch().view(torch.int32)
