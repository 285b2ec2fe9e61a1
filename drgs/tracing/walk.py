"""How rays walk along their Gaussians: in the order given, or in the exact order of each ray.

A `Part` is a set of lanes with one or four rays each and a stream of candidate Gaussians. On tiles the stream is in
order. That of the list of a tile serves all its pixels: 16 lanes carry four each, so that a record is loaded once for
64 pixels. In exact order a lane has one pixel, and its stream is that of its own hits, sorted beforehand (rows.py).

Rays without lists meet their candidates in any order. A lane has one of them and a sorted buffer of its hits: they
enter as they come, and the nearest leaves when a new one needs its place. A ray goes wrong only if a hit arrives in
front of one that has left; this is checked on every hit (the certificate), and such rays are walked again, with a
deeper buffer or along a sorted list of all their hits, so any depth is exact. A ray may stop at its transmittance limit
only where nothing that is still to come can lie in front: streams bound the keys to come from below.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import drjit as dr

from drgs import runtime
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.errors import own_errors
from drgs.tracing.kernels import HitModel
from drgs.tracing.peak import entry
from drgs.tracing.primitives import Projected, Ray
from drgs.tracing.protocols import Candidates, DividedStream, Kernel, Stream
from drgs.tracing.records import RECORD, load_record
from drgs.tracing.sort_keys import BEYOND, EMPTY, ascending, name_of, positive, push, word_of
from drgs.tracing.weights import PIXELS, Weights

BUFFER = 20  # hits that a ray is sorted among; a ray for which these are too few is walked again (docs/numerics.md)
# the same where these were too few; with 16 hits that was so of 40 to 80 % of a fit's rays (commit 07ccb400)
_DEEP_BUFFER = 48
_DEEP_FROM = 1000  # such rays, from which on compiling a kernel of their own is worth its time
NOWHERE = 0xFFFFFFFF  # place in a list of a ray that composited nothing
_WORD_BITS = 32  # bits of a word beside the key: the lane and the Gaussian
_MAX_SORTED_HITS = 1 << 25  # of one sorted list; longer ones are split by rays


def pixels_a_lane(basis: int = 0) -> int:
    """How many pixels of a tile share a lane along its list.

    Four on a CPU, which loads a Gaussian for all of them at once, unless each carries an SH basis: registers would not
    hold it. One on a card, whose memory is waited for by other lanes, the more the better, and whose registers hold no
    more.
    """
    return 1 if basis or runtime.backend().name == "cuda" else 4


@dataclasses.dataclass(eq=False)
class ListStream(Stream):
    """Entries of a list, of each lane those from `start` to `end`; a `Stream`.

    Attributes:
        index: (entries,) Gaussians.
        start, end: (lanes,) first entry of each lane, and that behind its last.
    """

    lib: Lib
    index: UInt32
    start: UInt32
    end: UInt32

    def begin(self) -> UInt32:
        """The place of the first entry."""
        return self.lib.UInt32(self.start)

    def more(self, i: UInt32) -> Mask:
        """Whether there is an entry left."""
        return i < self.end

    def next(self, i: UInt32, active: Mask) -> tuple[UInt32, Mask, list, Float, UInt32]:
        """One entry."""
        return dr.gather(self.lib.UInt32, self.index, i, active), active, [i], EMPTY, i + 1


@dataclasses.dataclass(frozen=True)
class Slots:
    """Where tables have the entries of some tiles' lists in each pixel of these tiles.

    Attributes:
        first: First entry of these lists among those of the whole view.
        size: Number of slots: entries times pixels of a tile, one entry to spare.
        columns: Pixel of the tile that each shared ray belongs to.
    """

    first: UInt32
    size: int
    columns: list[UInt32]


@dataclasses.dataclass(eq=False)
class Part:
    """Lanes, their rays and pixels, and the stream of candidates.

    Attributes:
        model: The formula of a hit.
        records: Flat record buffer of the view.
        rays: One or four a lane, all of which walk along the same stream.
        flat: Pixel (row-major index) that each shared ray belongs to.
        inside: Whether, of each shared ray, there is such a pixel and this part decides it.
        stream: Candidate Gaussians of every lane.
        ordered: Rays sort their candidates on the way; else these come in the order in which they are composited.
        center_key: (N,) order keys of Gaussians that are sorted by their centers; None where a ray's own order counts.
        buffer: Number of hits that a ray is sorted among.
        first: These rays were not walked before, with a shorter buffer.
        slots: Places of entries and pixels in tables, for rays through tiles; None for others. A hit's place is then
            where it stands in the ray's row and in the tile's list.
        in_lists: Makes a part with the same rays along the lists of their tiles; of rays that walk along rows of their
            own hits.
        weights: Holds the weights of these rays; None where they are not held.
        failed: Lanes whose buffer was too short, after a primal pass of rays that sort.
    """

    lib: Lib
    model: HitModel
    records: Float
    rays: list[Ray]
    flat: list[UInt32]
    inside: list[Mask]
    stream: Candidates
    _: dataclasses.KW_ONLY
    ordered: bool
    center_key: Float | None = None
    buffer: int = dataclasses.field(default_factory=lambda: BUFFER)  # as it is then, too
    first: bool = True
    slots: Slots | None = None
    in_lists: Callable[[], Part] | None = None
    weights: Weights | None = None
    failed: Mask = None

    @property
    def reduction(self) -> dr.ReduceMode:
        """How sums by Gaussian are added up: first over a packet of lanes, where all of it meets the same one."""
        return dr.ReduceMode.Direct if self.ordered or self.in_lists is not None else dr.ReduceMode.Local

    def slot(self, k: int, place: list) -> UInt32:
        """Where a table has shared ray k at a place in its order, which ends with that in the list."""
        assert self.slots is not None
        return (place[-1] - self.slots.first) * PIXELS + self.slots.columns[k]

    def reject(self) -> UInt32:
        """Take the rays whose order the certificate has refuted (`run` with `check`) out of this part: their lanes."""
        failed = self.failed & self.inside[0]
        lanes = dr.compress(failed)
        self.inside = [self.inside[0] & ~failed]
        dr.eval(self.inside)
        return lanes

    def again(self, lanes: UInt32) -> list[Part]:
        """Parts that walk some of the rays again, given by their lanes: many with a deeper buffer, where some may fail
        again; few along sorted lists of all their hits.
        """
        count = dr.width(lanes)
        if count == 0:
            return []
        pick = lambda x: None if x is None else dr.gather(type(x), x, lanes)  # noqa: E731
        rays = [Ray(pick(r.x), pick(r.y), pick(r.length), [pick(v) for v in r.carried], r.basis) for r in self.rays]
        divided: DividedStream | Any = self.stream
        flat = [pick(f) for f in self.flat]
        stream = divided.of(lanes)
        dr.eval(rays, flat)
        inside = [self.lib.Bool(True)]
        part = dataclasses.replace(
            self, rays=rays, flat=flat, inside=inside, stream=stream, buffer=_DEEP_BUFFER, first=False
        )
        return [part] if count >= _DEEP_FROM and self.buffer < _DEEP_BUFFER else part._listed(count)

    def _listed(self, count: int) -> list[Part]:
        """Parts with the same rays along sorted lists of all their hits."""
        lib = self.lib
        with dr.suspend_grad():  # lists say what to look at, and in which order: neither has a derivative
            hits = self._each_hit(count, lambda *hit: None)
            dr.eval(hits)
            total = int(dr.sum(lib.UInt64(hits))[0])
            gaussians = dr.width(self.records) // RECORD
            bits = max(1, (gaussians - 1).bit_length())
            if (total > _MAX_SORTED_HITS or (count - 1) >> max(_WORD_BITS - bits, 0)) and count > 1:
                half = dr.arange(lib.UInt32, count // 2)
                rest = dr.arange(lib.UInt32, count - dr.width(half)) + dr.width(half)
                return [part for lanes in (half, rest) for part in self.again(lanes)]
            start = dr.cumsum(hits) - hits
            index = self._sorted_hits(start, total, bits)
        stream = ListStream(lib, index, start, start + hits)
        return [dataclasses.replace(self, stream=stream, ordered=False)]

    def _sorted_hits(self, start: UInt32, total: int, bits: int) -> UInt32:
        """The hits of each ray, from its `start` on, by (key, Gaussian); indices of Gaussians have so many bits."""
        lib = self.lib
        count = dr.width(start)
        words = dr.zeros(lib.UInt64, max(total, 1))
        own = lib.UInt64(dr.arange(lib.UInt32, count)) << (32 + bits)

        def write(k: UInt32, candidate: UInt32, key: Float, ok: Mask) -> None:
            # Keys are >= 0, where floats order like their bits.
            word = own | (lib.UInt64(dr.reinterpret_array(lib.UInt32, key)) << bits) | lib.UInt64(candidate)
            dr.scatter(words, word, start + k, ok)

        dr.eval(self._each_hit(count, write), words)
        index = lib.UInt32(ascending(lib, words) & ((1 << bits) - 1))
        dr.eval(index, start)
        return index

    def _each_hit(self, lanes: int, visit: Callable) -> UInt32:
        """Number of hits of every lane; `visit(number so far, Gaussian, key, is hit)` sees each candidate."""
        lib = self.lib
        ray = self.rays[0]
        stream = self.stream.opened()

        def body(s: Any, k: UInt32) -> tuple:
            candidate, valid, _, _, s = stream.next(s, lib.Bool(True))
            key, ok = self._probe(candidate, ray, valid)
            visit(k, candidate, key, ok)
            return s, k + dr.select(ok, lib.UInt32(1), 0)

        return dr.while_loop((stream.begin(), dr.zeros(lib.UInt32, lanes)), lambda s, k: stream.more(s), body)[1]

    def run(self, kernel: Kernel, check: bool = False) -> list[dict]:
        """Walk all rays with a kernel: final states of each shared ray; `check` keeps the certificate in `failed`."""
        # Kernels differentiate on their own: nothing of the loop is recorded.
        with own_errors(), dr.suspend_grad():
            if not self.ordered:
                return self._in_order(kernel)
            return self._sorted(kernel, check)

    def _in_order(self, kernel: Kernel) -> list[dict]:
        """Composite the candidates as they come."""
        lib = self.lib
        stream = self.stream.opened()
        states = [kernel.init(k, inside, lib.UInt32(NOWHERE)) for k, inside in enumerate(self.inside)]
        start = stream.begin()

        def body(s: Any, go: UInt32, states: list[dict]) -> tuple:
            index, valid, place, _, after = stream.next(s, lib.Bool(True))
            states = kernel.shade(index, self.rays, states, [place] * len(self.rays), valid)
            alive = sum((st["alive"] for st in states), lib.UInt32(0))
            return after, dr.select(stream.more(after) & (alive != 0), lib.UInt32(1), 0), states

        go = dr.select(stream.more(start), lib.UInt32(1), 0)
        return dr.while_loop((start, go, states), lambda s, go, states: go != 0, body)[2]

    def _probe(self, index: UInt32, ray: Ray, active: Mask) -> tuple[Float, Mask]:
        """Order key of a candidate, and whether it is a hit."""
        lib = self.lib
        record = load_record(lib, self.records, index, active)
        _, key, ok = self.model.hit(record, ray, active)
        if self.center_key is not None:
            return dr.gather(lib.Float, self.center_key, index, ok), ok
        if self.model.s.order == "entry":
            key = entry(record, ray)
        return positive(lib, key) if self.model.signed else key, ok

    def _sorted(self, kernel: Kernel, check: bool) -> list[dict]:
        """Composite through a sorted buffer: a hit leaves it when it is the nearest and a new one needs its place."""
        lib = self.lib
        stream = self.stream.opened()
        size = self.buffer
        U, word = lib.UInt32, lib.Float64
        state = kernel.init(0, self.inside[0], word(EMPTY))
        start = stream.begin()

        def exchange(enter: Float, buffer: list[Float], last: Float, state: dict) -> tuple:
            """Put a hit into the buffer and composite the one that leaves it."""
            hit, buffer = push(enter, buffer)
            ok = (hit != EMPTY) & (hit < BEYOND)
            (state,) = kernel.shade(name_of(lib, hit), self.rays, [state], [[hit]], ok)
            return buffer, dr.select(ok, hit, last), state

        def body(s: Any, go: UInt32, buffer: list[Float], last: Float, failed: UInt32, state: dict) -> tuple:
            """Meet the next candidate; `last` left the buffer last, `failed` is 1 where a hit came too late."""
            there = stream.more(s)
            candidate, valid, _, bound, s = stream.next(s, there)
            key, ok = self._probe(candidate, self.rays[0], valid)
            hit = word_of(lib, key, candidate)
            if check:
                failed = dr.select(ok & (hit < last), 1, failed)
            # When all have come, what is left in the buffer is pushed out.
            alive = state["alive"] != 0
            enter = dr.select(alive, dr.select(there, dr.select(ok, hit, EMPTY), BEYOND), EMPTY)
            # Most candidates miss most packets of lanes: the branch skips the rest for these.
            buffer, last, state = dr.if_stmt(
                (enter, buffer, last, state), enter != EMPTY, exchange, lambda _, *unchanged: unchanged
            )
            alive = state["alive"] != 0
            there = stream.more(s)
            going = alive & (there | (buffer[0] < BEYOND))
            if check:
                going |= there & (word_of(lib, bound, U(0)) <= last)
            return s, dr.select(going, U(1), 0), buffer, last, failed, state

        go = dr.select(stream.more(start) & (state["alive"] != 0), U(1), 0)
        loop = (start, go, [word(EMPTY)] * size, word(EMPTY), U(0), state)
        *_, failed, state = dr.while_loop(loop, lambda s, go, *_: go != 0, body)
        self.failed = failed != 0
        return [state]


class Traversal(Protocol):
    """The rays of a view, and where they look for Gaussians.

    Attributes:
        projected: The Gaussians of the view.
        world: Their records are world records.
        rays: How many there are, in the order of the pixels.
        certificate: What the traversal says of its lists, after `start`.
        holes: (rays,) UInt32, 0 for pixels that have no ray and show the background; None if all have one.
    """

    projected: Projected
    world: bool
    rays: int
    certificate: dict
    holes: UInt32 | None

    def start(self, model: HitModel, records: Float, carried: list[Float], basis: int, replayed: bool) -> None:
        """Build lists or proxies from the record buffer.

        Args:
            model: The formula of a hit.
            records: Flat record buffer.
            carried: Floats a ray, `basis` of them an SH basis.
            basis: Number of SH basis values.
            replayed: Derivatives follow: what they need again may be held.
        """

    def parts(self, share: int) -> list[Part]:
        """All rays, `share` (1 or 4) a lane."""

    def weighed(self, share: int, size: int) -> list[Part]:
        """All rays, in parts whose weights are held, `size` bytes each; where there are no lists, as `parts`."""
