"""Which tiles gsplat's 3DGUT looks for a Gaussian in: those of the box of its covariance on the image, as the unscented
transform estimates it.

The transform (Julier and Uhlmann 1997; Wan and van der Merwe 2000, alpha = 0.1, beta = 2, kappa = 0, as in 3DGUT: Wu
et al. 2025) projects the mean and six points at sqrt(3) alpha standard deviations around it, and takes a weighted mean
and covariance of what it finds. The box reaches to where the opacity, times the root of the ratio of the determinants
of that covariance without and with dilation, falls to 1/255. What a large Gaussian near the camera covers beyond it is
not drawn: `culling` `ut` leaves it out, too. Boxes are of whole tiles and have no derivative.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np
import torch

from drgs.cameras import Camera
from drgs.cameras.lenses import angle_polynomial, distorted, fisheye_polynomial
from drgs.tracing.arrays import Float, Lib, Mask
from drgs.tracing.primitives import Activated

_ALPHA, _BETA = 0.1, 2.0  # parameters of the transform, gsplat's defaults; kappa is 0
SPREAD = _ALPHA * math.sqrt(3.0)
"""Distance of the six points from the mean, in standard deviations."""
_WEIGHT_OF_POINT = 1 / (2 * SPREAD**2)  # weight of each of the six points
MEAN_WEIGHTS = (1 - 6 * _WEIGHT_OF_POINT, *[_WEIGHT_OF_POINT] * 6)
"""Weights of the mean's and the six points' places in the mean on the image."""
COVARIANCE_WEIGHTS = (MEAN_WEIGHTS[0] + 1 - _ALPHA**2 + _BETA, *MEAN_WEIGHTS[1:])
"""The same in the covariance."""
MARGIN = 0.1
"""Share of the width and height, added on each side: a Gaussian without a point inside is not drawn."""
DILATION = 0.3
"""px^2, added to the covariance: gsplat's default."""
LEAST_COMPENSATION = 0.005
"""The least factor by which opacities are compensated for it: gsplat's."""
EXTENT = 3.33
"""Standard deviations of a box, or where the opacity falls to `LEAST_OPACITY`."""
LEAST_OPACITY = 1 / 255
_FINE, _COARSE = 8, 16  # pixels of gsplat's tiles: in images of less than `_HIGH` rows, and in others
_HIGH = 1080  # rows
_INSIDE = 0.25  # px, off the edge of a tile, so that rounding does not take its neighbor


def unscented_boxes(lib: Lib, g: Activated, camera: Camera, origin: torch.Tensor) -> tuple[list[Float], Mask]:
    """Bounds x0, y0, x1, y1 in pixels, of whole tiles, and which Gaussians have any.

    Args:
        g: Gaussians, in the axes of the camera.
        camera: Its lens and shutter are followed.
        origin: (3,) what was taken off the camera's world.
    """
    F = lib.Float64
    points = _pixels(lib, g, camera, origin)
    there = lib.Bool(False)
    for x, y, front in points:
        margin_x, margin_y = MARGIN * camera.width, MARGIN * camera.height
        inside = (x >= -margin_x) & (x < camera.width + margin_x)
        there |= front & inside & (y >= -margin_y) & (y < camera.height + margin_y)
    mean = [sum(w * p[k] for w, p in zip(MEAN_WEIGHTS, points, strict=True)) for k in range(2)]
    off = [(p[0] - mean[0], p[1] - mean[1]) for p in points]
    xx, xy, yy = (
        sum(w * o[i] * o[j] for w, o in zip(COVARIANCE_WEIGHTS, off, strict=True)) for i, j in ((0, 0), (0, 1), (1, 1))
    )
    sharp = xx * yy - xy * xy
    xx += DILATION
    yy += DILATION
    det = xx * yy - xy * xy
    # As if what the dilation widens was made fainter, although the opacity along rays is not.
    shrunk = dr.sqrt(dr.maximum(sharp / dr.select(det > 0, det, 1), LEAST_COMPENSATION**2))
    opacity = dr.detach(g.opacity) * shrunk  # boxes have no derivative
    extent = dr.minimum(dr.sqrt(2 * dr.log(dr.maximum(opacity / LEAST_OPACITY, 1))), EXTENT)
    middle = 0.5 * (xx + yy)
    largest = middle + dr.sqrt(dr.maximum(middle * middle - det, 0.01))
    size = F(camera.width), F(camera.height)
    tile = _FINE if camera.height < _HIGH else _COARSE
    low, high = [], []
    seen = there & (det > 0) & (opacity >= LEAST_OPACITY)
    for m, variance, side in zip(mean, (xx, yy), size, strict=True):
        radius = dr.ceil(extent * dr.sqrt(dr.minimum(variance, largest)))
        seen &= (m + radius > 0) & (m - radius < side) & (radius > 0)
        low.append(tile * dr.floor((m - radius) / tile) + _INSIDE)
        high.append(tile * dr.ceil((m + radius) / tile) - _INSIDE)
    return [*low, *high], seen


