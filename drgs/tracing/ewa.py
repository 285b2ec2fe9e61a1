"""Response `ewa`: the rasterizers' own model, a = alpha exp(-d^T Sigma'^-1 d / 2) at a pixel d from the projected mean.

Zwicker et al. 2001 (EWA splatting) as in Kerbl et al. 2023: Sigma' = J W Sigma W^T J^T + dilation, J the Jacobian of
the perspective at the mean, with each rasterizer's clamp of J and culling (docs/conventions.md). Sigma'^-1 is stored as
its triangular factor. Of `tiles` and `order="center"` only: the model is one of the image plane.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from drgs.tracing import records as layout
from drgs.tracing.arrays import Float, Lib, Mask
from drgs.tracing.peak import AlphaStrength, deviation
from drgs.tracing.primitives import Activated, Patch, Projected, Ray, Screen
from drgs.tracing.records import cross, dot

_SHAPE = (layout.R11, layout.R12, layout.R13, layout.R22, layout.R23)


class Ewa(AlphaStrength):
    """A Gaussian of the image plane; t* is the Gaussian's own depth."""

    planar = True
    front_only = False  # of rays; means behind the camera plane are culled
    at_most_alpha = True
    extra = 9 * len(_SHAPE)
    by_tangents = True

    # -- once a Gaussian and view ------------------------------------------------------------------------------------

    def project(self, g: Activated, screen: Screen) -> tuple[list[Float], list[Float], Mask, None]:
        """The triangular factor of Sigma'^-1 and where it is centered, the depth, and what each culling leaves."""
        fx, skew, cx, fy, cy = screen.pinhole
        Float64 = type(fx)
        s = g.settings
        c = g.center
        # Means at or behind the camera plane are culled, by a mask, which has no derivative; a positive depth keeps
        # their (unused) numbers finite.
        alive = dr.detach(c[2]) > 0
        z = dr.select(alive, c[2], 1)
        iz = dr.rcp(z)
        tx, ty = _clamped(c[0] * iz, c[1] * iz, screen, s.fov_clamp)
        # Rows of J for the image axes, and their pull-back into the local frame.
        jx = [fx * iz, skew * iz, -(fx * tx + skew * ty) * iz]
        jy = [Float64(0), fy * iz, -fy * ty * iz]
        f = g.from_local
        lx = [g.scale[k] * (f[0][k] * jx[0] + f[1][k] * jx[1] + f[2][k] * jx[2]) for k in range(3)]
        ly = [g.scale[k] * (f[1][k] * jy[1] + f[2][k] * jy[2]) for k in range(3)]
        cxx = dot(lx, lx) + s.dilation
        cyy = dot(ly, ly) + s.dilation
        cxy = dot(lx, ly)
        # |lx x ly|^2 + dilation (...) instead of cxx cyy - cxy^2: thin projections do not cancel.
        n = cross(lx, ly)
        det = dot(n, n) + s.dilation * (dot(lx, lx) + dot(ly, ly) + s.dilation)
        r22 = dr.rsqrt(cyy)
        r11 = dr.sqrt(cyy / det)
        r12 = -cxy * dr.rsqrt(cyy * det)
        px = fx * c[0] * iz + skew * c[1] * iz + cx
        py = fy * c[1] * iz + cy
        if screen.offsets is not None:
            px += screen.offsets[0]
            py += screen.offsets[1]
        ox, oy = screen.x - px, screen.y - py
        shape = [r11, r12, r11 * ox + r12 * oy, Float64(0), r22, r22 * oy, *[Float64(0)] * 5]
        shape.append(c[2] if s.depth_key == "z" else g.distance())
        # Culling has no derivative.
        px, py, cxx, cyy, det = (dr.detach(v) for v in (px, py, cxx, cyy, det))
        bounds, alive = _culled(g, px, py, cxx, cyy, det, alive)
        return shape, bounds, alive, None

    def extras(self, lib: Lib, projected: Projected, moved: list[list[Float]] | Any) -> list[Float]:
        """Tangents of the triangular factor."""
        return [lib.Float(tangent[k]) for tangent in moved for k in _SHAPE]

    # -- once a hit --------------------------------------------------------------------------------------------------

    def slots(self, world: bool, depth: bool) -> list[int]:
        """The triangular factor; the Gaussian's depth where a depth is rendered."""
        L = layout
        return [*range(L.R11, L.R23 + 1), L.ALPHA, *range(L.RGB, L.RGB + 3), *([L.H1] if depth else [])]

    def along(self, r: list[Float], ray: Ray, world: bool) -> tuple[Float, Float, Float | None]:
        """d^T Sigma'^-1 d and the Gaussian's depth."""
        c1, c2, _, _ = _offset(r, ray)
        return dr.fma(c1, c1, c2 * c2), r[layout.H1], None

    def slopes(self, r: list[Float], extra: list[Float], ray: Ray, world: bool) -> list[Float]:
        """Through the tangents of the triangular factor and of the projected mean (`extras`)."""
        c1, c2, dx, dy = _offset(r, ray)
        a = r[layout.ALPHA] * dr.exp(-0.5 * dr.fma(c1, c1, c2 * c2))
        slopes = []
        for j in range(9):
            r11, r12, r13, r22, r23 = extra[5 * j : 5 * j + 5]
            d1 = dr.fma(r11, dx, dr.fma(r12, dy, r13))
            d2 = dr.fma(r22, dy, r23)
            slopes.append(-a * dr.fma(c1, d1, c2 * d2))
        return [*slopes, a]

    def moves(self, r: list[Float], ray: Ray) -> tuple[Float, Float]:
        """d opacity / d projected mean, in x and y."""
        c1, c2, _, _ = _offset(r, ray)
        a = r[layout.ALPHA] * dr.exp(-0.5 * dr.fma(c1, c1, c2 * c2))
        return a * c1 * r[layout.R11], a * dr.fma(c1, r[layout.R12], c2 * r[layout.R22])

    # -- once a tile -------------------------------------------------------------------------------------------------

    def may_hit(self, r: list[Float], patch: Patch, limit: Float) -> Mask:
        """False only where rho^2 <= limit has no solution; 1.0001 is more than float32 rounds."""
        return ~(deviation(r, patch) > 1.0001 * limit)


