"""Features of Gaussians and their decoder, fitted to the maps of a teacher beside the colors, as Feature 3DGS does.

The features of a Gaussian begin at 0, the decoder as torch makes it: where all features are 0 the decoder's weights
have no gradient yet, but its bias and the features have, and once these have moved the weights follow.

What is outside a mask has no say, of whichever kind the mask is: a teacher has features for the surroundings of an
object, too, and where nothing is drawn the decoder could answer them by its bias alone.

Reference:
    [1] Zhou et al., "Feature 3DGS: Supercharging 3D Gaussian Splatting to Enable Distilled Feature Fields", CVPR 2024;
        orders and rates as in its code.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from drgs.features.decoder import Decoder
from drgs.fitting.networks import Network
from drgs.integrator import render

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians
    from drgs.fitting.config import FeatureSize, FitConfig
    from drgs.fitting.frames import Frame
    from drgs.integrator import Output
    from drgs.settings import RenderSettings

__all__ = ["FeatureDistance", "features_of"]

_INSIDE = 0.5  # share of a cell of the teacher's map that the mask must keep
_CHUNK = 1 << 22  # decoded numbers at a time: 16 MB, where a map of 512x360x480 has 354 MB


@dataclasses.dataclass(frozen=True)
class FeatureDistance:
    """gamma times the mean L1 distance between decoded features and the teacher's map, over channels and cells.

    Attributes:
        decoder: Map from the Gaussians' features to the teacher's.
        weight: gamma.
        settings: Settings that the colors are rendered with.
        size: `image`: of the features in `output`, reduced to the size of the map bilinearly, corners on corners, as in
            [1]; it mixes the 2 x 2 pixels around each cell's place, hence before the decoder, which is linear and mixes
            channels: the same numbers from fewer products. `teacher`: a ray through the middle of each cell.
        couple: Whether gradients reach the geometry where features are rendered here.
    """

    decoder: Decoder
    weight: float
    settings: RenderSettings
    size: FeatureSize
    couple: bool
    name: ClassVar[str] = "features"
    outputs: ClassVar[tuple[str, ...]] = ()

    def is_shown(self, frame: Frame) -> bool:
        """Whether the features are to be rendered with the colors of a photograph."""
        return frame.teacher is not None and self.size == "image"

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`; None without a map, and where the mask keeps nothing of it."""
        if frame.teacher is None:
            return None
        target = frame.teacher()
        channels, height, width = target.shape
        if channels != self.decoder.channels:
            raise ValueError(
                f"view {frame.name!r}: the teacher's map must have {self.decoder.channels} channels as the others, got "
                f"{channels}; make it again"
            )
        shown = self._shown(output, frame, gaussians, width, height).reshape(height * width, -1)
        cells = target.reshape(channels, height * width)
        if frame.mask is not None:
            kept = torch.nn.functional.interpolate(frame.mask[None, None], (height, width), mode="area").flatten()
            kept = kept > _INSIDE
            if not bool(kept.any()):
                return None
            shown = shown[kept]
            cells = cells[:, kept]
        return self.weight * _Distance.apply(shown, self.decoder.matrix, self.decoder.bias, cells)

    def _shown(self, output: Output, frame: Frame, gaussians: Gaussians, width: int, height: int) -> torch.Tensor:
        """(h, w, D) features at the size of the teacher's map."""
        if self.size == "image":
            assert output.features is not None  # `is_shown` asked for them
            planes = output.features.permute(2, 0, 1)[None]  # as it lies, channels last
            small = torch.nn.functional.interpolate(planes, (height, width), mode="bilinear", align_corners=True)
            return small[0].permute(1, 2, 0)
        # Constants but for the features: what an uncoupled derivative needs not compute.
        seen = gaussians if self.couple else gaussians.detach().replace(features=gaussians.features)
        camera = frame.camera.resized(width, height)
        shown = render(seen, camera, self.settings, outputs=(), couple_features=self.couple).features
        assert shown is not None
        return shown


class _Distance(torch.autograd.Function):
    """Mean |W f + b - t|, with its gradients, some cells at a time: nothing as large as a map is held.

    Args:
        features: (n, D).
        matrix, bias: W (C, D) and b (C,).
        cells: (C, n) t, of any floating type; gets no gradient.
    """

    @staticmethod
    def forward(
        ctx: Any, features: torch.Tensor, matrix: torch.Tensor, bias: torch.Tensor, cells: torch.Tensor
    ) -> torch.Tensor:
        """The loss is a number, so that its gradients are known with it, up to a factor."""
        total = 0.0
        step = max(1, _CHUNK // len(matrix))
        slopes = torch.empty_like(features), torch.zeros_like(matrix), torch.zeros_like(bias)
        for k in range(0, len(features), step):
            f = features[k : k + step]
            error = torch.addmm(bias, f, matrix.T).sub_(cells[:, k : k + step].T)
            total += float(error.abs().sum())
            sign = error.sign_()
            torch.mm(sign, matrix, out=slopes[0][k : k + step])
            slopes[1].addmm_(sign.T, f)
            slopes[2].add_(sign.sum(0))
        ctx.save_for_backward(*(x.div_(cells.numel()) for x in slopes))
        return features.new_tensor(total / cells.numel())

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Of everything but the map."""
        return (*(grad * x for x in ctx.saved_tensors), None)


def features_of(config: FitConfig, channels: int) -> tuple[FeatureDistance, Network]:
    """The term and the decoder of a fit to `channels` of a teacher.

    The decoder's first weights are those of torch, drawn by the config's seed; torch's own generator stays as it was.
    """
    wanted = config.features
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        decoder = Decoder(wanted.feature_width, channels)
    term = FeatureDistance(
        decoder, wanted.feature_weight, config.settings, wanted.feature_resolution, wanted.couple_features
    )
    return term, Network("decoder", decoder, wanted.decoder_rate)