def _pixels(lib: Lib, g: Activated, camera: Camera, origin: torch.Tensor) -> list[tuple[Float, Float, Mask]]:
    """Pixel of the mean and of the six points around it, and whether it is in front of the camera; else at (0, 0)."""
    center = [dr.detach(x) for x in g.center]  # numbers, as all of this
    scale = [dr.detach(s) * SPREAD for s in g.scale]
    if not camera.is_rolling and camera.model in _PLANES:
        axes = [[dr.detach(g.from_local[r][k]) * scale[k] for r in range(3)] for k in range(3)]
        fx, skew, cx, fy, cy = (
            dr.opaque(lib.Float64, float(camera.K[i, j])) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2))
        )
        found = []
        for x, y, z in _around(center, axes):
            x, y, front = _PLANES[camera.model](x, y, z, camera.distortion)
            u, v = fx * x + skew * y + cx, fy * y + cy
            found.append((dr.select(front, u, 0), dr.select(front, v, 0), front))
        return found
    mean = [dr.detach(x) + float(o) for x, o in zip(g.mean, origin, strict=True)]
    axes = [[dr.detach(g.rotation[r][k]) * scale[k] for r in range(3)] for k in range(3)]
    zero = dr.zeros(lib.Float64, dr.width(mean[0]))
    points = [np.stack([(x + zero).numpy() for x in point], 1) for point in _around(mean, axes)]
    pixels, _ = camera.project(np.concatenate(points))
    front = np.isfinite(pixels).all(1)
    pixels = np.where(front[:, None], pixels, 0.0)
    columns = [np.split(x, 7) for x in (pixels[:, 0], pixels[:, 1], front)]
    floats = [[lib.Float64(np.ascontiguousarray(x)) for x in column] for column in columns[:2]]
    masks = [lib.UInt32(x.astype(np.uint32)) != 0 for x in columns[2]]
    return list(zip(*floats, masks, strict=True))


def _pinhole(x: Float, y: Float, z: Float, distortion: tuple) -> tuple[Float, Float, Mask]:
    """Where the plane z = 1 shows a point, and whether it does."""
    front = z > 0
    iz = 1 / dr.select(front, z, 1)
    return x * iz, y * iz, front


def _opencv(x: Float, y: Float, z: Float, distortion: tuple) -> tuple[Float, Float, Mask]:
    """The same through OpenCV's lens."""
    u, v, front = _pinhole(x, y, z, distortion)
    return *distorted(u, v, distortion), front


def _fisheye(x: Float, y: Float, z: Float, distortion: tuple) -> tuple[Float, Float, Mask]:
    """The same through OpenCV's fisheye, which sees behind itself."""
    radius = dr.sqrt(x * x + y * y)
    seen, _ = fisheye_polynomial(dr.atan2(radius, z), distortion)
    factor = dr.select(radius > 0, seen / dr.select(radius > 0, radius, 1), 0)
    return x * factor, y * factor, radius >= 0


def _ftheta(x: Float, y: Float, z: Float, distortion: tuple) -> tuple[Float, Float, Mask]:
    """The same through an f-theta lens."""
    radius = dr.sqrt(x * x + y * y)
    seen, _ = angle_polynomial(dr.atan2(radius, z), distortion)
    factor = dr.select(radius > 0, seen / dr.select(radius > 0, radius, 1), 0)
    c, d, e = distortion[5:8]
    u, v = x * factor, y * factor
    return c * u + d * v, e * u + v, radius >= 0


_PLANES = {"pinhole": _pinhole, "opencv": _opencv, "opencv_fisheye": _fisheye, "ftheta": _ftheta}


def _around(center: list[Float], axes: list[list[Float]]) -> list[list[Float]]:
    """A point, and the two along each of three axes."""
    signed = [[sign * x for x in axis] for sign in (1, -1) for axis in axes]
    return [center, *([c + x for c, x in zip(center, axis, strict=True)] for axis in signed)]
