"""Policies by the information of views.

Those whose scores depend on what has been picked are greedy: take the best, add its information to H, score again
(`drgs.selection.greedy`). How a score comes from information is a `Scoring`; its criteria are in gain.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from drgs.information.blocks import CoverageQuestion, DiagonalQuestion, SceneBlocks
from drgs.selection.combine import Asked, Combination, Questions, asked_of
from drgs.selection.greedy import AskedView, InformationSource, ViewInformation, greedy
from drgs.selection.pool import Pool, Selection

__all__ = ["ask_views", "coverage", "fisher", "fisherrf"]

_FEW_PROBES = 8  # of a network's information, below which 1 / H is far too large on average


def fisher(pool: Pool) -> Selection:
    """Largest gain of Fisher information, of the blocks of the image that the scoring names."""
    scoring = pool.scoring
    if pool.information is not None:  # it knows by itself what it is about
        return _greedy(pool, ())
    blocks = _blocks(pool)
    asked, combination = asked_of(blocks)
    selection = _greedy(pool, asked, combination)
    selection.blocks = list(blocks.names)
    selection.semantics = blocks.metric.to_json() if blocks.metric else None
    if "deformation" in blocks.names:
        selection.network = {"score": scoring.network, "probes": scoring.probes}
        if scoring.network == "ratio" and scoring.probes < _FEW_PROBES:
            selection.notes.append(
                f"deformation: {scoring.probes} probes are few to divide by, where one view is all that is known of a "
                f"parameter its ratio is too large; take {_FEW_PROBES} or more"
            )
    if combination.apart:
        selection.combine = "zscore"
        selection.notes.append(f"scores are sums of z-scores of {', '.join(combination.apart)} over the candidates")
    return selection


def fisherrf(pool: Pool) -> Selection:
    """Largest sum Hc / (H + lambda) of FisherRF's H, which has no rotations and no features."""
    prior = pool.scoring.prior_of("fisherrf")
    weights = _without_rotations(pool.scoring.weights)
    prior = dataclasses.replace(prior, groups=_without_rotations(prior.groups))
    asked = Asked(DiagonalQuestion("fisherrf", without=("features",)))
    plain = dataclasses.replace(pool, masks=None)  # of which FisherRF knows nothing
    return _greedy(_scored(plain, criterion="eig", prior=prior, weights=weights), [asked])


def coverage(pool: Pool) -> Selection:
    """Largest sum Wc / (W + lambda), W = sum over pixels of w^2."""
    prior = dataclasses.replace(pool.scoring.prior_of("coverage"), groups={})
    return _greedy(_scored(pool, criterion="eig", prior=prior, weights={}), [Asked(CoverageQuestion())])


def _greedy(pool: Pool, asked: Sequence[Asked], combination: Combination | None = None) -> Selection:
    """`greedy` by what `drgs.fisher` says of each view, or by the pool's own information.

    Args:
        pool: The pool whose scoring says how much it counts.
        asked: What is asked of a view.
        combination: How that becomes a score; default by the pool's scoring, all groups together.
    """
    combination = combination or Combination(pool.scoring)
    if own := pool.information:
        kept_by = own, pool.scoring.settings
        source = InformationSource(lambda scene, camera, mask: own(camera), kept_by, by_name=True)
        return greedy(pool, ViewInformation(pool, source), combination)
    told = [one for one in asked if one.question.asks_known]
    known = None if len(told) == len(asked) else _source(pool, told)
    return greedy(pool, ViewInformation(pool, _source(pool, asked), known), combination)


def _source(pool: Pool, asked: Sequence[Asked]) -> InformationSource:
    """What views are asked: with a cache, first what depends on a view alone."""
    questions = Questions(pool.scoring.settings, tuple(asked))
    if pool.cache is None:
        return InformationSource(questions)
    return InformationSource(questions.lasting(), finish=questions.finished)


def ask_views(pool: Pool) -> None:
    """Ask the candidates what `fisher` goes by, for the pool's cache; nothing is scored."""
    asked, _ = asked_of(_blocks(pool))
    for _ in ViewInformation(pool, _source(pool, asked)).each(
        [AskedView(f"candidate {i}", camera) for i, camera in enumerate(pool.candidates)]
    ):
        pass


def _blocks(pool: Pool) -> SceneBlocks:
    """The blocks of the image that the pool's views are asked about."""
    views = [*pool.train, *pool.candidates]
    return SceneBlocks.of(pool.scene, pool.scoring, views, answers=pool.answers, empty_outside=pool.empty_outside)


def _scored(pool: Pool, **fields: Any) -> Pool:
    """The same pool with other fields of its scoring."""
    return dataclasses.replace(pool, scoring=dataclasses.replace(pool.scoring, **fields))


def _without_rotations(groups: Mapping[str, float]) -> dict[str, float]:
    """What is said of groups that FisherRF's rasterizer knows."""
    return {name: x for name, x in groups.items() if name != "rotations"}
