"""`farthest` and `uniform` where cameras differ in time as well: what they do with (camera, time).

Cameras that have stood somewhere before are new at another time. By their centers alone, all of a capture that begins
with every camera at the first time would count as seen, and by their names a camera's times would count as places.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Sequence
from typing import TypeVar

import numpy as np

from drgs.cameras import Camera
from drgs.information.pool import Pool, Selection

__all__ = ["by_number", "farthest_in_time", "has_times", "uniform_in_time"]

_T = TypeVar("_T", bound=Hashable)
_DIGITS = 9  # of distances: what differs less is a tie


def has_times(pool: Pool) -> bool:
    """Whether the cameras are of two times or more."""
    return len({camera.time for camera in (*pool.train, *pool.candidates)}) > 1


def by_number(name: str) -> list:
    """Sort key of names: `cam10` after `cam9`."""
    return [(1, int(x), "") if x.isdecimal() else (0, 0, x) for x in re.split(r"(\d+)", name)]


def farthest_in_time(pool: Pool) -> Selection:
    """Farthest point sampling on (center, time): the largest distance between two centers counts as much as the time
    between the first view and the last one.

    Of candidates as far from their nearest view, the one is taken whose second nearest view is farther, and so on: at
    the second time all cameras are as far from themselves at the first one.
    """
    known, new = _points(pool)
    distances = np.linalg.norm(new[:, None] - known[None], axis=2).round(_DIGITS)
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
        reach = np.linalg.norm(new - new[best], axis=1).round(_DIGITS)
        distances = np.c_[distances, reach]
    return Selection(picks, scores, evaluations=pool.k * len(new))


def _points(pool: Pool) -> tuple[np.ndarray, np.ndarray]:
    """(V, 4) center and time of the known views, and (C, 4) of the candidates, each in parts of its own range."""
    views = [*pool.train, *pool.candidates]
    centers = np.stack([camera.center for camera in views])
    times = np.array([[camera.time or 0.0] for camera in views])
    size = max(float(np.linalg.norm(centers - center, axis=1).max()) for center in centers)
    points = np.c_[centers / (size or 1.0), times / (float(np.ptp(times)) or 1.0)]
    return points[: len(pool.train)], points[len(pool.train) :]


def uniform_in_time(pool: Pool) -> Selection:
    """Every time and every camera as often as the others, evenly spaced on the way.

    The time is one of those with the fewest views, farthest from times with more and from the ends; then the camera
    likewise, in the order of names. Cameras of one pose are one camera. The score is minus the number of views that
    its camera has.
    """
    train = list(pool.train)
    picks = []
    left = list(range(len(pool.candidates)))
    views = sorted([*pool.train, *pool.candidates], key=lambda camera: by_number(camera.name))
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
    return (np.asarray(camera.c2w).round(_DIGITS) + 0.0).tobytes()


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
