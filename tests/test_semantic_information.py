"""What the feature image says about the geometry, against dense float64 Jacobians; moments along rays; bad input."""

from __future__ import annotations

import dataclasses
import itertools
import json

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from dense_jacobian import error
from scenes_random import assert_same_sums, gaussians
from test_select import ring

from drgs import cli, fisher, reference
from drgs.data.camera_lists import save_cameras_json
from drgs.files import load_state, save_ply
from drgs.fisher import SemanticMetric
from drgs.fitting.config import SelectionConfig
from drgs.information.maps import moments_map
from drgs.oracle import sh_colors
from drgs.select import CRITERIA, POLICIES, Cache, select
from drgs.settings import RenderSettings
from drgs.tracing.weights import Weights

Preset = RenderSettings.preset
COUPLED = ("means", "rotations", "log_scales", "logit_opacities")
# Rounding of float32 hits against float64, relative to the largest entry of a group; measured: 4e-7.
BOUND = 1e-5
ZERO = (0.0, 0.0, 0.0)


def metric(D: int, draw: int = 0, **fields) -> SemanticMetric:
    """Of a random decoder from D to D + 3 channels, gamma 0.7, exact unless said otherwise."""
    W = torch.randn(D + 3, D, generator=torch.Generator().manual_seed(draw), dtype=torch.float64)
    return SemanticMetric(W.T @ W, **{"weight": 0.7, "estimate": "exact", **fields})


def truth(g, out, m: SemanticMetric) -> tuple[dict, torch.Tensor]:
    """Diagonal and blocks of J^T J of y = [RGB; sqrt(gamma) W F], from the oracle's dense Jacobian."""
    J, F = dense.jacobian(g, out), dense.feature_jacobian(g, out)
    P, D = len(J["means"]) // 3, m.width
    rows = torch.cat([F["means"], F["rotations"], F["log_scales"], F["logit_opacities"][..., None]], -1)
    rows = rows.reshape(P, D, len(g), 10)
    coupled = m.weight * torch.einsum("pcni,cd,pdnj->nij", rows, m.matrix, rows)
    colors = dense.stacked(J)
    blocks = torch.einsum("pni,pnj->nij", colors, colors)
    blocks[:, :10, :10] += coupled
    diagonal = dense.squares(J)
    for name, place in zip(COUPLED, (slice(0, 3), slice(3, 6), slice(6, 9), 9), strict=True):
        diagonal[name] = diagonal[name] + coupled.diagonal(dim1=1, dim2=2)[:, place]
    return diagonal, blocks


@pytest.mark.every(4)
@pytest.mark.parametrize(
    ("response", "order", "D"),
    [
        ("peak", "ray", 1),
        *itertools.product(("peak", "integral"), ("ray", "center"), (3,)),
        ("ewa", "center", 3),
        ("peak", "center", 128),  # in eight traversals
        *(pytest.param(*kind, marks=pytest.mark.slow) for kind in (("integral", "ray", 128), ("peak", "ray", 512))),
    ],
)
def test_coupled_diagonal_and_blocks(response, order, D):
    """Squares of what geometry does to colors and decoded features, as every form of the information has them.

    Diagonal, blocks and columns are the dense Jacobian's; weighted by anything, the sum of the map is the diagonal's.
    """
    settings = Preset("exact", response=response, order=order, dilation=0.3 if response == "ewa" else 0.0)
    g, cam, out = dense.scene(np.random.default_rng(3), settings, K=4, D=D, n=6, size=(8, 6))
    m = metric(D)
    diagonal, blocks = truth(g, out, m)
    found = fisher.diagonal(g, cam, settings, semantics=m)
    assert set(found) == {*COUPLED, "sh", "features"}
    for name, x in diagonal.items():
        assert error(found[name], x) <= BOUND, name
    w2 = fisher.coverage(g, cam, settings)
    assert error(found["features"], 0.7 * m.matrix.diagonal().mean() * w2) <= BOUND
    scale = blocks.diagonal(dim1=1, dim2=2).amax(0).sqrt()
    error_of_blocks = (fisher.blocks(g, cam, settings, semantics=m) - blocks) / (scale[:, None] * scale)
    assert float(error_of_blocks.abs().max()) <= BOUND
    weights = {name: torch.rand(x.shape, dtype=torch.float64) for name, x in found.items()}
    total = float(fisher.variance_map(g, cam, weights, settings, semantics=m).double().sum())
    assert total == pytest.approx(sum(float((weights[n] * x).sum()) for n, x in found.items()), rel=1e-5)


