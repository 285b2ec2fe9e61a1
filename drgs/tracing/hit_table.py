"""The replay of hits that derivatives have in common, and a table of transmittances for it, along a list's order.

Rays sort their hits each on their own, so that the lanes of a packet are at different Gaussians: each loads a record of
its own, and adds to gradients of its own, atomically. But all that a derivative needs of the order are a few numbers a
hit, the transmittance T in front of it and what lies behind it. One walk in exact order fills a table of these, for
every entry of a tile's list and every pixel of the tile; the derivative then walks along the list, where a packet meets
one Gaussian at a time.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import drjit as dr

from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.kernels import Channels, HitModel
from drgs.tracing.primitives import Ray
from drgs.tracing.walk import Part


class Table:
    """T in front of every entry in every pixel, and what lies behind it per unit of transmittance; T = 0: no hit.

    Args:
        part: Rays in the order of the lists of tiles, by which it is read.
        count: How many numbers say what lies behind.
    """

    def __init__(self, lib: Lib, part: Part, count: int) -> None:
        assert part.slots is not None  # of a part along the lists of tiles
        self.lib = lib
        self.part = part
        self.count = 1 << count.bit_length()  # numbers of a slot: so many are written at once
        self.numbers = 1 + count
        self.array = dr.zeros(lib.Float, self.count * part.slots.size)

    def load(self, k: int, place: list, active: Mask) -> list[Float]:
        """T at a place of shared ray k, 0 where there is no hit, and what lies behind it."""
        slot = self.part.slot(k, place)
        return list(dr.gather(self.lib.ArrayXf, self.array, slot, active, shape=(self.count, dr.width(slot))))


class HitReplay(abc.ABC):
    """What derivatives have in common that replay a primal pass hit by hit: a `Kernel`, but for `take`.

    A hit needs the transmittance in front of it and the sums behind it. Along the ray's own order both are counted down
    from the final state of the ray, in float64; in any other order a table has them.

    Args:
        model: Says what a hit is.
        channels: What the primal pass composited.
        finals: Final state of the primal pass, of each shared ray; not needed with a table.
        table: Says what there is of each hit, in whatever order they come.
    """

    def __init__(self, model: HitModel, channels: Channels, finals: list[dict], table: Table | None) -> None:
        self.m = model
        self.channels = channels
        self.finals = finals
        self.table = table

    @abc.abstractmethod
    def rest(self, k: int) -> list[Float]:
        """Float64 sums along shared ray k, of which each hit takes its part."""

    @abc.abstractmethod
    def terms(self, k: int, values: list[Float], depth: Float, place: list, ok: Mask) -> list[Float]:
        """What a hit's weight is multiplied by in each sum; `values` are the channels of the hit."""

    @abc.abstractmethod
    def take(
        self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask, record: Any
    ) -> list[dict]:
        """A hit that some ray of the packet has; `record`: of the Gaussian, None where it has not been read."""

    def begun(self, k: int, alive: Mask, nowhere: Float | UInt32) -> tuple[dict, Mask]:
        """State of shared ray k in front of its first hit, and whether it has any."""
        if self.table is not None:
            return {}, alive
        return {"T": self.m.lib.Float(1), "rest": self.rest(k)}, alive & (self.finals[k]["place"] != nowhere)

    def going(self, states: list[dict], active: Mask) -> Mask:
        """Lanes with a ray that goes on."""
        return active & (sum((s["alive"] for s in states), self.m.lib.UInt32(0)) != 0)

    def shade(self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask) -> list[dict]:
        """`take` where a ray of the packet meets the Gaussian, else the same states.

        Most Gaussians of a tile's list miss most packets of its rays, and the branch is cheaper than what it skips.
        """
        lib = self.m.lib
        record: Any = None
        if self.table is None:
            record = self.channels.load(lib, index, rays[0], self.going(states, active), only="record")["record"]
        hits = lib.Bool(False)
        known = []
        for k, (ray, st, place) in enumerate(zip(rays, states, places, strict=True)):
            live = active & (st["alive"] != 0)
            if self.table is None:
                hits |= self.m.hit(record, ray, live)[2]
            else:
                known.append([self.table.load(k, place, live), *place])
                hits |= known[k][0][0] > 0
        return dr.if_stmt(
            (states, index, rays, known or places, active),
            hits,
            lambda states, index, rays, places, active: self.take(index, rays, states, places, active, record),
            lambda states, *_: states,
        )

    def replayed(
        self, k: int, st: dict, a: Float, terms: list[Float], place: list, ok: Mask
    ) -> tuple[Float, Float, list[Float], dict, Mask]:
        """A hit of opacity `a` on shared ray k: T in front of it, its weight, what lies behind it per unit of
        transmittance, the new state of the ray, and whether it is a hit.

        Args:
            st: State with `T`, `alive` and `rest`, a Float64 for each term.
            terms: As of the method.
            place: With a table, what it loaded comes first.
            ok: Whether it is a hit by the model; a table decides by itself.
        """
        T: Float
        if self.table is not None:
            T, *behind = place[0]
            return T, T * a, behind[: self.table.numbers - 1], dict(st), T > 0
        T = st["T"]
        left = 1 - a
        new = dict(st)
        wide = dr.float64_array_t(a)
        w = dr.select(ok, T * a, 0)
        rest = [r - wide(w) * wide(term) for r, term in zip(st["rest"], terms, strict=True)]
        # Behind an a that rounds to 1 nothing was composited: there is no rest to share out.
        share = dr.select(left > 0, dr.rcp(dr.select(left > 0, left, 1)), 0)
        behind = [type(a)(r) * share for r in rest]
        new["T"] = dr.select(ok, T * left, T)
        new["rest"] = [dr.select(ok, x, y) for x, y in zip(rest, st["rest"], strict=True)]
        # The last composited hit ends the ray, whatever rule ended the primal pass.
        new["alive"] = dr.select(ok & (place[0] == self.finals[k]["place"]), 0, st["alive"])
        return T, w, behind, new, ok


