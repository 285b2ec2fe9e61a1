"""What happens at one hit, and what compositing does with it: primal, adjoint and forward mode.

The traversals (`tiles.py`, `bvh.py`) decide which Gaussian a ray meets next; this module evaluates the hit from what is
stored of the Gaussian and updates the state of the ray. All of it runs inside Dr.Jit loops with AD suspended; the
derivative of a hit is taken by local AD inside the loop, so there is one formula a response.

    a     opacity of the hit            T     transmittance in front of it       w = a T   its weight
    s_i   derivative of the loss with respect to w_i: cotangent . (color, features, 1, depth)
    b_i   what lies behind hit i, per unit of transmittance

dL/da_i = T_i (s_i - b_i) = T_i s_i - R_i / (1 - a_i), where R_i = sum_{j > i} w_j s_j + T_end (cotangent . background)
is what is left of the whole sum behind hit i. In float32 this difference loses all digits as a -> 1 or T -> 0. Sums are
therefore kept in float64 in the primal pass, and the adjoint replays the very same float32 weights: the difference is
then exact to 1e-16 of the sum, which leaves 1e-9 even at 1 - a = 1e-7 (docs/numerics.md has the measured errors).
"""

from __future__ import annotations

import dataclasses

import drjit as dr

from drgs import projection as layout
from drgs.projection import RECORD

__all__ = [
    "Adjoint",
    "Model",
    "Primal",
    "Ray",
    "Source",
    "Tangent",
    "if_any_hit",
    "load_packed",
    "pack",
    "packed_size",
]


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

    def _screen(self, r, ray):
        """rho^2, t*, u of a pinhole ray through pixel (x, y)."""
        L = layout
        dx, dy = ray.x - r[L.AX], ray.y - r[L.AY]
        c1 = dr.fma(r[L.R11], dx, dr.fma(r[L.R12], dy, r[L.R13]))
        c2 = dr.fma(r[L.R21], dx, dr.fma(r[L.R22], dy, r[L.R23]))
        if self.s.response == "ewa":
            return dr.fma(c1, c1, c2 * c2), r[L.H1], None
        d1 = dr.fma(r[L.E2], dx, dr.fma(r[L.E3], dy, 1))
        d2 = dr.fma(r[L.E4], dx, r[L.E5] * dy)
        d3 = r[L.E6] * dy
        inverse = dr.rcp(dr.fma(d1, d1, dr.fma(d2, d2, d3 * d3)))
        rho2 = dr.fma(c1, c1, c2 * c2) * inverse
        along = dr.fma(r[L.H1], d1, dr.fma(r[L.H2], d2, r[L.H3] * d3))
        u = r[L.NORM] * along * dr.sqrt(inverse) if self.s.response == "integral" else None
        return rho2, along * inverse * ray.length, u

    def _world(self, r, ray):
        """The same along o + t d in the world: w = (o - mu) + t0 d first, then the local frame.

        t0, where the ray is nearest to the mean, is a constant of the derivative: it only moves the point about which
        the local frame is expanded, so that what is rounded is as small as the Gaussian's distance from the ray.
        """
        L = layout
        o, d = ray.lane[-6:-3], ray.lane[-3:]
        to = [r[L.W_MEAN + k] - o[k] for k in range(3)]
        t0 = dr.detach(to[0] * d[0] + to[1] * d[1] + to[2] * d[2])
        w = [dr.fma(t0, d[k], -to[k]) for k in range(3)]
        m = [r[L.W_ROWS + k] for k in range(9)]
        (a0, a1, a2), (d0, d1, d2) = (
            [m[3 * k] * v[0] + m[3 * k + 1] * v[1] + m[3 * k + 2] * v[2] for k in range(3)] for v in (w, d)
        )
        c = (a1 * d2 - a2 * d1, a2 * d0 - a0 * d2, a0 * d1 - a1 * d0)
        squared = d0 * d0 + d1 * d1 + d2 * d2
        # Lanes without a candidate read zeros: 0 / 0 would spoil their (masked) derivatives.
        inverse = dr.rcp(dr.select(squared > 0, squared, 1))
        rho2 = (c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) * inverse
        key = t0 - (a0 * d0 + a1 * d1 + a2 * d2) * inverse
        u = key * dr.rsqrt(inverse) if self.s.response == "integral" else None
        return rho2, key, u

    def hit(self, record, ray, active):
        """Opacity, t* (for `ewa` the Gaussian's depth) and validity of a hit; the first two carry derivatives."""
        rho2, key, u = self._world(record, ray) if self.world else self._screen(record, ray)
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
        if "count" in self.want:
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


def if_any_hit(model, source, index, rays, states, places, active, take):
    """`take(index, rays, states, places, active)` where a ray of the packet meets the Gaussian, else the same states.

    Most Gaussians of a tile's list miss most packets of its rays, and the branch is cheaper than what it skips.
    """
    t = model.t
    going = active & (sum((s["alive"] for s in states), t.UInt32(0)) != 0)
    record = source.load(t, index, rays[0], going, only="record")["record"]
    hits = t.Bool(False)
    for ray, st in zip(rays, states, strict=True):
        hits |= model.hit(record, ray, active & (st["alive"] != 0))[2]
    return dr.if_stmt(
        (states, index, rays, places, active),
        hits,
        lambda states, index, rays, places, active: take(index, rays, states, places, active),
        lambda states, *_: states,
    )


