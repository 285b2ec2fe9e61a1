"""Fisher information against the dense Jacobian of the float64 oracle."""

from __future__ import annotations

import math

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from dense_jacobian import GROUPS, error
from scenes_extreme import CASES
from scenes_random import camera, gaussians

from drgs import fisher, reference
from drgs.cameras import Camera
from drgs.gain import Prior, variances
from drgs.settings import RenderSettings

Preset = RenderSettings.preset
# 24 kinds, three scenes each.
KINDS = [
    (response, order, traversal, K)
    for K in (1, 4, 9, 16)
    for response, order, traversal in (
        ("peak", "ray", "tiles"),
        ("peak", "center", "tiles"),
        ("peak", "ray", "bvh"),
        ("integral", "ray", "tiles"),
        ("integral", "center", "bvh"),
        ("ewa", "center", "tiles"),
    )
]


def _settings(response, order, traversal):
    dilation = 0.3 if response == "ewa" else 0.0
    return Preset("exact", response=response, order=order, traversal=traversal, dilation=dilation)


@pytest.mark.core
@pytest.mark.every(5)
@pytest.mark.parametrize(("response", "order", "traversal", "K"), KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_diagonal_and_blocks(response, order, traversal, K, seed):
    """Within 1e-4 of the group's scale, every group, every kind; so are the blocks, of their rows' scale.

    SH are evaluated towards the means, in the last scene along each ray.
    """
    rng = np.random.default_rng(100 * seed + K)
    settings = _settings(response, order, traversal).replace(background=tuple(rng.uniform(0, 1, 3)))
    settings = settings.replace(sh_direction="ray" if seed == 2 else "gaussian")
    g, cam, out = dense.scene(rng, settings, K=K)
    J = dense.jacobian(g, out)
    found, truth = fisher.diagonal(g, cam, settings), dense.squares(J)
    assert tuple(found) == GROUPS
    for name in GROUPS:
        assert found[name].dtype == torch.float64
        assert error(found[name], truth[name]) <= 1e-4, name
    rows = dense.stacked(J)
    truth = torch.einsum("pni,pnj->nij", rows, rows)
    scale = truth.diagonal(dim1=1, dim2=2).amax(0).sqrt().clamp_min(1e-12)
    found = fisher.blocks(g, cam, settings)
    assert float(((found - truth) / (scale[:, None] * scale)).abs().max()) <= 1e-4


def test_small_entries_are_as_right_as_large_ones():
    """Moves along the viewing axis change little: their information has its own relative accuracy."""
    settings, rng = Preset("exact"), np.random.default_rng(0)
    g = gaussians(rng, 6, 1, scale=0.02, spread=0.5)
    w2c = torch.eye(4, dtype=torch.float64)
    w2c[2, 3] = 6
    cam = Camera(K=np.array([[200.0, 0, 12], [0, 200.0, 11], [0, 0, 1]]), w2c=w2c, width=24, height=22)
    out = reference.render(g, cam, settings)
    truth = dense.squares(dense.jacobian(g, out))["means"]
    assert float(truth[:, 2].max()) < 1e-2 * float(truth.max())
    found = fisher.diagonal(g, cam, settings)["means"]
    seen = truth[:, 2] > 1e-6 * truth[:, 2].max()
    assert float(((found - truth) / truth)[seen].abs().max()) < 1e-4


@pytest.mark.parametrize(("response", "order", "traversal"), [kind[:3] for kind in KINDS[:6]])
def test_rotations_of_spheres(response, order, traversal):
    """They change nothing, to the last bit, which an H + lambda of 0 would divide by; those of what is 1 % off a sphere
    do, by their own relative accuracy.
    """
    settings = _settings(response, order, traversal)
    g, cam, _ = dense.scene(np.random.default_rng(3), settings, K=1)
    sphere = g.detach().replace(log_scales=g.log_scales.detach()[:, :1].expand(-1, 3).contiguous())
    assert not fisher.diagonal(sphere, cam, settings)["rotations"].any()
    assert not fisher.blocks(sphere, cam, settings)[:, 3:6].any()
    nearly = sphere.replace(log_scales=sphere.log_scales + torch.tensor([0.0, 0.005, 0.01]))
    for x in nearly.parameters().values():
        x.requires_grad_()
    truth = dense.squares(dense.jacobian(nearly, reference.render(nearly, cam, settings)))["rotations"]
    assert 0 < float(truth.max()) < 1e-3
    assert error(fisher.diagonal(nearly, cam, settings)["rotations"], truth) <= 1e-4


def _one(K=4, seed=5, direction="gaussian", **options):
    settings = Preset("exact", sh_direction=direction)
    g, cam, out = dense.scene(np.random.default_rng(seed), settings, K=K, **options)
    return g, cam, settings, dense.jacobian(g, out), out


@pytest.mark.core
def test_columns_equal_exact():
    """Forward mode, a column for every parameter, says the same."""
    g, cam, settings, _, _ = _one()
    exact, columns = fisher.diagonal(g, cam, settings), fisher.diagonal(g, cam, settings, "columns")
    for name in GROUPS:
        assert error(columns[name], exact[name]) <= 1e-4, name


def test_single_columns():
    """Any subset of any group, and the pose, in the order asked for."""
    g, cam, settings, J, out = _one()
    index = {"means": [(3, 1), (0, 2)], "logit_opacities": [5], "sh": [(2, 3, 0)], "camera": [4]}
    found = fisher.jacobian_columns(g, cam, index, settings, batch=3)
    assert found.shape == (5, cam.height, cam.width, 3)
    rows = dense.pose_jacobian(cam, out)
    want = [J["means"][:, 3, 1], J["means"][:, 0, 2], J["logit_opacities"][:, 5], J["sh"][:, 2, 3, 0], rows[:, 4]]
    for a, b in zip(found, want, strict=True):
        assert error(a.reshape(-1).double(), b) <= 1e-4


def test_pose_information():
    """J^T J of the twist."""
    g, cam, settings, _, out = _one()
    J = dense.pose_jacobian(cam, out)
    assert error(fisher.pose_information(g, cam, settings), J.T @ J) <= 1e-4


def test_probes_are_unbiased():
    """The relative error falls as sqrt(2 / K) and no faster, and the mean has no offset."""
    g, cam, settings, _, _ = _one(D=2)
    exact = fisher.diagonal(g, cam, settings)
    spread = {}
    for probes in (32, 512):
        found = fisher.diagonal(g, cam, settings, "probes", probes=probes)
        # No probe is needed for what has a sum; on two threads sums differ in the last bits.
        torch.testing.assert_close(found["features"], exact["features"], rtol=1e-6, atol=1e-9)
        ratios = torch.cat([(found[n] / exact[n])[exact[n] > 1e-6 * exact[n].max()].reshape(-1) for n in GROUPS])
        spread[probes] = float((ratios - 1).square().mean().sqrt())
        assert abs(float(ratios.mean()) - 1) < 0.5 * math.sqrt(2 / probes)
    for probes, value in spread.items():
        assert 0.5 * math.sqrt(2 / probes) < value < 1.5 * math.sqrt(2 / probes)
    assert 2.5 < spread[32] / spread[512] < 6.0  # 4 = sqrt(512 / 32)


@pytest.mark.parametrize("direction", ["gaussian", "ray"])
def test_fisherrf_is_its_formula(direction):
    """Channels summed before the square, activations once; SH is right; rotations are left out."""
    g, cam, settings, J, _ = _one(direction=direction)
    found = fisher.diagonal(g, cam, settings, "fisherrf")
    pixels = len(J["means"]) // 3
    summed = {name: x.reshape(pixels, 3, *x.shape[1:]).sum(1).square().sum(0) for name, x in J.items()}
    opacity = g.logit_opacities.detach().double().sigmoid()
    want = {
        "means": summed["means"],
        "log_scales": summed["log_scales"] / g.log_scales.detach().double().exp(),
        "logit_opacities": summed["logit_opacities"] / (opacity * (1 - opacity)),
        "sh": dense.squares(J)["sh"],
    }
    assert set(found) == set(want)
    for name, x in want.items():
        assert error(found[name], x) <= 1e-4, name


# Not further: products below 1e-38 are denormal, which worker threads of Dr.Jit, if they compute, take as 0.
@pytest.mark.parametrize("logit", [2.0, 30.0, 38.0])
def test_fisherrf_of_opaque_gaussians(logit):
    """Divided by alpha (1 - alpha) also where alpha rounds to 1: of gray, 9 times one channel's square over that."""
    g, cam, _, _, _ = _one(K=1)
    gray = g.detach().replace(logit_opacities=torch.full((len(g),), logit))
    gray = gray.replace(sh=gray.sh[..., :1].abs().expand(-1, -1, 3).contiguous())
    settings = Preset("fast", alpha_max=1.0)
    theirs = fisher.diagonal(gray, cam, settings, "fisherrf")["logit_opacities"]
    red = fisher.diagonal(gray, cam, settings, channel_weights=(1.0, 0.0, 0.0))["logit_opacities"]
    slope = math.exp(-logit) / (1 + math.exp(-logit)) ** 2
    assert float(red.max()) > 0
    torch.testing.assert_close(theirs, 9 * red / slope, rtol=1e-4, atol=1e-4 * 9 * float(red.max()) / slope)


def test_fisherrf_loses_what_cancels_between_channels():
    """Red above and blue below the background by as much: the sum over channels does not move, the image does."""
    settings = Preset("exact", background=(0.5, 0.5, 0.5))
    g, cam = (
        gaussians(np.random.default_rng(1), 1, 1, scale=0.3, spread=0.1),
        camera(np.random.default_rng(1), (16, 14)),
    )
    with torch.no_grad():
        g.sh[:] = torch.tensor([0.8, 0.0, -0.8])
    true, theirs = fisher.diagonal(g, cam, settings), fisher.diagonal(g, cam, settings, "fisherrf")
    for name in ("means", "logit_opacities"):
        assert float(true[name].max()) > 0.01
        assert float(theirs[name].max()) < 1e-6 * float(true[name].max())


@pytest.mark.core
def test_views_add_up_and_groups_can_be_chosen():
    """A list of cameras is their sum; a part of the groups is that part."""
    g, cam, settings, _, _ = _one()
    other = camera(np.random.default_rng(9), (10, 9))
    both = fisher.diagonal(g, [cam, other], settings)
    for name in GROUPS:
        alone = fisher.diagonal(g, cam, settings, groups=[name])
        assert tuple(alone) == (name,)
        total = alone[name] + fisher.diagonal(g, other, settings)[name]
        assert torch.allclose(both[name], total, rtol=1e-5, atol=1e-9)


def test_permutation():
    """Gaussians in another order have their information in that order."""
    g, cam, settings, _, _ = _one()
    order = torch.randperm(len(g), generator=torch.Generator().manual_seed(0))
    found, moved = fisher.diagonal(g, cam, settings), fisher.diagonal(g.take(order), cam, settings)
    for name in GROUPS:
        assert error(moved[name], found[name][order]) < 1e-6


def test_features_have_the_information_of_their_weights():
    """The same number for every channel, whatever the features are."""
    g, cam, settings, _, _ = _one(D=3)
    exact, columns = fisher.diagonal(g, cam, settings), fisher.diagonal(g, cam, settings, "columns")
    assert exact["features"].shape == (len(g),)
    assert error(exact["features"], columns["features"]) <= 1e-4
    coverage = fisher.coverage(g, cam, settings)
    assert torch.allclose(exact["features"], coverage, rtol=1e-6)
    assert coverage.untyped_storage().nbytes() == 8 * len(g)  # and not that of all sums


@pytest.mark.parametrize("direction", ["gaussian", "ray"])
def test_variance_map(direction):
    """Per pixel the weighted sum of squares; with weights 1 / H it adds up to the number of parameters seen."""
    g, cam, settings, J, _ = _one(direction=direction)
    generator = torch.Generator().manual_seed(0)
    H = dense.squares(J)
    weights = {name: torch.rand(x.shape, generator=generator, dtype=torch.float64) for name, x in H.items()}
    found = fisher.variance_map(g, cam, weights, settings)
    want = sum((J[n].square() * weights[n]).reshape(len(J[n]), -1).sum(1) for n in GROUPS)
    assert error(found.double(), want.reshape(cam.height, cam.width, 3).sum(2)) <= 1e-4
    exact = fisher.diagonal(g, cam, settings)
    inverse = {name: torch.where(x > 1e-8, 1 / x, 0) for name, x in exact.items()}
    seen = sum(int((x > 1e-8).sum()) for x in exact.values())
    assert abs(float(fisher.variance_map(g, cam, inverse, settings).double().sum()) / seen - 1) < 1e-4


@pytest.mark.parametrize("direction", ["gaussian", "ray"])
def test_variance_without_lambda(direction):
    """Of what is all but transparent H is 1e-38 and 1 / H near the end of float32: the map is finite all the same, its
    sum at most the number of parameters seen, and infinite weights are refused, those of SH along rays, too.
    """
    g, cam, settings, _, _ = _one(direction=direction)
    settings = Preset("fast", sh_direction=direction, alpha_min=0.0)
    for logit in (-30.0, -42.0, -44.0):
        faint = g.detach().replace(logit_opacities=torch.full((len(g),), logit))
        weights = variances(fisher.diagonal(faint, cam, settings), Prior(0.0))
        found = fisher.variance_map(faint, cam, weights, settings)
        assert bool(torch.isfinite(found).all())
        assert float(found.sum()) <= 1.01 * sum(int((x > 0).sum()) for x in weights.values())
    assert float(max(x.max() for x in weights.values())) > 2e37
    weights["sh"][0, 0, 0] = math.inf
    with pytest.raises(ValueError, match="weights must be finite, got NaN or Inf; raise lambda above 0"):
        fisher.variance_map(faint, cam, weights, settings)


def test_channel_weights():
    """Inverse variances multiply the squares of their channel."""
    g, cam, settings, J, _ = _one()
    weights = torch.tensor([0.5, 2.0, 0.0], dtype=torch.float64)
    found = fisher.diagonal(g, cam, settings, channel_weights=weights.tolist())
    for name, x in J.items():
        want = (x.reshape(-1, 3, *x.shape[1:]).square() * weights.reshape(1, 3, *[1] * (x.ndim - 1))).sum((0, 1))
        assert error(found[name], want) <= 1e-4, name


@pytest.mark.every(5)
@pytest.mark.parametrize("preset", ["fast", "inria", "gsplat", "3dgut", "mitsuba"])
def test_presets(preset):
    """With every system's cut-offs the information is that of its columns."""
    g, cam = gaussians(np.random.default_rng(2), 8, 4, scale=0.25), camera(np.random.default_rng(2), (12, 10))
    settings = Preset(preset)
    exact, columns = fisher.diagonal(g, cam, settings), fisher.diagonal(g, cam, settings, "columns")
    for name in GROUPS:
        assert error(columns[name], exact[name]) <= 1e-4, name


@pytest.mark.every(5)
@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name.replace("`", ""))
def test_extremes(case):
    """Finite where the renderer is, and the squares of the columns: of three random parameters of every group."""
    rng = np.random.default_rng(3)
    g, cam = case.build(rng)
    found = fisher.diagonal(g, cam, case.settings)
    assert all(torch.isfinite(x).all() for x in found.values())
    assert torch.isfinite(fisher.blocks(g, cam, case.settings)).all()
    for name, x in found.items():
        if name == "features" or not len(g):
            continue
        rows = np.stack([rng.integers(0, n, 3) for n in x.shape], 1)
        columns = fisher.jacobian_columns(g, cam, {name: rows}, case.settings)[..., :3].double()
        want = columns.square().sum((1, 2, 3))
        scale = float(x.max())
        assert float((x[tuple(rows.T)] - want).abs().max()) <= 1e-4 * max(scale, 1e-30), name


