"""Lens models: the one table of them, and their maps between directions and points of a plane.

A model takes a direction in camera axes to a point of its plane, and K takes that to pixels. Its plane is the one at
z = 1 (`opencv`), or, of models that may see behind the camera, one of angles: `opencv_fisheye` and `ftheta` put a
direction at a distance that is a polynomial of its angle to the axis, `ftheta_inverse` at one that the angle is a
polynomial of, `equirectangular` at its longitude and latitude.
`drgs.cameras.Camera` is the way in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

_NEWTON_STEPS = 30  # Newton steps, at most; each squares the error, so far fewer are usual
_MIN_SLOPE = 1e-6  # smallest slope of a Newton step; `Camera` warns of a result that does not project back
_CONVERGED_ANGLE = 1e-14  # radians; the next step of Newton's is far below the rounding of float64
Guide = Literal["plane", "fisheye", "panorama"]
"""Where the silhouette of an ellipsoid is bounded (drgs/tracing/silhouettes.py): on the plane z = 1, under the
equidistant fisheye, or in longitude and latitude."""


@dataclass(frozen=True)
class LensModel:
    """A row of the table of lens models.

    Attributes:
        lengths: Numbers of coefficients that it takes.
        guide: The map under which silhouettes are bounded, which is near the model's own.
        project: (P,3) directions, of any length, and coefficients -> (P,2) points of its plane, or NaN.
        unproject: (P,2) points of its plane and coefficients -> (P,3) unit directions; the caller checks them by
            projecting.
        radial: Angle to the axis and coefficients -> distance in its plane and its derivative, of arrays or of tensors;
            None of a model that is not radial.
    """

    lengths: tuple[int, ...]
    guide: Guide
    project: Callable[[np.ndarray, tuple[float, ...]], np.ndarray]
    unproject: Callable[[np.ndarray, tuple[float, ...]], np.ndarray]
    radial: Callable[[Any, tuple], tuple[Any, Any]] | None = None


def distort_opencv(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Image-plane points (P,2) through OpenCV's radial, tangential and thin-prism model."""
    x, y = plane.T
    return np.stack(distorted(x, y, distortion), axis=-1)


def distorted(x: Any, y: Any, distortion: tuple) -> tuple[Any, Any]:
    """Both coordinates of `distort_opencv`; of arrays, or of tensors, whose graph is kept."""
    coefficients = [*distortion, *[0.0] * (12 - len(distortion))]
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = coefficients
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    moved_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    moved_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    if len(distortion) <= 8:
        return moved_x, moved_y
    return moved_x + r2 * (s1 + r2 * s2), moved_y + r2 * (s3 + r2 * s4)


