"""The file that a planner goes on from: one safetensors file, written at once or not at all.

Its header says that it is a planner's, and holds a digest of everything else: a file of which a bit has changed is
refused, and a file that is no planner's is never replaced.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.files import load_state, save_state, state_header
from drgs.guards import unfinished
from drgs.guards.arguments import check_path
from drgs.guards.camera_checks import as_numpy
from drgs.guards.json_files import check_json, parse_json

__all__ = [
    "ADVICE",
    "camera_record",
    "load_planner",
    "recorded_camera",
    "recorded_scene",
    "save_planner",
    "scene_record",
]

ADVICE = "restore the file, or begin anew"
_KIND = "planner"
_CAMERA = {
    "K": [[float]],
    "w2c": [[float]],
    "w2c_end": (None, [[float]]),
    "width": int,
    "height": int,
    "model": str,
    "distortion": [float],
    "name": str,
    "time": (None, float),
    "shutter": str,
}
_HEADER = {
    "digest": str,
    "version": str,
    "info_pixels": int,
    "max_views": int,
    "look": float,
    "bound": float,
    "max_bytes": int,
    "counted": int,
    "known": [_CAMERA],
    "here": (None, _CAMERA),
    "pool": [_CAMERA],
    "costs": (None, bool, [float]),
    "scoring": str,
    "asked_in": [float],
    "answered_in": [float],
    "origin": (None, [float]),
    "fit": dict,
    "photographs": [_CAMERA],
    "cache": dict,
    "expected": [_CAMERA],
}


def save_planner(path: str | os.PathLike, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
    """Write a planner's file; what a killed process left half written beside it is removed.

    Args:
        path: The file, which this process alone writes.
        tensors: What it holds.
        header: What else it holds, JSON.
    Raises:
        ValueError: If there is something else of that name, or the header is no JSON.
        OSError: If it cannot be written.
    """
    path = check_path("Planner.save", path)
    if os.path.lexists(path) and not _is_planners(path):
        raise ValueError(f"{path}: must not be replaced, is no planner's file that can be read; choose another name")
    try:
        header = parse_json(json.dumps(header, allow_nan=False), "Planner.save")  # as it will be read
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"Planner.save: notes must be JSON, got what is none ({error}); leave it out") from None
    if path.parent.is_dir():
        for other in path.parent.iterdir():
            if other.name.startswith(f".drgs.{path.name}.") and unfinished.is_left_over(other.resolve()):
                unfinished.delete(other)
    tensors = _apart(tensors)
    save_state(path, tensors, {"kind": _KIND, **header, "digest": _digest(tensors, header)})


def load_planner(path: str | os.PathLike) -> tuple[Path, dict[str, torch.Tensor], dict[str, Any]]:
    """The path, the tensors and the header of `save_planner`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is none that a planner has written, or damaged.
    """
    path = check_path("Planner.load", path)
    tensors, header = load_state(path)
    if header.pop("kind", None) != _KIND:
        raise ValueError(f"{path}: must be what Planner.save has written, is a checkpoint of a fit; see drgs fit")
    header.pop("schema")
    check_json(str(path), header, _HEADER, ADVICE)
    if _digest(tensors, header) != header["digest"]:
        raise ValueError(f"{path}: must be as Planner.save has written it, has been changed since; {ADVICE}")
    return path, tensors, header


def camera_record(camera: Camera) -> dict[str, Any]:
    """A camera in JSON, to the bit."""
    pose = lambda x: np.asarray(as_numpy(x), np.float64).tolist()  # noqa: E731
    return {
        "K": camera.K.tolist(),
        "w2c": pose(camera.w2c),
        "w2c_end": None if camera.w2c_end is None else pose(camera.w2c_end),
        **{name: getattr(camera, name) for name in ("width", "height", "model", "name", "time", "shutter")},
        "distortion": list(camera.distortion),
    }


def recorded_camera(where: Path, record: dict[str, Any], pixels: float = math.inf) -> Camera:
    """The camera of a record that `load_planner` has looked at.

    Args:
        where: The file, for messages.
        record: What `camera_record` made.
        pixels: Number of pixels that its image may have.
    Raises:
        ValueError: If there is no such camera.
    """
    fields = {name: record[name] for name in _CAMERA}
    try:
        for name in ("K", "w2c", "w2c_end"):
            if fields[name] is not None:
                fields[name] = np.array(fields[name], np.float64)
        camera = Camera(**fields | {"distortion": tuple(fields["distortion"])})
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{where}: {error}; {ADVICE}") from None
    if camera.width * camera.height > pixels:
        raise ValueError(f"{where}: {camera.name!r} must have at most {pixels} pixels, has more; {ADVICE}")
    return camera


def scene_record(scene: Gaussians | None) -> tuple[dict[str, torch.Tensor], list[float] | None]:
    """Tensors of a caller's own model and its origin; None where there is none."""
    if scene is None:
        return {}, None
    return {f"scene.{name}": x for name, x in scene.parameters().items()}, np.asarray(scene.origin).tolist()


def recorded_scene(where: Path, tensors: Mapping[str, torch.Tensor], origin: list[float]) -> Gaussians:
    """The inverse of `scene_record`.

    Raises:
        ValueError: If it is no model.
    """
    fields: dict[str, Any] = {
        name.removeprefix("scene."): x for name, x in tensors.items() if name.startswith("scene.")
    }
    try:
        scene = Gaussians(**fields, origin=np.array(origin, np.float64))
        scene.validate(str(where))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {str(error).removeprefix(f'{where}: ')}; {ADVICE}") from None
    return scene


def _is_planners(path: Path) -> bool:
    """Whether a file, no link, says that a planner has written it."""
    with contextlib.suppress(ValueError, OSError):
        return not path.is_symlink() and state_header(path).get("kind") == _KIND
    return False


def _apart(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The same without two that share memory, which safetensors refuses."""
    seen: set[int] = set()
    found = {}
    for name, x in tensors.items():
        x = x.detach().cpu()  # a file holds values
        place = x.untyped_storage().data_ptr()
        found[name] = x.clone() if place in seen else x
        seen.add(place)
    return found


def _digest(tensors: Mapping[str, torch.Tensor], header: Mapping[str, Any]) -> str:
    """A hash of all tensors, and of the header but for the hash."""
    text = json.dumps({key: x for key, x in header.items() if key != "digest"}, sort_keys=True)
    found = hashlib.blake2b(text.encode(), digest_size=16)
    for name in sorted(tensors):
        x = tensors[name].contiguous().numpy()
        found.update(f"{name} {x.dtype.str} {x.shape}".encode())
        found.update(x.data if x.size else b"")
    return found.hexdigest()
