"""Orbits: cameras around the subject of the photographs, where these show that a camera can stand, or around Gaussians.

Three kinds of capture, which are distinguished by their cameras alone:

- The optical axes meet, or all cameras look the same way: frames go around the point looked at, on a full circle if
  the cameras surround it, else back and forth within the span that they cover.
- Neither (a walk through rooms, a drive): frames follow the photographs' own path.
- No cameras (a file of Gaussians): frames go around the middle of the Gaussians.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from drgs.cameras import Camera, intrinsics_from_fov, look_at, orbit
from drgs.commands.values import UP, OrbitShape
from drgs.data.camera_layout import Focus, path, upright

if TYPE_CHECKING:
    from collections.abc import Callable

    from drgs.ellipsoids import Gaussians

# Chosen, not tuned.
_DEFAULT_ELEVATION = 20.0  # degrees above the center, from which tables and objects are usually seen
_DEFAULT_FOV = 45.0  # degrees, horizontal, about that of a normal lens
_MOST_ELEVATION = 80.0  # degrees of elevation; nearer to the pole a circle turns on the spot
_SAMPLED_GAUSSIANS = 20_000  # Gaussians that decide the distance, at most: more would take seconds
_FAR_FACTOR = 3.0  # times the median distance from the center: beyond are floaters and backgrounds
_INSIDE_SHARE = 0.998  # share of the rest that every frame shows
_MARGIN = 1.1  # of the frame's size over that of the Gaussians in it
_SOLID_OPACITY = 0.05  # opacity below which a Gaussian is no part of the shape


def scene_orbit(
    gaussians: Gaussians,
    frames: int,
    *,
    width: int,
    height: int,
    fixed: OrbitShape | None = None,
    returns: bool = False,
) -> list[Camera]:
    """An orbit around the middle of the Gaussians, outliers aside, as close as all frames show them.

    Args:
        gaussians: Gaussians to turn around, at least one.
        frames: Number of cameras.
        width, height: Pixels.
        fixed: What is fixed; else up is -y, as in COLMAP's worlds, the elevation 20 and the field of view 45 degrees.
        returns: Whether an orbit of less than a full circle goes back and forth; else evenly from end to end.
    Raises:
        ValueError: If there is no Gaussian.
    """
    if not len(gaussians):
        raise ValueError("orbit: there must be at least one Gaussian, got none; use --cameras")
    fixed = fixed or OrbitShape()
    center, offsets, reach = _shape(gaussians)
    if fixed.center is not None:
        offsets = offsets + center - fixed.center
        center = np.asarray(fixed.center, np.float64)
    up = _unit(fixed.up or UP["minus-y"])
    elevation = _DEFAULT_ELEVATION if fixed.elevation is None else fixed.elevation
    lens = _Lens(intrinsics_from_fov(fixed.fov or _DEFAULT_FOV, width, height), width, height)
    front = _level(np.eye(3)[np.argmin(np.abs(up))], up)  # any direction; this choice is stable
    distance = fixed.distance
    if distance is None:
        distance = 0.0
        for camera in _around(center, up, front, _turns(min(frames, 24), 360.0, False), 1.0, elevation, lens):
            local = offsets @ camera.w2c[:3, :3].T
            # A point is in the frame of a camera at distance D if |x| <= (D + z) tan and |y| likewise.
            slope = 0.5 * np.array([width / lens.K[0, 0], height / lens.K[1, 1]]) / _MARGIN
            needed = ((np.abs(local[:, :2]) + reach[:, None]) / slope).max(axis=1) - local[:, 2]
            distance = max(distance, float(np.quantile(needed, _INSIDE_SHARE)))
    turns = _turns(frames, 360.0 if fixed.span is None else fixed.span, returns)
    return _around(center, up, front, turns, distance, elevation, lens)


def capture_orbit(
    cameras: list[Camera],
    frames: int,
    *,
    width: int,
    height: int,
    fixed: OrbitShape | None = None,
    distance_of: Callable[[Camera], float | None] | None = None,
    returns: bool = False,
    beyond: bool = False,
) -> tuple[list[Camera], str]:
    """Frames near where the photographs were taken: around what they look at, or along their path.

    Args:
        cameras: The photographs'.
        frames, width, height, returns: The same as in `scene_orbit`.
        fixed: What is fixed; else center, distance, elevation, up, span and lens are the photographs'.
        distance_of: How far away what a camera looks at is (`seen_distance`), or None if it sees nothing. Asked where
            the axes are parallel, so that they meet nowhere.
        beyond: Whether to go all the way round where the axes meet, past what the cameras cover, and to follow no path.
    Returns:
        The cameras and what they do in words; none where the photographs determine none (there are fewer than two, or
        they look apart and lie apart, or `beyond` they look at no common point).
    Raises:
        ValueError: If something is fixed that needs a center, and the photographs look at no common point.
    """
    fixed = fixed or OrbitShape()
    lens = _Lens.like(cameras, width, height, fixed.fov) if cameras else None
    focus = Focus.of(cameras, fixed.center, distance_of)
    if focus is None:
        poses = [] if beyond else path(cameras, frames)
        if poses and fixed.moves:
            raise ValueError(
                "orbit: up, distance, elevation and span must have center=X,Y,Z in --orbit here, the photographs look "
                "at no common point; add it, or drop them to follow the photographs' path"
            )
        made = [lens.camera(w2c, index) for index, w2c in enumerate(poses)]
        return made, f"along the path of the photographs, {frames} frames" if made else ""
    up = _unit(fixed.up) if fixed.up is not None else upright(cameras)
    middle, span, distance, elevation = focus.stand(up)
    if beyond and focus.is_met:
        span = 360.0
    span = span if fixed.span is None else fixed.span
    distance = distance if fixed.distance is None else fixed.distance
    elevation = np.clip(elevation, -_MOST_ELEVATION, _MOST_ELEVATION) if fixed.elevation is None else fixed.elevation
    made = _around(focus.center, up, middle, _turns(frames, span, returns), distance, float(elevation), lens)
    kind = "circle" if span >= 360 else f"swing of {span:.0f} degrees"
    far = float(np.abs(focus.center).max()) / distance
    digits = 3 + max(0, math.floor(math.log10(far))) if far > 0 else 3  # so that three are of the scene's own size
    place = ", ".join(f"{x:.{digits}g}" for x in focus.center)
    return made, f"{kind} around ({place}) at distance {distance:.3g}, {elevation:.0f} degrees up, like the photographs"


def dome(circle: list[Camera], count: int) -> list[Camera]:
    """Cameras on the upper half of a sphere, evenly: rings of equal steps in elevation.

    Args:
        circle: Cameras around the sphere's equator, evenly spaced, looking at its center; their lens is taken.
        count: How many.
    """
    centers = np.stack([camera.center for camera in circle])
    middle = centers.mean(axis=0)
    up = -circle[0].c2w[:3, 1]
    radius = float(np.linalg.norm(centers - middle, axis=1).mean())
    rings = max(1, round(math.sqrt(count * math.pi / 8)))  # as far apart as the cameras of a ring are
    elevations = 90 * (np.arange(rings) + 0.5) / rings
    share = np.cumsum(np.cos(np.radians(elevations)))
    ends = np.round(count * share / share[-1]).astype(int)
    made = []
    for elevation, number in zip(elevations, np.diff(ends, prepend=0), strict=True):
        if number:
            made += orbit(middle, radius, int(number), float(elevation), up=up)
    return [
        dataclasses.replace(circle[0], w2c=camera.w2c, name=f"dome_{index:04d}") for index, camera in enumerate(made)
    ]


def _shape(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The middle (3,) of the Gaussians without outliers, their offsets (P,3) from it and their reach (P,)."""
    # Values, to place cameras by.
    means = gaussians.means.detach().cpu().numpy().astype(np.float64) + gaussians.origin
    sizes = gaussians.scales.detach().cpu().numpy().astype(np.float64).max(axis=1)
    solid = gaussians.opacities.detach().cpu().numpy() > _SOLID_OPACITY
    if solid.any():
        means, sizes = means[solid], sizes[solid]
    step = -(-len(means) // _SAMPLED_GAUSSIANS)
    means, sizes = means[::step], sizes[::step]
    distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    near = distance <= _FAR_FACTOR * np.median(distance)
    means = means[near]
    reach = 2 * sizes[near]
    # The median says what belongs to the scene; the middle of that is what to turn around, since
    # the median lies where the detail is.
    center = np.quantile(means, (1 - _INSIDE_SHARE, _INSIDE_SHARE), axis=0).mean(axis=0)
    return center, means - center, reach


@dataclasses.dataclass(frozen=True)
class _Lens:
    """Intrinsics (3,3) and size of every frame."""

    K: np.ndarray
    width: int
    height: int

    @classmethod
    def like(cls, cameras: list[Camera], width: int, height: int, fov: float | None) -> _Lens:
        """A pinhole with the median field of view of the photographs, and more where the frame's shape differs."""
        if fov is None:
            wide = np.median([camera.width / camera.K[0, 0] for camera in cameras])
            high = np.median([camera.height / camera.K[1, 1] for camera in cameras])
            fov = 2 * math.degrees(math.atan(0.5 * max(wide, high * width / height)))
        return cls(intrinsics_from_fov(fov, width, height), width, height)

    def camera(self, w2c: np.ndarray, index: int) -> Camera:
        return Camera(K=self.K, w2c=w2c, width=self.width, height=self.height, name=f"orbit_{index:04d}")


def _around(
    center: np.ndarray,
    up: np.ndarray,
    front: np.ndarray,
    turns: np.ndarray,
    distance: float,
    elevation: float,
    lens: _Lens,
) -> list[Camera]:
    """Cameras at azimuths (radians) from the direction `front`, looking at the center."""
    side = np.cross(up, front)
    rise = math.radians(elevation)
    made = []
    for index, turn in enumerate(turns):
        outward = math.cos(rise) * (math.cos(turn) * front + math.sin(turn) * side) + math.sin(rise) * up
        made.append(lens.camera(look_at(center + distance * outward, center, up), index))
    return made


def _turns(frames: int, span: float, returns: bool) -> np.ndarray:
    """Azimuths in radians: around the circle, or from end to end of a span (and back) about 0."""
    index = np.arange(frames)
    if span >= 360:
        return 2 * np.pi * index / frames
    if returns:
        # Started where no two frames of the way there and back stand at the same place.
        return math.radians(span / 2) * np.sin(2 * np.pi * (index + (0.0 if frames % 2 else 0.25)) / frames)
    return math.radians(span) * ((index + 0.5) / frames - 0.5)


def _unit(vector: npt.ArrayLike) -> np.ndarray:
    vector = np.asarray(vector, np.float64)
    return vector / np.linalg.norm(vector)


def _level(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The direction without its part along up, of length 1."""
    return _unit(direction - (direction @ up) * up)
