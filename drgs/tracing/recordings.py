"""Steps of a frame whose kernels are recorded once and launched again, without being traced.

To trace a frame, Python writes down some thousand operations that are the same ones in every frame: as long as nothing
but the numbers in arrays changes. `replay` runs a step by `dr.freeze`, which keeps its launches. What `dr.freeze` does
not see to is in the key of a recording here: all that a step depends on besides numbers in arrays, and the width of
every array, because a launch whose size does not follow from widths would keep that of the recording.

So a step is a function of a module, without a closure, of two arguments: what it is for (hashable, of which each other
value is another recording) and its arrays. It must not read a number back from an array, which Dr.Jit would not notice.
An array that it takes from elsewhere is refused by Dr.Jit. What it calls is part of the recording: whoever replaces a
function of the engine, in a test, asks for `without_recordings`.
"""

from __future__ import annotations

import contextlib
import functools
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import drjit as dr

from drgs import runtime
from drgs.tracing.errors import own_errors

_MAX_RECORDINGS = 256  # steps that are kept; the one that was used least recently goes first
_MAX_VARIANTS = 4  # of a step, by what Dr.Jit itself distinguishes: alignment, arrays that are the same one
_STEPS_AN_OCTAVE = 8  # of `padded`
_held: OrderedDict[Hashable, Any] = OrderedDict()

_are_on = True


def are_on() -> bool:
    """Whether frames are made of recorded steps: not within `without_recordings`, and not where Dr.Jit's flag for them
    is off.
    """
    return _are_on and dr.flag(dr.JitFlag.KernelFreezing)


@contextlib.contextmanager
def without_recordings() -> Iterator[None]:
    """Frames are traced within, each anew."""
    global _are_on
    before, _are_on = _are_on, False
    try:
        yield
    finally:
        _are_on = before


Step = Callable[[Any, dict], Any]


def replay(step: Step, what: Hashable, arrays: dict) -> Any:
    """`step(what, arrays)`, evaluated: launched as it was recorded for arrays of these widths, if it was.

    Args:
        what: All that the step depends on but numbers in arrays.
        arrays: Evaluated arrays without a graph, in dictionaries and lists.
    """
    chosen = runtime.backend()
    key = step, what, chosen.variant, dr.thread_count(), _widths(arrays)
    recorded = _held.get(key)
    if recorded is None:
        recorded = _held[key] = _recorded(step, what)
        if len(_held) > _MAX_RECORDINGS:
            _held.popitem(last=False)
    else:
        _held.move_to_end(key)
    try:
        with own_errors():
            return recorded(arrays)
    except BaseException:
        _held.pop(key, None)  # what was recorded in part
        raise


def _recorded(step: Step, what: Hashable) -> Any:
    """A step for one purpose as a function of its arrays."""

    # Dr.Jit hashes what a function closes over, under its lock: the hash of settings is Python, where the interpreter
    # may go on with another thread, which then waits for that lock for ever. A partial is hashed by its identity.
    whole = functools.partial(step, what)

    def run(arrays: dict) -> Any:
        return whole(arrays)

    return dr.freeze(run, limit=_MAX_VARIANTS, warn_after=1_000_000)


def _widths(x: Any) -> Hashable:
    """Types and widths of arrays, in the order of their containers."""
    if isinstance(x, dict):
        return tuple((name, _widths(value)) for name, value in x.items())
    if isinstance(x, list | tuple):
        return tuple(_widths(value) for value in x)
    return type(x), len(x)


def padded(count: int) -> int:
    """The next larger of eight numbers between a power of two and the next: widths that vary from frame to frame are
    made that long, so that few of them differ.
    """
    step = max((1 << count.bit_length()) // (2 * _STEPS_AN_OCTAVE), 16)
    return -(-count // step) * step
