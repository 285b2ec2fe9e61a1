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

from collections.abc import Callable
from typing import Any

import drjit as dr

from drgs.tracing.kernels import HitModel, Ray
from drgs.tracing.protocols import Float, Kernel, Lib, Mask, Stream, UInt32
from drgs.tracing.records import RECORD
from drgs.tracing.weights import PIXELS, Weights

__all__ = ["BUFFER", "EMPTY", "NOWHERE", "ListStream", "Part"]

BUFFER = 16
EMPTY = -1.0  # order key of "no hit"; keys of hits are >= 0
NOWHERE = 0xFFFFFFFF  # place in a list of a ray that composited nothing
_LAST = 3.3e38  # a key behind all others
_MAX_HITS = 1 << 25  # of one sorted list; longer ones are split by rays


class ListStream:
    """Entries of a list, of each lane those from `start` to `end`; a `Stream`.

    Args:
        index: (entries,) Gaussians.
        start, end: Per lane.
        ahead: (entries,) lower bound of the order key of this entry and all later ones of its lane; None without.
    """

    def __init__(self, lib: Lib, index: UInt32, start: UInt32, end: UInt32, ahead: Float | None = None) -> None:
        self.lib, self.index, self.start, self.end, self.ahead = lib, index, start, end, ahead

    def begin(self) -> UInt32:
        """The place of the first entry."""
        return self.lib.UInt32(self.start)

    def more(self, i: UInt32) -> Mask:
        """Whether there is an entry left."""
        return i < self.end

    def place(self, i: UInt32) -> UInt32:
        """In the list."""
        return i

    def next(self, i: UInt32, active: Mask) -> tuple[UInt32, Mask, Float, UInt32]:
        """One entry."""
        index = dr.gather(self.lib.UInt32, self.index, i, active)
        bound = EMPTY if self.ahead is None else dr.gather(self.lib.Float, self.ahead, i, active)
        return index, active, bound, i + 1

    def of(self, lanes: UInt32) -> ListStream:
        """The entries of some lanes."""
        start, end = (dr.gather(self.lib.UInt32, x, lanes) for x in (self.start, self.end))
        return ListStream(self.lib, self.index, start, end, self.ahead)


