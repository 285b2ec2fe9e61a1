"""Which cameras to add: policies over information, and simple baselines.

A policy is a function from a `Pool` to a `Selection`; adding one is writing it here and naming it in `POLICIES`.
Policies whose scores depend on what has been picked are greedy: take the best, add its information to H, score again
(information/greedy.py). How a score comes from information is a `Scoring`; its criteria are in gain.py.

    fisher      `criterion` of the Fisher information (gain.py)
    fisherrf    `eig` of what FisherRF's rasterizer computes, no rotations
    moments     variance of the features along the rays (Magic Moments), averaged over pixels
    coverage    sum_i Wc_i / (W_i + lambda), W = sum over pixels of w^2: how much is seen that was seen little
    farthest    the camera center farthest from those there are; of several times, the center and the time
    uniform     evenly spaced among the views sorted by name; of several times, among the times and the cameras
    random      drawn without replacement, from one generator for the whole process or run
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Scene
from drgs.gain import CRITERIA, METHODS, Information
from drgs.guards.arguments import must_be
from drgs.guards.doors import camera_list, check_any_scene
from drgs.information.cache import Cache
from drgs.information.combine import Asked, Combination, asked_of
from drgs.information.greedy import InformationSource, ViewInformation, greedy
from drgs.information.pool import Pick, Pool, Scoring, Selection
from drgs.information.semantics import SemanticMetric
from drgs.information.spacetime import by_number, farthest_in_time, has_times, uniform_in_time

__all__ = ["CRITERIA", "METHODS", "POLICIES", "Cache", "Pick", "Pool", "Scoring", "Selection", "select"]

_EMPTY = 0.05  # share of pixels
FEW_PROBES = 8  # of a network's information, below which 1 / H is far too large on average
# One for the process: a new one each call, or the same seed again, would draw the same places of the list every time.
_GENERATOR = torch.Generator().manual_seed(0)


def select(
    gaussians: Scene,
    candidates: Sequence[Camera],
    train: Sequence[Camera],
    k: int = 1,
    policy: str = "fisher",
    *,
    scoring: Scoring | None = None,
    rng: torch.Generator | None = None,
    cache: Cache | None = None,
    lazy: bool = True,
    progress: Callable[[int, int], object] | None = None,
    information: Callable[[Camera], Information] | None = None,
    **fields: Any,
) -> Selection:
    """Pick k cameras. No image of a candidate is needed.

    With k = 1 one candidate's information is held at a time; with k > 1 that of all, 4 bytes a parameter and view.
    k picks at once are those of k calls in a row that move each pick from `candidates` to `train` (`uniform` and
    `random` aside: they plan, or draw, all k at once). Every view's information is rounded to float32 once; sums and
    scores are float64. Ties go to the lower index. Duplicates among the cameras are views of their own: a second one
    still adds information, but less.

    Args:
        gaussians: The scene as it is now: Gaussians, or a `drgs.ellipsoids.Scene`, seen at each camera's time.
        candidates: Cameras to choose from, at least k.
        train: Cameras whose views are known; may be empty if lambda is absolute and > 0.
        k: How many.
        policy: A name in `POLICIES`.
        scoring: How views are scored; default `Scoring()`.
        rng: Of `random`; default one that lives as long as the process. Give a run its own, and keep it.
        cache: Where to look for and keep information of single views.
        lazy: Score only candidates whose last score, an upper bound, could still win: same picks, margins included.
            Not done where scores can rise (a relative lambda, or lambda = 0).
        progress: Called with (views done, views) after each view.
        information: Camera -> Information, in place of `drgs.fisher`; the policy's own kind: {"coverage": (N,)} for
            `coverage`, {"blocks": (N, 13, 13)} for criterion `block_logdet`.
        **fields: Of `Scoring`, in place of `scoring`: `criterion`, `settings`, `method`, `prior`, `weights`,
            `groups`, `blocks`, `semantics`, `network`, `combine`, `probes`; None is the default.
    Raises:
        ValueError: If there are no candidates or fewer than k, an argument is unknown, or information is negative, NaN
            or infinite.
    """
    started = time.perf_counter()
    check_any_scene("select", gaussians)
    candidates, train = camera_list("select", "candidates", candidates), camera_list("select", "train", train)
    if not candidates:
        raise ValueError("select: there must be at least one candidate, got none; give poses to choose from")
    if not (isinstance(k, int) and 1 <= k <= len(candidates)):
        raise ValueError(f"select: k must be a whole number in 1..{len(candidates)} candidates, got {k!r}; correct it")
    if policy not in POLICIES:
        raise ValueError(f"select: policy must be one of {', '.join(POLICIES)}, got {policy!r}; choose one")
    if rng is not None and not isinstance(rng, torch.Generator):
        raise ValueError(f"select: rng must be a torch.Generator that is kept between calls, got {rng!r}; make one")
    pool = Pool(
        scene=gaussians,
        candidates=candidates,
        train=train,
        k=k,
        scoring=_scoring(scoring, fields),
        rng=rng or _GENERATOR,
        cache=cache,
        lazy=lazy,
        progress=progress,
        information=information,
    )
    selection = POLICIES[policy](pool)
    selection.seconds = time.perf_counter() - started
    return selection


def _scoring(scoring: Scoring | None, fields: dict[str, Any]) -> Scoring:
    """The one that was passed, or one of the fields that were."""
    known = [field.name for field in dataclasses.fields(Scoring)]
    if unknown := [name for name in fields if name not in known]:
        raise TypeError(f"select() got an unexpected keyword argument {unknown[0]!r}; Scoring has {', '.join(known)}")
    if scoring is None:
        return Scoring(**{name: x for name, x in fields.items() if x is not None})
    must_be("select", "scoring", scoring, Scoring, "e.g. drgs.select.Scoring(criterion=...)")
    if fields:
        raise ValueError(f"select: {', '.join(fields)} must be fields of scoring, got both; put them into Scoring(...)")
    return scoring


# -------------------------------------------------- policies that ask for information


def fisher(pool: Pool) -> Selection:
    """Largest gain of Fisher information, of the blocks of the image that the scoring names."""
    scoring, metric = pool.scoring, None
    if pool.information is not None:  # it knows by itself what it is about
        return _greedy(pool, ())
    with torch.no_grad():
        seen = pool.scene.at(pool.candidates[0].time)
    blocks = scoring.blocks_of(seen, scene=pool.scene)
    if "semantic" in blocks:
        assert seen.features is not None  # else there is no such block
        metric = scoring.semantics or SemanticMetric.of(None, seen.features.shape[1])
    asked, combination = asked_of(scoring, blocks, metric)
    selection = _greedy(pool, asked, combination)
    selection.blocks, selection.semantics = list(blocks), metric.to_json() if metric else None
    if "deformation" in blocks:
        selection.network = {"score": scoring.network, "probes": scoring.probes}
        if scoring.network == "ratio" and scoring.probes < FEW_PROBES:
            selection.notes.append(
                f"deformation: {scoring.probes} probes are few to divide by, where one view is all that is known of a "
                f"parameter its ratio is too large; take {FEW_PROBES} or more"
            )
    if combination.apart:
        selection.combine = "zscore"
        selection.notes.append(f"scores are sums of z-scores of {', '.join(combination.apart)} over the candidates")
    return selection


def fisherrf(pool: Pool) -> Selection:
    """Largest sum Hc / (H + lambda) of FisherRF's H, which has no rotations and no features."""
    prior, weights = pool.scoring.prior, _without_rotations(pool.scoring.weights)
    prior = dataclasses.replace(prior, groups=_without_rotations(prior.groups))
    asked = Asked("diagonal", ("features",), (("method", "fisherrf"),))
    return _greedy(_scored(pool, criterion="eig", prior=prior, weights=weights), [asked])


