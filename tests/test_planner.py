"""The planner: its answers are those of `drgs.select_views`, within a budget, while a model grows beside it."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import threading
import time

import numpy as np
import pytest
import torch
from scenes_random import gaussians

import drgs
from drgs.cameras import Camera, intrinsics, orbit
from drgs.planner import Planner, default_config
from drgs.select import Refine, Scoring, select

FAST = Scoring(settings=drgs.RenderSettings.preset("fast"))


@pytest.fixture(scope="module")
def world():
    """30 Gaussians, three known cameras and five candidates around them."""
    g = gaussians(np.random.default_rng(0), 30, 4, scale=0.25).detach()
    views = [dataclasses.replace(c, name=f"c{i}") for i, c in enumerate(orbit((0, 0, 0), 4.0, 8, width=24, height=18))]
    return g, views[:3], views[3:]


def planner_of(world, **options) -> Planner:
    """One with a caller's own model that knows the three cameras."""
    g, known, _ = world
    planner = Planner(scene=g, **options)
    for camera in known:
        assert planner.observe(None, camera) == 0
    return planner


def photograph(g, camera):
    """(H, W, 3) uint8 and (H, W) depth of what there is to see."""
    out = drgs.render(g, camera, drgs.RenderSettings.preset("fast"), outputs=("median_depth",))
    depth = out.median_depth.numpy() * (out.alpha.numpy() > 0.5)
    along = camera.pixel_directions() @ camera.c2w[:3, 2]
    return (out.rgb.clamp(0, 1).numpy() * 255).round().astype(np.uint8), depth * along


# -------------------------------------------------------------------------------------------------------------- answers


def test_answers_are_those_of_select(world):
    """The scores and picks of `select` where all is asked anew; a second answer asks nothing and says the same."""
    g, known, candidates = world
    planner = planner_of(world, bound=0.0)
    plan = planner.scores(candidates)
    right = select(g, candidates, known, 3, scoring=FAST)
    assert plan.scores == pytest.approx(right.scores, rel=1e-6)
    assert (plan.picks, plan.changed, plan.computed, plan.left_out) == ([], 0.0, 8, 0)
    plan = planner.next(3)
    assert [(pick.index, pick.cost) for pick in plan.picks] == [(pick.index, 0.0) for pick in right.picks]
    assert [pick.score for pick in plan.picks] == pytest.approx([pick.score for pick in right.picks], rel=1e-6)
    assert [pick.value for pick in plan.picks] == [pick.score for pick in plan.picks]
    assert plan.picks[0].camera is candidates[plan.picks[0].index]
    assert plan.computed == 0
    assert planner.views == ["c0", "c1", "c2"]


def test_before_the_first_photograph(world):
    """A caller's own model is enough: scores and picks of `select` without known views."""
    g, _, candidates = world
    planner = Planner(scene=g)
    right = select(g, candidates, [], 1, scoring=FAST)
    assert planner.scores(candidates).scores == pytest.approx(right.scores, rel=1e-6)
    assert planner.next().picks[0].index == right.picks[0].index


def test_what_has_changed_little_is_not_asked_again(world):
    """The answer says how far; a bound of 0 asks all anew, and is right."""
    g, known, candidates = world
    near = g.replace(log_scales=g.log_scales + 0.1)
    kept, anew = planner_of(world, bound=0.15), planner_of(world, bound=0.0)
    for planner in (kept, anew):
        planner.scores(candidates)
        planner.scene = near
    old, new = kept.scores(candidates), anew.scores(candidates)
    assert (old.computed, new.computed) == (0, 8)
    assert old.changed == pytest.approx(0.1, rel=1e-3)
    assert new.changed == 0
    assert new.scores == pytest.approx(select(near, candidates, known, 1, scoring=FAST).scores, rel=1e-6)
    assert old.scores == pytest.approx(select(g, candidates, known, 1, scoring=FAST).scores, rel=1e-6)


def test_a_budget(world):
    """Without time one view is asked at each call, known ones and candidates in turn; the rest is left out and said."""
    g, known, candidates = world
    planner = planner_of(world)
    asked = []
    for _ in range(9):
        plan = planner.scores(candidates, seconds=0)
        asked.append((plan.computed, sum(x is not None for x in plan.scores), plan.left_out))
    assert asked[:4] == [(1, 0, 2), (1, 1, 2), (1, 2, 2), (1, 2, 1)]
    assert asked[-1] == (0, 5, 0)
    plan = planner.next(5, seconds=0)
    assert plan.scores == pytest.approx(select(g, candidates, known, 1, scoring=FAST).scores, rel=1e-6)
    fresh = planner_of(world)
    fresh.scores(candidates, seconds=0)
    fresh.scores(candidates, seconds=0)
    plan = fresh.next(3, seconds=0)
    assert len(plan.picks) == sum(x is not None for x in plan.scores) < 3
    assert {pick.index for pick in plan.picks} == {i for i, x in enumerate(plan.scores) if x is not None}


