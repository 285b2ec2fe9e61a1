"""Unknowns of a view itself, eliminated from what it tells: against float64 projections of the oracle's Jacobian."""

from __future__ import annotations

import dataclasses
import json
import math

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from dense_jacobian import GROUPS
from scenes_random import camera, gaussians
from test_network_information import TIME, drawn
from test_network_information import dense as network_jacobian

from drgs import cli, fisher, reference
from drgs.data.camera_lists import save_cameras_json
from drgs.files import CONFIG_SCHEMA, Run, load_state, save_ply
from drgs.fisher import Nuisances
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.fitting.records import fit_record
from drgs.gain import Prior, block_gain
from drgs.information.complement import Eliminated, remaining
from drgs.information.scoring import Scoring
from drgs.information.semantics import SemanticMetric
from drgs.lab.accuracy import twist_basis
from drgs.select import Cache, select
from drgs.settings import RenderSettings

EXACT = RenderSettings.preset("exact")
BOTH = ("exposure", "pose")
KINDS = {
    "tiles": {},
    "bvh": {"traversal": "bvh"},
    "ewa": {"response": "ewa", "order": "center", "dilation": 0.3},
    "along rays": {"sh_direction": "ray"},
}
BOUND = 1e-5  # of the largest entry of a group before anything is taken; measured: 4e-7


def exposure_columns(image):
    """(3 P, 3) derivatives of (P, 3) colors by three log gains."""
    return torch.diag_embed(image.detach().reshape(-1, 3)).reshape(-1, 3)


def pose_rows(rows, cam):
    """(rows, 6) derivatives of any rows of the oracle by the world-frame twist."""
    flat = rows.reshape(-1)
    (found,) = torch.autograd.grad(flat, cam.w2c, torch.eye(len(flat), dtype=flat.dtype), True, is_grads_batched=True)
    return torch.einsum("pij,kij->pk", found, -cam.w2c.detach() @ twist_basis())


def projected(J, N, P=None):
    """(rows, ...) W^(1/2) J by a plain float64 inverse of W^-1 = 1 + N P^-1 N^T, or a projection where P is None."""
    flat = J.reshape(len(N), -1)
    if P is None:
        Q = torch.linalg.svd(N, full_matrices=False)[0]
        return (flat - Q @ (Q.T @ flat)).reshape(J.shape)
    values, vectors = torch.linalg.eigh(torch.eye(len(N), dtype=torch.float64) + N @ torch.diag(1 / P) @ N.T)
    return ((vectors / values.sqrt()) @ (vectors.T @ flat)).reshape(J.shape)


def check(found, J, N, whole, P=None):
    """Diagonals of each group against J^T W J."""
    for name, x in found.items():
        truth = projected(J[name], N, P).square().sum(0)
        assert float((x - truth).abs().max()) <= BOUND * float(whole[name].max()), name


@pytest.mark.every(3)
@pytest.mark.parametrize("kind", KINDS)
def test_diagonal_blocks_and_columns(kind, rng):
    """J^T J - J^T N (N^T N)^-1 N^T J of the oracle, N of both unknowns, within a soft mask and weighted channels."""
    settings = EXACT.replace(background=(0.2, 0.5, 0.7), **KINDS[kind])
    g, cam, out = dense.scene(rng, settings, K=4)
    mask = torch.from_numpy(rng.uniform(-1, 2, (cam.height, cam.width))).float().clamp(0, 1)
    weights = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    factor = (mask.double().reshape(-1, 1) * weights.sqrt()).reshape(-1)
    J = {name: x * factor.reshape(-1, *[1] * (x.ndim - 1)) for name, x in dense.jacobian(g, out).items()}
    N = torch.cat([exposure_columns(out.rgb), dense.pose_jacobian(cam, out)], 1) * factor[:, None]
    ask = {"channel_weights": tuple(weights.tolist()), "masks": [mask]}
    whole = fisher.diagonal(g, cam, settings, **ask)
    found = fisher.diagonal(g, cam, settings, nuisances=Nuisances(eliminate=BOTH), **ask)
    assert tuple(found) == GROUPS
    check(found, J, N, whole)
    assert all(bool((found[name] <= whole[name]).all()) for name in GROUPS)
    rows = projected(dense.stacked(J), N)
    truth = torch.einsum("pni,pnj->nij", rows, rows)
    scale = fisher.blocks(g, cam, settings, **ask).diagonal(dim1=1, dim2=2).amax(0).sqrt().clamp_min(1e-12)
    blocks = fisher.blocks(g, cam, settings, nuisances=Nuisances(eliminate=BOTH), **ask)
    assert float(((blocks - truth) / (scale[:, None] * scale)).abs().max()) <= BOUND
    if kind == "tiles":
        columns = fisher.diagonal(
            g, cam, settings, "columns", groups=["means", "sh"], nuisances=Nuisances(eliminate=BOTH), **ask
        )
        check(columns, J, N, whole)