@pytest.fixture(scope="module")
def seen():
    """A scene with three feature channels, a camera, and what they tell in the metric of a decoder."""
    settings = Preset("exact")
    g, cam, _ = dense.scene(np.random.default_rng(3), settings, K=4, D=3, n=6, size=(8, 6))
    g = g.detach()
    m = metric(3)
    return g, cam, settings, m, fisher.diagonal(g, cam, settings, semantics=m)


def test_columns_and_probes(seen):
    """Forward mode says the same; 64 random images the same on average, within 4 of their standard deviations."""
    g, cam, settings, m, found = seen
    columns = fisher.diagonal(g, cam, settings, "columns", semantics=m)
    probes = fisher.diagonal(g, cam, settings, "probes", probes=64, semantics=m)
    for name, x in found.items():
        assert error(columns[name], x) <= BOUND, name
        ratios = (probes[name] / x)[x > 1e-6 * x.max()]
        assert abs(float(ratios.mean()) - 1) < 4 * (2 / 64) ** 0.5, name


@pytest.mark.parametrize(("estimate", "samples"), [("collapsed", 1), ("principal", 2)])
def test_estimates_are_unbiased(seen, estimate, samples):
    """The mean over 40 draws of signs is the exact sum, within 4 standard errors of the measured spread."""
    g, cam, settings, m, exact = seen
    draws = []
    for seed in range(40):
        drawn = dataclasses.replace(m, estimate=estimate, samples=samples, seed=seed)
        again = fisher.diagonal(g, cam, settings, semantics=drawn, groups=COUPLED)
        draws.append(torch.stack([again[name].sum() for name in COUPLED]))
    draws = torch.stack(draws)
    want = torch.stack([exact[name].sum() for name in COUPLED])
    assert float(draws.std(0).min()) > 0
    assert ((draws.mean(0) - want).abs() <= 4 * draws.std(0) / len(draws) ** 0.5).all()


def test_channels():
    """Scalar channels: distances of features in the metric exactly, or from what K - 1 of them have exactly upwards.

    With as many channels as the decoder sees directions every estimate is exact. 1e-5: float32 channels.
    """
    f, m = torch.randn(40, 6, generator=torch.Generator().manual_seed(1)), metric(6)
    f[:, 2:] *= 0.1
    lengths = m.squares(f) / m.weight
    for estimate, K in itertools.product(("exact", "principal", "collapsed"), (3, 6, 9)):
        y = dataclasses.replace(m, estimate=estimate, samples=K).channels(f).double()
        assert y.shape == (40, 6 if estimate == "exact" else min(K, 6))
        if y.shape[1] == 6:
            torch.testing.assert_close(y.square().sum(1), lengths, rtol=1e-5, atol=0)
    strongest = dataclasses.replace(m, estimate="principal", samples=3).channels(f).double()[:, :2].square().sum(1)
    assert (strongest <= lengths * (1 + 1e-5)).all()
    white = f.double() @ m._factor
    two = torch.linalg.svdvals(white)[:2].square().sum()
    assert float(strongest.sum()) == pytest.approx(float(two), rel=1e-5)


def test_colors_only_make_no_metric(world, monkeypatch):
    """Scenes without features, and blocks without semantics, call no code of features."""
    g, train, candidates = world
    monkeypatch.setattr(SemanticMetric, "__post_init__", lambda self: pytest.fail("a metric was made"))
    monkeypatch.setattr(SemanticMetric, "channels", lambda self, features: pytest.fail("channels were made"))
    for criterion in ("eig", "block_logdet"):
        select(g.replace(features=None), candidates, train, criterion=criterion)
        select(g, candidates, train, criterion=criterion, blocks=("geometry",))


