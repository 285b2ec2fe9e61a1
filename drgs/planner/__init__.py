"""Where to look next, for a robot: photographs come one at a time, and the next place is chosen in between.

    planner = drgs.Planner()
    planner.observe(image, camera, depth)      # (H, W, 3), drgs.Camera, (H, W) or None
    planner.fit(seconds=0.5)
    planner.scores(candidates, seconds=1.0)    # cameras where the robot could be
    plan = planner.next()
    plan.picks[0].camera, plan.changed         # where to go; how far what was known has changed since

    planner.save("planner.safetensors")        # and after a crash: planner = drgs.Planner.load(...)

The model, the information of each view and the candidates are kept from call to call. The information of a view is
computed again once its rendering has changed by more than a bound (`drgs.selection.drift`), so that a new photograph
costs only what it changes. With a time budget, an answer uses the information that there is by then, and says how much
of it is missing or out of date.

The planner knows nothing of ROS or maps, and starts no threads. All methods may be called from any thread: `observe`
and `fit` from one while another computes scores.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import numbers
import os
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from drgs import runtime
from drgs.cameras import Camera, camera_list
from drgs.cameras.sizes import at_most
from drgs.checks.arguments import ArgumentError, kind_of, must_be
from drgs.ellipsoids import Gaussians
from drgs.fitting.config import FitConfig
from drgs.fitting.online import OnlineFit
from drgs.gain import Information
from drgs.information.criteria import criterion_named
from drgs.information.region import NothingOfRegion, Region
from drgs.planner.file import camera_json, camera_of, read_file, region_of, scene_of, scene_tensors, write_file
from drgs.select import Scoring, select
from drgs.selection.cache import Cache, NotCached, named_by
from drgs.selection.informed import compute_candidates
from drgs.selection.pool import Pick, Pool, Selection
from drgs.selection.refining import Refine
from drgs.settings import RenderSettings

__all__ = ["Cost", "PlannedView", "Planner", "ViewPlan", "default_config"]

Cost = Sequence[float] | Callable[[Camera, Camera], float]
"""What it costs to go to each candidate, in the caller's unit; or a function: from where, to where."""

_FAST = Scoring(settings=RenderSettings.preset("fast"))
_RNG = torch.Generator()  # a pool must have one; policies that score by information draw nothing from it
_DURATIONS_KEPT = 3  # latest durations; their median, which the next one is expected to take, ignores one compilation
_ANSWER_SHARE = 0.5  # time to score / to compute the information of its views, until measured; 0.2 to 0.5 on `office`
_REGION_SHARE = 1.2  # the same with a region, whose information is computed while scoring; 1.1 to 1.4


def default_config() -> FitConfig:
    """Configuration of a planner's own model: colors only, small photographs, one renderer, few steps."""
    return FitConfig().replace(
        renderers=("fast",),
        semantics="ignore",
        exposure="off",
        max_pixels=12_000,
        max_gaussians=15_000,
        max_steps=1_000,
        sh_degree=1,
    )


@dataclasses.dataclass(frozen=True)
class PlannedView:
    """A candidate that was picked.

    Attributes:
        index: Place in the list of candidates.
        camera: The candidate.
        score: Score of its view's information, as of `drgs.select_views`.
        cost: Cost of going there, in the caller's unit; 0 without costs.
        value: score / (look + cost); without costs the score.
    """

    index: int
    camera: Camera
    score: float
    cost: float
    value: float


@dataclasses.dataclass(frozen=True)
class ViewPlan:
    """Scores and picks, and how much of the information they use is missing or out of date.

    Attributes:
        picks: Picked candidates in the order of going there; fewer than k where the information of the others was not
            computed in time.
        scores: Score of each candidate before the first pick; None where its information was not computed in time.
        changed: Largest change, in [0, 1], of a view's rendering since its information was computed; 0: all is of now.
        computed: Views whose information was computed for this answer.
        left_out: Known views whose information was not computed in time.
        seconds: Wall time from the call on, also of waiting for other threads.
        note: What is to be said of the region, a sentence; "" where there is nothing.
    """

    picks: list[PlannedView]
    scores: list[float | None]
    changed: float
    computed: int
    left_out: int
    seconds: float
    note: str = ""


