"""One candidate after the other: the best, then the best once that one is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drgs.information.pool import Pick, Pool

__all__ = ["in_turn"]


def in_turn(
    pool: Pool, gains_of: Callable[[list[int]], np.ndarray], take: Callable[[int], object]
) -> tuple[list[Pick], list[float]]:
    """Pick the candidate with the largest gain, `pool.k` times; ties by index.

    Args:
        pool: To choose from.
        gains_of: Candidates that are left -> what each would add to those that were taken.
        take: Called with each that is picked.
    Returns:
        The picks, and every candidate's gain before the first.
    """
    picks: list[Pick] = []
    first: list[float] = []
    left = list(range(len(pool.candidates)))
    for _ in range(pool.k):
        gains = gains_of(left)
        first = first or gains.tolist()
        order = np.argsort(-gains, kind="stable")
        margin = float(gains[order[0]] - gains[order[1]]) if len(order) > 1 else None
        best = left.pop(int(order[0]))
        picks.append(pool.pick(best, gains[order[0]], margin=margin))
        take(best)
    return picks, first
