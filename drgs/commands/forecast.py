"""A forecast of how long rendering will take, made on a few bands of the first view."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import torch

from drgs.display.progress import Bar
from drgs.integrator import render
from drgs.sizes import cropped

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

__all__ = ["forecast"]

_BANDS = (0.125, 0.375, 0.625, 0.875)  # places of the bands in parts of the height: one in each quarter
_SHARE = 1 / 32  # height of each band, in parts of the view's


def forecast(gaussians: Gaussians, cameras: list[Camera], settings: RenderSettings) -> float:
    """Seconds that all views will take, kernels compiled; finding out takes about a fifth of one view.

    Args:
        gaussians: Gaussians to be rendered.
        cameras: Views to be rendered, at least one.
        settings: Settings that they are rendered by.
    """
    first = cameras[0]
    rows = max(2, round(first.height * _SHARE))

    def seconds(place: float, height: int) -> float:
        band = cropped(first, 0, int(place * max(first.height - height, 0)), first.width, height)
        began = time.perf_counter()
        with torch.no_grad():  # as views are drawn: a graph would take time of its own
            render(gaussians, band, settings, ()).rgb.cpu().numpy()
        return time.perf_counter() - began

    with Bar("how long it will take", len(_BANDS)) as bar:
        seconds(0.5, rows)  # compiles the kernels
        view = row = 0.0
        for place in _BANDS:
            # What projecting and sorting all Gaussians takes, however small the image is, and what its rows take.
            least = seconds(place, 1)
            each = max(seconds(place, rows) - least, 0.0) / (rows - 1)
            view += max(least - each, 0.0) / len(_BANDS)
            row += each / len(_BANDS)
            bar.advance()
    pixels = sum(camera.width * camera.height for camera in cameras)
    return view * len(cameras) + row * pixels / first.width
