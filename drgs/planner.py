"""Where to look next, for a robot: photographs come one at a time, and so do questions.

    planner = drgs.Planner()
    planner.observe(image, camera, depth)      # (H, W, 3), drgs.Camera, (H, W) or None
    planner.fit(seconds=0.5)
    planner.scores(candidates, seconds=1.0)    # cameras where the robot could be
    plan = planner.next()
    plan.picks[0].camera, plan.changed         # where to go; how far what was known has changed since

    planner.save("planner.safetensors")        # and after a crash: planner = drgs.Planner.load(...)

What lasts from call to call: the model, what each view tells about it, and the candidates. What a view tells is asked
again once what it sees has changed by more than a bound (`drgs.selection.drift`), so that a new photograph costs what
is new. An answer within a time budget goes by what is known by then, and says how much that is.

Nothing here knows ROS, threads of its own, or maps: all methods may be called from any thread, `observe` and `fit` from
one while another asks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import json
import math
import numbers
import os
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs import runtime
from drgs.cameras import Camera, camera_list
from drgs.cameras.checks import as_numpy
from drgs.cameras.sizes import at_most
from drgs.checks.arguments import ArgumentError, check_path, kind_of, must_be
from drgs.ellipsoids import Gaussians
from drgs.fitting.config import FitConfig
from drgs.fitting.online import OnlineFit
from drgs.gain import Information
from drgs.io import atomic
from drgs.io.checkpoint import load_state, save_state, state_header
from drgs.io.json_files import check_json, parse_json
from drgs.select import Scoring, select
from drgs.selection.cache import Cache, NotKept, named_by
from drgs.selection.informed import compute_candidates
from drgs.selection.pool import Pick, Pool, Selection
from drgs.selection.refining import Refine
from drgs.settings import RenderSettings

__all__ = ["Cost", "PlannedView", "Planner", "ViewPlan", "default_config"]

Cost = Sequence[float] | Callable[[Camera, Camera], float]
"""What it costs to go to each candidate, in the caller's unit; or a function: from where, to where."""

_FAST = Scoring(settings=RenderSettings.preset("fast"))
_RNG = torch.Generator()  # scores of informed policies draw nothing
_LATELY = 9  # times that are remembered of how long something took: an odd number, for their median

_ADVICE = "restore the file, or begin anew"
_KIND = "planner"
_CAMERA = {
    "K": [[float]],
    "w2c": [[float]],
    "w2c_end": (None, [[float]]),
    "width": int,
    "height": int,
    "model": str,
    "distortion": [float],
    "name": str,
    "time": (None, float),
    "shutter": str,
}
_HEADER = {
    "digest": str,
    "version": str,
    "info_pixels": int,
    "max_views": int,
    "look": float,
    "bound": float,
    "max_bytes": int,
    "counted": int,
    "known": [_CAMERA],
    "here": (None, _CAMERA),
    "pool": [_CAMERA],
    "costs": (None, bool, [float]),
    "scoring": str,
    "asked_in": [float],
    "answered_in": [float],
    "origin": (None, [float]),
    "fit": dict,
    "photographs": [_CAMERA],
    "cache": dict,
    "expected": [_CAMERA],
}