def test_the_pose_is_told_by_colors(seen, monkeypatch):
    """Of a scene with features the pose's information is that of its colors, and no feature image is made for it."""
    g, cam, settings, _, _ = seen
    want = fisher.pose_information(g.replace(features=None), cam, settings)
    monkeypatch.setattr(Weights, "__init__", lambda *arguments: pytest.fail("a feature image was made"))
    assert torch.equal(fisher.pose_information(g, cam, settings), want)


def test_blocks_of_the_image_add_up(seen):
    """Colors and features are rows of their own: what they tell adds up; scaled by c, a decoder tells c^2 as much."""
    g, cam, settings, m, both = seen
    colors = fisher.diagonal(g, cam, settings, groups=[*COUPLED, "sh"])
    features = fisher.diagonal(g, cam, settings, semantics=m, channel_weights=ZERO)
    doubled = dataclasses.replace(m, matrix=4 * m.matrix)
    again = fisher.diagonal(g, cam, settings, semantics=doubled, channel_weights=ZERO)
    for name, x in both.items():
        assert error(colors.get(name, 0) + features[name], x) <= BOUND, name
        assert error(again[name], 4 * features[name]) <= BOUND, name
    assert float(features["sh"].abs().max()) == 0


def test_shuffled_features(seen):
    """Features among other Gaussians: what is uncoupled stays to the bit, what is coupled changes by 10 % and more."""
    g, cam, settings, m, before = seen
    other = g.replace(features=g.features.roll(1, 0))
    uncoupled = [fisher.diagonal(x, cam, settings) for x in (g, other)]
    assert all(torch.equal(uncoupled[0][name], uncoupled[1][name]) for name in uncoupled[0])
    after = fisher.diagonal(other, cam, settings, semantics=m)
    assert torch.equal(before["features"], after["features"])
    assert torch.equal(before["sh"], after["sh"])
    for name in COUPLED:
        assert error(after[name], before[name]) > 0.1, name


@pytest.mark.parametrize("D", [3, 0])
def test_moments(D):
    """sum w f^2 - (sum w f)^2, w from a float64 render of one channel a Gaussian; colors where there are no features.

    Rounding of float32 images, relative to the largest second moment (measured: 1e-7).
    """
    rng = np.random.default_rng(0)
    settings, cam = Preset("exact", background=(0.3, 0.5, 0.7)), ring(rng, 1)[0]
    g = gaussians(rng, 12, 4, scale=0.25, D=D).detach()
    f = g.features.double() if D else sh_colors(g.sh.double(), g.means.double() - torch.from_numpy(cam.center))
    w = reference.render(g.replace(features=torch.eye(12)), cam, settings).features
    second = torch.einsum("hwn,nc->hwc", w, f.square())
    want = (second - torch.einsum("hwn,nc->hwc", w, f).square()).sum(-1)
    assert float((moments_map(g, cam, settings) - want).abs().max()) <= 1e-6 * float(second.sum(-1).max())


@pytest.fixture(scope="module")
def world():
    """12 Gaussians with three feature channels, two known views and four candidates."""
    rng = np.random.default_rng(0)
    cameras = ring(rng, 6)
    return gaussians(rng, 12, 4, scale=0.25, D=3).detach(), cameras[:2], cameras[2:]


def test_moments_rank_candidates(world):
    """The score is the mean of the map; known views do not matter; two picks are the two best, and a note says so."""
    g, train, candidates = world
    found = select(g, candidates, train, 2, "moments")
    maps = [moments_map(g, camera, Preset("exact")) for camera in candidates]
    assert found.scores == pytest.approx([float(x.double().mean()) for x in maps], rel=1e-12)
    order = sorted(range(4), key=lambda i: -found.scores[i])
    assert [pick.index for pick in found.picks] == order[:2]
    assert found.picks[1].margin == found.scores[order[1]] - found.scores[order[2]]
    assert "do not take each other into account" in found.notes[0]
    assert select(g, candidates, [], 1, "moments").scores == found.scores


def test_every_policy_takes_semantic_scenes(world):
    """All of them pick; those that know colors or poses only pick as without features."""
    g, train, candidates = world
    for policy in POLICIES:
        found = select(g, candidates, train, 2, policy)
        assert len(found.picks) == 2
        if policy not in ("fisher", "moments", "random"):
            plain = select(g.replace(features=None), candidates, train, 2, policy)
            assert found.scores == pytest.approx(plain.scores, rel=1e-6)
    for criterion in CRITERIA:
        behind = [] if criterion == "block_logdet" else ["backdrop"]
        assert select(g, candidates, train, 1, criterion=criterion).blocks == ["geometry", "semantic", *behind]


