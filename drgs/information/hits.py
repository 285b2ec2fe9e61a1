"""The hits of a rendered view, walked again for the rows of the Jacobian.

What they need of each Gaussian besides its record (`tracing/records.py`), dc/dmu among it, are `gaussian_slopes`.

For a view whose frame is made of recorded steps (`tracing/frames.py`), sums over its hits are such steps, too, each of
which makes its own `Hits` of arrays. Other views are traced each time, by the same functions.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit as dr
import torch

from drgs import runtime
from drgs.information.jacobian import Rows, SumsOf, extras
from drgs.tracing import frames
from drgs.tracing.arrays import Float, Lib
from drgs.tracing.harmonics import sh_basis
from drgs.tracing.hit_table import Table, along_lists
from drgs.tracing.pose import quaternion_product
from drgs.tracing.primitives import Activated
from drgs.tracing.responses import Response

if TYPE_CHECKING:
    from drgs.settings import RenderSettings
    from drgs.tracing.composite import Compositor
    from drgs.tracing.kernels import Channels
    from drgs.tracing.primitives import Projected
    from drgs.tracing.protocols import Sink
    from drgs.tracing.walk import Part

_TABLED_CHANNELS = 4  # channels whose tables are worth their memory


class Walk(NamedTuple):
    """Rays of one traversal, to be walked again.

    Attributes:
        first: Its colors count; further traversals, for more semantic channels, composite them with a weight of 0.
        start: Row of its first semantic channel.
        weights: Weights of its channels: three colors, then semantic channels.
        channels: What it composited.
        part, finals: The rays, and their final states.
        table: What is known of their hits, where final states are not needed.
    """

    first: bool
    start: int
    weights: list[float]
    channels: Channels
    part: Part
    finals: list[dict]
    table: Table | None


class Hits:
    """The hits of a rendered view.

    Attributes:
        compositor: The compositor of the view, after `forward`.
        extras: The buffer of `jacobian.extras`; None: rows know weights only.
        color: Colors depend on the mean.
        mask: (pixels,) what rows are multiplied by; None: nothing.
    """

    def __init__(self, compositor: Compositor, extras: Float | None, color: bool, mask: Float | None) -> None:
        self.lib = compositor.lib
        self.compositor = compositor
        self.extras = extras
        self.color = color
        self.mask = mask

    def walks(
        self,
        channels: Channels,
        done: list[tuple[Part, list[dict]]],
        weights: list[float],
        first: bool = True,
        start: int = 3,
    ) -> Iterator[Walk]:
        """Each part of one traversal.

        Args:
            channels, done: What it composited, and its parts with their final states.
            weights, first, start: As of a `Walk`.
        """
        numbers = channels.outputs if self.extras is not None else 0
        kernel = functools.partial(self._rows, channels)
        tabled = None if numbers > _TABLED_CHANNELS else numbers
        for at in done:
            known = along_lists(self.lib, *at, tabled, kernel)
            yield Walk(first, start, weights, channels, *known)

    def _rows(
        self, channels: Channels, part: Part, finals: list[dict], sink: Sink | Any = None, table: Table | None = None
    ) -> Rows:
        """The kernel for a part."""
        masks = None
        if self.mask is not None:
            masks = [dr.gather(self.lib.Float, self.mask, *at) for at in zip(part.flat, part.inside, strict=True)]
        return Rows(self.compositor.model, channels, self.extras, sink, finals, self.color, masks, table)

    def run(self, walk: Walk, sink: Sink) -> list[dict]:
        """Hand the Jacobian's rows of a part to a sink: final states of its shared rays."""
        return walk.part.run(self._rows(walk.channels, walk.part, walk.finals, sink, walk.table))


# -------------------------------------------------- what hits need of the Gaussians


@runtime.exactly
def gaussian_slopes(
    lib: Lib,
    settings: RenderSettings,
    response: Response,
    inputs: dict,
    projected: Projected,
    coefficients: int,
    moved: list[list[Float]] | None,
) -> dict:
    """What hits and sums need of each Gaussian besides its record, in arrays.

    Args:
        inputs: Flat arrays: raw parameters and `w2c`.
        projected: The Gaussians in the view.
        coefficients: SH coefficients of a Gaussian and channel; 0 where SH are evaluated along each ray.
        moved: As of `jacobian.extras`.
    Returns:
        `extras`, the buffer. Where SH are evaluated towards the mean, `basis`, (N K) float64 squares of the SH basis,
        and `lit`, (N 3), 1 where a channel is not clamped at 0.
    """
    if not coefficients:  # colors depend on the pixel, not on the mean
        return {"extras": extras(lib, response, inputs["logit_opacities"], projected, moved, None)}
    lit, basis, color = _colors(lib, settings, response, inputs, coefficients)
    wide = [lib.Float64(x) for x in basis]
    return {
        "extras": extras(lib, response, inputs["logit_opacities"], projected, moved, color),
        "basis": dr.ravel(lib.ArrayXf64([x * x for x in wide])),
        "lit": dr.ravel(lib.ArrayXf(lit)),
    }