def default_config() -> FitConfig:
    """What a planner's own model is fitted by: colors, small photographs, one renderer, seconds of steps."""
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
        score: What its view tells, as `drgs.select_views` scores it.
        cost: What it costs to go there, in the caller's unit; 0 where nothing was said.
        value: The score over `look` + cost; where nothing was said of costs, the score.
    """

    index: int
    camera: Camera
    score: float
    cost: float
    value: float


@dataclasses.dataclass(frozen=True)
class ViewPlan:
    """An answer, and what it rests on.

    Attributes:
        picks: Picked candidates in the order of going there; fewer than were asked for where the others are not known
            in time.
        scores: Score of each candidate before the first pick; None of those that nothing was known of in time.
        changed: Largest change, in [0, 1], of what a view sees since it was asked what it tells; 0: all is as of now.
        computed: Views that were asked for this answer.
        left_out: Known views that nothing is known of in time.
        seconds: Wall time.
    """

    picks: list[PlannedView]
    scores: list[float | None]
    changed: float
    computed: int
    left_out: int
    seconds: float


class Planner:
    """A model that grows with every photograph, and which of the places to go to would tell most about it.

    Attributes:
        max_views: Photographs that are kept. Of one more, the one goes whose loss costs least coverage.
        info_pixels: Views are asked at no more pixels than these.
        look: What a photograph itself costs, in the unit of costs.
        notes: What the caller gave to `save`, in a planner that was loaded.
    """

    def __init__(
        self,
        config: FitConfig | None = None,
        *,
        scene: Gaussians | None = None,
        scoring: Scoring | None = None,
        info_pixels: int = 2_700,
        max_views: int = 64,
        bound: float = 0.2,
        look: float = 1.0,
        max_bytes: int = 1 << 30,
    ) -> None:
        """
        Args:
            config: How the planner's own model is fitted; default `drgs.planner.default_config`.
            scene: A model of the caller's own, in its place; see `scene`.
            scoring: How views are scored; default as `drgs.select_views`, drawn by preset `fast`.
            info_pixels, max_views, look: See the attributes.
            bound: Largest change of what a view sees, in [0, 1], up to which what it tells is not asked again.
            max_bytes: Bytes of what views tell that are kept at most.
        Raises:
            ValueError: If a number is out of range, or the model moves.
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
        self._scoring = scoring or _FAST
        self._fit = OnlineFit(config or default_config())
        self._cache = Cache(max_bytes, bound=bound)
        self._known: list[Camera] = []  # at the size at which they are asked
        self._here: Camera | None = None
        self._pool: list[Camera] = []
        self._cost: Cost | None = None
        self._own: Gaussians | None = None
        self._seen: Gaussians | None = None  # what was asked last, while nothing has changed
        self._counted = 0
        self._view_seconds, self._answer_seconds = _Duration(), _Duration()
        self._fit_lock = threading.RLock()
        self._answer_lock = threading.RLock()
        if scene is not None:
            self.scene = scene

    @property
    def scene(self) -> Gaussians | None:
        """The model as it is now, which further steps leave alone; None before there is any.

        A caller that maps by itself sets it, after every change, to Gaussians that keep their order: new ones come
        last. Where there are fewer than before, all views are asked again. `observe` then notes where a photograph was
        taken, and `fit` has nothing to do.
        """
        with self._fit_lock:
            if self._own is not None:
                return self._own
            if self._seen is None and self._fit.trainer is not None:
                self._seen = self._fit.gaussians()
            return self._seen

    @scene.setter
    def scene(self, gaussians: Gaussians) -> None:
        must_be("Planner", "scene", gaussians, Gaussians, "a scene that moves has none that could be planned for")
        with self._fit_lock:
            self._own = gaussians.detach()

    @property
    def views(self) -> list[str]:
        """Names of the photographs that are kept."""
        return [camera.name for camera in self._known]

    def observe(self, image: np.ndarray | None, camera: Camera, depth: np.ndarray | None = None) -> int:
        """A photograph that was taken; returns how many Gaussians it brought.

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
            if self._own is None:
                added = self._fit.add(_checked_image(image, camera), camera, _checked_depth(depth, camera))
                self._seen = None
            self._counted += 1
            self._here = camera
            self._known = [*self._known, at_most(camera, self.info_pixels)]
        if len(self._known) > self.max_views:
            self._drop_view()
        return added

    def fit(self, steps: int | None = None, seconds: float | None = None) -> int:
        """Go on fitting the planner's model to what was observed; returns how many steps were made.

        Another thread gets an answer between two of them.

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
                if self._own is not None or self._fit.trainer is None:
                    return done
                self._fit.step()
                self._seen = None
            done += 1
        return done

    def scores(
        self, candidates: Sequence[Camera], cost: Cost | None = None, *, seconds: float | None = None
    ) -> ViewPlan:
        """What the view of each place would tell; these places are what `next` picks from, until there are others.

        Args:
            candidates: Cameras at the places where it could go.
            cost: What it costs to go to each, >= 0; a function is called with the last place and the candidate.
            seconds: Wall time for the answer; None: all is asked that has changed.
        Returns:
            A plan without picks.
        Raises:
            ValueError: If there are no candidates, costs or `seconds` are not numbers >= 0, or there is no model yet;
                then `next` picks from the candidates before.
        """
        _check_seconds("Planner.scores", seconds)
        pool = camera_list("Planner.scores", "candidates", candidates)
        if not pool:
            raise ValueError("Planner.scores: there must be at least one candidate, got none; give poses")
        with self._answer_lock:
            before = self._pool, self._cost
            self._pool, self._cost = [at_most(camera, self.info_pixels) for camera in pool], cost
            try:
                self._costs(list(range(len(pool))), self._here)  # refuses what is no cost
                return self._plan(0, seconds)
            except BaseException:
                self._pool, self._cost = before
                raise

    def next(self, k: int = 1, *, seconds: float | None = None) -> ViewPlan:
        """The k places to go to next, of those that `scores` was given.

        Each is the one of most value, score over `look` + cost, once the ones before it are known; costs that are a
        function are counted from one to the next.

        Args:
            k: How many.
            seconds: Wall time for the answer; what has changed, or was never asked, is asked as far as it lasts.
        Raises:
            ValueError: If there are fewer candidates than k, or `seconds` is not a number >= 0.
        """
        _check_seconds("Planner.next", seconds)
        with self._answer_lock:
            if not (type(k) is int and 1 <= k <= len(self._pool)):
                raise ValueError(
                    f"Planner.next: k must be a whole number in 1..{len(self._pool)} candidates, got {k!r}; give "
                    "candidates to Planner.scores"
                )
            return self._plan(k, seconds)

    def refine(self, camera: Camera, refine: Refine | None = None) -> Pick:
        """A place moved to where its view tells more, within bounds; see `drgs.select.Refine`.

        Args:
            camera: The place to begin with, e.g. that of a pick.
            refine: How far and how long; default 20 further views, in the box of all known views and candidates.
        Returns:
            `camera` is the place, at the size at which views are asked; `score` and `start` are what it and the first
            tell, scored beside no other candidates.
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
            return select(scene, [start], known, 1, scoring=self._scoring, cache=self._cache, refine=refine).picks[0]

    # -------------------------------------------------- kill and resume

    def save(self, path: str | os.PathLike, notes: Any = None) -> None:
        """Write all that the planner knows to one file, from which `load` goes on with the same answers.

        A process that is killed meanwhile leaves the file as it was. One process alone may write a file.

        Args:
            path: The file, safetensors; a planner's own is replaced, any other refused.
            notes: Whatever else the caller goes on from, JSON: it is as old as the rest of the file.
        Raises:
            ValueError: If there is something else of that name, or notes are no JSON.
            OSError: If the file cannot be written.
        """
        records = lambda cameras: [_camera_json(camera) for camera in cameras]  # noqa: E731
        with self._answer_lock, self._fit_lock:
            fit, fit_header, photographs = self._fit.state()
            answers, cache_header, expected = self._cache.state()
            own, origin = _scene_tensors(self._own)
            costs = self._cost if self._cost is None or callable(self._cost) else [float(x) for x in self._cost]
            header = {
                "version": runtime.version(),
                "info_pixels": self.info_pixels,
                "max_views": self.max_views,
                "look": self.look,
                "bound": self._cache.bound,
                "max_bytes": self._cache.max_bytes,
                "counted": self._counted,
                "known": records(self._known),
                "here": None if self._here is None else _camera_json(self._here),
                "pool": records(self._pool),
                "costs": True if callable(costs) else costs,
                "scoring": named_by(self._scoring) or "",
                "asked_in": list(self._view_seconds.seconds),
                "answered_in": list(self._answer_seconds.seconds),
                "origin": origin,
                "fit": fit_header,
                "photographs": records(photographs),
                "cache": cache_header,
                "expected": records(expected),
                "notes": notes,
            }
        _write_file(path, {**fit, **answers, **own}, header)

    @classmethod
    def load(cls, path: str | os.PathLike, *, scoring: Scoring | None = None) -> Planner:
        """A planner that goes on from a file of `save`.

        With one thread its answers have the bits that they would have had without the interruption, except that a
        limit of time falls elsewhere. Costs that are a function are in no file: `next` needs another `scores` first.

        Args:
            path: The file.
            scoring: That of the planner that was saved, where it was not the default.
        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is none that a planner wrote, or damaged, or the scoring is another one.
        """
        where, tensors, header = _read_file(path)
        names = ("info_pixels", "max_views", "bound", "look", "max_bytes")
        try:
            planner = cls(scoring=scoring, **{name: header[name] for name in names})
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        if header["scoring"] != (named_by(planner._scoring) or ""):
            raise ValueError(
                f"{where}: scoring must be that of the planner that was saved, is another one; give it to Planner.load"
            )
        cameras = lambda name, pixels=math.inf: [  # noqa: E731
            _camera_of(where, one, pixels) for one in header[name]
        ]
        planner._fit = OnlineFit.from_state(tensors, header["fit"], cameras("photographs"), where)
        if header["origin"] is not None:
            planner._own = _scene_of(where, tensors, header["origin"])
        planner._known, planner._pool = (cameras(name, planner.info_pixels) for name in ("known", "pool"))
        planner._here = None if header["here"] is None else _camera_of(where, header["here"])
        planner._counted = header["counted"]
        costs = header["costs"]
        planner._cost = _unknown_cost if isinstance(costs, bool) else costs
        for name, durations in (("asked_in", planner._view_seconds), ("answered_in", planner._answer_seconds)):
            for seconds in header[name]:
                durations.note(seconds)
        expected = cameras("expected", planner.info_pixels)
        if header["version"] == runtime.version():  # another one may ask something else, which is asked anew
            planner._cache.restore(tensors, header["cache"], expected, str(where))
        planner.notes = header.get("notes")
        if len(planner._known) > planner.max_views:  # saved by one thread while another had just taken a photograph
            planner._drop_view()
        return planner

    # -------------------------------------------------- what is known

    def _name(self, name: str) -> str:
        """The name of a photograph, or its number."""
        name = name or f"view {self._counted}"
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
            if self._own is None:
                self._fit.drop(known[gone].name)

    def _coverage_of(self, scene: Gaussians) -> Callable[[Camera], Information]:
        """Coverage of a view, as policy `coverage` takes it; computed where it is not known yet."""

        def coverage(camera: Camera) -> Information:
            if self._cache.seen(scene, camera) is None:
                self._evaluate(scene, camera)
            return {"coverage": self._cache.seen(scene, camera)}

        return coverage

    def _model_and_views(self) -> tuple[Gaussians, list[Camera]]:
        """The model and the known views, together."""
        with self._fit_lock:
            scene = self.scene
            if scene is None:
                raise ValueError(
                    "Planner: there must be a model to ask, there is none yet; observe a photograph with depth, or two"
                )
            return scene, list(self._known)

    def _expect(self, cameras: Sequence[Camera]) -> None:
        """Before an answer: of other cameras nothing is kept, and nothing has been given."""
        self._cache.expect(cameras)
        self._cache.changes.clear()

    # -------------------------------------------------- answers

    def _plan(self, k: int, seconds: float | None) -> ViewPlan:
        """Compute information of as many views as there is time for, and answer by what is known then."""
        begun = time.monotonic()
        scene, known = self._model_and_views()
        self._expect([*known, *self._pool])
        calls = 1 if self._cost is None else max(k, 1)
        until = math.inf if seconds is None else begun + seconds - self._answer_seconds.usual * calls
        computed = self._evaluate_changed(scene, known, until)
        answering = time.monotonic()
        self._cache.computes = False
        try:
            plan = self._answer(scene, known, k)
        finally:
            self._cache.computes = True
        now = time.monotonic()
        if self._cache.forgot_saved:  # a file of another version named quantities otherwise: they are computed now
            self._cache.forgot_saved = False
            return self._plan(k, None if seconds is None else max(seconds - (now - begun), 0.0))
        self._answer_seconds.note((now - answering) / calls)
        return dataclasses.replace(plan, computed=computed, seconds=now - begun)

    def _evaluate_changed(self, scene: Gaussians, known: list[Camera], until: float) -> int:
        """Compute information of the views that have changed most, known ones and candidates in turn, until a time.

        Returns:
            How many views.
        """
        queues = []
        for cameras in (known, self._pool):
            changes = {i: self._cache.change(scene, camera) for i, camera in enumerate(cameras)}
            stale = sorted((i for i in changes if changes[i] > self._cache.bound), key=lambda i: (-changes[i], -i))
            queues.append(([cameras[i] for i in stale], len(cameras)))
        queues = [queue for queue, _ in sorted(queues, key=lambda x: -len(x[0]) / x[1])]  # where more is left first
        turns = [camera for pair in itertools.zip_longest(*queues) for camera in pair if camera is not None]
        done = 0
        for camera in turns:
            began = time.monotonic()
            if done and began + self._view_seconds.usual > until:  # one at least, so that every call brings something
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
        """Scores and picks by what is kept."""
        # Without costs all picks come of one call; with costs each is of another value than its score.
        at_once = max(k, 1) if self._cost is None else 1
        selection, places, there = self._selected(scene, list(range(len(self._pool))), known, at_once)
        scores: list[float | None] = [None] * len(self._pool)
        left_out = len(known) - len(there)
        picks: list[PlannedView] = []
        if selection is not None:
            for i, score in zip(places, selection.scores, strict=True):
                scores[i] = score
            if self._cost is None:
                scored = [(places[pick.index], pick.score) for pick in selection.picks[:k]]
                picks = [PlannedView(i, self._pool[i], score, 0.0, score) for i, score in scored]
        here = self._here
        while self._cost is not None and selection is not None and len(picks) < k:
            costs = self._costs(places, here)
            values = [score / (self.look + cost) for score, cost in zip(selection.scores, costs, strict=True)]
            best = int(np.argmax(values))
            here = self._pool[places[best]]
            picks.append(PlannedView(places[best], here, selection.scores[best], costs[best], values[best]))
            there = [*there, here]
            selection, places, there = self._selected(scene, [i for i in places if i != places[best]], there, 1)
        return ViewPlan(picks, scores, max(self._cache.changes.values(), default=0.0), 0, left_out, 0.0)

    def _selected(
        self, scene: Gaussians, places: list[int], known: list[Camera], k: int
    ) -> tuple[Selection | None, list[int], list[Camera]]:
        """Scores of the candidates that something is known of, against known views likewise; both as they are left."""
        while places:
            pool = [self._pool[i] for i in places]
            try:
                selection = select(scene, pool, known, min(k, len(pool)), scoring=self._scoring, cache=self._cache)
            except NotKept as lacking:
                places = [i for i in places if self._cache.keeps(lacking.quantity, self._pool[i])]
                known = [camera for camera in known if self._cache.keeps(lacking.quantity, camera)]
            else:
                return selection, places, known
        return None, places, known

    def _costs(self, places: list[int], here: Camera | None) -> list[float]:
        """What it costs to go from here to candidates."""
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


class _Duration:
    """How long something usually takes, as it was lately: a kernel that had to be compiled is not what is usual.

    Attributes:
        seconds: What it took the last times, the oldest first.
    """

    def __init__(self) -> None:
        self.seconds: deque[float] = deque(maxlen=_LATELY)

    def note(self, seconds: float) -> None:
        """It took so long."""
        self.seconds.append(seconds)

    @property
    def usual(self) -> float:
        """The median, seconds; 0 as long as nothing is known."""
        return statistics.median(self.seconds) if self.seconds else 0.0


def _unknown_cost(here: Camera, there: Camera) -> float:
    """What is in the place of costs that were a function when a planner was saved."""
    raise ValueError("Planner.next: costs were a function, which no file holds; give it to Planner.scores again")


def _check_seconds(where: str, seconds: float | None) -> None:
    """Refuse what is no limit of time; NaN would be none."""
    if seconds is not None and not (isinstance(seconds, numbers.Real) and seconds >= 0):
        raise ArgumentError(f"{where}: seconds must be a number >= 0, got {seconds!r}; leave it out for no limit")


def _checked_image(image: np.ndarray | None, camera: Camera) -> np.ndarray:
    shape = (camera.height, camera.width, 3)
    if not isinstance(image, np.ndarray) or image.shape != shape:
        got = f"shape {image.shape}" if isinstance(image, np.ndarray) else kind_of(image)
        raise ValueError(
            f"Planner.observe: image must be an array of shape {shape}, its camera's, got {got}; resize it"
        )
    if image.dtype != np.uint8 and not (np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1):
        raise ValueError("Planner.observe: image must be uint8, or finite and in [0, 1], got others; scale it")
    return image


def _checked_depth(depth: np.ndarray | None, camera: Camera) -> np.ndarray | None:
    if depth is None:
        return None
    shape = (camera.height, camera.width)
    if not isinstance(depth, np.ndarray) or depth.shape != shape:
        got = f"shape {depth.shape}" if isinstance(depth, np.ndarray) else kind_of(depth)
        raise ValueError(
            f"Planner.observe: depth must be an array of shape {shape}, its camera's, got {got}; resize it"
        )
    return np.nan_to_num(depth.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0).clip(min=0)


# ---------------------------------------------------------------------------------------------------- its file


def _write_file(path: str | os.PathLike, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
    """Write a planner's file; what a killed process left half written beside it is removed.

    Args:
        path: The file, which this process alone writes.
        tensors: What it holds.
        header: What else it holds, JSON.
    Raises:
        ValueError: If there is something else of that name, or the header is no JSON.
        OSError: If it cannot be written.
    """
    path = check_path("Planner.save", path)
    if os.path.lexists(path) and not _is_planner_file(path):
        raise ValueError(f"{path}: must not be replaced, is no planner's file that can be read; choose another name")
    try:
        header = parse_json(json.dumps(header, allow_nan=False), "Planner.save")  # as it will be read
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"Planner.save: notes must be JSON, got what is none ({error}); leave it out") from None
    if path.parent.is_dir():
        for other in path.parent.iterdir():
            if other.name.startswith(f".drgs.{path.name}.") and atomic.is_left_over(other.resolve()):
                atomic.delete(other)
    tensors = _apart(tensors)
    save_state(path, tensors, {"kind": _KIND, **header, "digest": _digest(tensors, header)})


def _read_file(path: str | os.PathLike) -> tuple[Path, dict[str, torch.Tensor], dict[str, Any]]:
    """The path, the tensors and the header of `_write_file`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is none that a planner has written, or damaged.
    """
    path = check_path("Planner.load", path)
    tensors, header = load_state(path)
    if header.pop("kind", None) != _KIND:
        raise ValueError(f"{path}: must be what Planner.save has written, is a checkpoint of a fit; see drgs fit")
    header.pop("schema")
    check_json(str(path), header, _HEADER, _ADVICE)
    if _digest(tensors, header) != header["digest"]:
        raise ValueError(f"{path}: must be as Planner.save has written it, has been changed since; {_ADVICE}")
    return path, tensors, header


def _camera_json(camera: Camera) -> dict[str, Any]:
    """A camera in JSON, to the bit."""
    pose = lambda x: np.asarray(as_numpy(x), np.float64).tolist()  # noqa: E731
    return {
        "K": camera.K.tolist(),
        "w2c": pose(camera.w2c),
        "w2c_end": None if camera.w2c_end is None else pose(camera.w2c_end),
        **{name: getattr(camera, name) for name in ("width", "height", "model", "name", "time", "shutter")},
        "distortion": list(camera.distortion),
    }


def _camera_of(where: Path, record: dict[str, Any], pixels: float = math.inf) -> Camera:
    """The camera of a record that `_read_file` has looked at.

    Args:
        where: The file, for messages.
        record: What `_camera_json` made.
        pixels: Number of pixels that its image may have.
    Raises:
        ValueError: If there is no such camera.
    """
    fields = {name: record[name] for name in _CAMERA}
    try:
        for name in ("K", "w2c", "w2c_end"):
            if fields[name] is not None:
                fields[name] = np.array(fields[name], np.float64)
        camera = Camera(**fields | {"distortion": tuple(fields["distortion"])})
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{where}: {error}; {_ADVICE}") from None
    if camera.width * camera.height > pixels:
        raise ValueError(f"{where}: {camera.name!r} must have at most {pixels} pixels, has more; {_ADVICE}")
    return camera


def _scene_tensors(scene: Gaussians | None) -> tuple[dict[str, torch.Tensor], list[float] | None]:
    """Tensors of a caller's own model and its origin; None where there is none."""
    if scene is None:
        return {}, None
    return {f"scene.{name}": x for name, x in scene.parameters().items()}, np.asarray(scene.origin).tolist()


