"""When the views of an active fit are picked, and among which: view by view, or cameras at the times of a sequence.

    views   a few views at the start, then any other of the training split
    times   all cameras at the first time, then one camera at each later time, in order: the dynamic loop of [1]
    pairs   all cameras at the first time, then any (camera, time) of the others; with `initial` views at the start
            these instead, spread over cameras and times, as where one camera moves about and films

[1] fits a static scene to the first time for 3,000 steps, then a dynamic one for 14,000, with a pick every 200 of
these at the 39 later times. `times` and `pairs` do so at any number of steps: the first pick comes when the dynamic
stage has lasted 200 of 17,000 steps, or `every` if that is more, for a deformation that begins at zero has no
information about its first layers. Every step shows one of the photographs picked so far, each as likely as any other,
those of the first time included.

Reference:
    [1] Next Best View Selections for Semantic and Dynamic 3D Gaussian Splatting, arXiv 2512.22771.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import Camera, places_in_time

if TYPE_CHECKING:
    from drgs.data import View
    from drgs.fitting.config import FitConfig, Schedule, SelectionConfig

_START_STREAM = 0x57A7  # any number: the random stream of the first view differs from all others of the same seed
_PICK_EVERY = 200  # steps between two picks, as in [1]
_PICK_PART = 200 / 17_000  # of all steps: the distance of two picks with --schedule times, as in [1]

VIEWS_TO_ADD = 10
"""As in [1], where a few views are there at the start and `SelectionConfig` does not say."""


@dataclasses.dataclass(frozen=True)
class Timetable:
    """Which views there are at the start, when the next one is picked, and among which.

    Attributes:
        schedule: `views`, `times` or `pairs`.
        start: Indices of the views that are known from the first step on.
        pools: Candidates: of `times` the indices of the views at each later time, one pick each; else one pool of all
            others.
        add: Picks.
        every: Steps between two of them.
        first: Steps done before the first.
    """

    schedule: Schedule
    start: tuple[int, ...]
    pools: tuple[tuple[int, ...], ...]
    add: int
    every: int
    first: int

    @classmethod
    def of(cls, views: Sequence[View], config: FitConfig, moves: bool = False) -> Timetable:
        """The timetable of a fit.

        Args:
            views: The training split, in its order, at least one.
            config: What the fit does, with a selection.
            moves: Whether a deformation is fitted: what `auto` goes by.
        Raises:
            ValueError: If the data set has not as many views or times, or the steps do not suffice.
        """
        active = config.selection
        assert active is not None
        schedule = ("times" if moves else "views") if active.schedule == "auto" else active.schedule
        if schedule == "views":
            if moves:
                raise ValueError(
                    "active: --schedule must be times or pairs where a deformation is fitted, got views; choose one, "
                    "or fit what stands still (--dynamics ignore)"
                )
            return cls._of_views(active, views, config)
        return cls._of_times(active, views, config, schedule)

    def left(self, picked: int, chosen: Sequence[int]) -> list[int]:
        """Candidates of the next pick, in the order of the split.

        Args:
            picked: How many picks there have been.
            chosen: Views that are known.
        """
        known = set(chosen)
        return [i for i in self.pools[min(picked, len(self.pools) - 1)] if i not in known]

    def due(self, step: int) -> int:
        """How many picks there must have been before step `step` (from 0)."""
        return 0 if step < self.first else min(self.add, 1 + (step - self.first) // self.every)

    @classmethod
    def _of_views(cls, active: SelectionConfig, views: Sequence[View], config: FitConfig) -> Timetable:
        """View by view."""
        add, every = active.add or VIEWS_TO_ADD, active.every or _PICK_EVERY
        if active.initial + add > len(views):
            raise ValueError(
                f"active: --initial {active.initial} and --add {add} must be at most the {len(views)} views of "
                "the training split; lower one, or hold out fewer (--test-every)"
            )
        if add * every >= config.max_steps:
            raise ValueError(
                f"active: --add {add} views, one --every {every} steps, must be there before step "
                f"{config.max_steps}, the last one would come at {add * every}; raise --max-steps"
            )
        first = _drawn(len(views), config.seed) if active.start == "seed" else 0
        start = initial_views([view.camera for view in views], active.initial, first)
        return cls("views", tuple(start), (tuple(range(len(views))),), add, every, every)

    @classmethod
    def _of_times(
        cls, active: SelectionConfig, views: Sequence[View], config: FitConfig, schedule: Schedule
    ) -> Timetable:
        """Cameras at times, after the static stage."""
        where = f"active: --schedule {schedule}"
        _check_times(where, active, views, config)
        times: dict[float, list[int]] = {}
        for i, view in enumerate(views):
            assert view.camera.time is not None
            times.setdefault(view.camera.time, []).append(i)
        if len(times) < 2:
            raise ValueError(f"{where} must have training views of two times or more, got one; use --schedule views")
        start, *later = (tuple(times[time]) for time in sorted(times))
        add = active.add or len(later)
        what = "later times" if schedule == "times" else "training views at later times"
        if schedule == "pairs" and active.initial != type(active).initial:
            first = _drawn(len(views), config.seed) if active.start == "seed" else 0
            start = tuple(initial_views([view.camera for view in views], min(active.initial, len(views)), first))
            later = [tuple(i for i in range(len(views)) if i not in start)]
            add = active.add or VIEWS_TO_ADD
            what = "training views besides the initial ones"
        elif len(start) == 1:
            raise ValueError(
                f"{where} must have two cameras or more at the first time, got one, {views[start[0]].name!r}; use "
                f"--schedule pairs with --initial, e.g. {min(len(views), 24)}"
            )
        room = len(later) if schedule == "times" else sum(map(len, later))
        if add > room:
            raise ValueError(f"{where} must have --add of at most the {room} {what}, got {add}; lower it")
        static = round(config.motion.static_share * config.max_steps)
        least = math.ceil(_PICK_PART * config.max_steps)
        every = active.every or max(1, round(_PICK_PART * config.max_steps))
        first = static + max(every, least)
        last = first + (add - 1) * every
        if last >= config.max_steps:
            raise ValueError(
                f"{where} must have its {add} picks, one --every {every} steps after the static stage of {static}, "
                f"before step {config.max_steps}, the last one would come at {last}; raise --max-steps or lower --every"
            )
        pools = tuple(later) if schedule == "times" else (tuple(i for pool in later for i in pool),)
        return cls(schedule, start, pools, add, every, first)


def _check_times(where: str, active: SelectionConfig, views: Sequence[View], config: FitConfig) -> None:
    """Refuse what does not go with picks at times."""
    if config.motion.dynamics == "ignore":
        raise ValueError(f"{where} must fit what moves, got --dynamics ignore; drop it, or use --schedule views")
    if timeless := next((view.name for view in views if view.camera.time is None), None):
        raise ValueError(f"{where} must have a time of every view, {timeless!r} has none; use --schedule views")
    default = type(active)()
    spread = active.schedule == "pairs" and active.initial != default.initial
    for name in () if spread else ("initial", "start"):
        if getattr(active, name) != getattr(default, name):
            hint = "drop it" if active.schedule != "pairs" else "drop it, or name --initial, too"
            raise ValueError(
                f"{where} must begin with all cameras at the first time, got --{name} {getattr(active, name)}; {hint}"
            )
    if active.pick_points == "uncovered":
        raise ValueError(
            f"{where} must have --pick-points auto or none, got uncovered: what has moved is not triangulated with "
            "photographs of other times; drop it"
        )


def initial_views(cameras: list[Camera], count: int, first: int = 0) -> list[int]:
    """One camera, then always the one that is farthest from all chosen ones; ties to the lower index.

    Distances are between centers; of cameras at several times, between centers and times (`places_in_time`).

    Args:
        cameras: Cameras to choose from, at least `count`.
        count: Number of views, at least 1.
        first: Index of the one to begin with.
    """
    centers = np.stack([camera.center for camera in cameras])
    if len({camera.time for camera in cameras}) > 1:
        centers = places_in_time(cameras)
    chosen = [first]
    distance = np.linalg.norm(centers - centers[first], axis=1)
    while len(chosen) < count:
        distance[chosen] = -1.0  # where all centers coincide, too, no view is chosen twice
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(centers - centers[chosen[-1]], axis=1))
    return chosen


def _drawn(count: int, seed: int) -> int:
    """Index in range(count), drawn by a seed; the generators of policies and of points begin with the seed alone."""
    return int(np.random.default_rng([seed, _START_STREAM]).integers(count))
