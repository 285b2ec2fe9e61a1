"""Paths of a camera through keyframes: where it is, where it looks and how wide, at every moment between them.

Symbols: s_i are the seconds of keyframe i, h_i = s_i+1 - s_i the step after it, d_i its slope: what changes over that
step, divided by it. The rate at a keyframe is that of the parabola through it and both neighbors (the tangent of
Catmull-Rom splines for uneven steps), v_i = (h_i d_i-1 + h_i-1 d_i) / (h_i-1 + h_i), shortened where it is longer than
the shorter slope; at an open end it is (3 d - v) / 2, of a spline whose ends do not bend, shortened alike. Between two
keyframes runs the cubic that has both values and both rates. So a path passes through every keyframe, changes its
rates nowhere suddenly, stands still between two equal keyframes, and backwards goes the same way.

By the Bernstein form a cubic is off the chord by no more than (u (1 - u)^2 + u^2 (1 - u)) h max|v - d|, at most
h |2 d| / 4: a path leaves the straight way between two keyframes by no more than half of its length.

Reference: Barry and Goldman, "A recursive evaluation algorithm for a class of Catmull-Rom splines", SIGGRAPH 1988;
Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985 (Bezier curves of rotations, by slerp).

Files of camera paths are ours, which `drgs view` saves and people write, and those of Nerfstudio's viewer.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drgs.cameras import Camera, c2w_from_opengl, intrinsics
from drgs.cameras.checks import check_handedness
from drgs.checks.records import nearest
from drgs.data.checks import check_last_row, inverse_pose
from drgs.io.journal import SCHEMA
from drgs.io.json_files import check_json, read_json

_log = logging.getLogger(__name__)
_TINY = 1e-12  # radians: below, an arc and its chord are the same to rounding


@dataclasses.dataclass(frozen=True, eq=False)
class Keyframe:
    """A camera that a path passes through.

    Attributes:
        position: (3,) center of the camera in the world.
        wxyz: (4,) quaternion of camera to world, OpenCV axes, of length 1.
        fov: Vertical field of view in degrees.
        seconds: Time at which the camera is there; only differences count.
        time: Time of the scene, of one that moves.
    """

    position: np.ndarray
    wxyz: np.ndarray
    fov: float
    seconds: float
    time: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class CameraPath:
    """A path of a camera through keyframes.

    Attributes:
        keyframes: Keyframes in the order of their seconds, at least one, no two at the same; all have a time, or none.
        duration: Seconds of the whole path, to which those of the keyframes are stretched; None leaves them.
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
        """Where the camera is after shares of the path's duration in [0, 1]; `seconds` are those from its start."""
        keys = [*self.keyframes, *self.keyframes[: self.loop]]
        knots = self._knots()
        steps = np.diff(knots)
        shares = np.asarray(shares, np.float64)
        if len(keys) == 1 or not len(steps):
            return [dataclasses.replace(keys[0], seconds=float(x * self.seconds)) for x in shares]
        at = shares * knots[-1]
        number = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(steps) - 1)
        samples = _Samples(steps, self.loop, number, ((at - knots[number]) / steps[number])[:, None])
        places = np.array([key.position for key in keys], np.float64)
        position = samples.interpolated(places, np.diff(places, axis=0), np.add, _lerp)
        zoom = np.log(np.tan(np.radians([key.fov for key in keys]) / 2))[:, None]
        zoom = samples.interpolated(zoom, np.diff(zoom, axis=0), np.add, _lerp, monotone=True)
        rotations = np.array([key.wxyz for key in keys], np.float64)
        turns = _logarithm(_product(rotations[:-1] * [1, -1, -1, -1], rotations[1:]))
        wxyz = samples.interpolated(rotations, turns, _turned, _slerp)
        fovs = np.degrees(2 * np.arctan(np.exp(zoom[:, 0])))
        times: list[float | None] = [None] * len(shares)
        if keys[0].time is not None:
            times = list(np.interp(at, knots, np.array([key.time for key in keys], np.float64)).tolist())
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


@dataclasses.dataclass(frozen=True)
class _Samples:
    """Where a path is sampled.

    Attributes:
        steps: (M,) seconds from each keyframe to the next.
        loop: Whether the last keyframe is the first.
        number: (S,) number of the step of each sample.
        share: (S, 1) share of that step.
    """

    steps: np.ndarray
    loop: bool
    number: np.ndarray
    share: np.ndarray

    def interpolated(
        self,
        values: np.ndarray,
        changes: np.ndarray,
        moved: Callable[[np.ndarray, np.ndarray], np.ndarray],
        between: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
        monotone: bool = False,
    ) -> np.ndarray:
        """(S, D) values on cubic Bezier curves, by de Casteljau, whose rates at the keyframes are as the module says.

        Args:
            values: (M + 1, D) of the keyframes, of a loop with the first one again.
            changes: (M, E) what changes over each step.
            moved: Function that moves values by changes.
            between: Function that goes from values to values, by shares.
            monotone: Whether a value that is between its neighbors nowhere (a peak) is passed at a rate of 0.
        """
        rates = _rates(changes / self.steps[:, None], self.steps, self.loop, monotone)
        third = self.steps[:, None] / 3
        end = moved(values[:-1], changes)
        first, second = moved(values[:-1], rates[:-1] * third), moved(end, -rates[1:] * third)
        points = [x[self.number] for x in (values[:-1], first, second, end)]
        while len(points) > 1:
            points = [between(a, b, self.share) for a, b in zip(points, points[1:], strict=False)]
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


