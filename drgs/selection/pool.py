"""What a policy is given, and what it returns: the views to choose from and how they are scored, the choice."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Scene
from drgs.information.choices import Combine
from drgs.information.once_per_time import once_per_time
from drgs.information.scoring import Scoring
from drgs.information.sums import Information
from drgs.selection.cache import Cache, camera_key, value_key
from drgs.selection.refining import Refine

__all__ = ["Pick", "Pool", "Question", "Selection", "ViewQuestion", "Workers"]


@dataclasses.dataclass(frozen=True)
class Pick:
    """A chosen candidate.

    Attributes:
        index: Place in the list of candidates.
        name: Name of its camera.
        score: Its score when it was picked.
        parts: Group -> its share of the score; empty for policies without groups.
        margin: This score minus the next best one's at that time; None when nothing else was left or the policy ranks
            nothing. With several threads sums differ in their last digits, so that ties and near-ties may fall
            differently from run to run.
        camera: The candidate's camera as it was moved, of which `score` and `parts` are; None where nothing is moved.
        start: Score of the candidate itself, which `margin` is of; None likewise.
    """

    index: int
    name: str
    score: float
    parts: dict[str, float]
    margin: float | None
    camera: Camera | None = None
    start: float | None = None


@dataclasses.dataclass
class Selection:
    """What a policy chose, in which order, and the scores that it chose by; `to_json` is how files hold it.

    Attributes:
        picks: Picks in the order of picking.
        scores: Scores of all candidates, before the first pick.
        parts: Parts of all candidates' scores, before the first pick: group -> what it adds.
        unseen: Share of each candidate's score, in the same unit, that is of parameters that no training view has
            information about (lambda alone decides how much they count).
        left_out: Group -> parameters not counted because lambda = 0 and no training view has information about them.
        evaluations: How often a candidate was scored.
        computed: Views whose information was computed, not taken from the cache.
        notes: What a reader of the result should know, one sentence each.
        blocks: The blocks of the image that the information is of; empty for policies without.
        semantics: What is coupled, if anything is: the metric's estimate, gamma and width.
        network: How the block `deformation` scored, and from how many probes, if it did.
        combine: `sum` of the groups' parts, or of blocks' z-scores over the candidates that were left: then scores
            and parts, `block.group`, are in standard deviations (`unseen` not less the mean).
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
    blocks: list[str] = dataclasses.field(default_factory=list)
    semantics: dict | None = None
    network: dict | None = None
    combine: Combine = "sum"
    seconds: float = 0.0

    def blocks_json(self) -> dict[str, Any]:
        """What of images the scores are of, as files hold it."""
        return {name: getattr(self, name) for name in ("blocks", "semantics", "network", "combine")}

    def picks_json(self, views: Sequence[Mapping], after: Sequence[Mapping] | None = None) -> list[dict[str, Any]]:
        """Each pick as files hold it: what is said of its view, score, parts, margin, what is said after these.

        Args:
            views: What is said of each candidate, in their order: index, name and what else says which view it is.
            after: What is said of each at the end of its record.
        """
        return [
            {
                **views[pick.index],
                "score": pick.score,
                "parts": pick.parts,
                "margin": pick.margin,
                **(after[pick.index] if after else {}),
            }
            for pick in self.picks
        ]

    def candidates_json(
        self, views: Sequence[Mapping], after: Sequence[Mapping] | None = None, no_parts: Mapping | None = None
    ) -> list[dict[str, Any]]:
        """Each candidate as files hold it: what is said of its view, score, parts, unseen, what is said after these.

        Args:
            views, after: The same as for `picks_json`.
            no_parts: What stands for `parts` where the policy has no groups.
        """
        count = len(self.scores)
        parts: Sequence[Mapping | None] = self.parts or [no_parts] * count
        unseen: Sequence[float | None] = self.unseen or [None] * count
        rows = zip(views, self.scores, parts, unseen, after or [{}] * count, strict=True)
        return [{**view, "score": score, "parts": own, "unseen": x, **rest} for view, score, own, x, rest in rows]


Question = Callable[[Scene, Camera, torch.Tensor | None], Information]
"""What is asked of a view: scene, camera and mask -> tensors by name. Other processes can be sent it."""


@dataclasses.dataclass(frozen=True)
class ViewQuestion:
    """A question to one view.

    Attributes:
        question: What is asked.
        camera, mask: The camera and the mask of the view.
        kept_by: What the answer depends on besides scene, camera and mask; None: on the question.
    """

    question: Question
    camera: Camera
    mask: torch.Tensor | None = None
    kept_by: Hashable = None

    @property
    def key(self) -> Hashable:
        """By which a cache keeps the answer."""
        by = self.question if self.kept_by is None else self.kept_by
        return by, camera_key(self.camera), None if self.mask is None else value_key(self.mask)