EWA = Ewa()
"""The row of `RESPONSES`."""


def _offset(r: list[Float], ray: Ray) -> tuple[Float, Float, Float, Float]:
    """The triangular factor times the pixel's offset from the projected mean; the offset from the anchor."""
    L = layout
    dx, dy = ray.x - r[L.AX], ray.y - r[L.AY]
    c1 = dr.fma(r[L.R11], dx, dr.fma(r[L.R12], dy, r[L.R13]))
    return c1, dr.fma(r[L.R21], dx, dr.fma(r[L.R22], dy, r[L.R23])), dx, dy


def _clamped(tx: Float, ty: Float, screen: Screen, fov_clamp: str) -> tuple[Float, Float]:
    """x/z and y/z as each rasterizer clamps them for J: symmetrically, or by the edges of the image."""
    if fov_clamp == "none":
        return tx, ty
    fx, _, cx, fy, cy = screen.pinhole
    half_x, half_y = screen.width / (2 * fx), screen.height / (2 * fy)
    if fov_clamp == "inria":
        high_x = 1.3 * half_x
        low_x = 1.3 * half_x
        high_y = 1.3 * half_y
        low_y = 1.3 * half_y
    else:
        high_x = (screen.width - cx) / fx + 0.3 * half_x
        low_x = cx / fx + 0.3 * half_x
        high_y = (screen.height - cy) / fy + 0.3 * half_y
        low_y = cy / fy + 0.3 * half_y
    # Both rasterizers' gradients are 0 where it is clamped, as a clip's is.
    return dr.clip(tx, -low_x, high_x), dr.clip(ty, -low_y, high_y)


def _culled(
    g: Activated, px: Float, py: Float, cxx: Float, cyy: Float, det: Float, alive: Mask
) -> tuple[list[Float], Mask]:
    """Screen bounds around the projected mean by the rule of `culling`, and which Gaussians have any."""
    culling = g.settings.culling
    if culling == "inria":
        # 0.1: the rasterizer's own floor below the difference of the eigenvalues.
        mid = 0.5 * (cxx + cyy)
        rx = ry = dr.ceil(3 * dr.sqrt(mid + dr.sqrt(dr.maximum(mid * mid - det, 0.1))))
    elif culling == "gsplat":
        opacity = dr.detach(g.opacity)  # culling has no derivative
        extent = dr.minimum(dr.sqrt(2 * dr.log(dr.maximum(255 * opacity, 1))), 3.33)
        rx, ry = dr.ceil(extent * dr.sqrt(cxx)), dr.ceil(extent * dr.sqrt(cyy))
        alive &= opacity >= 1 / 255
    else:
        extent = g.listed_extent()
        rx, ry = extent * dr.sqrt(cxx) + 1e-3, extent * dr.sqrt(cyy) + 1e-3  # px; rounding of float32 bounds
        alive &= extent > 0
    bounds = [px - rx, py - ry, px + rx, py + ry]
    if culling == "inria":
        # Whole 16x16 tiles, as getRect does; pixel indices p are covered when first <= p < last. The rasterizer's
        # pixel coordinate is half a pixel below ours.
        low = [16 * dr.floor((b - 0.5) / 16) for b in bounds[:2]]
        high = [16 * dr.floor((b - 0.5 + 15) / 16) for b in bounds[2:]]
        bounds = [low[0] + 0.25, low[1] + 0.25, high[0] - 0.25, high[1] - 0.25]
    elif culling == "gsplat":
        bounds = [b + s for b, s in zip(bounds, (-1.0, -1.0, 1.0, 1.0), strict=True)]
    return bounds, alive