class Adjoint:
    """Replay of a primal pass that scatters the gradient of what every hit reads.

    Args:
        grads: Buffers like `source.buffers`, added to.
        finals: Per shared ray, the final state of the Primal pass.
        cotangents: Per shared ray: `sum` (a float a channel), `alpha` (of sum w), `depth` (of sum w t*).
        depth: There is a depth cotangent.
    """

    def __init__(self, model: Model, source: Source, grads: dict, finals: list, cotangents: list, depth: bool, mode):
        self.m, self.source, self.grads, self.mode = model, source, grads, mode
        self.finals, self.cotangents, self.slots = finals, cotangents, set(model.slots(depth))
        self.pending = iter(zip(finals, cotangents, strict=True))

    def init(self, alive, place) -> dict:
        """State of the next shared ray; `lane` collects the gradient of what the ray itself carries."""
        t, (final, g) = self.m.t, next(self.pending)
        D = t.Float64
        rest = D(final["depth"]) * D(g["depth"]) if "depth" in final else D(0)
        rest = dr.fma(D(g["alpha"]), D(final["alpha"]), rest)
        for x, c in zip(final["sum"], g["sum"], strict=True):
            rest = dr.fma(D(x), D(c), rest)
        if self.source.color:
            for c, background in zip(g["sum"][:3], self.m.background, strict=True):
                rest = dr.fma(D(c * background), D(final["T"]), rest)
        nothing = final["place"][0] == place[0]
        return {
            "T": t.Float(1),
            "rest": rest,
            "alive": dr.select(alive & ~nothing, t.UInt32(1), 0),
            "lane": [t.Float(0) for _ in range(g["lanes"])],
        }

    def shade(self, index, rays, states, places, active):
        """Back-propagate through Gaussian `index` what the primal pass composited of it."""
        return if_any_hit(self.m, self.source, index, rays, states, places, active, self._take)

    def _take(self, index, rays, states, places, active):
        m, t, out = self.m, self.m.t, []
        D = t.Float64
        going = active & (sum((s["alive"] for s in states), t.UInt32(0)) != 0)
        with dr.resume_grad():
            fixed = {
                name: [dr.detach(x) for x in xs] for name, xs in self.source.load(t, index, rays[0], going).items()
            }
            dr.enable_grad(fixed)
            total, hits, lanes = t.Float(0), t.Bool(False), []
            for ray, st, g, final, place in zip(rays, states, self.cotangents, self.finals, places, strict=True):
                ray = dataclasses.replace(ray, lane=[dr.detach(x) for x in ray.lane])
                dr.enable_grad(ray.lane)
                lanes.append(ray.lane)
                a, depth, ok = m.hit(fixed["record"], ray, active & (st["alive"] != 0))
                values = self.source.values(m, fixed, ray)
                a0, depth0, T = dr.detach(a), dr.detach(depth), st["T"]
                w = dr.select(ok, T * a0, 0)
                s = dr.fma(D(g["depth"]), D(depth0), D(g["alpha"]))
                for v, c in zip(values, g["sum"], strict=True):
                    s = dr.fma(D(dr.detach(v)), D(c), s)
                rest = st["rest"] - D(w) * s
                left = 1 - a0
                # Behind an a that rounds to 1 nothing was composited: there is no rest to share out.
                behind = dr.select(left > 0, t.Float(rest) / dr.select(left > 0, left, 1), 0)
                local = dr.fma(dr.fma(T, t.Float(s), -behind), a, w * g["depth"] * depth)
                for v, c in zip(values, g["sum"], strict=True):
                    local = dr.fma(w * c, v, local)
                total += dr.select(ok, local, 0)
                hits |= ok
                new = dict(st)
                new["T"], new["rest"] = dr.select(ok, T * left, T), dr.select(ok, rest, st["rest"])
                # The last composited hit ends the ray, whatever rule ended the primal pass.
                at_end = ok
                for p, q in zip(place, final["place"], strict=True):
                    at_end = at_end & (p == q)
                new["alive"] = dr.select(at_end, 0, st["alive"])
                out.append(new)
            dr.backward_from(total)
            grads = {name: [dr.grad(x) for x in xs] for name, xs in fixed.items()}
            for new, lane in zip(out, lanes, strict=True):
                new["lane"] = [x + dr.grad(y) for x, y in zip(new["lane"], lane, strict=True)]
        for name, (stride, offset, count) in self.source.layout(rays[0]).items():
            for k in range(count):
                if name != "record" or k in self.slots:
                    at = index * stride + offset + k
                    dr.scatter_add(self.grads[name], grads[name][k], at, hits, mode=self.mode)
        return out