class Clock:
    """Stands for the module `time`: only what a test says takes time.

    Attributes:
        now: Seconds.
        slow: How many times as long as usual everything takes.
        begun: When each view began.
    """

    def __init__(self, monkeypatch):
        self.now, self.slow, self.begun = 100.0, 1.0, []
        evaluate, answer = Planner._evaluate, Planner._answer

        def slow_evaluate(planner, scene, camera):
            self.begun.append(self.now)
            evaluate(planner, scene, camera)
            self.now += self.slow

        def slow_answer(planner, scene, known, k):
            plan = answer(planner, scene, known, k)
            views = len(known) - plan.left_out + sum(score is not None for score in plan.scores)
            self.now += 0.7 * self.slow * views
            return plan

        monkeypatch.setattr(Planner, "_evaluate", slow_evaluate)
        monkeypatch.setattr(Planner, "_answer", slow_answer)
        monkeypatch.setattr(drgs.planner, "time", self)

    def monotonic(self):
        return self.now


def test_a_budget_holds_when_the_machine_slows_down(world, monkeypatch):
    """From the first answer on, and where all takes four times as long: no view begins without the time to score all.

    A view takes a second, and an answer 0.7 seconds for each view that it scores.
    """
    _, _, candidates = world
    clock = Clock(monkeypatch)
    planner = planner_of(world, bound=0.0)
    for slow, seconds in ((1, 8), (1, 8), (4, 40), (4, 40)):
        planner._cache.invalidate()
        clock.slow = slow
        clock.begun.clear()
        asked = clock.now
        plan = planner.scores(candidates, seconds=seconds)
        assert plan.seconds == clock.now - asked <= seconds + slow, "later by one view at most"
        assert 8 > plan.computed >= 4, "the time is used"
        assert plan.computed == len(clock.begun) == 8 - plan.left_out - plan.scores.count(None)


def test_waiting_for_another_thread_counts(world, monkeypatch):
    """An answer that has waited for longer than its budget computes the one view that every answer does."""
    clock = Clock(monkeypatch)
    planner = planner_of(world)

    @contextlib.contextmanager
    def busy():
        clock.now += 100
        yield

    planner._answer_lock = busy()
    plan = planner.scores(world[2], seconds=50)
    assert (plan.computed, plan.seconds >= 100) == (1, True)


def test_enough_time_is_enough(world):
    """With a budget beyond what it takes, all is asked; the time that was taken is said."""
    _, _, candidates = world
    planner = planner_of(world)
    began = time.monotonic()
    plan = planner.scores(candidates, seconds=600)
    assert plan.seconds <= time.monotonic() - began
    assert (plan.computed, plan.left_out, None in plan.scores) == (8, 0, False)


def test_costs(world):
    """A pick is the score over look + cost; a function counts from the last place on, and from pick to pick."""
    g, known, candidates = world
    scores = select(g, candidates, known, 1, scoring=FAST).scores
    best = int(np.argmax(scores))
    costs = [0.0] * 5
    costs[best] = 1e6
    planner = planner_of(world, look=2.0)
    planner.scores(candidates, cost=costs)
    pick = planner.next().picks[0]
    assert pick.index != best
    assert (pick.cost, pick.value) == (0.0, pytest.approx(scores[pick.index] / 2, rel=1e-6))
    legs = []

    def distance(here, there):
        legs.append((here.name, there.name))
        return float(np.linalg.norm(there.center - here.center))

    planner.scores(candidates, cost=distance)
    legs.clear()
    picks = planner.next(2).picks
    assert {here for here, _ in legs[:5]} == {"c2"}, "the last photograph"
    assert {here for here, _ in legs[5:]} == {picks[0].camera.name}
    first = [scores[i] / (2 + distance(known[-1], candidates[i])) for i in range(5)]
    assert picks[0].index == int(np.argmax(first))
    assert picks[0].value == pytest.approx(max(first))


