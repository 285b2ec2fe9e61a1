"""Greedy choice of views by information gain: one at a time, given the known views and the picks before.

Plain greedy picks the candidate with the best score, adds its information to H, that of the known views, and scores
all others again. But scores never rise as H grows: what is known already cannot be learned twice (diminishing
returns). So the score that a candidate had against an earlier H is an upper bound of the one it has now, and lazy
greedy [1] scores again, from the highest bound down, only until no other bound reaches the two best scores that are
known to be current: the best one is the pick, the second best gives its margin. Picks, scores and margins are those
of plain greedy.

A single pick need not compute every candidate in full, either. As in successive halving [2], candidates are first
scored by a quarter of their pixels, and only those that come close to the best by all (`Pool.halving`). Rays through
fewer places of an image are a sample of its rays: their information, times the pixels that each stands for, estimates
that of the whole view. Of known views, whose information divides, it is always that of all pixels.

Reference:
    [1] Minoux, "Accelerated greedy algorithms for maximizing submodular set functions", 1978.
    [2] Karnin et al., "Almost optimal exploration in multi-armed bandits", ICML 2013: sequential halving.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import torch

from drgs.cameras import Camera
from drgs.cameras.sizes import at_most
from drgs.ellipsoids import Gaussians
from drgs.information.gains import Gain, check, shares_of
from drgs.information.network_groups import NETWORK_GROUPS
from drgs.information.prior import Prior
from drgs.information.quantity import Quantity
from drgs.information.sums import Information, add
from drgs.runtime.memory import available
from drgs.selection.cache import Cache, size_of
from drgs.selection.combine import Combination
from drgs.selection.pool import Pool, Selection
from drgs.selection.refining import refined

_MEMORY_SHARE = 0.25  # of the free memory, for information that could be computed again; chosen
_WHOLE = 1e-5  # below 1, from which on a share of a pixel is all of it: rounding of float32 sums of weights
_REDUCTION = 4  # pixels of a candidate for each one that it is first scored by; by 16, `office` kept 9 picks of 10
_LEAST_PIXELS = 40_000  # of such a candidate: of fewer, half of the time is that of its Gaussians, whatever the pixels
_LEAST_CANDIDATES = 8  # two at least are scored twice: of fewer, nothing is saved
_MARGIN = 0.1  # share of the best score within which estimates decide nothing; chosen on `banana`, `fern`, `office`
_ROUNDING = 1e-12  # relative: how far a sum of float64 gains may rise again by rounding, and a bound be missed by


class PoolView(NamedTuple):
    """A view of a pool.

    Attributes:
        title: What it is called in messages.
        camera, mask: The camera and the mask of the view.
        is_known: Whether it is one of the known ones.
        of_region: Whether its mask is that of a region.
        stands_for: Pixels of the whole view for each of the camera's, whose information it estimates.
    """

    title: str
    camera: Camera
    is_known: bool = False
    mask: torch.Tensor | None = None
    of_region: bool = False
    stands_for: float = 1.0


class ViewInformation:
    """Information of a pool's views by one quantity, checked and counted.

    Attributes:
        computed: Number of views that were not in the cache.
        sizes: (title, pixels it stands for) of each view so far -> bytes that a cache needs to keep it.
        has_any: Group of a network -> whether any view so far has information about it.
    """

    def __init__(self, pool: Pool, quantity: Quantity, of_known: Quantity | None = None) -> None:
        """
        Args:
            pool: The pool whose cache and workers are used, and whose `progress` is called after each view.
            quantity: What is computed of a view.
            of_known: What is computed of known views, where less is needed of them.
        """
        self.pool = pool
        self.quantity = quantity
        self.of_known = of_known or quantity
        self.computed = self.done = 0
        self.sizes: dict[tuple[str, float], int] = {}
        self._expected = len(pool.train) + len(pool.candidates)
        self.has_any: dict[str, bool] = {}

    def each(self, views: Sequence[PoolView]) -> Iterator[Information]:
        """The information of these views, one after another: nothing of one is held while the next one is computed."""
        # Where the scene may change so do the shares of pixels, which are never looked for again.
        changes = self.pool.cache is not None and self.pool.cache.bound is not None
        pool = dataclasses.replace(self.pool, cache=None) if changes and any(x.of_region for x in views) else self.pool
        quantities = [self._quantity_of(view) for view in views]

        def accept(i: int, computed: Information) -> None:
            self.computed += 1
            signed = {*quantities[i].signed}
            where = f"select: {views[i].title}"
            check(where, {name: x for name, x in computed.items() if name in signed}, signed=True)
            check(where, {name: x for name, x in computed.items() if name not in signed})

        requests = [(quantity, view.camera, view.mask) for quantity, view in zip(quantities, views, strict=True)]
        results = pool.compute(requests, accept)
        for quantity, view in zip(quantities, views, strict=True):
            yield self._counted(quantity, view, next(results))

    def for_moved_cameras(self, most: int) -> Callable[[Camera], Information]:
        """What computes the information of further cameras, so many at most, one at a time."""
        self.expect(most)
        return lambda camera: next(self.each([PoolView(f"{camera.name}, moved", camera)]))

    def expect(self, more: int) -> None:
        """So many more views will be computed, for `progress`."""
        self._expected += more

    def _quantity_of(self, view: PoolView) -> Quantity:
        quantity = self.of_known if view.is_known else self.quantity
        return quantity.of_part() if view.of_region else quantity

    def _counted(self, quantity: Quantity, view: PoolView, computed: Information) -> Information:
        """The information that adds up over views, of what was computed of one."""
        self.sizes[view.title, view.stands_for] = size_of(computed)
        information = quantity.summand(computed, view.camera, view.mask)
        for name, x in information.items():
            if name.rpartition(".")[2] in NETWORK_GROUPS:
                self.has_any[name] = self.has_any.get(name, False) or bool(x.any())
        self.done += 1
        if self.pool.progress:
            self.pool.progress(self.done, self._expected)
        return information if view.stands_for == 1 else {name: x * view.stands_for for name, x in information.items()}


def greedy(pool: Pool, information: ViewInformation, combination: Combination | None = None) -> Selection:
    """The best candidate, then the best once that one is known, `pool.k` times.

    Args:
        pool: The pool whose `scoring` says how much what `information` returns counts.
        information: The information of single views.
        combination: How a score is made of it; default by that scoring, all groups together.
    """
    combination = combination or Combination(pool.scoring)
    prior = pool.prior_of(combination.scoring)
    combination = combination.with_prior(prior)
    if pool.refine is not None and combination.zscored:
        raise ValueError("select: refine must be None with combine zscore, which compares candidates; use combine sum")
    if not combination.trace_block or combination.zscored:  # a trace alone has no lambda
        _check_prior(pool, prior)
    first = _first_round(pool, information, combination)
    gains, kept = combination.compared(first.gains), first.kept
    selection = Selection(
        picks=[],
        scores=[gain.total for gain in gains],
        parts=[gain.parts for gain in gains],
        unseen=[math.fsum(gain.unseen.values()) for gain in gains],
        left_out=gains[0].left_out,
        prior=dataclasses.replace(prior, lengths={}),  # what is told of it, as of the scoring, are plain numbers
        evaluations=first.evaluations,
        pixels=first.pixels,
        notes=[
            *_notes(gains, combination.zscored),
            *_silent(information.has_any),
            *_crowded(pool.cache, information),
            *([first.note] if first.note else []),
            *_halved(pool, first.pixels),
        ],
    )
    # Scores never rise as H grows, unless lambda or the set of counted parameters changes with it.
    fixed = not prior.relative and min((prior.value, *prior.groups.values())) > 0
    falling = pool.lazy and fixed and combination.scores_fall
    left, fresh = list(range(len(gains))), set(range(len(gains)))
    while True:
        order = sorted((i for i in left if i in fresh), key=lambda i: -gains[i].total)  # stable: ties by index
        best = order[0]
        margin = gains[best].total - gains[order[1]].total if len(order) > 1 else None
        pick, picked = pool.pick(best, gains[best].total, gains[best].parts, margin), kept.get(best)
        if pool.refine is not None:
            score = first.scorer(combination)
            compute = information.for_moved_cameras(pool.refine.evaluations)
            start = pool.candidates[best]
            camera, gain, moved, count = refined(
                pool.scene, pool.candidates, pool.train, start, gains[best], score, compute, pool.refine
            )
            selection.evaluations += count
            pick = dataclasses.replace(pick, score=gain.total, parts=gain.parts, camera=camera, start=pick.score)
            picked = picked if moved is None else moved
        selection.picks.append(pick)
        selection.computed = information.computed
        if len(selection.picks) == pool.k:
            return selection
        left.remove(best)
        kept.pop(best)
        assert picked is not None  # kept, as more than one is picked
        _add(first.known, picked)
        fresh = set()  # the other scores are bounds now
        selection.evaluations += _refresh(gains, left, fresh, falling, first.scorer(combination), kept)
        for i, gain in zip(left, combination.compared([gains[i] for i in left]), strict=True):
            gains[i] = gain


class _FirstRound(NamedTuple):
    """What is known once every candidate has been scored.

    Attributes:
        known: H, the information of the training views, to which that of picks is added.
        everything: The information of all views, of the pixels that count; None where scores are not pooled.
        shares: Factors of what each parameter adds to a score, where a region counts and scores are not pooled.
        note: What is to be said of the region; "" where there is nothing.
        gains: Of each candidate.
        kept: Candidate -> its information, where it is wanted again.
        pixels: By how many each candidate was scored; none where all were by all of theirs.
        evaluations: How often one was scored.
    """

    known: dict[str, torch.Tensor]
    everything: Information | None
    shares: Information | None
    note: str
    gains: list[Gain]
    kept: dict[int, Information]
    pixels: list[int]
    evaluations: int

    def scorer(self, combination: Combination) -> Callable[[Information], Gain]:
        """What scores a candidate, given what is known by now."""
        return combination.scorer(self.known, self.everything, self.shares)


def _first_round(pool: Pool, information: ViewInformation, combination: Combination) -> _FirstRound:
    """Score every candidate, given the training views."""
    H: dict[str, torch.Tensor] = {}
    gains: list[Gain] = []
    kept: dict[int, Information] = {}
    known = [
        PoolView(f"training view {i} ({camera.name})", camera, True, mask)
        for i, (camera, mask) in enumerate(zip(pool.train, pool.masks or [None] * len(pool.train), strict=True))
    ]
    whole = [PoolView(f"candidate {i} ({camera.name})", camera) for i, camera in enumerate(pool.candidates)]
    candidates = [_reduced(view) for view in whole] if _halves(pool, combination) else whole
    shares, note = _shares_of_region(pool, [*known, *candidates])
    each = information.each([*known, *candidates])
    for _ in known:
        part = next(each)
        H = H or _nothing(part)
        _add(H, part)
    score = None
    everything = None
    keeps = pool.k > 1
    for i in range(len(candidates)):
        part = next(each)
        if i == 0:
            H = _nothing(part) | H  # also of groups that are not computed of known views
            if combination.pooled or pool.region is not None:
                everything = {name: x.clone() for name, x in H.items()}
                keeps = keeps or _fits(part, len(candidates))
            else:
                score = combination.scorer(H)
        if everything is not None:
            _add(everything, part)
        if score:
            gains.append(score(part))
        if keeps:
            kept[i] = part
        del part  # else two views are alive while the next one is computed
    pooled: Information | None = everything
    factors = None
    if everything is not None:
        if pool.region is not None:
            of_region = _of_region(information, [*known, *candidates], shares, everything)
            pooled, factors = (of_region, None) if combination.pooled else (None, shares_of(of_region, everything))
        score = combination.scorer(H, pooled, factors)
        if not keeps:
            information.expect(len(candidates))
            each = information.each(candidates)
        gains = [score(kept[i] if keeps else next(each)) for i in range(len(candidates))]
    pixels: list[int] = []
    evaluations = len(gains)
    if everything is not None and any(view.stands_for != 1 for view in candidates):
        scorer = lambda: combination.scorer(H, everything)  # noqa: E731
        full = _score_in_full(information, whole, candidates, gains, scorer, everything, kept)
        used = [(whole if i in full else candidates)[i].camera for i in range(len(whole))]
        pixels = [camera.width * camera.height for camera in used]
        evaluations += len(full)
    return _FirstRound(H, pooled, factors, note, gains, kept, pixels, evaluations)


def _halves(pool: Pool, combination: Combination) -> bool:
    """Whether candidates are first scored by fewer pixels: where that has been measured, and saves time."""
    few = len(pool.candidates) < _LEAST_CANDIDATES or pool.information is not None or pool.region is not None
    changes = pool.cache is not None and pool.cache.bound is not None  # which keeps views of expected cameras alone
    asked = pool.halving and pool.k == 1 and combination.pooled and not combination.zscored
    return asked and isinstance(pool.scene, Gaussians) and not (few or changes)


def _reduced(view: PoolView) -> PoolView:
    """The view as it is first scored: by fewer pixels, unless it has few."""
    pixels = view.camera.width * view.camera.height
    if pixels < _LEAST_PIXELS:
        return view
    camera = at_most(view.camera, pixels // _REDUCTION)
    return view._replace(camera=camera, stands_for=pixels / (camera.width * camera.height))


def _score_in_full(
    information: ViewInformation,
    whole: Sequence[PoolView],
    reduced: Sequence[PoolView],
    gains: list[Gain],
    scorer: Callable[[], Callable[[Information], Gain]],
    everything: dict[str, torch.Tensor],
    kept: Mapping[int, Information],
) -> set[int]:
    """Score by all of their pixels the candidates that estimates do not tell from the best, two at least.

    Args:
        information: The information of views.
        whole, reduced: The candidates, and as they were estimated.
        gains: Gains by estimates, in whose place those by all pixels come.
        scorer: Makes what scores a candidate by `everything` as it is now.
        everything: The information of all views: estimates in it are replaced, too.
        kept: Candidate -> its estimate, computed again where there is none.
    Returns:
        The candidates whose gains are of all pixels.
    """
    full: dict[int, Information] = {}
    while True:
        order = sorted(range(len(gains)), key=lambda i: -gains[i].total)
        least = (1 - _MARGIN) * gains[order[0]].total
        close = [i for rank, i in enumerate(order) if i not in full and (rank < 2 or gains[i].total >= least)]
        if not close:
            return {*full}
        information.expect(sum(1 if i in kept else 2 for i in close))
        for i, part in zip(close, information.each([whole[i] for i in close]), strict=True):
            full[i] = part
            estimate = kept[i] if i in kept else next(information.each([reduced[i]]))
            for name, x in everything.items():
                x.add_(part[name]).sub_(estimate[name]).clamp_(min=0)  # below 0 by rounding alone
        score = scorer()
        for i, part in full.items():
            gains[i] = score(part)


def _shares_of_region(pool: Pool, views: Sequence[PoolView]) -> tuple[list[torch.Tensor | None], str]:
    """How much of each pixel of the views shows the pool's region, and what is to be said of it; None: all of it does.

    Raises:
        NothingOfRegion: If no view shows any of it.
    """
    if pool.region is None:
        return [None] * len(views), ""
    shares, note = pool.region.shares(pool.scene, [view.camera for view in views], pool.scoring.settings, "select")
    return [None if bool((share > 1 - _WHOLE).all()) else share for share in shares], note


def _of_region(
    information: ViewInformation,
    views: Sequence[PoolView],
    shares: Sequence[torch.Tensor | None],
    everything: Mapping[str, torch.Tensor],
) -> dict[str, torch.Tensor]:
    """The information of all views, each pixel weighed by how much of it shows a region.

    Squares of derivatives are multiplied by the square of a mask, so that the root of the shares is the mask.

    Args:
        information: The information of single views.
        views: All views.
        shares: (H, W) of each; None: all of it shows the region.
        everything: The information of all pixels of all views.
    """
    if all(share is None for share in shares):
        return dict(everything)
    whole = [view for view, share in zip(views, shares, strict=True) if share is None]
    partly = [
        view._replace(mask=share.sqrt() if view.mask is None else share.sqrt() * view.mask, of_region=True)
        for view, share in zip(views, shares, strict=True)
        if share is not None and bool(share.any())
    ]
    information.expect(len(whole) + len(partly))
    total = {name: torch.zeros_like(x) for name, x in everything.items()}
    for part in itertools.chain(information.each(whole), information.each(partly)):
        _add(total, {name: part.get(name, torch.zeros_like(x)) for name, x in everything.items()})
    return total


def _fits(part: Information, count: int) -> bool:
    """Whether so many views' information may be held at a time: computing it twice takes longer, but no memory."""
    there = available()
    return there is None or count * size_of(part) < _MEMORY_SHARE * there


