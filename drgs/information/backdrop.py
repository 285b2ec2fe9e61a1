"""An unknown color behind everything: what the Gaussians leave open is no reason to be sure.

Information is about Gaussians that exist. Where a view shows none, a pixel is as unknown as it can be, and its variance
was 0. With a color b_c behind everything, one for each cell c of directions, known to a variance of 1 / lambda before
any view, a pixel p of the direction c is S_p + (1 - alpha_p) b_c: linear, so that the information of a view about b_c
is

    H_c = sum_{p in c} (1 - alpha_p)^2

in each of the three channels, whatever b is. Cells are those of a cube around the camera whose faces have 16x16 of
them, spaced evenly in angle (Ronchi et al., "The 'cubed sphere'", 1996): 1,536, of 4 to 6 degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.ellipsoids import colors_only

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene
    from drgs.settings import RenderSettings

__all__ = ["CELLS", "backdrop_cells", "backdrop_information", "backdrop_variance"]

_SIDE = 16  # cells along an edge of the cube
CELLS = 6 * _SIDE**2


def backdrop_cells(camera: Camera) -> torch.Tensor:
    """(H, W) int64: the cell of each pixel's direction in the world."""
    rays = camera.pixel_directions().reshape(-1, 3)
    axis = np.abs(rays).argmax(1)
    rows = np.arange(len(rays))
    along = rays[rows, axis]
    across = np.stack([rays[rows, (axis + k) % 3] for k in (1, 2)], axis=-1) / np.abs(along)[:, None]
    even = np.arctan(across) * 4 / np.pi  # in [-1, 1]
    places = ((even + 1) / 2 * _SIDE).astype(int).clip(0, _SIDE - 1)
    face = 2 * axis + (along < 0)
    found = (face * _SIDE + places[:, 0]) * _SIDE + places[:, 1]
    return torch.from_numpy(found.reshape(camera.height, camera.width))


def _open(scene: Scene, camera: Camera, settings: RenderSettings) -> torch.Tensor:
    """(H, W) float64: (1 - alpha)^2."""
    from drgs.integrator import render

    with torch.no_grad():
        alpha = render(colors_only(scene, camera.time), camera, settings, outputs=()).alpha
    return (1 - alpha.double().cpu()).clamp(min=0).square()


def backdrop_information(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    channel_weights: Sequence[float],
    mask: torch.Tensor | None = None,
) -> torch.Tensor:
    """(1536, 3) float64 H_c of a view in each channel, times the channel's weight; with a mask (H, W) of its square."""
    total, open_ = torch.zeros(CELLS, dtype=torch.float64), _open(scene, camera, settings)
    if mask is not None:
        open_ = open_ * mask.detach().double().cpu().square()
    total.index_add_(0, backdrop_cells(camera).flatten(), open_.flatten())
    return total[:, None] * torch.tensor(channel_weights, dtype=torch.float64)


def backdrop_variance(
    scene: Scene, camera: Camera, weights: torch.Tensor, settings: RenderSettings, channel_weights: Sequence[float]
) -> torch.Tensor:
    """(H, W) float64 (1 - alpha)^2 times the weights (1536, 3) of the pixel's cell, summed over weighted channels."""
    each = weights.double().cpu() @ torch.tensor(channel_weights, dtype=torch.float64)
    return _open(scene, camera, settings) * each[backdrop_cells(camera)]
