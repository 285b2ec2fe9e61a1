"""Response `peak`: a = alpha exp(-rho^2 / 2) where a ray comes nearest to the Gaussian in its own metric.

Moenne-Loccoz et al. 2024 (3D Gaussian ray tracing). With W = S^-1 R^T, o' = W (o - mu), d' = W d:
t* = -o'.d' / |d'|^2, rho^2 = |o' x d'|^2 / |d'|^2. Both o' x d' and d' are used times the least scale: what is left are
products of scales (`Activated.inverse`), and a disc is no special case, nor are its derivatives.

On the screen. A pinhole ray has the direction d(x, y) = d_a + (x - x_a) d_x + (y - y_a) d_y in camera coordinates,
unnormalized with d_z = 1, around an anchor pixel (x_a, y_a); c is the mean there, o' = -W c. Nothing cancels: o' x d'
is linear in the pixel, C_a + A dx + B dy, with (W c) x (W d) = cof(W) (c x d), so that rho^2 = |C_a + A dx + B dy|^2 /
|d'|^2 is formed without subtracting large numbers however far the Gaussian is. A, B and C_a are perpendicular to W c: a
frame (u, v) of that plane leaves 6 numbers of them, triangular form along (f1, f2, f3) 5 of (d'_a, d'_x, d'_y). The
anchor is the pixel center nearest to the projected mean, where C_a is small. A mean on or behind the camera plane has
no projection: there any anchor will do, because such a Gaussian reaches the picture only if it is within a few standard
deviations of the camera, where nothing is large.

Under a lens a ray is d = x d_x + y d_y + w d_a, from the anchor on: a point between pixels, w = 1, or, of a lens that
sees wide, a direction on the side of a cube around the camera that the mean is seen through, (d_x, d_y) its axes
(lens_rays.py). All of the above is linear in (x, y, w), and rho^2 does not depend on the length of d.

Derivatives. With y = S^-1 R^T x the ray meets its peak at p (|p|^2 = rho^2, p perpendicular to d'), u = t* |d'|, and
e = d' / |d'|. As p minimizes the distance, moving along the ray changes nothing, and

    d(-rho^2 / 2) = (p / s) . R^T dmu  +  p_k^2 dlog s_k  +  w . R (S p x S^-1 p)

for a move dmu of the mean and a world-frame rotation R <- exp([w]x) R; integral.py has du. Of the product component i,
with j and k the axes after it, is p_j p_k (s_j / s_k - s_k / s_j). That bracket is of the Gaussian, in float64: as a
cross product in float32, the rotation of a sphere, which changes nothing, would have a derivative of 1e-7.
"""

from __future__ import annotations

import drjit as dr

from drgs.tracing import records as layout
from drgs.tracing.arrays import Float, Lib, Mask
from drgs.tracing.lens_rays import on_side
from drgs.tracing.primitives import Activated, Patch, Projected, Ray, Screen
from drgs.tracing.records import cross, dot
from drgs.tracing.silhouettes import silhouette


class AlphaStrength:
    """What stands for alpha in the record is alpha itself, and x = strength exp(-rho^2 / 2) the opacity of a hit."""

    def strength(self, logit: Float, opacity: Float, e: Float) -> Float:
        """Alpha itself."""
        return opacity

    def strength_slope(self, logit: Float, opacity: Float, e: Float) -> Float:
        """1 - alpha, without its cancellation."""
        return dr.select(logit >= 0, e, 1) / (1 + e)

    def least_strength(self, alpha_min: float) -> float:
        """The opacity is the strength times exp(-rho^2 / 2)."""
        return alpha_min

    def opacity(self, x: Float, u: Float | None) -> Float:
        """x itself."""
        return x


