"""HexPlane: features of a place at a time, as the product of six planes, looked up bilinearly.

torch's `grid_sample` has no forward mode, so planes are looked up by gathers. All Gaussians of a view share its time:
the three planes with a time axis are interpolated along it first, to lines, along which each Gaussian is looked up.

Reference:
    Cao & Johnson 2023 (HexPlane); Wu et al. 2024 (4D Gaussian Splatting), section 4.2.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch

SPACE_PAIRS = ((0, 1), (0, 2), (1, 2))  # columns and rows of the planes of space
TIME_AXES = 3  # planes with a time, a column along each axis


class HexPlane(torch.nn.ParameterList):
    """The planes by which `features` gives (N, 3) places at a time (N, L C) features: the product over six planes,
    concatenated over L levels.

    Bilinear, corners on corners, constant outside (`grid_sample(align_corners=True, padding_mode="border")`). The
    derivative by a place or a time is that of the cell above, at a node too: one-sided there, from the right, and from
    the left at the last node.

    Parameters `0` to `6 L - 1`, level by level: the planes (x, y), (x, z), (y, z), shaped (resolution, resolution, C)
    with the second axis first, then (t, x), (t, y), (t, z), shaped (time_resolution, resolution, C). Those of space
    begin uniform in [0.5, 1.5], those of time at 1. 4DGS begins with [0.1, 0.5]: products of three are some 0.03, which
    planes of time can hardly change, and motion is learned late (docs/dynamic-data.md).

    Args:
        channels: C.
        resolutions: Nodes along an axis of space, a number a level.
        time_resolution: Nodes along the time.
        bounds: (2, 3) float64, lowest and highest corner of what the planes of space cover, in world units.
        span: First and last time, which the first and the last node of the planes of time lie at.
    Attributes:
        bounds, span: The arguments, buffers in float64 whatever the parameters are.
    """

    bounds: torch.Tensor
    span: torch.Tensor

    def __init__(
        self,
        channels: int,
        resolutions: Sequence[int],
        time_resolution: int,
        bounds: torch.Tensor,
        span: torch.Tensor,
    ) -> None:
        planes = []
        for r in resolutions:
            planes += [torch.empty(r, r, channels).uniform_(0.5, 1.5) for _ in SPACE_PAIRS]
            planes += [torch.ones(time_resolution, r, channels) for _ in range(TIME_AXES)]
        super().__init__(planes)
        self.register_buffer("bounds", bounds.to(torch.float64))
        self.register_buffer("span", span.to(torch.float64))

    def _apply(self, fn: Callable, recurse: bool = True) -> HexPlane:
        """What `.to(...)` does, but bounds and times stay float64: those of a world far from 0 need the digits."""
        bounds, span = self.bounds, self.span
        super()._apply(fn, recurse)
        self.bounds = bounds.to(self.bounds.device)
        self.span = span.to(self.span.device)
        return self


def levels(planes: Sequence[torch.Tensor]) -> Iterator[tuple[Sequence[torch.Tensor], Sequence[torch.Tensor]]]:
    """The planes of space and those of time of each level."""
    for k in range(0, len(planes), 6):
        yield planes[k : k + 3], planes[k + 3 : k + 6]


def features(planes: Sequence[torch.Tensor], places: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    """Look a HexPlane up.

    Args:
        planes: Planes in the order of `HexPlane`.
        places: (N, 3), 0 at the lower and 1 at the upper bound; beyond them the features of the border.
        time: Scalar, 0 at the first and 1 at the last time.
    Returns:
        (N, L C) of the dtype of the planes, differentiable in both modes by planes, places and time.
    """
    found = []
    for space, times in levels(planes):
        cells = _cells(space[0], places)
        below, part = _between(time, times[0].shape[0], times[0].dtype)
        both = torch.stack([1 - part, part])[:, None, None]
        found += [_bilinear(plane, cells[a], cells[b]) for plane, (a, b) in zip(space, SPACE_PAIRS, strict=True)]
        for plane, (first, s) in zip(times, cells, strict=True):
            line = (plane.narrow(0, int(below), 2) * both).sum(0)
            found.append(_Lookup.apply(line, _ends(first, 1), s[:, None]))
    return product(found)


def product(looked_up: Sequence[torch.Tensor]) -> torch.Tensor:
    """(N, L C) features of what places look up in each plane, (N, C) in the order of `HexPlane`."""
    return torch.cat([functools.reduce(torch.mul, looked_up[k : k + 6]) for k in range(0, len(looked_up), 6)], 1)


@dataclasses.dataclass(frozen=True)
class Corners:
    """Nodes of a plane, and their weights, between which places interpolate.

    Attributes:
        nodes: (N, 4) int64 which of its nodes, row by row.
        weights: (N, 4) by which these are added up.
    """

    nodes: torch.Tensor
    weights: torch.Tensor

    def read(self, plane: torch.Tensor) -> torch.Tensor:
        """(N, C) of the plane."""
        return _bag(plane.flatten(0, 1), self.nodes, self.weights)

    @functools.cached_property
    def _readers(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Nodes that are read; places that read them, node by node, where each node's begin, and their weights."""
        nodes, order = self.nodes.flatten().sort(stable=True)
        used, counts = nodes.unique_consecutive(return_counts=True)
        places = order // self.nodes.shape[1]
        return used, places, counts.cumsum(0) - counts, self.weights.flatten()[order]

    def squares(self, slopes: torch.Tensor) -> torch.Tensor:
        """(U, C) squares of slopes by the U nodes that are read; by all others they are 0.

        Args:
            slopes: (N, C) by what was read.
        """
        _, places, starts, weights = self._readers
        bag = torch.nn.functional.embedding_bag
        return bag(places, slopes, starts, mode="sum", per_sample_weights=weights).square_()

    def spread(self, squares: torch.Tensor, plane: torch.Tensor) -> torch.Tensor:
        """Squares by the nodes that are read, (U, C), in a tensor of the shape of the plane, 0 elsewhere."""
        return torch.zeros_like(plane).flatten(0, 1).index_copy_(0, self._readers[0], squares).view_as(plane)


