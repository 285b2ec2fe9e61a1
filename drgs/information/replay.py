"""A view rendered once, to be replayed for the rows of every hit; `ViewContext.replay` is how quantities get it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import drjit as dr
import torch

from drgs import runtime
from drgs.information.groups import GROUPS, Information
from drgs.information.jacobian import (
    GEOMETRY,
    BlockSums,
    RemovalSums,
    Rows,
    SeveralSums,
    SquareSums,
    VarianceSums,
    extras,
)
from drgs.tracing.arrays import Float
from drgs.tracing.bridge import to_drjit
from drgs.tracing.call import Call
from drgs.tracing.harmonics import sh_basis
from drgs.tracing.hit_table import Table, along_lists
from drgs.tracing.pose import quaternion_product
from drgs.tracing.primitives import Activated
from drgs.tracing.protocols import Sink

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings
    from drgs.tracing.kernels import Channels
    from drgs.tracing.walk import Part

_TABLED_CHANNELS = 4  # channels whose tables are worth their memory
_SEMANTIC_CHANNELS = 16  # semantic channels of one traversal, besides the colors
_FLOAT_MAX = torch.finfo(torch.float32).max
_MAX_WEIGHT = 1e-6 * _FLOAT_MAX  # of a weight, so that what few of them add up to is no inf, which times 0 were NaN


class Walk(NamedTuple):
    """Rays of one traversal, to be walked again.

    Attributes:
        first: It is the traversal whose colors weigh.
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


class WalkSink(Sink, Protocol):
    """The sink of one walk.

    Attributes:
        buffer: What it scatters into.
    """

    buffer: Float


class WalkSums(Protocol):
    """Sums over the hits of a view, to which each of its walks adds."""

    def sink(self, replay: Replay, walk: Walk) -> WalkSink:
        """The sink that adds up the hits of a walk of the view."""


