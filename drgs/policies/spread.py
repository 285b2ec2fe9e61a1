"""Policies that look at poses only, or at nothing: they spread views, whatever these show."""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch

from drgs.information.pool import Pool, Selection
from drgs.information.spacetime import by_number, farthest_in_time, has_times, uniform_in_time

__all__ = ["farthest", "random", "uniform"]


def farthest(pool: Pool) -> Selection:
    """Farthest point sampling on camera centers, in world units; without any view to start from, index 0 first.

    Of cameras at several times: on (center, time), see `drgs.information.spacetime`.
    """
    if has_times(pool):
        return farthest_in_time(pool)
    centers = np.array([camera.center for camera in pool.candidates])
    distance = np.full(len(centers), np.inf)
    for camera in pool.train:
        distance = np.minimum(distance, np.linalg.norm(centers - camera.center, axis=1))
    if not pool.train:
        distance[:] = 0.0
    scores = distance.tolist()
    picks = []
    left = np.ones(len(centers), bool)
    for _ in range(pool.k):
        order = np.argsort(np.where(left, -distance, np.inf), kind="stable")
        best, margin = order[0], None
        if left.sum() > 1:
            margin = float(distance[best] - distance[order[1]])
        picks.append(pool.pick(best, distance[best], margin=margin))
        left[best] = False
        reach = np.linalg.norm(centers - centers[best], axis=1)
        distance = reach if len(picks) == 1 and not pool.train else np.minimum(distance, reach)
    return Selection(picks, scores, evaluations=pool.k * len(centers))


def uniform(pool: Pool) -> Selection:
    """Evenly spaced in the order of names (numbers by value; unnamed ones as given, after the training views).

    The k picks split the gaps that training views leave in that order, the largest ones most, each into equal steps:
    one pick is the middle of the largest gap, k picks without training views are evenly spaced. The score is the
    distance to the nearest training view or end of the order, in places. Of cameras at several times: every time and
    every camera as often as the others, see `drgs.information.spacetime`.
    """
    if has_times(pool):
        return uniform_in_time(pool)
    views = [*pool.train, *pool.candidates]
    order = sorted(range(len(views)), key=lambda i: by_number(views[i].name))
    at = {view: place for place, view in enumerate(order)}
    walls = sorted([-1, len(views), *(at[i] for i in range(len(pool.train)))])
    gaps = [(a, b) for a, b in itertools.pairwise(walls) if b - a > 1]
    count = [0] * len(gaps)
    for _ in range(pool.k):
        open_gaps = [i for i, (a, b) in enumerate(gaps) if count[i] < b - a - 1]
        count[max(open_gaps, key=lambda i: (gaps[i][1] - gaps[i][0]) / (count[i] + 1))] += 1
    chosen = [
        math.floor(a + (b - a) * (j + 1) / (n + 1) + 0.5)
        for (a, b), n in zip(gaps, count, strict=True)
        for j in range(n)
    ]
    distance = [float(min(abs(at[i] - wall) for wall in walls)) for i in range(len(pool.train), len(views))]
    indices = [order[place] - len(pool.train) for place in chosen]
    return Selection([pool.pick(i, distance[i]) for i in indices], distance, evaluations=len(distance))


def random(pool: Pool) -> Selection:
    """k different candidates, each as likely as any other; the score is the number that was drawn."""
    drawn = torch.rand(len(pool.candidates), dtype=torch.float64, generator=pool.rng).tolist()
    order = sorted(range(len(drawn)), key=lambda i: -drawn[i])
    return Selection([pool.pick(i, drawn[i]) for i in order[: pool.k]], drawn, evaluations=len(drawn))
