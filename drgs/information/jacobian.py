"""The derivatives of one hit by the raw parameters of its Gaussian, in closed form, and sums of their squares.

With the local frame's y = S^-1 R^T x, the ray meets its peak at p (|p|^2 = rho^2, p perpendicular to the direction d'),
t* |d'| = u, and e = d' / |d'|. As p minimizes the distance, moving along the ray changes nothing, and

    d(-rho^2 / 2) = (p / s) . R^T dmu  +  p_k^2 dlog s_k  +  w . R (S p x S^-1 p)
    du            = (e / s) . R^T dmu  +  (2 p_k e_k - u e_k^2) dlog s_k
                    + w . R (S p x S^-1 e + S e x S^-1 p - u S e x S^-1 e)

for a move dmu of the mean and a world-frame rotation R <- exp([w]x) R. The rows of the Jacobian are then, with the
notation of kernels.py, dC_c = T (c_c - B_c) da + w dc_c: channels are summed over what a parameter does, then squared.
`ewa` has no p; there the derivatives of the record come from the AD of projection.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr

from drgs.tracing import projection as layout
from drgs.tracing.derivatives import if_any_hit
from drgs.tracing.kernels import load_packed, pack, packed_size
from drgs.tracing.projection import cross, dot

__all__ = ["GEOMETRY", "Blocks", "Diagonal", "Rows", "Variance", "extras"]

GEOMETRY = 10  # means 3, rotations 3, log-scales 3, logit-opacity 1: the order of every row
_OPACITY, _COLOR, _SHAPE = 0, 1, 10  # entries of `extras`: d strength / dlogit, dc/dmu (9), then matrices
_EWA = (layout.R11, layout.R12, layout.R13, layout.R22, layout.R23)


def extras(t, settings, inputs, projected, moved: list | None, color: list | None):
    """What hits need besides the record, packed (kernels.pack).

    Args:
        inputs: Flat parameter arrays, as `projection` gets them.
        projected: `Projected` of the view.
        moved: `ewa` only: per geometric parameter but the opacity, the tangent of the record.
        color: (channel, axis) nested lists of dc/dmu, or None where the color does not depend on the mean.
    """
    F = t.Float
    logit = t.Float64(inputs["logit_opacities"])
    e = dr.exp(-abs(logit))
    opacity = dr.select(logit >= 0, 1, e) / (1 + e)
    if settings.response == "integral":  # softplus' / softplus
        slope = opacity / (dr.maximum(logit, 0) + dr.log(1 + e))
    else:
        slope = dr.select(logit >= 0, e, 1) / (1 + e)
    columns = [F(slope)]
    columns += [F(x) for channel in color for x in channel] if color else [F(0)] * 9
    if settings.response == "ewa":
        columns += [F(tangent[k]) for tangent in moved for k in _EWA]
    else:
        rotation, scale, plane, axes = projected.frame
        axes = axes or [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        columns += [F(dot(f, x)) for x in plane for f in axes] if plane else [F(0)] * 6
        local = list(zip(*axes, strict=True))  # rows: local axes; columns: f
        for weight in ([dr.rcp(s) for s in scale], scale):
            columns += [
                F(sum(rotation[r][k] * weight[k] * local[k][i] for k in range(3))) for r in range(3) for i in range(3)
            ]
        columns += [F(local[k][i]) for k in range(3) for i in range(3)]
    return pack(t, columns, dr.width(logit))


class _Geometry:
    """d a / d(geometry) of a hit."""

    def __init__(self, model, buffer):
        self.m, self.t, self.buffer = model, model.t, buffer
        # `extras` has 10 numbers, then 45 or 33 of the shape.
        self.size = packed_size(_SHAPE + (45 if model.s.response == "ewa" else 33))

    def load(self, index, active) -> list:
        """The extras of a Gaussian."""
        return load_packed(self.t, self.buffer, self.size, index, active)

    def slopes(self, record, extra, ray) -> list:
        """The GEOMETRY derivatives of the opacity of a hit."""
        if self.m.s.response == "ewa":
            return self._screen(record, extra, ray)
        integral = self.m.s.response == "integral"
        p, e, u, rho2 = self._peak(record, extra, ray)
        gauss = dr.exp(-0.5 * rho2)
        strength = record[layout.W_ALPHA if self.m.world else layout.ALPHA]
        if integral:
            passed = 0.5 + 0.5 * dr.erf(u * 0.7071067811865476)
            left = strength * gauss * dr.exp(-strength * gauss * passed)
            along, across = left * passed, left * dr.exp(-0.5 * u * u) * 0.3989422804014327
        else:
            along = strength * gauss
        shape = extra[_SHAPE + 6 :]

        def times(first, x):
            m = shape[first : first + 9]
            return [m[3 * r] * x[0] + m[3 * r + 1] * x[1] + m[3 * r + 2] * x[2] for r in range(3)]

        n, v, local = times(0, p), times(9, p), times(18, p)
        means, turn, scales = n, cross(v, n), [x * x for x in local]
        result = [[along * x for x in part] for part in (means, turn, scales)]
        if integral:
            ne, ve, le = times(0, e), times(9, e), times(18, e)
            turn = [a + b - u * c for a, b, c in zip(cross(v, ne), cross(ve, n), cross(ve, ne), strict=True)]
            scales = [2 * x * y - u * y * y for x, y in zip(local, le, strict=True)]
            result = [
                [dr.fma(across, x, y) for x, y in zip(part, old, strict=True)]
                for part, old in zip((ne, turn, scales), result, strict=True)
            ]
        return [*result[0], *result[1], *result[2], along * extra[_OPACITY]]

    def _peak(self, r, extra, ray):
        """p, e, u and rho^2; on the screen p and e in the frame of the ray's direction at the anchor."""
        rho2, _, u = self.m.along(r, ray)
        if self.m.world:
            _, a, d, inverse = self.m.local(r, ray)
            root = dr.sqrt(inverse)
            # a - (a.d) d / |d|^2 would cancel where a is long: across a sheet it is 1e6 times p.
            return [x * inverse for x in cross(d, cross(a, d))], [x * root for x in d], u, rho2
        c1, c2, d, inverse = self.m.screen(r, ray)
        q = [dr.fma(c1, extra[_SHAPE + i], c2 * extra[_SHAPE + 3 + i]) for i in range(3)]
        root = dr.sqrt(inverse)
        return [x * inverse for x in cross(q, d)], [x * root for x in d], u, rho2

    def _screen(self, r, extra, ray):
        """Of `ewa`: through the triangular form of Sigma' and the projected mean."""
        L = layout
        dx, dy = ray.x - r[L.AX], ray.y - r[L.AY]
        c1, c2, _, _ = self.m.screen(r, ray)
        a = r[L.ALPHA] * dr.exp(-0.5 * dr.fma(c1, c1, c2 * c2))
        slopes = []
        for j in range(9):
            r11, r12, r13, r22, r23 = extra[_SHAPE + 5 * j : _SHAPE + 5 * j + 5]
            d1, d2 = dr.fma(r11, dx, dr.fma(r12, dy, r13)), dr.fma(r22, dy, r23)
            slopes.append(-a * dr.fma(c1, d1, c2 * d2))
        return [*slopes, a * extra[_OPACITY]]