def undistort_opencv(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Inverse of `distort_opencv`; the caller checks the result by projecting it."""
    import cv2

    # OpenCV stops at 5 rounds by default, which leaves a tenth of a pixel on ordinary lenses.
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-12)
    result = cv2.undistortPoints(
        np.ascontiguousarray(plane[:, None, :]),
        np.eye(3),
        np.array(distortion),
        None,
        np.eye(3),
        np.eye(3),
        criteria,
    )
    return result.reshape(-1, 2)


def fisheye_polynomial(angle: Any, distortion: tuple) -> tuple[Any, Any]:
    """Distorted angle and its derivative for an angle (radians) to the axis; of arrays, or of tensors."""
    k1, k2, k3, k4 = distortion
    a2 = angle * angle
    value = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
    return value, slope


def angle_polynomial(angle: Any, distortion: tuple) -> tuple[Any, Any]:
    """Distance k1 a + ... + k5 a^5 of `ftheta` and its derivative, for an angle a (radians); of arrays, or tensors."""
    k1, k2, k3, k4, k5 = distortion[:5]
    value = angle * (k1 + angle * (k2 + angle * (k3 + angle * (k4 + angle * k5))))
    slope = k1 + angle * (2 * k2 + angle * (3 * k3 + angle * (4 * k4 + angle * 5 * k5)))
    return value, slope


def angle_polynomial_inverse(angle: Any, distortion: tuple) -> tuple[Any, Any]:
    """Distance r of `ftheta_inverse` with k1 r + ... + k5 r^5 = angle (radians), and its derivative, for an angle; of
    arrays, or tensors, where the last of Newton's steps has the derivatives by angle and coefficients.
    """
    known = [x.detach() if hasattr(x, "detach") else x for x in (angle, *distortion[:5])]
    r = known[0] / known[1]
    for _ in range(_NEWTON_STEPS):
        value, slope = angle_polynomial(r, tuple(known[1:]))
        # Where the polynomial turns back the slope is 0.
        r = r - (value - known[0]) / (slope + _MIN_SLOPE * (abs(slope) < _MIN_SLOPE))
        r = r * (r > 0)
    value, slope = angle_polynomial(r, distortion)
    return r - (value - angle) / slope, 1 / slope


def linear_part(model: str, distortion: tuple) -> tuple[Any, Any, Any]:
    """The matrix [[c, d], [e, 1]] that follows a radial model's polynomial, as (c, d, e); none is (1, 0, 0)."""
    return tuple(distortion[5:8]) if model in ("ftheta", "ftheta_inverse") else (1.0, 0.0, 0.0)


def equirectangular(x: Any, y: Any, module: Any) -> tuple[Any, Any, Any]:
    """Unit direction of longitudes x and latitudes y, in radians: right of the axis and below it; of NumPy or torch,
    which `module` is.
    """
    across = module.cos(y)
    return across * module.sin(x), module.sin(y), across * module.cos(x)


def _on_plane(local: np.ndarray) -> np.ndarray:
    x, y, z = local.T
    depth = np.where(z > 0, z, np.nan)
    return np.stack([x / depth, y / depth], axis=-1)


def _pinhole_project(local: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    return _on_plane(local)


def _pinhole_unproject(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    directions = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _opencv_project(local: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    plane = _on_plane(local)
    return distort_opencv(plane, distortion) if any(distortion) else plane


def _opencv_unproject(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    return _pinhole_unproject(undistort_opencv(plane, distortion) if any(distortion) else plane, ())


def _radial_project(local: np.ndarray, distortion: tuple[float, ...], polynomial: Callable) -> np.ndarray:
    x, y, z = local.T
    radius = np.hypot(x, y)
    # On the axis the ratio is 0/0; its limit multiplies x = y = 0 and does not matter.
    factor = polynomial(np.arctan2(radius, z), distortion)[0] / np.where(radius > 0, radius, 1.0)
    return np.stack([x * factor, y * factor], axis=-1)


def _radial_unproject(plane: np.ndarray, distortion: tuple[float, ...], polynomial: Callable) -> np.ndarray:
    """Newton on the angle itself, not OpenCV's tangent of it, so that lenses beyond 180 degrees work."""
    radius = np.linalg.norm(plane, axis=1)
    steepest = polynomial(np.zeros(1), distortion)[1][0]
    angle = np.clip(radius / (steepest if abs(steepest) > 1e-6 else 1.0), 0.0, np.pi)
    for _ in range(_NEWTON_STEPS):
        value, slope = polynomial(angle, distortion)
        # Where the lens turns back the slope is 0: a step that the clip ends stands for an infinite one.
        moved = np.clip(angle - (value - radius) / np.where(np.abs(slope) > 1e-6, slope, 1e-6), 0.0, np.pi)
        is_there = np.abs(moved - angle).max(initial=0.0) < _CONVERGED_ANGLE
        angle = moved
        if is_there:
            break
    factor = np.sin(angle) / np.where(radius > 0, radius, 1.0)
    return np.concatenate([plane * factor[:, None], np.cos(angle)[:, None]], axis=1)


def _fisheye_project(local: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    return _radial_project(local, distortion, fisheye_polynomial)


def _fisheye_unproject(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    return _radial_unproject(plane, distortion, fisheye_polynomial)


def _ftheta_project(
    local: np.ndarray, distortion: tuple[float, ...], polynomial: Callable = angle_polynomial
) -> np.ndarray:
    c, d, e = distortion[5:]
    x, y = _radial_project(local, distortion, polynomial).T
    return np.stack([c * x + d * y, e * x + y], axis=-1)


def _round_plane(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Points before the linear part."""
    c, d, e = distortion[5:]
    x, y = plane.T
    return np.stack([x - d * y, c * y - e * x], axis=-1) / (c - d * e)


def _ftheta_unproject(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    return _radial_unproject(_round_plane(plane, distortion), distortion, angle_polynomial)


def _ftheta_inverse_project(local: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    return _ftheta_project(local, distortion, angle_polynomial_inverse)


def _ftheta_inverse_unproject(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    plane = _round_plane(plane, distortion)
    radius = np.linalg.norm(plane, axis=1)
    angle = angle_polynomial(radius, distortion)[0]
    factor = np.sin(angle) / np.where(radius > 0, radius, 1.0)
    return np.concatenate([plane * factor[:, None], np.cos(angle)[:, None]], axis=1)


def _equirectangular_project(local: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    x, y, z = local.T
    return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1)


def _equirectangular_unproject(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    x, y = plane.T
    return np.stack(equirectangular(x, y, np), axis=-1)


LENS_MODELS: dict[str, LensModel] = {
    "pinhole": LensModel((0,), "plane", _pinhole_project, _pinhole_unproject),
    "opencv": LensModel((4, 5, 8, 12), "plane", _opencv_project, _opencv_unproject),
    "opencv_fisheye": LensModel((4,), "fisheye", _fisheye_project, _fisheye_unproject, fisheye_polynomial),
    "ftheta": LensModel((8,), "fisheye", _ftheta_project, _ftheta_unproject, angle_polynomial),
    "ftheta_inverse": LensModel(
        (8,), "fisheye", _ftheta_inverse_project, _ftheta_inverse_unproject, angle_polynomial_inverse
    ),
    "equirectangular": LensModel((0,), "panorama", _equirectangular_project, _equirectangular_unproject),
}
"""Name of a model -> what it is."""
