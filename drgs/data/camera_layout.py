"""Layout of a capture by its poses: the point looked at, the stations, the up direction, the path.

Poses and image sizes only; no image is opened.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from drgs.cameras import Camera, look_at
from drgs.cameras.origins import origin_near, rounding

# Angles and shares are chosen by hand, so that orbits, forward-facing captures, walks and drives of the data sets in
# tests/test_orbits.py are classified rightly; no study varied them.
_REWEIGHTINGS = 30  # rounds of reweighting, at most; the median of lines settles in about ten
_MIN_CONVERGENCE = 0.02  # smallest mean squared sine between the axes and their mean: 8 degrees
_PARALLEL_AXES = 0.8  # length of the mean axis of cameras that look the same way: within about 37 degrees
_AIMED_COSINE = 0.85  # cosine between an axis and the way to the point looked at: 32 degrees
_MIN_SHARE_IN_FRONT = 0.75  # share of the cameras that must have the common point in front of them
_DEPTH_PROBES = 8  # cameras whose distance to the surface is taken
_WIDEST_GAP = 90.0  # degrees without a camera that a circle may pass
_LEAST_SPAN = 5.0  # degrees; cameras within less stand in a row, on a drive
_IMAGE_UP_WEIGHT = 0.05  # weight of the images' up where their horizontals leave it open
_MAX_STEP_RATIO = 8.0  # times the median step between photographs: no path leads there
_MAX_PATH_TURN = 75.0  # degrees between two photographs that follow each other on one path
_MIN_SMOOTHING = 0.75  # standard deviation of the smoothing in steps between photographs, at least
_MAX_PITCH = 80.0  # degrees above or below the horizon, beyond which an axis does not say what is ahead
_SMOOTHINGS_PER_PATH = 40  # at least 1 / 40 of the whole path, of which a video has many photographs
REFERENCE_EXTENT = 5.0  # world units: `scene_extent` of the scenes that others' constants with a length in them are for
_EXTENT_MARGIN = 1.1  # 3DGS's own factor of the radius of the cameras
_MOST_ROUNDING = 1e-3  # pixels that float64 may round a place in the scene by


@dataclasses.dataclass(frozen=True)
class Focus:
    """A point that cameras look at.

    Attributes:
        center: (3,) world.
        eyes: (V, 3) of the cameras that look at it.
        is_met: Whether the optical axes fix it, or a user does; else it lies where what they see is.
    """

    center: np.ndarray
    eyes: np.ndarray
    is_met: bool

    @classmethod
    def of(
        cls,
        cameras: list[Camera],
        center: tuple[float, float, float] | None = None,
        distance_of: Callable[[Camera], float | None] | None = None,
    ) -> Focus | None:
        """What most of the cameras look at.

        Args:
            cameras: Any number.
            center: The point, if it is given.
            distance_of: Distance from a camera to the surface in front of it; used where axes are parallel.
        Returns:
            None where there are fewer than two cameras or no such point.
        """
        if len(cameras) < (2 if center is None else 1):
            return None
        poses = np.stack([camera.c2w for camera in cameras])
        eyes, axes = poses[:, :3, 3], poses[:, :3, 2]
        if center is not None:
            return cls(np.asarray(center, np.float64), eyes, True)
        across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
        if np.linalg.eigvalsh(across.mean(axis=0))[0] >= _MIN_CONVERGENCE:
            met = _meeting_point(eyes, across)
            aimed = _aimed(met, eyes, axes)
            if aimed.mean() >= _MIN_SHARE_IN_FRONT:
                return cls(met, eyes[aimed], True)
        mean = axes.mean(axis=0)
        if distance_of is None or np.linalg.norm(mean) < _PARALLEL_AXES:
            return None
        mean /= np.linalg.norm(mean)
        moved = eyes - eyes.mean(axis=0)
        along = moved @ mean
        if (along**2).sum() > 0.5 * (moved**2).sum():  # a drive: they move where they look
            return None
        probes = (
            [cameras[i * len(cameras) // _DEPTH_PROBES] for i in range(_DEPTH_PROBES)]
            if len(cameras) > _DEPTH_PROBES
            else cameras
        )
        seen = [distance for distance in map(distance_of, probes) if distance is not None]
        if not seen:
            return None
        ahead = np.median(eyes, axis=0) + np.median(seen) * mean
        aimed = _aimed(ahead, eyes, axes)
        focus = cls(ahead, eyes[aimed], False)
        if aimed.mean() < _MIN_SHARE_IN_FRONT or focus.stand(upright(cameras))[1] < _LEAST_SPAN:
            return None
        return focus

    def stand(self, up: np.ndarray) -> tuple[np.ndarray, float, float, float]:
        """Where the cameras stand around the center.

        Args:
            up: (3,) of length 1.
        Returns:
            The level direction (3,) from the center to the middle of the span that they cover, or to the first one if
            they surround it; the span in degrees (360: they do); their median distance; their median elevation in
            degrees.
        """
        outward = self.eyes - self.center
        first = np.cross(np.cross(up, np.eye(3)[np.argmin(np.abs(up))]), up)
        first /= np.linalg.norm(first)
        second = np.cross(up, first)
        azimuths = np.degrees(np.arctan2(outward @ second, outward @ first))
        start, span, inside = _covered(azimuths)
        turn = np.radians(start + (0.0 if span >= 360 else span / 2))
        distance = np.linalg.norm(outward, axis=1)
        sines = outward @ up / np.maximum(distance, 1e-12)  # a camera at the center has 0 / 0: level
        # A camera straight above has a sine that exceeds 1 by rounding, of which arcsin is NaN.
        elevation = np.degrees(np.arcsin(np.clip(np.median(sines[inside]), -1, 1)))
        middle = np.cos(turn) * first + np.sin(turn) * second
        return middle, span, float(np.median(distance[inside])), float(elevation)


def upright(cameras: list[Camera]) -> np.ndarray:
    """(3,) world direction of length 1 that is up in photographs held level.

    The horizontals of level photographs are level whatever they look down on, and all at a right angle to it; the mean
    of the images' up, which leans towards what is looked down on from one side, decides where they leave it open.
    """
    poses = np.stack([camera.c2w for camera in cameras])
    rights = poses[:, :3, 0]
    mean = -poses[:, :3, 1].mean(axis=0)
    length = np.linalg.norm(mean)
    if length > 1e-9:  # below it they point everywhere, and what is left of the mean is rounding
        mean /= length
    lean = np.eye(3) - np.outer(mean, mean)
    up = np.linalg.eigh(rights.T @ rights / len(rights) + _IMAGE_UP_WEIGHT * lean)[1][:, 0]
    return up if up @ mean >= 0 else -up


def level_frame(camera: Camera, up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and ahead (3,) of a camera that is held level, each of length 1.

    Args:
        camera: The camera. If it looks almost straight down, ahead is where the upper edge of its picture points, if
            almost straight up, the lower one.
        up: (3,) of length 1.
    """
    axis = camera.c2w[:3, 2]
    ahead = axis - (axis @ up) * up
    if np.linalg.norm(ahead) < np.cos(np.radians(_MAX_PITCH)):
        ahead = camera.c2w[:3, 1] * np.sign(axis @ up)
        ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.cross(ahead, up), up, ahead


