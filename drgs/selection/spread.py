"""Policies by poses alone, or at random: they spread views, whatever these show.

Where cameras differ in time as well, `farthest` and `uniform` look at (camera, time). Cameras that have stood somewhere
before are new at another time: by their centers alone, all of a capture that begins with every camera at the first time
would count as seen, and by their names a camera's times would count as places.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Hashable, Sequence
from typing import TypeVar

import numpy as np
import torch

from drgs.cameras import Camera, places_in_time
from drgs.cameras.origins import decimals
from drgs.selection.pool import Pool, Selection

_T = TypeVar("_T", bound=Hashable)
_POSE_DIGITS = 9  # decimals of poses that are equal


def farthest(pool: Pool) -> Selection:
    """Farthest point sampling on camera centers, in world units; without any view to start from, index 0 first.

    Of cameras at several times: on (center, time), see `_farthest_in_time`.
    """
    if _has_times(pool):
        return _farthest_in_time(pool)
    centers = np.array([camera.center for camera in pool.candidates])
    distance = np.full(len(centers), np.inf)
    for camera in pool.train:
        distance = np.minimum(distance, np.linalg.norm(centers - camera.center, axis=1))
    if not pool.train:
        distance[:] = 0.0
    scores = distance.tolist()
    picks = []
    left = np.ones(len(centers), bool)
    digits = decimals(centers)  # what differs less is a tie
    for _ in range(pool.k):
        order = np.argsort(np.where(left, -distance.round(digits), np.inf), kind="stable")
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
    every camera as often as the others, see `_uniform_in_time`.
    """
    if _has_times(pool):
        return _uniform_in_time(pool)
    views = [*pool.train, *pool.candidates]
    order = sorted(range(len(views)), key=lambda i: _by_number(views[i].name))
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


# -------------------------------------------------- cameras at several times


def _has_times(pool: Pool) -> bool:
    """Whether the cameras are of two times or more."""
    return len({camera.time for camera in (*pool.train, *pool.candidates)}) > 1


def _by_number(name: str) -> list:
    """Sort key of names: `cam10` after `cam9`."""
    return [(1, int(x), "") if x.isdecimal() else (0, 0, x) for x in re.split(r"(\d+)", name)]


def _farthest_in_time(pool: Pool) -> Selection:
    """Farthest point sampling on (center, time): the largest distance between two centers counts as much as the time
    between the first view and the last one.

    Of candidates as far from their nearest view, the one is taken whose second nearest view is farther, and so on: at
    the second time all cameras are as far from themselves at the first one.
    """
    points = places_in_time([*pool.train, *pool.candidates])
    known, new = points[: len(pool.train)], points[len(pool.train) :]
    digits = decimals(points)  # what differs less is a tie
    distances = np.linalg.norm(new[:, None] - known[None], axis=2).round(digits)
    scores = distances.min(1).tolist() if len(known) else [0.0] * len(new)
    picks = []
    left = list(range(len(new)))
    for _ in range(pool.k):
        nearest = {i: sorted(distances[i]) for i in left}
        order = sorted(left, key=lambda i: [-x for x in nearest[i]])  # stable: ties by index
        best = order[0]
        score = nearest[best][0] if nearest[best] else 0.0
        margin = score - nearest[order[1]][0] if len(order) > 1 and nearest[best] else None
        picks.append(pool.pick(best, score, margin=margin))
        left.remove(best)
        reach = np.linalg.norm(new - new[best], axis=1).round(digits)
        distances = np.c_[distances, reach]
    return Selection(picks, scores, evaluations=pool.k * len(new))


def _uniform_in_time(pool: Pool) -> Selection:
    """Every time and every camera as often as the others, evenly spaced on the way.

    The time is one of those with the fewest views, farthest from times with more and from the ends; then the camera
    likewise, in the order of names. Cameras of one pose are one camera. The score is minus the number of views that
    its camera has.
    """
    train = list(pool.train)
    picks = []
    left = list(range(len(pool.candidates)))
    views = sorted([*pool.train, *pool.candidates], key=lambda camera: _by_number(camera.name))
    places = list(dict.fromkeys(_pose(camera) for camera in views))
    times = sorted({camera.time or 0.0 for camera in views})
    counts = [_count(train, _pose, _pose(camera)) for camera in pool.candidates]
    for _ in range(pool.k):
        there = [pool.candidates[i] for i in left]
        time = _evenly(times, [camera.time or 0.0 for camera in there], [camera.time or 0.0 for camera in train])
        there = [camera for camera in there if (camera.time or 0.0) == time]
        pose = _evenly(places, [_pose(camera) for camera in there], [_pose(camera) for camera in train])
        best = next(i for i in left if (pool.candidates[i].time or 0.0) == time and _pose(pool.candidates[i]) == pose)
        picks.append(pool.pick(best, -_count(train, _pose, pose)))
        left.remove(best)
        train.append(pool.candidates[best])
    return Selection(picks, [-float(count) for count in counts], evaluations=len(counts))


def _pose(camera: Camera) -> bytes:
    """Equal for cameras of one pose; 0 and -0 are equal."""
    return (np.asarray(camera.c2w).round(_POSE_DIGITS) + 0.0).tobytes()


def _count(views: Sequence[Camera], key: Callable[[Camera], Hashable], value: Hashable) -> int:
    return sum(key(camera) == value for camera in views)


def _evenly(order: Sequence[_T], available: Sequence[_T], used: Sequence[_T]) -> _T:
    """Of what is available and used least, what is farthest in the order from its ends and from what is used more."""
    counts = {x: 0 for x in order}
    for x in used:
        counts[x] += 1
    fewest = min(counts[x] for x in available)
    walls = [-1, len(order), *(place for place, x in enumerate(order) if counts[x] > fewest)]
    free = [place for place, x in enumerate(order) if x in set(available) and counts[x] == fewest]
    return order[max(free, key=lambda place: min(abs(place - wall) for wall in walls))]
