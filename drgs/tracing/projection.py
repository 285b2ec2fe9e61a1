"""From raw Gaussian parameters and a camera to one record of floats a Gaussian and view, in Dr.Jit.

Everything here is per-Gaussian work, done once a view in float64 and differentiated by Dr.Jit's AD; the per-hit loops
(`kernels.py`) only see the records. Notation: W = S^-1 R^T takes a world vector into the local frame of a Gaussian;
a pinhole ray has the direction d(x, y) = d_a + (x - x_a) d_x + (y - y_a) d_y in camera coordinates, unnormalized with
d_z = 1, around an anchor pixel (x_a, y_a); c is the mean in camera coordinates, o' = -W c, d' = W d.

Nothing cancels in screen space: o' x d' is linear in the pixel, C_a + A dx + B dy, with
(W c) x (W d) = cof(W) (c x d), so that rho^2 = |C_a + A dx + B dy|^2 / |d'|^2 is formed without subtracting large
numbers however far the Gaussian is. A, B and C_a are perpendicular to W c: a frame of that plane leaves 6 numbers of
them, triangular form 5 of (d'_a, d'_x, d'_y). The anchor is the pixel center nearest to the projected mean, where C_a
is small. A mean on or behind the camera plane has no projection: there any anchor will do, because such a Gaussian
reaches the picture only if it is within a few standard deviations of the camera, where nothing is large.
"""

from __future__ import annotations

import drjit as dr

from drgs.settings import RenderSettings

__all__ = ["RECORD", "Projected", "cross", "dot", "project_screen", "project_world", "sh_basis", "sh_color"]

# Layout of a screen record (floats). ALPHA holds the opacity, or softplus(logit) for the integral response.
RECORD = 24
AX, AY, R11, R12, R13, R21, R22, R23, E2, E3, E4, E5, E6, H1, H2, H3, NORM, ALPHA, EXT2, RGB = range(20)
# A world record: mean (3), W by rows (9), opacity, extent^2, rgb (3); padded to the same stride.
W_MEAN, W_ROWS, W_ALPHA, W_EXT2, W_RGB = 0, 3, 12, 13, 14

_SH = (
    0.28209479177387814,
    0.4886025119029199,
    (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396),
    (
        -0.5900435899266435,
        2.890611442640554,
        -0.4570457994644658,
        0.3731763325901154,
        -0.4570457994644658,
        1.445305721320277,
        -0.5900435899266435,
    ),
)


class Projected:
    """What a view needs to know about each Gaussian.

    Attributes:
        record: List of Dr.Jit floats of width N, in the layout above, attached to the AD graph of the parameters.
        key: (N,) float, the depth key of `order="center"`; detached.
        bounds: Four (N,) floats x0, y0, x1, y1, in pixels, outside of which the Gaussian has no hit; detached.
        lower: (N,) float, no hit has an order key below it; detached.
        alive: (N,) mask of Gaussians that can have a hit.
        ellipsoids: World records only: mean (3), quaternion wxyz (4) and half axes of the extent (3); detached.
        frame: Not of `ewa`: rotation (3, 3) to world axes, scales (3), and of the local frame, on the screen only, the
            plane (u, v) of o' x d' and the axes (f1, f2, f3) that directions are stored along.
    """

    def __init__(self, record, key, bounds, lower, alive, ellipsoids=None, frame=None):
        self.record, self.key, self.bounds, self.lower, self.alive = record, key, bounds, lower, alive
        self.ellipsoids, self.frame = ellipsoids, frame


