"""Scenes written for rasterizers on other machines, and what those wrote back: images and gradients, nothing to ask."""

from __future__ import annotations

import dataclasses
import hashlib
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.data.checks import check_npz
from drgs.ellipsoids import Gaussians
from drgs.files import atomic_write
from drgs.guards.foreign import refuse_foreign
from drgs.lab.raw import PARAMETERS, POSE, posed, raw_of, with_pose
from drgs.oracle import float64

__all__ = ["SUFFIXES", "Dump", "cotangents", "export", "is_export", "one_line", "read_dump"]

SUFFIXES = (".npz", ".safetensors")
_EXPORT = "drgs_export"  # an array by which an export can be told from a dump, which holds more
_POSE = "grad_viewmat"  # (C, 4, 4); may be left out
_LARGEST = 4 << 30  # bytes of a dump


@dataclasses.dataclass(frozen=True)
class Dump:
    """What a rasterizer wrote: see `drgs.lab.rasterizers.load_rasterizer`.

    Attributes:
        name: Path of the file.
        images: (C, H, W, 3) float64 colors.
        alphas: (C, H, W) float64 opacities.
        cotangents: (C, H, W, 3) weights that the gradients belong to.
        gradients: Group -> gradient of sum <cotangents, images>, raw parameters, all views together; and maybe
            `viewmats` (C, 6).
    """

    name: str
    images: torch.Tensor
    alphas: torch.Tensor
    cotangents: torch.Tensor
    gradients: dict


def cotangents(cameras: list[Camera], seed: int, channels: int = 3) -> torch.Tensor:
    """(C, H, W, channels) of +-1: the mean square of an error of J^T u is the error's Frobenius norm squared.

    Raises:
        ValueError: If the cameras differ in size.
    """
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise ValueError(f"crossval: cameras must have one image size, got {len(sizes)}; choose some with --limit")
    generator = torch.Generator().manual_seed(seed)
    shape = (len(cameras), *sizes.pop(), channels)
    return torch.randint(0, 2, shape, generator=generator).double() * 2 - 1


def scene_arrays(g: Gaussians, cameras: list[Camera], background: tuple) -> dict[str, np.ndarray]:
    """What tells a scene from another: float32 raw parameters, world frame, cameras and background."""
    arrays = {name: x.float().numpy() for name, x in raw_of(g).items()}
    # A file holds values, in float32 as rasterizers take them; a pose may be a leaf.
    arrays["viewmat"] = np.stack([float64(c.w2c).detach().float().numpy() for c in cameras])
    arrays["K"] = np.stack([np.asarray(c.K, np.float32) for c in cameras])
    arrays["width"] = np.int64(cameras[0].width)
    arrays["height"] = np.int64(cameras[0].height)
    arrays["background"] = np.asarray(background, np.float32)
    return arrays


def export(path: Path, g: Gaussians, cameras: list[Camera], background: tuple, seed: int) -> None:
    """Write the scene, its cameras and cotangents for a rasterizer on another machine (.npz).

    Arrays: `means` (N,3), `quats` (N,4), `log_scales` (N,3), `logit_opacities` (N,), `sh` (N,K,3), `viewmat` (C,4,4),
    `K` (C,3,3), `width`, `height`, `background` (3,), `cotangent` (C,H,W,3).

    Raises:
        ValueError: If a camera has a lens or a rolling shutter.
    """
    if any(camera.is_distorted or camera.is_rolling for camera in cameras):
        raise ValueError(
            "crossval: cameras that are exported must be pinholes, got a lens or a rolling shutter; undistort them"
        )
    arrays = scene_arrays(g, cameras, background)
    arrays["cotangent"] = cotangents(cameras, seed).float().numpy()
    arrays[_EXPORT] = _signature(arrays)
    with atomic_write(path) as file:
        np.savez_compressed(file, **arrays)


def is_export(path: Path) -> bool:
    """Whether `export` wrote a file; a dump that was made of one holds more arrays."""
    try:
        check_npz(path)
        with np.load(path, allow_pickle=False) as arrays:
            return np.array_equal(arrays[_EXPORT], _signature({*arrays.files} - {_EXPORT}))
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile):
        return False


def _signature(names: Iterable[str]) -> np.ndarray:
    """The mark of an export, as numbers: readers may make tensors of all arrays that they find."""
    return np.frombuffer(hashlib.sha256(" ".join(sorted(names)).encode()).digest(), np.uint8)