@pytest.mark.parametrize(
    ("fields", "got"),
    [
        ({"criterion": "block_logdet"}, "criterion block_logdet"),
        ({"combine": "zscore"}, "combine zscore"),
        ({"groups": ("means", "scales")}, "groups means, scales"),
        ({"blocks": ("backdrop",)}, "blocks backdrop"),
    ],
)
def test_scorings_that_cannot_grow(fields, got):
    """What is kept of views must have a meaning once Gaussians are added."""
    with pytest.raises(ValueError, match=f"group sh, got {got}"):
        Planner(scoring=Scoring(**fields))


def test_refine(world):
    """A place goes to where its view tells more, within its bounds; what it told before stays known."""
    _, _, candidates = world
    planner = planner_of(world)
    planner.scores(candidates)
    place = planner.next().picks[0]
    moved = planner.refine(place.camera, Refine(evaluations=12, box=(-5, -5, -5, 5, 5, 5)))
    assert moved.score >= moved.start > 0
    assert np.abs((moved.camera or place.camera).center).max() <= 5


# ---------------------------------------------------------------------------------------------------------------- model


def config(**fields):
    return default_config().replace(**{"max_gaussians": 200, "max_pixels": 500, "max_steps": 40, **fields})


def test_a_model_of_its_own(world):
    """It begins with depth, grows with what comes, gets better; copies stay as they are."""
    g, views, _ = world
    planner = Planner(config(), info_pixels=432)
    image, depth = photograph(g, views[0])
    first = planner.observe(image, views[0], depth)
    assert 0 < first <= 50
    image, depth = photograph(g, views[2])
    assert planner.observe(image, views[2], depth) > 0
    before = planner.scene
    means = before.means.clone()
    assert planner.fit() == 20
    assert torch.equal(before.means, means)
    assert not torch.equal(planner.scene.means, means)
    planner.fit(steps=100)  # beyond the 40 that the schedules were made for
    image = torch.from_numpy(photograph(g, views[2])[0] / 255)
    error = [
        float((drgs.render(x, views[2], drgs.RenderSettings.preset("fast")).rgb - image).square().mean())
        for x in (before, planner.scene)
    ]
    assert error[1] < error[0] / 2
    assert planner.fit(seconds=0) == 0


def test_a_surface_that_is_there_gets_no_points_again():
    """At the sides of a wide picture a wall is farther along the ray than its depth, and yet where the map says."""
    seen = Camera(intrinsics(20.0, 20.0, 20.0, 15.0), np.eye(4), 40, 30, name="a")
    wall, depth = np.full((30, 40, 3), 128, np.uint8), np.full((30, 40), 2.0)
    planner = Planner(config(max_gaussians=4000, max_pixels=1200, max_steps=1000))
    first = planner.observe(wall, seen, depth)
    assert first > 800
    planner.fit(steps=20)  # until nothing is open any more
    assert planner.observe(wall, dataclasses.replace(seen, name="b"), depth) < 0.05 * first


def test_without_depth_two_photographs_are_needed(world):
    """Nothing can be asked after one; after two there are points where both look."""
    g, views, candidates = world
    planner = Planner(config())
    assert planner.observe(photograph(g, views[0])[0], views[0]) == 0
    assert planner.scene is None
    assert planner.fit() == 0
    with pytest.raises(ValueError, match="observe a photograph with depth, or two"):
        planner.scores(candidates)
    assert planner.observe(photograph(g, views[1])[0] / 255, views[1]) > 50
    planner.fit(steps=3)
    assert all(np.isfinite(planner.scores(candidates).scores))


def test_no_more_views_than_allowed(world):
    """Of one more the one goes that the others cover: here a photograph that was taken twice; the fit lets go of it."""
    g, views, candidates = world
    planner = Planner(config(), max_views=3, info_pixels=432)
    twice = [*views, dataclasses.replace(views[2], name="c2 again")]
    for camera in twice:
        image, depth = photograph(g, camera)
        planner.observe(image, camera, depth)
    assert planner.views[:2] == ["c0", "c1"]
    assert len(planner.views) == 3
    assert [frame.name for frame in planner._fit.trainer.frames] == planner.views
    assert planner.scores(candidates).left_out == 0


def test_threads(world):
    """Photographs and steps on one, questions on another: all answers are finite, all steps are made."""
    g, views, candidates = world
    planner = Planner(config())
    image, depth = photograph(g, views[0])
    planner.observe(image, views[0], depth)
    plans, failed = [], []

    def ask():
        try:
            for _ in range(4):
                planner.scores(candidates, seconds=0.05)
                plans.append(planner.next(2, seconds=0.05))
        except Exception as error:  # noqa: BLE001  # whatever it is
            failed.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    for camera in views[1:]:
        image, depth = photograph(g, camera)
        planner.observe(image, camera, depth)
        assert planner.fit(steps=5) == 5
    thread.join()
    assert not failed
    assert len(plans) == 4
    assert all(np.isfinite(pick.score) for plan in plans for pick in plan.picks)
    assert planner.views == ["c0", "c1", "c2"]