def sh_basis(direction, coefficients: int) -> list:
    """Real spherical harmonics in the order and sign of 3DGS, at a unit `direction` (three floats)."""
    x, y, z = direction
    basis = [type(x)(_SH[0])]
    if coefficients > 1:
        basis += [-_SH[1] * y, _SH[1] * z, -_SH[1] * x]
    if coefficients > 4:
        xx, yy, zz, c = x * x, y * y, z * z, _SH[2]
        basis += [c[0] * x * y, c[1] * y * z, c[2] * (2 * zz - xx - yy), c[3] * x * z, c[4] * (xx - yy)]
    if coefficients > 9:
        c = _SH[3]
        basis += [
            c[0] * y * (3 * xx - yy),
            c[1] * x * y * z,
            c[2] * y * (4 * zz - xx - yy),
            c[3] * z * (2 * zz - 3 * xx - 3 * yy),
            c[4] * x * (4 * zz - xx - yy),
            c[5] * z * (xx - yy),
            c[6] * x * (xx - 3 * yy),
        ]
    return basis


def sh_color(basis: list, coefficient) -> list:
    """RGB = max(0.5 + sum_k basis_k coefficient(k, channel), 0); the gradient is 0 where it is clamped."""
    rgb = []
    for channel in range(3):
        value = basis[0] * coefficient(0, channel)
        for k in range(1, len(basis)):
            value = dr.fma(basis[k], coefficient(k, channel), value)
        value += 0.5
        rgb.append(dr.select(value > 0, value, 0))
    return rgb


def dot(a, b):
    """Of two lists of three."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    """Of two lists of three."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _scaled(a, s):
    return [x * s for x in a]


def _less(a, b, s):
    return [x - s * y for x, y in zip(a, b, strict=True)]


class _Activated:
    """Activated parameters of every Gaussian in float64, and their camera-frame geometry."""

    def __init__(self, t, p, w2c, settings: RenderSettings, count: int):
        Float64, UInt32 = t.Float64, t.UInt32
        self.t, self.count = t, count
        self.i = i = dr.arange(UInt32, count)
        # Each Gaussian gathers its own entries once, so the adjoint needs no atomics.
        permute = dr.ReduceMode.Permute

        def column(name, k, stride):
            return dr.gather(type(p[name]), p[name], i * stride + k, mode=permute)

        self.column = column
        self.mean = [Float64(column("means", k, 3)) for k in range(3)]
        q = [Float64(column("quats", k, 4)) for k in range(4)]
        # Dividing by the largest component first keeps the square of tiny or huge quaternions finite.
        big = dr.detach(dr.maximum(dr.maximum(abs(q[0]), abs(q[1])), dr.maximum(abs(q[2]), abs(q[3]))))
        q = _scaled(q, dr.rcp(big))
        self.quat = _scaled(q, dr.rsqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]))
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
        if settings.response == "integral":
            self.strength = dr.select(logit >= 0, logit, 0) + dr.log(1 + e)
        else:
            self.strength = self.opacity
        extent = settings.extent
        if extent is None:
            opacity = dr.detach(self.opacity)
            self.extent = dr.sqrt(2 * dr.log(dr.maximum(opacity * (count / 1e-5), 1)))
        else:
            self.extent = dr.opaque(Float64, extent)
        # w2c maps the re-centered world of p["means"]; rows of the rotation and the translation.
        v = [[dr.gather(Float64, w2c, UInt32(4 * r + c)) for c in range(4)] for r in range(3)]
        self.view = v
        self.center = [
            v[r][0] * self.mean[0] + v[r][1] * self.mean[1] + v[r][2] * self.mean[2] + v[r][3] for r in range(3)
        ]
        self.from_local = [[sum(v[r][k] * self.rotation[k][c] for k in range(3)) for c in range(3)] for r in range(3)]

    def distance(self):
        return dr.sqrt(dot(self.center, self.center))

    def rgb(self, p, settings, coefficients: int):
        """Colors towards the mean; the derivative of the direction is kept."""
        Float, v = self.t.Float, self.view
        # The direction in world axes: R_wc times the camera-frame mean.
        d = [v[0][k] * self.center[0] + v[1][k] * self.center[1] + v[2][k] * self.center[2] for k in range(3)]
        squared = dot(d, d)
        # A mean at the camera center has no direction; any finite one will do.
        scale = dr.select(squared > 0, dr.rsqrt(dr.select(squared > 0, squared, 1)), 0)
        direction = [Float(x * scale) for x in d]
        basis = sh_basis(direction, coefficients)
        return sh_color(basis, lambda k, c: Float(self.column("sh", k * 3 + c, 3 * coefficients)))