class Row(NamedTuple):
    """What a hit says about its Gaussian on one ray.

    Attributes:
        slopes: d a / d geometry; None without geometry.
        g: Per channel, dC / da, 0 where the ray has no such hit; None without geometry.
        w: Weight of the hit, 0 likewise.
        turned: (channel, axis) w dc/dmu, or None where the color does not depend on the mean.
        color: RGB of the Gaussian on this ray; None where no sink needs it.
        basis: SH basis along the ray; empty where SH are evaluated towards the mean.
    """

    slopes: list | None
    g: list | None
    w: Any
    turned: list | None
    color: list | None
    basis: list


class Rows:
    """Replay of a primal pass that hands the Jacobian's rows of every hit to a sink.

    Args:
        buffer: From `extras`; None leaves the geometry out, only w is known then.
        sink: What becomes of them: `Diagonal`, `Blocks` or `Variance`.
        finals: Per shared ray, the final state of the Primal pass.
        color: The color depends on the mean, through the direction.
    """

    def __init__(self, model, source, buffer, sink, finals, color: bool):
        self.m, self.source, self.sink, self.finals = model, source, sink, finals
        self.geometry, self.color = buffer is not None and _Geometry(model, buffer), color
        self.colors = buffer is not None or getattr(sink, "bands", 0) > 0
        self.pending = iter(finals)

    def init(self, alive, place) -> dict:
        """State of the next shared ray: what is left of each channel behind the last hit."""
        t, final = self.m.t, next(self.pending)
        D = t.Float64
        rest = [dr.fma(D(b), D(final["T"]), D(x)) for x, b in zip(final["sum"][:3], self.m.background, strict=True)]
        nothing = final["place"][0] == place[0]
        state = {"T": t.Float(1), "rest": rest, "alive": dr.select(alive & ~nothing, t.UInt32(1), 0)}
        return {**state, **self.sink.init()}

    def shade(self, index, rays, states, places, active):
        """One hit of each of `rays`."""
        return if_any_hit(self.m, self.source, index, rays, states, places, active, self._take)

    def _take(self, index, rays, states, places, active):
        m, t, rows, out = self.m, self.m.t, [], []
        D = t.Float64
        going = active & (sum((s["alive"] for s in states), t.UInt32(0)) != 0)
        loaded = self.source.load(t, index, rays[0], going, only=None if self.colors else "record")
        record, hits = loaded["record"], t.Bool(False)
        extra = self.geometry.load(index, going) if self.geometry else None
        for ray, st, final, place in zip(rays, states, self.finals, places, strict=True):
            a, _, ok = m.hit(record, ray, active & (st["alive"] != 0))
            T, left, new, at_end = st["T"], 1 - a, dict(st), ok
            w = dr.select(ok, T * a, 0)
            new["T"] = dr.select(ok, T * left, T)
            for p, q in zip(place, final["place"], strict=True):
                at_end = at_end & (p == q)
            new["alive"] = dr.select(at_end, 0, st["alive"])
            slopes = g = turned = None
            color = self.source.values(m, loaded, ray) if self.colors else None
            if self.geometry:
                rest = [r - D(w) * D(c) for r, c in zip(st["rest"], color, strict=True)]
                new["rest"] = [dr.select(ok, x, y) for x, y in zip(rest, st["rest"], strict=True)]
                share = dr.select(left > 0, dr.rcp(dr.select(left > 0, left, 1)), 0)
                g = [dr.select(ok, dr.fma(T, c, -t.Float(r) * share), 0) for c, r in zip(color, rest, strict=True)]
                moves = ok
                if m.s.alpha_max < 1 and m.s.alpha_max_gradient != "pass":
                    moves = ok & (a < m.alpha_max)
                # Far from the ellipsoid 0 times infinity is possible.
                slopes = [dr.select(moves, x, 0) for x in self.geometry.slopes(record, extra, ray)]
                if self.color:
                    turned = [[w * extra[_COLOR + 3 * c + j] for j in range(3)] for c in range(3)]
            rows.append(Row(slopes, g, w, turned, color, ray.lane[: ray.basis]))
            hits |= ok
            out.append(new)
        return self.sink.take(t, index, hits, rows, out)