def along_lists(
    lib: Lib, part: Part, finals: list[dict], count: int | None, kernel: Callable[[Part, list[dict]], HitReplay]
) -> tuple[Part, list[dict], Table | None]:
    """What a derivative walks of a part: its rays with their final states; in place of rays along rows of their own
    hits the same ones along the lists of tiles, with a table.

    Args:
        count: How many numbers say what lies behind a hit; None: no table, all rays as they are.
        kernel: Part, final states -> what says how these numbers are summed up.
    """
    if count is None or part.in_lists is None:
        return part, finals, None
    table = Table(lib, part.in_lists(), count)
    dr.eval(part.run(_TableFiller(kernel(part, finals), part, table)), table.array)
    return table.part, [], table


class _TableFiller:
    """Replay of a primal pass in exact order that fills a table.

    Args:
        kernel: Takes the derivative afterwards, and says what is summed up along a ray.
        part: Rays that are replayed, in the table's tiles.
        table: The table that is filled.
    """

    def __init__(self, kernel: HitReplay, part: Part, table: Table) -> None:
        self.kernel = kernel
        self.part = part
        self.table = table
        self.m = kernel.m

    def init(self, k: int, alive: Mask, nowhere: Float | UInt32) -> dict:
        """State of a ray: what is left of each sum behind the last hit."""
        state, alive = self.kernel.begun(k, alive, nowhere)
        return state | {"alive": dr.select(alive, self.m.lib.UInt32(1), 0)}

    def shade(self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask) -> list[dict]:
        """One hit."""
        kernel, table = self.kernel, self.table
        (ray,) = rays
        (st,) = states
        (place,) = places
        going = active & (st["alive"] != 0)
        loaded: Any = kernel.channels.load(self.m.lib, index, ray, going)
        a, depth, ok = self.m.hit(loaded["record"], ray, going)
        terms = kernel.terms(0, kernel.channels.values(self.m, loaded, ray), depth, place, ok)
        T, _, behind, new, _ = kernel.replayed(0, st, a, terms, place, ok)
        numbers = [T, *behind, *[self.m.lib.Float(0)] * (table.count - table.numbers)]
        dr.scatter(table.array, self.m.lib.ArrayXf(numbers), self.part.slot(0, place), ok)
        return [new]