def read_dump(path: Path, g: Gaussians, cameras: list[Camera], background: tuple) -> Dump:
    """A dump of this scene.

    Raises:
        ValueError: If it is damaged, or of another scene; one line.
    """
    found = _arrays(path)
    scene = scene_arrays(g, cameras, background)
    count = len(cameras)
    size = (cameras[0].height, cameras[0].width)
    shapes = {"image": (*size, 3), "alpha": size, "cotangent": (*size, 3)}
    names = [*shapes, *(f"grad_{name}" for name in PARAMETERS), *scene]
    pose = [_POSE] if _POSE in found else []
    if missing := [name for name in names if name not in found]:
        raise ValueError(f"{path}: must hold {', '.join(names)}; {missing[0]} is missing; write it anew from --export")
    for name, array in found.items():
        if name in (*names, *pose) and not np.isfinite(array).all():
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(np.atleast_1d(array)))[0])
            if not name.startswith("grad_"):  # a gradient that is not finite is a finding
                raise ValueError(f"{path}: {name} must be finite, is {np.atleast_1d(array)[index]} at {index}")
    for name, wanted in scene.items():
        got = found[name].reshape(wanted.shape) if found[name].size == wanted.size else found[name]
        if got.shape != wanted.shape:
            raise ValueError(f"{path}: {name} must have shape {wanted.shape}, got {got.shape}: it is of another scene")
        # Arrays of float32, which the other side may have computed again from its own parameters.
        if not np.allclose(got, wanted, rtol=1e-5, atol=1e-6):
            what = "the same scene, cameras and background"
            raise ValueError(f"{path}: must be of {what}, its {name} differs; write it anew from --export")
    for name, shape in shapes.items():
        got = found[name].squeeze(-1) if name == "alpha" and found[name].shape[-1:] == (1,) else found[name]
        if got.shape == shape and count == 1:
            got = got[None]
        if got.shape != (count, *shape):
            raise ValueError(f"{path}: {name} must have shape {(count, *shape)}, got {found[name].shape}")
        found[name] = got
    for name in PARAMETERS:
        if found[f"grad_{name}"].shape != scene[name].shape:
            wanted = scene[name].shape
            got = found[f"grad_{name}"].shape
            raise ValueError(f"{path}: grad_{name} must have shape {wanted}, got {got}")
    if pose and found[_POSE].reshape(-1).shape != scene["viewmat"].reshape(-1).shape:
        raise ValueError(f"{path}: {_POSE} must have shape {scene['viewmat'].shape}, got {found[_POSE].shape}")
    # Through float64 of this machine: files may have another byte order, which torch refuses.
    as_tensor = {name: torch.from_numpy(found[name].astype(np.float64)) for name in names if name not in scene}
    gradients = {name: as_tensor[f"grad_{name}"] for name in PARAMETERS}
    if pose:
        slopes = torch.from_numpy(found[_POSE].astype(np.float64)).reshape(count, 4, 4)
        gradients[POSE] = along_motions(g, cameras, slopes)
    return Dump(str(path), as_tensor["image"], as_tensor["alpha"], as_tensor["cotangent"], gradients)


def along_motions(g: Gaussians, cameras: list[Camera], slopes: torch.Tensor) -> torch.Tensor:
    """(C, 6) derivatives by the motions of `raw.posed` of those by the entries of w2c, (C, 4, 4)."""
    rows = []
    for camera, slope in zip(cameras, slopes, strict=True):
        raw = with_pose(raw_of(g))
        raw[POSE].requires_grad_()
        rows.append(torch.autograd.grad(posed(raw, camera).w2c, raw[POSE], slope)[0])
    return torch.stack(rows)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file; nothing in it is executed."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a file, there is none")
    refuse_foreign(path, f"a {path.suffix} file of arrays")
    if path.stat().st_size > _LARGEST:
        raise ValueError(f"{path}: must have at most {_LARGEST >> 30} GiB, has {path.stat().st_size >> 30}")
    try:
        if path.suffix == ".safetensors":
            from safetensors.numpy import load_file

            return load_file(path)
        check_npz(path)
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:
        raise ValueError(f"{path}: must be a {path.suffix} file of arrays, got {one_line(error)}") from None


def one_line(error: Exception) -> str:
    """What an error says first."""
    return (str(error).strip().splitlines() or ["without a message"])[0][:200]
