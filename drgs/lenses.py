"""OpenCV's lens models on the image plane at z = 1; `drgs.cameras.Camera` is the way in."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["distort_opencv", "distorted", "fisheye_directions", "fisheye_polynomial", "undistort_opencv"]


def distort_opencv(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Image-plane points (P,2) through OpenCV's radial, tangential and thin prism model."""
    return np.stack(distorted(*plane.T, distortion), axis=-1)


def distorted(x: Any, y: Any, distortion: tuple) -> tuple[Any, Any]:
    """Both coordinates of `distort_opencv`; of arrays, or of tensors, whose graph is kept."""
    k1, k2, p1, p2, k3, k4, k5, k6, *prism = (*distortion, *([0.0] * (8 - len(distortion))))
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    moved_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    moved_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    if prism:
        s1, s2, s3, s4 = prism
        moved_x = moved_x + r2 * (s1 + r2 * s2)
        moved_y = moved_y + r2 * (s3 + r2 * s4)
    return moved_x, moved_y


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


def fisheye_directions(plane: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """(P,3) unit directions of distorted image-plane points (P,2).

    Newton on the angle itself, not OpenCV's tangent of it, so that lenses beyond 180 degrees work.
    """
    radius = np.linalg.norm(plane, axis=1)
    angle = radius.copy()
    for _ in range(30):
        value, slope = fisheye_polynomial(angle, distortion)
        # Where the lens turns back the slope is 0: a step that the clip ends stands for an infinite one.
        angle = np.clip(angle - (value - radius) / np.where(np.abs(slope) > 1e-6, slope, 1e-6), 0.0, np.pi)
    factor = np.sin(angle) / np.where(radius > 0, radius, 1.0)
    return np.concatenate([plane * factor[:, None], np.cos(angle)[:, None]], axis=1)
