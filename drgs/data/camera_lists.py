"""Lists of cameras in JSON.

Every command that takes cameras reads one form: a list of cameras, or an object with such a list, as commands write it
(`cameras`, else the `camera` of each of its `picks`, else of its `views`). A camera is what `camera_to_json` writes, of
any lens, or as INRIA's `cameras.json` has it: pinhole, no skew, position and rotation of c2w.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from drgs.cameras import Camera, intrinsics
from drgs.checks.arguments import kind_of
from drgs.data.checks import inverse_pose, said_of
from drgs.io.json_files import check_json, read_json
from drgs.io.outputs import write_whole

_CAMERA_JSON = {
    "name": str,
    "width": int,
    "height": int,
    "K": [[float]],
    "c2w": [[float]],
    "model": str,
    "distortion": [float],
}
_LOOKED_AT = 1 << 20  # bytes of a file, where a transforms.json has its frames
_LISTS = ("cameras", "picks", "views")
_OURS = re.compile(rb'\{\s*("schema"\s*:\s*\d+\s*,\s*)?"(command|cameras)"\s*:')  # how such an object begins
_ENTRY = {"width": float, "height": float, "fx": float, "fy": float, "position": [float], "rotation": [[float]]}


def save_cameras_json(path: str | os.PathLike, cameras: list[Camera]) -> None:
    """Write cameras in INRIA's `cameras.json` layout, with cx, cy and a camera's time, if any, added; atomically.

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
    write_whole(path, json.dumps(entries, indent=1).encode())


def load_cameras_json(path: str | os.PathLike) -> list[Camera]:
    """Read cameras, in their order; of what a command wrote (selection.json, render.json, ...), those of its picks or
    views.

    A camera is as `camera_to_json` writes it, or in INRIA's layout: id, img_name, width, height, position, rotation
    (c2w), fx, fy[, cx, cy, time].

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not that layout, or a camera that cannot be; names the first one.
    """
    path = Path(path)
    cameras = []
    for where, entry in _entries(path, read_json(path, "a cameras.json file")):
        if isinstance(entry, dict) and "c2w" in entry:
            cameras.append(camera_from_json(where, entry))
        else:
            cameras.append(_of_inria(where, entry))
    return cameras


def _entries(path: Path, found: object) -> list[tuple[str, Any]]:
    """(where it stands, camera as parsed) of each camera of a file."""
    if isinstance(found, dict):
        lists = {key: found[key] for key in _LISTS if isinstance(found.get(key), list) and found[key]}
        key = next(iter(lists), "")
        rows = [row.get("camera", row) if isinstance(row, dict) else row for row in lists.get(key, ())]
        if not rows or any(not isinstance(row, dict) for row in rows):
            raise ValueError(
                f"{path}: must be a list of at least one camera, or have `cameras`, or poses in `picks` or `views`, "
                "got none; name a cameras.json, or a selection.json of drgs"
            )
        return [(f"{path}: {key} {i}", row) for i, row in enumerate(rows)]
    if not isinstance(found, list) or not found:
        raise ValueError(f"{path}: must be a list of at least one camera, got {kind_of(found)}; see INRIA's layout")
    return [(f"{path}: camera {i}", row) for i, row in enumerate(found)]


def _of_inria(where: str, entry: Any) -> Camera:
    """A camera in INRIA's layout."""
    check_json(where, entry, _ENTRY, "see INRIA's layout")
    w, h = entry["width"], entry["height"]
    center = {"cx": entry.get("cx", w / 2), "cy": entry.get("cy", h / 2)}
    check_json(where, center, {"cx": float, "cy": float}, "see INRIA's layout")
    sizes = len(entry["position"]), [len(row) for row in entry["rotation"]]
    if sizes != (3, [3, 3, 3]):
        raise ValueError(f"{where}: position must hold 3 numbers and rotation 3x3, got other sizes; correct them")
    w2c = inverse_pose(where, np.column_stack([entry["rotation"], entry["position"]]))
    name = str(entry.get("img_name", entry.get("id", where.rpartition(" ")[2])))
    with said_of(where):
        K = intrinsics(entry["fx"], entry["fy"], center["cx"], center["cy"])
        return Camera(K=K, w2c=w2c, width=w, height=h, name=name, time=entry.get("time"))


def is_camera_list(path: Path) -> bool:
    """Whether a JSON file holds cameras (`load_cameras_json`), and is not a transforms.json.

    A command's file may turn out to have none: then it is refused as what it is, not as a data set.
    """
    if path.suffix != ".json" or not path.is_file():
        return path.name == "cameras.json"
    with path.open("rb") as file:
        start = file.read(256).lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith(b"["):
        return True
    return _OURS.match(start) is not None and b'"frames"' not in path.read_bytes()[:_LOOKED_AT]


def camera_to_json(camera: Camera) -> dict:
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


def camera_from_json(where: str, value: object) -> Camera:
    """The camera that `camera_to_json` has made JSON of.

    Args:
        where: The file and the place in it, for messages.
        value: What was parsed of the JSON.
    Raises:
        ValueError: If it is nothing of the kind, or no camera can be so.
    """
    advice = "write the file again"
    check_json(where, value, _CAMERA_JSON, advice)
    assert isinstance(value, dict)  # checked
    shapes = [len(row) for row in value["K"]], [len(row) for row in value["c2w"]]
    if shapes != ([3] * 3, [4] * 4):
        raise ValueError(f"{where}: K must be 3x3 and c2w 4x4, got other sizes; {advice}")
    fields = {name: value[name] for name in ("name", "width", "height", "model")}
    w2c = inverse_pose(where, np.array(value["c2w"]))
    lens = tuple(value["distortion"])
    with said_of(where):
        return Camera(K=np.array(value["K"]), w2c=w2c, distortion=lens, time=value.get("time"), **fields)