def _scene_of(where: Path, tensors: Mapping[str, torch.Tensor], origin: list[float]) -> Gaussians:
    """The inverse of `_scene_tensors`.

    Raises:
        ValueError: If it is no model.
    """
    fields: dict[str, Any] = {
        name.removeprefix("scene."): x for name, x in tensors.items() if name.startswith("scene.")
    }
    try:
        scene = Gaussians(**fields, origin=np.array(origin, np.float64))
        scene.validate(str(where))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {str(error).removeprefix(f'{where}: ')}; {_ADVICE}") from None
    return scene


def _is_planner_file(path: Path) -> bool:
    """Whether a file, no link, says that a planner has written it."""
    with contextlib.suppress(ValueError, OSError):
        return not path.is_symlink() and state_header(path).get("kind") == _KIND
    return False


def _apart(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The same without two that share memory, which safetensors refuses."""
    seen: set[int] = set()
    apart = {}
    for name, x in tensors.items():
        x = x.detach().cpu()  # a file holds values
        place = x.untyped_storage().data_ptr()
        apart[name] = x.clone() if place in seen else x
        seen.add(place)
    return apart


def _digest(tensors: Mapping[str, torch.Tensor], header: Mapping[str, Any]) -> str:
    """A hash of all tensors, and of the header but for the hash."""
    text = json.dumps({key: x for key, x in header.items() if key != "digest"}, sort_keys=True)
    digest = hashlib.blake2b(text.encode(), digest_size=16)
    for name in sorted(tensors):
        x = tensors[name].contiguous().numpy()
        digest.update(f"{name} {x.dtype.str} {x.shape}".encode())
        digest.update(x.data if x.size else b"")
    return digest.hexdigest()
