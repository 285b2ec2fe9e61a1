"""How rays walk along their Gaussians: in the order given, or in the exact order of each ray.

A `Part` is a set of lanes with one or four rays each and a stream of candidate Gaussians. In `center` order on tiles
the stream is in order already: 16 lanes work on a tile and each carries four pixels, so that a record is loaded once
for 64 pixels. In every other case a lane has one ray and a sorted buffer of K hits (order key and index).

Exact order with a finite buffer: hits enter as they come, and the nearest leaves when a new one needs its place. A ray
goes wrong only if a hit arrives in front of one that has left; this is checked on every hit (the certificate), and such
rays are redone from a sorted list of all their hits, so any depth is exact. A ray may stop at its transmittance limit
only where nothing that is still to come can lie in front: streams bound the keys to come from below.
"""

from __future__ import annotations

import drjit as dr

from drgs.tracing.kernels import Ray
from drgs.tracing.projection import RECORD
from drgs.tracing.tiles import TILE, Lists

__all__ = ["BUFFER", "EMPTY", "NOWHERE", "Part", "TileStream", "tile_part"]

BUFFER = 16
EMPTY = -1.0  # order key of "no hit"; keys of hits are >= 0
NOWHERE = 0xFFFFFFFF  # place in a list of a ray that composited nothing
_LAST = 3.3e38  # a key behind all others
_MAX_HITS = 1 << 25  # of one sorted list; longer ones are split by rays


class TileStream:
    """Entries of a tile's list, one after the other."""

    def __init__(self, t, lists: Lists, tile, active):
        self.t, self.lists = t, lists
        self.start = dr.gather(t.UInt32, lists.start, tile)
        self.end = dr.select(active, dr.gather(t.UInt32, lists.end, tile), self.start)

    def begin(self):
        """State of the stream at its start."""
        return self.t.UInt32(self.start)

    def more(self, i):
        """Whether there is a candidate left."""
        return i < self.end

    def next(self, i, active):
        """(Gaussian, valid, lower bound of this and all later keys, new state)."""
        index = dr.gather(self.t.UInt32, self.lists.index, i, active)
        bound = EMPTY if self.lists.ahead is None else dr.gather(self.t.Float, self.lists.ahead, i, active)
        return index, active, bound, i + 1


