"""The hits of pixels in exact order, searched along the lists of tiles, and sorted in one row for each pixel.

Rays through a tile meet the Gaussians of its list in orders of their own. The list is walked once, where a packet of
rays looks at one Gaussian at a time, and every hit is written into the row of its pixel as one number, a word, that
orders like (t*, index). Sorting short rows is what processors do fast; then each ray walks along its own row.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import drjit as dr
import torch

from drgs import runtime
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.primitives import Ray, trimmed_extent2
from drgs.tracing.records import load_record
from drgs.tracing.sort_keys import BEYOND, EMPTY, name_of, positive, word_of
from drgs.tracing.walk import ListStream, Part
from drgs.tracing.weights import PIXELS, signed

_TILES_PER_TASK = 64  # tiles that a thread sorts at a time; chosen


@dataclasses.dataclass
class MemoryBudget:
    """Memory that orders may be held in.

    Attributes:
        left: Bytes that are not taken yet.
    """

    left: int

    def take(self, size: int) -> bool:
        """Whether there is room for so many bytes, which are taken then."""
        fits = size <= self.left
        self.left -= size if fits else 0
        return fits


@dataclasses.dataclass(eq=False)
class SortedHits:
    """The hits of the pixels of some tiles, searched and sorted when a walk begins (`opened`).

    Attributes:
        in_lists: Function that makes a part with these pixels, four a lane, along the lists of the tiles.
        index: (entries,) Gaussians of all lists; of the same key the first entry is the nearer hit.
        lengths: (tiles,) of the lists of these tiles.
        cut: (tiles,) what is taken off the squared extents (`trimmed_extent2`), or None.
        budget: Memory to hold the order in once it is known.
        held: That order, where there was room.
    """

    lib: Lib
    in_lists: Callable[[], Part]
    index: UInt32
    lengths: torch.Tensor
    cut: Float | None
    budget: MemoryBudget
    held: SortedRows | None = None

    def opened(self) -> SortedRows:
        """The stream to walk along."""
        if self.held is not None:
            return self.held
        words, start, count = self._sorted()
        total = int(dr.sum(self.lib.UInt64(count))[0])
        if self.budget.take(4 * total):
            # The entries alone, one row behind the other: a fraction of what the words take.
            first = dr.cumsum(count) - count
            entries = self._entries(words, start, count, first, total)
            self.held = SortedRows(self.lib, self.index, first, first + count, entries)
            return self.held
        return SortedRows(self.lib, self.index, start, start + count, words)

    def _sorted(self) -> tuple[Float, UInt32, UInt32]:
        """Words of the hits, and of each pixel where its row starts and how many it has."""
        words, start, count = found_hits(self.lib, self.in_lists(), len(self.lengths), self.cut)
        sort_rows(words.torch(), self.lengths, signed(count).view(-1, PIXELS))
        return words, start, count

    def _entries(self, words: Float, start: UInt32, count: UInt32, first: UInt32, total: int) -> UInt32:
        """(total,) what the words name, in rows without gaps."""
        lib = self.lib
        entries = dr.zeros(self.lib.UInt32, max(total, 1))

        def body(i: UInt32) -> tuple[UInt32]:
            dr.scatter(entries, name_of(lib, dr.gather(lib.Float64, words, start + i)), first + i)
            return (i + 1,)

        with dr.suspend_grad():  # an order has no derivative
            dr.while_loop((dr.zeros(lib.UInt32, dr.width(count)),), lambda i: i < count, body)
        dr.eval(entries, first)
        return entries


def found_hits(lib: Lib, part: Part, tiles: int, cut: Float | None) -> tuple[Float, UInt32, UInt32]:
    """Words of the hits of a part along lists, in no order, and of each pixel where its row starts and how many it has.

    Args:
        tiles: Number of tiles.
        cut: (tiles,) what is taken off the squared extents (`trimmed_extent2`), or None.
    """
    lists: ListStream | Any = part.stream
    slots = part.slots
    assert slots is not None  # of a part along lists
    share = len(slots.columns)
    first = lists.start - slots.first
    own = lists.end - lists.start
    starts = [first * PIXELS + column * own for column in slots.columns]
    words = dr.full(lib.Float64, BEYOND, slots.size)
    lane = dr.arange(lib.UInt32, tiles * PIXELS // share)
    cut = None if cut is None else dr.gather(lib.Float, cut, lane // (PIXELS // share))
    dr.eval(words, starts, cut)
    found = part.run(_Finder(part, words, starts, cut))
    dr.eval(found, words)  # together: one kernel
    start, count = (dr.zeros(lib.UInt32, tiles * PIXELS) for _ in range(2))
    for column, at, state in zip(slots.columns, starts, found, strict=True):
        pixel = lane // (PIXELS // share) * PIXELS + column
        dr.scatter(start, at, pixel)
        dr.scatter(count, state["count"], pixel)
    dr.eval(start, count)
    return words, start, count


@dataclasses.dataclass(eq=False)
class SortedRows(ListStream):
    """Sorted hits, of each lane those from `start` to `end`; a `Stream`.

    Attributes:
        hits: Float64 words, whose names are entries of a list of Gaussians, `index`; or UInt32, the entries.
    """

    hits: Float | UInt32

    def next(self, i: UInt32, active: Mask) -> tuple[UInt32, Mask, list, Float, UInt32]:
        """One hit."""
        entry = dr.gather(type(self.hits), self.hits, i, active)
        if dr.type_v(self.hits) == dr.VarType.Float64:
            entry = name_of(self.lib, entry)
        return dr.gather(self.lib.UInt32, self.index, entry, active), active, [i, entry], EMPTY, i + 1


class _Finder:
    """Writes the word of every hit into the row of its pixel; a `Kernel`.

    Args:
        part: Rays that look for hits.
        words: Buffer of all rows.
        starts: Start of the row of each shared ray.
        cut: What is taken off the squared extents, or None.
    """

    def __init__(self, part: Part, words: Float, starts: list[UInt32], cut: Float | None) -> None:
        self.m = part.model
        self.records = part.records
        self.words = words
        self.starts = starts
        self.cut = cut

    def init(self, k: int, alive: Mask, nowhere: Float | UInt32) -> dict:
        """State of a ray: how many hits it has."""
        lib = self.m.lib
        return {"count": lib.UInt32(0), "alive": dr.select(alive, lib.UInt32(1), 0)}

    def shade(self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask) -> list[dict]:
        """Look at one Gaussian."""
        lib = self.m.lib
        out = []
        record = load_record(lib, self.records, index, active)
        record[self.m.extent2] = trimmed_extent2(self.m.s, record[self.m.extent2], self.cut)
        for start, ray, st, place in zip(self.starts, rays, states, places, strict=True):
            _, key, ok = self.m.hit(record, ray, active & (st["alive"] != 0))
            key = positive(lib, key) if self.m.signed else key
            word = dr.select(ok, word_of(lib, key, place[-1]), BEYOND)
            # A miss is written, too, where the next hit or nothing will be: a store under a mask that follows no
            # pattern costs several times as much.
            dr.scatter(self.words, word, start + st["count"], active)
            out.append({"count": st["count"] + dr.select(ok, lib.UInt32(1), 0), "alive": st["alive"]})
        return out


def sort_rows(words: torch.Tensor, lengths: torch.Tensor, counts: torch.Tensor) -> None:
    """Sort rows in place.

    Args:
        words: Flat, of the tiles one behind the other: `PIXELS` rows, each as long as the tile's list.
        lengths: (tiles,) of the lists.
        counts: (tiles, PIXELS) hits of each row; what is behind them is `BEYOND`.
    """
    if words.is_cuda:
        _sort_at_once(words, counts)
    else:
        _sort_by_tile(words, lengths, counts, runtime.backend().threads)


def _sort_at_once(words: torch.Tensor, counts: torch.Tensor) -> None:
    """Sort by words, then, stably, by rows: cards sort one long array faster than many short ones.

    Only hits are sorted, for half of the rows or more is behind them; hits stay in the same places.
    """
    places = (words != BEYOND).nonzero()[:, 0]
    row = torch.arange(counts.numel(), dtype=torch.int32, device=words.device)
    row = row.repeat_interleave(counts.reshape(-1), output_size=len(places))
    order = torch.sort(words[places]).indices
    order = order[torch.sort(row[order], stable=True).indices]
    words[places] = words[places[order]]


def _sort_by_tile(words: torch.Tensor, lengths: torch.Tensor, counts: torch.Tensor, threads: int) -> None:
    """NumPy sorts short rows in vector registers."""
    flat = words.numpy()
    most = counts.amax(1).tolist()
    ends = [0, *(PIXELS * lengths).cumsum(0).tolist()]

    def sort(first: int) -> None:
        for tile in range(first, min(first + _TILES_PER_TASK, len(most))):
            if most[tile] > 1:
                flat[ends[tile] : ends[tile + 1]].reshape(PIXELS, -1)[:, : most[tile]].sort(axis=1)

    lots = range(0, len(most), _TILES_PER_TASK)
    if min(threads, len(lots)) < 2:
        for first in lots:
            sort(first)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(sort, lots))
