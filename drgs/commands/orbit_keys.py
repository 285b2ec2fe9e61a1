"""`--orbit KEY=VALUE`: what a command line fixes of an orbit or a dome; imports nothing heavy, for help shows it."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

__all__ = ["ORBIT_KEYS", "UP", "parsed_orbit"]

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
"""Key -> what it says, as help shows it."""


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
    return {key: _value(key, value) for key, value in pairs}


def _value(key: str, text: str) -> Any:
    """A value by its key: a direction, three numbers or a number; None is what the scene says."""
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