def project_screen(t, p, w2c, pinhole, settings: RenderSettings, width: int, height: int, coefficients: int):
    """Screen records of a pinhole camera.

    Args:
        t: Dr.Jit types of the backend.
        p: Flat parameter arrays: means, quats, log_scales, logit_opacities, sh.
        w2c: Float64 of width 12, the upper rows of the world-to-camera matrix; differentiable.
        pinhole: Opaque Float64 (fx, skew, cx, fy, cy).
        settings: Any with traversal `tiles`.
        width, height: Of the image.
        coefficients: SH coefficients in `p["sh"]`; 0 leaves the color out (SH along each ray).
    Returns:
        A `Projected`.
    """
    Float, Float64 = t.Float, t.Float64
    count = dr.width(p["logit_opacities"])
    g = _Activated(t, p, w2c, settings, count)
    c, z = g.center, g.center[2]
    fx, skew, cx, fy, cy = pinhole
    dx = [dr.rcp(fx), Float64(0), Float64(0)]
    dy = [-skew / (fx * fy), dr.rcp(fy), Float64(0)]
    # The anchor: pixel center nearest to the projected mean, on the screen; the center of it for z <= 0.
    zd, cd = dr.detach(z), dr.detach(c)
    front = zd > 1e-9 * (abs(cd[0]) + abs(cd[1]))
    iz = dr.select(front, 1 / dr.select(front, zd, 1), 0)
    px = dr.select(front, fx * (cd[0] * iz) + skew * (cd[1] * iz) + cx, cx)
    py = dr.select(front, fy * (cd[1] * iz) + cy, cy)
    ax = dr.clip(dr.floor(px), 0, width - 1) + 0.5
    ay = dr.clip(dr.floor(py), 0, height - 1) + 0.5
    if settings.response == "ewa":
        frame = None
        shape, bounds, alive = _ewa(g, pinhole, ax, ay, settings, width, height)
    else:
        shape, frame = _peak(g, ax, ay, dx, dy, pinhole)
        bounds, alive = _silhouette(g, pinhole, settings, width, height)
    distance = g.distance()
    if settings.response == "ewa":
        key = z if settings.depth_key == "z" else distance
        shape = [*shape, key]
    record = [Float(ax), Float(ay), *[Float(x) for x in shape]]
    record += [Float(0)] * (ALPHA - len(record))
    record += [Float(g.strength), Float(dr.detach(g.extent * g.extent))]
    record += g.rgb(p, settings, coefficients) if coefficients else [Float(0)] * 3
    if settings.near > 0:
        alive &= zd > settings.near
    key = dr.detach(z if settings.depth_key == "z" else distance)
    # Peaks lie inside the extent ellipsoid, so no t* is nearer than its nearest point.
    reach = g.extent * dr.maximum(dr.maximum(g.scale[0], g.scale[1]), g.scale[2])
    lower = dr.maximum(dr.detach(distance - reach), 0) * (1 - 1e-6)
    return Projected(record, Float(key), [Float(b) for b in bounds], Float(lower), alive, frame=frame)


