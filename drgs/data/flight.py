"""Flights of a camera through keyframes: where it is, where it looks and how wide, at every moment between them.

Symbols: s_i are the seconds of keyframe i, h_i = s_i+1 - s_i the step after it, d_i its slope: what changes over that
step, divided by it. The rate at a keyframe is that of the parabola through it and both neighbors (the tangent of
Catmull-Rom splines for uneven steps), v_i = (h_i d_i-1 + h_i-1 d_i) / (h_i-1 + h_i), shortened where it is longer than
the shorter slope; at an open end it is (3 d - v) / 2, of a spline whose ends do not bend, shortened alike. Between two
keyframes runs the cubic that has both values and both rates. So a flight passes through every keyframe, changes its
rates nowhere suddenly, stands still between two equal keyframes, and backwards goes the same way.

By the Bernstein form a cubic is off the chord by no more than (u (1 - u)^2 + u^2 (1 - u)) h max|v - d|, at most
h |2 d| / 4: a flight leaves the straight way between two keyframes by no more than half of its length.

Reference: Barry and Goldman, "A recursive evaluation algorithm for a class of Catmull-Rom splines", SIGGRAPH 1988;
Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985 (Bezier curves of rotations, by slerp).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from drgs.cameras import Camera, intrinsics

__all__ = ["Flight", "Keyframe", "quaternion_of", "rotation_of"]

_TINY = 1e-12  # radians: below, an arc and its chord are the same to rounding


@dataclasses.dataclass(frozen=True, eq=False)
class Keyframe:
    """A camera that a flight passes through.

    Attributes:
        position: (3,) center of the camera in the world.
        wxyz: (4,) quaternion of camera to world, OpenCV axes, of length 1.
        fov: Vertical field of view in degrees.
        seconds: Time at which the flight is there; only differences count.
        time: Time of the scene, of one that moves.
    """

    position: np.ndarray
    wxyz: np.ndarray
    fov: float
    seconds: float
    time: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Flight:
    """A way through keyframes.

    Attributes:
        keyframes: Keyframes in the order of their seconds, at least one, no two at the same; all have a time, or none.
        duration: Seconds of the whole flight, to which those of the keyframes are stretched; None leaves them.
        loop: Whether it ends where it began, after one more step as long as the others in the mean.
        fps: Frames a second; None where the file says nothing.
        width, height: Pixels of the pictures; None where the file says nothing.
    """

    keyframes: tuple[Keyframe, ...]
    duration: float | None = None
    loop: bool = False
    fps: float | None = None
    width: int | None = None
    height: int | None = None

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return float(self._knots()[-1]) if self.duration is None else self.duration

    def frame_count(self, fps: float) -> int:
        """Number of frames of a film: both ends are frames, but of a loop, whose end is its begin."""
        return max(1, round(self.seconds * fps) + (0 if self.loop else 1))

    def shares(self, count: int) -> np.ndarray:
        """(count,) shares of the way, evenly in time: from 0 to 1, of a loop to one step before 1."""
        if self.loop:
            return np.arange(count) / count
        return np.linspace(0.0, 1.0, count) if count > 1 else np.zeros(count)

    def at(self, shares: np.ndarray) -> list[Keyframe]:
        """Where the camera is after shares of the flight's duration in [0, 1]; `seconds` are those of the flight."""
        keys = [*self.keyframes, *self.keyframes[: self.loop]]
        knots = self._knots()
        steps = np.diff(knots)
        shares = np.asarray(shares, np.float64)
        if len(keys) == 1 or not len(steps):
            return [dataclasses.replace(keys[0], seconds=float(x * self.seconds)) for x in shares]
        moments = shares * knots[-1]
        number = np.clip(np.searchsorted(knots, moments, side="right") - 1, 0, len(steps) - 1)
        part = ((moments - knots[number]) / steps[number])[:, None]
        places = np.array([key.position for key in keys], np.float64)
        position = _through(places, np.diff(places, axis=0), steps, self.loop, np.add, _lerp, number, part)
        zoom = np.log(np.tan(np.radians([key.fov for key in keys]) / 2))[:, None]
        zoom = _through(zoom, np.diff(zoom, axis=0), steps, self.loop, np.add, _lerp, number, part, monotone=True)
        turns = np.array([key.wxyz for key in keys], np.float64)
        ways = _logarithm(_product(turns[:-1] * [1, -1, -1, -1], turns[1:]))
        wxyz = _through(turns, ways, steps, self.loop, _turned, _slerp, number, part)
        fovs = np.degrees(2 * np.arctan(np.exp(zoom[:, 0])))
        times: list[float | None] = [None] * len(shares)
        if keys[0].time is not None:
            times = list(np.interp(moments, knots, np.array([key.time for key in keys], np.float64)).tolist())
        return [
            Keyframe(position[k], wxyz[k] / np.linalg.norm(wxyz[k]), float(fovs[k]), float(x * self.seconds), times[k])
            for k, x in enumerate(shares)
        ]

    def cameras(self, count: int, width: int, height: int) -> list[Camera]:
        """Pinhole cameras of frames, evenly in time."""
        made = []
        for k, key in enumerate(self.at(self.shares(count))):
            focal = 0.5 * height / math.tan(math.radians(key.fov) / 2)
            w2c = np.eye(4)
            w2c[:3, :3] = rotation_of(key.wxyz).T
            w2c[:3, 3] = -w2c[:3, :3] @ key.position
            K = intrinsics(focal, focal, width / 2, height / 2)
            made.append(Camera(K=K, w2c=w2c, width=width, height=height, name=f"flight_{k:04d}", time=key.time))
        return made

    def _knots(self) -> np.ndarray:
        """Seconds of the keyframes from the first one on, and of a loop of its end."""
        knots = np.array([key.seconds for key in self.keyframes], np.float64)
        knots -= knots[0]
        if self.loop and len(knots) > 1:
            knots = np.append(knots, knots[-1] + np.diff(knots).mean())
        return knots


