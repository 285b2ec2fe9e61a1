"""Checks of a camera: its intrinsics, proportions, pose and lens, each refused in one line."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np

from drgs.cameras.lenses import LENS_MODELS
from drgs.cameras.shutters import SHUTTERS
from drgs.checks.arguments import ArgumentError, kind_of

_ROTATION_TOLERANCE = 1e-4  # of R R^T: what four digits a number leave; more is a scale or a shear
_ROW_TOLERANCE = 1e-6  # of the row 0 0 0 1, which only rounding may have touched
# Beyond these, which no camera reaches, squares and ratios of float64 lose their meaning.
IMAGE_MAX = 2**31  # pixels
_FOCAL_MIN = 1e-4  # pixels
_FOCAL_MAX = 1e6  # pixels
_DISTANCE_MAX = 1e15  # scene units
_DISTORTION_MAX = 1e6  # a coefficient, without a unit
_SINGULAR = 1e-6  # a determinant below has no inverse to speak of
_TURN_MAX = math.radians(170)  # of a camera within an exposure


def is_tensor(value: Any) -> bool:
    """Whether a value is a torch tensor, without importing torch."""
    return hasattr(value, "detach")


def as_numpy(value: Any) -> np.ndarray:
    """An array of what is an array, a list or a torch tensor (detached)."""
    if not is_tensor(value):
        return np.asarray(value)
    from drgs.checks.derivatives import unwrapped

    def array(x: Any) -> np.ndarray:
        # NumPy has no bfloat16, nor torch's floats of 8 bits; float32 has all of their values.
        return (x.float() if x.is_floating_point() and x.element_size() < 4 else x).cpu().numpy()

    return unwrapped(value, array)


def read_only(array: np.ndarray) -> np.ndarray:
    """A float64 copy that cannot be changed."""
    array = np.array(array, dtype=np.float64)
    array.setflags(write=False)
    return array


def _numbers(where: str, name: str, value: Any) -> np.ndarray:
    if is_tensor(value):
        from drgs.checks.derivatives import check_has_numbers

        check_has_numbers(where, name, value)
    try:
        return read_only(as_numpy(value))
    except (TypeError, ValueError):
        raise ArgumentError(f"{where}: {name} must be an array of numbers, got {kind_of(value)}; correct it") from None


def checked_intrinsics(where: str, K: Any) -> np.ndarray:
    """(3,3) float64 K, read-only, finite, with positive focal lengths and ones and zeros where they belong."""
    K = _numbers(where, "K", K)
    if K.shape != (3, 3):
        raise ValueError(f"{where}: K must have shape (3, 3), got {K.shape}; see drgs.cameras.intrinsics")
    if not np.isfinite(K).all():
        raise ValueError(f"{where}: K must be finite, got {K[tuple(np.argwhere(~np.isfinite(K))[0])]}; correct it")
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise ValueError(f"{where}: focal lengths must be positive, got {K[0, 0]:g} and {K[1, 1]:g}; correct K")
    if K[1, 0] != 0 or tuple(K[2]) != (0.0, 0.0, 1.0):
        raise ValueError(f"{where}: K must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}; correct it")
    return K


def check_proportions(where: str, K: np.ndarray, size: tuple[int, int]) -> None:
    """Focal lengths and principal point have something to do with (width, height)."""
    for axis, side in enumerate(size):
        focal = K[axis, axis]
        middle = K[axis, 2]
        if not _FOCAL_MIN * side <= focal <= _FOCAL_MAX * side:
            raise ValueError(
                f"{where}: focal lengths must be {_FOCAL_MIN:g} to {_FOCAL_MAX:g} times the sides of the image, got "
                f"f{'xy'[axis]} = {focal:g} for {side} pixels; correct K or the size"
            )
        if abs(middle) > _FOCAL_MAX * side or abs(K[0, 1]) > _FOCAL_MAX * side:
            raise ValueError(
                f"{where}: the principal point must be within {_FOCAL_MAX:g} sides of the image, skew too, got "
                f"c{'xy'[axis]} = {middle:g}, skew = {K[0, 1]:g} for {side} pixels; correct K or the size"
            )


def check_shutter(where: str, shutter: Any, w2c_end: Any) -> None:
    """A shutter that exists, with a second pose if and only if it is a rolling one."""
    if shutter not in SHUTTERS:
        raise ValueError(f"{where}: shutter must be one of {', '.join(SHUTTERS)}, got {shutter!r}; choose one")
    if (shutter == "global") != (w2c_end is None):
        raise ValueError(
            f"{where}: w2c_end must be there for rolling shutters, and for no other, got shutter {shutter!r} and "
            f"{'no' if w2c_end is None else 'a'} second pose; change one of them"
        )


def check_turn(where: str, angle: float) -> None:
    """Between the poses of a shutter, so many radians apart, there is one shortest way."""
    if not angle <= _TURN_MAX:
        raise ValueError(
            f"{where}: w2c_end must be turned against w2c by at most {math.degrees(_TURN_MAX):.0f} degrees, got "
            f"{math.degrees(angle):.0f}; give shorter exposures"
        )


def checked_pose(where: str, w2c: Any, name: str = "w2c") -> np.ndarray:
    """(4,4) float64 w2c, read-only, finite, a rotation and a translation."""
    w2c = _numbers(where, name, w2c)
    if w2c.shape != (4, 4):
        raise ValueError(f"{where}: {name} must have shape (4, 4), got {w2c.shape}; append the row 0 0 0 1")
    if not np.isfinite(w2c).all():
        row, column = np.argwhere(~np.isfinite(w2c))[0]
        raise ValueError(
            f"{where}: the pose must be finite, got {w2c[row, column]} at [{row}, {column}]; drop this view"
        )
    check_distance(where, w2c)
    if np.abs(w2c[3] - (0, 0, 0, 1)).max() > _ROW_TOLERANCE:
        raise ValueError(f"{where}: the last row of {name} must be 0 0 0 1, got {w2c[3].tolist()}; is it transposed?")
    rotation = w2c[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > _ROTATION_TOLERANCE:
        raise ValueError(
            f"{where}: the pose must hold a rotation (orthonormal to 1e-4), got an error of {error:.2g}; remove scale "
            "and shear"
        )
    column = "2 of camera-to-world, row 2 of world-to-camera"
    check_handedness(where, rotation, "(+x right, +y down, +z forward)", column)
    return w2c


def check_handedness(where: str, rotation: np.ndarray, axes: str, column: str) -> None:
    """The axes of camera and world are both right-handed: their rotation (3, 3), or its inverse, is no reflection.

    Which is left-handed, poses do not show: with one camera axis turned around, cameras stand where they stood;
    with one of the world, the scene is its own mirror image. Only photographs, or points, agree with one and not with
    the other.

    Args:
        rotation: (3, 3) matrix; one that is closer to a reflection is refused.
        axes: Axes of a camera where the pose comes from, for the message.
        column: Number of the column that usually points the other way, for the message.
    """
    check_distance(where, rotation)
    if np.linalg.det(rotation) < 0:
        raise ValueError(
            f"{where}: the pose must hold a rotation, got a reflection (determinant -1): its camera or its world is "
            f"left-handed; if it is the camera, whose axes must be {axes}, negate the one that points the other way, "
            f"mostly column {column}, and cameras stay where they are; if it is the world, as Unity's and Unreal's, "
            "negate one row of camera-to-world, position included, with that coordinate of all points, which mirrors "
            "the scene; the same in all views"
        )


def check_distance(where: str, pose: np.ndarray) -> None:
    """No number of a pose is beyond reason."""
    far = np.abs(pose).max()
    if far > _DISTANCE_MAX:
        raise ValueError(f"{where}: the pose must be within {_DISTANCE_MAX:g} of the origin, got {far:g}; correct it")


def checked_distortion(where: str, model: str, distortion: Any) -> tuple[float, ...]:
    """Finite coefficients, as many as the lens model takes."""
    try:
        values = tuple(float(v) for v in distortion)
    except (TypeError, ValueError):
        raise ArgumentError(f"{where}: distortion must hold numbers, got {kind_of(distortion)}; correct it") from None
    if not all(abs(v) <= _DISTORTION_MAX for v in values):
        raise ValueError(
            f"{where}: distortion must be finite, no coefficient above {_DISTORTION_MAX:g}, got {values}; correct it"
        )
    if not isinstance(model, str) or model not in LENS_MODELS:
        raise ValueError(f"{where}: model must be one of {', '.join(LENS_MODELS)}, got {model!r}; choose one")
    lengths = LENS_MODELS[model].lengths
    if len(values) not in lengths:
        raise ValueError(
            f"{where}: model {model} takes {' or '.join(map(str, lengths))} distortion "
            f"coefficients, got {len(values)}; "
            "pad with zeros"
        )
    if model in ("ftheta", "ftheta_inverse"):
        c, d, e = values[5:]
        if not abs(c - d * e) > _SINGULAR:
            raise ValueError(f"{where}: [[c, d], [e, 1]] of {model} must have an inverse, got {(c, d, e)}; correct it")
    return values


def checked_time(where: str, time: Any) -> float | None:
    """A finite number as a float, or None; no tensor, whose gradient would be lost."""
    if time is None:
        return None
    try:
        value = float(time) if isinstance(time, numbers.Real) and not isinstance(time, bool) else math.nan
    except OverflowError:  # an integer that no float holds
        value = math.inf
    if not math.isfinite(value):
        raise ArgumentError(f"{where}: time must be a finite number, or None, got {kind_of(time)}; correct it")
    return value
