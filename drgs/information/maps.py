"""Maps of what other rules would look at, in the pixels of a view: beside those of `drgs.fisher.variance_map`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from drgs.ellipsoids import Y_00
from drgs.gain import Information, Prior, variances
from drgs.information.groups import groups_of
from drgs.information.replay import Replay
from drgs.oracle import sh_colors

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

__all__ = ["fisherrf_map"]


def fisherrf_map(
    gaussians: Gaussians, camera: Camera, known: Information, prior: Prior, settings: RenderSettings
) -> torch.Tensor:
    """(H, W) float32: each pixel's share of the score that FisherRF's rasterizer would give the view.

    It sums the channels before it squares: what it looks at is one gray image, the sum of the colors. Each parameter's
    square is divided by what is known of it, and by the derivative of its activation, which it multiplies once instead
    of twice. The map adds up to `eig` of method `fisherrf`.

    Args:
        gaussians: The Gaussians as the camera sees them.
        camera, settings: The same as for `drgs.render`.
        known: `drgs.fisher.diagonal(..., method="fisherrf")` of the known views.
        prior: lambda.
    """
    g = gaussians.detach().replace(features=None)
    weights = {}
    inputs = g.parameters()
    for name, group in groups_of(g).items():
        if name in known and group.fisherrf is not None:
            weights[name] = variances({name: known[name]}, prior)[name] / group.fisherrf(inputs)
    # A color that is clamped at 0 is no part of the gray, and nothing is known by it.
    away = torch.from_numpy(g.origin - camera.center).to(g.means.device)
    lit = (sh_colors(g.sh.double(), g.means.double() + away) > 0).to(g.sh)
    sh = torch.zeros_like(g.sh)
    count = lit.sum(1)
    sh[..., 0] = (g.sh * lit[:, None]).sum(2)
    sh[:, 0, 0] += torch.where(count > 0, 0.5 * count - 0.5, -1.0) / Y_00  # a color is 0.5 + Y sh: of n, 0.5 n
    if "sh" in weights:
        gray = torch.zeros_like(weights["sh"])
        gray[..., 0] = (weights["sh"] * lit.cpu()[:, None]).sum(2)
        weights["sh"] = gray
    behind = (float(sum(settings.background)), 0.0, 0.0)
    return Replay(g.replace(sh=sh), camera, settings.replace(background=behind)).variance(weights, (1.0, 0.0, 0.0))