def _through(
    values: np.ndarray,
    ways: np.ndarray,
    steps: np.ndarray,
    loop: bool,
    moved: Callable[[np.ndarray, np.ndarray], np.ndarray],
    between: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    number: np.ndarray,
    part: np.ndarray,
    monotone: bool = False,
) -> np.ndarray:
    """Cubic Bezier curves through values, by de Casteljau, whose rates at the values are as the module says.

    Args:
        values: (M + 1, D) of the keyframes, of a loop with the first one again.
        ways: (M, E) what changes over each step.
        steps: (M,) seconds.
        loop: Whether the last value is the first.
        moved: Function that moves values by changes.
        between: Function that goes from values to values, by shares.
        number, part: (S,) number of the step and (S, 1) share of it, of each sample.
        monotone: Whether a value that is between its neighbors nowhere (a peak) is passed at a rate of 0.
    Returns:
        (S, D) values.
    """
    slopes = ways / steps[:, None]
    rates = _rates(slopes, steps, loop, monotone)
    third = steps[:, None] / 3
    end = moved(values[:-1], ways)
    first, second = moved(values[:-1], rates[:-1] * third), moved(end, -rates[1:] * third)
    points = [x[number] for x in (values[:-1], first, second, end)]
    while len(points) > 1:
        points = [between(a, b, part) for a, b in zip(points, points[1:], strict=False)]
    return points[0]


def _rates(slopes: np.ndarray, steps: np.ndarray, loop: bool, monotone: bool) -> np.ndarray:
    """(M + 1, E) rates at the ends of M steps."""
    before, after = (np.roll(slopes, 1, axis=0), slopes) if loop else (slopes[:-1], slopes[1:])
    h0, h1 = (np.roll(steps, 1), steps) if loop else (steps[:-1], steps[1:])
    rates = (h1[:, None] * before + h0[:, None] * after) / (h0 + h1)[:, None]
    rates = _shortened(rates, np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)))
    if monotone:
        rates = np.where(before * after > 0, rates, 0.0)
    if loop:
        return np.concatenate([rates, rates[:1]])
    if not len(rates):
        return np.concatenate([slopes, slopes])
    ends = _shortened(1.5 * slopes[[0, -1]] - 0.5 * rates[[0, -1]], np.linalg.norm(slopes[[0, -1]], axis=1))
    return np.concatenate([ends[:1], rates, ends[1:]])


def _shortened(rates: np.ndarray, longest: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(rates, axis=1)
    return rates * np.minimum(1.0, longest / np.where(length > 0, length, 1.0))[:, None]


def _lerp(a: np.ndarray, b: np.ndarray, part: np.ndarray) -> np.ndarray:
    return (1 - part) * a + part * b


# ------------------------------------------------------------------------------------------ rotations
# Here rates are in the axes of the camera. All points that de Casteljau goes between are less than half a turn of the
# quaternions' sphere apart, since no rate is longer than a slope: two keyframes are at most 90 degrees apart there, and
# a sixth of a step is at most 30. So no arc is ambiguous, and no sign of a quaternion need be changed on the way.


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """(4,) wxyz of a rotation: the eigenvector of the matrix whose form is largest at it, which no angle spoils."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.reshape(-1)
    form = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, yx + xy, xz + zx],
            [xz - zx, yx + xy, yy - xx - zz, zy + yz],
            [yx - xy, xz + zx, zy + yz, zz - xx - yy],
        ]
    )
    found = np.linalg.eigh(form)[1][:, -1]
    return found if found[0] >= 0 else -found


def rotation_of(wxyz: np.ndarray) -> np.ndarray:
    """(3,3) of a quaternion of any length but 0."""
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 4) products of quaternions: b is done first, or, of rotations of axes, in those of a."""
    w = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(axis=-1, keepdims=True)
    return np.concatenate(
        [w, a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])], axis=-1
    )


def _logarithm(q: np.ndarray) -> np.ndarray:
    """(..., 3) axis times angle of unit quaternions, the shorter way round."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > _TINY, angle / np.where(sine > _TINY, sine, 1.0), 2.0)


def _turned(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Quaternions, turned in their own axes by axis times angle."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return _product(q, np.concatenate([np.cos(half), 0.5 * vector * np.sinc(half / np.pi)], axis=-1))


def _slerp(a: np.ndarray, b: np.ndarray, part: np.ndarray) -> np.ndarray:
    """From unit quaternions to others along great circles, at an even pace; neither changes its sign."""
    apart = np.linalg.norm(a - b, axis=-1, keepdims=True), np.linalg.norm(a + b, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(*apart)
    bent = angle > 1e-6
    sine = np.where(bent, np.sin(angle), 1.0)
    far = (np.sin((1 - part) * angle) * a + np.sin(part * angle) * b) / sine
    return np.where(bent, far, _lerp(a, b, part))
