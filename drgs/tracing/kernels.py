"""What happens at one hit, and what compositing does with it.

`walk.py` decides which Gaussian a ray meets next; this module evaluates the hit from what is
stored of the Gaussian and updates the state of the ray. All of it runs inside Dr.Jit loops with AD suspended; the
derivative of a hit is taken by local AD inside the loop, so there is one formula a response.

    a     opacity of the hit            T     transmittance in front of it       w = a T   its weight

derivatives.py and jacobian.py replay what is composited here.
"""

from __future__ import annotations

import dataclasses

import drjit as dr

from drgs.tracing import projection as layout
from drgs.tracing.projection import RECORD, cross, dot

__all__ = ["Model", "Primal", "Ray", "Source", "load_packed", "pack", "packed_size"]


@dataclasses.dataclass
class Ray:
    """One ray a lane.

    Attributes:
        x, y: Pixel position, of a pinhole ray.
        length: |d| of that ray's direction with d_z = 1.
        lane: What a ray has that is differentiated: SH basis values (`basis` of them), then o and d of a world ray.
    """

    x: object = None
    y: object = None
    length: object = None
    lane: list = dataclasses.field(default_factory=list)
    basis: int = 0


class Model:
    """The response of a record along a ray, for given settings; `world` tells which kind of record."""

    def __init__(self, t, settings, world: bool = False):
        self.t, self.s, self.world = t, settings, world
        self.alpha_min = dr.opaque(t.Float, settings.alpha_min)
        self.alpha_max = dr.opaque(t.Float, settings.alpha_max)
        self.stop_at = dr.opaque(t.Float, settings.transmittance_min)
        self.max_hits = dr.opaque(t.UInt32, settings.max_hits or 0)
        self.background = [dr.opaque(t.Float, b) for b in settings.background]

    def slots(self, depth: bool) -> list[int]:
        """Entries of a record that carry a derivative; `depth` tells whether t* has a cotangent or tangent."""
        L = layout
        if self.world:
            return [*range(L.W_MEAN, L.W_ALPHA + 1), *range(L.W_RGB, L.W_RGB + 3)]
        used = [*range(L.R11, L.R23 + 1), L.ALPHA, *range(L.RGB, L.RGB + 3)]
        if self.s.response == "ewa":
            return used + ([L.H1] if depth else [])
        used += range(L.E2, L.E6 + 1)
        if self.s.response == "integral":
            return [*used, L.H1, L.H2, L.H3, L.NORM]
        return used + ([L.H1, L.H2, L.H3] if depth else [])

    def along(self, r, ray):
        """rho^2, t* and, for `integral`, u of a ray."""
        return self._along_world(r, ray) if self.world else self._along_screen(r, ray)

    def screen(self, r, ray):
        """Of a pinhole ray: the two parts of o' x d', d' in its own frame, and 1 / |d'|^2 (`ewa`: the first two)."""
        L = layout
        dx, dy = ray.x - r[L.AX], ray.y - r[L.AY]
        c1 = dr.fma(r[L.R11], dx, dr.fma(r[L.R12], dy, r[L.R13]))
        c2 = dr.fma(r[L.R21], dx, dr.fma(r[L.R22], dy, r[L.R23]))
        if self.s.response == "ewa":
            return c1, c2, None, None
        d1 = dr.fma(r[L.E2], dx, dr.fma(r[L.E3], dy, 1))
        d2 = dr.fma(r[L.E4], dx, r[L.E5] * dy)
        d3 = r[L.E6] * dy
        return c1, c2, [d1, d2, d3], dr.rcp(dr.fma(d1, d1, dr.fma(d2, d2, d3 * d3)))

    def _along_screen(self, r, ray):
        L = layout
        c1, c2, d, inverse = self.screen(r, ray)
        squared = dr.fma(c1, c1, c2 * c2)
        if self.s.response == "ewa":
            return squared, r[L.H1], None
        along = dr.fma(r[L.H1], d[0], dr.fma(r[L.H2], d[1], r[L.H3] * d[2]))
        u = r[L.NORM] * along * dr.sqrt(inverse) if self.s.response == "integral" else None
        return squared * inverse, along * inverse * ray.length, u

    def local(self, r, ray):
        """Of a ray o + t d in the world: t0, w = (o - mu) + t0 d and d in the local frame, and 1 / |d'|^2.

        t0, where the ray is nearest to the mean, is a constant of the derivative: it only moves the point about which
        the local frame is expanded, so that what is rounded is as small as the Gaussian's distance from the ray.
        """
        L = layout
        o, d = ray.lane[-6:-3], ray.lane[-3:]
        to = [r[L.W_MEAN + k] - o[k] for k in range(3)]
        t0 = dr.detach(dot(to, d))
        w = [dr.fma(t0, d[k], -to[k]) for k in range(3)]
        rows = [r[L.W_ROWS + 3 * k : L.W_ROWS + 3 * k + 3] for k in range(3)]
        a, d = ([dot(row, v) for row in rows] for v in (w, d))
        squared = dot(d, d)
        # Lanes without a candidate read zeros: 0 / 0 would spoil their (masked) derivatives.
        return t0, a, d, dr.rcp(dr.select(squared > 0, squared, 1))

    def _along_world(self, r, ray):
        t0, a, d, inverse = self.local(r, ray)
        c = cross(a, d)
        key = t0 - dot(a, d) * inverse
        u = None
        if self.s.response == "integral":
            # |d'|^2 is 0 where a scale is beyond 1e19: all that is in sight is then at u = 0.
            u = dr.select(dr.detach(dot(d, d)) > 0, key * dr.rsqrt(inverse), 0)
        return dot(c, c) * inverse, key, u

    def hit(self, record, ray, active):
        """Opacity, t* (for `ewa` the Gaussian's depth) and validity of a hit; the first two carry derivatives."""
        rho2, key, u = self.along(record, ray)
        strength = record[layout.W_ALPHA if self.world else layout.ALPHA]
        extent2 = dr.detach(record[layout.W_EXT2 if self.world else layout.EXT2])
        ok = active & (dr.detach(rho2) <= extent2)
        a = strength * dr.exp(-0.5 * rho2)
        if self.s.response == "integral":
            tau = a * (0.5 + 0.5 * dr.erf(u * 0.7071067811865476))
            # 1 - exp(-tau) rounds a small tau away; its series does not.
            series = tau * dr.fma(tau, dr.fma(tau, dr.fma(tau, -1 / 24, 1 / 6), -0.5), 1)
            a = dr.select(tau < 0.03, series, 1 - dr.exp(-tau))
        elif self.s.response == "peak":
            ok &= dr.detach(key) > 0
        if self.s.alpha_min > 0:
            ok &= dr.detach(a) >= self.alpha_min
        if self.s.alpha_max < 1:
            clamped = dr.minimum(a, self.alpha_max)
            a = dr.replace_grad(clamped, a) if self.s.alpha_max_gradient == "pass" else clamped
        return a, key, ok