# --------------------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Planner(max_views=1), "Planner: max_views must be a whole number >= 2, got 1; raise it"),
        (lambda: Planner(bound=1.5), r"Planner: bound must be in \[0, 1\], got 1.5; try 0.2"),
        (lambda: Planner(look=0), "Planner: look must be a finite number > 0, got 0; try 1"),
        (lambda: Planner(scene=3), "Planner: scene must be"),
        (lambda: Planner(drgs.FitConfig(selection=drgs.SelectionConfig())), "Planner: config must have no selection"),
    ],
)
def test_what_no_planner_can_be(make, told):
    with pytest.raises((ValueError, TypeError), match=told) as error:
        make()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("ask", "told"),
    [
        (lambda p, c: p.scores([]), "Planner.scores: there must be at least one candidate, got none; give poses"),
        (lambda p, c: p.scores(c, cost=[1.0]), "Planner: costs must be 5, one a candidate, got 1; give the missing"),
        (lambda p, c: p.scores(c, cost=[-1.0] * 5), "Planner: costs must be finite and >= 0, got -1.0; leave out"),
        (lambda p, c: p.scores(c, seconds=math.nan), "Planner.scores: seconds must be a number >= 0, got nan; leave"),
        (lambda p, c: p.scores(c, seconds=-1), "Planner.scores: seconds must be a number >= 0, got -1; leave it out"),
        (lambda p, c: p.next(seconds="1"), "Planner.next: seconds must be a number >= 0, got '1'; leave it out"),
        (lambda p, c: p.fit(seconds=-1), "Planner.fit: seconds must be a number >= 0, got -1; leave it out"),
        (lambda p, c: p.fit(steps=-3), "Planner.fit: steps must be a whole number >= 0, got -3; correct it"),
        (lambda p, c: p.fit(steps=2.5), "Planner.fit: steps must be a whole number >= 0, got 2.5; correct it"),
        (lambda p, c: p.next(), r"Planner.next: k must be a whole number in 1..0 candidates, got 1; give candidates"),
        (lambda p, c: p.observe(None, c[0].resized(5, 5)), None),
        (lambda p, c: p.observe(None, dataclasses.replace(c[0], name="c1")), "names must be different, got 'c1' again"),
        (lambda p, c: p.observe(None, 3), "Planner.observe: camera must be"),
    ],
)
def test_what_cannot_be_asked(world, ask, told):
    planner = planner_of(world)
    if told is None:
        assert ask(planner, world[2]) == 0  # a caller's own model needs no image
        return
    with pytest.raises((ValueError, TypeError), match=told) as error:
        ask(planner, world[2])
    assert "\n" not in str(error.value)


def test_candidates_of_scores_that_fail_are_not_installed(world):
    """`next` goes on picking from those before; without a model there is nothing to pick from."""
    planner = planner_of(world)
    candidates = world[2]
    before = planner.scores(candidates[:3], cost=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="costs must be 5, one a candidate, got 1"):
        planner.scores(candidates, cost=[1.0])
    plan = planner.next(3)
    assert plan.scores == before.scores
    assert sorted(pick.cost for pick in plan.picks) == [1.0, 2.0, 3.0]
    empty = Planner(config())
    with pytest.raises(ValueError, match="there must be a model, there is none"):
        empty.scores(candidates)
    with pytest.raises(ValueError, match=r"k must be a whole number in 1..0 candidates"):
        empty.next()


@pytest.mark.parametrize(
    ("image", "depth", "told"),
    [
        (None, None, r"image must be an array of shape \(18, 24, 3\), its camera's, got None; resize it"),
        (np.zeros((4, 4, 3)), None, r"its camera's, got shape \(4, 4, 3\); resize it"),
        (
            np.full((18, 24, 3), 255.0),
            None,
            r"image must be uint8, or finite and in \[0, 1\], got 255.0 to 255.0; scale it",
        ),
        (np.zeros((18, 24, 3)), np.ones((2, 2)), r"depth must be an array of shape \(18, 24\), its camera's"),
    ],
)
def test_photographs_that_cannot_be(world, image, depth, told):
    """One line, and nothing is known of them afterwards."""
    planner = Planner(config())
    with pytest.raises(ValueError, match=told) as error:
        planner.observe(image, world[1][0], depth)
    assert "\n" not in str(error.value)
    assert planner.views == []
