"""What the parts of the engine ask of each other: traversal, stream, kernel and sink.

A traversal hands out parts (walk.py). A part walks its rays along a stream of candidate Gaussians and calls a kernel
at each hit. Kernels composite (kernels.py) or differentiate what was composited (derivatives.py, jacobian.py); the one
of the Jacobian passes its rows on to a sink. Where a *lane* is spoken of, it is one of Dr.Jit's: a lane carries one or
four rays. `Response` (responses/) is what all of them evaluate. The names
of arrays in signatures are defined here, too.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from drgs.tracing.kernels import HitModel, Ray
    from drgs.tracing.projection import Projected
    from drgs.tracing.walk import Part

__all__ = [
    "DividedStream",
    "Float",
    "Int32",
    "Kernel",
    "Lib",
    "Mask",
    "Sink",
    "Stream",
    "Traversal",
    "UInt32",
    "UInt64",
]

Lib = ModuleType  # the module of Dr.Jit's array types of the backend (runtime.dr_types)

# For signatures: what an array holds. Its class depends on the backend, so type checkers see `Any`.
Float = Any  # Float, or Float64 where a Gaussian is projected
UInt32 = Any
UInt64 = Any
Int32 = Any
Mask = Any  # Bool


class Traversal(Protocol):
    """The rays of a view, and where they look for Gaussians.

    Attributes:
        projected: The Gaussians of the view.
        world: Their records are world records.
        rays: How many there are, in the order of the pixels.
        certificate: After `start`: what it says of lists.
    """

    projected: Projected
    world: bool
    rays: int
    certificate: dict

    def start(self, model: HitModel, records: Float, carried: list[Float], basis: int, replayed: bool) -> None:
        """Build lists or proxies from the record buffer; `carried`: per-ray floats, `basis` of them an SH basis;
        `replayed`: derivatives follow, what they need again may be held.
        """

    def parts(self, share: int) -> list[Part]:
        """All rays, `share` (1 or 4) a lane."""

    def weighed(self, share: int, size: int) -> list[Part]:
        """All rays, in parts whose weights are held, `size` bytes each; where there are no lists, as `parts`."""


class Stream(Protocol):
    """Candidate Gaussians of every lane, one after the other; its state is part of that of Dr.Jit's loop."""

    def opened(self) -> Stream:
        """What is walked along: itself, or what is made now."""

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
    """One of which some lanes can be taken."""

    def of(self, lanes: UInt32) -> DividedStream:
        """The same for these lanes."""


class Kernel(Protocol):
    """What happens at a hit; its states, one dictionary a ray, are part of that of Dr.Jit's loop."""

    def init(self, k: int, alive: Mask, nowhere: Float | UInt32) -> dict:
        """State of shared ray k, with `alive` (UInt32); `nowhere`: the place of no hit."""

    def shade(self, index: UInt32, rays: list[Ray], states: list[dict], places: list[list], active: Mask) -> list[dict]:
        """Meet Gaussian `index` on each ray, at places[k] in its order; new states, keys in the same order."""


class Sink(Protocol):
    """What becomes of the Jacobian's rows.

    Attributes:
        needs_color: It reads `Row.color`, even where there is no geometry.
    """

    needs_color: bool

    def init(self) -> dict:
        """What is kept per ray."""

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list, states: list[dict]) -> list[dict]:
        """Add the rows of Gaussian `index`, one a shared ray; `hits`: lanes that have any."""
