"""Which cameras to add: policies over information, and simple baselines.

A policy is a function from a `Pool` to a `Selection`; adding one is writing it and naming it in `POLICIES`. Policies
with scores that depend on what has been picked are greedy: take the best, add its information to H, score again.

    fisher      `criterion` of the Fisher information (gain.py)
    fisherrf    `eig` of what FisherRF's rasterizer computes, no rotations
    coverage    sum_i Wc_i / (W_i + lambda), W = sum over pixels of w^2: how much is seen that was seen little
    farthest    the camera center farthest from those there are
    uniform     evenly spaced among the views sorted by name
    random      drawn without replacement, from one generator for the whole process or run
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.gain import BLOCKS, CRITERIA, Information, Prior
from drgs.guards.doors import camera_list, check_scene
from drgs.information.greedy import Cache, Pick, Selection, Source, greedy

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

__all__ = ["POLICIES", "Cache", "Pick", "Pool", "Selection", "select"]

# One for the process: a new one each call, or the same seed again, would draw the same places of the list every time.
_GENERATOR = torch.Generator().manual_seed(0)


@dataclasses.dataclass
class Pool:
    """Everything a policy may look at; see `select` for the fields."""

    gaussians: Gaussians
    candidates: Sequence[Camera]
    train: Sequence[Camera]
    k: int
    criterion: str
    settings: RenderSettings | None
    method: str
    prior: Prior
    weights: dict[str, float] | None
    rng: torch.Generator
    cache: Cache | None
    lazy: bool
    progress: Callable[[int, int], object] | None
    information: Callable[[Camera], Information] | None

    def pick(self, index: int, score: float, parts: dict | None = None, margin: float | None = None) -> Pick:
        """A `Pick` with plain numbers."""
        return Pick(int(index), self.candidates[index].name, float(score), dict(parts or {}), margin)


def select(
    gaussians: Gaussians,
    candidates: Sequence[Camera],
    train: Sequence[Camera],
    k: int = 1,
    policy: str = "fisher",
    *,
    criterion: str = "eig",
    settings: RenderSettings | None = None,
    method: str = "exact",
    prior: Prior | None = None,
    weights: dict[str, float] | None = None,
    rng: torch.Generator | None = None,
    cache: Cache | None = None,
    lazy: bool = True,
    progress: Callable[[int, int], object] | None = None,
    information: Callable[[Camera], Information] | None = None,
) -> Selection:
    """Pick k cameras. No image of a candidate is needed.

    With k = 1 one candidate's information is held at a time; with k > 1 that of all, 4 bytes a parameter and view.
    k picks at once are those of k calls in a row that move each pick from `candidates` to `train` (`uniform` and
    `random` aside: they plan, or draw, all k at once). Every view's information is rounded to float32 once; sums and
    scores are float64. Ties go to the lower index. Duplicates among the cameras are views of their own: a second one
    still adds information, but less.

    Args:
        gaussians: The scene as it is now.
        candidates: Cameras to choose from, at least k.
        train: Cameras whose views are known; may be empty if lambda is absolute and > 0.
        k: How many.
        policy: A name in `POLICIES`.
        criterion: One of `drgs.gain.CRITERIA`; of `fisher` only.
        settings: Of the renderer, default `exact`.
        method: Of `drgs.fisher.diagonal`; of `fisher` only, not of `block_logdet`.
        prior: Default `Prior()`: lambda = 1e-6. `coverage` takes its `value`, not its `groups`.
        weights: Group -> factor, default 1; of `fisher` and `fisherrf` only.
        rng: Of `random`; default one that lives as long as the process. Give a run its own, and keep it.
        cache: Where to look for and keep information of single views.
        lazy: Score only candidates whose last score, an upper bound, could still win: same picks, margins included.
            Not done where scores can rise (a relative lambda, or lambda = 0).
        progress: Called with (views done, views) after each view.
        information: Camera -> Information, in place of `drgs.fisher`; the policy's own kind: {"coverage": (N,)} for
            `coverage`, {"blocks": (N, 13, 13)} for criterion `block_logdet`.
    Raises:
        ValueError: If there are no candidates or fewer than k, an argument is unknown, or information is negative, NaN
            or infinite.
    """
    started = time.perf_counter()
    check_scene("select", gaussians, settings)
    candidates, train = camera_list("select", "candidates", candidates), camera_list("select", "train", train)
    if not candidates:
        raise ValueError("select: there must be at least one candidate, got none; give poses to choose from")
    if not (isinstance(k, int) and 1 <= k <= len(candidates)):
        raise ValueError(f"select: k must be a whole number in 1..{len(candidates)} candidates, got {k!r}; correct it")
    for what, value, known in (("policy", policy, POLICIES), ("criterion", criterion, CRITERIA)):
        if value not in known:
            raise ValueError(f"select: {what} must be one of {', '.join(known)}, got {value!r}; choose one")
    if rng is not None and not isinstance(rng, torch.Generator):
        raise ValueError(f"select: rng must be a torch.Generator that is kept between calls, got {rng!r}; make one")
    pool = Pool(
        gaussians=gaussians,
        candidates=candidates,
        train=train,
        k=k,
        criterion=criterion,
        settings=settings,
        method=method,
        prior=prior or Prior(),
        weights=weights,
        rng=rng or _GENERATOR,
        cache=cache,
        lazy=lazy,
        progress=progress,
        information=information,
    )
    selection = POLICIES[policy](pool)
    selection.seconds = time.perf_counter() - started
    return selection


# -------------------------------------------------- policies that ask for information


def fisher(pool: Pool) -> Selection:
    """Largest gain of Fisher information."""
    if pool.criterion == "block_logdet":
        return greedy(pool, Source(pool, "blocks", lambda fisher, *view: {BLOCKS: fisher.blocks(*view)}))
    compute = lambda fisher, *view: fisher.diagonal(*view, method=pool.method)  # noqa: E731
    return greedy(pool, Source(pool, f"diagonal {pool.method}", compute))


def fisherrf(pool: Pool) -> Selection:
    """Largest sum Hc / (H + lambda) of FisherRF's H."""
    groups, weights = (
        {k: v for k, v in x.items() if k != "rotations"} for x in (pool.prior.groups, pool.weights or {})
    )
    prior = dataclasses.replace(pool.prior, groups=groups)
    pool = dataclasses.replace(pool, criterion="eig", prior=prior, weights=weights)
    compute = lambda fisher, *view: fisher.diagonal(*view, method="fisherrf")  # noqa: E731
    return greedy(pool, Source(pool, "diagonal fisherrf", compute))


