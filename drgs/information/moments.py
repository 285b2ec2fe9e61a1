"""Moments of the features along rays: how far what a pixel is made of differs from what the pixel shows.

Var_c = sum_i w_i f_ic^2 - (sum_i w_i f_ic)^2 in a pixel, w_i the weights of compositing. As sum w <= 1 it is >= 0, and
what is missing to 1 counts as a feature of 0. It is large where a ray mixes unlike things, whether or not any view has
seen them: dispersion along the ray, no uncertainty about parameters, so it needs no training views. The baseline
"Magic Moments" of [1] in the reading that is stated here: the sum over channels, averaged over pixels, for [1] does not
say how it becomes one number.

Reference:
    [1] Next Best View Selections for Semantic and Dynamic 3D Gaussian Splatting, arXiv 2512.22771.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from drgs.integrator import render
from drgs.oracle import sh_colors

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

__all__ = ["moments_map"]


def moments_map(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> torch.Tensor:
    """(H, W) float32 variance along the ray of every pixel, summed over channels, from one render of D + 1 channels.

    The channels are the features as they are stored, not decoded; of Gaussians without features the three colors, seen
    from the camera (without the background, and towards the means whatever `sh_direction` is).

    Args:
        gaussians: The Gaussians as the camera sees them.
        camera, settings: The same as for `drgs.render`.
    """
    g = gaussians.detach()
    values = g.features
    if values is None:
        away = torch.from_numpy(g.origin - camera.center).to(g.means.device)
        values = sh_colors(g.sh.double(), g.means.double() + away)
    values = values.double()
    # sum_c w f_c^2 = w |f|^2 is one more channel.
    moments = torch.cat([values, values.square().sum(1, keepdim=True)], 1).float()
    found = render(g.replace(sh=g.sh[:, :1], features=moments), camera, settings, outputs=()).features
    assert found is not None  # there is at least one channel
    found = found.double().cpu()
    return (found[..., -1] - found[..., :-1].square().sum(-1)).clamp_min(0).float()