class Tangent:
    """Forward mode: K tangents carried through one front-to-back traversal.

    Args:
        records: Tangents of the records, from `pack`: slot by slot, the K columns of each side by side.
        slots: Entries of a record that they hold.
        tangents: K dicts of buffers laid out like those of `source.buffers` besides the records.
        lanes: Per shared ray and tangent, the tangent of the ray's `lane`.
    """

    def __init__(self, primal: Primal, records, slots: list[int], tangents: list[dict], lanes: list[list]):
        self.primal, self.m, self.source = primal, primal.m, primal.source
        self.records, self.slots, self.tangents, self.lanes = records, slots, tangents, lanes

    def init(self, alive, place) -> dict:
        """State of a ray: the primal's, and `d` with a tangent of it for each column."""
        t, state = self.m.t, self.primal.init(alive, place)
        names = ["T", *(["depth"] if "depth" in state else [])]  # sum w is 1 - T
        state["d"] = [
            {**{n: t.Float(0) for n in names}, "sum": [t.Float(0) for _ in range(self.source.outputs)]}
            for _ in self.tangents
        ]
        return state

    def shade(self, index, rays, states, places, active):
        """As Primal.shade, with the tangents."""
        m, t = self.m, self.m.t
        going = active & (sum((s["alive"] for s in states), t.UInt32(0)) != 0)
        loaded = dr.detach(self.source.load(t, index, rays[0], going))
        speeds = self._load(index, rays[0], going)
        primal = [{k: v for k, v in st.items() if k != "d"} for st in states]
        out = self.primal.shade(index, rays, primal, places, active)
        for ray, lanes, st, new in zip(rays, self.lanes, states, out, strict=True):
            live = active & (st["alive"] != 0)
            # The primal wrote what it decided: the weight is what T lost, and 0 where there was no hit.
            a0, depth0, ok = m.hit(loaded["record"], ray, live)
            if m.s.stop != "after":
                ok &= new["alive"] != 0
            T, w = st["T"], dr.select(ok, st["T"] * a0, 0)
            values0 = self.source.values(m, loaded, ray)
            # One gradient of the hit serves all columns.
            slopes = [self._slopes(loaded["record"], ray, live, k) for k in range(2 if "depth" in new else 1)]
            new["d"] = []
            for speed, lane, old in zip(speeds, lanes, st["d"], strict=True):
                da = dr.select(ok, _along(slopes[0], speed["record"], lane), 0)
                dvalues = self._moved_values(loaded, speed, ray, lane)
                dw = dr.fma(old["T"], dr.select(ok, a0, 0), T * da)
                fresh = dict(old)
                fresh["T"] = dr.select(ok, old["T"] * (1 - a0), old["T"]) - T * da
                fresh["sum"] = [
                    dr.fma(dw, v, dr.fma(w, dv, s)) for v, dv, s in zip(values0, dvalues, old["sum"], strict=True)
                ]
                if "depth" in old:
                    ddepth = dr.select(ok, _along(slopes[1], speed["record"], lane), 0)
                    fresh["depth"] = dr.fma(dw, dr.select(ok, depth0, 0), dr.fma(w, ddepth, old["depth"]))
                new["d"].append(fresh)
        return out

    def _load(self, index, ray, active) -> list[dict]:
        """Tangents of what a hit reads, by column."""
        t, count = self.m.t, len(self.tangents)
        flat = load_packed(t, self.records, packed_size(len(self.slots) * count), index, active)
        speeds = [self.source.load(t, index, ray, active, tangent) for tangent in self.tangents]
        for k, speed in enumerate(speeds):
            speed["record"] = {slot: flat[j * count + k] for j, slot in enumerate(self.slots)}
        return speeds

    def _slopes(self, record, ray, live, which: int):
        """Gradient of a hit's opacity (0) or depth (1): {slot: value}, and of what the ray carries."""
        with dr.resume_grad():
            record = [dr.detach(x) for x in record]
            ray = dataclasses.replace(ray, lane=[dr.detach(x) for x in ray.lane])
            dr.enable_grad(record, ray.lane)
            dr.backward_from(self.m.hit(record, ray, live)[which])
            return {k: dr.grad(record[k]) for k in self.slots}, [dr.grad(x) for x in ray.lane]

    def _moved_values(self, loaded, speed, ray, lane) -> list:
        """Tangents of the channels of a hit."""
        if not (self.source.color and ray.basis):
            first = layout.W_RGB if self.m.world else layout.RGB
            color = [speed["record"][first + c] for c in range(3)] if self.source.color else []
            return color + speed.get("features", [])
        with dr.resume_grad():
            moved = [dr.detach(x) for x in loaded["sh"]]
            basis = [dr.detach(x) for x in ray.lane[: ray.basis]]
            dr.enable_grad(moved, basis)
            for x, v in zip(moved + basis, speed["sh"] + lane[: ray.basis], strict=True):
                dr.set_grad(x, v)
            color = layout.sh_color(basis, lambda k, c: moved[3 * k + c])
            dr.forward_to(color)
            return [dr.grad(x) for x in color] + speed.get("features", [])


def _along(slopes, record, lane):
    """A gradient times a tangent."""
    of_record, of_lane = slopes
    return sum(x * record[k] for k, x in of_record.items()) + sum(x * v for x, v in zip(of_lane, lane, strict=True))
