"""Places for the next photograph that a person can reach, in words that begin at photographs that are there.

A place is a few steps from where one of the photographs was taken: to the left or right, higher or lower, nearer or
farther, looking at what is in the middle of that photograph. Structure from motion knows no meters, so that lengths are
given in shares of the way from the photograph to what it shows, or in meters once one length is known.

World axes are the data set's; `up` is its upward direction. In the level frame of a photograph `right` and `ahead` are
horizontal, `ahead` the way it looks.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from drgs.cameras import Camera, look_at
from drgs.data.camera_layout import level_frame

# (right, up, ahead) from a photograph, in shares of its way to what it shows.
_MOVES = (
    (-1 / 3, 0.0, 0.0),
    (1 / 3, 0.0, 0.0),
    (-2 / 3, 0.0, 0.0),
    (2 / 3, 0.0, 0.0),
    (0.0, 1 / 3, 0.0),
    (0.0, 2 / 3, 0.0),
    (0.0, -1 / 4, 0.0),
    (0.0, 0.0, 1 / 3),
    (0.0, 0.0, -1 / 3),
    (-1 / 3, 1 / 3, 0.0),
    (1 / 3, 1 / 3, 0.0),
)
_LEAST_APART = 0.15  # of the way: a place that near to a photograph, or to another place, shows nothing new
_REACH_BELOW, _REACH_ABOVE = 0.25, 0.5  # of the way, beyond the lowest and highest photograph, that a person reaches
_CLEARANCE = 0.1  # of the way: nothing solid is nearer to a place, or than half of it to the path there
_PATH_START = 0.25  # of the path, that is not checked: beside the photograph itself somebody could stand
_STEEPEST_DEGREES = 80.0  # of pitch; straight down nobody can tell left from right
_LEAST_MOVE = 0.07  # of the way: a part of a move that is not worth a word
_LEVEL_DEGREES = 5.0  # of pitch that count as straight ahead
_FRACTIONS = (
    (1 / 10, "a tenth"),
    (1 / 6, "a sixth"),
    (1 / 4, "a quarter"),
    (1 / 3, "a third"),
    (1 / 2, "half"),
    (2 / 3, "two thirds"),
    (3 / 4, "three quarters"),
)


@dataclasses.dataclass(frozen=True)
class Place:
    """Where to stand and where to look.

    Attributes:
        camera: The camera there.
        base: Name of the photograph that its words begin at.
        origin: (3,) where that was taken.
        move: (right, up, ahead) from there, in shares of `way`.
        way: Distance from the photograph to what it shows, in the world's unit.
        pitch: Degrees that the camera looks up; negative: down.
    """

    camera: Camera
    base: str
    origin: np.ndarray
    move: tuple[float, float, float]
    way: float
    pitch: float

    def words(self, meters: float | None = None) -> str:
        """Where to stand and where to look, as an instruction.

        Args:
            meters: Meters of the world's unit; None: lengths are shares of the way.
        """
        right, up, ahead = self.move
        unit = None if meters is None else meters * self.way
        steps = []
        if abs(right) >= _LEAST_MOVE:
            steps.append(f"{length_in_words(abs(right), unit)} to the {'right' if right > 0 else 'left'}")
        if abs(ahead) >= _LEAST_MOVE:
            steps.append(f"{length_in_words(abs(ahead), unit)} {'closer' if ahead > 0 else 'farther back'}")
        if abs(up) >= _LEAST_MOVE:
            steps.append(f"{length_in_words(abs(up), unit)} {'higher' if up > 0 else 'lower'}")
        go = f", then {' and '.join(steps)}" if steps else ""
        tilt = abs(self.pitch)
        look = "straight ahead" if tilt < _LEVEL_DEGREES else f"{tilt:.0f} degrees {'up' if self.pitch > 0 else 'down'}"
        return f"go where {self.base} was taken{go}; look {look}, at what is in its middle"


def length_in_words(share: float, meters: float | None) -> str:
    """A length in words.

    Args:
        share: The length in shares of the way to what a photograph shows.
        meters: Length of that way in meters; None: unknown.
    """
    if meters is None:
        if share > 7 / 8:
            return "the whole way" if share < 1.25 else f"{share:.1f} times the way"
        return min(_FRACTIONS, key=lambda part: abs(part[0] - share))[1] + " of the way"
    length = share * meters
    return f"{100 * length:.0f} cm" if length < 0.95 else f"{length:.1f} m"


def places_around(
    cameras: Sequence[Camera],
    up: np.ndarray,
    way_of: Callable[[Camera], float | None],
    obstacles: np.ndarray,
    most: int = 48,
) -> list[Place]:
    """Places a few steps from photographs that a person can reach.

    Left out are places near photographs and near each other, above and below what photographs show that one can reach,
    and those in or behind things.

    Args:
        cameras: Those of the photographs, pinholes.
        up: (3,) of length 1.
        way_of: How far away what a camera looks at is; None: it sees nothing.
        obstacles: (P, 3) points of things that are solid.
        most: Largest number of places; photographs are taken evenly for as many.
    """
    ways = [way_of(camera) for camera in cameras]
    known = [(camera, way) for camera, way in zip(cameras, ways, strict=True) if way]
    if not known:
        return []
    usual = float(np.median([way for _, way in known]))
    centers = np.stack([camera.center for camera in cameras])
    heights = centers @ up
    places = list[Place]()
    for move in _MOVES:
        for camera, way in known:
            place = _moved_camera(camera, up, way, move)
            eye = place.camera.center
            taken = [*centers, *(other.camera.center for other in places)]
            if np.linalg.norm(np.stack(taken) - eye, axis=1).min() < _LEAST_APART * min(way, usual):
                continue
            if not heights.min() - _REACH_BELOW * usual <= eye @ up <= heights.max() + _REACH_ABOVE * usual:
                continue
            if abs(place.pitch) > _STEEPEST_DEGREES or not _is_free(camera.center, eye, way, obstacles):
                continue
            places.append(place)
    if len(places) <= most:
        return places
    return [places[i * len(places) // most] for i in range(most)]


def _moved_camera(camera: Camera, up: np.ndarray, way: float, move: tuple[float, float, float]) -> Place:
    """A camera moved from a photograph's, looking at what was in the middle of the photograph."""
    right, upward, ahead = level_frame(camera, up)
    target = camera.center + way * camera.c2w[:3, 2]
    eye = camera.center + way * (move[0] * right + move[1] * upward + move[2] * ahead)
    axis = (target - eye) / np.linalg.norm(target - eye)
    sine = float(np.clip(axis @ up, -1, 1))  # of axes of length 1 by rounding
    pitch = math.degrees(math.asin(sine))
    # Straight up or down `up` does not say which way the picture is held: as the photograph was.
    w2c = look_at(eye, target, up if abs(pitch) < _STEEPEST_DEGREES else -camera.c2w[:3, 1])
    words = "_".join(f"{x:+.2f}" for x in move)
    placed = dataclasses.replace(camera, w2c=w2c, name=f"{camera.name}_{words}")
    return Place(placed, camera.name, camera.center, move, way, pitch)