@pytest.mark.parametrize("names", [("exposure",), BOTH])
def test_what_is_known_before(names, rng):
    """With standard deviations known before, P is their inverse squares: of log gains, of the rotation about the
    camera's center, of its place."""
    g, cam, out = dense.scene(rng, EXACT, K=1)
    J, columns, P = dense.jacobian(g, out), [], []
    if "exposure" in names:
        columns.append(exposure_columns(out.rgb))
        P += [0.1**-2] * 3
    if "pose" in names:
        about = np.cross(cam.center, np.eye(3))  # a rotation about the center is one about the origin and this shift
        turned = torch.from_numpy(np.concatenate([np.eye(3), about], 1))
        basis = torch.cat([turned, torch.eye(6, dtype=torch.float64)[3:]])
        columns.append(dense.pose_jacobian(cam, out) @ basis.T)
        P += [0.02**-2] * 3 + [0.05**-2] * 3
    nuisances = Nuisances(eliminate=names, exposure_std=0.1, pose_std=(0.02, 0.05))
    whole, found = fisher.diagonal(g, cam), fisher.diagonal(g, cam, nuisances=nuisances)
    check(found, J, torch.cat(columns, 1), whole, torch.tensor(P, dtype=torch.float64))
    nothing = fisher.diagonal(g, cam, nuisances=Nuisances(eliminate=names))
    assert float((found["means"] - nothing["means"]).max()) > 1e-3 * float(whole["means"].max())


@pytest.mark.same_bits
def test_known_for_certain_has_the_old_bits(rng):
    """As P goes to infinity nothing is taken, to the last bit; so it is where no unknown is named."""
    g, cam = gaussians(rng, 8, 4, scale=0.25).detach(), camera(rng, (12, 10))
    certain = Nuisances(eliminate=BOTH, exposure_std=1e-9, pose_std=(1e-9, 1e-9))
    whole, blocks, behind = fisher.diagonal(g, cam), fisher.blocks(g, cam), fisher.backdrop(g, cam)
    for nuisances in (certain, Nuisances(), Nuisances(eliminate=())):
        found = fisher.diagonal(g, cam, nuisances=nuisances)
        assert all(torch.equal(found[name], whole[name]) for name in GROUPS)
        assert torch.equal(fisher.blocks(g, cam, nuisances=nuisances), blocks)
        assert torch.equal(fisher.backdrop(g, cam, nuisances=nuisances), behind)


def test_schur_identity(rng):
    """The scene's part of the inverse of the joint information is the inverse of what is left of the scene's own."""
    J, N = (torch.from_numpy(rng.normal(size=(60, n))) for n in (7, 4))
    P = torch.tensor([0.0, 3.0, 0.0, 1e4], dtype=torch.float64)
    joint = torch.cat([J, N], 1)
    information = joint.T @ joint
    information[7:, 7:] += torch.diag(P)
    rows = Eliminated.spanned(N.reshape(20, 3, 4), P).root(J.T.reshape(7, 20, 3)).reshape(7, 60)
    torch.testing.assert_close(torch.linalg.inv(rows @ rows.T), torch.linalg.inv(information)[:7, :7])


def test_joint_information_of_a_scene(rng):
    """The same of a rendered scene, block by block of a single Gaussian: blocks are the Schur complement of the joint
    information about its 13 parameters and the exposure."""
    g, cam = gaussians(rng, 1, 1, scale=0.25, spread=0.0), camera(rng, (12, 10))
    out = reference.render(g, cam, EXACT)
    rows = torch.cat([dense.stacked(dense.jacobian(g, out))[:, 0], exposure_columns(out.rgb)], 1)
    joint = rows.T @ rows
    ridge = torch.eye(13, dtype=torch.float64) * 1e-2 * float(joint.diagonal()[:13].max())  # as lambda is
    joint[:13, :13] += ridge
    found = fisher.blocks(g, cam, nuisances=Nuisances(eliminate=("exposure",)))[0] + ridge
    truth = torch.linalg.inv(joint)[:13, :13]
    assert float((torch.linalg.inv(found) - truth).abs().max()) <= 1e-4 * float(truth.abs().max())