def test_nothing_to_see():
    """No Gaussians, and Gaussians out of sight: zeros of the right shapes."""
    g, cam = gaussians(np.random.default_rng(0), 5, 4), camera(np.random.default_rng(0), (8, 6))
    away = g.replace(means=g.means.detach() + 1e3)
    for scene, n in ((g.take(slice(0, 0)), 0), (away, 5)):
        found = fisher.diagonal(scene, cam)
        assert found["sh"].shape == (n, 4, 3)
        assert all(float(x.abs().sum()) == 0 for x in found.values())
        assert float(fisher.blocks(scene, cam).abs().sum()) == 0
        assert float(fisher.variance_map(scene, cam, {k: torch.ones_like(x) for k, x in found.items()}).sum()) == 0
        assert float(fisher.pose_information(scene, cam).abs().sum()) == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda g, c: fisher.diagonal(g, []), "at least one camera"),
        (lambda g, c: fisher.diagonal(g, c, method="hessian"), "method must be one of exact, columns"),
        (lambda g, c: fisher.diagonal(g, c, groups=["scales"]), "groups must be among means"),
        (lambda g, c: fisher.diagonal(g, c, channel_weights=(1, -1, 1)), "channel_weights must be 3"),
        (lambda g, c: fisher.blocks(g, c, channel_weights=(1, -1, 1)), "channel_weights must be 3"),
        (lambda g, c: fisher.diagonal(g, c, method="probes", probes=0), "probes must be >= 1"),
        (lambda g, c: fisher.diagonal(g, c, method="probes", probes=2.5), "probes must be >= 1 and whole, got 2.5"),
        (lambda g, c: fisher.blocks(g, []), "fisher.blocks: there must be at least one camera, got none; pass one"),
        (lambda g, c: fisher.backdrop(g, c, channel_weights=(1,)), r"fisher.backdrop: channel_weights must .*; e.g. "),
        (
            lambda g, c: fisher.diagonal(g, c, method="fisherrf", groups=["rotations"]),
            "fisherrf must have more than rot",
        ),
        (
            lambda g, c: fisher.jacobian_columns(g, c, {"means": [(0, 1.9)]}),
            r"rows of 2 integers below .*\[\(0, 1.9\)\]",
        ),
        (lambda g, c: fisher.jacobian_columns(g, c, {"means": [(0, 1), (2,)]}), r"got \[\(0, 1\), \(2,\)\]; use whole"),
        (lambda g, c: fisher.variance_map(g, c, {"features": torch.ones(5)}), "weights must be of backdrop, means"),
        (lambda g, c: fisher.jacobian_columns(g, c, {"means": [(9, 0)]}), "index of means must be rows of 2"),
        (lambda g, c: fisher.jacobian_columns(g, c, {"scales": [(0, 0)]}), "must be one of means"),
        (
            lambda g, c: fisher.variance_map(g, c, {"means": torch.ones(3)}),
            r"weights of means must have shape \(5, 3\)",
        ),
        (
            lambda g, c: fisher.variance_map(g, c, {"means": torch.full((5, 3), math.inf)}),
            "weights must be finite",
        ),
    ],
)
def test_bad_input(call, message):
    """One line that says what must hold."""
    g, cam = gaussians(np.random.default_rng(0), 5, 4), camera(np.random.default_rng(0), (8, 6))
    with pytest.raises(ValueError, match=message) as caught:
        call(g, cam)
    assert "\n" not in str(caught.value)


def test_probes_of_sh_along_rays():
    """Probes know that direction too: 400 of them within 0.3 of the largest entry, 4 of their standard deviations."""
    g, cam = gaussians(np.random.default_rng(0), 5, 4), camera(np.random.default_rng(0), (8, 6))
    along = Preset("exact", sh_direction="ray")
    exact, probes = fisher.diagonal(g, cam, along), fisher.diagonal(g, cam, along, "probes", probes=400)
    assert error(probes["means"], exact["means"]) < 0.3


def test_not_finite():
    """NaN parameters are refused."""
    g, cam = gaussians(np.random.default_rng(0), 5, 4), camera(np.random.default_rng(0), (8, 6))
    with torch.no_grad():
        g.means[2, 1] = math.nan
    with pytest.raises(ValueError, match="means must be finite"):
        fisher.diagonal(g, cam)
