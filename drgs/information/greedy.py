"""Greedy choice of views by their information: one at a time, each against what the picks before it have told.

Scores fall as H grows (diminishing returns), so that an old score bounds a new one: "lazy" greedy scores again only
what could still win.

Reference:
    [1] Minoux, "Accelerated greedy algorithms for maximizing submodular set functions", 1978.
"""

from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.gain import Gain, Information, check, scorer

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.select import Pool

__all__ = ["Cache", "Pick", "Selection", "Source", "greedy"]

_ROUNDING = 1e-12  # relative: how far a sum of float64 gains may rise again by rounding


@dataclasses.dataclass(frozen=True)
class Pick:
    """A chosen candidate.

    Attributes:
        index: Place in the list of candidates.
        name: Of its camera.
        score: When it was picked.
        parts: Group -> its share of the score; empty for policies without groups.
        margin: This score minus the next best one's at that time; None when nothing else was left or the policy ranks
            nothing. With several threads sums differ in their last digits, so that ties and near-ties may fall
            differently from run to run.
    """

    index: int
    name: str
    score: float
    parts: dict[str, float]
    margin: float | None


@dataclasses.dataclass
class Selection:
    """What `select` returns; `dataclasses.asdict` of it is plain JSON.

    Attributes:
        picks: In the order of picking.
        scores: Of every candidate, before the first pick.
        parts: Of every candidate, before the first pick: group -> share of its score.
        unseen: Of every candidate: the share of its score from parameters that no training view has information
            about (lambda alone decides how much they count).
        left_out: Group -> parameters not counted because lambda = 0 and no training view has information about them.
        evaluations: How often a candidate was scored.
        computed: Views whose information was computed, not taken from the cache.
        notes: What a reader of the result should know, one sentence each.
        seconds: Wall time.
    """

    picks: list[Pick]
    scores: list[float]
    parts: list[dict[str, float]] = dataclasses.field(default_factory=list)
    unseen: list[float] = dataclasses.field(default_factory=list)
    left_out: dict[str, int] = dataclasses.field(default_factory=dict)
    evaluations: int = 0
    computed: int = 0
    notes: list[str] = dataclasses.field(default_factory=list)
    seconds: float = 0.0


class Cache:
    """Information of views, kept while the Gaussians do not change: 4 bytes a parameter and view.

    Forgets everything when it is asked about other tensors than last time, or when one of them was changed in place
    by torch. Changes behind torch's back (`.data`, NumPy views) need `invalidate`.

    Attributes:
        hits, misses: Views found and computed so far.
    """

    def __init__(self):
        self._views, self._tensors, self._origin, self.hits, self.misses = {}, (), b"", 0, 0

    def __len__(self) -> int:
        return len(self._views)

    def invalidate(self) -> None:
        """Forget everything."""
        self._views.clear()
        self._tensors = ()

    def get(self, gaussians: Gaussians, key, compute: Callable[[], Information]) -> Information:
        """What is stored under a hashable `key` for these Gaussians, else what `compute` returns."""
        tensors = tuple(gaussians.parameters().values())
        # Weak: a cache must not keep the Gaussians of an earlier state alive.
        origin = gaussians.origin.tobytes()
        same = (
            origin == self._origin
            and len(tensors) == len(self._tensors)
            and all(
                reference() is x and version == x._version
                for x, (reference, version) in zip(tensors, self._tensors, strict=True)
            )
        )
        if not same:
            self.invalidate()
            self._origin = origin
            self._tensors = tuple((weakref.ref(x), x._version) for x in tensors)
        if key not in self._views:
            self._views[key] = compute()
            self.misses += 1
        else:
            self.hits += 1
        return self._views[key]


class Source:
    """Information of single views, checked and in float32."""

    def __init__(self, pool: Pool, kind: str, compute: Callable):
        self.pool, self.kind, self.compute = pool, kind, compute
        self.computed = self.done = 0

    def __call__(self, what: str, camera: Camera) -> Information:
        """Of one view; `what` it is, for messages."""
        pool = self.pool
        if pool.cache is None:
            found = self._new(what, camera)
        else:
            key = (pool.information or self.kind, pool.settings, _identity(camera))
            found = pool.cache.get(pool.gaussians, key, lambda: self._new(what, camera))
        self.done += 1
        if pool.progress:
            pool.progress(self.done, len(pool.train) + len(pool.candidates))
        return found

    def _new(self, what: str, camera: Camera) -> Information:
        pool = self.pool
        if pool.information:
            found = pool.information(camera)
        else:
            from drgs import fisher  # loads Dr.Jit, which the other policies need not have

            found = self.compute(fisher, pool.gaussians, camera, pool.settings)
        self.computed += 1
        found = {name: x.to(torch.float32) for name, x in found.items()}
        check(f"select: {what}", found, pool.criterion)
        return found


