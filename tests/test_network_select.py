"""Choosing views by what they tell about a deformation: alone, beside other blocks, over cameras and times."""

import dataclasses

import numpy as np
import pytest
import torch
from scenes_random import assert_same_sums, camera, gaussians
from test_network_information import swarm

import drgs.information.quantity
from drgs import fisher
from drgs.ellipsoids import DeformableScene
from drgs.fitting.config import SelectionConfig
from drgs.gain import Prior, information_gain
from drgs.information.blocks import SceneBlocks
from drgs.information.diagonal import Diagonal
from drgs.information.network import NetworkInformation
from drgs.information.quantity import ViewContext, once_per_time
from drgs.information.replay import Replay
from drgs.select import POLICIES, Cache, Scoring, select
from drgs.selection.combine import joint_and_combination
from drgs.settings import RenderSettings

FAST = RenderSettings.preset("fast")
K = 2  # probes


@pytest.fixture(scope="module")
def views():
    """A scene that moves, and views of three cameras at three times each."""
    rng = np.random.default_rng(4)
    scene = swarm(gaussians(rng, 8, 1).detach())
    found = []
    for number in range(3):
        cam = camera(rng, (16, 16))
        for t in (0.0, 0.5, 1.0):
            name = f"cam{number:02d}/{round(2 * t):04d}"
            found.append(dataclasses.replace(cam, time=t, name=name, w2c=cam.w2c.detach()))
    return scene, found


def pick(scene, candidates, train, k=1, cache=None, rng=None, policy="fisher", **fields):
    return select(scene, candidates, train, k, policy, cache=cache, rng=rng, settings=FAST, probes=K, **fields)


@pytest.fixture(scope="module")
def cache():
    """One for all tests: the scene stays what it is."""
    return Cache()


def test_ratio_joins_the_groups(views, cache):
    """A field's groups are scored like all others, by default, too, and their parts are logged beside them."""
    scene, cams = views
    train, candidates = cams[:1], cams[2:5]
    assert pick(scene, candidates, train, cache=cache).blocks == ["geometry", "deformation", "backdrop"]
    told_by = {"blocks": ("geometry", "deformation"), "criterion": "eig"}
    found = pick(scene, candidates, train, cache=cache, **told_by)
    assert found.blocks == ["geometry", "deformation"]
    assert found.network == {"score": "ratio", "probes": K}
    assert found.combine == "sum"
    assert any("use --probes 8 or more" in note for note in found.notes)
    told = [fisher.network(scene, cam, FAST, probes=K) for cam in (*train, *candidates)]
    still = [fisher.diagonal(scene.at(cam.time), cam, FAST) for cam in (*train, *candidates)]
    for i, parts in enumerate(found.parts, 1):
        assert list(parts) == ["means", "rotations", "log_scales", "logit_opacities", "sh", "grid", "mlp"]
        want = information_gain(told[i], told[0], "eig").parts | information_gain(still[i], still[0], "eig").parts
        for name, x in parts.items():
            assert x == pytest.approx(want[name], rel=1e-4), name  # information is kept in float32
        assert found.scores[i - 1] == pytest.approx(sum(parts.values()))
    alone = pick(scene, candidates, train, cache=cache, blocks=("deformation",), criterion="eig")
    assert [list(x) for x in alone.parts] == [["grid", "mlp"]] * 3
    assert [x["mlp"] for x in alone.parts] == pytest.approx([x["mlp"] for x in found.parts], rel=1e-6)
    without = pick(scene, candidates, train, cache=cache, blocks=("geometry",))
    assert without.network is None
    assert "grid" not in without.parts[0]


def test_weights_lambda_and_groups_of_a_field(views, cache):
    """They go by the groups' names; lambda = 0 leaves out weights that no known view tells about."""
    scene, cams = views
    run = lambda **fields: pick(scene, cams[2:5], cams[:1], cache=cache, criterion="eig", **fields)  # noqa: E731
    plain = run(blocks=("deformation",))
    weighed = run(blocks=("deformation",), weights={"grid": 0.0, "mlp": 2.0})
    assert [x["mlp"] for x in weighed.parts] == [2 * x["mlp"] for x in plain.parts]
    assert all(x["grid"] == 0 for x in weighed.parts)
    firm = run(blocks=("deformation",), prior=Prior(1e-6, groups={"mlp": 1e3}))
    assert all(a["mlp"] < b["mlp"] and a["grid"] == b["grid"] for a, b in zip(firm.parts, plain.parts, strict=True))
    none = run(blocks=("deformation",), prior=Prior(0.0))
    assert none.left_out["grid"] > 0  # cells of other times
    assert any("lambda = 0" in note for note in none.notes)
    assert list(run(groups=("means", "mlp")).parts[0]) == ["means", "mlp"]
    assert list(run(groups=("grid",)).parts[0]) == ["grid"]
    with pytest.raises(ValueError, match="groups must have one that blocks deformation have information about, got sh"):
        run(groups=("sh",), blocks=("deformation",))