class Planner:
    """A model that grows with every photograph, and the choice of the next place by information about that model.

    Attributes:
        max_views: Largest number of photographs that are kept. Of more, the one goes whose loss costs least coverage.
        info_pixels: Largest number of pixels at which the information of a view is computed.
        look: Cost of taking the photograph itself, in the unit of costs.
        notes: What the caller gave to `save`, in a planner that was loaded.
    """

    def __init__(
        self,
        config: FitConfig | None = None,
        *,
        scene: Gaussians | None = None,
        scoring: Scoring | None = None,
        region: Region | None = None,
        info_pixels: int = 2_700,
        max_views: int = 64,
        bound: float = 0.2,
        look: float = 1.0,
        max_bytes: int = 1 << 30,
    ) -> None:
        """
        Args:
            config: Configuration of the planner's own model; default `drgs.planner.default_config`.
            scene: A model of the caller's own, in its place; see `scene`.
            scoring: How views are scored; default as `drgs.select_views`, rendered by preset `fast`.
            region: The part of the scene that counts, by the model as it is at each answer; None: all of it. Every
                answer then computes the information of all views that show some of it, whatever is kept.
            info_pixels, max_views, look: See the attributes.
            bound: Largest change of a view's rendering, in [0, 1], up to which its information is not computed again.
            max_bytes: Largest size of the information that is kept, bytes.
        Raises:
            ValueError: If a number is out of range, the model moves, or the scoring's information cannot grow with it.
        """
        for name, value in {"info_pixels": info_pixels, "max_views": max_views}.items():
            if type(value) is not int or value < 2:
                raise ArgumentError(f"Planner: {name} must be a whole number >= 2, got {value!r}; raise it")
        if not 0 <= bound <= 1:
            raise ArgumentError(f"Planner: bound must be in [0, 1], got {bound!r}; try 0.2")
        if not (math.isfinite(look) and look > 0):
            raise ArgumentError(f"Planner: look must be a finite number > 0, got {look!r}; try 1")
        self.info_pixels = info_pixels
        self.max_views = max_views
        self.look = float(look)
        self.notes: Any = None
        if scoring is not None:
            _check_scoring(scoring)
        if region is not None:
            must_be("Planner", "region", region, Region, "e.g. drgs.Region.box((0, 0, 0), (1, 1, 1))")
        self._scoring = scoring or _FAST
        self._region = region
        self._fit = OnlineFit(config or default_config())
        self._cache = Cache(max_bytes, bound=bound)
        self._known: list[Camera] = []  # at the size at which their information is computed
        self._last_camera: Camera | None = None
        self._pool: list[Camera] = []
        self._cost: Cost | None = None
        self._callers_scene: Gaussians | None = None
        self._fit_scene: Gaussians | None = None  # a copy of the fit's Gaussians, as long as these do not change
        self._num_observed = 0
        self._view_seconds, self._answer_share = _Typical(), _Typical(_REGION_SHARE if region else _ANSWER_SHARE)
        self._fit_lock = threading.RLock()
        self._answer_lock = threading.RLock()
        if scene is not None:
            self.scene = scene

    @property
    def scene(self) -> Gaussians | None:
        """The model as it is now, which further steps leave alone; None before there is any.

        A caller that maps by itself sets it, after every change, to Gaussians that keep their order: new ones come
        last. Where there are fewer than before, the information of all views is computed again. `observe` then records
        only where a photograph was taken, and `fit` does nothing.
        """
        with self._fit_lock:
            if self._callers_scene is not None:
                return self._callers_scene
            if self._fit_scene is None and self._fit.trainer is not None:
                self._fit_scene = self._fit.gaussians()
            return self._fit_scene

    @scene.setter
    def scene(self, gaussians: Gaussians) -> None:
        must_be("Planner", "scene", gaussians, Gaussians, "it takes static scenes only; pass scene.at(time)")
        with self._fit_lock:
            self._callers_scene = gaussians.detach()

    @property
    def views(self) -> list[str]:
        """Names of the photographs that are kept."""
        return [camera.name for camera in self._known]

    def observe(self, image: np.ndarray | None, camera: Camera, depth: np.ndarray | None = None) -> int:
        """Add a photograph; returns how many Gaussians were added for it.

        Args:
            image: (H, W, 3) uint8, or floats in [0, 1]; None if the model is the caller's own.
            camera: The camera at the place where it was taken, of the image's size; unnamed ones are named by number.
            depth: (H, W) distance along the camera's axis, world units, 0 or NaN where unknown; None: there is none.
        Raises:
            ValueError: If shapes do not agree, values are out of range, or there is no image for the planner's model.
        """
        must_be("Planner.observe", "camera", camera, Camera, "drgs.Camera(K=..., w2c=..., width=..., height=...)")
        with self._fit_lock:
            camera = dataclasses.replace(camera, name=self._name(camera.name))
            added = 0
            if self._callers_scene is None:
                added = self._fit.add(_checked_image(image, camera), camera, _checked_depth(depth, camera))
                self._fit_scene = None
            self._num_observed += 1
            self._last_camera = camera
            self._known = [*self._known, at_most(camera, self.info_pixels)]
        if len(self._known) > self.max_views:
            self._drop_view()
        return added

    def fit(self, steps: int | None = None, seconds: float | None = None) -> int:
        """Continue fitting the planner's model to its photographs; returns the number of steps done.

        Other threads can compute scores between two steps.

        Args:
            steps: Number of steps, at most; default 20 where no time is given either.
            seconds: Wall time after which no further step begins.
        Raises:
            ValueError: If one is not a number >= 0.
        """
        if steps is not None and not (isinstance(steps, numbers.Integral) and steps >= 0):
            raise ArgumentError(f"Planner.fit: steps must be a whole number >= 0, got {steps!r}; correct it")
        _check_seconds("Planner.fit", seconds)
        begun = time.monotonic()
        most = 20 if steps is None and seconds is None else math.inf if steps is None else steps
        done = 0
        while done < most and (seconds is None or time.monotonic() - begun < seconds):
            with self._fit_lock:
                if self._callers_scene is not None or self._fit.trainer is None:
                    return done
                self._fit.step()
                self._fit_scene = None
            done += 1
        return done

    def scores(
        self, candidates: Sequence[Camera], cost: Cost | None = None, *, seconds: float | None = None
    ) -> ViewPlan:
        """Score the view of each candidate; `next` picks from these candidates, until there are others.

        Args:
            candidates: Cameras at the places where it could go.
            cost: Cost of going to each, >= 0; a function is called with the last place and the candidate.
            seconds: Wall time for the answer; None: the information of all views that have changed is computed. One
                view is computed however little it is, and what is kept is always scored.
        Returns:
            A plan without picks.
        Raises:
            ValueError: If there are no candidates, costs or `seconds` are not numbers >= 0, or there is no model yet;
                then `next` picks from the candidates before.
        """
        begun = time.monotonic()
        _check_seconds("Planner.scores", seconds)
        pool = camera_list("Planner.scores", "candidates", candidates)
        if not pool:
            raise ValueError("Planner.scores: there must be at least one candidate, got none; give poses")
        with self._answer_lock:
            before = self._pool, self._cost
            self._pool, self._cost = [at_most(camera, self.info_pixels) for camera in pool], cost
            try:
                self._costs(list(range(len(pool))), self._last_camera)  # refuses what is no cost
                return self._plan(0, seconds, begun)
            except BaseException:
                self._pool, self._cost = before
                raise

    def next(self, k: int = 1, *, seconds: float | None = None) -> ViewPlan:
        """The k places to go to next, of those that `scores` was given.

        Each has the largest value, score / (look + cost), given the ones before it; costs that are a function are those
        of going from one to the next.

        Args:
            k: How many.
            seconds: Wall time for the answer, as of `scores`.
        Raises:
            ValueError: If there are fewer candidates than k, or `seconds` is not a number >= 0.
        """
        begun = time.monotonic()
        _check_seconds("Planner.next", seconds)
        with self._answer_lock:
            if not (type(k) is int and 1 <= k <= len(self._pool)):
                raise ValueError(
                    f"Planner.next: k must be a whole number in 1..{len(self._pool)} candidates, got {k!r}; give "
                    "candidates to Planner.scores"
                )
            return self._plan(k, seconds, begun)

    def refine(self, camera: Camera, refine: Refine | None = None) -> Pick:
        """Move a place to where its view scores higher, within bounds; see `drgs.select.Refine`.

        Args:
            camera: The place to begin with, e.g. that of a pick.
            refine: How far and how long; default 20 further views, in the box of all known views and candidates.
        Returns:
            `camera` is the place, of at most `info_pixels` pixels; `score` and `start` are the scores of it and of the
            first place, computed without other candidates.
        """
        must_be("Planner.refine", "camera", camera, Camera, "e.g. plan.picks[0].camera")
        with self._answer_lock:
            scene, known = self._model_and_views()
            start = at_most(camera, self.info_pixels)
            if refine is None or refine.box is None:
                centers = np.stack([one.center for one in (*known, *self._pool, start)])
                box = tuple(np.r_[centers.min(0), centers.max(0)].tolist())
                refine = dataclasses.replace(refine or Refine(evaluations=20), box=box)
            self._expect([*known, *self._pool, start])
            return self._chosen(scene, [start], known, 1, refine).picks[0]

    # -------------------------------------------------- kill and resume

    def save(self, path: str | os.PathLike, notes: Any = None) -> None:
        """Write the planner's state to one file; one that `load` makes of it gives the same answers.

        A process that is killed meanwhile leaves the file as it was. One process alone may write a file.

        Args:
            path: The file, safetensors; a planner's own is replaced, any other refused.
            notes: The caller's own state, JSON: it is saved together with the planner's, so that the two agree.
        Raises:
            ValueError: If there is something else of that name, or notes are no JSON.
            OSError: If the file cannot be written.
        """
        records = lambda cameras: [camera_json(camera) for camera in cameras]  # noqa: E731
        with self._answer_lock, self._fit_lock:
            fit, fit_header, photographs = self._fit.state()
            answers, cache_header, expected = self._cache.state()
            own, origin = scene_tensors(self._callers_scene)
            costs = self._cost if self._cost is None or callable(self._cost) else [float(x) for x in self._cost]
            header = {
                "version": runtime.version(),
                "info_pixels": self.info_pixels,
                "max_views": self.max_views,
                "look": self.look,
                "bound": self._cache.bound,
                "max_bytes": self._cache.max_bytes,
                "counted": self._num_observed,
                "known": records(self._known),
                "here": None if self._last_camera is None else camera_json(self._last_camera),
                "pool": records(self._pool),
                "costs": True if callable(costs) else costs,
                "scoring": named_by(self._scoring) or "",
                "asked_in": list(self._view_seconds.latest),
                "answer_shares": list(self._answer_share.latest),
                "origin": origin,
                "fit": fit_header,
                "photographs": records(photographs),
                "cache": cache_header,
                "expected": records(expected),
                "notes": notes,
                **({} if self._region is None else {"region": self._region.text}),
            }
        write_file(path, {**fit, **answers, **own}, header)

    @classmethod
    def load(cls, path: str | os.PathLike, *, scoring: Scoring | None = None, region: Region | None = None) -> Planner:
        """The planner that `save` wrote to a file.

        With one thread its answers have the bits that they would have had without the interruption, except that a
        limit of time falls elsewhere. Costs that are a function are in no file: `next` needs another `scores` first.

        Args:
            path: The file.
            scoring: That of the planner that was saved, where it was not the default.
            region: Likewise; a box and a sphere are in the file.
        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is none that a planner wrote, or damaged, or the scoring or the region is another one.
        """
        where, tensors, header = read_file(path)
        region = region_of(where, header.get("region"), region)
        names = ("info_pixels", "max_views", "bound", "look", "max_bytes")
        try:
            planner = cls(scoring=scoring, region=region, **{name: header[name] for name in names})
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        if header["scoring"] != (named_by(planner._scoring) or ""):
            raise ValueError(
                f"{where}: scoring must be that of the planner that was saved, is another one; give it to Planner.load"
            )

        def cameras(name: str, pixels: float = math.inf) -> list[Camera]:
            return [camera_of(where, one, pixels) for one in header[name]]

        planner._fit = OnlineFit.from_state(tensors, header["fit"], cameras("photographs"), where)
        if header["origin"] is not None:
            planner._callers_scene = scene_of(where, tensors, header["origin"])
        planner._known, planner._pool = (cameras(name, planner.info_pixels) for name in ("known", "pool"))
        planner._last_camera = None if header["here"] is None else camera_of(where, header["here"])
        planner._num_observed = header["counted"]
        costs = header["costs"]
        planner._cost = _unknown_cost if isinstance(costs, bool) else costs
        expected = cameras("expected", planner.info_pixels)
        if header["version"] == runtime.version():  # other versions may compute other information, in other times
            planner._view_seconds.latest.extend(header["asked_in"])
            planner._answer_share.latest.extend(header["answer_shares"])
            planner._cache.restore(tensors, header["cache"], expected, str(where))
        planner.notes = header.get("notes")
        if len(planner._known) > planner.max_views:  # saved by one thread while another had just taken a photograph
            planner._drop_view()
        return planner

    # -------------------------------------------------- views and model

    def _name(self, name: str) -> str:
        """The name of a photograph, or its number."""
        name = name or f"view {self._num_observed}"
        if name in self.views:
            raise ValueError(f"Planner.observe: names must be different, got {name!r} again; leave them empty")
        return name

    def _drop_view(self) -> None:
        """Drop the view that the others cover best."""
        with self._answer_lock, self._fit_lock:
            if (scene := self.scene) is None:
                return
            known = self._known
            self._expect([*known, *self._pool])
            kept = select(scene, known, [], len(known) - 1, "coverage", information=self._coverage_of(scene))
            (gone,) = set(range(len(known))) - {pick.index for pick in kept.picks}
            self._known = [camera for i, camera in enumerate(known) if i != gone]
            if self._callers_scene is None:
                self._fit.drop(known[gone].name)

    def _coverage_of(self, scene: Gaussians) -> Callable[[Camera], Information]:
        """Coverage of a view, as policy `coverage` takes it; computed where it is not known yet."""

        def coverage(camera: Camera) -> Information:
            if self._cache.image_weights(scene, camera) is None:
                self._evaluate(scene, camera)
            weights = self._cache.image_weights(scene, camera)
            assert weights is not None  # computed by now
            return {"coverage": weights}

        return coverage

    def _model_and_views(self) -> tuple[Gaussians, list[Camera]]:
        """The model and the known views, together."""
        with self._fit_lock:
            scene = self.scene
            if scene is None:
                raise ValueError(
                    "Planner: there must be a model, there is none yet; observe a photograph with depth, or two"
                )
            return scene, list(self._known)

    def _expect(self, cameras: Sequence[Camera]) -> None:
        """Before an answer: the cache forgets all other cameras, and which changes it has reported."""
        self._cache.expect(cameras)
        self._cache.changes.clear()

    # -------------------------------------------------- answers

    def _plan(self, k: int, seconds: float | None, begun: float) -> ViewPlan:
        """Compute information of as many views as there is time for, and answer by what there is then.

        Args:
            k: How many to pick.
            seconds: Wall time for the answer, from `begun` on.
            begun: When the answer was asked for, as of `time.monotonic`.
        """
        scene, known = self._model_and_views()
        self._expect([*known, *self._pool])
        calls = 1 if self._cost is None else max(k, 1)
        computed = self._evaluate_changed(scene, known, math.inf if seconds is None else begun + seconds, calls)
        answering = time.monotonic()
        self._cache.computes = False
        try:
            plan = self._answer(scene, known, k)
        finally:
            self._cache.computes = True
        now = time.monotonic()
        if self._cache.forgot_saved:  # a file of another version named quantities otherwise: they are computed now
            self._cache.forgot_saved = False
            return self._plan(k, seconds, begun)
        scored = sum(score is not None for score in plan.scores)
        views = calls * (len(known) - plan.left_out + scored) * self._view_seconds.usual
        if computed and scored and views:  # else the machine may have been faster when views were computed
            self._answer_share.note((now - answering) / views)
        return dataclasses.replace(plan, computed=computed, seconds=now - begun)

    def _evaluate_changed(self, scene: Gaussians, known: list[Camera], until: float, calls: int) -> int:
        """Compute information of the views that have changed most, known views and candidates in turn.

        Args:
            scene, known: The model, and the known views.
            until: When the answer is due: a view is computed if there is time for it and for scoring all views then.
            calls: How often these are scored.
        Returns:
            How many views.
        """
        bound = self._cache.bound
        assert bound is not None  # a planner's cache has one
        queues: list[tuple[float, list[Camera]]] = []
        there = 0  # views that have information
        for cameras in (known, self._pool):
            changes = [self._cache.change(scene, camera) for camera in cameras]
            there += sum(change < math.inf for change in changes)
            stale = [i for i, change in enumerate(changes) if change > bound]
            stale.sort(key=lambda i: (-changes[i], -i))
            queues.append((len(stale) / max(len(cameras), 1), [cameras[i] for i in stale]))
        queues.sort(key=lambda x: -x[0])  # where more is left first
        pairs = itertools.zip_longest(*(queue for _, queue in queues))
        turns = [camera for pair in pairs for camera in pair if camera is not None]
        done = 0
        for camera in turns:
            began = time.monotonic()
            there += self._cache.change(scene, camera) == math.inf
            views = 1 + calls * there * self._answer_share.usual  # that take as long: this one, and scoring all
            if done and began + views * self._view_seconds.usual > until:  # one at least: every call brings something
                break
            self._evaluate(scene, camera)
            self._view_seconds.note(time.monotonic() - began)
            done += 1
        return done

    def _evaluate(self, scene: Gaussians, camera: Camera) -> None:
        """Compute the information of one view, which does not depend on others."""
        compute_candidates(
            Pool(scene=scene, candidates=[camera], train=[], k=1, scoring=self._scoring, rng=_RNG, cache=self._cache)
        )

    def _answer(self, scene: Gaussians, known: list[Camera], k: int) -> ViewPlan:
        """Scores and picks by the information in the cache."""
        # Without costs all picks come of one call; with costs each is of another value than its score.
        at_once = max(k, 1) if self._cost is None else 1
        selection, places, there = self._selected(scene, list(range(len(self._pool))), known, at_once)
        scores: list[float | None] = [None] * len(self._pool)
        picks: list[PlannedView] = []
        note = ""
        if selection is not None:
            note = next((x for x in selection.notes if x.startswith("region ")), "")
            for i, score in zip(places, selection.scores, strict=True):
                scores[i] = score
            if self._cost is None:
                scored = [(places[pick.index], pick.score) for pick in selection.picks[:k]]
                picks = [PlannedView(i, self._pool[i], score, 0.0, score) for i, score in scored]
            else:
                picks = self._picks_by_value(scene, selection, places, there, k)
        changed = max(self._cache.changes.values(), default=0.0)
        return ViewPlan(picks, scores, changed, 0, len(known) - len(there), 0.0, note)

    def _picks_by_value(
        self, scene: Gaussians, selection: Selection | None, places: list[int], known: list[Camera], k: int
    ) -> list[PlannedView]:
        """k candidates, or as many as there is information of, each of the largest value given those before it.

        Args:
            selection, places, known: Of the first one, as `_selected` returns them.
        """
        picks: list[PlannedView] = []
        here = self._last_camera
        while selection is not None and len(picks) < k:
            costs = self._costs(places, here)
            values = [score / (self.look + cost) for score, cost in zip(selection.scores, costs, strict=True)]
            best = int(np.argmax(values))
            here = self._pool[places[best]]
            picks.append(PlannedView(places[best], here, selection.scores[best], costs[best], values[best]))
            if len(picks) < k:
                left = [i for i in places if i != places[best]]
                selection, places, known = self._selected(scene, left, [*known, here], 1)
        return picks

    def _selected(
        self, scene: Gaussians, places: list[int], known: list[Camera], k: int
    ) -> tuple[Selection | None, list[int], list[Camera]]:
        """Scores of the candidates, given the known views, of those views alone that the cache has information of.

        Returns:
            The scores (None without such candidates), indices of these candidates, and these known views."""
        while places:
            pool = [self._pool[i] for i in places]
            try:
                selection = self._chosen(scene, pool, known, min(k, len(pool)))
            except NotCached as lacking:
                places = [i for i in places if self._cache.keeps(lacking.quantity, self._pool[i])]
                known = [camera for camera in known if self._cache.keeps(lacking.quantity, camera)]
            else:
                return selection, places, known
        return None, places, known

    def _chosen(
        self, scene: Gaussians, pool: list[Camera], known: list[Camera], k: int, refine: Refine | None = None
    ) -> Selection:
        """The choice, by the region as far as the model shows any of it."""
        choose = functools.partial(
            select, scene, pool, known, k, scoring=self._scoring, cache=self._cache, refine=refine
        )
        if self._region is None:
            return choose()
        try:
            return choose(region=self._region)
        except NothingOfRegion:
            selection = choose()
            selection.notes.append(
                f"region {self._region.text}: no view shows any of it yet; the whole scene counts in this answer"
            )
            return selection

    def _costs(self, places: list[int], here: Camera | None) -> list[float]:
        """Costs of going from a camera to candidates."""
        cost = self._cost
        if cost is None or (callable(cost) and here is None):
            return [0.0] * len(places)
        if callable(cost):
            assert here is not None
            costs = [float(cost(here, self._pool[i])) for i in places]
        else:
            if len(cost) != len(self._pool):
                raise ValueError(
                    f"Planner: costs must be {len(self._pool)}, one a candidate, got {len(cost)}; give the missing ones"
                )
            costs = [float(cost[i]) for i in places]
        bad = next((x for x in costs if not (math.isfinite(x) and x >= 0)), None)
        if bad is not None:
            raise ValueError(f"Planner: costs must be finite and >= 0, got {bad}; leave out what cannot be reached")
        return costs


