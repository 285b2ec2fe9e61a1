"""Derivatives of the compositing of a ray: the adjoint, a replay of it, and forward mode, which goes along with it.

    a, T, w as in kernels.py
    s_i   derivative of the loss with respect to w_i: cotangent . (color, features, 1, depth)
    b_i   what lies behind hit i, per unit of transmittance

The image is C = sum_i w_i c_i + T_end background with w_i = a_i T_i, T_i = prod_{j<i} (1 - a_j) (Kerbl et al. 2023), so
that dw_i/da_i = T_i, and every w_j behind i, as T_end, has the factor 1 - a_i: dw_j/da_i = -w_j / (1 - a_i). Hence

    dL/da_i = T_i (s_i - b_i) = T_i s_i - R_i / (1 - a_i),  R_i = sum_{j > i} w_j s_j + T_end (cotangent . background)

where R_i is what is left of the whole sum behind hit i. Replaying the loop instead of storing its hits is path replay
backpropagation (Vicini et al. 2021), which has R_i as the whole sum minus what the ray has passed. In float32 this
difference loses all digits as a -> 1 or T -> 0. Sums are therefore kept in float64 in the primal pass, and the adjoint
replays the very same float32 weights: the difference is then exact to 1e-16 of the sum, which leaves 1e-9 even at
1 - a = 1e-7 (docs/numerics.md has the measured errors).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import drjit as dr

from drgs.tracing.arrays import Float, Mask, UInt32
from drgs.tracing.harmonics import sh_color
from drgs.tracing.hit_table import HitReplay, Table
from drgs.tracing.kernels import Channels, Emit, HitModel, Primal
from drgs.tracing.primitives import Ray
from drgs.tracing.records import load_packed, packed_size
from drgs.tracing.sums import add_row

Gradient = tuple[dict[int, Float], list[Float]]  # of one hit: by entry of its record, and by what the ray carries


class Adjoint(HitReplay):
    """Replay of a primal pass that scatters the gradient into the records, SH and features that each hit reads.

    Args:
        model, channels, finals, table: As of a `HitReplay`; the table is filled for these cotangents.
        grads: Buffers like `channels.buffers`, added to.
        cotangents: Cotangents of each shared ray: `sum` (a float a channel), `alpha` (of sum w), `depth` (of sum w t*).
        depth: There is a depth cotangent.
        scalar: What the features add to s: `scalar(shared ray, place, is hit)`; None without features here. The
            cotangents then have `rest`, the sum of it over the ray's weights.
        absolute: (2 N) added to: |dL / d projected mean| of each hit, in x and y, of a model of the image plane.
    """

    def __init__(
        self,
        model: HitModel,
        channels: Channels,
        grads: dict,
        finals: list,
        cotangents: list,
        depth: bool,
        mode: dr.ReduceMode,
        scalar: Callable[[int, list, Mask], Float] | None = None,
        table: Table | None = None,
        absolute: Float | None = None,
    ) -> None:
        super().__init__(model, channels, finals, table)
        self.absolute = absolute
        self.grads = grads
        self.mode = mode
        self.scalar = scalar
        self.cotangents = cotangents
        self.slots = set(model.slots(depth))

    def rest(self, k: int) -> list[Float]:
        """The whole sum of shared ray k, of which each hit takes its own."""
        D = self.m.lib.Float64
        final = self.finals[k]
        g = self.cotangents[k]
        rest = D(final["depth"]) * D(g["depth"]) if "depth" in final else D(0)
        rest = dr.fma(D(g["alpha"]), D(final["alpha"]), rest)
        for x, c in zip(final["sum"], g["sum"], strict=True):
            rest = dr.fma(D(x), D(c), rest)
        if self.channels.color:
            for c, background in zip(g["sum"][:3], self.m.background, strict=True):
                rest = dr.fma(D(c * background), D(final["T"]), rest)
        return [rest + g["rest"] if self.scalar is not None else rest]

    def terms(self, k: int, values: list[Float], depth: Float, place: list, ok: Mask) -> list[Float]:
        """s of a hit of shared ray k."""
        D, g = self.m.lib.Float64, self.cotangents[k]
        s = dr.fma(D(g["depth"]), D(dr.detach(depth)), D(g["alpha"]))  # a weight of the derivative: a number
        for v, c in zip(values, g["sum"], strict=True):
            s = dr.fma(D(dr.detach(v)), D(c), s)  # likewise
        return [s if self.scalar is None else s + D(self.scalar(k, place, ok))]

    def init(self, k: int, alive: Mask, nowhere: Float | UInt32) -> dict:
        """State of shared ray k; `carried` collects the gradient of what the ray itself carries."""
        state, alive = self.begun(k, alive, nowhere)
        carried = [self.m.lib.Float(0) for _ in range(self.cotangents[k]["carried"])]
        return {"carried": carried} | state | {"alive": dr.select(alive, self.m.lib.UInt32(1), 0)}

    def take(
        self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask, record: Any
    ) -> list[dict]:
        """One hit of each ray: its local derivative by AD, weighted with dL/da and with w times the cotangents."""
        m = self.m
        lib = self.m.lib
        out = []
        going = self.going(states, active)
        with dr.resume_grad():
            # A graph of this hit only, from leaves of its own: the walk has suspended AD.
            loaded = self.channels.load(lib, index, rays[0], going, record=record)
            fixed = {name: [dr.detach(x) for x in xs] for name, xs in loaded.items()}
            dr.enable_grad(fixed)
            total = lib.Float(0)
            hits = lib.Bool(False)
            carried = []
            moved = [lib.Float(0)] * 2
            for number, (ray, st, place) in enumerate(zip(rays, states, places, strict=True)):
                g = self.cotangents[number]
                ray = dataclasses.replace(ray, carried=[dr.detach(x) for x in ray.carried])  # leaves, too
                dr.enable_grad(ray.carried)
                carried.append(ray.carried)
                a, depth, ok = m.hit(fixed["record"], ray, active & (st["alive"] != 0))
                values = self.channels.values(m, fixed, ray)
                # Weights of the local derivative are numbers.
                a0 = dr.detach(a)
                (s,) = self.terms(number, values, depth, place, ok)
                T, w, (behind,), new, ok = self.replayed(number, st, a0, [s], place, ok)
                slope = dr.fma(T, lib.Float(s), -behind)
                local = dr.fma(slope, a, w * g["depth"] * depth)
                if self.absolute is not None:
                    moved = [
                        m + dr.select(ok, x, 0) for m, x in zip(moved, self._moves(slope, fixed, ray), strict=True)
                    ]
                for v, c in zip(values, g["sum"], strict=True):
                    local = dr.fma(w * c, v, local)
                total += dr.select(ok, local, 0)
                hits |= ok
                out.append(new)
            dr.backward_from(total)
            grads = {name: [dr.grad(x) for x in xs] for name, xs in fixed.items()}
            for new, own in zip(out, carried, strict=True):
                new["carried"] = [x + dr.grad(y) for x, y in zip(new["carried"], own, strict=True)]
        if self.absolute is not None:
            add_row(lib, self.absolute, moved, index, 2, 0, hits, self.mode)
        for name, (stride, offset, _) in self.channels.layout(rays[0]).items():
            own = [x if name != "record" or k in self.slots else None for k, x in enumerate(grads[name])]
            add_row(lib, self.grads[name], own, index, stride, offset, hits, self.mode)
        return out

    def _moves(self, slope: Float, fixed: dict, ray: Ray) -> list[Float]:
        """|dL / d projected mean| of a hit with dL/da = `slope`; 0 where a clamp ends the derivative of its opacity."""
        record = dr.detach(fixed["record"])  # numbers: the derivative is written out
        s = self.m.s
        free = self.m.lib.Bool(True)
        if s.alpha_max < 1 and s.alpha_max_gradient == "zero":
            rho2, _, u = self.m.response.along(record, ray, self.m.world)
            free = self.m.response.opacity(record[self.m.strength] * dr.exp(-0.5 * rho2), u) < self.m.alpha_max
        response: Any = self.m.response  # a model of the image plane: no other has projected means
        moves = response.moves(record, ray)
        return [dr.select(free, abs(dr.detach(slope) * x), 0) for x in moves]  # as above


class Tangent:
    """Forward mode: K tangents carried through one front-to-back traversal.

    The product rule along the ray: dw = dT a + T da, then dT <- dT (1 - a) - T da, and d sum w v gets dw v + w dv.

    Args:
        records: Tangents of the records, from `pack`: slot by slot, the K columns of each side by side.
        slots: Entries of a record that they hold.
        tangents: K dicts of buffers laid out like those of `channels.buffers` besides the records.
        carried: Tangents of what each shared ray carries.
        emits: Called with the tangent of every weight, one for each tangent, as `Primal.emit` is with the weight; None
            or empty: nothing is called.
    """

    def __init__(
        self,
        primal: Primal,
        records: Float,
        slots: list[int],
        tangents: list[dict],
        carried: list[list],
        emits: list[Emit | None] | None = None,
    ) -> None:
        self.primal = primal
        self.m = primal.m
        self.channels = primal.channels
        self.emits = emits
        self.records = records
        self.slots = slots
        self.tangents = tangents
        self.carried = carried

    def init(self, k: int, alive: Mask, nowhere: Float | UInt32) -> dict:
        """State of a ray: the primal's, and `d` with a tangent of it for each column."""
        lib = self.m.lib
        state = self.primal.init(k, alive, nowhere)
        names = ["T", *(["depth"] if "depth" in state else [])]  # sum w is 1 - T
        state["d"] = [
            {**{n: lib.Float(0) for n in names}, "sum": [lib.Float(0) for _ in range(self.channels.outputs)]}
            for _ in self.tangents
        ]
        return state

    def shade(self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask) -> list[dict]:
        """What `Primal.shade` does, with the tangents."""
        m, lib = self.m, self.m.lib
        going = active & (sum((s["alive"] for s in states), lib.UInt32(0)) != 0)
        # Nothing of the loop is recorded; `_slopes` and `_moved_values` differentiate on their own.
        loaded = dr.detach(self.channels.load(lib, index, rays[0], going))
        speeds = self._load(index, rays[0], going)
        primal = [{k: v for k, v in st.items() if k != "d"} for st in states]
        out = self.primal.shade(index, rays, primal, places, active)
        shared = zip(rays, self.carried, states, out, places, strict=True)
        for number, (ray, moving, st, new, place) in enumerate(shared):
            live = active & (st["alive"] != 0)
            # The primal wrote what it decided: the weight is what T lost, and 0 where there was no hit.
            a0, depth0, ok = m.hit(loaded["record"], ray, live)
            if m.s.max_hits:  # a ray's last hit counts, and ends it
                ok &= new["count"] != st["count"]
            elif m.s.stop != "after":
                ok &= new["alive"] != 0
            T = st["T"]
            w = dr.select(ok, st["T"] * a0, 0)
            values0 = self.channels.values(m, loaded, ray)
            # One gradient of the hit serves all columns.
            slopes = [self._slopes(loaded["record"], ray, live, k) for k in range(2 if "depth" in new else 1)]
            new["d"] = []
            for column, (speed, moved, old) in enumerate(zip(speeds, moving, st["d"], strict=True)):
                da = dr.select(ok, _along(slopes[0], speed["record"], moved), 0)
                dvalues = self._moved_values(loaded, speed, ray, moved)
                dw = dr.fma(old["T"], dr.select(ok, a0, 0), T * da)
                if self.emits and (emit := self.emits[column]) is not None:
                    emit(index, number, place, dw, ok)
                fresh = dict(old)
                fresh["T"] = dr.select(ok, old["T"] * (1 - a0), old["T"]) - T * da
                fresh["sum"] = [
                    dr.fma(dw, v, dr.fma(w, dv, s)) for v, dv, s in zip(values0, dvalues, old["sum"], strict=True)
                ]
                if "depth" in old:
                    ddepth = dr.select(ok, _along(slopes[1], speed["record"], moved), 0)
                    fresh["depth"] = dr.fma(dw, dr.select(ok, depth0, 0), dr.fma(w, ddepth, old["depth"]))
                new["d"].append(fresh)
        return out

    def _load(self, index: UInt32, ray: Ray, active: Mask) -> list[dict]:
        """Tangents of what a hit reads, by column."""
        lib = self.m.lib
        count = len(self.tangents)
        flat = load_packed(lib, self.records, packed_size(len(self.slots) * count), index, active)
        speeds = [self.channels.load(lib, index, ray, active, tangent) for tangent in self.tangents]
        for k, speed in enumerate(speeds):
            speed["record"] = {slot: flat[j * count + k] for j, slot in enumerate(self.slots)}
        return speeds

    def _slopes(self, record: list[Float], ray: Ray, live: Mask, which: int) -> Gradient:
        """Gradient of a hit's opacity (0) or depth (1): {slot: value}, and of what the ray carries."""
        with dr.resume_grad():
            # A graph of this hit only, from leaves of its own: the walk has suspended AD.
            record = [dr.detach(x) for x in record]
            ray = dataclasses.replace(ray, carried=[dr.detach(x) for x in ray.carried])
            dr.enable_grad(record, ray.carried)
            dr.backward_from(self.m.hit(record, ray, live)[which])
            return {k: dr.grad(record[k]) for k in self.slots}, [dr.grad(x) for x in ray.carried]

    def _moved_values(self, loaded: dict, speed: dict, ray: Ray, carried: list[Float]) -> list[Float]:
        """Tangents of the channels of a hit."""
        if not (self.channels.color and ray.basis):
            color = [speed["record"][self.m.rgb + c] for c in range(3)] if self.channels.color else []
            return color + speed.get("features", [])
        # A graph of this color only, from leaves of its own.
        with dr.resume_grad():
            moved = [dr.detach(x) for x in loaded["sh"]]
            basis = [dr.detach(x) for x in ray.carried[: ray.basis]]  # leaves, too
            dr.enable_grad(moved, basis)
            for x, v in zip(moved + basis, speed["sh"] + carried[: ray.basis], strict=True):
                dr.set_grad(x, v)
            color = sh_color(basis, lambda k, c: moved[3 * k + c])
            dr.forward_to(color)
            features = speed.get("features", [])
            if self.channels.oriented:
                features = self.channels.towards(loaded["features"], features, ray)
            return [dr.grad(x) for x in color] + features


def _along(slopes: Gradient, record: dict, carried: list[Float]) -> Float:
    """A gradient times a tangent."""
    of_record, of_ray = slopes
    return sum(x * record[k] for k, x in of_record.items()) + sum(x * v for x, v in zip(of_ray, carried, strict=True))