def test_greedy_over_pairs_of_camera_and_time(views, cache):
    """k picks at once are k calls in a row, lazily or not; two times at one pose are different candidates."""
    scene, cams = views
    train, left, picked = cams[:1], cams[1:], []
    at_once = pick(scene, left, train, 3, cache=cache, blocks=("deformation",))
    for _ in range(3):
        one = pick(scene, left, [*train, *picked], cache=cache, blocks=("deformation",)).picks[0]
        picked.append(left.pop(one.index))
        assert one.name == at_once.picks[len(picked) - 1].name
    scores = pick(scene, cams[1:], train, cache=cache, blocks=("deformation",)).scores
    assert len(set(scores)) == len(scores)
    assert cache.misses < cache.hits


@pytest.mark.same_bits
@pytest.mark.parametrize("preset", ["fast", "exact"])
@pytest.mark.parametrize("masked", [False, True])
def test_one_traversal_for_geometry_and_deformation(views, monkeypatch, preset, masked):
    """What the walk for the geometry sums up beside is what each says alone; the diagonal has the same bits."""
    scene, cams = views
    settings = RenderSettings.preset(preset)
    mask = torch.linspace(0, 1, 256).reshape(16, 16) if masked else None
    blocks = SceneBlocks.of(scene, Scoring(settings=settings, probes=K), cams)
    replays = []
    plain = Replay.__init__
    monkeypatch.setattr(Replay, "__init__", lambda *a, **o: (replays.append(a), plain(*a, **o))[1])
    found = joint_and_combination(blocks)[0].compute(ViewContext(scene, cams[4], settings, mask))
    assert len(replays) == 1
    masks = None if mask is None else [mask]
    want = fisher.network(scene, cams[4], settings, probes=K, masks=masks)
    for group, x in want.items():
        torch.testing.assert_close(found[group], x.float(), rtol=1e-4, atol=1e-5 * float(x.max()))
    for group, x in fisher.diagonal(scene.at(0.5), cams[4], settings, masks=masks).items():
        assert torch.equal(found[group], x.float())


def test_a_time_is_computed_once(views, monkeypatch):
    """In one call, whatever is asked and in whatever order; never across calls, between which weights may change."""
    scene, cams = views
    times = []
    plain = type(scene).at
    monkeypatch.setattr(type(scene), "at", lambda self, time: (times.append(time), plain(self, time))[1])
    first = pick(scene, cams[1:7], cams[:1])
    assert sorted(set(times)) == [0.0, 0.5, 1.0]
    assert len(times) <= 4  # one more as it is found out which blocks there are
    with torch.no_grad():
        scene.field.mlp["means"][3].bias += 0.05
    changed = pick(scene, cams[1:7], cams[:1])
    fresh = swarm(scene.gaussians)
    fresh.field.load_state_dict(scene.field.state_dict())
    again = pick(fresh, cams[1:7], cams[:1])
    with torch.no_grad():
        scene.field.mlp["means"][3].bias -= 0.05
    assert_same_sums(changed.scores, again.scores)
    assert changed.scores != first.scores


def test_what_is_computed_once_is_the_scene(views, monkeypatch):
    """With its parameters and what else it has; few times are held where each takes much."""
    scene, _ = views
    once = once_per_time(scene)
    assert once_per_time(once) is once
    assert isinstance(once, DeformableScene)
    assert once.parameters().keys() == scene.parameters().keys()
    assert torch.equal(once.moving, scene.moving)
    assert once.at(0.5) is once.at(0.5)
    assert not any(x.requires_grad for x in once.at(0.5).parameters().values())
    monkeypatch.setattr(drgs.information.quantity, "_TIMES_BYTES", 0)
    seen = once.at(0.5)
    assert once.at(1.0) is not seen
    assert once.at(0.5) is not seen
    assert torch.equal(once.at(0.5).means, seen.means)
    assert once_per_time(scene.gaussians) is scene.gaussians


