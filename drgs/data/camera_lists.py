"""Lists of cameras as INRIA's `cameras.json` has them: pinhole, no skew, position and rotation of c2w."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from drgs.cameras import Camera, intrinsics
from drgs.data.checks import inverse_pose
from drgs.files import atomic_write
from drgs.guards.json_files import check_json, read_json

__all__ = ["camera_described", "described", "is_camera_list", "load_cameras_json", "save_cameras_json"]

_DESCRIBED = {
    "name": str,
    "width": int,
    "height": int,
    "K": [[float]],
    "c2w": [[float]],
    "model": str,
    "distortion": [float],
}
_ENTRY = {"width": float, "height": float, "fx": float, "fy": float, "position": [float], "rotation": [[float]]}


def save_cameras_json(path: str | os.PathLike, cameras: list[Camera]) -> None:
    """Write cameras in INRIA's ``cameras.json`` layout, with cx, cy and a camera's time, if any, added; atomically.

    Raises:
        ValueError: a camera is distorted or skewed (the layout has no room for that).
    """
    entries = []
    for index, camera in enumerate(cameras):
        if camera.is_distorted or camera.K[0, 1] != 0.0:
            raise ValueError(
                f"{path}: cameras.json holds pinhole cameras without skew, camera {index} "
                f"({camera.name!r}) is not one; "
                "use camera.undistorted()"
            )
        c2w = camera.c2w
        entries.append(
            {
                "id": index,
                "img_name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "position": c2w[:3, 3].tolist(),
                "rotation": c2w[:3, :3].tolist(),
                "fx": float(camera.K[0, 0]),
                "fy": float(camera.K[1, 1]),
                "cx": float(camera.K[0, 2]),
                "cy": float(camera.K[1, 2]),
                **({} if camera.time is None else {"time": camera.time}),
            }
        )
    with atomic_write(path) as file:
        file.write(json.dumps(entries, indent=1).encode())


def load_cameras_json(path: str | os.PathLike) -> list[Camera]:
    """Read cameras in INRIA's layout: a list of id, img_name, width, height, position, rotation
    (c2w), fx, fy[, cx, cy, time].

    Raises:
        FileNotFoundError: no such file.
        ValueError: not that layout, or a camera that cannot be; names the first one.
    """
    path = Path(path)
    entries = read_json(path, "a cameras.json file")
    if not isinstance(entries, list) or not entries:
        raise ValueError(
            f"{path}: must be a list of at least one camera, got {type(entries).__name__}; see INRIA's layout"
        )
    cameras = []
    for index, entry in enumerate(entries):
        where = f"{path}: camera {index}"
        check_json(where, entry, _ENTRY, "see INRIA's layout")
        w, h = entry["width"], entry["height"]
        center = {"cx": entry.get("cx", w / 2), "cy": entry.get("cy", h / 2)}
        check_json(where, center, {"cx": float, "cy": float}, "see INRIA's layout")
        sizes = len(entry["position"]), [len(row) for row in entry["rotation"]]
        if sizes != (3, [3, 3, 3]):
            raise ValueError(f"{where}: position must hold 3 numbers and rotation 3x3, got other sizes; correct them")
        w2c = inverse_pose(where, np.column_stack([entry["rotation"], entry["position"]]))
        name = str(entry.get("img_name", entry.get("id", index)))
        try:
            K = intrinsics(entry["fx"], entry["fy"], center["cx"], center["cy"])
            cameras.append(Camera(K=K, w2c=w2c, width=w, height=h, name=name, time=entry.get("time")))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    return cameras


def is_camera_list(path: Path) -> bool:
    """Whether a JSON file is a list, as INRIA's cameras.json is, and not a transforms.json."""
    if path.suffix != ".json" or not path.is_file():
        return path.name == "cameras.json"
    with path.open("rb") as file:
        return file.read(256).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"[")


def described(camera: Camera) -> dict:
    """A camera of any kind as JSON, for the files of commands."""
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "c2w": camera.c2w.tolist(),
        "model": camera.model,
        "distortion": list(camera.distortion),
        **({} if camera.time is None else {"time": camera.time}),
    }


def camera_described(where: str, value: object) -> Camera:
    """The camera that `described` has made JSON of.

    Args:
        where: The file and the place in it, for messages.
        value: As parsed.
    Raises:
        ValueError: If it is nothing of the kind, or no camera can be so.
    """
    advice = "write the file again"
    check_json(where, value, _DESCRIBED, advice)
    assert isinstance(value, dict)  # checked
    shapes = [len(row) for row in value["K"]], [len(row) for row in value["c2w"]]
    if shapes != ([3] * 3, [4] * 4):
        raise ValueError(f"{where}: K must be 3x3 and c2w 4x4, got other sizes; {advice}")
    fields = {name: value[name] for name in ("name", "width", "height", "model")}
    w2c, lens = inverse_pose(where, np.array(value["c2w"])), tuple(value["distortion"])
    try:
        return Camera(K=np.array(value["K"]), w2c=w2c, distortion=lens, time=value.get("time"), **fields)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