def test_blocks_that_are_scored(world):
    """Geometry alone is the score without features; all there is is the default; results name blocks and metric."""
    g, train, candidates = world
    m = metric(3, estimate="collapsed", samples=2, seed=7)
    scores = {}
    for blocks in (("geometry",), ("semantic",), ("semantic", "geometry")):
        found = select(g, candidates, train, blocks=blocks, semantics=m)
        scores[blocks] = found.scores
        assert found.blocks == [name for name in ("geometry", "semantic") if name in blocks]
        assert ("features" in found.parts[0], "sh" in found.parts[0]) == ("semantic" in blocks, "geometry" in blocks)
        told = {"estimate": "collapsed", "samples": 2, "seed": 7, "gamma": 0.7, "width": 3}
        assert found.semantics == (told if "semantic" in blocks else None)
    plain = select(g.replace(features=None), candidates, train, blocks=("geometry",))
    assert_same_sums(scores["geometry",], plain.scores)
    everything = select(g, candidates, train, blocks=("geometry", "semantic", "backdrop"), semantics=m)
    assert_same_sums(everything.scores, select(g, candidates, train, semantics=m).scores)
    latent = select(g, candidates, train).semantics
    assert latent["width"] == 3
    assert latent["gamma"] == 1


def test_the_cache_knows_the_metric(world):
    """Another metric is other information; an equal one, of another object, is the same."""
    g, train, candidates = world
    cache = Cache()
    count = len(train) + len(candidates)
    for m, computed in ((metric(3), count), (metric(3), 0), (metric(3, draw=1), count), (None, count)):
        assert select(g, candidates, train, cache=cache, semantics=m).computed == computed


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda g, c: select(g.replace(features=None), c, c, blocks=("semantic",)), "semantic for Gaussians without"),
        (
            lambda g, c: select(g, c, c, blocks=("color",)),
            "blocks must be among geometry, semantic, deformation, backdrop, got 'color",
        ),
        (lambda g, c: select(g, c, c, blocks=()), "blocks must be a tuple of one or more"),
        (lambda g, c: select(g, c, c, blocks=("geometry",), groups=("features",)), "groups must have one that blocks"),
        (lambda g, c: select(g, c, c, blocks=("semantic",), groups=["sh"]), "groups must have one that blocks"),
        (lambda g, c: select(g, c, c, blocks=("semantic",), method="fisherrf"), "select: blocks must be geometry with"),
        (
            lambda g, c: SelectionConfig().replace(blocks=("semantic",), method="fisherrf"),
            "active: blocks must be geometry with m",
        ),
        (lambda g, c: select(g, c, c, semantics=metric(4)), "must be of the width of the features, 3, got 4"),
        (lambda g, c: fisher.blocks(g, c, semantics=metric(4)), "fisher.blocks: semantics must be of the width"),
        (lambda g, c: fisher.variance_map(g, c[0], {}, semantics=metric(4)), "fisher.variance_map: semantics must be"),
        (lambda g, c: fisher.diagonal(g.replace(features=None), c, semantics=metric(3)), "a scene with features"),
        (lambda g, c: fisher.diagonal(g, c, method="fisherrf", semantics=metric(3)), "it is about colors only"),
        (lambda g, c: SemanticMetric(torch.ones(2, 3)), r"matrix must be \(D, D\)"),
        (lambda g, c: SemanticMetric(torch.tensor([[1.0, 2.0], [0.0, 1.0]])), "must be symmetric"),
        (lambda g, c: SemanticMetric(-torch.eye(2)), "positive semidefinite, got an eigenvalue of -1"),
        (lambda g, c: SemanticMetric(torch.eye(2) / 0), "matrix must be finite"),
        (lambda g, c: SemanticMetric(torch.eye(2), weight=0), "weight must be a finite number > 0"),
        (lambda g, c: SemanticMetric(torch.eye(2), estimate="guess"), "estimate must be"),
        (lambda g, c: SemanticMetric(torch.eye(2), samples=0), "samples must be a whole number >= 1"),
    ],
)
def test_bad_input(world, call, message):
    """One line that says what must hold."""
    g, _, candidates = world
    with pytest.raises(ValueError, match=message) as caught:
        call(g, candidates)
    assert "\n" not in str(caught.value)


