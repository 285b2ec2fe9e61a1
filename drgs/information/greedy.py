"""Greedy choice of views by their information: one at a time, each against what the picks before it have told.

Plain greedy picks the candidate with the best score, adds its information to H, that of the known views, and scores
all others again. But scores never rise as H grows: what is known already cannot be learned twice (diminishing
returns). So the score that a candidate had against an earlier H is an upper bound of the one it has now, and lazy
greedy [1] scores again, from the highest bound down, only until no other bound reaches the two best scores that are
known to be current: the best one is the pick, the second best gives its margin. Picks, scores and margins are those
of plain greedy.

Reference:
    [1] Minoux, "Accelerated greedy algorithms for maximizing submodular set functions", 1978.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Sequence

import torch

from drgs.cameras import Camera
from drgs.gain import Gain, Information, Prior, check
from drgs.guards.memory import available
from drgs.information.cache import camera_key, value_key
from drgs.information.combine import Combination
from drgs.information.network_groups import NETWORK_GROUPS
from drgs.information.pool import Pool, Question, Selection

__all__ = ["InformationSource", "ViewInformation", "greedy"]

InformationSource = tuple[Question, Hashable]
"""What views are asked, and the key of the cache: what the answer depends on besides scene, camera and mask."""

_SHARE = 0.25  # of the memory there is, for information that could be computed again
_ROUNDING = 1e-12  # relative: how far a sum of float64 gains may rise again by rounding, and a bound be missed by


class ViewInformation:
    """Information of single views as greedy needs it: out of the pool's cache if it is there, checked, in float32.

    Attributes:
        computed: Views that were not in the cache.
        told: Group of a network -> whether any view so far says something about it.
    """

    def __init__(self, pool: Pool, source: InformationSource, known: InformationSource | None = None):
        """
        Args:
            pool: Whose cache is asked, and whose `progress` is called after each view.
            source: What information is computed by.
            known: The same of views that are known, where less is needed of them.
        """
        self.pool, self.source, self.known = pool, source, known or source
        self.computed = self.done = 0
        self._expected = len(pool.train) + len(pool.candidates)
        self.told: dict[str, bool] = {}
        self._coming: Iterator[Information] | None = None

    def ahead(self, views: Sequence[tuple[Camera, bool, torch.Tensor | None]]) -> None:
        """Say which views will be asked for next, in this order: (camera, is known, mask). Workers begin with them."""
        pool, wanted, seen = self.pool, [], set()
        if pool.workers is None:
            return
        cache = pool.cache
        if cache is not None and not cache.recognizes(pool.scene):
            cache = None  # which finds nothing then, not even of a view that comes twice
        for camera, is_known, mask in views:
            question, key = self._key(camera, is_known, mask)
            if cache is None or not (key in seen or cache.has(pool.scene, key)):
                wanted.append((question, camera, mask))
            seen.add(key)
        self._coming = pool.workers.each(pool.scene, wanted)

    def _key(self, camera: Camera, is_known: bool, mask: torch.Tensor | None) -> tuple[Question, Hashable]:
        """What a view is asked, and the key under which the cache keeps the answer."""
        question, key = self.known if is_known else self.source
        if self.pool.cache is None:
            return question, None
        return question, (key, camera_key(camera), None if mask is None else value_key(mask))

    def __call__(
        self, what: str, camera: Camera, is_known: bool = False, mask: torch.Tensor | None = None
    ) -> Information:
        """Of one view; `what` it is, for messages."""
        pool, (question, key) = self.pool, self._key(camera, is_known, mask)
        if pool.cache is None:
            found = self._new(what, camera, mask, question)
        else:
            found = pool.cache.get(pool.scene, key, lambda: self._new(what, camera, mask, question))
        for name, x in found.items():
            if name.rpartition(".")[2] in NETWORK_GROUPS:
                self.told[name] = self.told.get(name, False) or bool(x.any())
        self.done += 1
        if pool.progress:
            pool.progress(self.done, self._expected)
        return found

    def expect(self, more: int) -> None:
        """So many views will be asked for once more, for `progress`."""
        self._expected += more

    def _new(self, what: str, camera: Camera, mask: torch.Tensor | None, question: Question) -> Information:
        answer = question(self.pool.scene, camera, mask) if self._coming is None else next(self._coming)
        found = {name: x.to(torch.float32) for name, x in answer.items()}
        self.computed += 1
        check(f"select: {what}", found, self.pool.scoring.criterion)
        return found


def greedy(pool: Pool, information: ViewInformation, combination: Combination | None = None) -> Selection:
    """The best candidate, then the best once that one is known, `pool.k` times.

    Args:
        pool: Whose `scoring` says how much what `information` returns counts.
        information: Of single views.
        combination: How a score is made of it; default by that scoring, all groups together.
    """
    combination, prior = combination or Combination(pool.scoring), pool.scoring.prior_of()
    if not combination.traced or combination.apart:  # a trace alone has no lambda
        _check_prior(pool, prior)
    H, everything, scores, kept = _first_round(pool, information, combination)
    gains = combination.compared(scores)
    selection = Selection(
        picks=[],
        scores=[gain.total for gain in gains],
        parts=[gain.parts for gain in gains],
        unseen=[math.fsum(gain.unseen.values()) for gain in gains],
        left_out=gains[0].left_out,
        evaluations=len(gains),
        computed=information.computed,
        notes=[*_notes(gains, combination.apart), *_silent(information.told)],
    )
    # Scores never rise as H grows, unless lambda or the set of counted parameters changes with it.
    falling = pool.lazy and not prior.relative and min((prior.value, *prior.groups.values())) > 0 and combination.falls
    left, fresh = list(range(len(gains))), set(range(len(gains)))
    while True:
        order = sorted((i for i in left if i in fresh), key=lambda i: -gains[i].total)  # stable: ties by index
        best = order[0]
        margin = gains[best].total - gains[order[1]].total if len(order) > 1 else None
        selection.picks.append(pool.pick(best, gains[best].total, gains[best].parts, margin))
        if len(selection.picks) == pool.k:
            return selection
        left.remove(best)
        _add(H, kept.pop(best))
        fresh = set()  # the other scores are bounds now
        selection.evaluations += _refresh(gains, left, fresh, falling, combination.scorer(H, everything), kept)
        for i, gain in zip(left, combination.compared([gains[i] for i in left]), strict=True):
            gains[i] = gain


def _first_round(
    pool: Pool, information: ViewInformation, combination: Combination
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor] | None, list[Gain], dict[int, Information]]:
    """H of the training views and, where scores are pooled, of all views; every candidate's gain and, where it is
    wanted again, its information by index.
    """
    H: dict[str, torch.Tensor] = {}
    gains: list[Gain] = []
    kept: dict[int, Information] = {}
    masks, candidates = pool.masks or [None] * len(pool.train), [(camera, False, None) for camera in pool.candidates]
    information.ahead([*((x, True, mask) for x, mask in zip(pool.train, masks, strict=True)), *candidates])
    for i, (camera, mask) in enumerate(zip(pool.train, masks, strict=True)):
        part = information(f"training view {i} ({camera.name})", camera, is_known=True, mask=mask)
        H = H or _nothing(part)
        _add(H, part)
    views = [(i, f"candidate {i} ({camera.name})", camera) for i, camera in enumerate(pool.candidates)]
    score, everything, keeps = None, None, pool.k > 1
    for i, what, camera in views:
        part = information(what, camera)
        if i == 0:
            H = _nothing(part) | H  # also of what known views were not asked
            if combination.pooled:
                everything = {name: x.clone() for name, x in H.items()}
                keeps = keeps or _fits(part, len(views))
            else:
                score = combination.scorer(H)
        if everything is not None:
            _add(everything, part)
        if score:
            gains.append(score(part))
        if keeps:
            kept[i] = part
        del part  # else two views are alive while the next one is computed
    if everything is not None:
        score = combination.scorer(H, everything)
        if not keeps:
            information.expect(len(views))
            information.ahead(candidates)
        gains = [score(kept[i] if keeps else information(what, camera)) for i, what, camera in views]
    return H, everything, gains, kept


def _fits(part: Information, count: int) -> bool:
    """Whether so many views' information may be held at a time: computing it twice takes longer, but no memory."""
    there = available()
    return there is None or count * sum(x.nbytes for x in part.values()) < _SHARE * there