@dataclasses.dataclass
class Source:
    """Flat buffers that hits read: records, SH along rays, and a slice of the feature channels.

    Attributes:
        buffers: Name -> Float. `record` has RECORD floats a Gaussian; `sh` 3 K, present when SH are evaluated along
            each ray; `features` has `width` and channels first .. first + channels are composited.
        color: The pass composites RGB.
    """

    buffers: dict
    width: int = 0
    first: int = 0
    channels: int = 0
    color: bool = True

    @property
    def outputs(self) -> int:
        """Channels that the pass composites."""
        return (3 if self.color else 0) + self.channels

    def layout(self, ray: Ray) -> dict:
        """Name -> (stride, offset, count) of what a hit reads."""
        table = {"record": (RECORD, 0, RECORD)}
        if self.color and ray.basis:
            table["sh"] = (3 * ray.basis, 0, 3 * ray.basis)
        if self.channels:
            table["features"] = (self.width, self.first, self.channels)
        return table

    def load(self, t, index, ray, active, buffers=None, only=None) -> dict:
        """What a hit of Gaussian `index` reads, name -> list of floats; from other buffers, or `only` of one name."""
        buffers, loaded = buffers or self.buffers, {}
        for name, (stride, offset, count) in self.layout(ray).items():
            if name not in buffers or (only and name != only):
                continue
            if name == "record":
                packet = dr.gather(t.ArrayXf, buffers[name], index, active, shape=(RECORD, dr.width(index)))
                loaded[name] = list(packet)
            else:
                base = index * stride + offset
                loaded[name] = [dr.gather(t.Float, buffers[name], base + k, active) for k in range(count)]
        return loaded

    def values(self, model, loaded, ray) -> list:
        """The channels of a hit: RGB, then the slice of features."""
        values = []
        if self.color and ray.basis:
            values += layout.sh_color(ray.lane[: ray.basis], lambda k, c: loaded["sh"][3 * k + c])
        elif self.color:
            first = layout.W_RGB if model.world else layout.RGB
            values += loaded["record"][first : first + 3]
        return values + loaded.get("features", [])


