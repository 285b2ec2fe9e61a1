"""What the public functions take: a scene, cameras and settings of the right kind, or one sentence about it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians, Scene
from drgs.guards.arguments import ArgumentError, kind_of, must_be
from drgs.guards.derivatives import refuse_meta
from drgs.settings import RenderSettings

__all__ = [
    "Masks",
    "camera_list",
    "check_any_scene",
    "cameras_of_one_size",
    "check_oracle",
    "check_path",
    "check_scene",
    "check_view",
    "gaussians_at",
    "mask_list",
    "some_cameras",
    "three_weights",
]

Masks = Sequence[torch.Tensor | None] | None
"""Masks of several cameras: (H, W) in [0, 1] each, by which an image is multiplied before it is compared, or None."""

_SCENE = "drgs.load_ply(path) or drgs.Gaussians.from_arrays(means, quats, scales, opacities, sh) makes one"
_CAMERA = "drgs.Camera(K=K, w2c=w2c, width=width, height=height) makes one"
_SETTINGS = 'drgs.RenderSettings.preset("exact") makes them'


def check_scene(where: str, gaussians: Any, settings: Any) -> None:
    """Raise `ArgumentError` unless these are Gaussians and RenderSettings (or None)."""
    must_be(where, "gaussians", gaussians, Gaussians, _SCENE)
    if settings is not None:
        must_be(where, "settings", settings, RenderSettings, _SETTINGS)


def check_any_scene(where: str, scene: Any) -> None:
    """Raise `ArgumentError` unless this is a `Scene`, which names its parameters (a torch Module does not)."""
    if not isinstance(scene, Scene):
        must_be(where, "gaussians", scene, Gaussians, _SCENE)
    hint = "tensors by name, of a torch.nn.Module dict(self.named_parameters())"
    must_be(where, "scene.parameters()", scene.parameters(), Mapping, hint)


def gaussians_at(where: str, scene: Any, camera: Any) -> Any:
    """The Gaussians of a scene at the time of a camera; anything else as it is, for `check_view` to refuse."""
    if isinstance(scene, Gaussians) or not (isinstance(scene, Scene) and isinstance(camera, Camera)):
        return scene
    check_any_scene(where, scene)
    gaussians = scene.at(camera.time)
    must_be(where, "scene.at(time)", gaussians, Gaussians, "a scene has Gaussians at any time")
    return gaussians


def check_view(where: str, gaussians: Any, camera: Any, settings: Any) -> None:
    """The same, and one Camera."""
    if isinstance(camera, Gaussians) and isinstance(gaussians, Camera):
        raise ArgumentError(f"{where}: gaussians must come first and the camera second, got them swapped; swap them")
    check_scene(where, gaussians, None)
    several = isinstance(camera, list | tuple) and all(isinstance(x, Camera) for x in camera)
    hint = f"it takes one view at a time: [drgs.{where}(..., camera, ...) for camera in cameras]"
    must_be(where, "camera", camera, Camera, hint if several else _CAMERA)
    check_scene(where, gaussians, settings)


def camera_list(where: str, name: str, cameras: Any) -> list[Camera]:
    """One Camera or several as a list; `ArgumentError` for anything else."""
    if isinstance(cameras, Camera):
        return [cameras]
    if isinstance(cameras, str | bytes | dict) or not isinstance(cameras, Iterable):
        raise ArgumentError(f"{where}: {name} must be a Camera or a list of them, got {kind_of(cameras)}; {_CAMERA}")
    cameras = list(cameras)
    for index, camera in enumerate(cameras):
        must_be(where, f"{name}[{index}]", camera, Camera, _CAMERA)
    return cameras


def some_cameras(where: str, cameras: Any) -> list[Camera]:
    """The same, at least one."""
    found = camera_list(where, "cameras", cameras)
    if not found:
        raise ValueError(f"{where}: there must be at least one camera, got none; pass one or more")
    return found


def three_weights(where: str, channel_weights: Any) -> list[float]:
    """Those of R, G and B, finite and >= 0."""
    try:
        weights = [float(x) for x in channel_weights]
    except (TypeError, ValueError):
        weights = []
    if len(weights) != 3 or not all(math.isfinite(x) and x >= 0 for x in weights):
        raise ValueError(
            f"{where}: channel_weights must be 3 finite numbers >= 0, got {channel_weights}; e.g. (1, 1, 1)"
        )
    return weights


def mask_list(where: str, masks: Any, cameras: Sequence[Camera]) -> list[torch.Tensor | None]:
    """A mask or None for each camera; `ArgumentError` for another number of them, another size, or values."""
    if masks is None:
        return [None] * len(cameras)
    if not isinstance(masks, list | tuple) or len(masks) != len(cameras):
        got = f"{len(masks)}" if isinstance(masks, list | tuple) else kind_of(masks)
        raise ArgumentError(
            f"{where}: masks must be a list with one for each of {len(cameras)} cameras, got {got}; None is one, too"
        )
    for index, (mask, camera) in enumerate(zip(masks, cameras, strict=True)):
        if mask is None:
            continue
        must_be(where, f"masks[{index}]", mask, torch.Tensor, "(H, W) in [0, 1], or None")
        size = (camera.height, camera.width)
        if tuple(mask.shape) != size or not bool(((mask >= 0) & (mask <= 1)).all()):
            values = f" within {float(mask.min()):g} and {float(mask.max()):g}" if mask.numel() else ""
            raise ArgumentError(
                f"{where}: masks[{index}] must be {size} like its camera's image, all within 0 and 1, got "
                f"{tuple(mask.shape)}{values}; resize it"
            )
    return list(masks)


def cameras_of_one_size(where: str, cameras: Any) -> list[Camera]:
    """A list of at least one Camera, all of one image size; the first one that differs is named."""
    cameras = camera_list(where, "camera", cameras)
    if not cameras:
        raise ArgumentError(f"{where}: a list of cameras must have at least one, got none; pass one or more")
    sizes = [(camera.width, camera.height) for camera in cameras]
    for index, (width, height) in enumerate(sizes):
        if (width, height) != sizes[0]:
            raise ArgumentError(
                f"{where}: cameras of a list must have one image size, got {sizes[0][0]}x{sizes[0][1]} and "
                f"camera[{index}] with {width}x{height}; render each size by itself"
            )
    return cameras


def check_oracle(where: str, gaussians: Any, camera: Any, settings: Any) -> None:
    """What the oracles need, which take anything that has the fields of Gaussians and of a Camera."""
    if hasattr(camera, "log_scales"):
        raise ArgumentError(f"{where}: gaussians must come first and the camera second, got them swapped; swap them")
    if not hasattr(gaussians, "log_scales"):
        must_be(where, "gaussians", gaussians, Gaussians, _SCENE)
    if camera is not None and not hasattr(camera, "w2c"):
        must_be(where, "camera", camera, Camera, _CAMERA)
    if settings is not None:
        must_be(where, "settings", settings, RenderSettings, _SETTINGS)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh", "features"):
        if isinstance(x := getattr(gaussians, name, None), torch.Tensor):
            refuse_meta(where, name, x)


def check_path(where: str, path: Any) -> Path:
    """A file name as a Path."""
    must_be(where, "path", path, (str, os.PathLike), 'a file name, e.g. "point_cloud.ply"')
    return Path(path)
