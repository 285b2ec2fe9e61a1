"""Next best views: each policy as defined, lazy as greedy, batches as single picks, bounded memory, bad input."""

from __future__ import annotations

import dataclasses
import gc
import itertools
import json
import math
import weakref
from typing import NamedTuple

import dense_jacobian
import numpy as np
import pytest
import torch
from scenes_random import gaussians

from drgs import fisher, reference, runtime
from drgs.cameras import Camera, intrinsics_from_fov, look_at
from drgs.ellipsoids import Gaussians
from drgs.gain import CRITERIA, Prior, dense, information_gain
from drgs.information.quantity import ViewContext
from drgs.select import POLICIES, Cache, Scoring, select
from drgs.selection.cache import camera_key
from drgs.settings import RenderSettings

SIZE = (12, 10)
INFORMED = ("fisher", "fisherrf", "coverage")


def ring(rng, count: int, distance=4.0) -> list[Camera]:
    """Cameras in random directions around the origin, looking at points near it, named view0, view1, ..."""
    cameras = []
    for i in range(count):
        eye = rng.normal(size=3)
        eye *= distance * rng.uniform(0.8, 1.2) / np.linalg.norm(eye)
        w2c = look_at(eye, 0.3 * rng.normal(size=3), (0.1, 0.2, 1.0))
        cameras.append(Camera(intrinsics_from_fov(40.0, *SIZE), w2c, *SIZE, name=f"view{i}"))
    return cameras


def line(places, prefix="c") -> list[Camera]:
    """Cameras at (x, 0, 0), named by their order."""
    K, w2c = intrinsics_from_fov(40.0, *SIZE), np.eye(4)
    cameras = []
    for i, x in enumerate(places):
        w2c = np.eye(4)
        w2c[0, 3] = -x
        cameras.append(Camera(K, w2c, *SIZE, name=f"{prefix}{i}"))
    return cameras


def random_pool(rng, count, n=30, sparse=0.5, whole=False) -> dict[str, dict]:
    """Camera name -> information; whole numbers make ties likely."""
    pool = {}
    for i in range(count):
        seen = torch.tensor(rng.uniform(size=n) > sparse).double()
        draw = (lambda *s: rng.integers(0, 2, s)) if whole else (lambda *s: np.exp(2 * rng.normal(size=s)))  # noqa: E731
        pool[f"c{i}"] = {
            "means": seen[:, None] * torch.tensor(draw(n, 3)).double(),
            "logit_opacities": seen * torch.tensor(draw(n)).double(),
        }
    return pool


def choose(pool, train=(), k=1, **options):
    """`select` among a `random_pool`; names in `train` are known views."""
    cameras = {camera.name: camera for camera in line(range(len(pool)))}
    candidates = [camera for name, camera in cameras.items() if name not in train]
    known = [cameras[name] for name in train]
    return select(scene(), candidates, known, k, information=lambda camera: pool[camera.name], **options)


def scene(n=3):
    return gaussians(np.random.default_rng(0), n, 1, scale=0.25).detach()


def names(selection) -> list[str]:
    return [pick.name for pick in selection.picks]


# -------------------------------------------------- on real information


@pytest.fixture(scope="module")
def world():
    """12 Gaussians, 3 training views and 7 candidates, and the dense Jacobians of all ten in float64."""
    rng = np.random.default_rng(5)
    g, cameras = gaussians(rng, 12, 1, scale=0.25), ring(rng, 10)
    settings = RenderSettings.preset("exact")
    J = [dense_jacobian.jacobian(g, reference.render(g, camera, settings)) for camera in cameras]
    return g.detach(), cameras[:3], cameras[3:], J


