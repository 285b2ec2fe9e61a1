"""Lists of cameras as INRIA's `cameras.json` has them: pinhole, no skew, position and rotation of c2w."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from drgs.cameras import Camera, intrinsics

__all__ = ["load_cameras_json", "save_cameras_json"]


def save_cameras_json(path: str | os.PathLike, cameras: list[Camera]) -> None:
    """Write cameras in INRIA's ``cameras.json`` layout, with cx and cy added; atomically.

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
            }
        )
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(entries, indent=1))
    partial.replace(path)


def load_cameras_json(path: str | os.PathLike) -> list[Camera]:
    """Read cameras in INRIA's layout: a list of id, img_name, width, height, position, rotation
    (c2w), fx, fy[, cx, cy].

    Raises:
        FileNotFoundError: no such file.
        ValueError: not that layout, or a camera that cannot be; names the first one.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a cameras.json file, found none; check the path")
    try:
        entries = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: must be valid JSON, got {error}; write the file again") from None
    if not isinstance(entries, list) or not entries:
        raise ValueError(
            f"{path}: must be a list of at least one camera, got {type(entries).__name__}; see INRIA's layout"
        )
    cameras = []
    for index, entry in enumerate(entries):
        try:
            w, h = entry["width"], entry["height"]
            K = intrinsics(entry["fx"], entry["fy"], entry.get("cx", w / 2), entry.get("cy", h / 2))
            c2w = np.eye(4)
            c2w[:3, :3], c2w[:3, 3] = entry["rotation"], entry["position"]
            # The rotation's transpose stands for its inverse; Camera refuses what is not a
            # rotation.
            w2c = np.eye(4)
            w2c[:3, :3], w2c[:3, 3] = c2w[:3, :3].T, -c2w[:3, :3].T @ c2w[:3, 3]
            name = str(entry.get("img_name", entry.get("id", index)))
            cameras.append(Camera(K=K, w2c=w2c, width=w, height=h, name=name))
        except KeyError as error:
            raise ValueError(f"{path}: camera {index} must have the key {error}, found none; add it") from None
        except (TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{path}: camera {index}: {error}") from None
    return cameras