def coverage(pool: Pool) -> Selection:
    """Largest sum Wc / (W + lambda), W = sum over pixels of w^2."""
    prior = dataclasses.replace(pool.prior, groups={})
    pool = dataclasses.replace(pool, criterion="eig", prior=prior, weights=None)
    return greedy(pool, Source(pool, "coverage", lambda fisher, *view: {"coverage": fisher.coverage(*view)}))


# -------------------------------------------------- policies that look at poses only, or at nothing


def farthest(pool: Pool) -> Selection:
    """Farthest point sampling on camera centers, in world units; without any view to start from, index 0 first."""
    centers = np.array([camera.center for camera in pool.candidates])
    distance = np.full(len(centers), np.inf)
    for camera in pool.train:
        distance = np.minimum(distance, np.linalg.norm(centers - camera.center, axis=1))
    if not pool.train:
        distance[:] = 0.0
    scores, picks, left = distance.tolist(), [], np.ones(len(centers), bool)
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
    distance to the nearest training view or end of the order, in places.
    """
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


def _by_number(name: str) -> list:
    """Sort key: `cam10` after `cam9`."""
    return [(1, int(x), "") if x.isdecimal() else (0, 0, x) for x in re.split(r"(\d+)", name)]


POLICIES: dict[str, Callable[[Pool], Selection]] = {
    "fisher": fisher,
    "fisherrf": fisherrf,
    "coverage": coverage,
    "farthest": farthest,
    "uniform": uniform,
    "random": random,
}
"""Name -> policy."""
