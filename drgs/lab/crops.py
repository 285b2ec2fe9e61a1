"""Crops of views that the float64 oracle can take, each where most is seen."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.lab.raw import PARAMETERS
from drgs.lab.rows import Crop
from drgs.settings import RenderSettings

__all__ = ["crops"]

_SIDES = (32, 16, 8)  # pixels, the largest that the oracle can take
_STEP = 16  # pixels between the places that are tried: a rasterizer's tiles stay where they are
_PAIRS = 1_000_000  # (pixel, Gaussian) pairs of a crop that take the oracle seconds: image and gradient, by CPU


def crops(g: Gaussians, cameras: list[Camera], settings: RenderSettings) -> tuple[Gaussians, list[Camera], list[Crop]]:
    """The most varied square of each view, and the Gaussians that any of them sees.

    Squares have 32 pixels a side, or 16 or 8 where the oracle would take long over what one of them sees.

    Args:
        g: The scene.
        cameras: Pinhole, of one size.
        settings: Of the images that are looked at.
    Returns:
        The Gaussians; a camera a view that shows anything; and where each crop lies.
    Raises:
        ValueError: If no view shows a Gaussian.
    """
    drawn = [(camera, *_looked_at(g, camera, settings)) for camera in cameras]
    drawn = [(camera, image) for camera, image, seen in drawn if bool(seen.any())]
    if not drawn:
        raise ValueError("crossval: the cameras must show Gaussians, none of them shows any; choose others")
    for side in _SIDES:
        parts = []
        places = []
        seen = []
        for camera, image in drawn:
            width, height = min(camera.width, side), min(camera.height, side)
            x, y = _liveliest(image, width, height)
            K = np.array(camera.K, float)
            K[:2, 2] -= x, y
            parts.append(dataclasses.replace(camera, K=K, width=width, height=height))
            places.append(Crop(x, y, width, height, [camera.width, camera.height]))
            seen.append(_looked_at(g, parts[-1], settings)[1])
        if max(int(x.sum()) for x in seen) * side**2 <= _PAIRS:
            break
    seen = torch.stack(seen).any(0)
    index = torch.nonzero(seen)[:, 0]
    # What is compared has leaves of its own.
    fields = {name: getattr(g, name).detach()[index] for name in PARAMETERS}
    return Gaussians(**fields, origin=g.origin), parts, places


def _looked_at(g: Gaussians, camera: Camera, settings: RenderSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, 4) color and alpha, and (N,) bool: what is seen."""
    with torch.no_grad():
        out = render(g, camera, settings, outputs=("visibility",))
    return torch.cat([out.rgb, out.alpha[..., None]], -1).cpu(), out.visibility.cpu() > 0


def _liveliest(image: torch.Tensor, width: int, height: int) -> tuple[int, int]:
    """Corner (x, y) of the crop of an (H, W, 4) image whose colors and alpha vary most."""
    x = image.double().permute(2, 0, 1)[None]

    def mean(values: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(values, (height, width), stride=_STEP)

    variance = (mean(x * x) - mean(x) ** 2).sum(1)[0]
    row, column = divmod(int(variance.argmax()), variance.shape[1])
    return _STEP * column, _STEP * row
