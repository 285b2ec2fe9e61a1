"""Two rasterizers in plain NumPy float64, each from its own conventions, to hold renderers against.

One loop over pixels, one over the depth-sorted Gaussians: slow, short, and sharing nothing with the
package. Both take the same arguments:

    means (N,3), quats (N,4) wxyz, scales (N,3), opacities (N,), sh (N,K,3), K (3,3), w2c (4,4),
    width, height, background (3,)

and return `(rgb (H,W,3), alpha (H,W), count (H,W), visibility (N,))`. Left out, as they only matter
in float32: INRIA's 1e-7 in the perspective division, and gsplat's exact tile test, which removes
only tiles where every opacity is below 1/255.
"""

from __future__ import annotations

import math

import numpy as np

TILE = 16


def inria(means, quats, scales, opacities, sh, K, w2c, width, height, background=(0, 0, 0)):
    """`diff-gaussian-rasterization`: 3-sigma squares in tiles, symmetric clamp, alpha <= 0.99.

    Raises:
        ValueError: If the principal point is off center, which that code cannot express.
    """
    focal_x, focal_y = K[0, 0], K[1, 1]
    if K[0, 2] != width / 2 or K[1, 2] != height / 2:
        raise ValueError("oracle_rasterizers.inria: the principal point must be the image center")
    tan_x, tan_y = width / (2 * focal_x), height / (2 * focal_y)
    center = np.linalg.inv(w2c)[:3, 3]
    grid = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    gaussians = []
    for i in range(len(means)):
        view = w2c[:3, :3] @ means[i] + w2c[:3, 3]
        if view[2] <= 0.2:
            continue
        ndc = view[0] / (view[2] * tan_x), view[1] / (view[2] * tan_y)
        at = ((ndc[0] + 1) * width - 1) / 2, ((ndc[1] + 1) * height - 1) / 2
        tx = min(1.3 * tan_x, max(-1.3 * tan_x, view[0] / view[2])) * view[2]
        ty = min(1.3 * tan_y, max(-1.3 * tan_y, view[1] / view[2])) * view[2]
        cov = _screen_covariance(quats[i], scales[i], w2c, focal_x, focal_y, tx, ty, view[2], 0.3)
        det = cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2
        if det == 0:
            continue
        mid = 0.5 * (cov[0, 0] + cov[1, 1])
        radius = math.ceil(3 * math.sqrt(mid + math.sqrt(max(0.1, mid * mid - det))))
        first = [min(grid[k], max(0, int((at[k] - radius) / TILE))) for k in (0, 1)]
        last = [min(grid[k], max(0, int((at[k] + radius + TILE - 1) / TILE))) for k in (0, 1)]
        conic = cov[1, 1] / det, -cov[0, 1] / det, cov[0, 0] / det
        color = _color(sh[i], means[i] - center)
        gaussians.append((view[2], i, at, conic, color, first, last))
    gaussians.sort(key=lambda item: item[:2])

    out = _Image(width, height, len(means))
    for py in range(height):
        for px in range(width):
            light = 1.0
            for _, i, at, conic, color, first, last in gaussians:
                inside = first[0] <= px // TILE < last[0] and first[1] <= py // TILE < last[1]
                if not inside:
                    continue
                dx, dy = at[0] - px, at[1] - py
                power = -0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) - conic[1] * dx * dy
                if power > 0:
                    continue
                alpha = min(0.99, opacities[i] * math.exp(power))
                if alpha < 1 / 255:
                    continue
                if light * (1 - alpha) < 1e-4:
                    break
                out.add(px, py, i, alpha * light, color)
                light *= 1 - alpha
            out.finish(px, py, light, background)
    return out.result()