class Replay:
    """A view rendered once, to be replayed for information."""

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        settings: RenderSettings,
        geometry: bool = True,
        semantics: SemanticMetric | None = None,
        mask: torch.Tensor | None = None,
    ) -> None:
        """
        Args:
            mask: (H, W) what the image is multiplied by before it is compared; None: 1.
        """
        # Without a graph of torch: information is a number, and its derivatives are taken here.
        slices: list[torch.Tensor | None] = [None]
        if semantics is not None and geometry:
            assert gaussians.features is not None  # `SemanticMetric.check` has refused it
            channels = semantics.channels(gaussians.features)
            slices = list(channels.split(_SEMANTIC_CHANNELS, 1)) if channels.shape[1] else slices
        self.semantics = semantics
        self.slices = slices
        seen = gaussians.detach().replace(features=slices[0])
        self.call = call = Call(seen, camera, settings, frozenset())
        self.lib = call.lib
        self.settings = settings
        self.count = len(gaussians)
        lib = self.lib
        self.inputs = {name: to_drjit(lib, x) for name, x in call.inputs.items()}
        self.compositor, arguments = call.prepare(self.inputs)
        with dr.suspend_grad():  # nothing is recorded: what is wanted are the hits of this view
            images = self.compositor.forward(*arguments, keep=True, joint=call.width)
        self.opacity = images["alpha"].torch().cpu().reshape(call.shape)  # (H, W)
        self.image = images["rgb"].torch().cpu().reshape(*call.shape, 3)
        p = {name: x.array for name, x in self.inputs.items()}
        self.mask = None if mask is None else to_drjit(lib, mask.float().reshape(-1).to(call.home)).array
        self.along_ray = settings.sh_direction == "ray"
        self.color = False
        self.extras = None
        self.moved_color: list[list[Float]] | None = None  # (channel, axis) dc/dmu, where colors depend on the mean
        self.light: torch.Tensor | Any = None  # of SH along each ray, once `sums` or `sh_spread` was called
        if not geometry:
            return
        if not self.along_ray:  # there colors do not depend on the mean, but on the pixel
            self.lit, self.basis, self.moved_color = self._colors(p)
            dr.eval(self.lit, self.basis)
        self.color = self.moved_color is not None
        self.extras = extras(
            lib,
            self.compositor.model.response,
            p["logit_opacities"],
            self.compositor.traversal.projected,
            self._moved_records(),
            self.moved_color,
        )
        dr.eval(self.extras)

    @runtime.exactly
    def _colors(self, p: dict) -> tuple[list[Float], list[Float], list[list[Float]] | None]:
        """Per channel where the color is not clamped, the SH basis, and dc/dmu (None for degree 0)."""
        lib, K = self.lib, self.call.coefficients
        response = self.compositor.model.response
        g = Activated(lib, p, p["w2c"], self.settings, response.at_most_alpha)
        d, inverse, basis, rgb = g.color(K)
        coefficient = lambda k, c: lib.Float(g.column("sh", 3 * k + c, 3 * K))  # noqa: E731
        lit = [dr.select(x > 0, lib.Float(1), 0) for x in rgb]
        zero = dr.zeros(lib.Float, self.count)
        basis_width = [x + zero for x in basis]
        if K == 1:
            return lit, basis_width, None
        turned = []  # per axis, d basis / d direction
        for axis in range(3):
            along = [lib.Float(x) + 0 for x in d]
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

    def _moved_records(self) -> list[list[Float]] | None:
        """Tangents of the records along means, rotations and log-scales, for a response that needs them."""
        if not self.compositor.model.response.by_tangents:
            return None
        lib = self.lib
        call = self.call
        inputs = self.inputs
        moved = []
        axes = [("means", _unit(k)) for k in range(3)] + [("quats", _unit(k)) for k in range(3)]
        sizes = call.inputs["log_scales"]
        sphere = (sizes == sizes[:, :1]).all(1)
        for name, axis in [*axes, *(("log_scales", _unit(k)) for k in range(3))]:
            x = call.inputs[name]
            tangent = torch.tensor(axis, dtype=torch.float64, device=x.device).expand(self.count, 3)
            if name == "quats":
                # A sphere's rotation changes nothing, not even by rounding.
                tangent = 0.5 * quaternion_product(tangent, x.double()) * ~sphere[:, None]
            dr.enable_grad(inputs[name])
            dr.set_grad(inputs[name], to_drjit(lib, tangent.to(x.dtype)))
            _, arguments = call.prepare(inputs)
            record = arguments.record
            dr.forward_to(record, flags=dr.ADFlag.ClearEdges)
            moved.append([dr.detach(dr.grad(r)) for r in record])  # numbers, free of this graph
            dr.disable_grad(inputs[name])
        return moved

    def walks(self, weights: Sequence[float]) -> Iterator[Walk]:
        """Each part of each traversal.

        The first has the colors and a slice of the semantic channels. Each other slice has the colors beside it, too,
        for that costs little; there they weigh nothing.
        """
        compositor = self.compositor
        gamma = self.semantics.weight if self.semantics else 0.0
        for number, features in enumerate(self.slices):
            count = 0 if features is None else features.shape[1]
            channels, done = compositor.passes[0], compositor.finals[0]
            if number:
                assert features is not None  # only the first slice may be none at all
                channels, done = compositor.again(to_drjit(self.lib, features.reshape(-1)).array, count)
            numbers = channels.outputs if self.extras is not None else 0
            kernel = functools.partial(self._rows, channels)
            tabled = None if numbers > _TABLED_CHANNELS else numbers
            own = [*(weights if number == 0 else [0.0] * 3), *[gamma] * count]
            for at in done:
                known = along_lists(self.lib, *at, tabled, kernel)
                yield Walk(number == 0, 3 + number * _SEMANTIC_CHANNELS, own, channels, *known)

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

    def add_up(self, sums: WalkSums) -> None:
        """Add the hits of all walks to sums of them."""
        for walk in self.walks([1.0] * 3):
            sink = sums.sink(self, walk)
            dr.eval(self.run(walk, sink), sink.buffer)

    def _summed(
        self,
        sink_of: Callable[[Walk, dr.ReduceMode], SquareSums | BlockSums | RemovalSums],
        width: int,
        weights: Sequence[float],
        more_sums: Sequence[WalkSums] = (),
    ) -> torch.Tensor:
        """(N, width) float64, where kernels run: what `sink_of(walk, reduce mode)` sums up in its `buffer`, over all
        walks; their hits are added to `more_sums`, too.
        """
        total = torch.zeros(self.count, width, dtype=torch.float64, device=self.call.home)
        for walk in self.walks(weights):
            sink = sink_of(walk, walk.part.reduction)
            others = [sums.sink(self, walk) for sums in more_sums]
            # A buffer is float32, which one traversal fills; what several add up to is float64.
            dr.eval(self.run(walk, SeveralSums([sink, *others])), sink.buffer, [other.buffer for other in others])
            sums = sink.buffer.torch().double().reshape(self.count, -1)[:, :width]
            total[:, : sums.shape[1]] += sums
        return total

    def sums(
        self, entries: Sequence[int], weights: Sequence[float], summed: bool = False, more_sums: Sequence[WalkSums] = ()
    ) -> torch.Tensor:
        """(N, 11) float64, where kernels run: squares of the geometry, and sum w^2; those of SH along each ray are kept
        in `light`.
        """
        bands = self.call.coefficients if self.along_ray and self.extras is not None and GEOMETRY in entries else 0

        def sink_of(walk: Walk, mode: dr.ReduceMode) -> SquareSums:
            own = entries if walk.first else [k for k in entries if k < GEOMETRY]
            return SquareSums(self.lib, self.count, walk.weights, own, mode, bands if walk.first else 0, summed)

        total = self._summed(sink_of, GEOMETRY + 1 + 3 * bands, weights, more_sums)
        self.light = total[:, GEOMETRY + 1 :].reshape(self.count, bands, 3)
        return total[:, : GEOMETRY + 1]

    def diagonal(
        self, groups: dict, weights: Sequence[float], fisherrf: bool, more_sums: Sequence[WalkSums] = ()
    ) -> Information:
        """`fisher.diagonal` of one view, on the CPU; its hits are added to `more_sums`, too."""
        entries = sorted({k for group in groups.values() for k in group.entries})
        sums = self.sums(entries, weights, fisherrf, more_sums)
        result = {}
        scale = torch.tensor([1.0] * 3 if fisherrf else weights, dtype=torch.float64, device=self.call.home)
        for name, group in groups.items():
            # On a card all sums are made there: the CPU would take many times as long as the kernels.
            result[name] = group.collect(sums[:, group.entries], self, scale).cpu()
            if fisherrf:
                result[name] = result[name] / group.fisherrf(self.call.inputs)
        return result

    def blocks(self, weights: Sequence[float]) -> torch.Tensor:
        """`fisher.blocks` of one view, on the CPU."""
        lib, size = self.lib, BlockSums.SIZE
        sink_of = lambda walk, mode: BlockSums(lib, self.count, walk.weights, mode)  # noqa: E731
        row, column = torch.tril_indices(size, size, device=self.call.home)
        total = self._summed(sink_of, len(row), weights)
        full = torch.zeros(self.count, size, size, dtype=torch.float64, device=self.call.home)
        full[:, row, column] = total
        full[:, column, row] = total
        return full.cpu()

    def removal_errors(self, weights: Sequence[float], power: float) -> torch.Tensor:
        """`fisher.removal_error` of one view, on the CPU."""
        sink_of = lambda walk, mode: RemovalSums(self.lib, self.count, walk.weights, power, mode)  # noqa: E731
        return self._summed(sink_of, 1, weights)[:, 0].cpu()

    def variance(self, information: Information, weights: Sequence[float]) -> torch.Tensor:
        """`fisher.variance_map` of one view, by weights of the groups (`information`) and of the channels."""
        lib = self.lib
        table = torch.zeros(self.count, 16, dtype=torch.float64, device=self.call.home)
        for name, values in information.items():
            group = GROUPS[name]
            assert group.spread is not None, name  # `variance_map` has refused the others
            spread = group.spread(values.to(self.call.home, torch.float64), self)
            # Squared weights w^2 are of one color each, then of all other channels.
            first = GEOMETRY + 3 if name == "features" else group.entries[0]
            table[:, first : first + spread.shape[1]] = spread
        buffer = self._weights(table)
        image = dr.zeros(lib.Float, self.call.pixels)
        light = None if self.light is None else self._weights(self.light)
        for walk in self.walks(weights):
            sink = VarianceSums(
                buffer, walk.weights, light if walk.first else None, walk.first and "features" in information
            )
            for state, at, inside in zip(self.run(walk, sink), walk.part.flat, walk.part.inside, strict=True):
                dr.scatter_add(image, state["variance"], at, inside)
            dr.eval(image)
        # Sums of weights that lambda = 0 makes huge may be inf, which a picture's scale could not hold.
        return image.torch().cpu().clamp_max(_FLOAT_MAX).reshape(self.call.shape)

    def _weights(self, weights: torch.Tensor) -> Float:
        """Weights of `variance` on the device."""
        if not torch.isfinite(weights).all():
            raise ValueError("fisher.variance_map: weights must be finite, got NaN or Inf; raise lambda above 0")
        return to_drjit(self.lib, weights.clamp_max(_MAX_WEIGHT).float().reshape(-1).to(self.call.home)).array

    def sh_information(self, squares: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """(N, K, 3) squares of the derivatives by SH, from (N, 1) sum w^2, times (3,) weights; call after `sums`."""
        if self.along_ray:
            return self.light * weights
        seen = squares[:, 0].nonzero()[:, 0]
        if 2 * len(seen) > self.count:  # to copy them to where they belong takes longer than zeros of the others
            seen = torch.arange(self.count, device=squares.device)
        basis, lit = self._squared_basis(seen)
        information = basis[:, :, None] * (squares[seen] * lit * weights)[:, None, :]
        if len(seen) == self.count:
            return information
        return information.new_zeros(self.count, *information.shape[1:]).index_copy_(0, seen, information)

    @property
    def feature_scale(self) -> float:
        """Factor from sum w^2 to the information about a channel of the features."""
        return 1.0 if self.semantics is None else self.semantics.scale

    def sh_spread(self, weights: torch.Tensor) -> torch.Tensor:
        """(N, 3) weights of w^2 in each channel, from (N, K, 3) of SH; along rays they stay with the pixel."""
        if self.along_ray:
            self.light = weights
            return weights.new_zeros(self.count, 3)
        basis, lit = self._squared_basis(torch.arange(self.count, device=weights.device))
        return (basis[:, :, None] * weights).sum(1) * lit

    def _squared_basis(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Of n Gaussians (n, K) squares of the SH basis towards them, and (n, 3) 1 where a channel is above 0, or 0."""
        chosen = lambda x: x.torch()[rows]  # noqa: E731
        basis, lit = (torch.stack([chosen(x) for x in xs], 1).double() for xs in (self.basis, self.lit))
        return basis.square_(), lit


def _unit(k: int) -> list[float]:
    return [float(j == k) for j in range(3)]