class _Typical:
    """What a measured number usually is: a median, which a single compilation of a kernel does not change.

    Attributes:
        latest: The latest numbers, the oldest first.
        first: What it is taken for before there is any.
    """

    def __init__(self, first: float = 0.0) -> None:
        self.first = first
        self.latest: deque[float] = deque(maxlen=_DURATIONS_KEPT)

    def note(self, number: float) -> None:
        """Add a number."""
        self.latest.append(number)

    @property
    def usual(self) -> float:
        """The median, of two the lower."""
        return statistics.median_low(self.latest) if self.latest else self.first


def _unknown_cost(here: Camera, there: Camera) -> float:
    """Stands for costs that were a function when a planner was saved."""
    raise ValueError("Planner.next: costs were a function, which no file holds; give it to Planner.scores again")


def _check_scoring(scoring: Scoring) -> None:
    """Raise ValueError unless information is of single parameters, colors included.

    What is kept of a view gets zeros for Gaussians that come later; how much a view changes is weighed by what it says
    of colors; and value = score / cost has a meaning where a score is at least 0.
    """
    if criterion_named(scoring.criterion, "Planner").of_blocks:
        got = f"criterion {scoring.criterion}"
    elif scoring.combine == "zscore":
        got = "combine zscore"
    elif scoring.groups is not None and "sh" not in scoring.groups:
        got = f"groups {', '.join(scoring.groups)}"
    elif scoring.blocks is not None and "geometry" not in scoring.blocks:
        got = f"blocks {', '.join(scoring.blocks)}"
    else:
        return
    raise ArgumentError(
        f"Planner: scoring must add up the information of single parameters, with group sh, got {got}; leave that out"
    )