def _identity(camera: Camera) -> tuple:
    """Equal for cameras that see the same; names alone may repeat."""
    pose = np.asarray(camera.c2w).tobytes()
    return camera.name, pose, camera.K.tobytes(), camera.width, camera.height, camera.model, camera.distortion


def greedy(pool: Pool, source: Source) -> Selection:
    """The best, then the best once that is known, `pool.k` times.

    Args:
        pool: Whose `criterion`, `prior` and `weights` score what `source` returns.
        source: Information of single views.
    """
    _check_prior(pool)
    H, gains, kept = _first_round(pool, source)
    selection = Selection(
        picks=[],
        scores=[gain.total for gain in gains],
        parts=[gain.parts for gain in gains],
        unseen=[math.fsum(gain.unseen.values()) for gain in gains],
        left_out=gains[0].left_out,
        evaluations=len(gains),
        computed=source.computed,
        notes=_notes(gains),
    )
    # Scores never rise as H grows, unless lambda or the set of counted parameters changes with it.
    falling = pool.lazy and not pool.prior.relative and min((pool.prior.value, *pool.prior.groups.values())) > 0
    left, fresh = list(range(len(gains))), set(range(len(gains)))
    while True:
        order = sorted((i for i in left if i in fresh), key=lambda i: -gains[i].total)  # stable: ties by index
        best = order[0]
        margin = gains[best].total - gains[order[1]].total if len(order) > 1 else None
        name = pool.candidates[best].name
        selection.picks.append(Pick(best, name, gains[best].total, gains[best].parts, margin))
        if len(selection.picks) == pool.k:
            return selection
        left.remove(best)
        _add(H, kept[best])
        kept[best], fresh = None, set()
        score = scorer(H, pool.criterion, pool.prior, pool.weights)
        selection.evaluations += _refresh(gains, left, fresh, falling, score, kept)


def _first_round(pool: Pool, source: Source) -> tuple[dict[str, torch.Tensor], list[Gain], list[Information]]:
    """H of the training views, every candidate's gain and, where more than one is picked, its information."""
    H, score, gains, kept = None, None, [], []
    for i, camera in enumerate(pool.train):
        part = source(f"training view {i} ({camera.name})", camera)
        H = _nothing(part) if H is None else H
        _add(H, part)
    for i, camera in enumerate(pool.candidates):
        part = source(f"candidate {i} ({camera.name})", camera)
        if score is None:
            H = _nothing(part) if H is None else H
            score = scorer(H, pool.criterion, pool.prior, pool.weights)
        gains.append(score(part))
        if pool.k > 1:
            kept.append(part)
        del part  # else two views are alive while the next one is computed
    return H, gains, kept


def _nothing(part: Information) -> dict[str, torch.Tensor]:
    return {name: torch.zeros_like(x, dtype=torch.float64) for name, x in part.items()}


def _notes(gains: list[Gain]) -> list[str]:
    """What is worth saying about the first round."""
    notes, scores = [], [gain.total for gain in gains]
    if max(scores) == 0:
        notes.append("every score is 0: no candidate has information that counts; the order decided")
    elif len(scores) > 1 and max(scores) == min(scores):
        notes.append(f"all {len(scores)} candidates have the same score; the order decided")
    if repaired := max(gain.repaired for gain in gains):
        notes.append(f"{repaired} blocks were not positive definite by rounding; see drgs.gain.block_gain")
    counts = ", ".join(f"{count} of {name}" for name, count in gains[0].left_out.items() if count)
    if counts:
        notes.append(f"lambda = 0: parameters without information in the training views are left out: {counts}")
    return notes


def _refresh(gains: list[Gain], left: list[int], fresh: set[int], falling: bool, score, kept) -> int:
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


def _check_prior(pool: Pool) -> None:
    absolute = not pool.prior.relative and (pool.prior.value > 0 or any(x > 0 for x in pool.prior.groups.values()))
    if not pool.train and not absolute:
        raise ValueError(
            f"select: without training views lambda must be absolute and > 0, got {pool.prior}; nothing would count"
        )


def _add(H: dict[str, torch.Tensor], part: Information) -> None:
    if H.keys() != part.keys() or any(H[name].shape != x.shape for name, x in part.items()):
        shapes = ({name: tuple(x.shape) for name, x in y.items()} for y in (H, part))
        raise ValueError("select: information must be of the same parameters in every view, got {}, {}".format(*shapes))
    for name, x in part.items():
        H[name] += x
