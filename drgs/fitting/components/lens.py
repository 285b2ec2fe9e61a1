"""Whether a fit looks through lenses: where taking them out would lose much of the photographs.

The pinhole camera of a lens's K shows what is in front of it, within the image: what a wide lens sees besides is lost.
A fit that can draw along rays need not lose it.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.sizes import at_most
from drgs.display.progress import Bar
from drgs.fitting.components.base import Component, Conflict, Fit, Setup
from drgs.fitting.renderers import RendererSchedule, planar_of

if TYPE_CHECKING:
    from drgs.data import View
    from drgs.fitting.config import FitConfig

# Share of the rays that undistorting may crop; ordinary lenses lose 0.05, a fisheye of 180 degrees most.
_MOST_LOST = 0.2
_COUNTED_PIXELS = 10_000  # pixels of a camera by which the share is counted: right within 1 %


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
        if self.lost <= _MOST_LOST:
            return ""
        if self.undistort == "off":
            return f"undistorting would lose {self.lost:.0%} of the photographs: they are fitted through their lenses"
        return f"undistorting loses {self.lost:.0%} of the photographs; to fit through lenses {self.because}"

    def to_json(self) -> dict[str, Any]:
        """As config.json has it."""
        return dataclasses.asdict(self)


def lens_choice(config: FitConfig, views: Sequence[View], otherwise: str | None = None) -> LensChoice:
    """What `--undistort auto` means of photographs.

    Args:
        config: Configuration of the fit.
        views: The training views.
        otherwise: What to do to fit through lenses, where something else of the fit does not go with them.
    """
    counted: dict[tuple, int] = {}
    cameras: dict[tuple, Camera] = {}
    for view in views:
        camera = view.camera
        key = camera.model, camera.distortion, camera.K.tobytes(), camera.width, camera.height
        counted[key] = counted.get(key, 0) + 1
        cameras[key] = camera
    lost = sum(count * lost_share(cameras[key]) for key, count in counted.items()) / max(len(views), 1)
    if lost <= _MOST_LOST:
        return LensChoice("on", lost)
    if planar_of(config.renderers, config.settings):
        return LensChoice("on", lost, "use --for drgs, or another renderer along rays")
    if otherwise is not None:
        return LensChoice("on", lost, otherwise)
    drawn = RendererSchedule.of(config.renderers, config.settings).all_settings
    if any(settings.near > 0 for settings in drawn) and any(_looks_behind(camera) for camera in cameras.values()):
        return LensChoice("on", lost, "use --for drgs: near planes leave out what lenses see behind the camera's plane")
    return LensChoice("off", lost)


class LensComponent(Component):
    """Whether photographs are fitted as they were taken, through their lenses: `undistort` off, or auto, where
    undistorting would lose much.

    Attributes:
        choice: The choice of `auto`; None where it is not `auto`.
    """

    name = "lens"
    option = ("undistort", "on")
    where = "where photographs are fitted through their lenses"
    conflicts = (
        Conflict("poses", "a lens's pose is not differentiated", "use --poses fixed"),
        Conflict("selection", "candidates are scored as pinhole cameras", "use --views all"),
    )

    def __init__(self) -> None:
        self.choice: LensChoice | None = None

    def prepare(self, setup: Setup) -> None:
        """See `Component`: what `auto` means is from now on in the configuration."""
        if setup.config.data.undistort != "auto":
            return
        with Bar("lenses") as bar:
            clash = setup.conflict(self)
            self.choice = lens_choice(setup.config, setup.train, None if clash is None else clash[0].advice)
            if self.choice.words():
                bar.note(self.choice.words())
        data = dataclasses.replace(setup.config.data, undistort=self.choice.undistort)
        setup.config = setup.config.replace(data=data)

    def setting(self, setup: Setup) -> str | None:
        """See `Component`: `auto` gives way."""
        return "off" if setup.config.data.undistort == "off" else None

    def record(self, fit: Fit, before: Mapping[str, Any]) -> dict[str, Any]:
        """See `Component`."""
        return {"lenses": self.choice.to_json()} if self.choice is not None and self.choice.lost else {}


def _looks_behind(camera: Camera) -> bool:
    """Whether any ray of a camera is at more than 90 degrees to its axis."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*cannot be inverted")
        return bool((at_most(camera, _COUNTED_PIXELS).local_directions()[..., 2] < 0).any())


def lost_share(camera: Camera) -> float:
    """Share of a photograph's rays that its undistorted image does not show."""
    if not camera.is_distorted:
        return 0.0
    small = at_most(dataclasses.replace(camera, w2c=np.eye(4), shutter="global", w2c_end=None), _COUNTED_PIXELS)
    with warnings.catch_warnings():
        # Where a lens has no inverse is said when its photographs are read.
        warnings.filterwarnings("ignore", message=".*cannot be inverted")
        rays = small.pixel_directions().reshape(-1, 3)
    plain = small.undistorted()
    return 1 - float(plain.contains(plain.project(rays)[0]).mean())