def coverage(pool: Pool) -> Selection:
    """Largest sum Wc / (W + lambda), W = sum over pixels of w^2."""
    prior = dataclasses.replace(pool.scoring.prior, groups={})
    return _greedy(_scored(pool, criterion="eig", prior=prior, weights={}), [Asked("coverage")])


def _greedy(pool: Pool, asked: Sequence[Asked], combination: Combination | None = None) -> Selection:
    """`greedy` by what `drgs.fisher` says of each view, or by the pool's own information.

    Args:
        pool: Whose scoring says how much it counts.
        asked: What is asked of a view.
        combination: How that becomes a score; default by the pool's scoring, all groups together.
    """
    settings, combination = pool.scoring.settings, combination or Combination(pool.scoring)

    def by(asked: Sequence[Asked]) -> InformationSource:
        def compute(camera: Camera) -> Information:
            found: dict[str, torch.Tensor] = {}
            for one in asked:
                found |= one(pool.scene, camera, settings)
            return found

        return compute, (settings, *asked)

    if pool.information:
        return greedy(pool, ViewInformation(pool, (pool.information, (pool.information, settings))), combination)
    known = None if all(one.known for one in asked) else by([one for one in asked if one.known])
    return greedy(pool, ViewInformation(pool, by(asked), known), combination)


def _scored(pool: Pool, **fields: Any) -> Pool:
    """The same pool with other fields of its scoring."""
    return dataclasses.replace(pool, scoring=dataclasses.replace(pool.scoring, **fields))


def _without_rotations(groups: Mapping[str, float]) -> dict[str, float]:
    return {name: x for name, x in groups.items() if name != "rotations"}


