"""Values that are written as text: `--set KEY=VALUE`, `--orbit KEY=VALUE`, sizes, times. Imports nothing heavy."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import typing
from collections.abc import Sequence
from typing import Any

from drgs.settings import RenderSettings

UP = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "minus-x": (-1.0, 0.0, 0.0),
    "minus-y": (0.0, -1.0, 0.0),
    "minus-z": (0.0, 0.0, -1.0),
}
"""World directions by their names on the command line."""

ORBIT_KEYS = {
    "up": "up direction of the world: x, y, z, minus-x, minus-y, minus-z; auto: that of the photographs, else minus-y",
    "center": "world point X,Y,Z to look at; default that of the photographs, else the middle of the Gaussians",
    "distance": "distance from that point, in scene units; default the photographs' median, else all is in the frame",
    "elevation": "degrees above the center; default the photographs' median, else 20",
    "span": "degrees of the orbit; default that of the photographs, else 360 (select and fisher: 360 if closed)",
    "fov": "horizontal field of view in degrees; default the photographs', else 45",
}
"""Key -> its meaning, for help."""

_FORMATS = ("png", "jpg", "exr", "webm", "mp4", "ply")  # that `drgs render` writes
_MOST_CELLS = 4096  # cells of a side of a feature map, at most: more is a typing error
_SECONDS = {"s": 1.0, "sec": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
_LEAST_BUDGET = 30.0  # seconds: less is not enough to start all libraries


def parsed(texts: Sequence[str]) -> dict[str, Any]:
    """The fields that texts like `order=ray` replace.

    Raises:
        ValueError: If one is no KEY=VALUE, names no field or has the wrong type.
    """
    hints = typing.get_type_hints(RenderSettings)
    values = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or key not in hints:
            what = "KEY=VALUE" if not equals else "a render setting"
            raise ValueError(f"--set: must be {what}, got {text!r}; known: {', '.join(hints)}")
        values[key] = _setting(key, hints[key], value)
    if "background" in values:
        check_color("--set background", values["background"])
    return values


def override(name: str, value: Any) -> str:
    """The text that `parsed` reads a field from."""
    if isinstance(value, tuple):
        return f"{name}={','.join(map(repr, value))}"
    if isinstance(value, bool):
        return f"{name}={str(value).lower()}"
    return f"{name}={value!r}" if isinstance(value, float) else f"{name}={value}"


def check_color(option: str, color: tuple[float, ...]) -> None:
    """Raise ValueError unless a color of an option is one that a photograph can have: R, G, B in [0, 1]."""
    if len(color) != 3 or not all(0 <= x <= 1 for x in color):
        got = " ".join(f"{x:g}" for x in color)
        raise ValueError(f"{option} must be R, G and B in [0, 1], got {got}; 255 is 1.0 here")


def parsed_size(option: str, text: str) -> tuple[int, int]:
    """(width, height) of a text WIDTHxHEIGHT, else ValueError."""
    sides = re.fullmatch(r"(\d{1,9})x(\d{1,9})", text)
    if not sides:
        raise ValueError(f"{option}: must be WIDTHxHEIGHT, got {text!r}; say e.g. 320x240")
    return int(sides[1]), int(sides[2])


def parsed_cells(text: str) -> tuple[int, int]:
    """Width and height of a feature map, by `--size` of `drgs teach`; else ValueError, as of the next ones."""
    size = parsed_size("--size", text)
    if not all(1 <= side <= _MOST_CELLS for side in size):
        raise ValueError(f"--size must be 1x1 to {_MOST_CELLS}x{_MOST_CELLS} cells, got {text}; correct it")
    return size


def parsed_scales(text: str) -> list[float]:
    """The numbers of `--scales` of `drgs teach`."""
    try:
        scales = [float(part) for part in text.split(",")]
    except ValueError:
        scales = []
    if not scales or not all(0.1 <= scale <= 8 for scale in scales):
        raise ValueError(f"--scales must be numbers from 0.1 to 8 with commas between, got {text!r}; correct it")
    return scales


def parsed_formats(text: str) -> tuple[str, ...]:
    """The formats of `--format` of `drgs render`."""
    names = tuple(dict.fromkeys(part.strip().lower() for part in text.split(",") if part.strip()))
    unknown = [name for name in names if name not in _FORMATS]
    if unknown or not names:
        got = unknown[0] if unknown else text
        raise ValueError(f"--format must be a list of {', '.join(_FORMATS)}, got {got!r}; correct it")
    return names


def parsed_decibels(text: str) -> float:
    """The number of `0.1dB`, `0.1 dB` or `0.1`, of `--loss` of `drgs prune`."""
    try:
        loss = float(text.strip().lower().removesuffix("db"))
    except ValueError:
        loss = math.nan
    if not 0 < loss < math.inf:
        raise ValueError(f"--loss must be a number of decibels above 0, e.g. 0.1dB, got {text!r}; correct it")
    return loss


def seconds_of_budget(text: str) -> float:
    """Seconds of `90s`, `10min`, `1.5h`, of `--budget` of `drgs capture`; at least half a minute."""
    matched = re.fullmatch(r"\s*(\d+(?:\.\d+)?|\.\d+)\s*([a-z]+)\s*", text.lower())
    if matched is None or matched[2] not in _SECONDS:
        raise ValueError(f"--budget must be a time with its unit, e.g. 90s, 10min or 1.5h, got {text!r}; correct it")
    seconds = float(matched[1]) * _SECONDS[matched[2]]
    if not _LEAST_BUDGET <= seconds <= 1e7:
        raise ValueError(f"--budget must be at least {_LEAST_BUDGET:.0f}s, got {text}; allow more time")
    return seconds


def _setting(key: str, hint: Any, text: str) -> Any:
    """One --set value by its field's type: str, float, `float | None`, or a tuple of floats."""
    kinds = typing.get_args(hint) or (hint,)
    try:
        if typing.get_origin(hint) is tuple:
            return tuple(float(part) for part in text.strip("()[] ").split(","))
        if type(None) in kinds and text.lower() == "none":
            return None
        if bool in kinds:
            return {"true": True, "false": False}[text.lower()]
        number = next((kind for kind in (int, float) if kind in kinds), None)
        return number(text) if number else text
    except (ValueError, KeyError):
        kind = hint.__name__ if kinds == (hint,) else hint
        raise ValueError(f"--set {key}: must be of type {kind}, got {text!r}") from None


