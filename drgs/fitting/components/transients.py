"""What was there for one photograph only, a shadow or a passer-by: found in residuals, and left out of the loss.

A residual alone does not distinguish it from what is merely not fitted yet: on captures where nothing moves the largest
residuals are as far above the others. But where several photographs see one place, what is not fitted yet leaves them
the same residual, and what one of them shows alone leaves it to that one. So every photograph's residual is compared
with the median of those of its neighbors, at the places where they see the same surface: the ray is followed to the
distance that is rendered, and projected into them. Robust losses of radiance fields look at one photograph at a time
[1, 2] and pay for it with details of clean captures. A mask is made anew at each look, so that nothing is left out for
ever that the others come to agree with.

Reference:
    [1] Sabour et al., "RobustNeRF: Ignoring Distractors with Robust Losses", CVPR 2023.
    [2] Sabour et al., "SpotLessSplats: Ignoring Distractors in 3D Gaussian Splatting", ACM TOG 2025.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, max_pool2d, pad

from drgs.cameras.sizes import reduced_size
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians, colors_only
from drgs.fitting.components.base import Checkpoint, Component, Conflict, Fit, Setup
from drgs.fitting.depths import axis_cosines, renders_z
from drgs.integrator import render

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drgs.cameras import Camera
    from drgs.fitting.config import TransientUse
    from drgs.fitting.frames import Frame
    from drgs.settings import RenderSettings

TENSOR = "transient."
"""What names of masks in a checkpoint begin with; the number of the photograph follows."""

# Where nothing measured is named: chosen, not tuned.
_COMPARED_AT = (0.375, 0.5, 0.625, 0.75, 0.875)  # of the steps: masks are made anew; until the first, all pixels count
_LEAST_VISITS = 4  # steps that a photograph must have had on average; fewer leave residuals of what is not fitted yet
_FEWEST_PHOTOGRAPHS = 4  # photographs of a fit: one, and three that it is compared with
_COMPARED_PIXELS = 6_000  # pixels of a picture that is compared: 20,000 give the same masks in twice the time
_BLUR = 0.02  # radius of the mean that is compared, in widths of the picture
_NEIGHBORS = 8  # photographs that each one is compared with, the nearest
_FEWEST_NEIGHBORS = 3  # of them that must see the same place
_SAME_DISTANCE = 0.1  # relative difference of two distances to one surface
_SOLID = 0.5  # opacity below which a ray ends in nothing
_DARK = 0.05  # of the range of colors, below which the ratio of two is noise
_SPREADS = 2.0  # times the spread of the neighbors' own colors, which a difference must exceed
_CLEAR, _EDGE = 0.1, 0.05  # of the range of colors: what exceeds the spread where a mask begins, and where it ends
_GROWTH = 0.08  # widths of the picture: how far a mask grows from where it begins, at most
# Share of a photograph's pixels that clearly differ, above which masks are used. Clean captures: at most 0.017.
_DECISIVE_SHARE = 0.025
_MASKED_SHARE = 0.01  # the same, from which on a photograph has a mask once that is decided; less are specks
_TIMES_MEDIAN = 4.0  # times the median over photographs, which wrong poses and mirrors raise in all of them


class TransientsComponent(Component):
    """Pixels of photographs that the photometric term of a fit leaves out: `transients` mask, or auto, where residuals
    clearly show some.

    Attributes:
        present: Whether there is something to be left out; None until that has been decided.
    """

    name = "transients"
    option = ("transients", "keep")
    where = "where what single photographs show is left out"
    # They are distinguished by what neighbors show of the same surface at rest.
    conflicts = (
        Conflict(
            "motion",
            "what moves is in no two photographs the same",
            "leave --transients out, or fit to what stands still (--dynamics ignore)",
        ),
    )
    reserved_names = (TENSOR.rstrip("."),)
    header_kinds = {"transients": bool}

    def __init__(self) -> None:
        self.present: bool | None = None

    def setting(self, setup: Setup) -> str | None:
        """See `Component`."""
        use = setup.config.loss.transients
        return None if use == "keep" else use

    def before_step(self, fit: Fit) -> list[dict]:
        """See `Component`: looks when it is due."""
        use = fit.config.loss.transients
        if not self.is_due(use, fit.step_index, fit.config.max_steps, len(fit.frames)):
            return []
        return [self.look(use, fit.photographs(), fit.gaussians(), fit.config.settings)]

    def is_due(self, use: TransientUse, done: int, max_steps: int, photographs: int) -> bool:
        """Whether to look before step `done`; `use` as `LossConfig.transients` says."""
        if (
            use == "keep"
            or self.present is False
            or photographs < _FEWEST_PHOTOGRAPHS
            or done < _LEAST_VISITS * photographs
        ):
            return False
        return done in {round(part * max_steps) for part in _COMPARED_AT}

    def look(self, use: TransientUse, frames: list[Frame], gaussians: Gaussians, settings: RenderSettings) -> dict:
        """Decide, where that is open, whether there is something to be left out, and renew the masks of all frames.

        Args:
            use: As `LossConfig.transients` says.
            frames: Photographs; their `transient` is set if there is something.
            gaussians: What has been fitted to them so far.
            settings: What it is rendered with.
        Returns:
            The evidence, for the log.
        """
        masks, shares = transient_masks(frames, gaussians, settings)
        worst, median = max(shares), float(np.median(shares))
        if self.present is None:
            self.present = use == "mask" or worst > max(_DECISIVE_SHARE, _TIMES_MEDIAN * median)
        if self.present:
            for frame, mask in zip(frames, masks, strict=True):
                frame.transient = mask if mask.any() else None
        return {
            "event": "transients",
            "found": self.present,
            "worst": worst,
            "median": median,
            "photographs": sum(share > _DECISIVE_SHARE for share in shares),
            "of": len(frames),
            **masked_share(frames),
        }

    def state(self, fit: Fit) -> tuple[dict[str, torch.Tensor], dict]:
        """See `Component`."""
        masks = {
            f"{TENSOR}{i}": x.transient.to(torch.uint8) for i, x in enumerate(fit.frames) if x.transient is not None
        }
        return masks, {} if self.present is None else {"transients": self.present}

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`.

        Raises:
            ValueError: If a mask has not the size of its photograph.
        """
        self.present = checkpoint.header.get("transients")
        for i, frame in enumerate(fit.frames):
            mask = checkpoint.tensors.get(f"{TENSOR}{i}")
            size = tuple(frame.pixels.shape[:2])
            if mask is not None and tuple(mask.shape) != size:
                raise ValueError(
                    f"{checkpoint.where}: {TENSOR}{i} must have the size {size} of its photograph, got "
                    f"{tuple(mask.shape)}; choose another run folder"
                )
            frame.transient = None if mask is None else mask.bool()

    def describe(self, event: Mapping[str, Any]) -> str | None:
        """See `Component`."""
        return line_of(event) if event["event"] == "transients" and event["found"] else None

    def metrics(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`."""
        is_on = self.present or fit.config.loss.transients == "mask"
        return {"transients": masked_share(fit.frames)} if is_on else {}

    @classmethod
    def tensor_kinds(cls, checkpoint: Checkpoint, count: int) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
        """See `Component`: a mask is a picture of any size."""
        masks = {name: x for name, x in checkpoint.tensors.items() if name.startswith(TENSOR)}
        return {name: (torch.uint8, (*x.shape, 0, 0)[:2]) for name, x in masks.items()}


def masked_share(frames: list[Frame]) -> dict:
    """How many photographs have a mask, `masked`, and its mean `share` of all their pixels."""
    masks = [frame.transient for frame in frames if frame.transient is not None]
    total = sum(float(mask.float().mean()) for mask in masks)
    return {"masked": len(masks), "share": total / len(frames)}


def line_of(event: Mapping[str, Any]) -> str:
    """What was found, in one line, of an event of `TransientsComponent.look`."""
    return (
        f"{event['photographs']} of {event['of']} photographs show over {100 * _DECISIVE_SHARE:g} % of what their "
        f"neighbors do not, up to {100 * event['worst']:.1f} % (median {100 * event['median']:.1f} %): left out of the "
        f"loss, {100 * event['share']:.1f} % of all pixels; --transients keep fits it"
    )


@dataclasses.dataclass
class _Compared:
    """A photograph beside its rendering, at the size at which photographs are compared.

    Attributes:
        camera: Pinhole of that size.
        residual: (3, H, W) photograph without its gain, less rendering, blurred.
        distance: (H, W) to what is rendered.
        valid: (H, W) whether the ray ends on something, inside the mask.
    """

    camera: Camera
    residual: torch.Tensor
    distance: torch.Tensor
    valid: torch.Tensor


def transient_masks(
    frames: list[Frame], gaussians: Gaussians, settings: RenderSettings
) -> tuple[list[torch.Tensor], list[float]]:
    """Where photographs differ from their neighbors.

    Args:
        frames: V photographs.
        gaussians: What has been fitted to them so far.
        settings: What it is rendered with.
    Returns:
        V masks (H, W), bool, and V shares of pixels that clearly differ, in [0, 1].
    """
    masks, shares = [], []
    with Bar("comparing photographs", 2 * len(frames)) as bar:
        compared = []
        for frame in frames:
            compared.append(_compared(frame, gaussians, settings))
            bar.advance()
        centers = np.stack([x.camera.center for x in compared])
        for i, frame in enumerate(frames):
            order = np.argsort(np.linalg.norm(centers - centers[i], axis=1), kind="stable")
            neighbors = [compared[j] for j in order if j != i][:_NEIGHBORS]
            excess = _excess(compared[i], neighbors)
            clear = excess > _CLEAR
            shares.append(float(clear.float().mean()))
            # One pixel more: the blur has drawn what is beside it into the difference at its border.
            grown = _grown(clear, excess > _EDGE, 1) if shares[-1] > _MASKED_SHARE else torch.zeros_like(clear)
            height, width = frame.pixels.shape[:2]
            masks.append(interpolate(grown.float()[None, None], (height, width), mode="nearest")[0, 0] > 0)
            bar.advance()
    return masks, shares


def _compared(frame: Frame, gaussians: Gaussians, settings: RenderSettings) -> _Compared:
    """A photograph beside its rendering."""
    width, height = reduced_size(frame.camera, _COMPARED_PIXELS)
    camera = frame.camera.resized(width, height)
    with torch.no_grad():  # compared, not optimized
        out = render(colors_only(gaussians, camera.time), camera, settings, outputs=("depth",))
    rgb = out.rgb.cpu().clamp(0, 1).permute(2, 0, 1)
    image = _reduced(frame.image().permute(2, 0, 1), height, width)
    valid = out.alpha.cpu() > _SOLID
    if frame.mask is not None:
        valid &= _reduced(frame.mask[None], height, width)[0] > 0.5
    assert out.depth is not None  # an output of this rendering
    distance = out.depth.cpu()
    if renders_z(settings):  # rays are followed along themselves
        distance = distance / axis_cosines(camera)
    # Exposure and white balance of a photograph are everywhere in it, and no object.
    gains = []
    for shown, fitted in zip(image, rgb, strict=True):
        bright = valid & (fitted > _DARK) & (shown > _DARK)
        gains.append((shown[bright] / fitted[bright]).median() if bright.any() else torch.ones(()))
    difference = (image / torch.stack(gains)[:, None, None] - rgb) * valid
    radius = max(1, round(_BLUR * width))
    residual = avg_pool2d(pad(difference[None], (radius,) * 4, mode="replicate"), 2 * radius + 1, 1)[0]
    return _Compared(camera, residual, distance, valid)


def _excess(one: _Compared, neighbors: list[_Compared]) -> torch.Tensor:
    """(H, W) by how much a residual differs from its neighbors' more than these from each other; 0 where few see it."""
    points = one.camera.center + one.camera.pixel_directions() * one.distance.double().numpy()[..., None]
    height, width = one.distance.shape
    seen = []
    for other in neighbors:
        pixels, depth = other.camera.project(points.reshape(-1, 3))
        size = np.array([other.camera.width, other.camera.height])
        where = torch.from_numpy(2 * pixels / size - 1).float().reshape(height, width, 2)
        distance = torch.from_numpy(np.linalg.norm(points - other.camera.center, axis=-1)).float()
        front = torch.from_numpy(depth > 0).reshape(height, width)
        maps = torch.cat([other.residual, other.distance[None], other.valid[None].float()])[None]
        sampled = grid_sample(maps, where.nan_to_num(2.0)[None], align_corners=False)[0]
        same = front & (where.abs() < 1).all(-1) & (sampled[4] > 0.5)
        same &= (sampled[3] - distance).abs() < _SAME_DISTANCE * distance
        seen.append(torch.where(same, sampled[:3], torch.nan))
    stack = torch.stack(seen)
    median = stack.nanmedian(0).values
    spread = (stack - median).abs().nanmedian(0).values.mean(0)
    count = (~stack[:, 0].isnan()).sum(0)
    # What the others' residual explains is no object of this one; nor is what this one's own rendering shows already.
    difference = torch.minimum((one.residual - median).abs().mean(0), one.residual.abs().mean(0))
    judged = one.valid & (count >= _FEWEST_NEIGHBORS)
    return torch.where(judged, difference - _SPREADS * spread, 0.0)


def _grown(seeds: torch.Tensor, allowed: torch.Tensor, border: int) -> torch.Tensor:
    """(H, W) bool seeds, what is allowed and connected with them, and a border of so many pixels around."""
    grown = seeds.float()[None]
    for _ in range(max(1, round(_GROWTH * seeds.shape[1]))):
        grown = max_pool2d(grown, 3, 1, 1) * (allowed | seeds)
    return max_pool2d(grown, 2 * border + 1, 1, border)[0] > 0


def _reduced(planes: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """(C, height, width) mean of areas of (C, H, W)."""
    return interpolate(planes[None], (height, width), mode="area")[0]
