"""Policies that look at poses only, or at nothing: they spread views, whatever these show."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.information.pool import Pool, Selection
from drgs.information.spacetime import by_number, farthest_in_time, has_times, uniform_in_time
from drgs.policies.turns import in_turn

__all__ = ["farthest", "pose_distances", "poses", "random", "uniform"]


def pose_distances(views: Sequence[Camera]) -> np.ndarray:
    """(V, V) distances of camera centers, in those from their middle, and of directions, in half radians."""
    centers = np.array([camera.center for camera in views])
    size = np.linalg.norm(centers - centers.mean(0), axis=1).mean() or 1.0
    forward = np.array([camera.c2w[:3, 2] for camera in views])
    angles = np.arccos((forward @ forward.T).clip(-1, 1))
    return np.hypot(np.linalg.norm(centers[:, None] - centers, axis=2) / size, 0.5 * angles)


def poses(pool: Pool) -> Selection:
    """k-medoids on camera centers and directions: the pool's views, each by the chosen one nearest to it."""
    views = [*pool.train, *pool.candidates]
    near, known = np.exp(-0.5 * pose_distances(views) ** 2), len(pool.train)
    covered = near[:known].max(0) if known else np.zeros(len(views))

    def take(i: int) -> None:
        np.maximum(covered, near[known + i], out=covered)

    gains_of = lambda left: (near[[known + i for i in left]] - covered).clip(min=0).mean(1)  # noqa: E731
    picks, scores = in_turn(pool, gains_of, take)
    return Selection(picks, scores, evaluations=pool.k * len(pool.candidates))


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

    def take(i: int) -> None:
        nonlocal distance
        reach = np.linalg.norm(centers - centers[i], axis=1)
        distance = np.minimum(distance, reach) if pool.train or distance.any() else reach

    picks, scores = in_turn(pool, lambda left: distance[left], take)
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
