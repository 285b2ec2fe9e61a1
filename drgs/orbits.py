"""Turntables: cameras on a circle around what there is to see."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import orbit

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians

__all__ = ["UP", "capture_orbit", "scene_orbit"]

UP = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "minus-x": (-1.0, 0.0, 0.0),
    "minus-y": (0.0, -1.0, 0.0),
    "minus-z": (0.0, 0.0, -1.0),
}
"""World directions by their names on the command line (a name must not begin with a dash)."""

_ELEVATION = 20.0
_SAMPLE = 20_000  # Gaussians that decide the radius
_FAR = 3.0  # times the median distance from the center: beyond are floaters and backgrounds
_INSIDE = 0.998  # share of the rest that every frame shows
_MARGIN = 1.1
_SOLID = 0.05  # opacity below which a Gaussian is no part of the shape
_PARALLEL = 0.05  # smallest eigenvalue of the axes' spread that still fixes the point they meet in


def scene_orbit(
    gaussians: Gaussians,
    frames: int,
    *,
    up: tuple[float, float, float],
    width: int,
    height: int,
    fov: float = 45.0,
    elevation: float | None = None,
) -> list[Camera]:
    """An orbit around the middle of the Gaussians, outliers aside, as close as all frames show them.

    Args:
        gaussians: At least one.
        frames: Number of cameras.
        up: (3,) world direction.
        width, height: Pixels.
        fov: Horizontal field of view in degrees.
        elevation: Degrees above the center, default 20.
    Raises:
        ValueError: If there is no Gaussian.
    """
    if not len(gaussians):
        raise ValueError("orbit: there must be at least one Gaussian, got none; use --cameras")
    means = gaussians.means.detach().cpu().numpy().astype(np.float64) + gaussians.origin
    sizes = gaussians.scales.detach().cpu().numpy().astype(np.float64).max(axis=1)
    solid = gaussians.opacities.detach().cpu().numpy() > _SOLID
    if solid.any():
        means, sizes = means[solid], sizes[solid]
    step = -(-len(means) // _SAMPLE)
    means, sizes = means[::step], sizes[::step]
    distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    near = distance <= _FAR * np.median(distance)
    means, reach = means[near], 2 * sizes[near]
    # The median says what belongs to the scene; the middle of that is what to turn around, since
    # the median lies where the detail is.
    center = np.quantile(means, (1 - _INSIDE, _INSIDE), axis=0).mean(axis=0)
    offsets = means - center
    shape = {"width": width, "height": height, "fov": fov, "up": up}
    elevation = _ELEVATION if elevation is None else elevation
    radius = 0.0
    for camera in orbit(center, 1.0, min(frames, 24), elevation, **shape):
        local = offsets @ camera.w2c[:3, :3].T
        # A point is in the frame of a camera at distance D if |x| <= (D + z) tan and |y| likewise.
        slope = 0.5 * np.array([width / camera.K[0, 0], height / camera.K[1, 1]]) / _MARGIN
        needed = ((np.abs(local[:, :2]) + reach[:, None]) / slope).max(axis=1) - local[:, 2]
        radius = max(radius, float(np.quantile(needed, _INSIDE)))
    return orbit(center, radius, frames, elevation, **shape)


def capture_orbit(
    cameras: list[Camera],
    frames: int,
    *,
    width: int,
    height: int,
    fov: float = 45.0,
    elevation: float | None = None,
) -> list[Camera]:
    """An orbit like that of the photographs: around the point they look at, at their distance and height.

    Args:
        cameras: The photographs'.
        frames, width, height, fov, elevation: As in `scene_orbit`; the elevation defaults to the photographs'.
    Returns:
        The cameras, or none where the photographs do not look at one point (a forward-facing or outward capture).
    """
    if len(cameras) < 3:
        return []
    poses = np.stack([camera.c2w for camera in cameras])
    eyes, axes, up = poses[:, :3, 3], poses[:, :3, 2], -poses[:, :3, 1].mean(axis=0)
    # The point nearest to all optical axes.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    spread = across.mean(axis=0)
    if np.linalg.eigvalsh(spread)[0] < _PARALLEL or np.linalg.norm(up) < 0.2:
        return []
    center = np.linalg.solve(spread, (across @ eyes[:, :, None])[:, :, 0].mean(axis=0))
    outward = eyes - center
    radius = np.linalg.norm(outward, axis=1)
    if np.median((axes * -outward).sum(axis=1) / np.maximum(radius, 1e-12)) < 0.5:
        return []
    up /= np.linalg.norm(up)
    if elevation is None:
        sines = (outward @ up) / np.maximum(radius, 1e-12)
        elevation = float(np.clip(np.degrees(np.arcsin(np.clip(np.median(sines), -1, 1))), -80, 80))
    return orbit(center, float(np.median(radius)), frames, elevation, width=width, height=height, fov=fov, up=up)
