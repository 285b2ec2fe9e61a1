"""What each step sees of the photographs: small ones at first, then parts of them, whole ones at the end.

**Coarse to fine.** Early steps fit large structures alone, which a small photograph shows at a fraction of the cost.
With n downscales the first steps see photographs of 1 / 2^n of the width and height, which double after equal shares of
the steps, until from `FULL` of the steps on they have the size of the fit. The idea is that of Nerfstudio's splatfacto
[1], which counts steps where this has a fraction of them.

**Mini-batches.** On a CPU a step takes as long as it has pixels, and what a short fit lacks is optimizer updates: so a
step can be several of them, each with a small photograph, or with a quarter of one of full size, drawn at random.
Averaging over all pixels of a photograph pays at the end, from `WHOLE` of the steps on. gsplat's trainer has crops, too
(`patch_size`, [2]), a step each.

Only steps see parts and small photographs. Whatever measures, compares, samples or chooses has those of the fit:
metrics and previews, transients, the 3D filter, reach and information of poses, active views.

References:
    [1] Tancik et al., "Nerfstudio: A Modular Framework for Neural Radiance Field Development", SIGGRAPH 2023.
    [2] Ye et al., "gsplat: An Open-Source Library for Gaussian Splatting", JMLR 2025.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from drgs.cameras.sizes import cropped
from drgs.data.resampling import resize_area

if TYPE_CHECKING:
    from drgs.fitting.components.base import Setup
    from drgs.fitting.config import FitConfig
    from drgs.fitting.frames import Frame

FULL = 1 / 2
"""Fraction of the steps from which on photographs have the size of the fit; chosen (docs/one-model.md has its gain)."""

WHOLE = 0.8
"""Fraction of the steps from which on an update sees a whole photograph: density control ends there, too."""

LARGE = 25_000
"""Pixels of a photograph, the median, from which on a step of a plain fit is several updates: measured at
`--max-pixels` 30,000, which leaves photographs of some shapes a little smaller (docs/one-model.md)."""

PIXELS_A_GAUSSIAN = 2.0
"""Pixels of a photograph over the largest number of Gaussians, from which on likewise: what an update costs by Gaussian
would take more time than its fewer pixels save (with 1.8, and as long, nothing is gained)."""

UPDATES = 3
"""Updates of such a step: of half the width and height, or of a quarter, they take as long as one of all pixels."""

_LEAST = 11  # pixels of the shorter side: the window of SSIM (losses.py) is as wide


class Resolution:
    """How many updates a step has, and what each sees of its photograph."""

    def __init__(self, num_downscales: int, max_steps: int, updates: int = 1) -> None:
        """
        Args:
            num_downscales: How many times photographs are halved at the start.
            max_steps: Steps of the fit.
            updates: Updates of a step that does not see whole photographs.
        """
        self._updates = updates
        self._ends = [round(FULL * max_steps * (k + 1) / num_downscales) for k in range(num_downscales)]
        self._parts_end = round(WHOLE * max_steps) if updates > 1 else 0
        self._kept: dict[int, tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]] = {}
        self._kept_at = 0

    @classmethod
    def of(cls, config: FitConfig) -> Resolution:
        """That of a fit."""
        updates = config.data.updates_per_step or 1
        halved = config.data.num_downscales
        return cls(int(updates > 1) if halved is None else halved, config.max_steps, updates)

    def halvings(self, step: int) -> int:
        """How many times photographs are halved in a step (from 0); those that are small already, less often."""
        return sum(step < end for end in self._ends)

    def has_parts(self, step: int) -> bool:
        """Whether the updates of a step (from 0) see quarters of photographs."""
        return step < self._parts_end and not self.halvings(step)

    def updates(self, step: int) -> int:
        """Updates of a step (from 0)."""
        return self._updates if self.halvings(step) or self.has_parts(step) else 1

    def events(self, step: int, frames: list[Frame]) -> list[dict]:
        """What is to be logged before a step: what it begins to see, of the first photograph."""
        kind = (self.halvings(step), self.has_parts(step))
        before = (self.halvings(step - 1), self.has_parts(step - 1)) if step else (0, False)
        if kind == before:
            return []
        width, height = halved_size(frames[0].camera.width, frames[0].camera.height, kind[0])
        if kind[1]:
            width, height = _half_up(width), _half_up(height)
        updates = {"updates": self.updates(step)} if self._updates > 1 else {}
        return [{"event": "resolution", "halvings": kind[0], "width": width, "height": height, **updates}]

    def describe(self, event: Mapping[str, Any]) -> str | None:
        """The line on stderr for an event of its own; None for others."""
        if event["event"] != "resolution":
            return None
        updates = event.get("updates", 1)
        return f"photographs of {event['width']}x{event['height']}" + (f", {updates} a step" if updates > 1 else "")

    def seen(self, index: int, frame: Frame, step: int, generator: torch.Generator) -> Frame:
        """What an update sees of a photograph.

        Args:
            index: Index of the photograph among those of the fit.
            frame: The photograph at the size of the fit, whose camera may have a pose that is fitted.
            step: The step, from 0.
            generator: Draws the quarter.
        """
        return _quarter(frame, generator) if self.has_parts(step) else self.resized(index, frame, step)

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
            mask, alpha = (None if x is None else averaged(x, size) for x in (frame.mask, frame.alpha))
            self._kept[index] = averaged(frame.pixels, size), mask, alpha
        pixels, mask, alpha = self._kept[index]
        return dataclasses.replace(
            frame,
            camera=frame.camera.resized(*size),
            pixels=pixels,
            mask=mask,
            alpha=alpha,
            # Made anew each time: what is transient changes on the way.
            transient=None if frame.transient is None else averaged(frame.transient.float(), size) > 0,
        )


def updates_of(setup: Setup) -> int:
    """`updates_per_step` of a fit. Where it is not stated, several if photographs are large, in fits of the kind that
    this was measured in: nothing moves, no teacher or depth map is fitted to, all views are fitted to from the start,
    and it begins with points.

    Raises:
        ValueError: If several are stated and a teacher or depth maps are fitted to: a quarter of a photograph would be
            compared with the whole map.
    """
    config, frames, stated = setup.config, setup.frames, setup.config.data.updates_per_step
    maps = {
        "--semantics ignore": config.features.semantics != "ignore" and any(x.teacher for x in frames),
        "--depth off": config.loss.depth != "off" and any(x.depth or x.relative_depth for x in frames),
    }
    without = " ".join(option for option, is_there in maps.items() if is_there)
    if stated is not None:
        if stated > 1 and without:
            raise ValueError(
                f"fit: updates_per_step must be 1 where a teacher or depth maps are fitted to, got {stated}; leave it "
                f"out, or use {without}"
            )
        return stated
    pixels = [frame.camera.width * frame.camera.height for frame in frames]
    is_plain = not (setup.modes & {"selection", "begin"} or setup.times or without)
    least = max(LARGE, PIXELS_A_GAUSSIAN * config.density.max_gaussians)
    return UPDATES if is_plain and statistics.median(pixels) >= least else 1


def halved_size(width: int, height: int, times: int) -> tuple[int, int]:
    """(width, height) of an image halved so many times, rounded down, or as often as the window of SSIM fits in."""
    while times and min(width, height) >> times < _LEAST:
        times -= 1
    return width >> times, height >> times


def _half_up(side: int) -> int:
    """Pixels of a half of a side, rounded up: halves of an odd one share a pixel."""
    return (side + 1) // 2


def _quarter(frame: Frame, generator: torch.Generator) -> Frame:
    """One of the four quarters of a photograph, with the camera that shows it."""
    whole = frame.camera
    width, height = _half_up(whole.width), _half_up(whole.height)
    right, low = torch.randint(2, (2,), generator=generator).tolist()
    x, y = right * (whole.width - width), low * (whole.height - height)
    pixels, mask, alpha, transient = (
        None if values is None else values[y : y + height, x : x + width].contiguous()
        for values in (frame.pixels, frame.mask, frame.alpha, frame.transient)
    )
    assert pixels is not None
    camera = cropped(whole, x, y, width, height)
    return dataclasses.replace(frame, camera=camera, pixels=pixels, mask=mask, alpha=alpha, transient=transient)


def averaged(values: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """(H, W) or (H, W, C) values at a smaller (width, height), of the same type."""
    return torch.from_numpy(resize_area(values.numpy(), *size))
