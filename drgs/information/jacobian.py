"""The rows of the Jacobian, hit by hit, and sums of their squares and products.

With the notation of kernels.py, dC_c = T (c_c - B_c) da + w dc_c, where B_c lies behind the hit: what a parameter does
to a channel is summed up, then squared. Channels are those that were composited: colors, whose c moves with the mean
and behind which there is a background, then any number of others, for which dc = 0 and the background is 0. The
derivatives da of a hit's opacity by the geometry of its Gaussian are closed forms of the responses
(`tracing/peak.py`, where they are derived); dc by the mean is the same for all hits of a Gaussian (hits.py).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import drjit as dr

from drgs import runtime
from drgs.ellipsoids import Y_00
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.hit_table import HitReplay, Table
from drgs.tracing.kernels import Channels, HitModel
from drgs.tracing.primitives import Projected, Ray
from drgs.tracing.protocols import Sink
from drgs.tracing.records import load_packed, pack, packed_size
from drgs.tracing.responses import Response
from drgs.tracing.sums import add_row

GEOMETRY = 10  # means 3, rotations 3, log-scales 3, logit-opacity 1: the order of every row
# entries of `extras`: d log strength / dlogit, dc/dmu (9), then the response's
_OPACITY = 0
_COLOR = 1
_SHAPE = 10


@runtime.exactly
def extras(
    lib: Lib,
    response: Response,
    logit: Float,
    projected: Projected,
    moved: list[list[Float]] | None,
    color: list[list[Float]] | None,
) -> Float:
    """What hits need besides the record, packed (records.pack).

    Args:
        logit: (N,) raw opacities.
        projected: `Projected` of the view.
        moved: Tangents of the record, where the response needs them: one per geometric parameter but the opacity.
        color: (channel, axis) nested lists of dc/dmu, or None where the color does not depend on the mean.
    """
    F = lib.Float
    logit = lib.Float64(logit)
    e = dr.exp(-abs(logit))
    opacity = dr.select(logit >= 0, 1, e) / (1 + e)
    columns = [F(response.strength_slope(logit, opacity, e))]
    columns += [F(x) for channel in color for x in channel] if color else [F(0)] * 9
    return pack(lib, columns + response.extras(lib, projected, moved), dr.width(logit))


class Row(NamedTuple):
    """The row of the Jacobian of a hit: slopes by its Gaussian's parameters on one ray.

    Attributes:
        slopes: d a / d geometry; None without geometry.
        g: Slopes dC / da, one per channel, 0 where the ray has no such hit; None without geometry.
        w: Weight of the hit, 0 likewise.
        a: Opacity of the hit; whatever it is where `g` and `w` are 0.
        color_by_mean: (color, axis) w dc/dmu, or None where the color does not depend on the mean.
        color: RGB of the Gaussian on this ray, then its other channels; None where the sink does not need them.
        basis: SH basis along the ray; empty where SH are evaluated towards the mean.
    """

    slopes: list[Float] | Any
    g: list[Float] | Any
    w: Float
    a: Float
    color_by_mean: list[list[Float]] | None
    color: list[Float] | Any
    basis: list[Float]


class Rows(HitReplay):
    """Replay of a primal pass that hands the Jacobian's rows of every hit to a sink.

    Args:
        model, channels, finals, table: As of a `HitReplay`.
        buffer: The buffer of `extras`; None leaves the geometry out, only w is known then.
        sink: What becomes of them: `SquareSums`, `BlockSums`, `RemovalSums` or `VarianceSums`.
        color: The color depends on the mean, through the direction.
        masks: What the rows of each shared ray are multiplied by; None: nothing.
    """

    def __init__(
        self,
        model: HitModel,
        channels: Channels,
        buffer: Float | None,
        sink: Sink,
        finals: list[dict],
        color: bool,
        masks: list[Float] | None = None,
        table: Table | None = None,
    ) -> None:
        super().__init__(model, channels, finals, table)
        self.sink = sink
        self.masks = masks
        self.buffer = buffer
        self.color = color
        self.size = packed_size(_SHAPE + model.response.extra)
        self.colors = buffer is not None or (sink is not None and sink.needs_color)

    def rest(self, k: int) -> list[Float]:
        """The whole sum of each channel of shared ray k; none without geometry.

        In float64: what lies behind a hit is left of it by subtraction, and in float32 nothing were left of what many
        hits in front of it have covered.
        """
        final, D = self.finals[k], self.m.lib.Float64
        if self.buffer is None:
            return []
        backgrounds = self.m.background if self.channels.color else []
        rest = [dr.fma(D(b), D(final["T"]), D(x)) for x, b in zip(final["sum"], backgrounds, strict=False)]
        return rest + [D(x) for x in final["sum"][len(rest) :]]

    def terms(self, k: int, values: list[Float], depth: Float, place: list, ok: Mask) -> list[Float]:
        """The channels of a hit."""
        return values if self.buffer is not None else []

    def init(self, k: int, alive: Mask, nowhere: Float | UInt32) -> dict:
        """State of shared ray k: what is left of each channel behind the last hit."""
        state, alive = self.begun(k, alive, nowhere)
        if self.masks:
            alive = alive & (self.masks[k] > 0)
        return {**state, "alive": dr.select(alive, self.m.lib.UInt32(1), 0), **self.sink.init(k)}

    def take(
        self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask, record: Any
    ) -> list[dict]:
        """Replay a hit that some ray of the packet has: B_c as in derivatives.py, exact as the sums are float64."""
        m = self.m
        lib = self.m.lib
        rows = []
        out = []
        going = self.going(states, active)
        only = None if self.colors else "record"
        loaded = self.channels.load(lib, index, rays[0], going, only=only, record=record)
        record = loaded["record"]
        hits = lib.Bool(False)
        extra = None if self.buffer is None else load_packed(lib, self.buffer, self.size, index, going)
        for k, (ray, st, place) in enumerate(zip(rays, states, places, strict=True)):
            a, depth, ok = m.hit(record, ray, active & (st["alive"] != 0))
            color: list[Float] | Any = self.channels.values(m, loaded, ray) if self.colors else None
            T, w, behind, new, ok = self.replayed(k, st, a, self.terms(k, color, depth, place, ok), place, ok)
            slopes = g = color_by_mean = None
            if extra:
                g = [dr.select(ok, dr.fma(T, c, -b), 0) for c, b in zip(color, behind, strict=True)]
                moves = ok
                if m.s.alpha_max < 1 and m.s.alpha_max_gradient != "pass":
                    moves = ok & (a < m.alpha_max)
                # Far from the ellipsoid 0 times infinity is possible.
                slopes = [dr.select(moves, x, 0) for x in self._slopes(record, extra, ray)]
                if self.color:
                    color_by_mean = [[w * extra[_COLOR + 3 * c + j] for j in range(3)] for c in range(3)]
            if self.masks:  # after `rest`, which is of the whole image
                w = w * self.masks[k]
                g = [x * self.masks[k] for x in g] if g else g
                color_by_mean = (
                    [[x * self.masks[k] for x in each] for each in color_by_mean] if color_by_mean else color_by_mean
                )
            rows.append(Row(slopes, g, w, a, color_by_mean, color, ray.carried[: ray.basis]))
            hits |= ok
            out.append(new)
        return self.sink.take(lib, index, hits, rows, out)

    def _slopes(self, record: list[Float], extra: list[Float], ray: Ray) -> list[Float]:
        """The GEOMETRY derivatives of the opacity of a hit, before the clamp at alpha_max."""
        *slopes, strength = self.m.response.slopes(record, extra[_SHAPE:], ray, self.m.world)
        return [*slopes, strength * extra[_OPACITY]]


def _entry(slopes: list[Float], g: list[Float], color_by_mean: list[list[Float]] | None, j: int, c: int) -> Float:
    """dC_c / d(geometry j)."""
    value = g[c] * slopes[j]
    return value + color_by_mean[c][j] if color_by_mean and j < 3 and c < len(color_by_mean) else value


class SquareSums(Sink):
    """Sums of squares into a buffer of `width` floats a Gaussian: geometry, sum w^2, by band and channel, then padding.

    Args:
        weights: Weights of the channels: colors first, where they are composited.
        entries: Those that are wanted.
        bands: SH coefficients whose sums (w Y_k)^2 over the rays where a channel is not clamped are wanted as well:
            where SH are evaluated along each ray, they are no multiple of sum w^2.
        channels_first: Sum the channels before squaring, as FisherRF does.
    """

    def __init__(
        self,
        lib: Lib,
        count: int,
        weights: Sequence[float],
        mode: dr.ReduceMode,
        entries: Sequence[int],
        bands: int = 0,
        channels_first: bool = False,
    ) -> None:
        self.width = packed_size(GEOMETRY + 1 + 3 * bands)
        self.buffer = dr.zeros(lib.Float, count * self.width)
        self.weights = weights
        self.entries = entries
        self.mode = mode
        self.bands = bands
        self.channels_first = channels_first
        self.needs_color = bands > 0

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """Add a hit's rows."""
        sums: list[Float | None] = [None] * (GEOMETRY + 1)
        for k in self.entries:
            total = lib.Float(0)
            for row in rows:
                if k == GEOMETRY:
                    total = dr.fma(row.w, row.w, total)
                else:
                    total += weighted_squares(row, k, self.weights, self.channels_first)
            sums[k] = total
        for k in range(self.bands):
            for c in range(3):
                slopes = [dr.select(row.color[c] > 0, row.w * row.basis[k], 0) for row in rows]
                sums.append(sum(x * x for x in slopes))
        add_row(lib, self.buffer, sums, index, self.width, 0, hits, self.mode)
        return states