def test_a_view_that_only_tells_its_exposure_tells_nothing(rng):
    """One Gaussian before black: its color changes the image as a gain does. Of one pixel, gains explain everything."""
    g = gaussians(rng, 1, 1, scale=0.3, spread=0.0).detach()
    cam = camera(rng, (12, 10))
    whole = fisher.diagonal(g, cam)
    found = fisher.diagonal(g, cam, nuisances=Nuisances(eliminate=("exposure",)))
    assert float(whole["sh"].max()) > 0
    assert not found["sh"].any()
    assert float(found["means"].min()) > 0  # its shape is no gain
    one = dataclasses.replace(cam, width=1, height=1, K=np.array([[20.0, 0, 0.5], [0, 20.0, 0.5], [0, 0, 1]]))
    assert float(fisher.diagonal(g, one)["logit_opacities"].max()) > 0
    for x in fisher.diagonal(g, one, nuisances=Nuisances(eliminate=BOTH)).values():
        assert not x.any()


def test_where_unknowns_change_nothing(rng):
    """A black view has no exposure; a sphere does not show how the camera turned about it: never NaN or below 0."""
    g, cam = gaussians(rng, 1, 1, scale=0.3, spread=0.0).detach(), camera(rng, (12, 10))
    black = g.replace(sh=torch.full_like(g.sh, -10.0))
    exposure, whole = Nuisances(eliminate=("exposure",)), fisher.diagonal(black, cam)
    found = fisher.diagonal(black, cam, nuisances=exposure)
    assert all(torch.equal(found[name], whole[name]) for name in GROUPS)
    sphere = g.replace(log_scales=torch.full_like(g.log_scales, -1.0))
    out = reference.render(sphere, cam, EXACT)
    N = dense.pose_jacobian(cam, out).detach()
    assert int(torch.linalg.matrix_rank(N, rtol=1e-6)) == 3
    for leaf in sphere.parameters().values():
        leaf.requires_grad_()
    J = dense.jacobian(sphere, reference.render(sphere, cam, EXACT))
    U = torch.linalg.svd(N, full_matrices=False)[0][:, :3]
    told, found = fisher.diagonal(sphere, cam), fisher.diagonal(sphere, cam, nuisances=Nuisances(eliminate=("pose",)))
    for name in GROUPS:
        flat = J[name].reshape(len(N), -1)
        truth = (flat - U @ (U.T @ flat)).square().sum(0).reshape(found[name].shape)
        assert float((found[name] - truth).abs().max()) <= BOUND * max(float(told[name].max()), 1e-12), name
    none = g.replace(**{name: x[:0] for name, x in g.parameters().items()})
    empty = fisher.diagonal(none, cam, nuisances=Nuisances(eliminate=BOTH))
    assert all(x.numel() == 0 for x in empty.values())


def test_far_from_the_origin(rng):
    """What is left does not depend on where the world's origin is, about which twists turn: 1,000 units away, of
    float64 means, it is the same."""
    g, cam = gaussians(rng, 8, 1, scale=0.25).detach(), camera(rng, (12, 10))
    cam = dataclasses.replace(cam, w2c=cam.w2c.detach().double())
    pose = Nuisances(eliminate=("pose",))
    near = fisher.diagonal(g.replace(means=g.means.double()), cam, nuisances=pose)
    shift = torch.tensor([1000.0, -2000.0, 500.0], dtype=torch.float64)
    w2c = cam.w2c.clone()
    w2c[:3, 3] -= w2c[:3, :3] @ shift
    there = fisher.diagonal(
        g.replace(means=g.means.double() + shift), dataclasses.replace(cam, w2c=w2c), nuisances=pose
    )
    for name in GROUPS:
        assert float((near[name] - there[name]).abs().max()) <= 1e-4 * float(near[name].max())


