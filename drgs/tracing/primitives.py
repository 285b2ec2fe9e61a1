"""The inputs of a response: the rays and the Gaussians of one view, in Dr.Jit.

Everything about Gaussians is per-Gaussian work, done once a view in float64 and differentiated by Dr.Jit's AD.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import drjit as dr

from drgs.cameras.lenses import Guide
from drgs.settings import TOLERANCE_OF_END, RenderSettings
from drgs.tracing.arrays import Float, Lib, Mask
from drgs.tracing.harmonics import sh_basis, sh_color
from drgs.tracing.records import dot

_THINNEST = math.log(1e-30)  # of log-scales
TOLERANCE = 1e-5
"""Of `exact`: the largest error of an image that it claims, and what the tails that it leaves out may add up to in any
derivative of a ray (`adaptive_extent2`), where 10 times that is claimed. In an image they are 1/30 of it.
"""
TOLERANCE_UNLISTED = 0.1
"""Share of `RenderSettings.tolerance` that the tails of Gaussians which a tile does not list may add up to. They are
far away, mostly: a smaller share makes lists longer by little, and leaves more to those that are listed.
"""
TOLERANCE_LISTED = 1 - TOLERANCE_UNLISTED - TOLERANCE_OF_END
"""The same of those that a tile lists."""
_STEPS = 4  # of a fixed point, each of which makes the error at least 13 times smaller


def adaptive_extent2(log_strength: Float | float, log: Callable = math.log) -> Float | float:
    """Squared radius r^2, in standard deviations^2, where strength (1 + r^2) exp(-r^2 / 2) has fallen to `TOLERANCE`.

    Beyond r a Gaussian adds at most strength exp(-r^2 / 2) to an opacity; to its derivative by the logit likewise, by
    the mean in standard deviations r times, by log-scales and rotations of a sphere r^2 times that: 1 + r^2 bounds all.
    And of a derivative over the whole plane, by log-scales, the part (1 + r^2 / 2) exp(-r^2 / 2) lies beyond r.

    Args:
        log_strength: >= 0.
        log: The natural logarithm.
    """
    start = log_strength - math.log(TOLERANCE)
    half = start
    for _ in range(_STEPS):
        half = start + log(1 + 2 * half)
    return 2 * half


LEAST_EXTENT2 = adaptive_extent2(0.0)
"""5.47^2, of strengths up to 1: however faint a Gaussian is, its own derivatives keep all but 5e-6 of themselves."""


def trimmed_extent2(settings: RenderSettings, extent2: Float, cut: Float | None) -> Float:
    """Squared extents on a tile, less by what its tails may be cut, down to what derivatives need; with a tolerance,
    which bounds colors alone, down to 0.
    """
    if cut is None:
        return extent2
    return dr.maximum(extent2 - cut, LEAST_EXTENT2 if settings.tolerance is None else 0)


@dataclasses.dataclass
class Ray:
    """One ray a lane.

    Attributes:
        x, y: Pixel position, of a pinhole ray; of a narrow lens the center of a pixel of the pinhole camera.
        length: |d| of that ray's direction with d_z = 1; 1 of a wide lens.
        carried: What a ray carries that is differentiated: SH basis values (`basis` of them), then o and d of a world
            ray, or the shifts of a ray of the screen.
        basis: Number of SH basis values; 0 where colors are evaluated towards the means.
        direction: Unit direction in camera axes, of a wide lens (lens_rays.py).
        low: What float32 leaves of x and y, or of the direction, of a ray through a lens.
        shifted: Whether the last three that are carried, which are 0, say how it moves with the lens (lens_motion.py).
    """

    x: Float = None
    y: Float = None
    length: Float = None
    carried: list[Float] = dataclasses.field(default_factory=list)
    basis: int = 0
    direction: list[Float] = dataclasses.field(default_factory=list)
    low: list[Float] = dataclasses.field(default_factory=list)
    shifted: bool = False


class Lens(Protocol):
    """The functions of a lens that bounds on the image need (lens_rays.py).

    Attributes:
        guide: What guides are of: pixels of the pinhole camera (plane), the equidistant fisheye, or longitude and
            latitude (panorama).
        reach: How far off the camera center rays start at most, in scene units; 0 if all start there.
    """

    guide: Guide
    reach: float

    def pixels(self, guides: list[Float]) -> list[Float]:
        """Bounds of the pixels whose guides are within bounds."""


class Screen(NamedTuple):
    """The image that Gaussians are projected to.

    Attributes:
        pinhole: Opaque Float64 (fx, skew, cx, fy, cy).
        width, height: Size of the image, in pixels.
        x, y: (N,) each Gaussian's anchor: the pixel center that its record is expanded around; on a side of the cube
            the place where it is, from -1 to 1.
        lens: The lens, if there is one.
        side: (N,) the side of the cube, 0, 1 or 2 for x, y and z, that the anchor is on; None of what is no wide lens.
        offsets: Two (N,) columns of zeros in pixels, added to projected means: derivatives by these are by them; None
            where it is not needed.
    """

    pinhole: list[Float]
    width: int
    height: int
    x: Float
    y: Float
    lens: Lens | None = None
    side: Float | Any = None
    offsets: list[Float] | None = None

    def axes(self) -> tuple[list[Float], list[Float], list[Float]]:
        """Three vectors in camera axes: the direction of a ray changes by so much in x and y, from that at the anchor
        on.
        """
        fx, skew, cx, fy, cy = self.pinhole
        if self.side is None:
            yn = (self.y - cy) / fy
            anchor = [(self.x - cx - skew * yn) / fx, yn, type(yn)(1)]
            return [dr.rcp(fx), type(fx)(0), type(fx)(0)], [-skew / (fx * fy), dr.rcp(fy), type(fx)(0)], anchor
        unit = [dr.select(self.side == k, type(fx)(1), 0) for k in range(3)]
        dx = [unit[2], unit[0], unit[1]]
        dy = [unit[1], unit[2], unit[0]]
        return dx, dy, [self.x * a + self.y * b + c for a, b, c in zip(dx, dy, unit, strict=True)]


class Patch(NamedTuple):
    """The rays of a tile, as a record sees them: (x, y, w) within a box.

    Attributes:
        dx, dy, w: The middle of the box, from w times the anchor; w is 1 but for wide lenses.
        half: How far it reaches in x, y and, for wide lenses, w; there from 0 on, not from the anchor.
        anchor: The record's, for wide lenses.
    """

    dx: Float
    dy: Float
    w: Float | int
    half: tuple
    anchor: tuple | Any = None

    def spread(self, a: Float, b: Float, c: Float) -> Float:
        """Largest difference of a dx + b dy + c w on the patch from its value in the middle."""
        hx, hy, *hw = self.half
        if not hw:
            return hx * (abs(a) + abs(b)) if hx is hy else dr.fma(hx, abs(a), hy * abs(b))
        ax, ay = self.anchor
        return dr.fma(hx, abs(a), dr.fma(hy, abs(b), hw[0] * abs(c - a * ax - b * ay)))


class ViewColor(NamedTuple):
    """The color of each Gaussian in a view, evaluated towards its mean, in float32.

    Attributes:
        direction: Unit vector from the camera to the mean, world axes.
        inverse: 1 / distance of the mean; 0 for a mean at the camera center, which has no direction.
        basis: SH basis at the direction.
        rgb: max(0.5 + SH, 0); differentiated by the coefficients and, through the direction, by mean and pose.
    """

    direction: list[Float]
    inverse: Float
    basis: list[Float]
    rgb: list[Float]


class Activated:
    """Activated parameters of every Gaussian in float64, and their camera-frame geometry.

    Args:
        p: Flat raw parameters by name: means, quats, log_scales, logit_opacities, sh.
        w2c: Float64 of width 12, the upper rows of the world-to-camera matrix, of the re-centered world of the means.
        settings: Cut-offs of the render.
        at_most_alpha: `Response.at_most_alpha`.
    Attributes:
        mean, quat, scale, opacity: Activated parameters, columns (N,).
        logit, e: Raw opacity, and exp(-|logit|), which activations of it are formed from.
        rotation: (3, 3) local axes to world axes.
        extent: Cut-off radius in standard deviations.
        view: (3, 4) rows of w2c.
        center: (3,) means in camera axes.
        from_local: (3, 3) local axes to camera axes, of half axes R S: as the Gaussian is strained, if it is.
        inverse, cofactor: (3,) diagonals of S^-1 and of its cofactor matrix, s_k / (s_1 s_2 s_3), both times the least
            scale, which cancels in rho^2 and t*. They are formed as products of scales: by the scale of a disc's thin
            axis, which may be 0 nearly, derivatives of quotients would cancel.
        norm: |W v| = norm |diag(inverse) R^T v|.
        rotation_of_inverse: (3, 3) R in W = S^-1 R^T, which takes world vectors to the local frame: the same but for
            strains, whose diagonal is in `inverse`: there times 1 + trace(E), for the same reason.
        inverse_from_local: (3, 3) the same in camera axes.
        stretching: (3,) diagonal of the strain in local axes; None without strains.
    """

    def __init__(self, lib: Lib, p: dict, w2c: Float, settings: RenderSettings, at_most_alpha: bool) -> None:
        Float64, UInt32 = lib.Float64, lib.UInt32
        count = dr.width(p["logit_opacities"])
        self.lib = lib
        self.settings = settings
        self.at_most_alpha = at_most_alpha
        i = dr.arange(UInt32, count)
        # Each Gaussian gathers its own entries once, so the adjoint needs no atomics.
        permute = dr.ReduceMode.Permute

        def column(name: str, k: int, stride: int) -> Float:
            return dr.gather(type(p[name]), p[name], i * stride + k, mode=permute)

        self.column = column
        # Raw parameters may be float32: a difference of world coordinates keeps its digits only in float64.
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
        # In float32 the square of a scale overflows at a log-scale of 45, which is a legal parameter. Any scale below
        # 1e-30 is this one, without a derivative: it is invisible, and float32 holds its inverse.
        self.scale = [dr.exp(dr.maximum(Float64(column("log_scales", k, 3)), _THINNEST)) for k in range(3)]
        self.logit = Float64(column("logit_opacities", 0, 1))
        # exp of a non-positive number on both sides: no overflow at any logit. Not of -|logit|, whose derivative at a
        # logit of 0 is 0.
        self.e = dr.exp(dr.select(self.logit >= 0, -self.logit, self.logit))
        self.opacity = dr.select(self.logit >= 0, 1, self.e) / (1 + self.e)
        self.extent = self._extent(count)
        v = [[dr.gather(Float64, w2c, UInt32(4 * r + c)) for c in range(4)] for r in range(3)]
        self.view = v
        self.center = [
            v[r][0] * self.mean[0] + v[r][1] * self.mean[1] + v[r][2] * self.mean[2] + v[r][3] for r in range(3)
        ]
        # Of s_1 s_2 s_3 S^-1 and S, `inverse` and `cofactor` are the same multiple. Which one changes no value, hence
        # detached: first of scales relative to the largest, which float64 can multiply, then so that the largest
        # entry of `inverse` is 1.
        largest = dr.detach(dr.maximum(dr.maximum(self.scale[0], self.scale[1]), self.scale[2]))
        relative = [s / largest for s in self.scale]
        products = [relative[(k + 1) % 3] * relative[(k + 2) % 3] for k in range(3)]
        top = dr.detach(dr.maximum(dr.maximum(products[0], products[1]), products[2]))
        top = dr.maximum(top, 1e-300)  # never 0 / 0
        self.inverse = [x / top for x in products]
        self.cofactor = [x / (top * largest) for x in relative]
        self.norm = top / (relative[0] * relative[1] * relative[2] * largest)
        stretched = self.rotation_of_inverse = self.rotation
        self.stretching: list[Float] | None = None
        if "strains" in p:
            stretched = self._strained([column("strains", k, 6) for k in range(6)])
        self.from_local = _rotated(v, stretched)
        same = self.rotation_of_inverse is self.rotation
        self.inverse_from_local = self.from_local if same else _rotated(v, self.rotation_of_inverse)

    def _strained(self, strains: list[Float]) -> list[list[Float]]:
        """R (I + E), and what else strains change of W.

        The strain E is 0, and moves the Gaussian to first order only: R (I + E), and R (I - E) of W.

        Args:
            strains: Columns (N,) xx, xy, xz, yy, yz, zz of E in local axes.
        """
        xx, xy, xz, yy, yz, zz = strains
        shears = [[0, xy, xz], [xy, 0, yz], [xz, yz, 0]]
        moved = [[sum(row[k] * shears[k][c] for k in range(3) if k != c) for c in range(3)] for row in self.rotation]
        self.stretching = [xx, yy, zz]
        self.rotation_of_inverse = [
            [a - b for a, b in zip(*rows, strict=True)] for rows in zip(self.rotation, moved, strict=True)
        ]
        others = [yy + zz, zz + xx, xx + yy]
        self.inverse = [x * (1 + e) for x, e in zip(self.inverse, others, strict=True)]
        self.norm *= 1 - (xx + yy + zz)
        return [
            [a * (1 + e) + b for a, b, e in zip(*rows, self.stretching, strict=True)]
            for rows in zip(self.rotation, moved, strict=True)
        ]

    def _extent(self, count: int) -> Float:
        """Cut-off radius in standard deviations; a constant of the derivative, as every cut-off is."""
        if self.settings.extent is not None:
            # Opaque: another extent is no other kernel.
            return dr.opaque(self.lib.Float64, self.settings.extent)
        strength = dr.detach(self.opacity)
        if not self.at_most_alpha:  # but at most the optical depth
            strength = dr.detach(dr.maximum(self.logit, 0) + dr.log(1 + self.e))
        if self.settings.tolerance is not None:
            share = dr.opaque(self.lib.Float64, TOLERANCE_UNLISTED * self.settings.tolerance / count)
            return self.lib.Float64(dr.sqrt(2 * dr.log(dr.maximum(strength / share, 1))))
        # N times: so much are the tails of all N Gaussians together.
        together = dr.maximum(self.lib.Float(strength * dr.opaque(self.lib.Float64, count)), 1)
        return self.lib.Float64(dr.sqrt(adaptive_extent2(dr.log(together), dr.log)))

    def listed_extent(self) -> Float:
        """Radius beyond which no hit counts: the extent, or less where alpha_min cuts earlier; detached, a cut-off."""
        extent = dr.detach(self.extent)  # a cut-off
        if self.settings.alpha_min > 0 and self.at_most_alpha:
            ratio = dr.maximum(dr.detach(self.opacity) / self.settings.alpha_min, 1)
            # A cut-off, too. The factor keeps a hit that float32 rounds to the right side of alpha_min.
            extent = dr.minimum(extent, dr.sqrt(2 * dr.log(ratio)) * 1.001 + 1e-3)
        return extent

    def distance(self) -> Float:
        """(N,) distance of the means from the camera."""
        return dr.sqrt(dot(self.center, self.center))

    def color(self, coefficients: int) -> ViewColor:
        """Colors towards the means, from so many SH coefficients (1, 4, 9 or 16)."""
        Float, v = self.lib.Float, self.view
        # The direction in world axes: R_wc times the camera-frame mean.
        d = [v[0][k] * self.center[0] + v[1][k] * self.center[1] + v[2][k] * self.center[2] for k in range(3)]
        squared = dot(d, d)
        # A mean at the camera center has no direction; any finite one will do.
        scale = dr.select(squared > 0, dr.rsqrt(dr.select(squared > 0, squared, 1)), 0)
        # Cast where it is a unit vector: float32 holds it, and a color of it, to 1e-7.
        direction = [Float(x * scale) for x in d]
        basis = sh_basis(direction, coefficients)
        rgb = sh_color(basis, lambda k, c: Float(self.column("sh", k * 3 + c, 3 * coefficients)))
        return ViewColor(direction, Float(scale), basis, rgb)


def _rotated(view: list, axes: list) -> list:
    """Axes as columns (3, 3), world to camera."""
    return [[sum(view[r][k] * axes[k][c] for k in range(3)) for c in range(3)] for r in range(3)]


@dataclasses.dataclass(eq=False)
class Projected:
    """The record of each Gaussian in a view, with its bounds and order.

    Attributes:
        record: List of Dr.Jit floats of width N, laid out as `records` says, attached to the AD graph of the
            parameters.
        key: (N,) float, the depth key of `order="center"`; detached.
        bounds: Four (N,) floats x0, y0, x1, y1, in pixels, outside of which the Gaussian has no hit; detached.
        alive: (N,) mask of Gaussians that can have a hit.
        ellipsoids: World records only: mean (3), quaternion wxyz (4) and half axes of the extent (3); detached.
        frame: What closed-form derivatives of a response need (None of `ewa`): rotation (3, 3) to world axes, scales
            (3), and of the local frame, on the screen only, the plane (u, v) of o' x d' and the axes (f1, f2, f3) that
            directions are stored along.
    """

    record: list[Float]
    key: Float
    # Any: None where a view has no such thing, and then it is not read.
    bounds: list[Float] | Any
    alive: Mask
    ellipsoids: list[Float] | Any = None
    frame: tuple | Any = None