def _colors(
    lib: Lib, settings: RenderSettings, response: Response, inputs: dict, coefficients: int
) -> tuple[list[Float], list[Float], list[list[Float]] | None]:
    """Per channel where the color is not clamped, the SH basis, and (channel, axis) dc/dmu; None for degree 0."""
    K = coefficients
    g = Activated(lib, inputs, inputs["w2c"], settings, response.at_most_alpha)
    d, inverse, basis, rgb = g.color(K)
    coefficient = lambda k, c: lib.Float(g.column("sh", 3 * k + c, 3 * K))  # noqa: E731
    lit = [dr.select(x > 0, lib.Float(1), 0) for x in rgb]
    zero = dr.zeros(lib.Float, dr.width(inputs["logit_opacities"]))
    basis_width = [x + zero for x in basis]
    if K == 1:
        return lit, basis_width, None
    turned = []  # per axis, d basis / d direction
    for axis in range(3):
        along = [lib.Float(x) + 0 for x in d]
        with dr.resume_grad():
            dr.enable_grad(along[axis])
            dr.set_grad(along[axis], 1)
            values = sh_basis(along, K)
            dr.forward_to(values[1:], flags=dr.ADFlag.ClearEdges)
            turned.append([lib.Float(0)] + [dr.grad(x) for x in values[1:]])
    moved = []
    for c in range(3):
        slope = [sum(coefficient(k, c) * turned[axis][k] for k in range(1, K)) for axis in range(3)]
        radial = slope[0] * d[0] + slope[1] * d[1] + slope[2] * d[2]
        moved.append([lit[c] * inverse * (slope[j] - radial * d[j]) for j in range(3)])
    return lit, basis_width, moved


def moved_records(inputs: dict, tangents: dict, record_of: Callable[[dict], list[Float]]) -> list[list[Float]]:
    """Tangents of the records along means, rotations and log-scales, which some responses need.

    Args:
        inputs: What records are made of, by name.
        tangents: Like the inputs, from `tangents_of`.
        record_of: Inputs -> columns of the records.
    """
    moved = []
    for name, each in tangents.items():
        for tangent in each:
            with dr.resume_grad():
                x = type(inputs[name])(inputs[name])
                dr.enable_grad(x)
                dr.set_grad(x, tangent)
                record = record_of(inputs | {name: x})
                dr.forward_to(record, flags=dr.ADFlag.ClearEdges)
                moved.append([dr.detach(dr.grad(r)) for r in record])  # numbers, free of this graph
    return moved


def tangents_of(inputs: dict[str, torch.Tensor]) -> dict[str, list[torch.Tensor]]:
    """For each axis of means, world-frame rotations and log-scales, how the parameters move along it, by name."""
    sizes = inputs["log_scales"]
    sphere = (sizes == sizes[:, :1]).all(1)
    tangents: dict[str, list[torch.Tensor]] = {}
    for name in ("means", "quats", "log_scales"):
        x = inputs[name]
        tangents[name] = []
        for axis in torch.eye(3, dtype=torch.float64, device=x.device):
            along = axis.expand(len(x), 3)
            if name == "quats":
                # A sphere's rotation changes nothing, not even by rounding.
                along = 0.5 * quaternion_product(along, x.double()) * ~sphere[:, None]
            tangents[name].append(along.to(x.dtype))
    return tangents


# -------------------------------------------------- recorded steps: functions of what they depend on, and of arrays


def gaussian_slopes_of_frame(view: frames.View, a: dict) -> dict:
    """`gaussian_slopes` of a frame."""
    response = view.response
    seen = frames.projected(view, a["inputs"], a["pinhole"])
    moved = None
    if response.by_tangents:
        record_of = lambda inputs: frames.projected(view, inputs, a["pinhole"]).record  # noqa: E731
        moved = moved_records(a["inputs"], a["tangents"], record_of)
    given = runtime.dr_types(), view.settings, response, a["inputs"]
    return gaussian_slopes(*given, seen, view.coefficients, moved)


class SumOfFrame(NamedTuple):
    """What a sum over the hits of a frame depends on besides arrays.

    Attributes:
        view: That of the frame.
        weights: Weights of its channels.
        sums: What is summed up.
        gaussians: Number of Gaussians.
        color: Colors depend on the mean.
    """

    view: frames.View
    weights: tuple[float, ...]
    sums: SumsOf
    gaussians: int
    color: bool


def summed(what: SumOfFrame, a: dict) -> Float:
    """The buffer of the sums of a frame."""
    hits = Hits(frames.composited(what.view, a["seen"], a["finals"]), a.get("extras"), what.color, a.get("mask"))
    compositor = hits.compositor
    (walk,) = hits.walks(compositor.passes[0], compositor.finals[0], list(what.weights))
    sink = what.sums.sink(hits.lib, what.gaussians, walk.weights, walk.part.reduction)
    hits.run(walk, sink)
    return sink.buffer


def sh_squares(what: tuple[int, tuple[float, ...]], a: dict) -> Float:
    """(N K 3) float64 squares of the derivatives by SH: those of the basis, times sum w^2 and weights of the channels.

    Args:
        what: K, and the weights.
        a: `squares`, (N,) float64 sum w^2, with `basis` and `lit` of `gaussian_slopes`.
    """
    lib = runtime.dr_types()
    coefficients, weights = what
    squares = a["squares"]
    i = dr.arange(lib.UInt32, dr.width(squares))
    basis = dr.gather(lib.ArrayXf64, a["basis"], i, shape=(coefficients, dr.width(i)))
    lit = dr.gather(lib.ArrayXf, a["lit"], i, shape=(3, dr.width(i)))
    scaled = [squares * lib.Float64(x) * weight for x, weight in zip(lit, weights, strict=True)]
    return dr.ravel(lib.ArrayXf64([x * y for x in basis for y in scaled]))