def scene_extent(cameras: list[Camera], points: np.ndarray | None = None) -> float:
    """1.1 x the largest distance of a camera center to their mean (3DGS), in scene units.

    Where that is 0 (one camera, or all at one place), 1.1 x the median distance of the points to
    it; 1.0 without points.

    Args:
        cameras: Cameras, at least one.
        points: (P,3) world points, used only in that case.
    """
    if not cameras:
        raise ValueError("scene_extent: there must be at least one camera, got none; pass the training views' cameras")
    centers = np.stack([camera.center for camera in cameras])
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - middle, axis=1).max())
    if spread > rounding(centers):  # else they stand in one place
        return _EXTENT_MARGIN * spread
    if points is not None and len(points):
        return _EXTENT_MARGIN * float(np.median(np.linalg.norm(points - middle, axis=1)))
    return 1.0


def scene_origin(where: str, cameras: list[Camera], points: np.ndarray | None = None) -> np.ndarray:
    """(3,) float64 origin that Gaussians seen by cameras are kept relative to: 0 unless they stand far from there.

    Far is more than 10 times `scene_extent` (`drgs.cameras.origins.origin_near`).

    Args:
        where: Where the cameras come from, for messages.
        cameras: Cameras, at least one.
        points: (P,3) world points, as of `scene_extent`.
    Raises:
        ValueError: If float64 rounds places in the scene by more than 1e-3 of a pixel.
    """
    extent = scene_extent(cameras, points)
    for camera in cameras:
        far = float(np.linalg.norm(camera.center))
        off = float(np.spacing(far)) * float(max(camera.K[0, 0], camera.K[1, 1])) / extent
        if off > _MOST_ROUNDING:
            raise ValueError(
                f"{where}: cameras must stand where float64 holds {_MOST_ROUNDING:g} of a pixel, got {camera.name!r} "
                f"{far:.3g} from 0, where it rounds by {off:.2g} pixels of a scene {extent:.3g} wide; subtract an "
                "offset from all positions"
            )
    return origin_near(np.stack([camera.center for camera in cameras]).mean(axis=0), extent)