def _nothing(part: Information) -> dict[str, torch.Tensor]:
    return {name: torch.zeros_like(x, dtype=torch.float64) for name, x in part.items()}


def _notes(gains: list[Gain], zscored: tuple[str, ...]) -> list[str]:
    """What is worth saying about the first round, of blocks that are scored alone or of all groups together."""
    notes = []
    scores = [gain.total for gain in gains]
    if max(scores) == 0 and zscored:  # of z-scores, one is positive otherwise
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


def _halved(pool: Pool, pixels: Sequence[int]) -> list[str]:
    """What is worth saying of candidates that were scored by fewer pixels."""
    whole = [camera.width * camera.height for camera in pool.candidates]
    if few := sum(n < all_of_them for n, all_of_them in zip(pixels, whole, strict=False)):
        return [f"halving: the scores of {few} of {len(whole)} candidates are estimates by a quarter of their pixels"]
    return []


def _silent(has_any: dict[str, bool]) -> list[str]:
    """What is worth saying about a network that no view has information about."""
    return [
        f"deformation: no view informs {name}, which adds 0 to every score (heads of the network that are 0, "
        "as at its start, or no Gaussian in sight moves)"
        for name, any_view in has_any.items()
        if not any_view
    ]


def _crowded(cache: Cache | None, information: ViewInformation) -> list[str]:
    """What is worth saying about a cache that cannot hold the views of one call."""
    needed = sum(information.sizes.values())
    if cache is None or needed <= cache.max_bytes:
        return []
    return [
        f"cache: max_bytes must be at least {needed} for all {len(information.sizes)} views to be found by the next "
        f"call, is {cache.max_bytes}; the others are computed again"
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
    add(H, part)