@pytest.mark.parametrize("network", ["trace", "paper"])
def test_a_trace_needs_nothing_known(views, cache, network):
    """The paper's scores: of a candidate alone, whatever the known views and lambda are; k picks are the k best."""
    scene, cams = views
    options = {"cache": cache, "blocks": ("deformation",), "network": network}
    found = pick(scene, cams[1:4], cams[:1], 2, **options)
    for cam, score, parts in zip(cams[1:4], found.scores, found.parts, strict=True):
        want = fisher.network(scene, cam, FAST, estimate=network, probes=K)
        assert parts == pytest.approx({name: float(x) for name, x in want.items()}, rel=1e-5)
        assert score == pytest.approx(sum(parts.values()))
    again = pick(scene, cams[1:4], [], 2, prior=Prior(0.0), **options)
    assert again.scores == found.scores
    assert sorted(found.scores)[-2:] == [x.score for x in reversed(found.picks)]


@pytest.mark.parametrize("blocks", [("deformation",), ("geometry", "deformation")])
def test_a_trace_is_not_computed_of_known_views(views, monkeypatch, blocks):
    """Probes of the network are pulled back at the candidates alone; other blocks ask known views as ever."""
    scene, cams = views
    computed = {Diagonal: [], NetworkInformation: []}
    for kind in computed:

        def spy(self, view, plain=kind.compute):
            computed[type(self)].append(view.camera.name)
            return plain(self, view)

        monkeypatch.setattr(kind, "compute", spy)
    pick(scene, cams[2:4], cams[:2], 2, blocks=blocks, network="trace")
    assert computed[NetworkInformation] == [x.name for x in cams[2:4]]
    assert computed[Diagonal] == ([x.name for x in cams[:4]] if "geometry" in blocks else [])
    computed[NetworkInformation].clear()
    pick(scene, cams[2:4], cams[:2], 2, blocks=blocks)  # a ratio needs what is known
    assert computed[NetworkInformation] == [x.name for x in cams[:4]]


@pytest.mark.parametrize("network", ["ratio", "trace"])
def test_zscores_over_the_candidates(views, cache, network):
    """Each block is scored by its own information, less the mean over the standard deviation of the candidates."""
    scene, cams = views
    run = lambda **fields: pick(scene, cams[1:5], cams[:1], cache=cache, criterion="eig", **fields)  # noqa: E731
    fields = {"blocks": ("geometry", "deformation")}
    fields |= {} if network == "trace" else {"combine": "zscore"}  # with a trace it is the default
    found = run(network=network, k=2, **fields)
    assert found.combine == "zscore"
    assert any("z-scores of geometry, deformation" in note for note in found.notes)
    total = np.zeros(4)
    for block in ("geometry", "deformation"):
        scores = np.array(run(blocks=(block,), network=network).scores)
        z = (scores - scores.mean()) / scores.std()
        own = [sum(x for name, x in parts.items() if name.startswith(f"{block}.")) for parts in found.parts]
        assert own == pytest.approx(z, rel=1e-6, abs=1e-9)
        total += z
    assert found.scores == pytest.approx(total, abs=1e-9)
    assert found.picks[0].index == int(np.argmax(found.scores))
    # The second pick is by z-scores of those that are left, against what is known then.
    left = [i for i in range(4) if i != found.picks[0].index]
    known = [cams[0], cams[1 + found.picks[0].index]]
    after = pick(scene, [cams[1 + i] for i in left], known, cache=cache, criterion="eig", network=network, **fields)
    assert found.picks[1].index == left[after.picks[0].index]
    assert found.picks[1].score == pytest.approx(after.picks[0].score, rel=1e-6)


def test_constant_blocks_count_nothing(views, cache):
    """A block that is the same for all candidates has no z-score, and one candidate alone has none."""
    scene, cams = views
    found = pick(scene, [cams[2], cams[2]], cams[:1], cache=cache, combine="zscore")
    assert found.scores == [0, 0]
    assert any("all 2 candidates have the same score in each block" in note for note in found.notes)
    assert pick(scene, [cams[2]], cams[:1], cache=cache, combine="zscore").scores == [0]