def _peak(g: _Activated, ax, ay, dx, dy, pinhole):
    """The 15 numbers of rho^2, t* and |d'| around the anchor (module docstring), and `Projected.frame`."""
    fx, skew, cx, fy, cy = pinhole
    inverse = [dr.rcp(s) for s in g.scale]
    volume = inverse[0] * inverse[1] * inverse[2]
    cofactor = [s * volume for s in g.scale]
    f = g.from_local

    def local(v, weight):  # diag(weight) Q^T v
        return [weight[k] * (f[0][k] * v[0] + f[1][k] * v[1] + f[2][k] * v[2]) for k in range(3)]

    yn = (ay - cy) / fy
    da = [(ax - cx - skew * yn) / fx, yn, type(yn)(1)]
    d = local(da, inverse)
    norm = dr.sqrt(dot(d, d))
    unit = dr.rcp(norm)
    A = _scaled(local(cross(g.center, dx), cofactor), unit)
    B = _scaled(local(cross(g.center, dy), cofactor), unit)
    C = _scaled(local(cross(g.center, da), cofactor), unit)
    # All three are perpendicular to W c: two components each say everything.
    u, v = _frame(local(g.center, inverse))
    r = [dot(u, A), dot(u, B), dot(u, C), dot(v, A), dot(v, B), dot(v, C)]
    # The same for (d'_a, d'_x, d'_y), divided by |d'_a|.
    f1 = _scaled(d, unit)
    Dx, Dy = _scaled(local(dx, inverse), unit), _scaled(local(dy, inverse), unit)
    e2, e3 = dot(f1, Dx), dot(f1, Dy)
    rest = _perpendicular(_less(Dx, f1, e2), f1)
    e4 = dr.sqrt(dot(rest, rest))
    f2 = _scaled(rest, dr.rcp(e4))
    f3 = cross(f1, f2)
    h = _scaled(local(g.center, inverse), unit)
    numbers = [*r, e2, e3, e4, dot(f2, Dy), dot(f3, Dy), dot(f1, h), dot(f2, h), dot(f3, h), norm]
    return numbers, (g.rotation, g.scale, (u, v), (f1, f2, f3))


def _frame(n):
    """Orthonormal u, v perpendicular to n, smooth in n; around the z axis where n is 0 (the mean at the camera)."""
    squared = dot(n, n)
    usable = dr.detach(squared) > 0
    scale = dr.select(usable, dr.rsqrt(dr.select(usable, squared, 1)), 0)
    x, y, z = _scaled(n, scale)
    z = dr.select(usable, z, 1)
    # The axis that n is least along gives u its direction.
    ax, ay, az = (abs(dr.detach(v)) for v in (x, y, z))
    first, second = (ax <= ay) & (ax <= az), ay <= az
    e = [dr.select(first, 1.0, 0.0), dr.select(~first & second, 1.0, 0.0), dr.select(~first & ~second, 1.0, 0.0)]
    n = [x, y, z]
    u = _less(e, n, dot(e, n))
    u = _scaled(u, dr.rsqrt(dot(u, u)))
    return u, cross(n, u)


def _perpendicular(a, n):
    """a, perpendicular to n but for rounding, without that: its component along the largest axis of n is put right.

    Of a Gaussian as thin as a sheet n is the thin axis, nearly, and what a has of it is multiplied by 1 / scale.
    """
    size = [abs(dr.detach(x)) for x in n]
    largest = dr.maximum(dr.maximum(size[0], size[1]), size[2])
    result = []
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        here = size[k] == largest
        result.append(dr.select(here, -(n[i] * a[i] + n[j] * a[j]) / dr.select(here, n[k], 1), a[k]))
    return result


def _listed_extent(g: _Activated, settings):
    """Radius beyond which no hit counts: the extent, or less where alpha_min cuts earlier."""
    extent = dr.detach(g.extent)
    if settings.alpha_min > 0 and settings.response != "integral":
        ratio = dr.maximum(dr.detach(g.opacity) / settings.alpha_min, 1)
        # The factor keeps a hit that float32 rounds to the right side of alpha_min.
        extent = dr.minimum(extent, dr.sqrt(2 * dr.log(ratio)) * 1.001 + 1e-3)
    return extent