@dataclasses.dataclass(frozen=True, kw_only=True)
class OrbitShape:
    """What of an orbit's shape is fixed; None leaves it to the cameras or the Gaussians.

    Attributes:
        up: (3,) world direction.
        center: (3,) world point that all frames look at.
        distance: Distance of every frame from the center, in scene units.
        elevation: Degrees above the center.
        span: Degrees that the frames cover; below 360 they stay in the middle of what the cameras cover.
        fov: Horizontal field of view in degrees.
    Raises:
        ValueError: If one is out of range, named as the command-line option.
    """

    up: tuple[float, float, float] | None = None
    center: tuple[float, float, float] | None = None
    distance: float | None = None
    elevation: float | None = None
    span: float | None = None
    fov: float | None = None

    def __post_init__(self):
        if self.center is not None and not all(map(math.isfinite, self.center)):
            raise ValueError(f"--orbit center must be three finite numbers, got {self.center}; correct it")
        if self.distance is not None and not 0 < self.distance < math.inf:
            raise ValueError(f"--orbit distance must be positive and finite, got {self.distance}; correct it")
        for option, value, low, high in (
            ("--orbit elevation", self.elevation, -89, 89),
            ("--orbit span", self.span, 0, 360),
            ("--orbit fov", self.fov, 1, 170),
        ):
            if value is not None and not low <= value <= high:
                raise ValueError(f"{option} must be in [{low}, {high}] degrees, got {value}; correct it")

    @property
    def moves(self) -> bool:
        """Whether it fixes where frames are or what they look at, and not only their lens."""
        return any(value is not None for value in (self.up, self.center, self.distance, self.elevation, self.span))


def parsed_orbit(texts: Sequence[str], keys: Sequence[str] = tuple(ORBIT_KEYS)) -> dict[str, Any]:
    """What texts like `elevation=30,center=0,0,1` fix, by key; a later one wins.

    Args:
        texts: Each of one KEY=VALUE or several with commas between.
        keys: Those that the command has.
    Raises:
        ValueError: If one is no KEY=VALUE, of an unknown key, or of a value that it cannot have.
    """
    pairs = list[tuple[str, str]]()
    for text in texts:
        for piece in text.split(","):
            key, equals, value = piece.partition("=")
            if not equals and pairs and pairs[-1][0] == "center":
                pairs[-1] = "center", f"{pairs[-1][1]},{piece}"  # the numbers of a point have commas between, too
                continue
            if not equals or key.strip() not in keys:
                near = difflib.get_close_matches(key.strip(), keys, 1, 0.5) if equals else []
                what = "of a known key" if equals else "KEY=VALUE"
                advice = f"did you mean {near[0]}?" if near else f"known: {', '.join(keys)}"
                raise ValueError(f"--orbit: must be {what}, got {piece!r}; {advice}")
            pairs.append((key.strip(), value.strip()))
    return {key: _orbit_value(key, value) for key, value in pairs}


def _orbit_value(key: str, text: str) -> Any:
    """A value by its key: a direction, three numbers or a number; None leaves it to the scene."""
    if key == "up":
        if text != "auto" and text not in UP:
            raise ValueError(f"--orbit up must be one of auto, {', '.join(UP)}, got {text!r}; choose one")
        return None if text == "auto" else UP[text]
    try:
        numbers = tuple(float(number) for number in text.split(","))
    except ValueError:
        numbers = ()
    if key == "center" and len(numbers) == 3:
        return numbers
    if key != "center" and len(numbers) == 1:
        return numbers[0]
    what = "three numbers, X,Y,Z" if key == "center" else "a number"
    raise ValueError(f"--orbit {key} must be {what}, got {text!r}; correct it")