def test_scores_are_the_oracles(world):
    """The pipeline's scores against the formula on the dense Jacobian, every criterion."""
    g, train, candidates, J = world
    squares = [dense_jacobian.squares(x) for x in J]
    H = {name: sum(x[name] for x in squares[:3]) for name in squares[0]}
    rows = [dense_jacobian.stacked(x) for x in J]
    blocks = [torch.einsum("pni,pnj->nij", x, x) for x in rows]
    for criterion in CRITERIA:
        found = select(g, candidates, train, criterion=criterion, prior=Prior(1e-2), blocks=("geometry",))
        for i, view in enumerate(range(3, 10)):
            new, old = (
                (squares[view], H)
                if criterion != "block_logdet"
                else ({"blocks": blocks[view]}, {"blocks": sum(blocks[:3])})
            )
            everything = {name: sum(x[name] for x in squares) for name in H} if criterion == "v_opt" else None
            truth = information_gain(new, old, criterion, found.prior, pool=everything)
            assert found.scores[i] == pytest.approx(truth.total, rel=1e-4)
            assert found.parts[i] == pytest.approx(truth.parts, rel=1e-3, abs=1e-6 * truth.total)
        assert found.picks[0].index == int(np.argmax(found.scores))
        assert found.picks[0].score == max(found.scores)
        assert found.picks[0].margin == pytest.approx(max(found.scores) - sorted(found.scores)[-2], rel=1e-12)
        assert found.computed == 10
        assert found.evaluations == 7


def test_permutation_of_the_gaussians(world):
    """Their order plays no role, for any policy, through the renderer."""
    g, train, candidates, _ = world
    shuffled = g.take(torch.randperm(len(g)))
    for policy in INFORMED:
        one, two = (select(x, candidates, train, 3, policy) for x in (g, shuffled))
        assert names(one) == names(two)
        assert two.scores == pytest.approx(one.scores, rel=1e-5)


def test_policies_on_real_information(world):
    """Each policy scores what it says it does."""
    g, train, candidates, _ = world
    prior = Prior(1e-3)
    H = fisher.diagonal(g, train, method="fisherrf")
    rf = select(g, candidates, train, policy="fisherrf", prior=prior)
    for i, camera in enumerate(candidates):
        part = fisher.diagonal(g, camera, method="fisherrf")
        assert rf.scores[i] == pytest.approx(information_gain(part, H, "eig", prior).total, rel=1e-5)
    assert "rotations" not in rf.parts[0]
    # Also when the prior and the weights speak of rotations, which it does not have.
    spoken = select(
        g, candidates, train, policy="fisherrf", prior=Prior(1e-3, groups={"rotations": 1}), weights={"rotations": 2}
    )
    assert spoken.scores == pytest.approx(rf.scores, rel=1e-6)
    W = fisher.coverage(g, train)
    covered = select(g, candidates, train, policy="coverage", prior=prior)
    for i, camera in enumerate(candidates):
        assert covered.scores[i] == pytest.approx(float((fisher.coverage(g, camera) / (W + 1e-3)).sum()), rel=1e-5)


def test_diagonal_picks_against_mutual_information(world):
    """On this scene the best view by blocks or diagonal loses little of the best mutual information."""
    g, train, candidates, J = world
    flat = [dense_jacobian.stacked(x).flatten(1) for x in J]
    truth = [dense(x, torch.cat(flat[:3]), 1e-2).mutual_information for x in flat[3:]]
    for criterion in ("logdet", "block_logdet"):
        found = select(g, candidates, train, criterion=criterion, prior=Prior(1e-2), blocks=("geometry",))
        assert truth[found.picks[0].index] >= 0.9 * max(truth)


@pytest.mark.parametrize("policy", ["fisher", "fisherrf", "coverage", "farthest"])
def test_batch_is_single_picks(world, policy):
    """k at once are k calls that move each pick to the training views: same picks, scores and margins."""
    g, train, candidates, _ = world
    batch = select(g, candidates, train, 4, policy)
    known, left, singles = list(train), list(candidates), []
    for _ in range(4):
        one = select(g, left, known, 1, policy).picks[0]
        singles.append(one)
        known.append(left.pop(one.index))
    assert names(batch) == [one.name for one in singles]
    for a, b in zip(batch.picks, singles, strict=True):
        assert candidates[a.index].name == a.name
        assert a.score == pytest.approx(b.score, rel=1e-6)
        assert a.margin == pytest.approx(b.margin, rel=1e-6, abs=1e-9 * b.score)


@pytest.mark.parametrize("prior", [Prior(0.0), Prior(1e-2, relative=True)])
def test_batch_with_a_prior_that_moves(world, prior):
    """lambda = 0 and relative lambda follow H from pick to pick, as single calls do; nothing is scored lazily then."""
    g, train, candidates, _ = world
    batch = select(g, candidates, train[:1], 4, prior=prior)
    assert batch.evaluations == 7 + 6 + 5 + 4
    known, left = list(train[:1]), list(candidates)
    for pick in batch.picks:
        one = select(g, left, known, 1, prior=prior).picks[0]
        assert (one.name, one.score) == (pick.name, pytest.approx(pick.score, rel=1e-6))
        known.append(left.pop(one.index))


