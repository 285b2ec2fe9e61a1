"""A candidate moved to where its view scores higher, within bounds.

A list of candidates is a sample of the places where a camera can be; the best of them is near a better one. From there
the camera goes along its own axes and turns about two of them, one motion at a time, each kept where the score is
higher, in steps that are halved when none is: the pattern search of Hooke and Jeeves (1961). It needs scores alone, of
which one costs as much as that of a candidate; a gradient by differences would need ten for each step, and the score
has corners wherever a Gaussian enters the image.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.origins import decimals, rounding
from drgs.checks.arguments import ArgumentError, kind_of

if TYPE_CHECKING:
    from drgs.ellipsoids import Scene
    from drgs.information.gains import Gain
    from drgs.information.sums import Information

_AXES = ("right", "down", "forward")
_MAX_HALVINGS = 4  # times that steps are halved, to a 16th of the first: finer ones change a score by little
_MIN_GAIN = 1e-6  # relative rise of a score that is more than rounding
_OBSTACLE_ALPHA = 0.5  # opacity from which on a Gaussian is in the way
_NEAREST_RANK = 10  # distance to Gaussians is that to the tenth nearest: fewer may be floaters. Chosen


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refine:
    """How far and how long a pick is moved.

    Attributes:
        evaluations: Views that are scored for each pick, at most.
        box: Lowest and highest x, y and z of the camera's center, world units: (x0, y0, z0, x1, y1, z1); None: of the
            box around all candidates and known views.
        turn: How far the camera's axis may turn from the candidate's, degrees.
    Raises:
        ValueError: If a value is out of range.
    """

    evaluations: int = 40
    box: tuple[float, ...] | None = None
    turn: float = 15.0

    def __post_init__(self) -> None:
        if type(self.evaluations) is not int or self.evaluations < 1:
            raise ArgumentError(
                f"Refine: evaluations must be a whole number >= 1, got {kind_of(self.evaluations)}; try 40"
            )
        if not 0 <= self.turn <= 90:
            raise ArgumentError(f"Refine: turn must be in [0, 90] degrees, got {self.turn!r}; try 15")
        if self.box is not None:
            object.__setattr__(self, "box", tuple(float(x) for x in self.box))
            low, high = np.array(self.box[:3]), np.array(self.box[3:])
            if len(self.box) != 6 or not np.isfinite(self.box).all() or (low > high).any():
                raise ArgumentError(
                    f"Refine: box must be x0, y0, z0, x1, y1, z1, lowest before highest, got {self.box}; correct it"
                )


@dataclasses.dataclass(frozen=True)
class _Bounds:
    """Where a camera may be.

    Attributes:
        low, high: (3,) corners of the box, world units.
        forward: (3,) world, optical axis of the candidate.
        turn: Largest angle between it and the axis of the moved camera, degrees.
        solid: (M, 3) world, means of the Gaussians that are opaque enough to be run into.
        clearance: World units: how near any of the cameras comes to the tenth nearest of these, the least distance.
    """

    low: np.ndarray
    high: np.ndarray
    forward: np.ndarray
    turn: float
    solid: np.ndarray
    clearance: float

    @classmethod
    def of(cls, scene: Scene, cameras: Sequence[Camera], start: Camera, refine: Refine) -> _Bounds:
        """Those of a candidate, of which there are more, among `cameras`."""
        centers = np.stack([x.center for x in cameras])
        seen = scene.at(start.time)
        means = seen.means.detach().double().cpu().numpy() + np.asarray(seen.origin)
        solid = means[(seen.logit_opacities.detach().sigmoid() > _OBSTACLE_ALPHA).cpu().numpy()]
        low, high = (centers.min(0), centers.max(0)) if refine.box is None else np.split(np.array(refine.box), 2)
        clearance = min((_distance(solid, center) for center in centers), default=0.0)
        return cls(low, high, start.c2w[:3, 2], refine.turn, solid, clearance)

    def hold(self, camera: Camera, start: Camera) -> bool:
        """Whether a camera keeps them; a candidate outside of the box may stay outside, not go further out."""
        beyond = lambda x: np.maximum(np.maximum(self.low - x, x - self.high), 0).max()  # noqa: E731
        tiny = rounding(np.stack([self.low, self.high]))  # of a center, which turning moves by as much
        if beyond(camera.center) > beyond(start.center) + max(1e-9 * np.abs(self.high - self.low).max(), tiny):
            return False
        cosine = float(np.clip(camera.c2w[:3, 2] @ self.forward, -1, 1))
        if math.degrees(math.acos(cosine)) > self.turn + 1e-6:
            return False
        return _distance(self.solid, camera.center) >= min(self.clearance, _distance(self.solid, start.center)) - tiny


def _distance(solid: np.ndarray, center: np.ndarray) -> float:
    """To the tenth nearest Gaussian; infinite where there are fewer."""
    if len(solid) < _NEAREST_RANK:
        return math.inf
    return float(np.partition(np.linalg.norm(solid - center, axis=1), _NEAREST_RANK - 1)[_NEAREST_RANK - 1])


def refined(
    scene: Scene,
    candidates: Sequence[Camera],
    known: Sequence[Camera],
    start: Camera,
    gain: Gain,
    score: Callable[[Information], Gain],
    compute: Callable[[Camera], Information],
    refine: Refine,
) -> tuple[Camera, Gain, Information | None, int]:
    """A candidate moved to where it scores higher.

    Args:
        scene: The scene.
        candidates, known: The cameras that it was chosen among, and those of known views.
        start, gain: The candidate, and its gain.
        score: Gain of a view's information against that of the known views.
        compute: Information of a view.
        refine: How far and how long.
    Returns:
        The camera, its gain and its information (None where it has not moved), and how many views were scored.
    """
    bounds = _Bounds.of(scene, [*candidates, *known], start, refine)
    shift = _shift(candidates) or _shift([*candidates, *known])  # one candidate alone has no next one
    best, highest, moved = start, gain, None
    count = 0
    motions = [(kind, axis, sign) for kind in ("go", "turn") for axis in _AXES for sign in (1, -1)]
    motions = [x for x in motions if x[:2] != ("turn", "forward")]  # a roll shows the same place
    for halved in range(_MAX_HALVINGS + 1):
        rose = True
        while rose:
            rose = False
            for kind, axis, sign in motions:
                size = sign * (shift if kind == "go" else math.radians(refine.turn) / 2) / 2**halved
                camera = _moved(best, kind, _AXES.index(axis), size)
                while size and count < refine.evaluations and bounds.hold(camera, start):
                    information = compute(camera)
                    own = score(information)
                    count += 1
                    if own.total <= highest.total + _MIN_GAIN * abs(highest.total):
                        break
                    best, highest, moved, rose = camera, own, information, True
                    camera = _moved(best, kind, _AXES.index(axis), size)
            if count >= refine.evaluations:
                return best, highest, moved, count
    return best, highest, moved, count


def _shift(cameras: Sequence[Camera]) -> float:
    """Half of how far cameras are from the next one, the median; 0 where all are in one place."""
    centers = np.stack([x.center for x in cameras])
    centers = np.unique(centers.round(decimals(centers)), axis=0)
    if len(centers) < 2:
        return 0.0
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(1))) / 2


def _moved(camera: Camera, kind: str, axis: int, size: float) -> Camera:
    """A camera that went along one of its axes, or turned about it, by world units or radians."""
    back = np.eye(4)  # from its new axes to those it had, inverted
    if kind == "go":
        back[axis, 3] = -size
    else:
        a, b = (k for k in range(3) if k != axis)
        back[a, a] = back[b, b] = math.cos(size)
        back[a, b], back[b, a] = math.sin(size), -math.sin(size)
    poses = ("w2c", "w2c_end") if camera.is_rolling else ("w2c",)
    return dataclasses.replace(camera, **{name: back @ np.array(getattr(camera, name).tolist()) for name in poses})