def weighted_squares(row: Row, j: int, weights: Sequence[float], channels_first: bool = False) -> Float:
    """sum_c weight_c (dC_c / d(geometry j))^2."""
    slopes, g, color_by_mean = row.slopes, row.g, row.color_by_mean
    if channels_first:
        value = sum(_entry(slopes, g, color_by_mean, j, c) for c in range(len(g)))
        return value * value
    if color_by_mean and j < 3:
        entries = [_entry(slopes, g, color_by_mean, j, c) for c in range(len(color_by_mean))]
        value = sum(x * x * weight for x, weight in zip(entries, weights, strict=False))
        return value + slopes[j] * slopes[j] * _uncolored(row, weights) if len(g) > len(color_by_mean) else value
    return slopes[j] * slopes[j] * sum(x * x * weight for x, weight in zip(g, weights, strict=True))


def _uncolored(row: Row, weights: Sequence[float]) -> Float:
    """sum_c weight_c (dC_c / da)^2 over the channels behind the colors."""
    return sum(x * x * weight for x, weight in zip(row.g[3:], weights[3:], strict=True))


class BlockSums(Sink):
    """Sums of outer products: the lower triangles of (13, 13), row by row, then padding; base colors follow the
    geometry.
    """

    SIZE = GEOMETRY + 3
    WIDTH = packed_size(SIZE * (SIZE + 1) // 2)
    needs_color = True

    def __init__(self, lib: Lib, count: int, weights: Sequence[float], mode: dr.ReduceMode) -> None:
        self.buffer = dr.zeros(lib.Float, count * self.WIDTH)
        self.weights = weights
        self.mode = mode

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """Add a hit's rows."""
        full, others = [], []
        for row in rows:
            if len(row.g) > 3:
                others.append((row.slopes, _uncolored(row, self.weights)))
            for c in range(3 if any(self.weights[:3]) else 0):
                entries = [_entry(row.slopes, row.g, row.color_by_mean, j, c) for j in range(GEOMETRY)]
                # d color / d sh_0, 0 where the color is clamped.
                unclamped = dr.select(row.color[c] > 0, row.w * Y_00, 0)
                full.append((self.weights[c], [*entries, *(unclamped if k == c else None for k in range(3))]))
        sums: list[Float | None] = []
        for i in range(self.SIZE):
            for j in range(i + 1):
                total = lib.Float(0)
                for weight, entries in full:
                    if entries[i] is not None and entries[j] is not None:
                        total = dr.fma(weight * entries[i], entries[j], total)
                for slopes, squares in others if i < GEOMETRY else ():
                    total = dr.fma(slopes[i] * slopes[j], squares, total)
                sums.append(total)
        add_row(lib, self.buffer, sums, index, self.WIDTH, 0, hits, self.mode)
        return states


class RemovalSums(Sink):
    """Sums of the changes of the image where a Gaussian is left out: of a hit, dC / da a, as C is linear in the opacity
    a of each hit.

    Args:
        weights: Weights of the squares of the channels: colors first, where they are composited.
        power: Of the length over the channels that is summed up: 2, 1.5 or 1.
    """

    needs_color = False

    def __init__(self, lib: Lib, count: int, weights: Sequence[float], mode: dr.ReduceMode, power: float) -> None:
        self.buffer = dr.zeros(lib.Float, count)
        self.weights = weights
        self.power = power
        self.mode = mode

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """Add a hit's rows."""
        total = lib.Float(0)
        for row in rows:
            changes = [slope * row.a for slope in row.g]
            square = sum((x * x * w for x, w in zip(changes, self.weights, strict=True)), lib.Float(0))
            length = dr.sqrt(square)
            total += {2: square, 1.5: length * dr.sqrt(length), 1: length}[self.power]
        add_row(lib, self.buffer, [total], index, 1, 0, hits, self.mode)
        return states


class SumsOf(NamedTuple):
    """One of the sums above, to be made for a part of the rays.

    Attributes:
        kind: The class.
        options: Its arguments after `mode`, hashable.
    """

    kind: type[SquareSums | BlockSums | RemovalSums]
    options: tuple = ()

    def sink(self, lib: Lib, count: int, weights: Sequence[float], mode: dr.ReduceMode) -> Any:
        """The sums, all 0: of `count` Gaussians, with weights of the channels, added up by `mode`."""
        return self.kind(lib, count, weights, mode, *self.options)


class SeveralSums:
    """Several sinks, each of which takes every row.

    Args:
        sinks: The sinks; what each keeps along a ray has a name of its own.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self.sinks = sinks
        self.needs_color = any(sink.needs_color for sink in sinks)

    def init(self, k: int) -> dict:
        """What all of them keep."""
        return {name: x for sink in self.sinks for name, x in sink.init(k).items()}

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """One after another."""
        for sink in self.sinks:
            states = sink.take(lib, index, hits, rows, states)
        return states


@dataclasses.dataclass(eq=False)
class VarianceSums:
    """Per pixel, the sum over parameters of squared derivatives times a weight of each.

    Attributes:
        buffer: 16 floats a Gaussian: the weights of the geometry, then of w^2 in each color, then of w^2 itself.
        weights: Weights of the channels: colors first.
        sh_weights: 3 K floats a Gaussian, the weights of SH that are evaluated along each ray, or None.
        plain: Whether there are weights of w^2 itself.
    """

    buffer: Float
    weights: Sequence[float]
    sh_weights: Float | None = None
    plain: bool = False
    needs_color: bool = False

    def init(self, k: int) -> dict:
        """The sum along a ray."""
        return {"variance": type(self.buffer)(0)}

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """Add a hit's rows to their rays."""
        v = list(dr.gather(lib.ArrayXf, self.buffer, index, hits, shape=(16, dr.width(index))))
        out = []
        sh_weights = []
        if self.sh_weights is not None:
            K = len(rows[0].basis)
            sh_weights = [dr.gather(lib.Float, self.sh_weights, index * (3 * K) + k, hits) for k in range(3 * K)]
        for row, state in zip(rows, states, strict=True):
            total = sum(v[j] * weighted_squares(row, j, self.weights) for j in range(GEOMETRY))
            shares = [v[GEOMETRY + c] for c in range(3)]
            for k, weight in enumerate(sh_weights):
                band = row.basis[k // 3]
                c = k % 3
                shares[c] = shares[c] + dr.select(row.color[c] > 0, band * band * weight, 0)
            colors = sum(x * weight for x, weight in zip(shares, self.weights, strict=False))
            if self.plain:
                colors += v[GEOMETRY + 3]
            total += row.w * row.w * colors
            new = dict(state)
            new["variance"] = state["variance"] + total
            out.append(new)
        return out
