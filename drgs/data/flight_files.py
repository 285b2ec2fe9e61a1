"""Files of flights: ours, which `drgs view` saves and people write, and the camera paths of Nerfstudio's viewer."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from drgs.cameras import c2w_from_opengl
from drgs.data.checks import check_last_row, inverse_pose
from drgs.data.flight import Flight, Keyframe, quaternion_of
from drgs.guards.camera_checks import check_handedness
from drgs.guards.records import nearest
from drgs.io.journal import SCHEMA
from drgs.io.json_files import check_json, read_json

__all__ = ["flight_json", "read_flight"]

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
_FPS = 24.0
_THEIRS: dict[str, Any] = {"render_height": int, "render_width": int, "camera_path": [dict]}


def flight_json(flight: Flight) -> bytes:
    """A flight as `read_flight` reads it."""
    keys = [
        {
            "position": key.position.tolist(),
            "wxyz": key.wxyz.tolist(),
            "fov": key.fov,
            "seconds": key.seconds,
            **({} if key.time is None else {"time": key.time}),
        }
        for key in flight.keyframes
    ]
    told = {name: getattr(flight, name) for name in ("duration", "fps", "width", "height")}
    told = {name: value for name, value in told.items() if value is not None}
    return json.dumps({"schema": SCHEMA, "keyframes": keys, "loop": flight.loop, **told}, indent=1).encode()


def read_flight(path: Path) -> Flight:
    """Read a flight.

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
    _known(where, found, _OURS)
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
    return Flight(
        keys,
        duration=_number(where, found, "duration", _STEP, _LONGEST),
        loop=found.get("loop", False),
        fps=_number(where, found, "fps", 0.1, _FASTEST),
        width=_side(where, found, "width"),
        height=_side(where, found, "height"),
    )


def _known(where: str, row: dict, names: tuple[str, ...]) -> None:
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
    _known(where, row, _KEYFRAME)
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


def _of_nerfstudio(where: str, found: dict) -> Flight:
    """A camera path of Nerfstudio's viewer: OpenGL axes, matrices of 16 numbers, vertical fields of view in degrees."""
    check_json(where, found, _THEIRS, "export the camera path again")
    kind = found.get("camera_type", "perspective")
    if kind not in ("perspective", "equirectangular"):
        raise ValueError(f"{where}: camera_type must be perspective, got {kind!r}; export a camera path of that type")
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
    return Flight(
        tuple(keys), fps=fps, width=_side(where, found, "render_width"), height=_side(where, found, "render_height")
    )
