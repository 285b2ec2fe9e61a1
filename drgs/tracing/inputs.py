"""Checks of the arguments of rendering: a scene, a camera and settings of the right kind, else an error of one line."""

from __future__ import annotations

from typing import Any

from drgs.cameras import Camera, check_camera
from drgs.checks.arguments import ArgumentError, must_be
from drgs.ellipsoids import Gaussians, Scene, check_any_scene, check_gaussians
from drgs.settings import check_settings


def check_scene(where: str, gaussians: Any, settings: Any) -> None:
    """Raise `ArgumentError` unless these are Gaussians and RenderSettings (or None)."""
    check_gaussians(where, gaussians)
    check_settings(where, settings)


def check_view(where: str, gaussians: Any, camera: Any, settings: Any) -> None:
    """Raise `ArgumentError` unless these are Gaussians, one Camera and RenderSettings (or None)."""
    if isinstance(camera, Gaussians) and isinstance(gaussians, Camera):
        raise ArgumentError(f"{where}: gaussians must come first and the camera second, got them swapped; swap them")
    check_gaussians(where, gaussians)
    check_camera(where, camera)
    check_settings(where, settings)


def gaussians_at(where: str, scene: Any, camera: Any) -> Any:
    """The Gaussians of a scene at the time of a camera; anything else as it is, for `check_view` to refuse."""
    if isinstance(scene, Gaussians) or not (isinstance(scene, Scene) and isinstance(camera, Camera)):
        return scene
    check_any_scene(where, scene)
    gaussians = scene.at(camera.time)
    must_be(where, "scene.at(time)", gaussians, Gaussians, "let at(time) return drgs.Gaussians")
    return gaussians
