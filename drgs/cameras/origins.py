"""Where a world's zero is: an offset that positions are kept relative to, so that float32 has the digits of detail.

Surveyed worlds stand far from 0: 5,400,000 m north in UTM, where float32 steps by 0.5 m. Cameras and points of data
sets stay in the world, float64. Means of Gaussians are float32 and relative to `Gaussians.origin`, and so are the
positions in files that are written of them. position in the world = position in the file + offset.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

FAR = 10.0
"""Extents of a scene that its middle may be from 0 with an origin of 0: float32 rounds by 6e-7 of the extent there,
which is a thousandth of a pixel of a picture 1,600 pixels wide."""
_FARTHEST = 1e15  # world units, as of cameras: beyond it squares and ratios of float64 lose their meaning


def origin_near(middle: np.ndarray, extent: float) -> np.ndarray:
    """(3,) float64 origin of a scene: 0, or its middle where that is far from 0.

    Rounded to a power of ten that is not above the extent: few decimals, which text gives back exactly.

    Args:
        middle: (3,) middle of the scene, world.
        extent: Size of the scene, world units, > 0.
    """
    if not float(np.linalg.norm(middle)) > FAR * extent:
        return np.zeros(3)
    decimals = -math.floor(math.log10(extent))
    return np.array([round(float(x), decimals) + 0.0 for x in middle])  # + 0.0: no -0


def origin_text(origin: np.ndarray) -> str:
    """Three numbers, blanks between them, that `origin_of_text` gives back exactly."""
    return " ".join(repr(float(x)).removesuffix(".0") for x in origin)


def origin_of_text(where: str, text: str) -> np.ndarray:
    """(3,) float64 of three numbers in a file.

    Args:
        where: File, and place in it, for the message.
        text: The numbers, blanks or commas between them.
    Raises:
        ValueError: If it is anything else, or a number is not finite or beyond 1e15.
    """
    try:
        values = [float(x) for x in text.replace(",", " ").split()]
    except ValueError:
        values = []
    return check_origin(where, values if len(values) == 3 else text)


def check_origin(where: str, values: Any) -> np.ndarray:
    """(3,) float64 of an origin that a file states.

    Args:
        where: File, and place in it, for the message.
        values: What it states: a list of three numbers, if it is right.
    Raises:
        ValueError: If it is anything else, or a number is not finite or beyond 1e15.
    """
    known = isinstance(values, list) and len(values) == 3
    if not known or not all(
        isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= _FARTHEST for x in values
    ):
        raise ValueError(
            f"{where}: the offset must be three finite numbers up to {_FARTHEST:g}, got {str(values)[:60]!r}; correct "
            "it, or remove it if positions are absolute"
        )
    return np.array(values, np.float64)


def rounding(coordinates: np.ndarray) -> float:
    """Difference between coordinates of any shape that may come of rounding alone, in files and in inverse matrices."""
    return max(1e-9, 1e-12 * float(np.abs(coordinates).max(initial=0.0)))


def decimals(coordinates: np.ndarray) -> int:
    """Decimals that coordinates of any shape are rounded to so that those are equal which differ by `rounding` alone: 9
    near 0, 5 at millions.
    """
    return -math.ceil(math.log10(rounding(coordinates)))