def _silhouette(g: _Activated, pinhole, settings, width: int, height: int):
    """Screen bounds of the extent ellipsoid, exact where it lies in front of the camera plane.

    The rays that touch the ellipsoid {c, extent^2 Sigma} are a cone; a plane through the camera with normal n is
    tangent to it where n^T (extent^2 Sigma - c c^T) n = 0.
    """
    fx, skew, cx, fy, cy = pinhole
    f, extent = g.from_local, _listed_extent(g, settings)
    c = dr.detach(g.center)
    e2 = extent * extent

    def sigma(a, b):
        return e2 * sum(dr.detach(f[a][k] * f[b][k] * g.scale[k] * g.scale[k]) for k in range(3))

    szz = sigma(2, 2)
    q22 = szz - c[2] * c[2]
    inside = q22 >= -1e-9 * (c[2] * c[2])  # the ellipsoid meets the camera plane: unbounded on the screen
    behind = ~inside & (c[2] < 0)
    den = dr.select(inside, -1, q22)

    def axis(k):
        q = sigma(k, 2) - c[k] * c[2]
        root = dr.sqrt(dr.maximum(q * q - (sigma(k, k) - c[k] * c[k]) * den, 0)) / -den
        return q / den, root

    mx, rx = axis(0)
    my, ry = axis(1)
    grow_x = abs(fx) * rx + abs(skew) * ry
    x = fx * mx + skew * my + cx
    y = fy * my + cy
    pad = 1e-3  # px; rounding of float32 bounds
    bounds = [x - grow_x - pad, y - abs(fy) * ry - pad, x + grow_x + pad, y + abs(fy) * ry + pad]
    full = [0.0, 0.0, float(width), float(height)]
    bounds = [dr.select(inside, edge, b) for edge, b in zip(full, bounds, strict=True)]
    # Wholly behind the camera plane at this extent: no peak in front, and what integral would add there is below
    # the tail that the extent leaves out.
    return bounds, ~behind & (extent > 0)


