"""The loss of a step: a list of terms, among them L1 and structural similarity, cheap enough for two CPU cores.

SSIM is the training variant of 3DGS: 11x11 Gaussian window with sigma 1.5, zero padding, one value per pixel and
channel, mean over all of them. `drgs.fitting.metrics` also reports the variant without padding that papers print.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import torch

from drgs.data.camera_layout import REFERENCE_EXTENT

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians
    from drgs.fitting.config import FitConfig
    from drgs.fitting.frames import Frame
    from drgs.integrator import Output

# As Wang et al. have them: a Gaussian window of 11x11 pixels, and (K1 L)^2, (K2 L)^2 with L = 1 the range of values.
_RADIUS = 5  # pixels
_SIGMA = 1.5  # pixels
_C1 = 0.01**2
_C2 = 0.03**2


class LossTerm(Protocol):
    """A term of the loss. `terms_of` lists those of a fit; a new one is a class like those below."""

    @property
    def name(self) -> str:
        """Unique name of the term within the fit; a plain attribute will do."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """What it needs of `drgs.render` besides rgb, alpha and features; a plain attribute will do."""

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """The term for one view.

        Args:
            output: What `drgs.render` shows of `gaussians`.
            frame: The photograph, at the size of the picture, which may be smaller at first (resolution.py).
            gaussians: Gaussians at this step and at the time of the view; gradients reach what is fitted.
        Returns:
            A scalar with the term's weight in it, or None where the term has nothing to say about this view.
        """


def terms_of(config: FitConfig, extent: float, far: int = 0) -> list[LossTerm]:
    """The terms that every fit has, in the order in which they are added up.

    Args:
        config: Configuration of the fit.
        extent: Extent of the scene, its unit of length.
        far: How many of the first Gaussians are far away, and left out of means over all.
    """
    terms: list[LossTerm] = [Photometric(config.loss.ssim_weight)]
    if config.loss.outside_weight:
        terms.append(Outside(config.loss.outside_weight))
    if config.loss.opacity_weight:
        terms.append(Opacity(config.loss.opacity_weight, far))
    if config.loss.scale_weight:
        terms.append(Scale(config.loss.scale_weight, extent, far))
    return terms


@dataclasses.dataclass(frozen=True)
class Photometric:
    """(1 - w) L1 + w (1 - SSIM), a mean over all pixels; both images are black outside the mask, if there is one.

    Where the photograph shows what no other does, both images are the rendering, without a gradient.
    """

    ssim_weight: float
    name: ClassVar[str] = "photometric"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor:
        """See `LossTerm`."""
        rgb = output.rgb
        target = frame.target()
        if frame.mask is not None:
            rgb = rgb * frame.mask[..., None]
        if frame.transient is not None:
            here = frame.transient[..., None]
            shown = rgb.detach()  # nothing is learned of these pixels; windows of SSIM at their border see no edge
            rgb = torch.where(here, shown, rgb)
            target = torch.where(here, shown, target)
        loss = (1 - self.ssim_weight) * (rgb - target).abs().mean()
        return loss + self.ssim_weight * (1 - padded_ssim(rgb, target)) if self.ssim_weight else loss


@dataclasses.dataclass(frozen=True)
class Outside:
    """Opacity where a photograph says that nothing is: outside the mask of an object, or by its own alpha channel.

    A mask of valid pixels leaves what is outside free. Without this term what is as dark as the background may be
    anywhere in front of it.
    """

    weight: float
    name: ClassVar[str] = "outside"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`."""
        empty = frame.empty()
        return None if empty is None else self.weight * (empty * output.alpha).mean()


@dataclasses.dataclass(frozen=True)
class Opacity:
    """Opacity of all Gaussians: those that no photograph needs become transparent, and density control moves them.

    `far`: how many of the first are far away (a skybox), and left out of the mean.
    """

    weight: float
    far: int = 0
    name: ClassVar[str] = "opacity"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor:
        """See `LossTerm`."""
        return self.weight * gaussians.opacities[self.far :].mean()


@dataclasses.dataclass(frozen=True)
class Scale:
    """Scales of all Gaussians, in units of the scene's extent: those that no photograph needs shrink.

    `far`: how many of the first are far away (a skybox), and left out of the mean.
    """

    weight: float
    extent: float
    far: int = 0
    name: ClassVar[str] = "scale"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor:
        """See `LossTerm`."""
        # The weight of MCMC's authors has a length in it.
        return self.weight * gaussians.scales[self.far :].mean() * (REFERENCE_EXTENT / self.extent)