def _entry(slopes, g, turned, j, c):
    """dC_c / d(geometry j)."""
    value = g[c] * slopes[j]
    return value + turned[c][j] if turned and j < 3 else value


class Diagonal:
    """Sums of squares into a buffer of `width` floats a Gaussian: geometry, sum w^2, then by band and channel.

    Args:
        weights: Of the channels.
        entries: Those that are wanted.
        bands: SH coefficients whose sums (w Y_k)^2 over the rays where a channel is not clamped are wanted as well:
            where SH are evaluated along each ray, they are no multiple of sum w^2.
        summed: Sum the channels before squaring, as FisherRF does.
    """

    def __init__(self, t, count: int, weights, entries, mode, bands: int = 0, summed: bool = False):
        self.width = GEOMETRY + 1 + 3 * bands
        self.buffer = dr.zeros(t.Float, count * self.width)
        self.weights, self.entries, self.mode, self.bands, self.summed = weights, entries, mode, bands, summed

    def init(self) -> dict:
        """Nothing is kept per ray."""
        return {}

    def take(self, t, index, hits, rows, states):
        """Add a hit's rows."""
        for k in self.entries:
            total = t.Float(0)
            for row in rows:
                if k == GEOMETRY:
                    total = dr.fma(row.w, row.w, total)
                else:
                    total += squares(row, k, self.weights, self.summed)
            dr.scatter_add(self.buffer, total, index * self.width + k, hits, mode=self.mode)
        for k in range(self.bands):
            for c in range(3):
                slopes = [dr.select(row.color[c] > 0, row.w * row.basis[k], 0) for row in rows]
                at = index * self.width + (GEOMETRY + 1 + 3 * k + c)
                dr.scatter_add(self.buffer, sum(x * x for x in slopes), at, hits, mode=self.mode)
        return states


