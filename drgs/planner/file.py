"""The file of a planner: what `Planner.save` writes, and `Planner.load` reads."""

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
from drgs.cameras.checks import as_numpy
from drgs.checks.arguments import check_path
from drgs.ellipsoids import Gaussians
from drgs.information.region import Region, RegionText
from drgs.io import atomic
from drgs.io.checkpoint import load_state, save_state, state_header
from drgs.io.json_files import check_json, parse_json

_ADVICE = "restore the file, or begin anew"
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
    "answer_shares": [float],
    "origin": (None, [float]),
    "fit": dict,
    "photographs": [_CAMERA],
    "cache": dict,
    "expected": [_CAMERA],
}


def write_file(path: str | os.PathLike, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
    """Write a planner's file; half-written files of killed processes beside it are removed.

    Args:
        path: The file, which this process alone writes.
        tensors: What it holds.
        header: What else it holds, JSON.
    Raises:
        ValueError: If there is something else of that name, or the header is no JSON.
        OSError: If it cannot be written.
    """
    path = check_path("Planner.save", path)
    if os.path.lexists(path) and not _is_planner_file(path):
        raise ValueError(f"{path}: must not be replaced, is no planner's file that can be read; choose another name")
    try:
        header = parse_json(json.dumps(header, allow_nan=False), "Planner.save")  # as it will be read
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"Planner.save: notes must be JSON, got what is none ({error}); leave it out") from None
    if path.parent.is_dir():
        for other in path.parent.iterdir():
            if other.name.startswith(f".drgs.{path.name}.") and atomic.is_left_over(other.resolve()):
                atomic.delete(other)
    tensors = _without_shared_memory(tensors)
    save_state(path, tensors, {"kind": _KIND, **header, "digest": digest_of(tensors, header)})


def read_file(path: str | os.PathLike) -> tuple[Path, dict[str, torch.Tensor], dict[str, Any]]:
    """The path, the tensors and the header of `write_file`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is none that a planner has written, or damaged.
    """
    path = check_path("Planner.load", path)
    tensors, header = load_state(path)
    if header.pop("kind", None) != _KIND:
        raise ValueError(f"{path}: must be what Planner.save has written, is a checkpoint of a fit; see drgs fit")
    header.pop("schema")
    known = {"answer_shares": header.get("answered_in"), **header}  # as older files call them
    check_json(str(path), known, _HEADER, _ADVICE)
    if digest_of(tensors, header) != header["digest"]:
        raise ValueError(f"{path}: must be as Planner.save has written it, has been changed since; {_ADVICE}")
    return path, tensors, known


def camera_json(camera: Camera) -> dict[str, Any]:
    """A camera in JSON, to the bit."""
    pose = lambda x: np.asarray(as_numpy(x), np.float64).tolist()  # noqa: E731
    return {
        "K": camera.K.tolist(),
        "w2c": pose(camera.w2c),
        "w2c_end": None if camera.w2c_end is None else pose(camera.w2c_end),
        **{name: getattr(camera, name) for name in ("width", "height", "model", "name", "time", "shutter")},
        "distortion": list(camera.distortion),
    }


def camera_of(where: Path, record: dict[str, Any], pixels: float = math.inf) -> Camera:
    """The camera of a record that `read_file` has checked.

    Args:
        where: The file, for messages.
        record: From `camera_json`.
        pixels: Largest number of pixels of its image.
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
        raise ValueError(f"{where}: {error}; {_ADVICE}") from None
    if camera.width * camera.height > pixels:
        raise ValueError(f"{where}: {camera.name!r} must have at most {pixels} pixels, has more; {_ADVICE}")
    return camera


def scene_tensors(scene: Gaussians | None) -> tuple[dict[str, torch.Tensor], list[float] | None]:
    """Tensors of a caller's own model and its origin; None where there is none."""
    if scene is None:
        return {}, None
    return {f"scene.{name}": x for name, x in scene.parameters().items()}, np.asarray(scene.origin).tolist()


def scene_of(where: Path, tensors: Mapping[str, torch.Tensor], origin: list[float]) -> Gaussians:
    """The inverse of `scene_tensors`.

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
        raise ValueError(f"{where}: {str(error).removeprefix(f'{where}: ')}; {_ADVICE}") from None
    return scene


def _is_planner_file(path: Path) -> bool:
    """Whether a file, no link, says that a planner has written it."""
    with contextlib.suppress(ValueError, OSError):
        return not path.is_symlink() and state_header(path).get("kind") == _KIND
    return False


def _without_shared_memory(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The tensors on the CPU, copied where two share memory, which safetensors refuses."""
    seen: set[int] = set()
    separate = {}
    for name, x in tensors.items():
        x = x.detach().cpu()  # a file holds values
        place = x.untyped_storage().data_ptr()
        separate[name] = x.clone() if place in seen else x
        seen.add(place)
    return separate


def digest_of(tensors: Mapping[str, torch.Tensor], header: Mapping[str, Any]) -> str:
    """A hash of all tensors, and of the header but for the hash."""
    text = json.dumps({key: x for key, x in header.items() if key != "digest"}, sort_keys=True)
    digest = hashlib.blake2b(text.encode(), digest_size=16)
    for name in sorted(tensors):
        x = tensors[name].contiguous().numpy()
        digest.update(f"{name} {x.dtype.str} {x.shape}".encode())
        digest.update(x.data if x.size else b"")
    return digest.hexdigest()


def region_of(where: Path, saved: Any, given: Region | None) -> Region | None:
    """The region of a planner that was saved: the one that is given, or one that its text describes."""
    if given is None and isinstance(saved, str) and saved.partition(":")[0] in ("box", "sphere"):
        return RegionText.of(saved, str(where)).region(lambda folder: ([], []), lambda: (None, None))
    if saved != (None if given is None else given.text):
        raise ValueError(
            f"{where}: region must be that of the planner that was saved, {saved}, got "
            f"{'none' if given is None else given.text}; give it to Planner.load"
        )
    return given