class Part:
    """Lanes, their rays and pixels, and the stream of candidates.

    Attributes:
        rays: One or four a lane, all of which walk along the same stream.
        flat: Per shared ray, the pixel (row-major index) it belongs to.
        inside: Per shared ray, whether there is such a pixel and this part decides it.
        failed: After a primal pass in exact order: lanes whose buffer was too short.
        weights: Where the weights of these rays are held; None where they are not. A place in the order then ends
            with that in the list.
        columns: Per shared ray, its pixel of the tile.
    """

    def __init__(
        self,
        lib: Lib,
        model: HitModel,
        records: Float,
        rays: list[Ray],
        flat: list[UInt32],
        inside: list[Mask],
        stream: Stream,
        ordered: bool,
        center_key: Float | None = None,
    ) -> None:
        self.lib, self.model, self.records = lib, model, records
        self.rays, self.flat, self.inside = rays, flat, inside
        self.stream, self.ordered, self.center_key = stream, ordered, center_key
        self.failed = None
        self.weights: Weights | None = None
        self.columns: list[UInt32] = []

    def held(self, k: int, place: list) -> UInt32:
        """Where the weight of shared ray k at a place in its order is held."""
        assert self.weights is not None
        return (place[-1] - self.weights.first) * PIXELS + self.columns[k]

    def listed(self, again: UInt32) -> list[Part]:
        """Parts that walk some of the rays again, given by their lanes, along sorted lists of all their hits."""
        lib, count = self.lib, dr.width(again)
        if count == 0:
            return []
        pick = lambda x: None if x is None else dr.gather(type(x), x, again)  # noqa: E731
        rays = [Ray(pick(r.x), pick(r.y), pick(r.length), [pick(v) for v in r.carried], r.basis) for r in self.rays]
        flat, stream = [pick(f) for f in self.flat], self.stream.of(again)
        dr.eval(rays, flat)
        with dr.suspend_grad():  # lists say what to look at, and in which order: neither has a derivative
            hits = self._each_hit(rays[0], stream, count, lambda *hit: None)
            dr.eval(hits)
            total = int(dr.sum(lib.UInt64(hits))[0])
            if total > _MAX_HITS and count > 1:
                half = dr.arange(lib.UInt32, count // 2)
                rest = dr.arange(lib.UInt32, count - dr.width(half)) + dr.width(half)
                return self.listed(dr.gather(lib.UInt32, again, half)) + self.listed(dr.gather(lib.UInt32, again, rest))
            start = dr.cumsum(hits) - hits
            index = self._sorted_hits(rays[0], stream, start, total)
        stream = ListStream(lib, index, start, start + hits)
        inside = [lib.Bool(True)] * len(rays)
        return [Part(lib, self.model, self.records, rays, flat, inside, stream, False)]

    def _sorted_hits(self, ray: Ray, stream: Stream, start: UInt32, total: int) -> UInt32:
        """The hits of each ray, from its `start` on, by (key, index)."""
        lib, count = self.lib, dr.width(start)
        keys, index = dr.zeros(lib.UInt64, max(total, 1)), dr.zeros(lib.UInt32, max(total, 1))
        own = lib.UInt64(dr.arange(lib.UInt32, count)) << 32

        def write(k: UInt32, candidate: UInt32, key: Float, ok: Mask) -> None:
            # Keys are >= 0, where floats order like their bits.
            dr.scatter(keys, own | lib.UInt64(dr.reinterpret_array(lib.UInt32, key)), start + k, ok)
            dr.scatter(index, candidate, start + k, ok)

        dr.eval(self._each_hit(ray, stream, count, write), keys, index)
        # Sorts are stable: by index first, so that equal keys of a ray keep that order.
        by_index = lib.UInt32(dr.argsort(index))
        by_key = lib.UInt32(dr.argsort(dr.gather(lib.UInt64, keys, by_index)))
        index = dr.gather(lib.UInt32, index, dr.gather(lib.UInt32, by_index, by_key))
        dr.eval(index, start)
        return index

    def _each_hit(self, ray: Ray, stream: Stream, lanes: int, visit: Callable) -> UInt32:
        """Number of hits of every lane; `visit(number so far, Gaussian, key, is hit)` sees each candidate."""
        lib = self.lib

        def body(s: Any, k: UInt32) -> tuple:
            candidate, valid, _, s = stream.next(s, lib.Bool(True))
            key, ok = self._probe(candidate, ray, valid)
            visit(k, candidate, key, ok)
            return s, k + dr.select(ok, lib.UInt32(1), 0)

        return dr.while_loop((stream.begin(), dr.zeros(lib.UInt32, lanes)), lambda s, k: stream.more(s), body)[1]

    def run(self, kernel: Kernel, check: bool = False) -> list[dict]:
        """Walk all rays with a kernel: final states of each shared ray; `check` keeps the certificate in `failed`."""
        with dr.suspend_grad():  # kernels differentiate on their own: nothing of the loop is recorded
            if not self.ordered:
                return self._in_order(kernel)
            return self._sorted(kernel, check)

    def _in_order(self, kernel: Kernel) -> list[dict]:
        """Composite the candidates as they come."""
        lib, stream = self.lib, self.stream
        states = [kernel.init(k, inside, [lib.UInt32(NOWHERE)]) for k, inside in enumerate(self.inside)]
        start = stream.begin()

        def body(s: Any, go: UInt32, states: list[dict]) -> tuple:
            index, valid, _, after = stream.next(s, lib.Bool(True))
            states = kernel.shade(index, self.rays, states, [[stream.place(s)]] * len(self.rays), valid)
            alive = sum((st["alive"] for st in states), lib.UInt32(0))
            return after, dr.select(stream.more(after) & (alive != 0), lib.UInt32(1), 0), states

        go = dr.select(stream.more(start), lib.UInt32(1), 0)
        return dr.while_loop((start, go, states), lambda s, go, states: go != 0, body)[2]

    def _probe(self, index: UInt32, ray: Ray, active: Mask) -> tuple[Float, Mask]:
        """Order key of a candidate, and whether it is a hit."""
        lib = self.lib
        record = list(dr.gather(lib.ArrayXf, self.records, index, active, shape=(RECORD, dr.width(index))))
        _, key, ok = self.model.hit(record, ray, active)
        # `integral` has hits whose t* lies behind the origin.
        key = dr.maximum(key, 0)
        if self.center_key is not None:
            key = dr.gather(lib.Float, self.center_key, index, ok)
        return key, ok

    def _sorted(self, kernel: Kernel, check: bool) -> list[dict]:
        """Composite through a sorted buffer: a hit leaves it when it is the nearest and a new one needs its place."""
        lib, stream = self.lib, self.stream
        F, U = lib.Float, lib.UInt32
        # What a hit is known by: the Gaussian, and where weights are held its place in the list.
        known = 1 if self.weights is None else 2
        state = kernel.init(0, self.inside[0], [F(EMPTY), *(U(0) for _ in range(known))])
        start = stream.begin()
        keys, names = [F(EMPTY) for _ in range(BUFFER)], [[U(0) for _ in range(known)] for _ in range(BUFFER)]

        def exchange(
            enter: Float, name: list[UInt32], keys: list[Float], names: list[list[UInt32]], last: list, state: dict
        ) -> tuple:
            """Put a hit into the buffer and composite the one that leaves it."""
            (key, at), keys, names = _push(enter, name, keys, names)
            out = key != EMPTY
            (state,) = kernel.shade(at[0], self.rays, [state], [[key, *at]], out)
            return keys, names, [dr.select(out, key, last[0]), dr.select(out, at[0], last[1])], state

        def body(
            s: Any, go: UInt32, keys: list[Float], names: list[list[UInt32]], last: list, failed: UInt32, state: dict
        ) -> tuple:
            """Meet the next candidate; `last` left the buffer last, `failed` is 1 where a hit came too late."""
            place = stream.place(s)
            candidate, valid, bound, s = stream.next(s, lib.Bool(True))
            key, ok = self._probe(candidate, self.rays[0], valid)
            if check:
                failed = dr.select(ok & _less(key, candidate, *last), 1, failed)
            enter = dr.select(ok & (state["alive"] != 0), key, EMPTY)
            # Most candidates miss most packets of lanes: the branch skips the rest for these.
            keys, names, last, state = dr.if_stmt(
                (enter, [candidate, place][:known], keys, names, last, state),
                enter != EMPTY,
                exchange,
                lambda _, __, *unchanged: unchanged,
            )
            going = state["alive"] != 0
            if check:
                going |= bound <= last[0]
            return s, dr.select(stream.more(s) & going, U(1), 0), keys, names, last, failed, state

        go = dr.select(stream.more(start) & (state["alive"] != 0), U(1), 0)
        loop = (start, go, keys, names, [F(EMPTY), U(0)], U(0), state)
        _, _, keys, names, _, failed, state = dr.while_loop(loop, lambda s, go, *_: go != 0, body)
        self.failed = failed != 0
        return [self._drain(kernel, keys, names, state)]

    def _drain(self, kernel: Kernel, keys: list[Float], names: list[list[UInt32]], state: dict) -> dict:
        """Composite what is left in the buffer."""
        lib = self.lib

        def body(j: UInt32, keys: list[Float], names: list[list[UInt32]], state: dict) -> tuple:
            (state,) = kernel.shade(
                names[0][0], self.rays, [state], [[keys[0], *names[0]]], (keys[0] != EMPTY) & (keys[0] < _LAST)
            )
            keys = [*keys[1:], lib.Float(_LAST)]
            names = [*names[1:], [lib.UInt32(0) for _ in names[0]]]
            return j + 1, keys, names, state

        def cond(j: UInt32, keys: list[Float], names: list[list[UInt32]], state: dict) -> Mask:
            return (j < BUFFER) & (state["alive"] != 0)

        return dr.while_loop((lib.UInt32(0), keys, names, state), cond, body)[3]


def _less(key_a: Float, index_a: UInt32, key_b: Float, index_b: UInt32) -> Mask:
    """(key, index) order."""
    return (key_a < key_b) | ((key_a == key_b) & (index_a < index_b))


def _push(
    key: Float, name: list[UInt32], keys: list[Float], names: list[list[UInt32]]
) -> tuple[tuple[Float, list[UInt32]], list[Float], list[list[UInt32]]]:
    """Insert into a buffer that ascends by (key, Gaussian) and take its smallest out; pushing EMPTY changes nothing.

    A name begins with the Gaussian.
    """
    keys, names = list(keys), list(names)
    swap = _less(keys[0], names[0][0], key, name[0])
    out = dr.select(swap, keys[0], key), _either(swap, names[0], name)
    key, name = dr.select(swap, key, keys[0]), _either(swap, name, names[0])
    for j in range(1, len(keys)):
        swap = _less(keys[j], names[j][0], key, name[0])
        keys[j - 1], names[j - 1] = dr.select(swap, keys[j], key), _either(swap, names[j], name)
        key, name = dr.select(swap, key, keys[j]), _either(swap, name, names[j])
    keys[-1], names[-1] = key, name
    return out, keys, names


def _either(first: Mask, a: list[UInt32], b: list[UInt32]) -> list[UInt32]:
    return [dr.select(first, x, y) for x, y in zip(a, b, strict=True)]
