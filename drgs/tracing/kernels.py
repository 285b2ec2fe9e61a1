"""The kernel of a primal pass: the opacity of one hit, and its compositing.

`walk.py` decides which Gaussian a ray meets next; this module evaluates the hit from what is
stored of the Gaussian and updates the state of the ray. All of it runs inside Dr.Jit loops with AD suspended; the
derivative of a hit is taken by local AD inside the loop, so there is one formula a response (responses.py).

    a     opacity of the hit            T     transmittance in front of it       w = a T   its weight

derivatives.py and jacobian.py replay what is composited here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import drjit as dr

from drgs.settings import RenderSettings
from drgs.tracing import records as layout
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.harmonics import sh_color
from drgs.tracing.primitives import Ray
from drgs.tracing.records import RECORD, load_record
from drgs.tracing.responses import response_of

Emit = Callable[[UInt32, int, list, Float, Mask], None]


class HitNumbers(NamedTuple):
    """Numbers of settings, of width 1 and opaque: another value is no other kernel."""

    alpha_min: Float
    alpha_max: Float
    stop_at: Float
    max_hits: UInt32
    background: list[Float]


def numbers_of(lib: Lib, settings: RenderSettings) -> HitNumbers:
    """The numbers of settings that hits are compared and composited with."""
    return HitNumbers(
        dr.opaque(lib.Float, settings.alpha_min),
        dr.opaque(lib.Float, settings.alpha_max),
        dr.opaque(lib.Float, settings.least_transmittance),
        dr.opaque(lib.UInt32, settings.max_hits or 0),
        [dr.opaque(lib.Float, b) for b in settings.background],
    )


class HitModel:
    """Opacity and depth of hits, for given settings: the response of a record along a ray, and the cut-offs.

    Attributes:
        response: The settings' `Response`.
        world: Records are world records.
        signed: Keys that order hits along a ray may be negative: entries, and peaks behind the origin of a ray where
            these count.

    Args:
        numbers: Those of the settings, if they are held already.
    """

    def __init__(
        self, lib: Lib, settings: RenderSettings, world: bool = False, numbers: HitNumbers | None = None
    ) -> None:
        self.lib = lib
        self.s = settings
        self.world = world
        self.response = response_of(settings)
        self.signed = settings.order == "entry" or (settings.order == "ray" and not self.response.front_only)
        self.alpha_min, self.alpha_max, self.stop_at, self.max_hits, self.background = numbers or numbers_of(
            lib, settings
        )
        self.strength = layout.W_ALPHA if world else layout.ALPHA  # places in a record
        self.extent2 = layout.W_EXT2 if world else layout.EXT2
        self.rgb = layout.W_RGB if world else layout.RGB

    def slots(self, depth: bool) -> list[int]:
        """Entries of a record that carry a derivative; `depth`: whether t* has a cotangent or tangent."""
        return self.response.slots(self.world, depth)

    def hit(self, record: list[Float], ray: Ray, active: Mask) -> tuple[Float, Float, Mask]:
        """Opacity, t* (for `ewa` the Gaussian's depth) and validity of a hit; the first two carry derivatives."""
        rho2, key, u = self.response.along(record, ray, self.world)
        # Whether there is a hit has no derivative: cut-offs compare detached values.
        ok = active & (dr.detach(rho2) <= dr.detach(record[self.extent2]))
        a = self.response.opacity(record[self.strength] * dr.exp(-0.5 * rho2), u)
        if self.response.front_only:
            ok &= dr.detach(key) > 0  # a cut-off, too
        if self.s.alpha_min > 0:
            ok &= dr.detach(a) >= self.alpha_min  # likewise
        if self.s.alpha_max < 1:
            clamped = dr.minimum(a, self.alpha_max)
            # INRIA's gradient passes through the clamp; gsplat's is 0 there.
            a = dr.replace_grad(clamped, a) if self.s.alpha_max_gradient == "pass" else clamped
        return a, key, ok


@dataclasses.dataclass
class Channels:
    """The channels that one traversal composites, in flat buffers: colors, from records or SH, and a slice of the
    features.

    Attributes:
        buffers: Name -> Float. `record` has RECORD floats a Gaussian; `sh` 3 K, present when SH are evaluated along
            each ray; `features` has `width` and channels first .. first + channels are composited.
        color: RGB are composited.
        oriented: The three features are an axis in the world, that of the two directions that looks against the ray;
            rays carry an SH basis.
    """

    buffers: dict
    width: int = 0
    first: int = 0
    channels: int = 0
    color: bool = True
    oriented: bool = False

    @property
    def outputs(self) -> int:
        """Number of channels."""
        return (3 if self.color else 0) + self.channels

    def layout(self, ray: Ray) -> dict:
        """Name -> (stride, offset, count) of what a hit reads."""
        table = {"record": (RECORD, 0, RECORD)}
        if self.color and ray.basis:
            table["sh"] = (3 * ray.basis, 0, 3 * ray.basis)
        if self.channels:
            table["features"] = (self.width, self.first, self.channels)
        return table

    def load(
        self,
        lib: Lib,
        index: UInt32,
        ray: Ray,
        active: Mask,
        buffers: dict | None = None,
        only: str | None = None,
        record: list[Float] | None = None,
    ) -> dict:
        """What a hit of Gaussian `index` reads, name -> list of floats; from other buffers, or `only` of one name.

        Args:
            record: The Gaussian's record, where it has been read already.
        """
        buffers = buffers or self.buffers
        loaded = {}
        for name, (stride, offset, count) in self.layout(ray).items():
            if name not in buffers or (only and name != only):
                continue
            if name == "record":
                loaded[name] = record or load_record(lib, buffers[name], index, active)
            else:
                base = index * stride + offset
                loaded[name] = [dr.gather(lib.Float, buffers[name], base + k, active) for k in range(count)]
        return loaded

    def values(self, model: HitModel, loaded: dict, ray: Ray) -> list[Float]:
        """The channels of a hit: RGB, then the slice of features."""
        values = []
        if self.color and ray.basis:
            values += sh_color(ray.carried[: ray.basis], lambda k, c: loaded["sh"][3 * k + c])
        elif self.color:
            values += loaded["record"][model.rgb : model.rgb + 3]
        features = loaded.get("features", [])
        return values + (self.towards(features, features, ray) if self.oriented else features)

    def towards(self, axis: list[Float], values: list[Float], ray: Ray) -> list[Float]:
        """Values, or their negatives where an axis looks along the ray: a choice, without a derivative."""
        # The linear harmonics of a direction (x, y, z) are -c y, c z, -c x.
        _, y, z, x = (dr.detach(v) for v in ray.carried[:4])
        along = dr.detach(axis[2]) * z - dr.detach(axis[0]) * x - dr.detach(axis[1]) * y
        return [dr.select(along > 0, -v, v) for v in values]


class Primal:
    """Front-to-back compositing of `channels.outputs` channels.

    Args:
        want: What to keep besides color and T: `depth`, `median`, `count`, and `replay`: sums in float64, whatever
            the order, and the place of the last composited hit, for the adjoint.
        emit: Told of every composited hit: `emit(Gaussian, shared ray, its place, weight, is hit)`; None without.
    """

    def __init__(self, model: HitModel, channels: Channels, want: frozenset, emit: Emit | None = None) -> None:
        self.m = model
        self.channels = channels
        self.want = want
        self.emit = emit

    def init(self, k: int, alive: Mask, nowhere: Float | UInt32) -> dict:
        """State of a ray; the same for each shared one."""
        lib = self.m.lib
        # The same bits whether the adjoint may follow or not; in the order of centers, where sums are much of the
        # work, an image alone is summed in float32.
        Sum = lib.Float64 if "replay" in self.want or self.m.s.order != "center" else lib.Float
        state = {
            "T": lib.Float(1),
            "alpha": Sum(0),
            "sum": [Sum(0) for _ in range(self.channels.outputs)],
            "alive": dr.select(alive, lib.UInt32(1), 0),
        }
        for name in ("depth", "median"):
            if name in self.want:
                state[name] = Sum(0) if name == "depth" else lib.Float(0)
        if "count" in self.want or self.m.s.max_hits:
            state["count"] = lib.UInt32(0)
        if "replay" in self.want:
            state["place"] = type(nowhere)(nowhere)
        return state

    def shade(self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask) -> list[dict]:
        """Composite Gaussian `index` onto each of `rays`; places[k] is where the hit stands in the order."""
        m = self.m
        out = []
        any_active = active & (sum((s["alive"] for s in states), m.lib.UInt32(0)) != 0)
        loaded = self.channels.load(m.lib, index, rays[0], any_active)
        for k, (ray, st, place) in enumerate(zip(rays, states, places, strict=True)):
            a, depth, ok = m.hit(loaded["record"], ray, active & (st["alive"] != 0))
            T = st["T"]
            rest = st["T"] * (1 - a)
            if m.s.stop == "after":
                done = ok & (rest < m.stop_at)
            else:
                done = ok & ((rest < m.stop_at) if m.s.stop == "before" else (rest <= m.stop_at))
                ok &= ~done
            w = dr.select(ok, T * a, 0)
            new = dict(st)  # a loop state keeps its order of keys
            new["T"] = dr.select(ok, rest, T)
            new["alive"] = dr.select(done, 0, st["alive"])
            values = self.channels.values(m, loaded, ray)
            new["sum"] = [_add(w, v, s) for v, s in zip(values, st["sum"], strict=True)]
            # Not 1 - T, which rounds a thin veil away.
            new["alpha"] = st["alpha"] + type(st["alpha"])(w)
            if "depth" in st:
                new["depth"] = _add(w, depth, st["depth"])
            if "median" in st:
                new["median"] = dr.select(ok & (T > 0.5) & (rest <= 0.5), depth, st["median"])
            if "count" in st:
                new["count"] = st["count"] + dr.select(ok, m.lib.UInt32(1), 0)
                if m.s.max_hits:
                    new["alive"] = dr.select(new["count"] >= m.max_hits, 0, new["alive"])
            if "place" in st:
                new["place"] = dr.select(ok, place[0], st["place"])
            if self.emit is not None:
                self.emit(index, k, place, w, ok)
            out.append(new)
        return out


def _add(w: Float, value: Float, total: Float) -> Float:
    """total + w value in the precision of `total`."""
    Sum = type(total)
    return dr.fma(Sum(w), Sum(value), total)
