"""A prior field: how wrong the pool's views will be about where things are, given what chosen views can tell of it.

A place p of drgs.policies.places is where something may be, known with covariance C_0 = s^2 I before any view, s a
part of its distance. A view v that sees it tells about the plane across its ray d_v, to 1 / c pixels squared:

    I_v = T_v(p) exp(kappa (cos(angle) - 1)) c (f_v / z_v)^2 (1 - d_v d_v^T)

T_v the model's transmittance, f_v the focal length in pixels, z_v the distance; the kernel of the angle to the ray that
p was drawn for says that what looks different is not recognized. In the view q that p was drawn for its error is then

    e_p(S) = tr[c (f_q / z_q)^2 (1 - d_q d_q^T) (C_0^-1 + sum_{v in S} I_v)^-1]

in units of what one view tells: V-optimality (Bates & Watts 1988; BAIT in active learning), over what may be there
instead of over Gaussians that are. One view leaves its ray's depth open, which shows in q as the angle between both
rays; two views with a parallax close it. The score is the sum of w_p e / (1 + e), for no pixel can be more than wrong.
It falls with each view that is added (monotone); two views may be worth more than the sum of each (not submodular), so
that greedy choice has no bound.
"""

from __future__ import annotations

import numpy as np
import torch

from drgs.information.pool import Pool, Selection
from drgs.policies.places import Places, Sight, places, sight_of
from drgs.policies.turns import in_turn

__all__ = ["precision", "prior_field", "wrong"]

_KAPPA = 8.0
_PRECISION = 0.05  # c, pixels^-2: a view tells where something is to 4.5 pixels
_SPREAD = 0.3  # s, in distances
_COUNT = 64  # pixels of a view
_SEED = 0  # the same places of the same model


def precision(sight: Sight, at: Places, focal: float, kappa: float = _KAPPA) -> torch.Tensor:
    """(P, 3, 3) I_v of a view with this focal length in pixels."""
    offsets = at.points - sight.camera.center
    distances = np.linalg.norm(offsets, axis=1).clip(1e-12)
    rays = offsets / distances[:, None]
    share = sight.reach(at.points) * np.exp(kappa * ((rays * at.rays).sum(1) - 1))
    return _across(share * _PRECISION * (focal / distances) ** 2, rays)


def _across(scale: np.ndarray, rays: np.ndarray) -> torch.Tensor:
    """(P, 3, 3) scale (1 - d d^T)."""
    d = torch.from_numpy(rays)
    return torch.from_numpy(scale)[:, None, None] * (torch.eye(3, dtype=d.dtype) - d[:, :, None] * d[:, None, :])


def wrong(known: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """(..., P) e / (1 + e) of precisions (..., P, 3, 3) and of what the pool's views see of errors (P, 3, 3)."""
    e = (torch.linalg.inv(known) * seen).sum((-1, -2))
    return e / (1 + e)


def prior_field(pool: Pool) -> Selection:
    """Largest drop of the expected share of wrong pixels over all views of the pool."""
    views = [*pool.train, *pool.candidates]
    sights = []
    for number, camera in enumerate(views, 1):
        sights.append(sight_of(pool.scene, camera))
        if pool.progress:
            pool.progress(number, len(views))
    at = places(sights, len(pool.train), _COUNT, np.random.default_rng(_SEED))
    focal = [float(camera.K[0, 0]) for camera in views]
    lengths = np.array(focal)[at.views]
    seen = _across(_PRECISION * (lengths / at.distances) ** 2, at.rays)
    known = torch.diag_embed(torch.from_numpy((_SPREAD * at.distances) ** -2.0)[:, None].expand(-1, 3))
    told = [precision(sight, at, f) for sight, f in zip(sights, focal, strict=True)]
    for part in told[: len(pool.train)]:
        known = known + part
    weights = torch.from_numpy(at.weights)

    def gains_of(left: list[int]) -> np.ndarray:
        before = weights @ wrong(known, seen)
        return np.array([float(before - weights @ wrong(known + told[len(pool.train) + i], seen)) for i in left])

    picks, scores = in_turn(pool, gains_of, lambda i: known.add_(told[len(pool.train) + i]))
    return Selection(picks, scores, evaluations=pool.k * len(pool.candidates), computed=len(views))