def test_duplicate_cameras(world):
    """A second view from the same place is a view: it scores the same, and less once the first is known."""
    g, train, candidates, _ = world
    # Out of a cache, as a view rendered twice by several threads may differ in its last digits.
    found = select(g, [candidates[0]] * 3, train, 3, cache=Cache())
    assert found.scores[0] == found.scores[1] == found.scores[2]
    assert [pick.index for pick in found.picks] == [0, 1, 2]
    assert found.picks[0].margin == 0
    scores = [pick.score for pick in found.picks]
    assert scores[0] > scores[1] > scores[2] > 0
    assert any("same score" in note for note in found.notes)
    assert found.picks[2].margin is None


def test_nothing_seen(world):
    """Cameras that look away: scores 0, the order decides, and the result says so."""
    g, train, _, _ = world
    away = [dataclasses.replace(x, w2c=np.diag([-1.0, 1, -1, 1]) @ x.w2c) for x in train]
    for policy in INFORMED:
        found = select(g, away, train, 2, policy, blocks=("geometry",))
        assert found.scores == [0.0] * 3
        assert [pick.index for pick in found.picks] == [0, 1]
        assert [pick.margin for pick in found.picks] == [0.0, 0.0]
        assert any("every score is 0" in note for note in found.notes)
    blind = select(g, train, away, prior=Prior(0.0), blocks=("geometry",))
    assert blind.scores == [0.0] * 3
    assert any("lambda = 0" in note and "36 of means" in note for note in blind.notes)
    assert blind.left_out["logit_opacities"] == 12


def test_no_training_views(world):
    """Everything is unseen: an absolute prior decides, any other is an error."""
    g, _, candidates, _ = world
    found = select(g, candidates, [], 2)
    assert found.unseen == pytest.approx(found.scores)
    assert found.computed == 7
    for prior in (Prior(0.0), Prior(1.0, relative=True)):
        with pytest.raises(ValueError, match="select: without training views lambda must be absolute and > 0"):
            select(g, candidates, [], prior=prior)


def test_no_gaussians():
    """An empty scene is a scene."""
    g = scene(1).take(slice(0, 0))
    found = select(g, line(range(3)), line([9.0]), 2, blocks=("geometry",))
    assert found.scores == [0.0] * 3
    assert [pick.index for pick in found.picks] == [0, 1]


def test_nan_gaussians(world):
    """A NaN parameter is named before anything is rendered."""
    g, train, candidates, _ = world
    means = g.means.clone()
    means[4, 1] = math.nan
    with pytest.raises(ValueError, match="means must be finite, .* at index 4"):
        select(g.replace(means=means), candidates, train)


# -------------------------------------------------- lazy greedy


@pytest.mark.core
@pytest.mark.every(4)
@pytest.mark.parametrize("criterion", ["logdet", "eig", "trace_cov", "v_opt"])
@pytest.mark.parametrize("whole", [False, True], ids=["generic", "ties"])
def test_lazy_is_greedy(criterion, whole):
    """Same picks, scores and margins on 40 random pools, with fewer evaluations."""
    plain_count = lazy_count = ties = 0
    for seed in range(40):
        pool = random_pool(np.random.default_rng(seed), 25, n=8 if whole else 30, whole=whole, sparse=0.6)
        if whole:  # and exact copies
            pool["c20"], pool["c7"] = pool["c3"], pool["c3"]
        options = {"criterion": criterion, "prior": Prior(1e-2), "train": ("c0",), "k": 10}
        plain, lazy = (choose(pool, lazy=x, **options) for x in (False, True))
        assert lazy.picks == plain.picks
        assert lazy.scores == plain.scores
        assert plain.evaluations == sum(range(15, 25))
        plain_count, lazy_count = plain_count + plain.evaluations, lazy_count + lazy.evaluations
        ties += sum(pick.margin == 0 for pick in plain.picks)
    assert (ties > 20) == whole
    # Ties have to be scored to be seen; variances of unseen parameters (`trace_cov`) fall the most from pick to pick.
    share = 0.95 if whole else {"logdet": 0.7, "eig": 0.85, "trace_cov": 0.85, "v_opt": 0.9}[criterion]
    assert lazy_count < share * plain_count, (lazy_count, plain_count)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_lazy_on_real_information(criterion):
    """The same on rendered information, blocks included."""
    rng = np.random.default_rng(8)
    g, cameras, cache = gaussians(rng, 14, 4, scale=0.2).detach(), ring(rng, 24), Cache()
    options = {"criterion": criterion, "cache": cache}
    plain, lazy = (select(g, cameras[2:], cameras[:2], 8, lazy=x, **options) for x in (False, True))
    assert lazy.picks == plain.picks
    assert lazy.evaluations < plain.evaluations == sum(range(15, 23))
    assert (plain.computed, lazy.computed) == (24, 0)