class Part:
    """Lanes, their rays and pixels, and the stream of candidates.

    Attributes:
        rays: `share` rays a lane.
        flat: Per shared ray, the pixel (row-major index) it belongs to.
        inside: Per shared ray, whether there is such a pixel and this part decides it.
        failed: After a primal pass in exact order: lanes whose buffer was too short.
    """

    def __init__(self, t, model, records, rays, flat, inside, stream_of, ordered: bool, center_key=None):
        self.t, self.model, self.records = t, model, records
        self.rays, self.flat, self.inside = rays, flat, inside
        self.stream_of, self.ordered, self.center_key = stream_of, ordered, center_key
        self.failed = None

    def listed(self, lanes) -> list[Part]:
        """Parts that walk a subset of lanes along sorted lists of all their hits."""
        t = self.t
        if dr.width(lanes) == 0:
            return []
        pick = lambda x: dr.gather(type(x), x, lanes)  # noqa: E731
        rays = [
            Ray(*(None if v is None else pick(v) for v in (r.x, r.y, r.length)), [pick(v) for v in r.lane], r.basis)
            for r in self.rays
        ]
        flat, stream = [pick(f) for f in self.flat], self.stream_of(lanes)
        dr.eval(rays, flat)
        with dr.suspend_grad():
            count = self._each_hit(rays[0], stream, dr.width(lanes), lambda *hit: None)
            dr.eval(count)
            total = int(dr.sum(t.UInt64(count))[0])
            if total > _MAX_HITS and dr.width(lanes) > 1:
                half = dr.arange(t.UInt32, dr.width(lanes) // 2)
                rest = dr.arange(t.UInt32, dr.width(lanes) - dr.width(half)) + dr.width(half)
                return self.listed(dr.gather(t.UInt32, lanes, half)) + self.listed(dr.gather(t.UInt32, lanes, rest))
            start = dr.cumsum(count) - count
            keys, index = dr.zeros(t.UInt64, max(total, 1)), dr.zeros(t.UInt32, max(total, 1))
            lane = t.UInt64(dr.arange(t.UInt32, dr.width(lanes))) << 32

            def write(k, candidate, key, ok):
                # Keys are >= 0, where floats order like their bits.
                dr.scatter(keys, lane | t.UInt64(dr.reinterpret_array(t.UInt32, key)), start + k, ok)
                dr.scatter(index, candidate, start + k, ok)

            dr.eval(self._each_hit(rays[0], stream, dr.width(lanes), write), keys, index)
            # Sorts are stable: by index first, so that equal keys of a ray keep that order.
            by_index = t.UInt32(dr.argsort(index))
            by_key = t.UInt32(dr.argsort(dr.gather(t.UInt64, keys, by_index)))
            index = dr.gather(t.UInt32, index, dr.gather(t.UInt32, by_index, by_key))
            dr.eval(index, start)
        lists = Lists(index, start, start + count, None, 0, 0, total)
        here = dr.arange(t.UInt32, dr.width(lanes))
        stream_of = lambda _: TileStream(t, lists, here, t.Bool(True))  # noqa: E731
        inside = [t.Bool(True)] * len(rays)
        return [Part(t, self.model, self.records, rays, flat, inside, stream_of, False)]

    def _each_hit(self, ray, stream, lanes: int, visit):
        """Number of hits of every lane; `visit(number so far, Gaussian, key, is hit)` sees each candidate."""
        t = self.t
        start = stream.begin()
        start = t.UInt32(start) if isinstance(start, t.UInt32) else start

        def body(s, k):
            candidate, valid, _, s = stream.next(s, t.Bool(True))
            key, ok = self._probe(candidate, ray, valid)
            visit(k, candidate, key, ok)
            return s, k + dr.select(ok, t.UInt32(1), 0)

        return dr.while_loop((start, dr.zeros(t.UInt32, lanes)), lambda s, k: stream.more(s), body)[1]

    def run(self, kernel, check: bool = False) -> list[dict]:
        """Walk all rays with a Primal, Adjoint or Tangent; `check` keeps the certificate in `failed`."""
        with dr.suspend_grad():
            if not self.ordered:
                return self._in_order(kernel)
            return self._sorted(kernel, check)

    def _in_order(self, kernel):
        t, stream = self.t, self.stream_of(None)
        states = [kernel.init(inside, [t.UInt32(NOWHERE)]) for inside in self.inside]
        start = stream.begin()

        def body(s, go, states):
            index, valid, _, after = stream.next(s, t.Bool(True))
            place = s if isinstance(s, t.UInt32) else after[0]
            states = kernel.shade(index, self.rays, states, [[place]] * len(self.rays), valid)
            alive = sum((st["alive"] for st in states), t.UInt32(0))
            return after, dr.select(stream.more(after) & (alive != 0), t.UInt32(1), 0), states

        go = dr.select(stream.more(start), t.UInt32(1), 0)
        return dr.while_loop((start, go, states), lambda s, go, states: go != 0, body)[2]

    def _probe(self, index, ray, active):
        """Order key of a candidate, and whether it is a hit."""
        t = self.t
        record = list(dr.gather(t.ArrayXf, self.records, index, active, shape=(RECORD, dr.width(index))))
        _, key, ok = self.model.hit(record, ray, active)
        # `integral` has hits whose t* lies behind the origin.
        key = dr.maximum(key, 0)
        if self.center_key is not None:
            key = dr.gather(t.Float, self.center_key, index, ok)
        return key, ok

    def _sorted(self, kernel, check):
        t, stream = self.t, self.stream_of(None)
        F, U = t.Float, t.UInt32
        state = kernel.init(self.inside[0], [F(EMPTY), U(0)])
        start = stream.begin()
        keys, index = [F(EMPTY) for _ in range(BUFFER)], [U(0) for _ in range(BUFFER)]

        def exchange(enter, candidate, keys, index, last, state):
            """Put a hit into the buffer and composite the one that leaves it."""
            (key, at), keys, index = _push(enter, candidate, keys, index)
            out = key != EMPTY
            (state,) = kernel.shade(at, self.rays, [state], [[key, at]], out)
            return keys, index, [dr.select(out, key, last[0]), dr.select(out, at, last[1])], state

        def body(s, go, keys, index, last, failed, state):
            candidate, valid, bound, s = stream.next(s, t.Bool(True))
            key, ok = self._probe(candidate, self.rays[0], valid)
            if check:
                failed = dr.select(ok & _less(key, candidate, *last), 1, failed)
            enter = dr.select(ok & (state["alive"] != 0), key, EMPTY)
            # Most candidates miss most packets of lanes: the branch skips the rest for these.
            keys, index, last, state = dr.if_stmt(
                (enter, candidate, keys, index, last, state),
                enter != EMPTY,
                exchange,
                lambda _, __, *unchanged: unchanged,
            )
            going = state["alive"] != 0
            if check:
                going |= bound <= last[0]
            return s, dr.select(stream.more(s) & going, U(1), 0), keys, index, last, failed, state

        go = dr.select(stream.more(start) & (state["alive"] != 0), U(1), 0)
        loop = (start, go, keys, index, [F(EMPTY), U(0)], U(0), state)
        _, _, keys, index, _, failed, state = dr.while_loop(loop, lambda s, go, *_: go != 0, body)
        self.failed = failed != 0
        return [self._drain(kernel, keys, index, state)]

    def _drain(self, kernel, keys, index, state):
        """Composite what is left in the buffer."""
        t = self.t

        def body(j, keys, index, state):
            (state,) = kernel.shade(
                index[0], self.rays, [state], [[keys[0], index[0]]], (keys[0] != EMPTY) & (keys[0] < _LAST)
            )
            keys = [*keys[1:], t.Float(_LAST)]
            index = [*index[1:], t.UInt32(0)]
            return j + 1, keys, index, state

        def cond(j, keys, index, state):
            return (j < BUFFER) & (state["alive"] != 0)

        return dr.while_loop((t.UInt32(0), keys, index, state), cond, body)[3]


def _less(key_a, index_a, key_b, index_b):
    """(key, index) order."""
    return (key_a < key_b) | ((key_a == key_b) & (index_a < index_b))


def _push(key, index, keys, indices):
    """Insert into an ascending buffer and take its smallest out; pushing EMPTY changes nothing."""
    keys, indices = list(keys), list(indices)
    swap = _less(keys[0], indices[0], key, index)
    out = dr.select(swap, keys[0], key), dr.select(swap, indices[0], index)
    key, index = dr.select(swap, key, keys[0]), dr.select(swap, index, indices[0])
    for j in range(1, len(keys)):
        swap = _less(keys[j], indices[j], key, index)
        keys[j - 1], indices[j - 1] = dr.select(swap, keys[j], key), dr.select(swap, indices[j], index)
        key, index = dr.select(swap, key, keys[j]), dr.select(swap, index, indices[j])
    keys[-1], indices[-1] = key, index
    return out, keys, indices


def tile_part(t, model, records, lists: Lists, settings, width: int, height: int, ray_of, share: int) -> Part:
    """All pixels of an image along their tile lists.

    Args:
        ray_of: (x, y, pixel index, active) -> Ray.
        share: Pixels a lane carries, 4 or 1.
    """
    per_tile = TILE * TILE // share
    lane = dr.arange(t.UInt32, lists.columns * lists.rows * per_tile)
    tile, inner = lane // per_tile, lane % per_tile
    block, k = inner // 16, inner % 16
    # 16 consecutive lanes, a packet, are 4x4 pixels.
    x = (tile % lists.columns) * TILE + (block % 2) * 4 + k % 4
    y = (tile // lists.columns) * TILE + (block // 2) * 4 + k // 4
    blocks = [(0, 0), (4, 0), (0, 4), (4, 4)] if share == 4 else [(0, 0)]
    pixels = [(x + a, y + b) for a, b in blocks]
    inside = [(px < width) & (py < height) for px, py in pixels]
    flat = [py * width + px for px, py in pixels]
    rays = [
        ray_of(t.Float(px) + 0.5, t.Float(py) + 0.5, f, i) for (px, py), f, i in zip(pixels, flat, inside, strict=True)
    ]
    some = inside[0]
    for other in inside[1:]:
        some = some | other

    def stream_of(lanes):
        if lanes is None:
            return TileStream(t, lists, tile, some)
        return TileStream(t, lists, dr.gather(t.UInt32, tile, lanes), t.Bool(True))

    return Part(t, model, records, rays, flat, inside, stream_of, settings.order == "ray")
