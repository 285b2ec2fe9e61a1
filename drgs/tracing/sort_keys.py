"""Numbers that are sorted: a hit as one of them, a word, which orders like (t*, name) and holds both; and sorting."""

from __future__ import annotations

import drjit as dr
import numpy as np
import torch

from drgs import runtime
from drgs.tracing.arrays import Float, Lib, UInt32, UInt64
from drgs.tracing.recordings import padded

EMPTY = -1.0  # "no hit"; order keys of hits are >= 0
BEYOND = 1e308  # above the word of any hit
_VECTOR_SORT_THREADS = 4  # threads up to which one sort in vector registers is faster than a radix sort by all of them
_MIN_KEY = 1.2e-38  # of keys: below, float32 is not normal


def word_of(lib: Lib, key: Float, name: UInt32) -> Float:
    """Float64 that orders like (key, name): positive floats order like their bits, and these are those of the key
    before those of the name. Processors exchange floats faster than integers. `EMPTY` for a key below 0.
    """
    # Where the float32 is not normal the float64 would not be, and might become 0.
    key = dr.select(key >= 0, dr.maximum(key, _MIN_KEY), EMPTY)
    bits = lib.UInt64(dr.reinterpret_array(lib.UInt32, key)) << 32
    return dr.reinterpret_array(lib.Float64, bits | lib.UInt64(name))


def positive(lib: Lib, x: Float) -> Float:
    """A number >= 0 that orders like x, of either sign, up to the last bit of x."""
    # Infinities and what is near them would have the bits of NaN, whose comparisons are all false.
    bits = dr.reinterpret_array(lib.UInt32, dr.clip(x, -1e37, 1e37))
    sign = lib.UInt32(0x80000000)
    return dr.reinterpret_array(lib.Float, dr.select((bits & sign) != 0, ~bits, bits | sign) >> 1)


def name_of(lib: Lib, word: Float) -> UInt32:
    """The name in a word."""
    return lib.UInt32(dr.reinterpret_array(lib.UInt64, word) & 0xFFFFFFFF)


def push(word: Float, buffer: list[Float]) -> tuple[Float, list[Float]]:
    """Insert into an ascending buffer and take its smallest out; pushing `EMPTY` changes nothing."""
    shifted = []
    for old in buffer:
        first = word < old
        shifted.append(dr.select(first, word, old))
        word = dr.select(first, old, word)
    return shifted[0], [*shifted[1:], word]


def ascending(lib: Lib, keys: UInt64) -> UInt64:
    """Sorted; evaluated."""
    if _by_torch():
        # Dr.Jit's sort by digits is forty launches, which take ten times as long as sorting.
        top = lib.UInt64(1 << 63)  # torch knows signed numbers only
        return lib.UInt64(lib.Int64(torch.sort(lib.Int64(keys ^ top).torch()).values)) ^ top
    if runtime.backend().threads > _VECTOR_SORT_THREADS:
        keys = dr.sort(keys)
        dr.eval(keys)
        return keys
    # A third of the time of Dr.Jit's sort by digits on one thread, and none of its 24 launches, for each of which
    # threads wait on a busy machine.
    return lib.UInt64(np.sort(keys.numpy()))


def compacted(lib: Lib, keys: UInt64, empty: int, count: int | None = None) -> tuple[UInt64, int]:
    """The keys that are not the largest number, `empty`, in their order, and behind them as many of these as `padded`
    says; and how many they are.

    Args:
        count: So many at the beginning are, and no others; None: it is not known.
    """
    if count is None:
        kept = dr.compress(keys != empty)
        count = dr.width(kept)
        if not count:
            return dr.full(lib.UInt64, empty, padded(1)), 0
    elif padded(count) == dr.width(keys):
        return keys, count
    else:
        kept = dr.arange(lib.UInt32, count)
    found = dr.full(lib.UInt64, empty, padded(count))
    dr.scatter(found, dr.gather(lib.UInt64, keys, kept), dr.arange(lib.UInt32, count))
    dr.eval(found)
    return found, count


def _by_torch() -> bool:
    """Whether torch sorts."""
    return runtime.backend().name == "cuda"
