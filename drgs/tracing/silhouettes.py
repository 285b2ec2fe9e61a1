"""Where on the image the ellipsoids of the extents are seen: bounds in pixels.

Bounds only say where to look, hence none of this has a derivative.

The rays that touch the ellipsoid {c, extent^2 Sigma} are a cone; a plane through the camera with normal n is tangent to
it where n^T (extent^2 Sigma - c c^T) n = 0. Among the planes that contain an axis, that is a quadratic equation.

Under the equidistant fisheye a direction is seen at its angle theta to the axis, at the azimuth that it has. Two boxes
hold what an ellipsoid covers, and so does what they have in common. The box on the plane z = 1, of what is in front of
the camera: both coordinates of the fisheye grow with that of the plane. And a sector, theta_0 <= theta <= theta_1,
within delta of the mean's azimuth: delta from the planes that contain the axis of the camera; theta from those that
contain the direction e_t in which the azimuth grows, between which all directions lie at angles phi to the axis, with
tan theta = tan phi / cos(azimuth).

A panorama shows longitude and latitude: the azimuth and the angle of the same sector, around the vertical axis of the
camera in place of the one along which it looks. What crosses the seam behind the camera, or holds a pole, is looked for
at every longitude.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr

from drgs.tracing.arrays import Float, Mask
from drgs.tracing.primitives import Activated, Screen
from drgs.tracing.records import dot

_BOUND_PAD = 1e-3  # px added to bounds for the rounding of float32
_NOWHERE = 1e30  # px, beyond the image
_FULL_CIRCLE = 4.0  # radians, for no bound: the fisheye sees no farther than pi


class _Plane(NamedTuple):
    """What the plane z = 1 shows of an ellipsoid.

    Attributes:
        x, y: Middles of the box.
        rx, ry: Half its sides.
        inside: The ellipsoid meets the camera plane, but for rounding: it is unbounded, and the box means nothing.
        behind: It lies behind that plane.
    """

    x: Float
    y: Float
    rx: Float
    ry: Float
    inside: Mask
    behind: Mask


def silhouette(g: Activated, screen: Screen) -> tuple[list[Float], Mask]:
    """Bounds x0, y0, x1, y1 in pixels of the extent ellipsoid, and which are there.

    Of a pinhole they are exact where the ellipsoid lies in front of the camera plane; of a lens they are the pixels
    whose rays lie in such a box, or about it (lens_rays.py). Rays that start up to `Lens.reach` off the camera center
    meet the ellipsoid where rays from the center meet what is as near to it: a larger ellipsoid holds that.
    """
    fx, skew, cx, fy, cy = screen.pinhole
    extent = g.listed_extent()
    lens = screen.lens
    half_axes = [dr.detach(s) * extent for s in g.scale]  # bounds have no derivative
    if lens is not None and lens.reach:
        half_axes = _grown(half_axes, dr.opaque(type(fx), lens.reach))
        axes = [[dr.detach(x) * a for x, a in zip(row, half_axes, strict=True)] for row in g.from_local]
        seen = _on_plane(g, type(fx)(1), half_axes)
    else:
        axes = [[dr.detach(x * s) * extent for x, s in zip(row, g.scale, strict=True)] for row in g.from_local]
        seen = _on_plane(g, extent, g.scale)
    center = dr.detach(g.center)
    if lens is not None and lens.guide != "plane":
        low, high = _fisheye(center, axes, seen) if lens.guide == "fisheye" else _panorama(center, axes)
        middle = [0.5 * (a + b) for a, b in zip(low, high, strict=True)]
        half = [0.5 * (b - a) for a, b in zip(low, high, strict=True)]
        bounds = _in_pixels(screen, middle, half)
        return lens.pixels(bounds), extent > 0
    bounds = _in_pixels(screen, [seen.x, seen.y], [seen.rx, seen.ry])
    if lens is None:
        full = [0.0, 0.0, float(screen.width), float(screen.height)]
    else:
        full = [-_NOWHERE, -_NOWHERE, _NOWHERE, _NOWHERE]
    bounds = [dr.select(seen.inside, edge, b) for edge, b in zip(full, bounds, strict=True)]
    # Wholly behind the camera plane at this extent: no peak in front, and what integral would add there is below
    # the tail that the extent leaves out.
    return bounds if lens is None else lens.pixels(bounds), ~seen.behind & (extent > 0)


def _in_pixels(screen: Screen, middle: list[Float], half: list[Float]) -> list[Float]:
    """The box of K times a box."""
    fx, skew, cx, fy, cy = screen.pinhole
    grow_x = abs(fx) * half[0] + abs(skew) * half[1]
    x = fx * middle[0] + skew * middle[1] + cx
    y = fy * middle[1] + cy
    return [
        x - grow_x - _BOUND_PAD,
        y - abs(fy) * half[1] - _BOUND_PAD,
        x + grow_x + _BOUND_PAD,
        y + abs(fy) * half[1] + _BOUND_PAD,
    ]


def _grown(half_axes: list[Float], reach: Float) -> list[Float]:
    """Half axes a of an ellipsoid that holds all that is within `reach` = r of one.

    a^2 (1 + 1 / p) + r^2 (1 + p) holds it for every p > 0, by the Cauchy-Schwarz inequality for support functions; with
    p = |a| / r it grows least where the ellipsoid is round.
    """
    size = dr.sqrt(dot(half_axes, half_axes))
    ratio = reach / dr.maximum(size, 1e-30)
    return [dr.sqrt(a * a * (1 + ratio) + reach * (reach + size)) for a in half_axes]


def _on_plane(g: Activated, extent: Float, scale: list[Float]) -> _Plane:
    """The box on the plane z = 1, of ellipsoids with half axes `extent` times `scale`."""
    f = g.from_local
    c = dr.detach(g.center)  # for bounds, as sigma
    e2 = extent * extent

    def sigma(a: int, b: int) -> Float:
        # Bounds have no derivative.
        return e2 * sum(dr.detach(f[a][k] * f[b][k] * scale[k] * scale[k]) for k in range(3))

    szz = sigma(2, 2)
    q22 = szz - c[2] * c[2]
    inside = q22 >= -1e-9 * (c[2] * c[2])
    behind = ~inside & (c[2] < 0)
    den = dr.select(inside, -1, q22)

    def axis(k: int) -> tuple[Float, Float]:
        q = sigma(k, 2) - c[k] * c[2]
        root = dr.sqrt(dr.maximum(q * q - (sigma(k, k) - c[k] * c[k]) * den, 0)) / -den
        return q / den, root

    mx, rx = axis(0)
    my, ry = axis(1)
    return _Plane(mx, my, rx, ry, inside, behind)


def _fisheye(c: list[Float], axes: list[list[Float]], seen: _Plane) -> tuple[list[Float], list[Float]]:
    """Least and largest coordinates under the equidistant fisheye, in radians.

    Args:
        c: Means in camera axes.
        axes: (3, 3) rows: the half axes of the ellipsoids, times the axes of the camera.
        seen: The ellipsoids on the plane z = 1.
    """
    front = ~seen.inside & ~seen.behind
    sides = (seen.x, seen.rx), (seen.y, seen.ry)
    ranges = [(dr.select(front, m - r, 0), dr.select(front, m + r, 0)) for m, r in sides]
    plane = []
    for (low, high), (other_low, other_high) in zip(ranges, ranges[::-1], strict=True):
        # x atan(r) / r, r^2 = x^2 + y^2, grows with x; it is the larger the nearer y is to 0 on the positive side.
        near = dr.maximum(dr.maximum(other_low, -other_high), 0)
        far = dr.maximum(abs(other_low), abs(other_high))
        plane.append(
            (_equidistant_x(low, dr.select(low > 0, far, near)), _equidistant_x(high, dr.select(high > 0, near, far)))
        )
    whole = [(dr.select(front, a, -_FULL_CIRCLE), dr.select(front, b, _FULL_CIRCLE)) for a, b in plane]
    sector = _sector(c, axes)
    low = [dr.maximum(a[0], b[0]) for a, b in zip(whole, sector, strict=True)]
    high = [dr.minimum(a[1], b[1]) for a, b in zip(whole, sector, strict=True)]
    return low, high


def _panorama(c: list[Float], axes: list[list[Float]]) -> tuple[list[Float], list[Float]]:
    """Least and largest longitude and latitude, in radians; arguments as `_fisheye`."""
    # With the axis that points up first, z grows from the lower pole to the upper one.
    turned = [c[2], c[0], -c[1]]
    sector = _cone(turned, [axes[2], axes[0], [-a for a in axes[1]]])
    longitude = dr.atan2(turned[1], turned[0])
    west, east = longitude + dr.atan(sector.left), longitude + dr.atan(sector.right)
    around = sector.axial | (west < -math.pi) | (east > math.pi)
    west, east = dr.select(around, -_FULL_CIRCLE, west), dr.select(around, _FULL_CIRCLE, east)
    # Latitude counts downwards, from the horizon; the angle from the upper pole, upwards, from it.
    top = dr.select(sector.axial, sector.theta - sector.width, sector.first)
    bottom = dr.select(sector.axial, sector.theta + sector.width, sector.last)
    north, south = top - math.pi / 2, bottom - math.pi / 2
    whole = sector.surrounds
    return (
        [west, dr.select(whole, -_FULL_CIRCLE, north)],
        [east, dr.select(whole, _FULL_CIRCLE, south)],
    )


def _equidistant_x(x: Float, y: Float) -> Float:
    """First coordinate under the equidistant fisheye of a point (x, y) of the plane z = 1."""
    r = dr.sqrt(x * x + y * y)
    # atan(r) / r is 1 at 0 and below it elsewhere.
    return x * dr.select(r > 0, dr.atan(r) / dr.select(r > 0, r, 1), 1)


class _Sector(NamedTuple):
    """Directions about that to a mean, in spherical coordinates around the third axis.

    Attributes:
        theta: Angle of the mean to the axis.
        e: First two coordinates of the mean's azimuth, as a unit vector.
        left, right: Tangents of the least and the largest azimuth, from the mean's on.
        cos_left, cos_right: Cosines of these angles.
        first, last: Least and largest angle to the axis.
        width: No direction is farther than this from that to the mean, in radians.
        axial: The ellipsoid may meet the axis: azimuths, `first` and `last` mean nothing.
        surrounds: It holds the camera: nothing means anything.
    """

    theta: Float
    e: list[Float]
    left: Float
    right: Float
    cos_left: Float
    cos_right: Float
    first: Float
    last: Float
    width: Float
    axial: Mask
    surrounds: Mask


def _sector(c: list[Float], axes: list[list[Float]]) -> list[tuple[Float, Float]]:
    """Least and largest x, and y, of the sector under the equidistant fisheye."""
    s = _cone(c, axes)
    # Around the axis: no farther from it than the cone that holds both pairs of planes.
    disc = dr.select(s.surrounds, _FULL_CIRCLE, dr.minimum(s.theta + s.width, math.pi))
    cos_delta = dr.minimum(s.cos_left, s.cos_right)
    outward = dr.select(s.axial, -disc, s.first * cos_delta), dr.select(s.axial, disc, s.last)
    left, right = s.last * s.left * s.cos_left, s.last * s.right * s.cos_right
    across = dr.select(s.axial, -disc, left), dr.select(s.axial, disc, right)
    boxes = []
    for a, b in ((s.e[0], -s.e[1]), (s.e[1], s.e[0])):
        products = [(k * r[0], k * r[1]) for k, r in ((a, outward), (b, across))]
        ends = [(dr.minimum(*pair), dr.maximum(*pair)) for pair in products]
        boxes.append((ends[0][0] + ends[1][0], ends[0][1] + ends[1][1]))
    return boxes


def _cone(c: list[Float], axes: list[list[Float]]) -> _Sector:
    """The sector of ellipsoids with means `c` and half axes in the rows of `axes`."""
    rho2 = c[0] * c[0] + c[1] * c[1]
    rho = dr.sqrt(rho2)
    off = rho > 0
    e = [dr.select(off, c[0] / dr.select(off, rho, 1), 1), dr.select(off, c[1] / dr.select(off, rho, 1), 0)]
    D2 = rho2 + c[2] * c[2]
    D = dr.sqrt(D2)
    scale = dr.select(D > 0, 1 / dr.select(D > 0, D, 1), 0)
    sine, cosine = rho * scale, c[2] * scale
    # Half axes along: away from the camera's axis and around it; towards the mean and where theta grows.
    out = [e[0] * a + e[1] * b for a, b in zip(axes[0], axes[1], strict=True)]
    around = [e[0] * b - e[1] * a for a, b in zip(axes[0], axes[1], strict=True)]
    to = [sine * a + cosine * b for a, b in zip(out, axes[2], strict=True)]
    up = [cosine * a - sine * b for a, b in zip(out, axes[2], strict=True)]
    left, right, wraps = _slopes(dot(out, out), dot(out, around), dot(around, around), rho2)
    down, rise, surrounds = _slopes(dot(to, to), dot(to, up), dot(up, up), D2)
    left_, right_, _ = _slopes(dot(to, to), dot(to, around), dot(around, around), D2)
    theta = dr.atan2(rho, c[2])
    steep = dr.maximum(abs(down), rise)
    broad = dr.maximum(abs(left_), right_)
    width = dr.atan(dr.sqrt(steep * steep + broad * broad))
    # Off the axis. cos(delta), and how theta differs from phi at it.
    cos_left, cos_right = dr.rsqrt(1 + left * left), dr.rsqrt(1 + right * right)
    cos_delta = dr.minimum(cos_left, cos_right)
    phi0, phi1 = theta + dr.atan(down), theta + dr.atan(rise)
    first = dr.select(phi0 <= math.pi / 2, phi0, dr.atan2(dr.sin(phi0), dr.cos(phi0) * cos_delta))
    last = dr.select(phi1 >= math.pi / 2, phi1, dr.atan2(dr.sin(phi1), dr.cos(phi1) * cos_delta))
    axial = wraps | surrounds
    return _Sector(theta, e, left, right, cos_left, cos_right, first, last, width, axial, surrounds)


def _slopes(aa: Float, ab: Float, bb: Float, distance2: Float) -> tuple[Float, Float, Mask]:
    """Least and largest b / a on an ellipse around (distance, 0), and whether it holds the origin, where they mean
    nothing.

    Args:
        aa, ab, bb: Squares and product of its half axes along a and b.
    """
    q = aa - distance2
    holds = q >= -1e-9 * distance2
    q = dr.select(holds, -1, q)
    root = dr.sqrt(dr.maximum(ab * ab - bb * q, 0))
    return (ab + root) / q, (ab - root) / q, holds