class Peak(AlphaStrength):
    """a = alpha exp(-rho^2 / 2); peaks behind the origin of the ray do not count."""

    planar = False
    front_only = True
    at_most_alpha = True
    # The plane (u, v) of o' x d' in the axes that directions are stored along (6), R S^-1 and those axes (18), R times
    # the brackets of rotations (9).
    extra = 33
    by_tangents = False

    # -- once a Gaussian and view ------------------------------------------------------------------------------------

    def project(self, g: Activated, screen: Screen) -> tuple[list[Float], list[Float], Mask, tuple]:
        """The 15 numbers of rho^2, t* and |d'| around the anchor, and the bounds of the extent ellipsoid."""
        dx, dy, da = screen.axes()

        # diag(weight) R^T v, from camera axes; R as in W, and as in det(W) W^-T, which cross products have.
        def local(v: list[Float]) -> list[Float]:
            return _weighted(g.inverse_from_local, v, g.inverse)

        def crossed(v: list[Float]) -> list[Float]:
            return _weighted(g.from_local, v, g.cofactor)

        d = local(da)
        length = dr.sqrt(dot(d, d))
        unit = dr.rcp(length)
        A = _scaled(crossed(cross(g.center, dx)), unit)
        B = _scaled(crossed(cross(g.center, dy)), unit)
        C = _scaled(crossed(cross(g.center, da)), unit)
        # All three are perpendicular to W c: two components each say everything.
        u, v = _frame(local(g.center))
        r = [dot(u, A), dot(u, B), dot(u, C), dot(v, A), dot(v, B), dot(v, C)]
        # The same for (d'_a, d'_x, d'_y), divided by |d'_a|: Gram-Schmidt from d'_a on.
        f1 = _scaled(d, unit)
        Dx, Dy = _scaled(local(dx), unit), _scaled(local(dy), unit)
        e2, e3 = dot(f1, Dx), dot(f1, Dy)
        rest = _perpendicular(_less(Dx, f1, e2), f1)
        e4 = dr.sqrt(dot(rest, rest))
        f2 = _scaled(rest, dr.rcp(e4))
        f3 = cross(f1, f2)
        h = _scaled(local(g.center), unit)
        numbers = [*r, e2, e3, e4, dot(f2, Dy), dot(f3, Dy), dot(f1, h), dot(f2, h), dot(f3, h), length * g.norm]
        return numbers, *silhouette(g, screen), (g.rotation, g.scale, (u, v), (f1, f2, f3))

    def extras(self, lib: Lib, projected: Projected, moved: list[list[Float]] | None) -> list[Float]:
        """What the closed forms need of the frame, see `extra`."""
        F = lib.Float
        rotation, scale, plane, axes = projected.frame
        axes = axes or [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        columns = [F(dot(f, x)) for x in plane for f in axes] if plane else [F(0)] * 6
        local = list(zip(*axes, strict=True))  # rows: local axes; columns: f
        thin = [dr.rcp(s) for s in scale]
        columns += [
            F(sum(rotation[r][k] * thin[k] * local[k][i] for k in range(3))) for r in range(3) for i in range(3)
        ]
        columns += [F(local[k][i]) for k in range(3) for i in range(3)]
        pairs = [(scale[(i + 1) % 3], scale[(i + 2) % 3]) for i in range(3)]
        brackets = [a / b - b / a for a, b in pairs]  # exactly 0 where two scales are the same
        return columns + [F(rotation[r][i] * brackets[i]) for r in range(3) for i in range(3)]

    # -- once a hit --------------------------------------------------------------------------------------------------

    def slots(self, world: bool, depth: bool) -> list[int]:
        """All numbers of the shape; those of t* where a depth is rendered."""
        L = layout
        if world:
            return [*range(L.W_MEAN, L.W_ALPHA + 1), *range(L.W_RGB, L.W_RGB + 3)]
        used = [*range(L.R11, L.R23 + 1), L.ALPHA, *range(L.RGB, L.RGB + 3), *range(L.E2, L.E6 + 1)]
        return used + ([L.H1, L.H2, L.H3] if depth else [])

    def along(self, r: list[Float], ray: Ray, world: bool) -> tuple[Float, Float, Float | None]:
        """rho^2, t* and u of a ray."""
        if world:
            t0, along, c, _, inverse = _local(r, ray)
            key = t0 - along * inverse
            return dot(c, c) * inverse, key, self._u_in_world(r, key, inverse)
        c1, c2, d, inverse = _on_screen(r, ray)
        squared = dr.fma(c1, c1, c2 * c2)
        along = dr.fma(r[layout.H1], d[0], dr.fma(r[layout.H2], d[1], r[layout.H3] * d[2]))
        length = ray.length + ray.carried[-1] if ray.shifted and not ray.direction else ray.length
        return squared * inverse, along * inverse * length, self._u_on_screen(r, along, inverse)

    def _u_in_world(self, r: list[Float], key: Float, inverse: Float) -> Float | None:
        return None

    def _u_on_screen(self, r: list[Float], along: Float, inverse: Float) -> Float | None:
        return None

    def slopes(self, r: list[Float], extra: list[Float], ray: Ray, world: bool) -> list[Float]:
        """a times the derivatives of -rho^2 / 2 (module docstring)."""
        p, _, _, rho2 = self._peak(r, extra, ray, world)
        a = r[layout.W_ALPHA if world else layout.ALPHA] * dr.exp(-0.5 * rho2)
        return [*(a * x for x in approach(extra, p)), a]

    def _peak(
        self, r: list[Float], extra: list[Float], ray: Ray, world: bool
    ) -> tuple[list[Float], list[Float], Float, Float]:
        """p, e, u and rho^2; on the screen p and e in the frame of the ray's direction at the anchor."""
        rho2, _, u = self.along(r, ray, world)
        if world:
            _, _, c, d, inverse = _local(r, ray)
            root = dr.sqrt(inverse)
            return [x * inverse for x in cross(d, c)], [x * root for x in d], u, rho2
        c1, c2, d, inverse = _on_screen(r, ray)
        q = [dr.fma(c1, extra[i], c2 * extra[3 + i]) for i in range(3)]
        root = dr.sqrt(inverse)
        return [x * inverse for x in cross(q, d)], [x * root for x in d], u, rho2

    # -- once a tile -------------------------------------------------------------------------------------------------

    def may_hit(self, r: list[Float], patch: Patch, limit: Float) -> Mask:
        """False only where rho^2 <= limit has no solution, or (if only peaks in front count) all of it is behind."""
        d = _direction(r, patch.dx, patch.dy, patch.w)
        slopes = (r[layout.E2], r[layout.E3], 1), (r[layout.E4], r[layout.E5], 0), (0.0, r[layout.E6], 0)
        most = [abs(v) + patch.spread(*slope) for v, slope in zip(d, slopes, strict=True)]
        length2 = dr.fma(most[0], most[0], dr.fma(most[1], most[1], most[2] * most[2]))
        # 1.0001 and 1e-6: float32 rounds what is compared by less.
        met = ~(deviation(r, patch) > 1.0001 * limit * length2)
        if self.front_only:
            h = r[layout.H1], r[layout.H2], r[layout.H3]
            along = [a * b for a, b in zip(h, d, strict=True)]
            rise = [sum(a * b[k] for a, b in zip(h, slopes, strict=True)) for k in range(2)]
            rounding = 1e-6 * sum(abs(x) for x in along)
            met &= ~(sum(along) + patch.spread(rise[0], rise[1], h[0]) + rounding <= 0)
        return met


PEAK = Peak()
"""The row of `RESPONSES`."""


def entry(r: list[Float], ray: Ray) -> Float:
    """Where a world ray enters the ellipsoid of the extent: before its origin if that is inside."""
    t0, along, c, _, inverse = _local(r, ray)
    half = dr.maximum(r[layout.W_EXT2] - dot(c, c) * inverse, 0) * inverse
    return t0 - along * inverse - dr.sqrt(half) / r[layout.W_NORM]


def deviation(r: list[Float], patch: Patch) -> Float:
    """Least (c1^2 + c2^2) of the record within a patch, rounding taken off."""
    L = layout

    def least(a: Float, b: Float, c: Float) -> Float:  # of |a x + b y + c w|
        parts = a * patch.dx, b * patch.dy, _times_w(c, patch.w)
        # A few units in the last place of each part.
        rounding = 1e-6 * (abs(parts[0]) + abs(parts[1]) + abs(parts[2]))
        return dr.maximum(abs(parts[0] + parts[1] + parts[2]) - patch.spread(a, b, c) - rounding, 0)

    m1 = least(r[L.R11], r[L.R12], r[L.R13])
    m2 = least(r[L.R21], r[L.R22], r[L.R23])
    return dr.fma(m1, m1, m2 * m2)


def approach(extra: list[Float], p: list[Float]) -> list[Float]:
    """d(-rho^2 / 2) by mean, rotation and log-scale: (p / s) R^T, R (S p x S^-1 p), p_k^2."""
    n, local = times(extra, 0, p), times(extra, 1, p)
    squares = [x * x for x in local]
    products = [local[1] * local[2], local[2] * local[0], local[0] * local[1]]
    return [*n, *times(extra, 2, products), *squares]


def times(extra: list[Float], which: int, x: list[Float]) -> list[Float]:
    """One of the three matrices of `Peak.extra` times x.

    Args:
        extra: Columns of `Peak.extras`.
        which: 0: R S^-1, from the stored axes to world axes. 1: the stored axes to local ones. 2: R (S x x S^-1 y) in
            world axes, from the products (x_2 y_3, x_3 y_1, x_1 y_2) in local axes, y = x or their sum both ways round.
        x: Three floats.
    """
    m = extra[6 + 9 * which : 15 + 9 * which]
    return [m[3 * r] * x[0] + m[3 * r + 1] * x[1] + m[3 * r + 2] * x[2] for r in range(3)]


def _on_screen(r: list[Float], ray: Ray) -> tuple[Float, Float, list[Float], Float]:
    """The two parts of o' x d' of a ray of the screen, d' in its own frame, and 1 / |d'|^2."""
    L = layout
    dx, dy, w = _from_anchor(r, ray)
    c1 = dr.fma(r[L.R11], dx, dr.fma(r[L.R12], dy, _times_w(r[L.R13], w)))
    c2 = dr.fma(r[L.R21], dx, dr.fma(r[L.R22], dy, _times_w(r[L.R23], w)))
    d = _direction(r, dx, dy, w)
    return c1, c2, d, dr.rcp(dr.fma(d[0], d[0], dr.fma(d[1], d[1], d[2] * d[2])))


def _from_anchor(r: list[Float], ray: Ray) -> tuple[Float, Float, Float | int]:
    """Where a ray is from the anchor, (x - w x_a, y - w y_a, w): a pixel, with w = 1, or on a side of the cube."""
    ax, ay = r[layout.AX], r[layout.AY]
    low = ray.low
    if ray.shifted:
        low = [a + b for a, b in zip(low, ray.carried[-3:], strict=False)] or ray.carried[-3:]
    if not ray.direction:
        dx, dy = ray.x - ax, ray.y - ay
        return (dx + low[0], dy + low[1], 1) if low else (dx, dy, 1)
    # A product is not rounded before it is added: where the two are nearly the same, no digit is lost.
    x, y, w = on_side(r[layout.SIDE], ray.direction)
    x1, y1, w1 = on_side(r[layout.SIDE], low)
    return (
        dr.fma(-ax, w, x) + dr.fma(-ax, w1, x1),
        dr.fma(-ay, w, y) + dr.fma(-ay, w1, y1),
        w + w1 if ray.shifted else w,
    )


def _times_w(c: Float, w: Float | int) -> Float:
    """c w, and c itself where w is 1."""
    return c if isinstance(w, int) else c * w


def _direction(r: list[Float], dx: Float, dy: Float, w: Float | int) -> list[Float]:
    """The three parts of d' at (dx, dy) from w times the anchor, along (f1, f2, f3)."""
    L = layout
    return [dr.fma(r[L.E2], dx, dr.fma(r[L.E3], dy, w)), dr.fma(r[L.E4], dx, r[L.E5] * dy), r[L.E6] * dy]


def _local(r: list[Float], ray: Ray) -> tuple[Float, Float, list[Float], list[Float], Float]:
    """A world ray o + t d in the local frame, with w = (o - mu) + t0 d: t0, w'.d', w' x d', d' and 1 / |d'|^2.

    w', d' and w' x d' are divided by `Activated.norm`, which cancels in rho^2, t* and the peak. w' x d' is the cofactor
    matrix of W times w x d: of a disc, whose W is large, nothing large is formed.

    t0, where the ray is nearest to the mean, only moves the point about which the local frame is expanded, so that what
    is rounded is as small as the Gaussian's distance from the ray.
    """
    L = layout
    o = ray.carried[-6:-3]
    d = ray.carried[-3:]
    to = [r[L.W_MEAN + k] - o[k] for k in range(3)]
    t0 = dr.detach(dot(to, d))  # no value depends on it but for rounding, hence no derivative
    w = [dr.fma(t0, d[k], -to[k]) for k in range(3)]
    rows = [r[L.W_ROWS + 3 * k : L.W_ROWS + 3 * k + 3] for k in range(3)]
    w, d = ([dot(row, v) for row in rows] for v in (w, d))
    c = [x * y for x, y in zip(r[L.W_COFACTOR : L.W_COFACTOR + 3], cross(w, d), strict=True)]
    w, d = ([x * y for x, y in zip(r[L.W_INVERSE : L.W_INVERSE + 3], v, strict=True)] for v in (w, d))
    squared = dot(d, d)
    # Lanes without a candidate read zeros: 0 / 0 would spoil their (masked) derivatives.
    return t0, dot(w, d), c, d, dr.rcp(dr.select(squared > 0, squared, 1))


def _frame(n: list[Float]) -> tuple[list[Float], list[Float]]:
    """Orthonormal u, v perpendicular to n, smooth in n; around the z axis where n is 0 (the mean at the camera).

    rho^2 does not depend on which pair it is, so that masks and choices in here need no derivative.
    """
    squared = dot(n, n)
    usable = dr.detach(squared) > 0  # a mask
    scale = dr.select(usable, dr.rsqrt(dr.select(usable, squared, 1)), 0)
    x, y, z = _scaled(n, scale)
    z = dr.select(usable, z, 1)
    # The axis that n is least along gives u its direction: a choice, again.
    ax, ay, az = (abs(dr.detach(v)) for v in (x, y, z))
    first = (ax <= ay) & (ax <= az)
    second = ay <= az
    e = [dr.select(first, 1.0, 0.0), dr.select(~first & second, 1.0, 0.0), dr.select(~first & ~second, 1.0, 0.0)]
    n = [x, y, z]
    u = _less(e, n, dot(e, n))
    u = _scaled(u, dr.rsqrt(dot(u, u)))
    return u, cross(n, u)


def _perpendicular(a: list[Float], n: list[Float]) -> list[Float]:
    """a, perpendicular to n but for rounding, without that: its component along the largest axis of n is put right.

    Of a Gaussian as thin as a sheet n is the thin axis, nearly, and what a has of it is multiplied by 1 / scale.
    """
    size = [abs(dr.detach(x)) for x in n]  # only says which axis is the largest
    largest = dr.maximum(dr.maximum(size[0], size[1]), size[2])
    result = []
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        here = size[k] == largest
        result.append(dr.select(here, -(n[i] * a[i] + n[j] * a[j]) / dr.select(here, n[k], 1), a[k]))
    return result


def _weighted(f: list[list[Float]], v: list[Float], weight: list[Float]) -> list[Float]:
    """diag(weight) f^T v."""
    return [weight[k] * (f[0][k] * v[0] + f[1][k] * v[1] + f[2][k] * v[2]) for k in range(3)]


def _scaled(a: list[Float], s: Float) -> list[Float]:
    return [x * s for x in a]


def _less(a: list[Float], b: list[Float], s: Float) -> list[Float]:
    return [x - s * y for x, y in zip(a, b, strict=True)]
