"""From raw Gaussian parameters and a camera to one record of floats a Gaussian and view, in Dr.Jit.

Everything here is per-Gaussian work, done once a view in float64 and differentiated by Dr.Jit's AD; the loops over hits
(`kernels.py`) only see the records. What of a record depends on the response is filled by it (`responses/`).

Notation: W = S^-1 R^T takes a world vector into the local frame of a Gaussian; c is its mean in camera coordinates.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr

from drgs.settings import RenderSettings
from drgs.tracing.harmonics import sh_basis, sh_color
from drgs.tracing.protocols import Float, Lib, Mask
from drgs.tracing.records import ALPHA, dot
from drgs.tracing.responses import RESPONSES

__all__ = ["Activated", "Projected", "Screen", "project_screen", "project_world"]


class Projected:
    """What a view needs to know about each Gaussian.

    Attributes:
        record: List of Dr.Jit floats of width N, laid out as `records` says, attached to the AD graph of the
            parameters.
        key: (N,) float, the depth key of `order="center"`; detached.
        bounds: Four (N,) floats x0, y0, x1, y1, in pixels, outside of which the Gaussian has no hit; detached.
        alive: (N,) mask of Gaussians that can have a hit.
        ellipsoids: World records only: mean (3), quaternion wxyz (4) and half axes of the extent (3); detached.
        frame: Not of `ewa`: rotation (3, 3) to world axes, scales (3), and of the local frame, on the screen only, the
            plane (u, v) of o' x d' and the axes (f1, f2, f3) that directions are stored along.
    """

    def __init__(
        self,
        record: list[Float],
        key: Float,
        bounds: list[Float] | None,
        alive: Mask,
        ellipsoids: list[Float] | None = None,
        frame: tuple | None = None,
    ) -> None:
        self.record = record
        self.key = key
        self.alive = alive
        # Any: None where a view has no such thing, and then nobody reads it.
        self.bounds: list[Float] | Any = bounds
        self.ellipsoids: list[Float] | Any = ellipsoids
        self.frame: tuple | Any = frame


class Screen(NamedTuple):
    """The image that Gaussians are projected to.

    Attributes:
        pinhole: Opaque Float64 (fx, skew, cx, fy, cy).
        width, height: Of the image, in pixels.
        x, y: (N,) each Gaussian's anchor: the pixel center that its record is expanded around.
    """

    pinhole: list[Float]
    width: int
    height: int
    x: Float
    y: Float


class Activated:
    """Activated parameters of every Gaussian in float64, and their camera-frame geometry."""

    def __init__(self, lib: Lib, p: dict, w2c: Float, settings: RenderSettings, count: int) -> None:
        Float64, UInt32 = lib.Float64, lib.UInt32
        self.lib = lib
        self.settings = settings
        self.response = RESPONSES[settings.response]
        i = dr.arange(UInt32, count)
        # Each Gaussian gathers its own entries once, so the adjoint needs no atomics.
        permute = dr.ReduceMode.Permute

        def column(name: str, k: int, stride: int) -> Float:
            return dr.gather(type(p[name]), p[name], i * stride + k, mode=permute)

        self.column = column
        self.mean = [Float64(column("means", k, 3)) for k in range(3)]
        q = [Float64(column("quats", k, 4)) for k in range(4)]
        # Dividing by the largest component first keeps the square of tiny or huge quaternions finite. It cancels in
        # the division by the norm, hence no derivative.
        big = dr.detach(dr.maximum(dr.maximum(abs(q[0]), abs(q[1])), dr.maximum(abs(q[2]), abs(q[3]))))
        inverse = dr.rcp(big)
        q = [x * inverse for x in q]
        norm = dr.rsqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        self.quat = [x * norm for x in q]
        w, x, y, z = self.quat
        self.rotation = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        self.scale = [dr.exp(Float64(column("log_scales", k, 3))) for k in range(3)]
        logit = Float64(column("logit_opacities", 0, 1))
        # exp of a non-positive number on both sides: no overflow at any logit. Not of -|logit|, whose derivative at a
        # logit of 0 is 0.
        e = dr.exp(dr.select(logit >= 0, -logit, logit))
        self.opacity = dr.select(logit >= 0, 1, e) / (1 + e)
        self.strength = self.response.strength(logit, self.opacity, e)
        self.extent = self._extent(count)
        # w2c maps the re-centered world of p["means"]; rows of the rotation and the translation.
        v = [[dr.gather(Float64, w2c, UInt32(4 * r + c)) for c in range(4)] for r in range(3)]
        self.view = v
        self.center = [
            v[r][0] * self.mean[0] + v[r][1] * self.mean[1] + v[r][2] * self.mean[2] + v[r][3] for r in range(3)
        ]
        self.from_local = [[sum(v[r][k] * self.rotation[k][c] for k in range(3)) for c in range(3)] for r in range(3)]

    def _extent(self, count: int) -> Float:
        """Cut-off radius in standard deviations; a constant of the derivative, as every cut-off is."""
        if self.settings.extent is not None:
            return dr.opaque(self.lib.Float64, self.settings.extent)
        opacity = dr.detach(self.opacity)
        # All N tails beyond these radii add up to at most N alpha exp(-extent^2 / 2) = 1e-5.
        return dr.sqrt(2 * dr.log(dr.maximum(opacity * (count / 1e-5), 1)))

    def listed_extent(self) -> Float:
        """Radius beyond which no hit counts: the extent, or less where alpha_min cuts earlier; detached, a cut-off."""
        extent = dr.detach(self.extent)  # a cut-off
        if self.settings.alpha_min > 0 and self.response.at_most_alpha:
            ratio = dr.maximum(dr.detach(self.opacity) / self.settings.alpha_min, 1)
            # A cut-off, too. The factor keeps a hit that float32 rounds to the right side of alpha_min.
            extent = dr.minimum(extent, dr.sqrt(2 * dr.log(ratio)) * 1.001 + 1e-3)
        return extent

    def distance(self) -> Float:
        """Of the means from the camera."""
        return dr.sqrt(dot(self.center, self.center))

    def rgb(self, coefficients: int) -> list[Float]:
        """Colors towards the mean; the derivative of the direction is kept."""
        if not coefficients:
            return [self.lib.Float(0)] * 3
        Float, v = self.lib.Float, self.view
        # The direction in world axes: R_wc times the camera-frame mean.
        d = [v[0][k] * self.center[0] + v[1][k] * self.center[1] + v[2][k] * self.center[2] for k in range(3)]
        squared = dot(d, d)
        # A mean at the camera center has no direction; any finite one will do.
        scale = dr.select(squared > 0, dr.rsqrt(dr.select(squared > 0, squared, 1)), 0)
        direction = [Float(x * scale) for x in d]
        basis = sh_basis(direction, coefficients)
        return sh_color(basis, lambda k, c: Float(self.column("sh", k * 3 + c, 3 * coefficients)))


def project_screen(
    lib: Lib,
    p: dict,
    w2c: Float,
    pinhole: list[Float],
    settings: RenderSettings,
    width: int,
    height: int,
    coefficients: int,
) -> Projected:
    """Screen records of a pinhole camera.

    Args:
        lib: Dr.Jit types of the backend.
        p: Flat parameter arrays: means, quats, log_scales, logit_opacities, sh.
        w2c: Float64 of width 12, the upper rows of the world-to-camera matrix; differentiable.
        pinhole: Opaque Float64 (fx, skew, cx, fy, cy).
        settings: Any with traversal `tiles`.
        width, height: Of the image.
        coefficients: SH coefficients in `p["sh"]`; 0 leaves the color out (SH along each ray).
    Returns:
        A `Projected`.
    """
    Float = lib.Float
    g = Activated(lib, p, w2c, settings, dr.width(p["logit_opacities"]))
    fx, skew, cx, fy, cy = pinhole
    # The anchor: pixel center nearest to the projected mean, on the screen; the center of it for z <= 0. It is where
    # the record is expanded around, which changes no value: hence no derivative. A mean nearer to the camera plane than
    # 1e-9 of its distance counts as on it.
    zd = dr.detach(g.center[2])
    cd = dr.detach(g.center)
    front = zd > 1e-9 * (abs(cd[0]) + abs(cd[1]))
    iz = dr.select(front, 1 / dr.select(front, zd, 1), 0)
    px = dr.select(front, fx * (cd[0] * iz) + skew * (cd[1] * iz) + cx, cx)
    py = dr.select(front, fy * (cd[1] * iz) + cy, cy)
    ax = dr.clip(dr.floor(px), 0, width - 1) + 0.5
    ay = dr.clip(dr.floor(py), 0, height - 1) + 0.5
    shape, bounds, alive, frame = g.response.project(g, Screen(pinhole, width, height, ax, ay))
    distance = g.distance()
    record = [Float(ax), Float(ay), *[Float(x) for x in shape]]
    record += [Float(0)] * (ALPHA - len(record))
    # The extent is a cut-off: a constant of the derivative.
    record += [Float(g.strength), Float(dr.detach(g.extent * g.extent)), *g.rgb(coefficients)]
    if settings.near > 0:
        alive &= zd > settings.near
    # Keys order hits, and an order has no derivative.
    key = dr.detach(g.center[2] if settings.depth_key == "z" else distance)
    return Projected(record, Float(key), [Float(b) for b in bounds], alive, frame=frame)


def project_world(lib: Lib, p: dict, w2c: Float, settings: RenderSettings, coefficients: int) -> Projected:
    """World records for arbitrary rays: mean, W = S^-1 R^T, opacity, extent^2, color.

    Args and Returns: as `project_screen`; `bounds` is None.
    """
    Float = lib.Float
    g = Activated(lib, p, w2c, settings, dr.width(p["logit_opacities"]))
    inverse = [dr.rcp(s) for s in g.scale]
    record = [Float(x) for x in g.mean]
    record += [Float(inverse[r] * g.rotation[c][r]) for r in range(3) for c in range(3)]
    # The extent is a cut-off, keys order hits: both are constants of the derivative.
    record += [Float(g.strength), Float(dr.detach(g.extent * g.extent)), *g.rgb(coefficients)]
    distance = dr.detach(g.distance())
    z = dr.detach(g.center[2])
    alive = dr.detach(g.extent) > 0  # a mask has none
    if settings.near > 0:
        alive &= z > settings.near
    key = z if settings.depth_key == "z" else distance
    # The proxies of `bvh` may stop where alpha_min cuts, unless it is their entry points that order the hits. They
    # only say which hits to look at, hence no derivative.
    extent = dr.detach(g.extent) if settings.order == "entry" else g.listed_extent()
    ellipsoids = [dr.detach(x) for x in [*g.mean, *g.quat, *[dr.detach(s) * extent for s in g.scale]]]
    frame = g.rotation, g.scale, None, None
    return Projected(record, Float(key), None, alive & (extent > 0), ellipsoids, frame)