def middle_camera(cameras: list[Camera]) -> Camera:
    """The camera whose place is nearest to the middle of all, coordinate by coordinate."""
    centers = np.stack([camera.center for camera in cameras])
    return cameras[int(np.linalg.norm(centers - np.median(centers, axis=0), axis=1).argmin())]


def path(cameras: list[Camera], frames: int) -> list[np.ndarray]:
    """World-to-camera matrices (4,4) along the way that the photographs were taken, smoothed, at even speed.

    The longest stretch without a jump of the cameras in their order, so that nothing is crossed that they did not.

    Returns:
        None of them where no three cameras in a row are near each other.
    """
    if len(cameras) < 3:
        return []
    poses = np.stack([camera.c2w for camera in cameras])
    walked = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    # The product of two axes of length 1 exceeds 1 by rounding, of which arccos is NaN.
    turned = np.degrees(np.arccos(np.clip((poses[1:, :3, 2] * poses[:-1, :3, 2]).sum(axis=1), -1, 1)))
    typical = max(float(np.median(walked)), 1e-12)  # a divisor, and most of them may not have moved at all
    breaks = np.flatnonzero((walked > _MAX_STEP_RATIO * typical) | (turned > _MAX_PATH_TURN)) + 1
    stretch = max(np.split(np.arange(len(poses)), breaks), key=len)
    if len(stretch) < 3:
        return []
    poses = poses[stretch]
    walked = walked[stretch[:-1]]
    turned = turned[stretch[:-1]]
    # A turn by 30 degrees takes as long as a step; times increase even where a camera stays as it is.
    times = np.concatenate([[0.0], np.cumsum(np.maximum(walked / typical + turned / 30, 1e-3))])
    width = max(_MIN_SMOOTHING * times[-1] / (len(times) - 1), times[-1] / _SMOOTHINGS_PER_PATH)
    made = []
    for time in np.linspace(0, times[-1], frames):
        weights = np.exp(-0.5 * ((times - time) / width) ** 2)
        pose = np.tensordot(weights / weights.sum(), poses, 1)
        eye = pose[:3, 3]
        made.append(look_at(eye, eye + pose[:3, 2], -pose[:3, 1]))
    return made


def _meeting_point(eyes: np.ndarray, across: np.ndarray) -> np.ndarray:
    """The point (3,) whose distances to the optical axes have the smallest sum: a few stray cameras do not move it.

    Args:
        eyes: (V, 3).
        across: (V, 3, 3) projections onto the plane across each axis.
    """
    weights = np.ones(len(eyes))
    for _ in range(_REWEIGHTINGS):
        total = (weights[:, None, None] * across).sum(axis=0)
        point = np.linalg.solve(total, (weights[:, None] * (across @ eyes[:, :, None])[:, :, 0]).sum(axis=0))
        miss = np.linalg.norm((across @ (point - eyes)[:, :, None])[:, :, 0], axis=1)
        # An axis that is met exactly must not take all the weight.
        weights = 1 / np.maximum(miss, max(1e-3 * float(np.median(miss)), 1e-12))
        weights /= weights.max()
    return point


def _aimed(point: np.ndarray, eyes: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(V,) bool: which cameras have the point before them, near the middle of the picture."""
    ahead = point - eyes
    return (ahead * axes).sum(axis=1) >= _AIMED_COSINE * np.linalg.norm(ahead, axis=1)


def _covered(azimuths: np.ndarray) -> tuple[float, float, np.ndarray]:
    """The arc that holds most cameras without a wide gap: its start, its span (360 without a wide gap at all), both in
    degrees, and which cameras (V,) lie in it.

    Args:
        azimuths: (V,) degrees.
    """
    # Stable: cameras of one azimuth keep their order on every machine.
    order = np.argsort(azimuths, kind="stable")
    around = azimuths[order]
    gaps = np.diff(around, append=around[0] + 360)
    wide = np.flatnonzero(gaps > _WIDEST_GAP)
    if not len(wide):
        return float(azimuths[0]), 360.0, np.ones(len(azimuths), bool)
    # Begin after a wide gap; every wide gap then ends a piece.
    order = np.roll(order, -(wide[-1] + 1))
    ends = np.flatnonzero(np.roll(gaps, -(wide[-1] + 1)) > _WIDEST_GAP) + 1
    piece = max(np.split(order, ends[:-1]), key=len)
    inside = np.zeros(len(azimuths), bool)
    inside[piece] = True
    start = float(azimuths[piece[0]])
    return start, float((azimuths[piece[-1]] - start) % 360), inside