def moments(pool: Pool) -> Selection:
    """Largest variance of the features along the rays, on average over pixels; of colors where there are no features.

    It needs no training views, and picks do not change it: k picks are the k best, whatever they share.
    """
    from drgs.information.moments import moments_map  # loads Dr.Jit, which the policies below need not have

    scores = []
    for number, camera in enumerate(pool.candidates, 1):
        found = moments_map(pool.scene.at(camera.time), camera, pool.scoring.settings)
        scores.append(float(found.double().mean()))
        if pool.progress:
            pool.progress(number, len(pool.candidates))
    order = sorted(range(len(scores)), key=lambda i: -scores[i])  # stable: ties by index
    picks = []
    for place, i in enumerate(order[: pool.k]):
        margin = scores[i] - scores[order[place + 1]] if place + 1 < len(order) else None
        picks.append(pool.pick(i, scores[i], margin=margin))
    notes = ["moments rank candidates one by one: picks do not take each other into account"] if pool.k > 1 else []
    return Selection(picks, scores, evaluations=len(scores), notes=notes)


def field(pool: Pool) -> Selection:
    """Largest drop of the pool's expected error about where things are or may be."""
    from drgs.information.prior_field import prior_field

    return prior_field(pool)


def facility(pool: Pool) -> Selection:
    """Places that the pool's views will show, each by the chosen view that sees it best."""
    from drgs.information.facility import facility

    return facility(pool)


def switch(pool: Pool) -> Selection:
    """`farthest` while the candidates show emptiness, `fisher` after that."""
    from drgs.information.places import sight_of

    shown = [1 - float(sight_of(pool.scene, camera).alpha.mean()) for camera in pool.candidates]
    emptiness = sum(shown) / len(shown)
    selection = (farthest if emptiness > _EMPTY else fisher)(pool)
    selection.notes.append(f"candidates show emptiness in {emptiness:.1%} of their pixels")
    return selection


def diverse(pool: Pool) -> Selection:
    """Largest gain of information times what the pose does not share with known ones: det of a quality-diversity kernel.

    With L_uv = q_u k(u, v) q_v, q^2 the gain of each candidate alone and k a kernel of poses, log det L_S grows by
    log q_v^2 + log k(v, v | S), the variance that is left of v's pose given those of S: greedy choice for determinantal
    point processes (Kulesza & Taskar 2012), where known views have no choice.
    """
    found = fisher(dataclasses.replace(pool, k=1))
    views = [*pool.train, *pool.candidates]
    kernel = np.exp(-0.5 * _pose_distances(views) ** 2)
    gains, picks, scores, known = np.array(found.scores), [], [], list(range(len(pool.train)))
    left = list(range(len(pool.candidates)))
    for _ in range(pool.k):
        rest = [len(pool.train) + i for i in left]
        across = kernel[np.ix_(rest, known)]
        solved = np.linalg.solve(kernel[np.ix_(known, known)] + 1e-6 * np.eye(len(known)), across.T)
        values = gains[left] * (1 - (across * solved.T).sum(1)).clip(min=0)
        scores = scores or values.tolist()
        order = np.argsort(-values, kind="stable")
        margin = float(values[order[0]] - values[order[1]]) if len(order) > 1 else None
        best = left.pop(int(order[0]))
        picks.append(pool.pick(best, values[order[0]], margin=margin))
        known.append(len(pool.train) + best)
    return dataclasses.replace(found, picks=picks, scores=scores)


# -------------------------------------------------- policies that look at poses only, or at nothing


def _pose_distances(views: Sequence[Camera]) -> np.ndarray:
    """(V, V) distances of camera centers, in those from their middle, and of directions, in half radians."""
    centers = np.array([camera.center for camera in views])
    size = np.linalg.norm(centers - centers.mean(0), axis=1).mean() or 1.0
    forward = np.array([camera.c2w[:3, 2] for camera in views])
    angles = np.arccos((forward @ forward.T).clip(-1, 1))
    return np.hypot(np.linalg.norm(centers[:, None] - centers, axis=2) / size, 0.5 * angles)


def poses(pool: Pool) -> Selection:
    """k-medoids on camera centers and directions: the pool's views, each by the chosen one nearest to it."""
    views = [*pool.train, *pool.candidates]
    near, known = np.exp(-0.5 * _pose_distances(views) ** 2), len(pool.train)
    covered = near[:known].max(0) if known else np.zeros(len(views))
    picks, scores, left = [], [], list(range(len(pool.candidates)))
    for _ in range(pool.k):
        gains = [float((near[known + i] - covered).clip(min=0).mean()) for i in left]
        scores = scores or gains
        order = sorted(range(len(left)), key=lambda j: -gains[j])
        margin = gains[order[0]] - gains[order[1]] if len(order) > 1 else None
        best = left.pop(order[0])
        picks.append(pool.pick(best, gains[order[0]], margin=margin))
        covered = np.maximum(covered, near[known + best])
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


POLICIES: dict[str, Callable[[Pool], Selection]] = {
    "fisher": fisher,
    "fisherrf": fisherrf,
    "coverage": coverage,
    "moments": moments,
    "field": field,
    "facility": facility,
    "switch": switch,
    "diverse": diverse,
    "poses": poses,
    "farthest": farthest,
    "uniform": uniform,
    "random": random,
}
"""Name -> policy."""
