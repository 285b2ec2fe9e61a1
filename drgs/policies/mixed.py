"""Policies that go by poses and by information."""

from __future__ import annotations

import dataclasses

import numpy as np

from drgs.information.pool import Pool, Selection
from drgs.policies.informed import fisher
from drgs.policies.places import sight_of
from drgs.policies.spread import farthest, pose_distances
from drgs.policies.turns import in_turn

__all__ = ["diverse", "switch"]

_EMPTY = 0.05  # share of pixels


def switch(pool: Pool) -> Selection:
    """`farthest` while the candidates show emptiness, `fisher` after that."""
    shown = [1 - float(sight_of(pool.scene, camera).alpha.mean()) for camera in pool.candidates]
    emptiness = sum(shown) / len(shown)
    selection = (farthest if emptiness > _EMPTY else fisher)(pool)
    selection.notes.append(f"candidates show emptiness in {emptiness:.1%} of their pixels")
    return selection


def diverse(pool: Pool) -> Selection:
    """Largest gain of information times what the pose does not share with known ones.

    With the quality-diversity kernel L_uv = q_u k(u, v) q_v, q^2 the gain of each candidate alone and k a kernel of
    poses, log det L_S grows by log q_v^2 + log k(v, v | S), the variance that is left of v's pose given those of S:
    greedy choice for determinantal point processes (Kulesza & Taskar 2012), where known views have no choice.
    """
    found = fisher(dataclasses.replace(pool, k=1))
    views = [*pool.train, *pool.candidates]
    kernel = np.exp(-0.5 * pose_distances(views) ** 2)
    gains, known = np.array(found.scores), list(range(len(pool.train)))

    def gains_of(left: list[int]) -> np.ndarray:
        across = kernel[np.ix_([len(pool.train) + i for i in left], known)]
        solved = np.linalg.solve(kernel[np.ix_(known, known)] + 1e-6 * np.eye(len(known)), across.T)
        return gains[left] * (1 - (across * solved.T).sum(1)).clip(min=0)

    picks, scores = in_turn(pool, gains_of, lambda i: known.append(len(pool.train) + i))
    return dataclasses.replace(found, picks=picks, scores=scores)
