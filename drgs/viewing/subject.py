"""What a viewer looks at."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from drgs.viewing.layers import Layer
from drgs.viewing.placed_views import Ranking, Station
from drgs.viewing.poses import Pose
from drgs.viewing.uncertainty import Uncertainty

if TYPE_CHECKING:
    from drgs.ellipsoids import Scene
    from drgs.settings import RenderSettings

__all__ = ["FirstView", "Subject"]


@dataclasses.dataclass(frozen=True, eq=False)
class FirstView:
    """Where a browser begins, in the client's frame.

    Attributes:
        pose: Of its camera.
        target: (3,) the point that it looks at, and turns around.
        up: (3,) direction that is up in the capture.
    """

    pose: Pose
    target: np.ndarray
    up: np.ndarray

    @property
    def distance(self) -> float:
        """From the camera to what it looks at."""
        return float(np.linalg.norm(self.target - self.pose.position))


@dataclasses.dataclass(frozen=True, eq=False)
class Subject:
    """What is looked at; another one takes its place where a run has gone on.

    Attributes:
        name: Of the file or folder, whatever characters it has.
        state: How far a fit is, e.g. `step 1200`; empty where nobody knows.
        count: Of Gaussians.
        scene: What is drawn.
        origin: (3,) of the Gaussians: world coordinates of the client's 0.
        times: Of a scene that moves, ascending; else none.
        settings: Preset -> how it is drawn.
        layers: Which pictures there are.
        stations: Where photographs were taken or could be.
        ranking: What says so.
        uncertainty: What the layer of that name shows; None where there is none.
        first: Where a browser begins.
        background: RGB in [0, 1].
        notes: What else to say, a line each: why something is not there.
    """

    name: str
    state: str
    count: int
    scene: Scene
    origin: np.ndarray
    times: tuple[float, ...]
    settings: Callable[[str], RenderSettings]
    layers: tuple[Layer, ...]
    stations: tuple[Station, ...]
    ranking: Ranking | None
    uncertainty: Uncertainty | None
    first: FirstView
    background: tuple[float, float, float]
    notes: tuple[str, ...] = ()

    def moment(self, time: float | None) -> float | None:
        """The time at which it is looked at by who wants a time: one that it has; None where nothing moves.

        Args:
            time: Wanted: of a slider, a photograph, or of what was looked at before, which may have had none or others.
        """
        if not self.times:
            return None
        if time is None or not math.isfinite(time):
            return self.times[0]
        return min(max(time, self.times[0]), self.times[-1])

    def layer(self, name: str) -> Layer:
        """The layer of a name, else the first one."""
        return next((layer for layer in self.layers if layer.name == name), self.layers[0])
