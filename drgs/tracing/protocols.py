"""What the parts of the engine ask of each other: traversal, stream, kernel and sink.

A traversal hands out parts (walk.py). A part walks its rays along a stream of candidate Gaussians and calls a kernel
at each hit. Kernels composite (kernels.py) or differentiate what was composited (derivatives.py, jacobian.py); the one
of the Jacobian passes its rows on to a sink. Where a *lane* is spoken of, it is one of Dr.Jit's: a lane carries one or
four rays. `Response` (responses/) is what all of them evaluate.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from drgs.tracing.kernels import HitModel
    from drgs.tracing.projection import Projected
    from drgs.tracing.walk import Part

__all__ = ["Kernel", "Sink", "Stream", "Traversal"]


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

    def start(self, model: HitModel, records, carried: list, basis: int) -> None:
        """Build lists or proxies from the record buffer; `carried`: per-ray floats, `basis` of them an SH basis."""

    def parts(self, share: int) -> list[Part]:
        """All rays, `share` (1 or 4) a lane."""


class Stream(Protocol):
    """Candidate Gaussians of every lane, one after the other; its state is part of that of Dr.Jit's loop."""

    def begin(self) -> Any:
        """State before the first candidate."""

    def more(self, state) -> Any:
        """Mask of lanes that have a candidate left."""

    def place(self, state) -> Any:
        """UInt32, different for each candidate of a lane: where it stands in the stream."""

    def next(self, state, active) -> tuple:
        """(Gaussian, whether there is one, lower bound of its and all later order keys, new state)."""

    def of(self, lanes) -> Stream:
        """The same for some of the lanes."""


class Kernel(Protocol):
    """What happens at a hit; its states, one dictionary a ray, are part of that of Dr.Jit's loop."""

    def init(self, k: int, alive, nowhere: list) -> dict:
        """State of shared ray k, with `alive` (UInt32); `nowhere`: the place of no hit."""

    def shade(self, index, rays: list, states: list[dict], places: list[list], active) -> list[dict]:
        """Meet Gaussian `index` on each ray, at places[k] in its order; new states, keys in the same order."""


class Sink(Protocol):
    """What becomes of the Jacobian's rows.

    Attributes:
        needs_color: It reads `Row.color`, even where there is no geometry.
    """

    needs_color: bool

    def init(self) -> dict:
        """What is kept per ray."""

    def take(self, lib, index, hits, rows: list, states: list[dict]) -> list[dict]:
        """Add the rows of Gaussian `index`, one a shared ray; `hits`: lanes that have any."""