def test_greedy_is_greedy(rng):
    """Against picking by hand."""
    pool = random_pool(rng, 9)
    found = choose(pool, ("c0", "c4"), 5, criterion="eig", weights={"means": 0.5})
    H = {name: (pool["c0"][name].float() + pool["c4"][name].float().double()) for name in pool["c0"]}
    left = [name for name in pool if name not in ("c0", "c4")]
    for pick in found.picks:
        scores = {name: information_gain(pool[name], H, "eig", weights={"means": 0.5}).total for name in left}
        best = max(scores, key=scores.get)
        assert pick.name == best
        assert pick.score == pytest.approx(scores[best], rel=1e-6)
        assert pick.score == pytest.approx(sum(pick.parts.values()), rel=1e-12)
        left.remove(best)
        H = {name: H[name] + pool[best][name] for name in H}


# -------------------------------------------------- memory and the cache


class _Counter:
    """Makes information and counts how many views of it are alive at once."""

    def __init__(self, n=200):
        self.n, self.alive, self.most, self.calls = n, weakref.WeakSet(), 0, 0

    def __call__(self, camera):
        self.most = max(self.most, len(self.alive))
        self.calls += 1
        generator = torch.Generator().manual_seed(int(camera.name[1:]))
        # float32 already: what select keeps is then this very tensor.
        x = torch.rand(self.n, 3, generator=generator)
        self.alive.add(x)
        return {"means": x}


def test_memory_of_one_pick_is_constant():
    """Nothing of another view is alive while one is computed, however many there are; a batch holds all candidates.
    `v_opt` holds them, too, or computes them twice: see test_pool_that_does_not_fit_into_memory.
    """
    most = {}
    for count, k in ((5, 1), (40, 1), (5, 2), (40, 2)):
        counter = _Counter()
        select(scene(), line(range(count)), line([-1.0, -2.0]), k, information=counter, criterion="eig")
        assert counter.calls == count + 2
        most[count, k] = counter.most
    assert most[5, 1] == most[40, 1] <= 1
    assert (most[5, 2], most[40, 2]) == (4, 39)


def test_cache():
    """Views are computed once while the Gaussians stay; other poses under the same name are other views."""
    g, counter, cache = scene(), _Counter(), Cache()
    cameras = line(range(6))
    run = lambda k=1, **options: select(g, cameras[2:], cameras[:2], k, cache=cache, information=counter, **options)  # noqa: E731
    first, again = run(), run(criterion="eig")
    assert (first.computed, again.computed, counter.calls, len(cache)) == (6, 0, 6, 6)
    assert run(3).scores == first.scores == select(g, cameras[2:], cameras[:2], information=counter).scores
    calls = counter.calls
    moved = [dataclasses.replace(x, w2c=np.linalg.inv(x.c2w @ np.diag([1, -1, -1, 1.0]))) for x in cameras]
    select(g, moved[2:], cameras[:2], cache=cache, information=counter)
    assert counter.calls == calls + 4
    with torch.no_grad():
        g.means[0] += 1  # in place: noticed
    assert run().computed == 6
    assert run().computed == 0
    g = g.replace(sh=g.sh.clone())  # other tensors: noticed
    assert run().computed == 6
    g = g.replace(origin=np.array([1.0, 0.0, 0.0]))
    assert run().computed == 6
    cache.invalidate()
    assert len(cache) == 0
    assert run().computed == 6
    assert cache.misses == counter.calls - 6


