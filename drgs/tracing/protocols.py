"""Interfaces between the modules of the engine: stream, kernel and sink.

A part (walk.py) walks its rays along a stream of candidate Gaussians and calls a kernel at each hit. Kernels composite
(kernels.py) or differentiate what was composited (derivatives.py, jacobian.py); the one of the Jacobian passes its rows
on to a sink. Where a *lane* is spoken of, it is one of Dr.Jit's: a lane carries one or four rays. What hands out parts
is a `Traversal` (walk.py); what all of them evaluate is a `Response` (responses.py).
"""

from __future__ import annotations

from typing import Any, Protocol

from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.primitives import Ray


class Candidates(Protocol):
    """Where the stream of a part comes from: the stream itself, or what is only made when it is walked along."""

    def opened(self) -> Stream:
        """The stream to walk along."""


class Stream(Candidates, Protocol):
    """Candidate Gaussians of every lane, one after the other; its state is part of that of Dr.Jit's loop."""

    def opened(self) -> Stream:
        """Itself."""
        return self

    def begin(self) -> Any:
        """State before the first candidate."""

    def more(self, state: Any) -> Mask:
        """Mask of lanes that have a candidate left."""

    def next(self, state: Any, active: Mask) -> tuple[UInt32, Mask, list, Float, Any]:
        """(Gaussian, whether there is one, its place, lower bound of its and all later order keys, new state).

        A place is a list: a number that no other candidate of the lane has and, of a ray through a tile, where it
        stands in the tile's list, which may be the same.
        """


class DividedStream(Stream, Protocol):
    """A stream of which some lanes can be taken."""

    def of(self, lanes: UInt32) -> DividedStream:
        """The stream of these lanes alone."""


class Kernel(Protocol):
    """What happens at a hit; its states, one dictionary a ray, are part of that of Dr.Jit's loop."""

    def init(self, k: int, alive: Mask, nowhere: Float | UInt32) -> dict:
        """State of shared ray k, with `alive` (UInt32); `nowhere`: the place of no hit."""

    def shade(self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask) -> list[dict]:
        """Meet Gaussian `index` on each ray, at places[k] in its order; new states, keys in the same order."""


class Sink(Protocol):
    """Consumer of the Jacobian's rows.

    Attributes:
        needs_color: It reads `Row.color`, even where there is no geometry.
    """

    needs_color: bool

    def init(self, k: int) -> dict:
        """What is kept along shared ray k: nothing, unless it says otherwise."""
        return {}

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list, states: list[dict]) -> list[dict]:
        """Add the rows of Gaussian `index`, one a shared ray; `hits`: lanes that have any."""
