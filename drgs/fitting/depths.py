"""Rendered depth beside that of depth maps, which is z, whatever a renderer's own depth is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.fitting.frames import Frame
    from drgs.integrator import Output
    from drgs.settings import RenderSettings


def renders_z(settings: RenderSettings) -> bool:
    """Whether `drgs.integrator.Output.depth` is z with these settings; else it is the distance along the ray."""
    return settings.planar and settings.depth_key == "z"


def axis_cosines(camera: Camera) -> torch.Tensor:
    """(H, W) float32 z over distance along the ray of each pixel, lens included; not positive beside or behind."""
    return torch.from_numpy(camera.local_directions()[..., 2]).float()


def depth_error(out: Output, frame: Frame, settings: RenderSettings) -> float | None:
    """Mean of |z - z_map| / z_map over the pixels where a depth map knows z_map, inside the mask.

    Args:
        out: A rendering with its depth.
        frame: The photograph of its size.
        settings: What it was rendered with.
    Returns:
        None where the photograph has no depth map, or none of its pixels counts.
    """
    if frame.depth is None or out.depth is None:
        return None
    measured = torch.from_numpy(frame.depth())
    depth = out.depth.detach().cpu()  # a measure, not a loss
    z = depth if renders_z(settings) else depth * axis_cosines(frame.camera)
    weights = (measured > 0).double()
    if frame.mask is not None:
        weights = weights * frame.mask
    if not bool(weights.any()):
        return None
    error = (z.double() / measured.double().clamp_min(1e-30) - 1).abs()
    return float((torch.where(weights > 0, error, 0.0) * weights).sum() / weights.sum())