def _check_seconds(where: str, seconds: float | None) -> None:
    """Raise ValueError unless `seconds` is None or a number >= 0."""
    if seconds is not None and not (isinstance(seconds, numbers.Real) and seconds >= 0):
        raise ArgumentError(f"{where}: seconds must be a number >= 0, got {seconds!r}; leave it out for no limit")


def _checked_image(image: np.ndarray | None, camera: Camera) -> np.ndarray:
    image = _sized_as("image", image, (camera.height, camera.width, 3))
    if image.dtype != np.uint8 and not (np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1):
        raise ValueError(
            f"Planner.observe: image must be uint8, or finite and in [0, 1], got {image.min()} to {image.max()}; "
            "scale it"
        )
    return image


def _checked_depth(depth: np.ndarray | None, camera: Camera) -> np.ndarray | None:
    if depth is None:
        return None
    depth = _sized_as("depth", depth, (camera.height, camera.width))
    return np.nan_to_num(depth.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0).clip(min=0)


def _sized_as(name: str, x: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """An array, if it has the shape of its camera's image."""
    if not isinstance(x, np.ndarray) or x.shape != shape:
        got = f"shape {x.shape}" if isinstance(x, np.ndarray) else kind_of(x)
        raise ValueError(
            f"Planner.observe: {name} must be an array of shape {shape}, its camera's, got {got}; resize it"
        )
    return x
