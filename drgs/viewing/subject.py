"""The subject of a viewer: a scene with its cameras, or a run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping

import numpy as np

from drgs.ellipsoids import Scene
from drgs.settings import RenderSettings
from drgs.viewing.client import Pose
from drgs.viewing.layers import Layer, PhotographMap
from drgs.viewing.placed_views import PlacedView, Ranking


@dataclasses.dataclass(frozen=True, eq=False)
class FirstView:
    """The view at which a browser begins, in the client's frame.

    Attributes:
        pose: Pose of the browser's camera.
        target: (3,) point that it looks at, and turns around.
        up: (3,) direction that is up in the capture.
    """

    pose: Pose
    target: np.ndarray
    up: np.ndarray

    @property
    def distance(self) -> float:
        """Distance from the camera to what it looks at."""
        return float(np.linalg.norm(self.target - self.pose.position))


@dataclasses.dataclass(frozen=True, eq=False)
class Subject:
    """A scene with its cameras; a newer one replaces it when a run has continued.

    Attributes:
        name: Name of the file or folder, whatever characters it has.
        state: How far a fit is, e.g. `step 1200`; empty where it is unknown.
        count: Number of Gaussians.
        scene: What is drawn.
        origin: (3,) origin of the Gaussians: world coordinates of the client's 0.
        times: Times of a scene that moves, ascending; empty for one that does not.
        settings: Function of a preset's name: the settings that the scene is drawn by.
        layers: Pictures that there are of it.
        placed_views: Places where photographs were taken or could be.
        ranking: Selection that scored these; None where there is none.
        maps: What photographs say, by the name of the layer that shows it.
        first: View at which a browser begins.
        background: RGB in [0, 1].
        notes: Lines that say what is not there, and why.
    """

    name: str
    state: str
    count: int
    scene: Scene
    origin: np.ndarray
    times: tuple[float, ...]
    settings: Callable[[str], RenderSettings]
    layers: tuple[Layer, ...]
    placed_views: tuple[PlacedView, ...]
    ranking: Ranking | None
    maps: Mapping[str, PhotographMap]
    first: FirstView
    background: tuple[float, float, float]
    notes: tuple[str, ...] = ()

    def nearest_time(self, time: float | None) -> float | None:
        """The time of the scene that is nearest to a wanted time; None where nothing moves.

        Args:
            time: Wanted time, of a slider, a photograph, or of the subject before, which may have had none or
                others.
        """
        if not self.times:
            return None
        if time is None or not math.isfinite(time):
            return self.times[0]
        return min(max(time, self.times[0]), self.times[-1])

    def layer(self, name: str) -> Layer:
        """The layer of a name, else the first one."""
        return next((layer for layer in self.layers if layer.name == name), self.layers[0])
