"""Whether a fit looks through lenses: where taking them out would lose much of the photographs.

The pinhole camera of a lens's K shows what is in front of it, within the image: what a wide lens sees besides is lost.
A fit that can draw along rays need not lose it.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from drgs.cameras import Camera
from drgs.fitting.renderers import RendererSchedule, planar_of
from drgs.sizes import at_most

if TYPE_CHECKING:
    from drgs.data import View
    from drgs.fitting.config import FitConfig

__all__ = ["LensChoice", "lens_choice", "lost_share"]

_LOST = 0.2  # of the rays of photographs; ordinary lenses lose a twentieth, a fisheye of 180 degrees most
_PIXELS = 10_000  # of a photograph, whose share is counted


@dataclasses.dataclass(frozen=True)
class LensChoice:
    """What `--undistort auto` means of these photographs.

    Attributes:
        undistort: `on` or `off`.
        lost: Share of the rays of photographs that undistorting would lose.
        because: Why lenses are taken out although much is lost; empty otherwise.
    """

    undistort: Literal["on", "off"]
    lost: float
    because: str = ""

    def words(self) -> str:
        """One line for who fits; empty where there is nothing to say."""
        if self.lost <= _LOST:
            return ""
        if self.undistort == "off":
            return f"undistorting would lose {self.lost:.0%} of the photographs: they are fitted through their lenses"
        return f"undistorting loses {self.lost:.0%} of the photographs; to fit through lenses {self.because}"

    def to_json(self) -> dict[str, Any]:
        """As config.json has it."""
        return dataclasses.asdict(self)


def lens_choice(config: FitConfig, views: Sequence[View]) -> LensChoice:
    """What `--undistort auto` means of photographs.

    Args:
        config: Configuration of the fit.
        views: The training views.
    """
    counted: dict[tuple, int] = {}
    cameras: dict[tuple, Camera] = {}
    for view in views:
        camera = view.camera
        key = camera.model, camera.distortion, camera.K.tobytes(), camera.width, camera.height
        counted[key] = counted.get(key, 0) + 1
        cameras[key] = camera
    lost = sum(count * lost_share(cameras[key]) for key, count in counted.items()) / max(len(views), 1)
    if lost <= _LOST:
        return LensChoice("on", lost)
    if planar_of(config.renderers, config.settings):
        return LensChoice("on", lost, "use --for drgs, or another renderer along rays")
    if config.data.poses != "fixed":
        return LensChoice("on", lost, "use --poses fixed")
    if config.selection is not None:
        return LensChoice("on", lost, "use --views all")
    drawn = RendererSchedule.of(config.renderers, config.settings, config.max_steps).all_settings
    if any(settings.near > 0 for settings in drawn) and any(_looks_behind(camera) for camera in cameras.values()):
        return LensChoice("on", lost, "use --for drgs: near planes leave out what lenses see behind the camera's plane")
    return LensChoice("off", lost)


def _looks_behind(camera: Camera) -> bool:
    """Whether any ray of a camera is at more than 90 degrees to its axis."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*cannot be inverted")
        return bool((at_most(camera, _PIXELS).local_directions()[..., 2] < 0).any())


def lost_share(camera: Camera) -> float:
    """Share of a photograph's rays that its undistorted image does not show."""
    if not camera.is_distorted:
        return 0.0
    small = at_most(dataclasses.replace(camera, w2c=np.eye(4), shutter="global", w2c_end=None), _PIXELS)
    with warnings.catch_warnings():
        # Where a lens has no inverse is said when its photographs are read.
        warnings.filterwarnings("ignore", message=".*cannot be inverted")
        rays = small.pixel_directions().reshape(-1, 3)
    plain = small.undistorted()
    return 1 - float(plain.contains(plain.project(rays)[0]).mean())
