"""Facility location: every place that the pool's views will show should be seen by one chosen view from near its ray.

The score of a set of views is sum_p w_p max_v k(v, p) over the places p of drgs.policies.places, with weights w_p and

    k(v, p) = T_v(p) exp(kappa (cos(angle) - 1)) min(1, d_q / d_v)

the share of the light from p that reaches v, a von Mises kernel of the angle between v's ray and that of the view q
that p was drawn for, and how much coarser v sees it. Monotone and submodular: the greedy choice has at least 1 - 1/e of
the best score that any set of as many views has (Nemhauser, Wolsey & Fisher 1978). All views count alike, the known
ones too: the pool stands for what will be looked at.
"""

from __future__ import annotations

import numpy as np

from drgs.information.pool import Pool, Selection
from drgs.policies.places import Places, Sight, places, sight_of
from drgs.policies.turns import in_turn

__all__ = ["facility", "overlap"]

_KAPPA = 4.0  # half at 34 degrees
_COUNT = 64  # pixels of a view
_SEED = 0  # the same places of the same model


def overlap(sight: Sight, at: Places, kappa: float = _KAPPA) -> np.ndarray:
    """(P,) k(v, p) of a view and places."""
    offsets = at.points - sight.camera.center
    distances = np.linalg.norm(offsets, axis=1).clip(1e-12)
    cosines = (offsets * at.rays).sum(1) / distances
    near = np.exp(kappa * (cosines - 1)) * np.minimum(1.0, at.distances / distances)
    return sight.reach(at.points) * near


def facility(pool: Pool) -> Selection:
    """Largest sum over places of what a view adds to the best that there is."""
    views = [*pool.train, *pool.candidates]
    sights = []
    for number, camera in enumerate(views, 1):
        sights.append(sight_of(pool.scene, camera))
        if pool.progress:
            pool.progress(number, len(views))
    at = places(sights, len(pool.train), _COUNT, np.random.default_rng(_SEED))
    covered = np.zeros(len(at.points))
    for sight in sights[: len(pool.train)]:
        covered = np.maximum(covered, overlap(sight, at))
    offered = np.stack([overlap(sight, at) for sight in sights[len(pool.train) :]])

    def take(i: int) -> None:
        np.maximum(covered, offered[i], out=covered)

    picks, scores = in_turn(pool, lambda left: (at.weights * (offered[left] - covered).clip(min=0)).sum(1), take)
    return Selection(picks, scores, evaluations=pool.k * len(offered), computed=len(views))