def test_cache_keeps_kinds_apart(world):
    """Policies, methods and settings that share a cache do not get each other's information."""
    g, train, candidates, _ = world
    cache = Cache()
    kinds = [
        {"policy": "fisher"},
        {"policy": "fisher", "method": "probes"},
        {"policy": "fisher", "criterion": "block_logdet"},
        {"policy": "fisher", "settings": RenderSettings.preset("fast")},
        {"policy": "fisherrf"},
        {"policy": "coverage"},
    ]
    for options in kinds:
        found = select(g, candidates[:3], train[:1], cache=cache, **options)
        assert found.computed == 4
        # Logarithms of what a single view hardly determines are of sums whose order is not fixed on a card.
        close = 1e-3 if runtime.backend().name == "cuda" else 1e-6
        assert found.scores == pytest.approx(select(g, candidates[:3], train[:1], **options).scores, rel=close)
    assert len(cache) == 4 * len(kinds) + 4, "and how far away the surfaces of each view are, for the backdrop"


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(Camera)])
def test_every_field_of_a_camera_is_in_the_key(field):
    """Cameras that differ in any one field but the name never share information; copies do, whatever holds their
    pose."""
    w2c = np.eye(4)
    w2c[0, 3] = 1
    camera = Camera(intrinsics_from_fov(40.0, *SIZE), np.eye(4), *SIZE, "opencv", (0.1, 0.0, 0.0, 0.0), "one")
    camera = dataclasses.replace(camera, shutter="rolling_top_to_bottom", w2c_end=np.eye(4))
    other = {
        "K": intrinsics_from_fov(41.0, *SIZE),
        "w2c": w2c,
        "width": SIZE[0] + 1,
        "height": SIZE[1] + 1,
        "model": "opencv_fisheye",
        "distortion": (0.1, 0.0, 0.0, 1e-12),
        "name": "two",
        "time": 0.25,
        "shutter": "rolling_bottom_to_top",
        "w2c_end": w2c,
    }
    assert camera_key(dataclasses.replace(camera)) == camera_key(camera)
    changed = dataclasses.replace(camera, **{field: other[field]})
    assert (camera_key(changed) == camera_key(camera)) == (field == "name")
    as_tensor = dataclasses.replace(changed, w2c=torch.tensor(changed.w2c, requires_grad=True))
    assert camera_key(as_tensor) == camera_key(changed)
    hash(camera_key(changed))


def test_cache_knows_time_and_features():
    """Two times at one pose do not share information, nor do a scene and itself with other features."""
    g, counter, cache = scene(), _Counter(), Cache()
    g = g.replace(features=torch.zeros(len(g), 2))
    early, late = (dataclasses.replace(camera, time=t) for camera, t in zip(line([0, 0]), (0.0, 0.5), strict=True))
    late = dataclasses.replace(late, name=early.name)
    run = lambda: select(g, [early, late], line([5.0]), cache=cache, information=counter)  # noqa: E731
    assert run().computed == 3
    assert run().computed == 0
    with torch.no_grad():
        g.features[1, 1] = 1
    assert run().computed == 3
    g = g.replace(features=g.features.clone())
    assert run().computed == 3
    g = g.replace(features=None)
    assert run().computed == 3


class _Moving:
    """Gaussians that a network of one weight moves along x."""

    def __init__(self, g):
        self.g, self.speed = g, torch.zeros(())

    def at(self, time):
        return self.deform(self.parameters(), time)

    def deform(self, parameters, time):
        means = parameters["means"]
        x = torch.eye(3)[0].to(means)
        return self.g.to(means.device).replace(means=means + parameters["speed"] * time * x)

    def parameters(self):
        return {**self.g.parameters(), "speed": self.speed}