def _ewa(g: _Activated, pinhole, ax, ay, settings, width: int, height: int):
    """The rasterizers' model: Sigma' = J W Sigma W^T J^T + dilation, with each one's clamp and culling."""
    fx, skew, cx, fy, cy = pinhole
    Float64 = type(fx)
    c = g.center
    # Means at or behind the camera plane are culled; a positive depth keeps their (unused) numbers finite.
    alive = dr.detach(c[2]) > 0
    z = dr.select(alive, c[2], 1)
    iz = dr.rcp(z)
    tx, ty = c[0] * iz, c[1] * iz
    if settings.fov_clamp != "none":
        half_x, half_y = width / (2 * fx), height / (2 * fy)
        if settings.fov_clamp == "inria":
            high_x, low_x, high_y, low_y = 1.3 * half_x, 1.3 * half_x, 1.3 * half_y, 1.3 * half_y
        else:
            high_x, low_x = (width - cx) / fx + 0.3 * half_x, cx / fx + 0.3 * half_x
            high_y, low_y = (height - cy) / fy + 0.3 * half_y, cy / fy + 0.3 * half_y
        tx, ty = dr.clip(tx, -low_x, high_x), dr.clip(ty, -low_y, high_y)
    # Rows of J for the image axes, and their pull-back into the local frame.
    jx = [fx * iz, skew * iz, -(fx * tx + skew * ty) * iz]
    jy = [Float64(0), fy * iz, -fy * ty * iz]
    f = g.from_local
    lx = [g.scale[k] * (f[0][k] * jx[0] + f[1][k] * jx[1] + f[2][k] * jx[2]) for k in range(3)]
    ly = [g.scale[k] * (f[1][k] * jy[1] + f[2][k] * jy[2]) for k in range(3)]
    cxx = dot(lx, lx) + settings.dilation
    cyy = dot(ly, ly) + settings.dilation
    cxy = dot(lx, ly)
    # |lx x ly|^2 + dilation (...) instead of cxx cyy - cxy^2: thin projections do not cancel.
    n = cross(lx, ly)
    det = dot(n, n) + settings.dilation * (dot(lx, lx) + dot(ly, ly) + settings.dilation)
    r22 = dr.rsqrt(cyy)
    r11 = dr.sqrt(cyy / det)
    r12 = -cxy * dr.rsqrt(cyy * det)
    px = fx * c[0] * iz + skew * c[1] * iz + cx
    py = fy * c[1] * iz + cy
    ox, oy = ax - px, ay - py
    shape = [r11, r12, r11 * ox + r12 * oy, Float64(0), r22, r22 * oy, *[Float64(0)] * 5]
    px, py, cxx, cyy, det = (dr.detach(v) for v in (px, py, cxx, cyy, det))
    if settings.culling == "inria":
        mid = 0.5 * (cxx + cyy)
        radius = dr.ceil(3 * dr.sqrt(mid + dr.sqrt(dr.maximum(mid * mid - det, 0.1))))
        rx = ry = radius
    elif settings.culling == "gsplat":
        opacity = dr.detach(g.opacity)
        extent = dr.minimum(dr.sqrt(2 * dr.log(dr.maximum(255 * opacity, 1))), 3.33)
        rx, ry = dr.ceil(extent * dr.sqrt(cxx)), dr.ceil(extent * dr.sqrt(cyy))
        alive &= opacity >= 1 / 255
    else:
        extent = _listed_extent(g, settings)
        rx, ry = extent * dr.sqrt(cxx) + 1e-3, extent * dr.sqrt(cyy) + 1e-3
        alive &= extent > 0
    bounds = [px - rx, py - ry, px + rx, py + ry]
    if settings.culling == "inria":
        # Whole 16x16 tiles, as getRect does; pixel indices p are covered when first <= p < last. The rasterizer's
        # pixel coordinate is half a pixel below ours.
        low = [16 * dr.floor((b - 0.5) / 16) for b in bounds[:2]]
        high = [16 * dr.floor((b - 0.5 + 15) / 16) for b in bounds[2:]]
        bounds = [low[0] + 0.25, low[1] + 0.25, high[0] - 0.25, high[1] - 0.25]
    elif settings.culling == "gsplat":
        bounds = [b + s for b, s in zip(bounds, (-1.0, -1.0, 1.0, 1.0), strict=True)]
    return shape, bounds, alive


def project_world(t, p, w2c, settings: RenderSettings, coefficients: int):
    """World records for arbitrary rays: mean, W = S^-1 R^T, opacity, extent^2, color.

    Args and Returns: as `project_screen`; `bounds` is None.
    """
    Float = t.Float
    count = dr.width(p["logit_opacities"])
    g = _Activated(t, p, w2c, settings, count)
    inverse = [dr.rcp(s) for s in g.scale]
    record = [Float(x) for x in g.mean]
    record += [Float(inverse[r] * g.rotation[c][r]) for r in range(3) for c in range(3)]
    record += [Float(g.strength), Float(dr.detach(g.extent * g.extent))]
    record += g.rgb(p, settings, coefficients) if coefficients else [Float(0)] * 3
    distance, z = dr.detach(g.distance()), dr.detach(g.center[2])
    alive = dr.detach(g.extent) > 0
    if settings.near > 0:
        alive &= z > settings.near
    key = z if settings.depth_key == "z" else distance
    # The proxies of `bvh` may stop where alpha_min cuts, unless it is their entry points that order the hits.
    extent = dr.detach(g.extent) if settings.order == "entry" else _listed_extent(g, settings)
    ellipsoids = [*g.mean, *g.quat, *[dr.detach(s) * extent for s in g.scale]]
    frame = g.rotation, g.scale, None, None
    return Projected(record, Float(key), None, None, alive & (extent > 0), [dr.detach(x) for x in ellipsoids], frame)