_ADVICE = "correct it (docs/view.md, Flights)"
_OURS = ("schema", "keyframes", "duration", "loop", "fps", "width", "height")
_KEYFRAME = ("position", "wxyz", "w2c", "fov", "seconds", "time")
_FOV = 1.0, 170.0  # degrees
_LONGEST = 86400.0  # seconds
_FASTEST = 240.0  # frames a second
_SIDE = 16384  # pixels
_MANY = 100_000  # keyframes
_STEP = 1e-3  # seconds between two keyframes, at least
_UNIT = 1e-3  # by which the length of a quaternion may be off 1: of three digits
_RIGID = 1e-3  # by which a rotation may be none
_FPS = 24.0  # frames a second, where a camera path of Nerfstudio states none
_THEIRS: dict[str, Any] = {"render_height": int, "render_width": int, "camera_path": [dict]}


def camera_path_json(path: CameraPath) -> bytes:
    """A camera path as `read_camera_path` reads it."""
    keys = [
        {
            "position": key.position.tolist(),
            "wxyz": key.wxyz.tolist(),
            "fov": key.fov,
            "seconds": key.seconds,
            **({} if key.time is None else {"time": key.time}),
        }
        for key in path.keyframes
    ]
    stated = {name: getattr(path, name) for name in ("duration", "fps", "width", "height")}
    stated = {name: value for name, value in stated.items() if value is not None}
    return json.dumps({"schema": SCHEMA, "keyframes": keys, "loop": path.loop, **stated}, indent=1).encode()


def read_camera_path(path: Path) -> CameraPath:
    """Read a camera path.

    Args:
        path: Our JSON, or Nerfstudio's: with `camera_path`, whose every camera becomes a keyframe, one a frame.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is none, a field is unknown, missing, or out of range; names the first one.
    """
    found = read_json(path, "a JSON file of a flight", _ADVICE)
    where = str(path)
    check_json(where, found, dict, _ADVICE)
    if "camera_path" in found:
        return _of_nerfstudio(where, found)
    _check_keys(where, found, _OURS)
    check_json(where, found, {"keyframes": [dict]}, _ADVICE)
    rows = found["keyframes"]
    if not 1 <= len(rows) <= _MANY:
        raise ValueError(f"{where}: keyframes must hold 1 to {_MANY} keyframes, got {len(rows)}; {_ADVICE}")
    if found.get("schema", SCHEMA) != SCHEMA:
        raise ValueError(f"{where}: schema must be {SCHEMA}, got {found['schema']!r}; was it written by a newer drgs?")
    keys = tuple(_keyframe(f"{where}: keyframes[{k}]", row) for k, row in enumerate(rows))
    _check_together(where, keys)
    if "loop" in found:
        check_json(where, found, {"loop": bool}, _ADVICE)
    return CameraPath(
        keys,
        duration=_number(where, found, "duration", _STEP, _LONGEST),
        loop=found.get("loop", False),
        fps=_number(where, found, "fps", 0.1, _FASTEST),
        width=_side(where, found, "width"),
        height=_side(where, found, "height"),
    )


def _check_keys(where: str, row: dict, names: tuple[str, ...]) -> None:
    """Raise ValueError if a key is unknown."""
    for name in row:
        if name not in names:
            raise ValueError(f"{where}: must hold known fields, got {name!r}; {nearest(name, names)}")


def _number(where: str, row: dict, name: str, low: float, high: float) -> float | None:
    """A number of a row; None where it has none."""
    if name not in row:
        return None
    check_json(where, row, {name: float}, _ADVICE)
    if not low <= row[name] <= high:
        raise ValueError(f"{where}: {name} must be in [{low:g}, {high:g}], got {row[name]:g}; {_ADVICE}")
    return float(row[name])


def _side(where: str, row: dict, name: str) -> int | None:
    if name in row:
        check_json(where, row, {name: int}, _ADVICE)
    value = _number(where, row, name, 1, _SIDE)
    return None if value is None else int(value)