def squares(row: Row, j: int, weights, summed=False):
    """sum_c weight_c (dC_c / d(geometry j))^2."""
    slopes, g, turned = row.slopes, row.g, row.turned
    if summed:
        value = sum(_entry(slopes, g, turned, j, c) for c in range(3))
        return value * value
    if turned and j < 3:
        entries = [_entry(slopes, g, turned, j, c) for c in range(3)]
        return sum(x * x * weight for x, weight in zip(entries, weights, strict=True))
    return slopes[j] * slopes[j] * sum(x * x * weight for x, weight in zip(g, weights, strict=True))


class Blocks:
    """Sums of outer products: the lower triangles of (13, 13), row by row; base colors follow the geometry."""

    SIZE = GEOMETRY + 3
    WIDTH = SIZE * (SIZE + 1) // 2

    def __init__(self, t, count: int, weights, mode):
        self.buffer = dr.zeros(t.Float, count * self.WIDTH)
        self.weights, self.mode = weights, mode

    def init(self) -> dict:
        """Nothing is kept per ray."""
        return {}

    def take(self, t, index, hits, rows, states):
        """Add a hit's rows."""
        full = []
        for row in rows:
            for c in range(3):
                entries = [_entry(row.slopes, row.g, row.turned, j, c) for j in range(GEOMETRY)]
                # d color / d sh_0, 0 where the color is clamped.
                lit = dr.select(row.color[c] > 0, row.w * float(layout._SH[0]), 0)
                full.append((self.weights[c], [*entries, *(lit if k == c else None for k in range(3))]))
        for i in range(self.SIZE):
            for j in range(i + 1):
                total = t.Float(0)
                for weight, entries in full:
                    if entries[i] is not None and entries[j] is not None:
                        total = dr.fma(weight * entries[i], entries[j], total)
                at = index * self.WIDTH + (i * (i + 1) // 2 + j)
                dr.scatter_add(self.buffer, total, at, hits, mode=self.mode)
        return states


class Variance:
    """Per pixel, the sum over parameters of squared derivatives times a weight of each.

    Args:
        buffer: 16 floats a Gaussian: the weights of the geometry, then of w^2 in each channel.
        weights: Of the channels.
        light: 3 K floats a Gaussian, the weights of SH that are evaluated along each ray, or None.
    """

    def __init__(self, buffer, weights, light=None):
        self.buffer, self.weights, self.light = buffer, weights, light

    def init(self) -> dict:
        """The sum along a ray."""
        return {"variance": type(self.buffer)(0)}

    def take(self, t, index, hits, rows, states):
        """Add a hit's rows to their rays."""
        v = list(dr.gather(t.ArrayXf, self.buffer, index, hits, shape=(16, dr.width(index))))
        out = []
        light = []
        if self.light is not None:
            K = len(rows[0].basis)
            light = [dr.gather(t.Float, self.light, index * (3 * K) + k, hits) for k in range(3 * K)]
        for row, state in zip(rows, states, strict=True):
            total = sum(v[j] * squares(row, j, self.weights) for j in range(GEOMETRY))
            shares = [v[GEOMETRY + c] for c in range(3)]
            for k, weight in enumerate(light):
                band, c = row.basis[k // 3], k % 3
                shares[c] = shares[c] + dr.select(row.color[c] > 0, band * band * weight, 0)
            total += row.w * row.w * sum(x * weight for x, weight in zip(shares, self.weights, strict=True))
            new = dict(state)
            new["variance"] = state["variance"] + total
            out.append(new)
        return out