@pytest.mark.every(2)
@pytest.mark.parametrize("method", ["exact", "columns", "probes"])
def test_features(method, rng):
    """Decoded features are rows that a pose moves and an exposure does not; what they tell about themselves and about
    the geometry is what is left of both."""
    g, cam = gaussians(rng, 5, 1, D=3, scale=0.3), camera(rng, (8, 7))
    out = reference.render(g, cam, EXACT)
    W = torch.randn(4, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    metric = SemanticMetric(W.T @ W, weight=0.7, estimate="exact")
    decode = 0.7**0.5 * W
    pixels = cam.width * cam.height
    J, F = dense.jacobian(g, out), dense.feature_jacobian(g, out)
    features = out.features @ decode.T
    N = torch.cat([torch.cat([exposure_columns(out.rgb), dense.pose_jacobian(cam, out)], 1),
                   torch.cat([torch.zeros(pixels * 4, 3), pose_rows(features, cam)], 1)])  # fmt: skip
    decoded = lambda x: torch.einsum("ed,pd...->pe...", decode, x.reshape(pixels, 3, *x.shape[1:])).flatten(0, 1)  # noqa: E731
    rows = {name: torch.cat([J[name], decoded(F[name])]) for name in F}
    flat = out.features.reshape(-1)
    eye = torch.eye(len(flat), dtype=flat.dtype)
    (own,) = torch.autograd.grad(flat, [g.features], eye, True, is_grads_batched=True)
    rows["features"] = torch.cat([torch.zeros(pixels * 3, *own.shape[1:]), decoded(own.double())])
    nuisances = Nuisances(eliminate=BOTH)
    probes = 150 if method == "probes" else 1
    found = fisher.diagonal(g.detach(), cam, method=method, probes=probes, semantics=metric, nuisances=nuisances)
    for name, x in rows.items():
        truth = projected(x, N).square().sum(0)
        truth = truth.mean(1) if name == "features" else truth
        if method == "probes" and name != "features":  # features are exact there
            # The mean of 150 estimates of relative error sqrt(2) each: five standard deviations.
            torch.testing.assert_close(found[name], truth, rtol=5 * (2 / 150) ** 0.5, atol=1e-6)
        else:
            whole = x.square().sum(0)
            assert float((found[name] - truth).abs().max()) <= BOUND * float(whole.max()), name
    few = dataclasses.replace(metric, estimate="collapsed", samples=2)
    if method == "exact":
        estimated = fisher.diagonal(g.detach(), cam, semantics=few, nuisances=nuisances)
        told = fisher.diagonal(g.detach(), cam, semantics=few)
        for name, x in estimated.items():
            assert bool((x <= told[name]).all())
            assert bool((x >= 0).all())


def test_network():
    """Each probe of the network's estimates is of W^(1/2) J, in both modes: u is freed of what the unknowns explain."""
    scene, cam = drawn(size=(8, 8), n=5)
    J = network_jacobian(scene, cam)
    w2c = torch.as_tensor(cam.w2c, dtype=torch.float64).clone().requires_grad_()
    moved = dataclasses.replace(cam, w2c=w2c)
    out = reference.render(scene.at(TIME).detach(), moved, EXACT)
    N = torch.cat([exposure_columns(out.rgb), dense.pose_jacobian(moved, out)], 1)
    rest = {name: projected(x.flatten(0, 1), N) for name, x in J.items()}
    both = torch.cat(list(rest.values()), 1)
    draw = lambda generator, *shape: torch.randint(0, 2, shape, generator=generator).double() * 2 - 1  # noqa: E731
    ask = {"probes": 2, "nuisances": Nuisances(eliminate=BOTH)}
    generator = torch.Generator().manual_seed(0)
    u = torch.stack([draw(generator, 64, 3).flatten() for _ in range(2)])
    diagonal, trace = fisher.network(scene, cam, **ask), fisher.network(scene, cam, estimate="trace", **ask)
    generator = torch.Generator().manual_seed(0)
    v = torch.cat([draw(generator, 2, x.shape[1]) for x in rest.values()], 1)
    paper = fisher.network(scene, cam, estimate="paper", **ask)
    for name, x in rest.items():
        truth = (u @ x).square().mean(0)
        assert float((diagonal[name] - truth).abs().max()) <= 1e-4 * float(truth.max())
        assert float(trace[name]) == pytest.approx(float(truth.sum()), rel=1e-4)
        assert float(paper[name]) == pytest.approx(float((v @ both.T @ x).square().sum(1).mean()), rel=1e-4)
        assert float(x.square().sum()) < 0.9 * float(J[name].square().sum())  # and not what it was before


def test_backdrop(rng):
    """(1 - alpha) of a cell's pixels, freed of what both unknowns explain, in each channel."""
    settings = EXACT.replace(background=(0.3, 0.6, 0.2))
    g, cam, out = dense.scene(rng, settings, K=1, size=(16, 14))
    from drgs.information.backdrop import CELLS, backdrop_cells

    open_ = (1 - out.alpha.detach()).reshape(-1)
    cells = backdrop_cells(cam).flatten()
    J = torch.zeros(len(open_), 3, CELLS, 3, dtype=torch.float64)
    for c in range(3):
        J[torch.arange(len(open_)), c, cells, c] = open_
    N = torch.cat([exposure_columns(out.rgb), dense.pose_jacobian(cam, out)], 1)
    truth = projected(J.flatten(0, 1), N).square().sum(0)
    found = fisher.backdrop(g.detach(), cam, settings, nuisances=Nuisances(eliminate=BOTH))
    whole = fisher.backdrop(g.detach(), cam, settings)
    assert float((found - truth).abs().max()) <= BOUND * float(whole.max())
    assert float((whole - found).max()) > 1e-3 * float(whole.max())


def test_rounding_is_nothing():
    """A rest within rounding of both sums is 0, of either sign; more is kept."""
    told = torch.tensor([1.0, 1.0, 1.0, 0.0], dtype=torch.float64)
    found = remaining(told, torch.tensor([1 - 1e-6, 1 + 1e-6, 0.9, 0.0], dtype=torch.float64))
    assert found.tolist() == pytest.approx([0, 0, 0.1, 0])


def test_blocks_score(rng):
    """What is left of blocks is positive semidefinite up to rounding: criterion `block_logdet` takes it."""
    g, cam = gaussians(rng, 30, 1, scale=0.25).detach(), camera(rng, (24, 20))
    found = fisher.blocks(g, cam, nuisances=Nuisances(eliminate=BOTH))
    least = torch.linalg.eigvalsh(found)[:, 0] / fisher.blocks(g, cam).diagonal(dim1=1, dim2=2).amax(1).clamp_min(1e-30)
    assert float(least.min()) >= -1e-6
    assert block_gain(found, torch.zeros_like(found)).total > 0


def test_blocks_that_a_view_explains_wholly(rng):
    """One Gaussian that fills the image says nothing but the exposure: rounding is 0, not less than nothing."""
    g = gaussians(rng, 1, 1, scale=30.0).detach().replace(logit_opacities=torch.full((1,), 9.0))
    cam = camera(rng, (128, 128))
    train = fisher.blocks(g, cam)
    found = fisher.blocks(g, cam, nuisances=Nuisances(eliminate=("exposure",)))
    size = train.diagonal(dim1=1, dim2=2).amax()
    assert float(torch.linalg.eigvalsh(found).min()) >= -1e-12 * float(size)
    colors = slice(10, 13)
    assert float(found[0, colors, colors].abs().max()) <= 4e-6 * float(train[0, colors, colors].max())
    assert math.isfinite(block_gain(found, torch.zeros_like(found)).total)


def around(rng, count):
    """Cameras as arrays, which a file holds."""
    cameras = [camera(rng, (12, 10)) for _ in range(count)]
    return [dataclasses.replace(x, w2c=x.w2c.detach().numpy(), name=f"v{i}") for i, x in enumerate(cameras)]


def test_select_scores_and_keeps_them_apart(rng):
    """Scores are of what is left, known views' included; a cache keeps answers of other unknowns apart."""
    g, cache, cameras = gaussians(rng, 8, 1, scale=0.25).detach(), Cache(), around(rng, 4)
    ask = {"criterion": "eig", "cache": cache}
    plain = select(g, cameras[2:], cameras[:2], **ask)
    freed = Nuisances(eliminate=BOTH)
    first = select(g, cameras[2:], cameras[:2], nuisances=freed, **ask)
    again = select(g, cameras[2:], cameras[:2], nuisances=freed, **ask)
    fresh = select(g, cameras[2:], cameras[:2], nuisances=freed, criterion="eig")
    assert first.computed == 4
    assert again.computed == 0
    assert first.scores == again.scores == pytest.approx(fresh.scores, rel=1e-6)
    assert first.scores != pytest.approx(plain.scores, rel=1e-5)
    H = fisher.diagonal(g, cameras[:2], nuisances=freed)
    Hc = fisher.diagonal(g, cameras[2], nuisances=freed)
    least = Prior(1e-6).in_scene(g, cameras).per_group(H)
    score = sum(float((Hc[name] / (H[name] + least[name])).sum()) for name in GROUPS)
    assert sum(first.parts[0][name] for name in GROUPS) == pytest.approx(score, rel=1e-4)


def test_commands(rng, tmp_path):
    """`--eliminate` of select and fisher: less is known, shares of pixels still add up to the view's `logdet`."""
    g, cameras = gaussians(rng, 8, 1, scale=0.25).detach(), around(rng, 3)
    save_ply(g, tmp_path / "g.ply")
    save_cameras_json(tmp_path / "c.json", cameras)
    known = [str(tmp_path / "g.ply"), "--train", str(tmp_path / "c.json"), "--quiet"]
    said = {}
    for name in ("none", "exposure,pose"):
        out = tmp_path / name
        assert cli.main(["fisher", *known, "-o", str(out), "--limit", "1", "--eliminate", name]) == 0
        report = json.loads((out / "fisher.json").read_text())
        said[name] = load_state(out / "information.safetensors")[0]
        view = report["views"][0]
        assert view["share"]["sum"] == pytest.approx(view["gain"]["logdet"], rel=1e-3)
        assert ("nuisances" in report) == (name != "none")
    assert all(bool((said["exposure,pose"][name] <= x).all()) for name, x in said["none"].items())
    chosen = tmp_path / "s.json"
    ask = ["select", *known, "--candidates", "orbit", "--count", "3", "-o", str(chosen)]
    assert cli.main([*ask, "--eliminate", "exposure", "--exposure-std", "0.2"]) == 0
    nuisances = json.loads(chosen.read_text())["nuisances"]
    assert nuisances == {"eliminate": ["exposure"], "exposure_std": 0.2, "pose_std": None}


def test_what_a_fit_has_estimated():
    """Unless it says itself, a scoring eliminates what the fit has estimated; FisherRF's method knows nothing of it."""
    assert Scoring().over(("pose", "exposure")).nuisances.names == BOTH
    assert Scoring(nuisances=Nuisances(eliminate=())).over(BOTH).nuisances.names == ()
    assert Scoring(method="fisherrf").over(BOTH).nuisances.names == ()
    selection = SelectionConfig().replace(eliminate=("exposure",), exposure_std=0.1)
    assert SelectionConfig.from_json(json.loads(json.dumps(selection.to_json()))) == selection


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"eliminate": ("gain",)}, "eliminate must be among exposure, pose, or none, got 'gain'"),
        ({"eliminate": "pose"}, "eliminate must be a tuple of exposure, pose, got 'pose'"),
        ({"exposure_std": 0.0}, "exposure_std must be within 1e-09 and 1e"),
        ({"pose_std": 0.1}, "pose_std must be two numbers, radians and world units, got 0.1"),
        ({"pose_std": (0.1, float("nan"))}, "pose_std must be within"),
    ],
)
def test_bad_nuisances(fields, message):
    """One line that names the field."""
    with pytest.raises(ValueError, match=message):
        Nuisances(**fields)