def corners_of(planes: Sequence[torch.Tensor], places: torch.Tensor, time: torch.Tensor) -> list[Corners]:
    """What `features` reads of each plane; arguments are the same."""
    found = []
    for space, times in levels(planes):
        cells = _cells(space[0], places)
        moment = [x.expand(len(places)) for x in _between(time, times[0].shape[0], times[0].dtype)]
        for plane, (a, b) in zip(space, SPACE_PAIRS, strict=True):
            found.append(_corners(plane, cells[a], cells[b]))
        found += [_corners(plane, cell, moment) for plane, cell in zip(times, cells, strict=True)]
    return [Corners(nodes, _weights(parts)) for nodes, parts in found]


def _cells(plane: torch.Tensor, places: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Along each axis of space the node below each place, and how far it is to the next, in planes like this one."""
    return [_between(places[:, axis], plane.shape[0], plane.dtype) for axis in range(3)]


def _between(x: torch.Tensor, nodes: int, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """The node below and how far it is to the next, of coordinates where 0 is the first node and 1 the last.

    NaN stays NaN in the second, and is a legal index.
    """
    # What lies outside sees the border, and has no derivative by where it is.
    x = x.clamp(0, 1) * (nodes - 1)
    below = x.detach().long().clamp(0, nodes - 2)  # which cell it is has no derivative
    return below, (x - below).to(dtype)


def _ends(first: torch.Tensor, step: int) -> torch.Tensor:
    return torch.stack([first, first + step], -1)


def _bilinear(plane: torch.Tensor, column: Sequence[torch.Tensor], row: Sequence[torch.Tensor]) -> torch.Tensor:
    """(N, C) of cells and parts along the second and the first axis of a plane."""
    return _Lookup.apply(plane.reshape(-1, plane.shape[2]), *_corners(plane, column, row))


def _corners(
    plane: torch.Tensor, column: Sequence[torch.Tensor], row: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """(N, 4) nodes around cells and (N, 2) parts along the second and the first axis of a plane."""
    (a, s) = column
    (b, t) = row
    nodes = _ends(_ends(b * plane.shape[1] + a, 1), plane.shape[1]).flatten(1)
    return nodes, torch.stack([s, t], 1)


class _Lookup(torch.autograd.Function):
    """Linear in each of A axes, without the rows of all corners between: (R, C) rows, (N, 2^A) which of them are the
    corners of a cell, and (N, A) parts of the way through the cell along each axis -> (N, C).
    """

    @staticmethod
    def forward(rows: torch.Tensor, corners: torch.Tensor, parts: torch.Tensor) -> torch.Tensor:
        return _bag(rows, corners, _weights(parts))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, slope: torch.Tensor) -> tuple:  # type: ignore[override]
        rows, corners, parts = ctx.saved_tensors
        by_rows = by_parts = None
        if ctx.needs_input_grad[0]:
            each = slope[:, None] * _weights(parts)[..., None]
            by_rows = torch.zeros_like(rows).index_add_(0, corners.flatten(), each.flatten(0, 1))
        if ctx.needs_input_grad[2]:
            moved = [_bag(rows, corners, _weights(parts, axis)) for axis in range(parts.shape[1])]
            by_parts = torch.stack([(slope * x).sum(1) for x in moved], 1)
        return by_rows, None, by_parts

    @staticmethod
    def jvp(ctx: Any, by_rows: torch.Tensor, _: None, by_parts: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        rows, corners, parts = ctx.saved_tensors
        along = torch.stack([_weights(parts, axis) * by_parts[:, axis, None] for axis in range(parts.shape[1])]).sum(0)
        # Not by `_bag`, which knows no derivative of its own by weights that other modes look at.
        pick = torch.nn.functional.embedding
        return (_weights(parts)[:, None] @ pick(corners, by_rows) + along[:, None] @ pick(corners, rows))[:, 0]


def _bag(rows: torch.Tensor, corners: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.embedding_bag(corners, rows, mode="sum", per_sample_weights=weights)


def _weights(parts: torch.Tensor, derivative: int | None = None) -> torch.Tensor:
    """(N, 2^A) of the corners, or their derivative by one of the parts; as `_ends` orders them."""
    made = torch.ones_like(parts[:, :1])
    for axis in range(parts.shape[1]):
        part = parts[:, axis]
        one = torch.ones_like(part)
        ends = torch.stack([-one, one] if axis == derivative else [1 - part, part], 1)
        made = (made[:, :, None] * ends[:, None]).flatten(1)
    return made