def test_a_decoder_that_sees_nothing(seen):
    """W = 0: features tell nothing, colors what they always do."""
    g, cam, settings, _, _ = seen
    blind = SemanticMetric(torch.zeros(3, 3))
    found, colors = fisher.diagonal(g, cam, settings, semantics=blind), fisher.diagonal(g, cam, settings)
    assert all(torch.equal(found[name], colors[name]) for name in COUPLED)
    assert float(found["features"].abs().max()) == 0


@pytest.fixture(scope="module")
def folder(world, tmp_path_factory):
    """`scene.ply` with features, `plain.ply` without, `cameras.json`."""
    g, train, candidates = world
    path = tmp_path_factory.mktemp("semantic")
    save_ply(g, path / "scene.ply")
    save_ply(g.replace(features=None), path / "plain.ply")
    save_cameras_json(path / "train.json", train)
    save_cameras_json(path / "cameras.json", candidates)
    return path


def test_maps_of_blocks(folder, monkeypatch, capsys):
    """`drgs fisher`: the maps of both blocks add up to the scores, each has a file of its own, tables name both.

    1e-4: sums of float32 maps against float64 sums over parameters (measured: 1e-7).
    """
    monkeypatch.chdir(folder)
    line = "fisher scene.ply --train train.json --cameras cameras.json --limit 1 -o out --blocks geometry,semantic"
    assert cli.main(line.split()) == 0
    report, text = json.loads((folder / "out/fisher.json").read_text()), capsys.readouterr().out
    assert report["blocks"] == ["geometry", "semantic"]
    assert (report["semantics"]["estimate"], report["semantics"]["gamma"]) == ("principal", 1.0)
    assert "geometry %" in text
    assert "eig: semantic %" in text
    (row,) = report["views"]
    for kind, criterion in (("variance", "eig"), ("share", "logdet")):
        parts = [row["blocks"][block][kind]["sum"] for block in report["blocks"]]
        assert min(parts) > 0
        assert sum(parts) == pytest.approx(row["gain"][criterion], rel=1e-4)
        for name in ("", "geometry.", "semantic."):
            assert f"{row['name']}.{name}{kind}.png" in row["files"]
    tensors, header = load_state(folder / "out/information.safetensors")
    assert header["blocks"] == report["blocks"]
    for name, x in tensors.items():
        assert sum(report["groups"][name]["blocks"].values()) == pytest.approx(float(x.sum()), rel=1e-9)
    assert report["groups"]["sh"]["blocks"]["semantic"] == report["groups"]["features"]["blocks"]["geometry"] == 0


def test_select_names_blocks(folder, monkeypatch, capsys):
    """`drgs select`: blocks, estimate and gamma are in the report; a scene without features has no semantic block."""
    monkeypatch.chdir(folder)
    line = "select scene.ply --train train.json --candidates cameras.json"
    for option, blocks in (("", ["geometry", "semantic", "backdrop"]), (" --blocks semantic", ["semantic"])):
        assert cli.main((line + option + " -o picks.json").split()) == 0
        report = json.loads((folder / "picks.json").read_text())
        assert report["blocks"] == blocks
        assert (report["semantics"]["estimate"], report["semantics"]["gamma"]) == ("principal", 1.0)
    capsys.readouterr()
    for bad, message in (
        ("plain.ply --blocks geometry,semantic", "got semantic for Gaussians without features"),
        ("scene.ply --blocks colors", "blocks must be among geometry, semantic, deformation, backdrop, got 'colors"),
    ):
        for command, other in (("select", "--candidates cameras.json -o no.json"), ("fisher", "-o no")):
            assert cli.main(f"{command} {bad} --train train.json {other}".split()) == 2
            error = capsys.readouterr().err
            assert message in error
            assert error.count("\n") == 1
            assert not (folder / "no").exists()