def test_scene_that_moves(world):
    """Each camera sees the Gaussians of its time, known views too; a weight that changes is another scene."""
    g, train, candidates, _ = world
    moving, cache = _Moving(g), Cache()
    moving.speed.fill_(0.5)
    cameras = [dataclasses.replace(candidates[0], time=t) for t in (0.0, 1.0)]
    known = [dataclasses.replace(train[0], time=1.0)]
    found = select(moving, cameras, known, cache=cache, criterion="eig", blocks=("geometry",))
    H = fisher.diagonal(moving.at(1.0), known)
    for camera, score in zip(cameras, found.scores, strict=True):
        part = fisher.diagonal(moving.at(camera.time), camera)
        assert score == pytest.approx(information_gain(part, H, "eig", found.prior).total, rel=1e-5)
    assert found.scores[0] != pytest.approx(found.scores[1], rel=1e-2)
    assert select(moving, cameras, known, cache=cache, blocks=("geometry",)).computed == 0
    # The speed moves nothing at time 0; other groups are other information.
    options = {"method": "columns", "groups": ("speed",), "cache": cache}
    found = select(moving, cameras, known, **options)
    assert found.computed == 3
    assert found.scores[0] == 0 < found.scores[1] == found.parts[1]["speed"]
    moving.speed.fill_(0.25)
    assert select(moving, cameras, known, cache=cache).computed == 3
    other = _Moving(g)
    other.speed = moving.speed
    assert select(other, cameras, known, cache=cache).computed == 3


class _Fresh(_Moving):
    """Its `parameters()` are other tensors at each call."""

    def parameters(self):
        return {name: x.detach() for name, x in super().parameters().items()}


class _Plain(NamedTuple):
    """A scene that cannot be weakly referenced."""

    g: Gaussians

    def at(self, time):
        return self.g

    def parameters(self):
        return self.g.parameters()


@pytest.mark.parametrize("kind", [_Fresh, _Plain])
def test_cache_computes_what_it_cannot_recognize(kind):
    """Tensors that are made for one call, and scenes without weak references, never share information."""
    moving, cache, counter = kind(scene()), Cache(), _Counter()
    for _ in range(2):
        assert select(moving, line(range(3)), line([5.0]), cache=cache, information=counter).computed == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": "moments"}, "select: information must be None with policy moments, got some; use fisher"),
        ({"policy": "random"}, "information must be None with policy random"),
        ({"combine": "zscore"}, "combine and network must be left out with information, got zscore"),
        ({"network": "trace"}, "combine and network must be left out with information, got trace"),
    ],
)
def test_what_means_nothing_beside_information_is_refused(options, message):
    """It was dropped in silence."""
    with pytest.raises(ValueError, match=message):
        select(scene(), line(range(3)), line([5.0]), information=_Counter(), **options)


class _Here:
    """Workers that answer in this process, as they are asked."""

    def each(self, scene, settings, requests):
        return (x.compute(ViewContext(scene, camera, settings, mask)) for x, camera, mask in requests)


@pytest.mark.parametrize("kind", [_Fresh, _Plain, lambda g: g])
def test_workers_answer_each_view_of_what_a_cache_does_not_recognize(world, kind):
    """Also one that comes twice: no view gets the answer of the next one."""
    g, *views, _ = world
    train, (a, b, c, *_) = ([dataclasses.replace(camera, time=0.0) for camera in some] for some in views)
    ask = {"settings": RenderSettings.preset("fast"), "criterion": "eig", "blocks": ("geometry",)}
    wanted = select(g, [a, a, b, c], train, **ask).scores
    found = select(kind(g), [a, a, b, c], train, cache=Cache(), workers=_Here(), **ask)
    assert found.scores == pytest.approx(wanted, rel=1e-6)
    assert found.scores[0] != found.scores[2]


def test_cache_does_not_keep_the_gaussians():
    """A cache outlives the state it was made for; the tensors must not."""
    g, cache = scene(), Cache()
    select(g, line(range(3)), line([5.0]), cache=cache, information=_Counter())
    alive = weakref.ref(g.means)
    del g
    gc.collect()
    assert alive() is None


def test_progress():
    """Called after every view."""
    seen = []
    select(scene(), line(range(3)), line([5.0]), information=_Counter(), progress=lambda *x: seen.append(x))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_pool_that_does_not_fit_into_memory(rng, monkeypatch):
    """`v_opt` asks for what cannot be kept a second time: the same scores, and `progress` knows of it."""
    pool, seen, gone = random_pool(rng, 6), [], []
    monkeypatch.setattr("drgs.selection.greedy.available", lambda: 0 if gone else 1 << 30)
    kept = choose(pool, ["c0"], criterion="v_opt", progress=lambda *x: seen.append(x))
    assert (kept.computed, seen[-1]) == (6, (6, 6))
    gone.append(True)
    again = choose(pool, ["c0"], criterion="v_opt", progress=lambda *x: seen.append(x))
    assert (again.computed, seen[-1]) == (11, (11, 11))
    assert dataclasses.replace(again, seconds=0.0, computed=6) == dataclasses.replace(kept, seconds=0.0)


