"""From raw Gaussian parameters and a camera to one record of floats a Gaussian and view, in Dr.Jit.

Everything here is per-Gaussian work, done once a view in float64 and differentiated by Dr.Jit's AD; the loops over hits
(`kernels.py`) only see the records. What of a record depends on the response is filled by it (responses.py).

Notation: W = S^-1 R^T takes a world vector into the local frame of a Gaussian; c is its mean in camera coordinates.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr

from drgs import runtime
from drgs.settings import RenderSettings
from drgs.tracing.arrays import Float, Lib, Mask
from drgs.tracing.lens_rays import LensRays, on_side
from drgs.tracing.primitives import Activated, Projected, Screen
from drgs.tracing.records import ALPHA
from drgs.tracing.responses import Response, response_of
from drgs.tracing.silhouettes import silhouette

Cull = Callable[[Activated], tuple[list[Float], Mask]]
"""Bounds x0, y0, x1, y1 in pixels that Gaussians are seen within, and which of them are there."""


@runtime.exactly
def project_screen(
    lib: Lib,
    p: dict,
    w2c: Float,
    pinhole: list[Float],
    settings: RenderSettings,
    width: int,
    height: int,
    coefficients: int,
    lens: LensRays | None = None,
    cull: Cull | None = None,
) -> Projected:
    """Screen records of a camera.

    Args:
        p: Flat parameter arrays: means, quats, log_scales, logit_opacities, sh, and mean_offsets and strains if
            derivatives by projected means and by covariances are wanted.
        w2c: Float64 of width 12, the upper rows of the world-to-camera matrix; differentiable.
        pinhole: Opaque Float64 (fx, skew, cx, fy, cy).
        settings: Settings of the render, with traversal `tiles`.
        width, height: Size of the image, in pixels.
        coefficients: SH coefficients in `p["sh"]`.
        lens: The camera's, if it is no pinhole.
        cull: What else bounds Gaussians on the image.
    Returns:
        Records, depth keys and bounds of all N Gaussians.
    """
    Float = lib.Float
    response = response_of(settings)
    g = Activated(lib, p, w2c, settings, response.at_most_alpha)
    screen = _screen(lib, dr.detach(g.center), pinhole, width, height, lens)
    if "mean_offsets" in p:
        screen = screen._replace(offsets=[lib.Float64(g.column("mean_offsets", k, 2)) for k in range(2)])
    shape, bounds, alive, frame = response.project(g, screen)
    distance = g.distance()
    record = [Float(screen.x), Float(screen.y), *[Float(x) for x in shape]]
    record += [Float(0)] * (ALPHA - len(record))
    record += _common(lib, g, response, coefficients)
    if screen.side is not None:
        record += [Float(screen.side)]
    if settings.near > 0:
        alive &= dr.detach(g.center[2]) > settings.near
    # Keys order hits, and an order has no derivative.
    key = dr.detach(g.center[2] if settings.depth_key == "z" else distance)
    bounds, alive = _culled(g, bounds, alive, cull)
    return Projected(record, Float(key), [Float(b) for b in bounds], alive, frame=frame)


def _culled(g: Activated, bounds: list[Float], alive: Mask, cull: Cull | None) -> tuple[list[Float], Mask]:
    """Bounds within those of `cull`, if there is any, and what is left."""
    if cull is None:
        return bounds, alive
    boxes, seen = cull(g)
    low = [dr.maximum(a, b) for a, b in zip(bounds[:2], boxes[:2], strict=True)]
    high = [dr.minimum(a, b) for a, b in zip(bounds[2:], boxes[2:], strict=True)]
    return [*low, *high], alive & seen


def _screen(lib: Lib, c: list[Float], pinhole: list[Float], width: int, height: int, lens: LensRays | None) -> Screen:
    """The screen with the anchor of every Gaussian, given the means `c` in camera axes.

    The anchor is where the record is expanded around, which changes no value: hence no derivative.
    """
    fx, skew, cx, fy, cy = pinhole
    if lens is not None and lens.wide:
        # On the side of the cube that the mean is seen through; a mean at the camera center is seen nowhere.
        size = [abs(x) for x in c]
        side = dr.select(size[0] > dr.maximum(size[1], size[2]), 0, dr.select(size[1] > size[2], 1, 2))
        x, y, w = on_side(side, c)
        w = dr.select(w != 0, w, 1)
        # Where float32 holds it: it is read from the record.
        x, y = (lib.Float64(lib.Float(v / w)) for v in (x, y))
        return Screen(pinhole, width, height, x, y, lens, lib.Float(side))
    # The pixel center nearest to the projected mean, on the screen; the center of it for z <= 0. A mean nearer to the
    # camera plane than 1e-9 of its distance counts as on it.
    front = c[2] > 1e-9 * (abs(c[0]) + abs(c[1]))
    iz = dr.select(front, 1 / dr.select(front, c[2], 1), 0)
    px = dr.select(front, fx * (c[0] * iz) + skew * (c[1] * iz) + cx, cx)
    py = dr.select(front, fy * (c[1] * iz) + cy, cy)
    # Into the image: around an anchor far outside, the record would lose digits at the pixels of the image.
    (low_x, low_y), (high_x, high_y) = ((0, 0), (width - 1, height - 1)) if lens is None else (lens.low, lens.high)
    ax = dr.clip(dr.floor(px), low_x, high_x) + 0.5
    ay = dr.clip(dr.floor(py), low_y, high_y) + 0.5
    return Screen(pinhole, width, height, ax, ay, lens)


@runtime.exactly
def project_world(
    lib: Lib,
    p: dict,
    w2c: Float,
    settings: RenderSettings,
    coefficients: int,
    screen: Screen | None = None,
    cull: Cull | None = None,
) -> Projected:
    """World records for arbitrary rays: mean, W = S^-1 R^T and its cofactor matrix, opacity, extent^2, color.

    Args:
        p: Flat parameter arrays: means, quats, log_scales, logit_opacities, sh, and strains if derivatives by
            covariances are wanted.
        w2c: Float64 of width 12, the upper rows of the world-to-camera matrix; differentiable.
        settings: Settings of the render.
        coefficients: SH coefficients in `p["sh"]`.
        screen: The image that bounds are wanted on, of the camera of w2c; its lens says where its rays are.
        cull: What else bounds Gaussians on that image.
    Returns:
        Records, depth keys, and either bounds or, without a screen, the ellipsoids of the extents.
    """
    Float = lib.Float
    response = response_of(settings)
    g = Activated(lib, p, w2c, settings, response.at_most_alpha)
    cofactor = g.cofactor
    if g.stretching is not None:
        cofactor = [x * (1 + e) for x, e in zip(cofactor, g.stretching, strict=True)]
    record = [Float(x) for x in g.mean]
    record += [Float(g.rotation_of_inverse[c][r]) for r in range(3) for c in range(3)]
    record += [Float(x) for x in [*g.inverse, *cofactor]]
    record += [*_common(lib, g, response, coefficients), Float(g.norm)]
    # Keys order hits, and an order has no derivative.
    distance = dr.detach(g.distance())
    z = dr.detach(g.center[2])
    alive = dr.detach(g.extent) > 0  # a mask has none
    if settings.near > 0:
        alive &= z > settings.near
    key = z if settings.depth_key == "z" else distance
    frame = g.rotation, g.scale, None, None
    if screen is not None:
        bounds, seen = silhouette(g, screen)
        bounds, alive = _culled(g, bounds, alive & seen, cull)
        return Projected(record, Float(key), [Float(b) for b in bounds], alive, frame=frame)
    # The proxies of `bvh` may stop where alpha_min cuts, unless it is their entry points that order the hits. They
    # only say which hits to look at, hence no derivative.
    extent = dr.detach(g.extent) if settings.order == "entry" else g.listed_extent()
    ellipsoids = [dr.detach(x) for x in [*g.mean, *g.quat, *[dr.detach(s) * extent for s in g.scale]]]
    return Projected(record, Float(key), None, alive & (extent > 0), ellipsoids, frame)


def _common(lib: Lib, g: Activated, response: Response, coefficients: int) -> list[Float]:
    """What records of the screen and of the world end with: strength, extent^2, rgb (0: SH along each ray)."""
    strength = response.strength(g.logit, g.opacity, g.e)
    rgb = [lib.Float(0)] * 3 if g.settings.sh_direction == "ray" else g.color(coefficients).rgb
    # The extent is a cut-off: a constant of the derivative.
    return [lib.Float(strength), lib.Float(dr.detach(g.extent * g.extent)), *rgb]
