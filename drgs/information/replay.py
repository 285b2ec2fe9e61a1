"""A view rendered once, to be replayed for the rows of every hit; `ViewContext.replay` is how quantities get it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import torch

from drgs.information.groups import GROUPS, Information
from drgs.information.hits import (
    Hits,
    SumOfFrame,
    Walk,
    gaussian_slopes,
    gaussian_slopes_of_frame,
    moved_records,
    sh_squares,
    summed,
    tangents_of,
)
from drgs.information.jacobian import (
    GEOMETRY,
    BlockSums,
    RemovalSums,
    SeveralSums,
    SquareSums,
    SumsOf,
    VarianceSums,
)
from drgs.tracing.arrays import Float
from drgs.tracing.bridge import to_drjit
from drgs.tracing.call import Call
from drgs.tracing.protocols import Sink
from drgs.tracing.recordings import replay
from drgs.tracing.responses import response_of

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings
    from drgs.tracing.frames import Frame
    from drgs.tracing.primitives import Projected

_OF_GAUSSIANS = ("means", "quats", "log_scales", "logit_opacities", "sh")  # inputs that rows are about
_SEMANTIC_CHANNELS = 16  # semantic channels of one traversal, besides the colors
_FLOAT_MAX = torch.finfo(torch.float32).max
_MAX_WEIGHT = 1e-6 * _FLOAT_MAX  # of a weight, so that what few of them add up to is no inf, which times 0 were NaN


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
        self.mask = None if mask is None else to_drjit(lib, mask.float().reshape(-1).to(call.home)).array
        self.along_ray = settings.sh_direction == "ray"
        self.sh_sums: torch.Tensor | Any = None  # of SH along each ray, once `sums` was called
        self.sh_weights: torch.Tensor | Any = None  # of these, once `sh_pixel_weights` was called
        self.color = geometry and not self.along_ray and call.coefficients > 1  # it depends on the mean
        self.frame: Frame | None = None  # of recorded steps
        if call.is_recorded:
            self.frame = call.frame({name: x.array for name, x in self.inputs.items()}, _OF_GAUSSIANS)
            images = self.frame.images
            self.gaussian_slopes = self._recorded_gaussian_slopes() if geometry else {}
        else:
            self.compositor, arguments = call.prepare(self.inputs)
            with dr.suspend_grad():  # nothing is recorded: what is wanted are the hits of this view
                images = self.compositor.forward(*arguments, keep=True, joint=call.width)
            self.gaussian_slopes = self._gaussian_slopes(self.compositor.traversal.projected) if geometry else {}
        self.opacity = images["alpha"].torch().cpu().reshape(call.shape)  # (H, W)
        self.image = images["rgb"].torch().cpu().reshape(*call.shape, 3)

    def _gaussian_slopes(self, projected: Projected) -> dict:
        """`hits.gaussian_slopes` of Gaussians that were projected into the view."""
        call = self.call
        response = response_of(self.settings)
        moved = None
        if response.by_tangents:
            tangents = {n: [to_drjit(self.lib, x) for x in xs] for n, xs in tangents_of(call.inputs).items()}
            moved = moved_records(self.inputs, tangents, lambda inputs: call.prepare(inputs)[1].record)
        p = {name: x.array for name, x in self.inputs.items()}
        coefficients = 0 if self.along_ray else call.coefficients
        found = gaussian_slopes(self.lib, self.settings, response, p, projected, coefficients, moved)
        dr.eval(found)
        return found

    def _recorded_gaussian_slopes(self) -> dict:
        """The same of the frame."""
        assert self.frame is not None
        tangents = tangents_of(self.call.inputs) if response_of(self.settings).by_tangents else {}
        arrays = {name: [to_drjit(self.lib, x).array for x in xs] for name, xs in tangents.items()}
        return replay(gaussian_slopes_of_frame, self.frame.view, self.frame.given | {"tangents": arrays})

    @functools.cached_property
    def hits(self) -> Hits:
        """The hits of the view."""
        compositor = self.compositor if self.frame is None else self.frame.compositor()
        return Hits(compositor, self.gaussian_slopes.get("extras"), self.color, self.mask)

    def walks(self, weights: Sequence[float]) -> Iterator[Walk]:
        """Each part of each traversal.

        The first has the colors and a slice of the semantic channels. Each other slice has the colors beside it, too,
        for that costs little; there they weigh nothing.
        """
        compositor = self.hits.compositor
        gamma = self.semantics.weight if self.semantics else 0.0
        for number, features in enumerate(self.slices):
            count = 0 if features is None else features.shape[1]
            channels, done = compositor.passes[0], compositor.finals[0]
            if number:
                assert features is not None  # only the first slice may be none at all
                channels, done = compositor.again(to_drjit(self.lib, features.reshape(-1)).array, count)
            own = [*(weights if number == 0 else [0.0] * 3), *[gamma] * count]
            yield from self.hits.walks(channels, done, own, number == 0, 3 + number * _SEMANTIC_CHANNELS)

    def add_up(self, sums: WalkSums) -> None:
        """Add the hits of all walks to sums of them."""
        for walk in self.walks([1.0] * 3):
            sink = sums.sink(self, walk)
            dr.eval(self.hits.run(walk, sink), sink.buffer)

    def _summed(
        self,
        sums_of: Callable[[bool], SumsOf],
        width: int,
        weights: Sequence[float],
        more_sums: Sequence[WalkSums] = (),
    ) -> torch.Tensor:
        """(N, width) float64, where kernels run: what `sums_of(first)` sums up over all walks, `first` or not; their
        hits are added to `more_sums`, too.
        """
        total: torch.Tensor | None = None
        for buffer in self._buffers(sums_of, weights, more_sums):
            # A buffer is float32, which one traversal fills; what several add up to is float64. The first is widest.
            sums = buffer.torch().reshape(self.count, -1)[:, :width].double()
            if total is None:
                total = sums
            else:
                total[:, : sums.shape[1]] += sums
        assert total is not None  # a view has a walk
        return total

    def _buffers(
        self, sums_of: Callable[[bool], SumsOf], weights: Sequence[float], more_sums: Sequence[WalkSums]
    ) -> Iterator[Float]:
        """The buffer of each walk, as of `_summed`."""
        frame = self.frame
        if frame is not None and frame.banded is None and not more_sums:
            what = SumOfFrame(frame.view, tuple(weights), sums_of(True), self.count, self.color)
            optional = {"extras": self.gaussian_slopes.get("extras"), "mask": self.mask}
            arrays = {name: x for name, x in optional.items() if x is not None}
            yield replay(summed, what, arrays | {"seen": frame.seen, "finals": frame.finals})
            return
        for walk in self.walks(weights):
            sink = sums_of(walk.first).sink(self.lib, self.count, walk.weights, walk.part.reduction)
            others = [sums.sink(self, walk) for sums in more_sums]
            rows = self.hits.run(walk, SeveralSums([sink, *others]))
            dr.eval(rows, sink.buffer, [other.buffer for other in others])
            yield sink.buffer

    def sums(
        self,
        entries: Sequence[int],
        weights: Sequence[float],
        channels_first: bool = False,
        more_sums: Sequence[WalkSums] = (),
    ) -> torch.Tensor:
        """(N, 11) float64, where kernels run: squares of the geometry, and sum w^2; those of SH along each ray are kept
        in `sh_sums`. `channels_first`: channels are summed before they are squared.
        """
        bands = self.call.coefficients if self.along_ray and self.gaussian_slopes and GEOMETRY in entries else 0

        def sums_of(first: bool) -> SumsOf:
            own = tuple(k for k in entries if first or k < GEOMETRY)
            return SumsOf(SquareSums, (own, bands if first else 0, channels_first))

        total = self._summed(sums_of, GEOMETRY + 1 + 3 * bands, weights, more_sums)
        self.sh_sums = total[:, GEOMETRY + 1 :].reshape(self.count, bands, 3)
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
            own = sums[:, group.entries[0] : group.entries[-1] + 1].clone(memory_format=torch.contiguous_format)
            result[name] = group.from_sums(own, self, scale).cpu()
            if fisherrf:
                result[name] = result[name] / group.fisherrf(self.call.inputs)
        return result

    def blocks(self, weights: Sequence[float]) -> torch.Tensor:
        """`fisher.blocks` of one view, on the CPU."""
        size = BlockSums.SIZE
        row, column = torch.tril_indices(size, size, device=self.call.home)
        total = self._summed(lambda first: SumsOf(BlockSums), len(row), weights)
        full = torch.zeros(self.count, size, size, dtype=torch.float64, device=self.call.home)
        full[:, row, column] = total
        full[:, column, row] = total
        return full.cpu()

    def removal_errors(self, weights: Sequence[float], power: float) -> torch.Tensor:
        """`fisher.removal_error` of one view, on the CPU."""
        return self._summed(lambda first: SumsOf(RemovalSums, (power,)), 1, weights)[:, 0].cpu()

    def variance(self, information: Information, weights: Sequence[float]) -> torch.Tensor:
        """`fisher.variance_map` of one view, by weights of the groups (`information`) and of the channels."""
        lib = self.lib
        table = torch.zeros(self.count, 16, dtype=torch.float64, device=self.call.home)
        for name, values in information.items():
            group = GROUPS[name]
            assert group.pixel_weights is not None, name  # `variance_map` has refused the others
            squares = group.pixel_weights(values.to(self.call.home, torch.float64), self)
            # Squared weights w^2 are of one color each, then of all other channels.
            first = GEOMETRY + 3 if name == "features" else group.entries[0]
            table[:, first : first + squares.shape[1]] = squares
        buffer = self._weights(table)
        image = dr.zeros(lib.Float, self.call.pixels)
        sh_weights = None if self.sh_weights is None else self._weights(self.sh_weights)
        for walk in self.walks(weights):
            sink = VarianceSums(
                buffer, walk.weights, sh_weights if walk.first else None, walk.first and "features" in information
            )
            for state, at, inside in zip(self.hits.run(walk, sink), walk.part.flat, walk.part.inside, strict=True):
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
            return self.sh_sums * weights
        arrays = {
            "squares": to_drjit(self.lib, squares).array,
            "basis": self.gaussian_slopes["basis"],
            "lit": self.gaussian_slopes["lit"],
        }
        what = self.call.coefficients, tuple(weights.tolist())
        found = sh_squares(what, arrays) if self.frame is None else replay(sh_squares, what, arrays)
        return found.torch().view(self.count, -1, 3)

    @property
    def feature_scale(self) -> float:
        """Factor from sum w^2 to the information about a channel of the features."""
        return 1.0 if self.semantics is None else self.semantics.scale

    def sh_pixel_weights(self, weights: torch.Tensor) -> torch.Tensor:
        """(N, 3) weights of w^2 in each channel, from (N, K, 3) of SH; along rays they stay with the pixel."""
        if self.along_ray:
            self.sh_weights = weights
            return weights.new_zeros(self.count, 3)
        basis, lit = self._squared_basis
        return (basis[:, :, None] * weights).sum(1) * lit

    @property
    def _squared_basis(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, K) squares of the SH basis towards each Gaussian, and (N, 3) 1 where a channel is above 0, or 0."""
        basis, lit = (self.gaussian_slopes[name].torch().reshape(self.count, -1) for name in ("basis", "lit"))
        return basis, lit.double()