# -------------------------------------------------- policies without information


def test_farthest():
    """Farthest point sampling: the ends, then the middles."""
    found = select(scene(), line([0, 1, 2, 3, 4, 5, 6, 10]), line([0.4], "t"), 4, "farthest")
    assert found.scores == pytest.approx([0.4, 0.6, 1.6, 2.6, 3.6, 4.6, 5.6, 9.6])
    assert [pick.index for pick in found.picks] == [7, 5, 3, 2]
    assert [pick.score for pick in found.picks] == pytest.approx([9.6, 4.6, 2.0, 1.0])
    assert found.picks[0].margin == pytest.approx(4.0)
    # 5 is 4.6 from 0.4, 6 only 4 from 10; then 3 is 2 from 5; then 2, 4 and 6 are 1 from something: the lowest index.
    alone = select(scene(), line([3, 1, 7]), [], 3, "farthest")
    assert [pick.index for pick in alone.picks] == [0, 2, 1]
    assert [pick.score for pick in alone.picks] == [0.0, 4.0, 2.0]
    same = select(scene(), line([1, 1, 1]), line([1.0], "t"), 2, "farthest")
    assert [pick.index for pick in same.picks] == [0, 1]
    assert [pick.score for pick in same.picks] == [0.0, 0.0]


def test_uniform():
    """The middle of the largest gap; several picks evenly; numbers in names count as numbers."""
    cameras = line(range(21))  # c0 .. c20: as text, c10 would follow c1
    train = [cameras[0], cameras[12]]
    left = [x for x in cameras if x not in train]
    assert names(select(scene(), left, train, 1, "uniform")) == ["c6"]
    assert names(select(scene(), left, train, 2, "uniform")) == ["c6", "c17"]
    assert names(select(scene(), left, train, 4, "uniform")) == ["c4", "c8", "c15", "c18"]
    shuffled = [left[i] for i in np.random.default_rng(0).permutation(len(left))]
    found = select(scene(), shuffled, train, 2, "uniform")
    assert names(found) == ["c6", "c17"]
    assert [shuffled[pick.index].name for pick in found.picks] == ["c6", "c17"]
    assert max(found.scores) == 6
    assert names(select(scene(), line(range(9)), [], 1, "uniform")) == ["c4"]
    assert names(select(scene(), line(range(9)), [], 4, "uniform")) == ["c1", "c3", "c5", "c7"]
    everything = select(scene(), left, train, len(left), "uniform")
    assert sorted(pick.index for pick in everything.picks) == list(range(len(left)))
    unnamed = [dataclasses.replace(x, name="") for x in line(range(9))]
    assert [pick.index for pick in select(scene(), unnamed, [], 1, "uniform").picks] == [4]


def _widest(n, places):
    return max(np.diff(sorted([-1, n, *places])))


def test_uniform_gaps_are_even():
    """For any pool: no gap between neighbors could be narrower by placing the same number of picks otherwise."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        n = int(rng.integers(5, 14))
        cameras = line(range(n))
        train = sorted(rng.choice(n, int(rng.integers(0, 4)), replace=False).tolist())
        free = [i for i in range(n) if i not in train]
        k = int(rng.integers(1, min(4, len(free)) + 1))
        chosen = select(scene(), [cameras[i] for i in free], [cameras[i] for i in train], k, "uniform")
        best = min(_widest(n, [*train, *picks]) for picks in itertools.combinations(free, k))
        assert _widest(n, [*train, *(int(name[1:]) for name in names(chosen))]) == best


def test_random():
    """One generator that goes on: calls differ, a run's own repeats, and every subset comes up."""
    cameras = line(range(50))
    pick = lambda k=5, **options: [x.index for x in select(scene(), cameras, [], k, "random", **options).picks]  # noqa: E731
    assert len({tuple(pick()) for _ in range(5)}) == 5
    generator = torch.Generator().manual_seed(3)
    first = [pick(rng=generator), pick(rng=generator)]
    assert first[0] != first[1]
    generator.manual_seed(3)
    assert [pick(rng=generator), pick(rng=generator)] == first
    assert sorted(pick(50)) == list(range(50))
    state = torch.random.get_rng_state()
    pick()
    assert torch.equal(state, torch.random.get_rng_state())  # nobody else's numbers are used up
    counts = np.bincount([pick(1, rng=generator)[0] for _ in range(2000)], minlength=50)
    assert ((counts - 40) ** 2 / 40).sum() < 90  # chi squared, 49 degrees of freedom: p = 3e-4