def test_a_field_that_is_silent_is_noted(views):
    """Where no view tells about a group, a note says so; it is no silent 0."""
    scene, cams = views
    start = swarm(scene.gaussians, std=0.0)
    found = pick(start, cams[1:3], cams[:1], blocks=("deformation",))
    assert any(note.startswith("deformation: no view informs grid,") for note in found.notes)
    assert not any("informs mlp" in note for note in found.notes)
    nobody = swarm(scene.gaussians, motion=torch.full((8,), -1.0))
    found = pick(nobody, cams[1:3], cams[:1], blocks=("deformation",))
    assert sum(note.startswith("deformation: no view informs") for note in found.notes) == 2
    assert any(note.startswith("every score is 0") for note in found.notes)


def test_rows_of_the_image_are_those_of_the_other_blocks():
    """Features tell about the field where `semantic` is a block, colors where `geometry` is, or neither."""
    rng = np.random.default_rng(4)
    g, cam = gaussians(rng, 8, 1).detach(), camera(rng, (16, 16))
    scene = swarm(g.replace(features=torch.randn(8, 4)))
    cams = [dataclasses.replace(cam, time=t, w2c=cam.w2c.detach()) for t in (0.0, 1.0)]
    score = lambda *blocks: Scoring(blocks=blocks, network="trace")  # noqa: E731
    parts_of = lambda *blocks: joint_and_combination(SceneBlocks.of(scene, score(*blocks), cams))[0].parts  # noqa: E731
    told = {}
    for blocks in (("deformation",), ("geometry", "deformation"), ("semantic", "deformation")):
        quantity = parts_of(*blocks)[-1][1]
        assert isinstance(quantity, NetworkInformation)
        told[blocks[0]] = sum(float(x) for x in quantity.compute(ViewContext(scene, cams[1], FAST)).values())
    both = parts_of("geometry", "semantic", "deformation")
    assert [block for block, _ in both] == ["geometry", "semantic", "deformation"]
    assert told["deformation"] == told["geometry"]
    assert told["semantic"] != told["geometry"]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"blocks": ("deformation",), "method": "fisherrf"}, "blocks must be geometry with method fisherrf, got defor"),
        ({"blocks": ("deformation",), "criterion": "block_logdet"}, "with criterion block_logdet, got deformation"),
        (
            {"blocks": ("geometry", "deformation"), "network": "trace", "combine": "sum"},
            "combine must be zscore with network trace beside other blocks, got sum",
        ),
        (
            {"network": "trace", "combine": "sum"},
            "combine must be zscore with network trace beside other blocks, got sum",
        ),
        ({"network": "hessian"}, "network must be one of ratio, trace, paper, got 'hessian'"),
        ({"combine": "rank"}, "combine must be one of sum, zscore, got 'rank'"),
        ({"probes": 0}, "probes must be a whole number >= 1, got 0"),
    ],
)
def test_refusals(fields, message):
    """In one line, and of a fit before its first step."""
    with pytest.raises(ValueError, match=f"^select: .*{message}"):
        Scoring(**fields)
    with pytest.raises(ValueError, match=rf"^active: .*{message.split(', got')[0].replace('>= 1', '.*')}"):
        SelectionConfig().replace(**fields)


def test_still_scenes_have_no_such_block(views):
    """Gaussians alone are not deformed by anything."""
    scene, cams = views
    with pytest.raises(
        ValueError, match="select: blocks must be of what the scene has, got deformation for a scene th"
    ):
        pick(scene.gaussians, cams[1:3], cams[:1], blocks=("deformation",))
    assert pick(scene.gaussians, cams[1:3], cams[:1]).blocks == ["geometry", "backdrop"]


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_policies_know_cameras_and_times(views, cache, policy):
    """Each can choose among pairs of camera and time; those that look at the scene see it as it is then."""
    scene, cams = views
    found = pick(scene, cams[1:], cams[:1], 2, cache=cache, policy=policy, rng=torch.Generator().manual_seed(0))
    assert len({x.index for x in found.picks}) == 2
    assert len(found.scores) == 8
    if policy in ("fisher", "fisherrf", "coverage", "moments"):
        assert found.scores[0] != found.scores[1]  # one pose at two times
