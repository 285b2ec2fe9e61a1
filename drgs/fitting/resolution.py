"""Coarse to fine: the first steps are fitted to photographs of half, a quarter ... of the width and height.

Early steps fit large structures alone, which a small photograph shows at a fraction of the cost. With n downscales
the first steps see photographs of 1 / 2^n of the width and height, which double after equal shares of the steps, until
from `FULL` of the steps on they have the size of the fit. What a step sees depends on its number alone. The idea is
that of Nerfstudio's splatfacto [1], which counts steps where this has a fraction of them.

Only steps see small photographs. Whatever measures, compares, samples or chooses has those of the fit: metrics and
previews, transients, the 3D filter, reach and information of poses, active views.

Reference:
    [1] Tancik et al., "Nerfstudio: A Modular Framework for Neural Radiance Field Development", SIGGRAPH 2023.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from drgs.data.resampling import resize_area

if TYPE_CHECKING:
    from drgs.fitting.frames import Frame

__all__ = ["FULL", "Resolution", "halved_size"]

FULL = 1 / 2
"""Fraction of the steps from which on photographs have the size of the fit; chosen (docs/one-model.md has its gain)."""

_LEAST = 11  # pixels of the shorter side: the window of SSIM (losses.py) is as wide


class Resolution:
    """The size of the photographs in each step.

    Attributes:
        num_downscales: How many times they are halved at the start.
    """

    def __init__(self, num_downscales: int, max_steps: int) -> None:
        """
        Args:
            num_downscales: How many times photographs are halved at the start.
            max_steps: Steps of the fit.
        """
        self.num_downscales = num_downscales
        self._ends = [round(FULL * max_steps * (k + 1) / num_downscales) for k in range(num_downscales)]
        self._kept: dict[int, tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]] = {}
        self._kept_at = 0

    def halvings(self, step: int) -> int:
        """How many times photographs are halved in a step (from 0); those that are small already, less often."""
        return sum(step < end for end in self._ends)

    def events(self, step: int, frames: list[Frame]) -> list[dict]:
        """What is to be logged before a step: the size, of the first photograph, that it begins to have at this one."""
        halvings = self.halvings(step)
        if step and halvings == self.halvings(step - 1) or not self.num_downscales:
            return []
        width, height = halved_size(frames[0].camera.width, frames[0].camera.height, halvings)
        return [{"event": "resolution", "halvings": halvings, "width": width, "height": height}]

    def describe(self, event: Mapping[str, Any]) -> str | None:
        """The line on stderr for an event of its own; None for others."""
        return f"photographs of {event['width']}x{event['height']}" if event["event"] == "resolution" else None

    def resized(self, index: int, frame: Frame, step: int) -> Frame:
        """A photograph at the size of a step: area averages of pixels, mask and alpha, with the camera of that size.

        A pixel shows something transient where one of those that it is made of does. Labels and the map of a teacher
        are as they were. Averages are kept until the size changes.

        Args:
            index: Index of the photograph among those of the fit.
            frame: The photograph at the size of the fit, whose camera may have a pose that is fitted.
            step: The step, from 0.
        """
        halvings = self.halvings(step)
        if halvings != self._kept_at:
            self._kept.clear()
            self._kept_at = halvings
        size = halved_size(frame.camera.width, frame.camera.height, halvings)
        if size == (frame.camera.width, frame.camera.height):
            return frame
        if index not in self._kept:
            mask, alpha = (None if x is None else _averaged(x, size) for x in (frame.mask, frame.alpha))
            self._kept[index] = _averaged(frame.pixels, size), mask, alpha
        pixels, mask, alpha = self._kept[index]
        return dataclasses.replace(
            frame,
            camera=frame.camera.resized(*size),
            pixels=pixels,
            mask=mask,
            alpha=alpha,
            # Made anew each time: what is transient changes on the way.
            transient=None if frame.transient is None else _averaged(frame.transient.float(), size) > 0,
        )


def halved_size(width: int, height: int, times: int) -> tuple[int, int]:
    """(width, height) of an image halved so many times, rounded down, or as often as the window of SSIM fits in."""
    while times and min(width, height) >> times < _LEAST:
        times -= 1
    return width >> times, height >> times


def _averaged(values: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """(H, W) or (H, W, C) values at a smaller (width, height), of the same type."""
    return torch.from_numpy(resize_area(values.numpy(), *size))