def test_fisherrf_has_none(rng):
    """The baseline is what its code computes."""
    g, cam = gaussians(rng, 3, 1).detach(), camera(rng, (6, 5))
    with pytest.raises(ValueError, match="method fisherrf must have no nuisances"):
        fisher.diagonal(g, cam, method="fisherrf", nuisances=Nuisances(eliminate=("pose",)))
    with pytest.raises(ValueError, match="eliminate must be none with method fisherrf, got pose"):
        Scoring(method="fisherrf", nuisances=Nuisances(eliminate=("pose",)))


def test_runs_say_what_they_have_estimated(tmp_path):
    """`estimated` of config.json is what `drgs select RUN` eliminates; older runs have none, other words fail."""
    config = {"schema": CONFIG_SCHEMA, "command": "fit", "data": "x", "train": ["a"], "test": []}
    config |= {"fit": FitConfig().to_json()}
    for said, names in (({}, ()), ({"estimated": ["pose"]}, ("pose",))):
        (tmp_path / "config.json").write_text(json.dumps(config | said))
        record = fit_record(Run(tmp_path))
        assert Scoring().over(record.estimated).nuisances.names == names
    (tmp_path / "config.json").write_text(json.dumps(config | {"estimated": ["weather"]}))
    with pytest.raises(ValueError, match="estimated must be among exposure, pose, got 'weather'"):
        fit_record(Run(tmp_path))
