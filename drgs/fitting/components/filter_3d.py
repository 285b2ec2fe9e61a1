"""A low-pass filter of the Gaussians themselves: none is smaller than what the photographs could have shown of it.

Photographs sample the scene. They have no information about detail that is finer than their pixels, and what is fitted
there shows as needles, or as holes between Gaussians, in pictures that sample it more finely: in larger ones, and
nearer by.
So each Gaussian of covariance S and opacity o is rendered as its convolution with an isotropic one, as wide as the
pixels of the photograph that samples it most finely [1, eq. 7 to 9]:

    S' = S + s / nu^2 I,   o' = o sqrt(|S| / |S'|),   nu = max over the cameras that see its mean of f / z.

What is fitted, and what density control divides, are S and o; whatever a fit shows, saves and measures are S' and o',
so that viewers know of no filter. The 2D filter of [1] is not here: the screen is the renderer's business.

It helps where all renderers of a fit widen Gaussians on the screen, as `gsplat` does, which leaves them too narrow for
others and for larger pictures. A fit for all renderers gains nothing by it, and may lose (benchmarks/filter_3d.py).

Reference:
    [1] Yu et al., "Mip-Splatting: Alias-free 3D Gaussian Splatting", CVPR 2024, and its code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.cameras.lenses import LENS_MODELS
from drgs.fitting.components.base import Checkpoint, Component, Conflict, Fit, Setup

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians

VARIANCES = "filter_3d"
"""Name of the filter's variances in a checkpoint, one a Gaussian."""

_STRENGTH = 0.2  # s of [1]: the variance in squared intervals between samples
_MARGIN = 0.15  # of an image's sides, beyond which a mean is not seen [1, code]: its Gaussian may reach in


class Filter3D(torch.nn.Module):
    """What makes the Gaussians that are shown of those that are fitted.

    Attributes:
        variances: (N,) float32 s / nu^2, in squared world units; before the first `sample` there is none.
    """

    variances: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("variances", torch.zeros(0))

    def sample(self, means: torch.Tensor, cameras: Sequence[Camera], far: int = 0) -> None:
        """Take the sampling rates anew, after Gaussians have come or gone.

        Args:
            means: (N, 3) float64 world, without a graph.
            cameras: Those of the photographs, of the size at which these are fitted.
            far: How many of the first means are far away.
        """
        # A rate is a maximum over cameras of what changes little from step to step: constant in between, and after the
        # last density control.
        rates = sampling_rates(means.cpu().numpy(), cameras)
        seen = rates[far:][rates[far:] > 0]
        # Nothing shows what no camera sees: it gets the filter of the most coarsely sampled of the others [1, code].
        lowest = seen.min() if len(seen) else np.inf
        variances = _STRENGTH / np.square(np.where(rates > 0, rates, lowest))
        self.variances = torch.from_numpy(variances).float()

    def forward(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians under the filter.

        Args:
            gaussians: N Gaussians, as many as at the last `sample`.
        Gradients:
            Reach log scales and opacities; a filtered opacity depends on both.
        """
        return filtered(gaussians, self.variances)


def filtered(gaussians: Gaussians, variances: torch.Tensor) -> Gaussians:
    """Gaussians convolved with isotropic ones, with opacities that keep the integral of each.

    Args:
        gaussians: N Gaussians.
        variances: (N,) variances of the filter, >= 0, in squared world units.
    """
    # In float64, then rounded once: logit(o') = log o' - log(1 - o') cancels where o' is near 1, and a checkpoint and
    # the PLY beside it have the same bits wherever they are compared.
    log_scales = gaussians.log_scales.double()
    log_variances = variances.double().log().to(log_scales.device)
    wider = torch.logaddexp(2 * log_scales, log_variances[:, None]) / 2
    log_opacities = torch.nn.functional.logsigmoid(gaussians.logit_opacities.double()) + (log_scales - wider).sum(1)
    logits = log_opacities - torch.log(-torch.expm1(log_opacities))
    kind = gaussians.log_scales.dtype
    return gaussians.replace(log_scales=wider.to(kind), logit_opacities=logits.to(gaussians.logit_opacities.dtype))


def sampling_rates(means: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """(N,) pixels per world unit, in the image plane of the camera that samples a mean most finely; 0 where none does.

    Fisheyes and panoramas have no such plane: theirs are pixels a radian, at the distance of the mean.

    Args:
        means: (N, 3) world.
        cameras: Cameras of any lens.
    Reference:
        [1], eq. 7.
    """
    rates = np.zeros(len(means))
    for camera in cameras:
        pixels, depth = camera.project(means)
        if LENS_MODELS[camera.model].guide != "plane":
            depth = np.linalg.norm(means - camera.center, axis=1)
        sides = np.array([camera.width, camera.height])
        inside = (depth > 0) & ((pixels >= -_MARGIN * sides) & (pixels <= (1 + _MARGIN) * sides)).all(1)
        focal = max(camera.K[0, 0], camera.K[1, 1])
        rates[inside] = np.maximum(rates[inside], focal / depth[inside])
    return rates


class Filter3DComponent(Component):
    """The filter as a part of a fit; `filter_3d on`.

    Attributes:
        filter: The filter; None in a fit without.
    """

    name = "filter_3d"
    option = ("filter_3d", "off")
    where = "where Gaussians have a 3D filter"
    conflicts = (
        Conflict(
            "motion",
            "sampling rates are those of what stands still",
            "leave --filter-3d out, or fit to what stands still (--dynamics ignore)",
        ),
    )
    reserved_names = (VARIANCES,)

    def __init__(self) -> None:
        self.filter: Filter3D | None = None

    def setting(self, setup: Setup) -> str | None:
        """See `Component`."""
        return "on" if setup.config.filter_3d == "on" else None

    def changed(self, fit: Fit) -> None:
        """See `Component`: how finely photographs sample the Gaussians is computed anew."""
        if fit.config.filter_3d == "on":
            self.filter = self.filter or Filter3D()
            cameras = [frame.camera for frame in fit.photographs()]
            self.filter.sample(fit.rows.places(), cameras, fit.rows.far)

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """See `Component`."""
        return gaussians if self.filter is None else self.filter(gaussians)

    def state(self, fit: Fit) -> tuple[dict[str, torch.Tensor], dict]:
        """See `Component`."""
        return ({} if self.filter is None else {VARIANCES: self.filter.variances}), {}

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`."""
        if fit.config.filter_3d == "on":
            self.filter = Filter3D()
            self.filter.variances = checkpoint.tensors[VARIANCES]

    @classmethod
    def tensor_kinds(cls, checkpoint: Checkpoint, count: int) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
        """See `Component`."""
        is_on = VARIANCES in checkpoint.tensors or checkpoint.header["config"].get("filter_3d") == "on"
        return {VARIANCES: (torch.float32, (count,))} if is_on else {}

    @classmethod
    def load_gaussians(cls, gaussians: Gaussians, checkpoint: Checkpoint) -> Gaussians:
        """See `Component`."""
        return filtered(gaussians, checkpoint.tensors[VARIANCES]) if VARIANCES in checkpoint.tensors else gaussians
