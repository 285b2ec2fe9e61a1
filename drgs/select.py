"""Which cameras to add: policies over information, and simple baselines.

A policy is a function from a `Pool` to a `Selection`; adding one is writing it in `drgs.selection` and naming it in
`POLICIES` (`drgs.information.choices`), or `POLICIES["mine"] = mine` in a script. How a score comes from information
is a `Scoring`; its criteria are in information/criteria.py.

    fisher      `criterion` of the Fisher information (information/gains.py)
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

import torch

from drgs.cameras import Camera, camera_list
from drgs.checks.arguments import must_be
from drgs.ellipsoids import Scene, check_any_scene
from drgs.information.choices import METHODS, POLICIES
from drgs.information.criteria import CRITERIA
from drgs.information.inputs import Masks, mask_list
from drgs.information.region import Region
from drgs.information.scoring import Scoring
from drgs.information.sums import Information
from drgs.selection.cache import Cache
from drgs.selection.policies import choose, policy_named
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
    "Region",
    "Scoring",
    "Selection",
    "policy_named",
    "select",
]

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
    halving: bool = True,
    progress: Callable[[int, int], object] | None = None,
    information: Callable[[Camera], Information] | None = None,
    workers: Workers | None = None,
    refine: Refine | None = None,
    region: Region | None = None,
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
        halving: Score candidates by a quarter of their pixels first, and by all only those within a tenth of the best
            (docs/information.md has how often the pick is the same). Done for one pick by `v_opt` among 8 candidates or
            more of a scene that stands still, of views of 40,000 pixels or more, without region, `information` and a
            cache's bound. The pick is scored by all of its pixels, given estimates of what other candidates show.
        progress: Called with (views done, views) after each view.
        information: Camera -> Information, in place of `drgs.fisher`; the policy's own kind: {"coverage": (N,)} for
            `coverage`, {"blocks": (N, 13, 13)} for criterion `block_logdet`. lambda is in the units of its parameters.
        workers: Processes that compute the information of single views, here or on other machines
            (`drgs.cluster.connect.opened`); scores and picks are made here, of the same bits.
        refine: Move each pick to where its view scores higher; of `fisher`, `fisherrf` and `coverage`, whose scores add
            up (no z-scores). `Pick.camera` is where to.
        region: The part of the scene that counts (`drgs.Region`), of `fisher`, `fisherrf` and `coverage`: what is left
            unknown of pixels that show it. Every view that shows some of it is computed twice.
        **fields: Fields of `Scoring`, in place of `scoring`: `criterion`, `settings`, `method`, `prior`, `weights`,
            `groups`, `blocks`, `semantics`, `network`, `combine`, `probes`; None is the default.
    Raises:
        ValueError: If there are no candidates or fewer than k, an argument is unknown, information is negative, NaN
            or infinite, no view shows anything of the region, or a policy returns something else than a choice of k
            candidates.
    """
    started = time.perf_counter()
    check_any_scene("select", gaussians)
    train = camera_list("select", "train", train)
    pool = Pool(
        scene=gaussians,
        candidates=camera_list("select", "candidates", candidates),
        train=train,
        k=k,
        scoring=_scoring(scoring, fields),
        rng=_GENERATOR if rng is None else rng,
        masks=mask_list("select", masks, train),
        empty_outside=empty_outside,
        cache=cache,
        lazy=lazy,
        halving=halving,
        progress=progress,
        information=information,
        workers=workers,
        refine=refine,
        region=region,
    )
    if masks is not None and information is not None:
        raise ValueError(
            "select: masks must be None with information, got both; an information function weighs pixels itself"
        )
    selection = choose(policy, pool)
    selection.seconds = time.perf_counter() - started
    return selection


def _scoring(scoring: Scoring | None, fields: dict[str, Any]) -> Scoring:
    """The scoring that was passed, or one of the fields that were."""
    known = [field.name for field in dataclasses.fields(Scoring)]
    if unknown := [name for name in fields if name not in known]:
        raise TypeError(f"select() got an unexpected keyword argument {unknown[0]!r}; Scoring has {', '.join(known)}")
    if scoring is None:
        return Scoring(**{name: x for name, x in fields.items() if x is not None})
    must_be("select", "scoring", scoring, Scoring, "e.g. drgs.select.Scoring(criterion=...)")
    if fields:
        raise ValueError(f"select: {', '.join(fields)} must be fields of scoring, got both; put them into Scoring(...)")
    return scoring