def packed_size(count: int) -> int:
    """Floats a Gaussian in a packed buffer of `count`: whole packets of 16."""
    return -(-count // 16) * 16


def pack(t, columns: list, count: int):
    """Interleave per-Gaussian floats: `packed_size(len(columns))` of each of `count` Gaussians together."""
    size, i, zero = packed_size(len(columns)), dr.arange(t.UInt32, count), dr.zeros(t.Float, count)
    buffer = dr.zeros(t.Float, count * size)
    columns = [x + zero for x in columns] + [zero] * (size - len(columns))
    for k in range(0, size, 16):
        dr.scatter(buffer, t.ArrayXf(columns[k : k + 16]), i * (size // 16) + k // 16)
    return buffer


def load_packed(t, buffer, size: int, index, active) -> list:
    """The `size` floats of a Gaussian."""
    values = []
    for k in range(size // 16):
        values += list(dr.gather(t.ArrayXf, buffer, index * (size // 16) + k, active, shape=(16, dr.width(index))))
    return values


class Primal:
    """Front-to-back compositing of `source.outputs` channels.

    Args:
        want: What to keep besides color and T: `depth`, `median`, `count`, and `replay`: sums in float64 and the place
            of the last composited hit, for the adjoint.
        visibility: Float of width N that the weights are added to, or None.
    """

    def __init__(self, model: Model, source: Source, want: frozenset, visibility=None):
        self.m, self.source, self.want, self.visibility = model, source, want, visibility

    def init(self, alive, place) -> dict:
        """State of a ray; `place` is the order's "nowhere"."""
        t = self.m.t
        Sum = t.Float64 if "replay" in self.want else t.Float
        state = {
            "T": t.Float(1),
            "alpha": Sum(0),
            "sum": [Sum(0) for _ in range(self.source.outputs)],
            "alive": dr.select(alive, t.UInt32(1), 0),
        }
        for name in ("depth", "median"):
            if name in self.want:
                state[name] = Sum(0) if name == "depth" else t.Float(0)
        if "count" in self.want or self.m.s.max_hits:
            state["count"] = t.UInt32(0)
        if "replay" in self.want:
            state["place"] = [type(x)(x) for x in place]
        return state

    def shade(self, index, rays, states, places, active):
        """Composite Gaussian `index` onto each of `rays`; places[k] is where the hit stands in the order."""
        m, out = self.m, []
        any_active = active & (sum((s["alive"] for s in states), m.t.UInt32(0)) != 0)
        loaded = self.source.load(m.t, index, rays[0], any_active)
        for ray, st, place in zip(rays, states, places, strict=True):
            a, depth, ok = m.hit(loaded["record"], ray, active & (st["alive"] != 0))
            T, rest = st["T"], st["T"] * (1 - a)
            if m.s.stop == "after":
                done = ok & (rest < m.stop_at)
            else:
                done = ok & ((rest < m.stop_at) if m.s.stop == "before" else (rest <= m.stop_at))
                ok &= ~done
            w = dr.select(ok, T * a, 0)
            new = dict(st)  # a loop state keeps its order of keys
            new["T"], new["alive"] = dr.select(ok, rest, T), dr.select(done, 0, st["alive"])
            values = self.source.values(m, loaded, ray)
            new["sum"] = [_add(w, v, s) for v, s in zip(values, st["sum"], strict=True)]
            # Not 1 - T, which rounds a thin veil away.
            new["alpha"] = st["alpha"] + type(st["alpha"])(w)
            if "depth" in st:
                new["depth"] = _add(w, depth, st["depth"])
            if "median" in st:
                new["median"] = dr.select(ok & (T > 0.5) & (rest <= 0.5), depth, st["median"])
            if "count" in st:
                new["count"] = st["count"] + dr.select(ok, m.t.UInt32(1), 0)
                if m.s.max_hits:
                    new["alive"] = dr.select(new["count"] >= m.max_hits, 0, new["alive"])
            if "place" in st:
                new["place"] = [dr.select(ok, p, q) for p, q in zip(place, st["place"], strict=True)]
            if self.visibility is not None:
                dr.scatter_add(self.visibility, w, index, ok)
            out.append(new)
        return out


def _add(w, value, total):
    """total + w value in the precision of `total`."""
    Sum = type(total)
    return dr.fma(Sum(w), Sum(value), total)
