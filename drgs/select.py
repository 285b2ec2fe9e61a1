"""Which cameras to add: policies over information, and simple baselines.

A policy is a function from a `Pool` to a `Selection`; adding one is writing it in `drgs.policies` and naming it in
`POLICIES` (`drgs.information.choices`), or `POLICIES["mine"] = mine` in a script. How a score comes from information
is a `Scoring`; its criteria are in information/criteria.py.

    fisher      `criterion` of the Fisher information (gain.py)
    fisherrf    `eig` of what FisherRF's rasterizer computes, no rotations
    moments     variance of the features along the rays (Magic Moments), averaged over pixels
    blur        least sharp rendering
    renderers   variance of the colors between renderers of the same Gaussians, averaged over pixels
    coverage    sum_i Wc_i / (W_i + lambda), W = sum over pixels of w^2: how much is seen that was seen little
    farthest    the camera center farthest from those there are; of several times, the center and the time
    uniform     evenly spaced among the views sorted by name; of several times, among the times and the cameras
    random      drawn without replacement, from one generator for the whole process or run
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Scene
from drgs.guards.arguments import kind_of, must_be
from drgs.guards.inputs import Masks, camera_list, check_any_scene, mask_list
from drgs.information.choices import METHODS, POLICIES, check_named
from drgs.information.criteria import CRITERIA, criterion_named
from drgs.information.scoring import Scoring
from drgs.information.sums import Information
from drgs.selection.cache import Cache
from drgs.selection.pool import Pick, Pool, Selection, Workers
from drgs.selection.refining import Refine

__all__ = [
    "CRITERIA",
    "METHODS",
    "POLICIES",
    "Cache",
    "Pick",
    "Pool",
    "Refine",
    "Scoring",
    "Selection",
    "policy_named",
    "select",
]

_INFORMED = ("fisher", "fisherrf", "coverage")
"""Policies that score a camera by what its view tells."""

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
    masks: Masks = None,
    empty_outside: bool = False,
    cache: Cache | None = None,
    lazy: bool = True,
    progress: Callable[[int, int], object] | None = None,
    information: Callable[[Camera], Information] | None = None,
    workers: Workers | None = None,
    refine: Refine | None = None,
    **fields: Any,
) -> Selection:
    """Pick k cameras. No image of a candidate is needed.

        chosen = drgs.select_views(g, candidates=cameras[2:], train=cameras[:2], k=2)
        [pick.name for pick in chosen.picks], chosen.scores

    With k = 1 one candidate's information is held at a time (criterion `v_opt`: that of all, where it fits); with k > 1
    that of all, 4 bytes a parameter and view.
    k picks at once are those of k calls in a row that move each pick from `candidates` to `train` (`uniform` and
    `random` aside: they plan, or draw, all k at once). Every view's information is rounded to float32 once; sums and
    scores are float64. Ties go to the lower index. Duplicates among the cameras are views of their own: a second one
    still adds information, but less.

    Args:
        gaussians: The scene as it is now: Gaussians, or a `drgs.ellipsoids.Scene`, seen at each camera's time.
        candidates: Cameras to choose from, at least k.
        train: Cameras whose views are known; may be empty if lambda is absolute and > 0.
        k: How many.
        policy: A name in `POLICIES`, or `package.module:function` of a function like those: `Pool` to `Selection`.
        scoring: How views are scored; default `Scoring()`.
        rng: Generator of `random`; default one that lives as long as the process. Give a run its own, and keep it.
        masks: One for each view of `train`, as `drgs.fisher.diagonal` takes them: what is outside was not learned from.
            Candidates have none. Only `fisher`, `coverage` and policies that are made of these use masks.
        empty_outside: Nothing is outside of the masks, as of an object's: what these views leave open there is known
            to be empty (block `backdrop`).
        cache: Cache where information of single views is looked for and kept.
        lazy: Score only candidates whose last score, an upper bound, could still win: same picks, margins included.
            Not done where scores can rise (a relative lambda, lambda = 0, or z-scores).
        progress: Called with (views done, views) after each view.
        information: Camera -> Information, in place of `drgs.fisher`; the policy's own kind: {"coverage": (N,)} for
            `coverage`, {"blocks": (N, 13, 13)} for criterion `block_logdet`.
        workers: Processes that compute what single views tell, here or on other machines
            (`drgs.cluster.connect.opened`); scores and picks are made here, of the same bits.
        refine: Move each pick to where its view tells more; of `fisher`, `fisherrf` and `coverage`, whose scores add
            up (no z-scores). `Pick.camera` is where to.
        **fields: Fields of `Scoring`, in place of `scoring`: `criterion`, `settings`, `method`, `prior`, `weights`,
            `groups`, `blocks`, `semantics`, `network`, `combine`, `probes`; None is the default.
    Raises:
        ValueError: If there are no candidates or fewer than k, an argument is unknown, information is negative, NaN
            or infinite, or a policy returns something else than a choice of k candidates.
    """
    started = time.perf_counter()
    check_any_scene("select", gaussians)
    candidates = camera_list("select", "candidates", candidates)
    train = camera_list("select", "train", train)
    if not candidates:
        raise ValueError("select: there must be at least one candidate, got none; give poses to choose from")
    if not (isinstance(k, int) and 1 <= k <= len(candidates)):
        raise ValueError(f"select: k must be a whole number in 1..{len(candidates)} candidates, got {k!r}; correct it")
    chosen = policy_named(policy)
    if rng is not None and not isinstance(rng, torch.Generator):
        raise ValueError(f"select: rng must be a torch.Generator that is kept between calls, got {rng!r}; make one")
    if masks is not None and information is not None:
        raise ValueError("select: masks must be None with information, got both; it knows by itself what views tell")
    if workers is not None and information is not None:
        raise ValueError("select: workers must be None with information, got both; a function is called here")
    scored = _scoring(scoring, fields)
    criterion_named(scored.criterion, "select")  # else the first view's information would be computed before
    if information is not None:
        _check_beside(policy, scored)
    if refine is not None:
        must_be("select", "refine", refine, Refine, "e.g. drgs.select.Refine(evaluations=40)")
        if policy in POLICIES and policy not in _INFORMED:
            raise ValueError(
                f"select: refine must be None with policy {policy}, got some; use {', '.join(_INFORMED)}, which score "
                "any camera"
            )
    pool = Pool(
        scene=gaussians,
        candidates=candidates,
        train=train,
        k=k,
        scoring=scored,
        rng=rng or _GENERATOR,
        masks=mask_list("select", masks, train),
        empty_outside=empty_outside,
        cache=cache,
        lazy=lazy,
        progress=progress,
        information=information,
        workers=workers,
        refine=refine,
    )
    selection = _returned(policy, pool, chosen(pool))
    selection.seconds = time.perf_counter() - started
    return selection


def _returned(policy: str, pool: Pool, found: object) -> Selection:
    """What a policy has returned, if it is a choice from the pool."""
    where = f"select: policy {policy}"
    advice = "make picks with pool.pick(index, score)"
    must_be(where, "what it returns", found, Selection, f"e.g. Selection(picks, scores); {advice}")
    assert isinstance(found, Selection)
    picks = found.picks
    scores = found.scores
    count = len(pool.candidates)
    if not isinstance(picks, list | tuple) or any(not isinstance(pick, Pick) for pick in picks):
        raise ValueError(f"{where}: picks must be a list of Pick, got {kind_of(picks)}; {advice}")
    indices = [pick.index for pick in picks]
    possible = all(isinstance(i, int) and 0 <= i < count for i in indices)
    if not possible or len(indices) != pool.k or len(set(indices)) != pool.k:
        raise ValueError(
            f"{where}: picks must be k = {pool.k} different ones of {count} candidates, got indices {indices}; {advice}"
        )
    try:
        plain = scores.detach().cpu() if isinstance(scores, torch.Tensor) else scores
        numbers = np.asarray(plain, dtype=np.float64) if not np.iscomplexobj(plain) else np.empty(0)
    except (TypeError, ValueError, NotImplementedError):  # lists of other lengths, text; a tensor on `meta`
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(
            f"{where}: scores must be a finite number for each of {count} candidates, got {kind_of(scores)}; "
            "before the first pick, in their order"
        )
    found.scores = numbers.tolist()  # plain, as files hold them
    for name, one in (("parts", found.parts), ("unseen", found.unseen)):
        if not isinstance(one, list) or len(one) not in (0, count):
            raise ValueError(
                f"{where}: {name} must be a list for each of {count} candidates, or empty, got {kind_of(one)}; "
                "leave them out"
            )
    return found


def _check_beside(policy: str, scoring: Scoring) -> None:
    """Refuse what means nothing beside information of one's own, which would be dropped in silence."""
    if policy in POLICIES and policy not in _INFORMED:
        raise ValueError(f"select: information must be None with policy {policy}, got some; use {', '.join(_INFORMED)}")
    if scoring.combine is not None or scoring.network != "ratio":
        raise ValueError(
            "select: combine and network must be left out with information, got "
            f"{scoring.combine or scoring.network}; its groups are scored together, by criterion"
        )


def policy_named(name: str) -> Callable[[Pool], Selection]:
    """The policy of a name, or the function that `package.module:function` names.

    Raises:
        ValueError: If there is none.
    """
    check_named("select", POLICIES, name)
    return POLICIES.find("--policy", name)


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
