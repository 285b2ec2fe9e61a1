"""Which steps a schedule runs over, and which times the photographs of a fit are of; of every fit, also of what stands
still, and therefore without what moves (components/motion.py).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from drgs.cameras import at_first_time

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.data import Dataset
    from drgs.fitting.config import FitConfig

_FEWEST_PHOTOGRAPHS = 3  # photographs of one time that show the depth of things, with one to spare


class _Seen(Protocol):
    """A view or a photograph."""

    @property
    def camera(self) -> Camera:
        """Whose time counts."""

    @property
    def name(self) -> str:
        """For messages."""


_T = TypeVar("_T", bound=_Seen)


@dataclasses.dataclass(frozen=True)
class Stage:
    """Steps over which density control runs through its schedule once.

    Attributes:
        begin, end: The first of them, and the one after the last.
        budget: Part of the Gaussians that there may be.
    """

    begin: int
    end: int
    budget: float = 1.0

    @property
    def length(self) -> int:
        """How many steps."""
        return self.end - self.begin


def dynamic_stage(config: FitConfig) -> Stage:
    """The steps of a fit to what moves that come after those that fit what stands still."""
    return Stage(round(config.motion.static_share * config.max_steps), config.max_steps)


def fitted_times(config: FitConfig, train: Sequence[_Seen], test: Sequence[_Seen]) -> tuple[float, ...]:
    """The distinct times of all views that a fit distinguishes, sorted; none if nothing can have moved in the training
    views, or is to.

    Raises:
        ValueError: If some views have a time and others do not.
    """
    if config.motion.dynamics == "ignore" or not times_of(train):
        return ()
    return times_of([*train, *test])


def times_of(views: Sequence[_Seen]) -> tuple[float, ...]:
    """The distinct times of views, sorted; none if nothing can have moved: there is one time, or no view has one.

    Raises:
        ValueError: If some views have a time and others do not.
    """
    times = {view.camera.time for view in views}
    if None in times and len(times) > 1:
        name = next(view.name for view in views if view.camera.time is None)
        raise ValueError(
            f"fit: all training views must have a time or none, {name!r} has none; add it, or use --dynamics ignore"
        )
    return tuple(sorted(t for t in times if t is not None)) if len(times) > 1 else ()


def first_time(views: Sequence[_T]) -> list[_T]:
    """Those of `drgs.cameras.at_first_time`; all, where these are fewer than 3."""
    found = [views[i] for i in at_first_time([view.camera for view in views])]
    return found if len(found) >= _FEWEST_PHOTOGRAPHS else list(views)


def shows_first_time(views: Sequence[_Seen]) -> bool:
    """Whether `first_time` is of the first time alone."""
    return len({view.camera.time for view in first_time(views)}) == 1


def spacing(times: Sequence[float]) -> float:
    """Median time between one photograph and the next of another time; 1 where there is one time."""
    apart = np.diff(np.unique(times))
    return float(np.median(apart)) if len(apart) else 1.0


def moving_labels(dataset: Dataset) -> frozenset[int]:
    """The labels of what moves, as the data set says; none where it says nothing, or has no labels."""
    known = dataset.semantics
    if known is None or not known.labels or not known.moving or not known.classes:
        return frozenset()
    names = known.classes.names
    return frozenset(1 + names.index(name) for name in known.moving)