class Workers(Protocol):
    """Other processes that views are asked about in; `drgs.cluster.workers.Cluster` is some."""

    def each(
        self, scene: Scene, views: Sequence[tuple[Question, Camera, torch.Tensor | None]]
    ) -> Iterator[Information]:
        """The answers, in the order of the views, with the bits that this process would find with one thread."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pool:
    """Everything that a policy may look at: the scene, the views that are known and those to choose from.

    Attributes:
        scene: The scene as it is now; the Gaussians that a camera sees are `scene.at(camera.time)`.
        candidates: Cameras to choose from, at least `k`; a policy names them by their place in this list.
        train: Cameras whose views are known; may be empty.
        masks: Masks of these, where they have some; see `drgs.fisher.diagonal`.
        empty_outside: Whether it is known that nothing is outside of the masks, as of an object's.
        k: How many to pick.
        scoring: How views are scored, where the policy scores them by information.
        rng: Generator that policies that draw take their numbers from.
        cache: Cache where information of single views is looked up and kept; None: nowhere.
        lazy: Whether greedy policies leave out scores that cannot win; see `drgs.selection.greedy`.
        progress: Called with (views done, views) after each view whose information is known.
        information: Camera -> Information, in place of what `drgs.fisher` computes.
        workers: Processes that compute information; None: this one.
        refine: How far picks are moved to where they tell more; None: not at all.
    """

    scene: Scene
    candidates: Sequence[Camera]
    train: Sequence[Camera]
    k: int
    scoring: Scoring
    rng: torch.Generator
    masks: Sequence[torch.Tensor | None] | None = None
    empty_outside: bool = False
    cache: Cache | None = None
    lazy: bool = True
    progress: Callable[[int, int], object] | None = None
    information: Callable[[Camera], Information] | None = None
    workers: Workers | None = None
    refine: Refine | None = None

    def answers(self, question: Question, cameras: Iterable[Camera]) -> Iterator[Information]:
        """What views say to one question, one after another; see `told`."""
        return self.told([ViewQuestion(question, camera) for camera in cameras])

    def told(
        self,
        views: Sequence[ViewQuestion],
        accept: Callable[[int, Information], Information] = lambda i, answer: answer,
    ) -> Iterator[Information]:
        """What views say, one after another: out of the cache, else computed by the workers, if any, else here.

        Args:
            views: Questions to the views, in their order.
            accept: Called with the place of a view and what was computed of it; returns what is made of that, and kept.
        """
        cache = self.cache
        if cache is None:
            coming = self._computed(views)
            for i in range(len(views)):
                yield accept(i, next(coming))
            return
        keys = [view.key for view in views]
        # What is found is held until its turn: what is computed before that may push it out of the cache.
        held = {key: cache.find(self.scene, key) for key in dict.fromkeys(keys)}
        first = {key: i for i, key in reversed([*enumerate(keys)])}
        last = {key: i for i, key in enumerate(keys)}
        coming = self._computed([views[first[key]] for key, found in held.items() if found is None])

        for i, key in enumerate(keys):
            found = held.pop(key)
            if found is None:
                # Never looked up again: another call may have stored it meanwhile, and the next answer is this one's.
                found = accept(i, next(coming))
                cache.keep(self.scene, key, found)
            elif i > first[key]:
                cache.hits += 1  # the same view once more
            if i < last[key]:
                held[key] = found
            yield found
            del found  # not alive while the next one is computed

    def _computed(self, views: Sequence[ViewQuestion]) -> Iterator[Information]:
        if self.workers is not None:
            return self.workers.each(self.scene, [(view.question, view.camera, view.mask) for view in views])
        return (view.question(self._once_per_time, view.camera, view.mask) for view in views)

    @functools.cached_property
    def _once_per_time(self) -> Scene:
        """The scene, for questions that are asked here: a pool lives no longer than the choice from it."""
        return once_per_time(self.scene)

    def pick(self, index: int, score: float, parts: Mapping | None = None, margin: float | None = None) -> Pick:
        """A `Pick` with plain numbers.

        Raises:
            ValueError: If there is no such candidate, or the score is no finite number.
        """
        count = len(self.candidates)
        try:
            place = operator.index(index)
            number = float(score)
        except (TypeError, ValueError, RuntimeError):
            place, number = -1, math.nan
        if not 0 <= place < count or not math.isfinite(number):
            raise ValueError(
                f"Pool.pick: index must be one of {count} candidates and score a finite number, got "
                f"{str(index)[:40]} and {str(score)[:40]}; count candidates from 0"
            )
        return Pick(place, self.candidates[place].name, number, dict(parts or {}), margin)