# -------------------------------------------------- bad input, and the result


def test_errors():
    """One line each, that says what was got."""
    g, cameras = scene(), line(range(4))
    for policy in POLICIES:
        with pytest.raises(ValueError, match="select: there must be at least one candidate, got none"):
            select(g, [], cameras, policy=policy)
        for k in (5, 0, -1, 1.5):
            with pytest.raises(ValueError, match=f"select: k must be a whole number in 1..4 candidates, got {k}"):
                select(g, cameras, [], k, policy)
    with pytest.raises(ValueError, match="select: policy must be one of fisher, .*, got 'oracle'"):
        select(g, cameras, [], policy="oracle")
    with pytest.raises(ValueError, match="select: criterion must be one of v_opt, .*, got 'D-opt'"):
        select(g, cameras, [], criterion="D-opt")
    with pytest.raises(ValueError, match="select: rng must be a torch.Generator that is kept between calls, got 3"):
        select(g, cameras, [], policy="random", rng=3)
    bad = {f"c{i}": {"means": torch.ones(3, 3).double()} for i in range(4)}
    for value, shown in ((math.nan, "nan"), (math.inf, "inf"), (-1.0, "-1"), (1e39, "inf")):
        bad["c2"]["means"][1, 2] = value
        for options in ({}, {"k": 2}, {"cache": Cache()}):
            with pytest.raises(ValueError, match=rf"select: candidate 0 \(c2\): .*, got {shown} in means at \(1, 2\)"):
                choose(bad, ("c0", "c1"), **options)
        with pytest.raises(ValueError, match=rf"select: training view 0 \(c2\): .*, got {shown} in means at \(1, 2\)"):
            choose(bad, ("c2",))
    bad["c2"] = {"means": torch.ones(2, 3).double()}
    with pytest.raises(ValueError, match=r"means must have the shape of train, \(3, 3\), got \(2, 3\)"):
        choose(bad, ("c0",), criterion="eig")
    with pytest.raises(ValueError, match="select: information must be of the same parameters in every view"):
        choose(bad, ("c0",))
    with pytest.raises(ValueError, match="select: information must be of the same parameters in every view"):
        choose(bad, ("c0", "c2"))


def test_scoring_is_its_fields():
    """Fields as keywords mean the `Scoring` made of them, None the default; never both, and no others."""
    cameras, pool = line(range(4)), random_pool(np.random.default_rng(2), 4)

    def run(**options):
        views = lambda camera: pool[camera.name]  # noqa: E731
        return select(scene(), cameras[1:], cameras[:1], 2, information=views, **options)

    options = {"criterion": "logdet", "prior": Prior(1e-2), "weights": {"means": 0.5}}
    assert run(**options).picks == run(scoring=Scoring(**options)).picks
    assert run(**options).picks != run().picks
    assert run(criterion=None, settings=None, prior=None, weights=None).picks == run().picks
    with pytest.raises(ValueError, match="select: criterion, prior, weights must be fields of scoring, got both"):
        run(scoring=Scoring(), **options)
    with pytest.raises(TypeError, match="unexpected keyword argument 'criterium'"):
        run(criterium="eig")
    for field in ("scoring", "prior", "settings", "weights", "groups"):
        with pytest.raises(ValueError, match=f"select: {field} must be a"):
            run(**{field: "logdet"})
    with pytest.raises(
        ValueError, match="select: method must be one of exact, columns, probes, fisherrf, got 'columnz'"
    ):
        Scoring(method="columnz")


def test_result_is_json(world):
    """Plain numbers all the way down, for every policy."""
    g, train, candidates, _ = world
    for policy in POLICIES:
        found = select(g, candidates, train, 2, policy)
        back = json.loads(json.dumps(dataclasses.asdict(found), allow_nan=False))
        assert [pick["name"] for pick in back["picks"]] == names(found)
        assert len(back["scores"]) == len(candidates)
        assert back["seconds"] > 0
        assert len({pick.index for pick in found.picks}) == 2
