"""Input and output of a policy: the views to choose from and their scoring, and the selection."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import torch

from drgs.cameras import Camera
from drgs.checks.arguments import must_be
from drgs.ellipsoids import Scene
from drgs.information.choices import Combine
from drgs.information.criteria import criterion_named
from drgs.information.prior import Prior
from drgs.information.quantity import Quantity, ViewContext, once_per_time
from drgs.information.region import Region
from drgs.information.scoring import Scoring
from drgs.information.sums import Information
from drgs.selection.cache import Cache, view_key
from drgs.selection.refining import Refine
from drgs.settings import RenderSettings


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
        unseen: What parameters that no training view has information about add to each candidate's score, in its unit
            (lambda alone decides how much they count).
        left_out: Group -> parameters not counted because lambda = 0 and no training view has information about them.
        evaluations: How often a candidate was scored.
        computed: Views whose information was computed, not taken from the cache.
        pixels: Number of pixels that each candidate's score is of, where some are estimates by fewer; else empty.
        notes: What a reader of the result should know, one sentence each.
        prior: lambda as it counted, with its length; None for policies without.
        blocks: The blocks of the image that the information is of; empty for policies without.
        semantics: What is coupled, if anything is: the metric's estimate, gamma and width.
        network: How the block `deformation` scored, and from how many probes, if it did.
        combine: `sum` of the groups' parts, or of blocks' z-scores over the candidates that were left: then scores
            and parts, `block.group`, are in standard deviations (the mean is not subtracted from `unseen`).
        seconds: Wall time.
    """

    picks: list[Pick]
    scores: list[float]
    parts: list[dict[str, float]] = dataclasses.field(default_factory=list)
    unseen: list[float] = dataclasses.field(default_factory=list)
    left_out: dict[str, int] = dataclasses.field(default_factory=dict)
    evaluations: int = 0
    computed: int = 0
    pixels: list[int] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    prior: Prior | None = None
    blocks: list[str] = dataclasses.field(default_factory=list)
    semantics: dict | None = None
    network: dict | None = None
    combine: Combine = "sum"
    seconds: float = 0.0

    def prior_json(self, scoring: Scoring, policy: str) -> dict[str, Any]:
        """lambda as files hold it; where none counted, that of the policy by a scoring."""
        return (self.prior or scoring.prior_of(policy)).to_json()

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
        pixels = [{"pixels": n} for n in self.pixels] or [{}] * count
        rows = zip(views, self.scores, parts, unseen, pixels, after or [{}] * count, strict=True)
        return [{**view, "score": s, "parts": own, "unseen": x, **of, **rest} for view, s, own, x, of, rest in rows]


ViewRequest = tuple[Quantity, Camera, torch.Tensor | None]
"""A quantity, and the camera and mask of the view that it is computed of; plain data, sent to other processes."""