def _is_free(start: np.ndarray, eye: np.ndarray, way: float, obstacles: np.ndarray) -> bool:
    """Whether nothing solid is near a place, nor on the way there from a photograph."""
    if not len(obstacles):
        return True
    if np.linalg.norm(obstacles - eye, axis=1).min() <= _CLEARANCE * way:
        return False
    start = start + _PATH_START * (eye - start)
    along = eye - start
    share = np.clip((obstacles - start) @ along / (along @ along), 0, 1)
    return bool(np.linalg.norm(start + share[:, None] * along - obstacles, axis=1).min() > _CLEARANCE / 2 * way)


def meters_of(text: str, centers: Mapping[str, np.ndarray]) -> float:
    """Meters of the world's unit, from the distance between two photographs.

    Args:
        text: Two names and a length, e.g. `IMG_0001 IMG_0004 1.5 m`; the suffix of a name may be there.
        centers: Name of a photograph -> (3,) where it was taken.
    Raises:
        ValueError: If it is no such text, there is no such photograph, or both were taken at one place.
    """
    matched = re.fullmatch(r"\s*(.+?)\s+(\S+)\s+(\d+(?:\.\d+)?)\s*(m|cm)\s*", text)
    if matched is None:
        raise ValueError(
            f"--length must be two photographs and a length, 'IMG_0001 IMG_0004 1.5 m', got {text!r}; correct it"
        )
    names = [_known(name, centers) for name in matched.groups()[:2]]
    length = float(matched[3]) * (0.01 if matched[4] == "cm" else 1.0)
    apart = float(np.linalg.norm(centers[names[0]] - centers[names[1]]))
    if not (apart > 0 and length > 0):
        raise ValueError(f"--length must be between two places, got {text!r}; name photographs that are apart")
    return length / apart


def _known(name: str, centers: Mapping[str, np.ndarray]) -> str:
    for one in (name, name.rpartition(".")[0]):
        if one in centers:
            return one
    raise ValueError(
        f"--length must name photographs with a pose, got {name!r}; the first are {', '.join(sorted(centers)[:3])}"
    )