def gsplat(
    means,
    quats,
    scales,
    opacities,
    sh,
    K,
    w2c,
    width,
    height,
    background=(0, 0, 0),
    alpha_max=0.999,
):
    """`gsplat.rasterization` (classic mode): per-axis radii, off-center clamp, T (1 - a) <= 1e-4.

    `alpha_max` is 0.999 up to version 1.5 and 0.99 later.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    center = np.linalg.inv(w2c)[:3, 3]
    gaussians = []
    for i in range(len(means)):
        x, y, z = w2c[:3, :3] @ means[i] + w2c[:3, 3]
        if z < 0.01 or opacities[i] < 1 / 255:
            continue
        tx = z * min((width - cx) / fx + margin_x, max(-(cx / fx + margin_x), x / z))
        ty = z * min((height - cy) / fy + margin_y, max(-(cy / fy + margin_y), y / z))
        cov = _screen_covariance(quats[i], scales[i], w2c, fx, fy, tx, ty, z, 0.3)
        inverse = np.linalg.inv(cov)
        at = np.array([fx * x / z + cx, fy * y / z + cy])
        extend = min(3.33, math.sqrt(2 * math.log(opacities[i] * 255)))
        radius = np.ceil(extend * np.sqrt(np.diag(cov)))
        if np.any(at + radius <= 0) or np.any(at - radius >= (width, height)):
            continue
        first, last = np.floor((at - radius) / TILE), np.ceil((at + radius) / TILE)
        gaussians.append((z, i, at, inverse, _color(sh[i], means[i] - center), first, last))
    gaussians.sort(key=lambda item: item[:2])

    out = _Image(width, height, len(means))
    for py in range(height):
        for px in range(width):
            transmittance = 1.0
            for _, i, at, inverse, color, first, last in gaussians:
                tile = np.array([px // TILE, py // TILE])
                if np.any(tile < first) or np.any(tile >= last):
                    continue
                delta = at - (px + 0.5, py + 0.5)
                sigma = 0.5 * delta @ inverse @ delta
                alpha = min(alpha_max, opacities[i] * math.exp(-sigma))
                if sigma < 0 or alpha < 1 / 255:
                    continue
                following = transmittance * (1 - alpha)
                if following <= 1e-4:
                    break
                out.add(px, py, i, alpha * transmittance, color)
                transmittance = following
            out.finish(px, py, transmittance, background)
    return out.result()


class _Image:
    def __init__(self, width, height, n):
        self.rgb, self.alpha = np.zeros((height, width, 3)), np.zeros((height, width))
        self.count, self.visibility = np.zeros((height, width), int), np.zeros(n)

    def add(self, x, y, i, weight, color):
        self.rgb[y, x] += weight * color
        self.count[y, x] += 1
        self.visibility[i] += weight

    def finish(self, x, y, transmittance, background):
        self.rgb[y, x] += transmittance * np.asarray(background, float)
        self.alpha[y, x] = 1 - transmittance

    def result(self):
        return self.rgb, self.alpha, self.count, self.visibility


def _screen_covariance(quat, scale, w2c, fx, fy, tx, ty, z, dilation):
    w, x, y, z_ = quat / np.linalg.norm(quat)
    rotation = np.array(
        [
            [w * w + x * x - y * y - z_ * z_, 2 * (x * y - w * z_), 2 * (x * z_ + w * y)],
            [2 * (x * y + w * z_), w * w - x * x + y * y - z_ * z_, 2 * (y * z_ - w * x)],
            [2 * (x * z_ - w * y), 2 * (y * z_ + w * x), w * w - x * x - y * y + z_ * z_],
        ]
    )
    world = rotation @ np.diag(scale**2) @ rotation.T
    jacobian = np.array([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]])
    turn = jacobian @ w2c[:3, :3]
    return turn @ world @ turn.T + dilation * np.eye(2)


def sh_polynomials(direction) -> np.ndarray:
    """The 16 functions with their published decimal constants, at one unit direction."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    return np.array(
        [
            0.28209479177387814,
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    )


def _color(sh, towards):
    basis = sh_polynomials(towards / np.linalg.norm(towards))[: len(sh)]
    return np.maximum(0.5 + basis @ sh, 0)