def psnr_of(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared error of values in [0, 1]."""
    return -10 * math.log10(max(mse, 1e-10))  # equal images have 100 dB, which averages can take


def psnr(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB, as `drgs.fitting.metrics.DEFINITIONS` says.

    Args:
        image, target: (H, W, 3) in [0, 1].
        mask: (H, W) weights in [0, 1], or None.
    """
    error = (image.double() - target.double()).square().mean(2)
    if mask is not None:
        if not bool((mask > 0).any()):
            raise ValueError("psnr: the mask must keep at least one pixel, keeps none; drop this view")
        mse = float((error * mask).sum() / mask.double().sum())
    else:
        mse = float(error.mean())
    return psnr_of(mse)


def padded_ssim(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean structural similarity, 11x11 window, sigma 1.5, zero-padded, data range 1.

    Args:
        image: (H, W, C).
        target: (H, W, C), gets no gradient.
    Returns:
        A scalar of at most 1.
    Gradients:
        w.r.t. `image`, by hand: autograd through the blurs would keep 15 blurred maps and take twice as long.
    Reference:
        Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity", TIP 2004.
    """
    planes = image.permute(2, 0, 1)
    return _Ssim.apply(planes, target.permute(2, 0, 1).contiguous())


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """(H, W, C) structural similarity of each window, centered at each pixel; windows are zero-padded at the border."""
    # A measure, not a loss: its values alone.
    planes = (x.detach().permute(2, 0, 1).contiguous() for x in (image, target))
    return _ssim_parts(*planes)[-1].permute(1, 2, 0)


class _Ssim(torch.autograd.Function):
    """Mean SSIM of (C, H, W) planes; S = A1 A2 / (B1 B2) with A, B as in the paper."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        x = x.contiguous()
        parts = _ssim_parts(x, y)
        ctx.save_for_backward(x, y, *parts)
        value = parts[-1]
        return value.mean()

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        x, y, mean_x, mean_y, a1, a2, b1, b2, bottom, value = ctx.saved_tensors
        # dS with respect to the three blurred maps that hold x; each goes back through the symmetric blur.
        d_xx = -value / b2
        d_xy = (2 * a1).div_(bottom)
        d_mean = (2 * mean_y * (a2 - a1)).div_(bottom).sub_(2 * mean_x * value * (1 / b1 - 1 / b2))
        d_mean, d_xx, d_xy = _blur(torch.cat([d_mean, d_xx, d_xy])).chunk(3)
        return (d_mean + 2 * x * d_xx + y * d_xy) * (grad / value.numel()), None


def _ssim_parts(x: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Blurred x and y, then a1, a2, b1, b2, b1 b2 and S = a1 a2 / (b1 b2) of (C, H, W) planes."""
    mean_x, mean_y, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    product = mean_x * mean_y
    squares = mean_x.square().add_(mean_y * mean_y)
    a1 = 2 * product + _C1
    a2 = 2 * (xy - product) + _C2
    b1 = squares + _C1
    b2 = (xx + yy).sub_(squares).add_(_C2)
    bottom = b1 * b2
    return mean_x, mean_y, a1, a2, b1, b2, bottom, (a1 * a2).div_(bottom)


def _blur(planes: torch.Tensor) -> torch.Tensor:
    """(C, H, W) blurred by the separable window, zeros outside.

    Eleven shifted additions in each direction: on a CPU 60 times faster than `conv2d` with one channel a group.
    """
    weights = [math.exp(-(d * d) / (2 * _SIGMA**2)) for d in range(_RADIUS + 1)]
    total = weights[0] + 2 * sum(weights[1:])
    weights = [w / total for w in weights]
    for dim, pad in ((2, (_RADIUS, _RADIUS, 0, 0)), (1, (0, 0, _RADIUS, _RADIUS))):
        size = planes.shape[dim]
        padded = torch.nn.functional.pad(planes, pad)
        planes = padded.narrow(dim, _RADIUS, size) * weights[0]
        for d in range(1, _RADIUS + 1):
            planes.add_(padded.narrow(dim, _RADIUS - d, size), alpha=weights[d])
            planes.add_(padded.narrow(dim, _RADIUS + d, size), alpha=weights[d])
    return planes