class Workers(Protocol):
    """Other processes that compute quantities of views; `drgs.cluster.workers.Cluster` is some."""

    def each(self, scene: Scene, settings: RenderSettings, requests: Sequence[ViewRequest]) -> Iterator[Information]:
        """What `Quantity.compute` returns, in the order of the requests, with the bits that this process would compute
        with one thread."""


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
        halving: Whether they first score candidates by a quarter of their pixels, likewise.
        progress: Called with (views done, views) after each view whose information is known.
        information: Camera -> Information, in place of what `drgs.fisher` computes.
        workers: Processes that compute information; None: this one.
        refine: How far picks are moved to where they score higher; None: not at all.
        region: The part of the scene that counts; None: all of it.
    Raises:
        ValueError: If there are no candidates or fewer than k, or an argument is wrong or means nothing beside others.
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
    halving: bool = False
    progress: Callable[[int, int], object] | None = None
    information: Callable[[Camera], Information] | None = None
    workers: Workers | None = None
    refine: Refine | None = None
    region: Region | None = None

    def __post_init__(self) -> None:
        count = len(self.candidates)
        if not count:
            raise ValueError("select: there must be at least one candidate, got none; give poses to choose from")
        if not (isinstance(self.k, int) and 1 <= self.k <= count):
            raise ValueError(f"select: k must be a whole number in 1..{count} candidates, got {self.k!r}; correct it")
        if not isinstance(self.rng, torch.Generator):
            raise ValueError(
                f"select: rng must be a torch.Generator that is kept between calls, got {self.rng!r}; make one"
            )
        criterion_named(self.scoring.criterion, "select")  # else the first view's information would be computed before
        if self.refine is not None:
            must_be("select", "refine", self.refine, Refine, "e.g. drgs.select.Refine(evaluations=40)")
        if self.region is not None:
            must_be("select", "region", self.region, Region, "e.g. drgs.Region.box((0, 0, 0), (1, 1, 1))")
        if self.information is None:
            return
        if self.region is not None:
            raise ValueError(
                "select: region must be None with information, got both; an information function weighs pixels itself"
            )
        if self.workers is not None:
            raise ValueError("select: workers must be None with information, got both; a function is called here")
        scoring = self.scoring  # of the rest, what means nothing beside information would be dropped in silence
        if scoring.combine is not None or scoring.network != "ratio":
            raise ValueError(
                "select: combine and network must be left out with information, got "
                f"{scoring.combine or scoring.network}; its groups are scored together, by criterion"
            )

    def prior_of(self, scoring: Scoring) -> Prior:
        """lambda by a scoring, in the length of all its cameras; of information by a function in world units."""
        prior = scoring.prior_of()
        if self.information is not None:
            return prior.over(1.0)
        return prior.in_scene(self.scene, [*self.train, *self.candidates])

    def compute_each(self, quantity: Quantity, cameras: Iterable[Camera]) -> Iterator[Information]:
        """One quantity of several views without masks; see `compute`."""
        return self.compute([(quantity, camera, None) for camera in cameras])

    def compute(
        self, requests: Sequence[ViewRequest], accept: Callable[[int, Information], object] = lambda i, computed: None
    ) -> Iterator[Information]:
        """Quantities of views, one after another: out of the cache, else computed by the workers, if any, else here.

        Args:
            requests: The views, in their order.
            accept: Called with the place of a view and what was computed of it, before the cache keeps that; it raises
                if that is wrong.
        """
        cache = self.cache
        if cache is None:
            coming = self._computed(requests)
            for i in range(len(requests)):
                computed = next(coming)
                accept(i, computed)
                yield computed
                del computed  # not alive while the next one is computed
            return
        settings = self.scoring.settings
        keys = [view_key(quantity.key(camera, settings), camera, mask) for quantity, camera, mask in requests]
        # What the cache has is held until its turn: what is computed before that may push it out of the cache.
        held = {key: cache.find(self.scene, key) for key in dict.fromkeys(keys)}
        first = {key: i for i, key in reversed([*enumerate(keys)])}
        last = {key: i for i, key in enumerate(keys)}
        coming = self._computed([requests[first[key]] for key, kept in held.items() if kept is None])

        for i, key in enumerate(keys):
            kept = held.pop(key)
            if kept is None:
                # Never looked up again: another call may have stored it meanwhile, and the next result is this one's.
                kept = next(coming)
                accept(i, kept)
                cache.keep(self.scene, key, kept)
            elif i > first[key]:
                cache.hits += 1  # the same view once more
            if i < last[key]:
                held[key] = kept
            yield kept
            del kept  # not alive while the next one is computed

    def _computed(self, requests: Sequence[ViewRequest]) -> Iterator[Information]:
        settings = self.scoring.settings
        if self.workers is not None:
            return self.workers.each(self.scene, settings, requests)
        scene = self._once_per_time
        return (quantity.compute(ViewContext(scene, camera, settings, mask)) for quantity, camera, mask in requests)

    @functools.cached_property
    def _once_per_time(self) -> Scene:
        """The scene, for views that are computed here: a pool lives no longer than the choice from it."""
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