def _keyframe(where: str, row: dict) -> Keyframe:
    """A keyframe of ours."""
    _check_keys(where, row, _KEYFRAME)
    if ("w2c" in row) == ("position" in row or "wxyz" in row):
        raise ValueError(f"{where}: must have either position and wxyz, or w2c, got both or neither; {_ADVICE}")
    check_json(where, row, {"fov": float, "seconds": float}, _ADVICE)
    if "w2c" in row:
        check_json(where, row, {"w2c": [[float]]}, _ADVICE)
        position, wxyz = _pose(where, "w2c", row["w2c"], is_inverse=True)
    else:
        check_json(where, row, {"position": [float], "wxyz": [float]}, _ADVICE)
        if (len(row["position"]), len(row["wxyz"])) != (3, 4):
            raise ValueError(f"{where}: position must hold 3 numbers and wxyz 4, got other sizes; {_ADVICE}")
        position, wxyz = np.array(row["position"], np.float64), np.array(row["wxyz"], np.float64)
        length = float(np.linalg.norm(wxyz))
        if not abs(length - 1) <= _UNIT:
            raise ValueError(
                f"{where}: wxyz must be a quaternion of length 1, got length {length:g}; divide it by that"
            )
        wxyz /= length
        inverse_pose(where, np.column_stack([np.eye(3), position]))  # refuses what is beyond reason
    _number(where, row, "fov", *_FOV)
    _number(where, row, "seconds", -_LONGEST, _LONGEST)
    time = _number(where, row, "time", -math.inf, math.inf)
    return Keyframe(position, wxyz, float(row["fov"]), float(row["seconds"]), time)


def _pose(where: str, name: str, rows: list, is_inverse: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion of a 4x4 matrix, camera to world, or its inverse."""
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise ValueError(f"{where}: {name} must be 4x4 by rows, got another size; {_ADVICE}")
    matrix = np.array(rows, np.float64)
    check_last_row(f"{where}: {name}", matrix)
    c2w = inverse_pose(where, matrix) if is_inverse else matrix
    inverse_pose(where, c2w)  # refuses what is beyond reason
    rotation = c2w[:3, :3]
    check_handedness(where, rotation, "x right, y down, z to the front", "2")
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > _RIGID:
        raise ValueError(f"{where}: {name} must begin with a rotation, its rows are off by {off:.2g}; {_ADVICE}")
    if is_inverse:  # of rows that are a rotation up to their digits, the inverse that belongs to the quaternion
        return -rotation @ matrix[:3, 3], quaternion_of(rotation)
    return c2w[:3, 3], quaternion_of(rotation)


def _check_together(where: str, keys: tuple[Keyframe, ...]) -> None:
    """Raise ValueError unless seconds rise, and all keyframes have a time of the scene, or none has."""
    for k in range(1, len(keys)):
        before, after = keys[k - 1].seconds, keys[k].seconds
        if not after - before >= _STEP:
            raise ValueError(
                f"{where}: keyframes[{k}]: seconds must rise from keyframe to keyframe, by {_STEP:g} at least, got "
                f"{after:g} after {before:g}; {_ADVICE}"
            )
    timed = [key.time is not None for key in keys]
    if any(timed) and not all(timed):
        k = timed.index(False)
        raise ValueError(f"{where}: keyframes[{k}]: must have time as others have, found none; add it, or drop all")


def _of_nerfstudio(where: str, found: dict) -> CameraPath:
    """A camera path of Nerfstudio's viewer: OpenGL axes, matrices of 16 numbers, vertical fields of view in degrees."""
    check_json(where, found, _THEIRS, "export the camera path again")
    kind = found.get("camera_type", "perspective")
    if kind not in ("perspective", "equirectangular"):
        raise ValueError(
            f"{where}: camera_type must be perspective or equirectangular, got {kind!r}; export a camera path of "
            "one of these types"
        )
    if kind == "equirectangular":
        _log.info("%s: is of panoramas, add --panorama: without it pictures are those of a pinhole camera", where)
    fps = _number(where, found, "fps", 0.1, _FASTEST) or _FPS
    rows = found["camera_path"]
    if not 1 <= len(rows) <= _MANY:
        raise ValueError(f"{where}: camera_path must hold 1 to {_MANY} cameras, got {len(rows)}; export it again")
    keys = []
    for k, row in enumerate(rows):
        at = f"{where}: camera_path[{k}]"
        check_json(at, row, {"camera_to_world": [float], "fov": float}, "export the camera path again")
        if len(row["camera_to_world"]) != 16:
            raise ValueError(
                f"{at}: camera_to_world must hold 16 numbers, got {len(row['camera_to_world'])}; export it again"
            )
        matrix = np.array(row["camera_to_world"], np.float64).reshape(4, 4)
        check_last_row(f"{at}: camera_to_world", matrix)
        matrix = c2w_from_opengl(matrix)
        length = np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
        if not 1e-6 < length < 1e6:
            raise ValueError(
                f"{at}: camera_to_world must hold a rotation, got a determinant of {length**3:g}; export it again"
            )
        matrix[:3, :3] /= length  # their poses may carry the scale of the scene
        position, wxyz = _pose(at, "camera_to_world", matrix.tolist())
        _number(at, row, "fov", *_FOV)
        time = _number(at, row, "render_time", -math.inf, math.inf)
        keys.append(Keyframe(position, wxyz, float(row["fov"]), k / fps, time))
    _check_together(where, tuple(keys))
    return CameraPath(
        tuple(keys), fps=fps, width=_side(where, found, "render_width"), height=_side(where, found, "render_height")
    )
