"""A fit that ends when it is to end: the number of its steps follows what steps take."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

__all__ = ["FEWEST_STEPS", "Pacer"]

FEWEST_STEPS = 100
"""Steps that a fit has, however little time is left: with fewer there is nothing to look at."""

_EVERY = 20  # steps between two looks at the clock
_RECENT = 60  # steps whose time is that of those to come: five cycles of the renderers' longest one
_FIRST = 40  # steps before the first look: renderers compile in their first ones
_GROWN = 0.5  # share of the steps from which on there are as many Gaussians as there will be (`grow_until`)
_WORTH = 0.03  # of the steps; a smaller change is none
_MOST = 4.0  # times the planned steps, however fast they turn out to be: timed beside other programs they are too slow


class Pacer:
    """How many steps a fit is to have so that the last one is done in time; what `drgs.train.fit` takes as `pace`.

    While Gaussians still grow in number, later steps take longer than those seen so far: steps are only taken away
    then, where even these are too slow. After that their number follows the clock in both directions, up to 4 times
    what was planned. Schedules of a fit go by the share of its steps that is done, so that they end where they should.

    Args:
        end: Time at which the last step is to be done, as `clock` counts.
        planned: Steps that were planned.
        clock: Seconds of a clock that never goes back.
    """

    def __init__(self, end: float, planned: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._end = end
        self._most = round(_MOST * planned)
        self._clock = clock
        self._marks: deque[tuple[int, float]] = deque(maxlen=_RECENT)
        self._first: int | None = None

    def __call__(self, done: int, total: int) -> int:
        """Steps of the whole fit.

        Args:
            done: Steps that are done.
            total: Steps that the fit has so far.
        """
        now = self._clock()
        if self._first is None:
            self._first = done
        self._marks.append((done, now))
        if done - self._first < _FIRST or done % _EVERY or done >= total:
            return total
        first, began = self._marks[0]
        each = (now - began) / (done - first)
        there = max(done + max(1, int((self._end - now) / max(each, 1e-9))), min(total, FEWEST_STEPS))
        wanted = min(there, total if done < _GROWN * total else max(total, self._most))
        return wanted if abs(wanted - total) > _WORTH * total or wanted <= done + _EVERY < total else total