def _nothing(part: Information) -> dict[str, torch.Tensor]:
    return {name: torch.zeros_like(x, dtype=torch.float64) for name, x in part.items()}


def _notes(gains: list[Gain], apart: tuple[str, ...]) -> list[str]:
    """What is worth saying about the first round, of blocks that are scored alone or of all groups together."""
    notes, scores = [], [gain.total for gain in gains]
    if max(scores) == 0 and apart:  # of z-scores, one is positive otherwise
        if len(gains) > 1:
            notes.append(f"all {len(scores)} candidates have the same score in each block; the order decided")
    elif max(scores) == 0:
        notes.append("every score is 0: no candidate has information that counts; the order decided")
    elif len(scores) > 1 and max(scores) == min(scores):
        notes.append(f"all {len(scores)} candidates have the same score; the order decided")
    if repaired := max(gain.repaired for gain in gains):
        notes.append(f"{repaired} blocks were not positive definite by rounding; see drgs.gain.block_gain")
    counts = ", ".join(f"{count} of {name}" for name, count in gains[0].left_out.items() if count)
    if counts:
        notes.append(f"lambda = 0: parameters without information in the training views are left out: {counts}")
    return notes


def _silent(told: dict[str, bool]) -> list[str]:
    """What is worth saying about a network that views tell nothing about."""
    return [
        f"deformation: no view has information about {name}, which decides nothing (heads of the network that are 0, "
        "as at its start, or no Gaussian in sight moves)"
        for name, any_view in told.items()
        if not any_view
    ]


def _refresh(
    gains: list[Gain],
    left: list[int],
    fresh: set[int],
    falling: bool,
    score: Callable[[Information], Gain],
    kept: dict[int, Information],
) -> int:
    """Score again what may be among the two best of `left`; how many that were."""
    count = 0
    while stale := [i for i in left if i not in fresh]:
        if falling:
            known = sorted((gains[i].total for i in left if i in fresh), reverse=True)
            i = max(stale, key=lambda i: gains[i].total)
            # An old score bounds the new one; the second best has to be known too, for the margin and for ties.
            if len(known) > 1 and gains[i].total < known[1] * (1 - _ROUNDING):
                break
        else:
            i = stale[0]
        gains[i] = score(kept[i])
        fresh.add(i)
        count += 1
    return count


def _check_prior(pool: Pool, prior: Prior) -> None:
    absolute = not prior.relative and (prior.value > 0 or any(x > 0 for x in prior.groups.values()))
    if not pool.train and not absolute:
        raise ValueError(
            f"select: without training views lambda must be absolute and > 0, got {prior}; nothing would count"
        )


def _add(H: dict[str, torch.Tensor], part: Information) -> None:
    if H.keys() != part.keys() or any(H[name].shape != x.shape for name, x in part.items()):
        shapes = ({name: tuple(x.shape) for name, x in y.items()} for y in (H, part))
        raise ValueError("select: information must be of the same parameters in every view, got {}, {}".format(*shapes))
    for name, x in part.items():
        H[name] += x
