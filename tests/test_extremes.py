"""The extremes of the renderer: everything finite, and as close to the float64 oracle as anywhere else.

The cases are in drgs/lab/extremes.py; `drgs stress` runs them on any machine, and
`python benchmarks/numerics.py` prints their errors for docs/numerics.md.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings

import numpy as np
import pytest
import torch
from scenes_extreme import CASES, CROWDS, crowd
from scenes_random import camera, gaussians, gradients

from drgs import fisher, reference
from drgs.cameras import Camera, intrinsics_from_fov, look_at
from drgs.ellipsoids import Gaussians
from drgs.integrator import render, render_jvp, render_rays
from drgs.lab.extremes import REFUSALS
from drgs.lab.stress import refused, row_of, truth_of
from drgs.rasterize import rasterization
from drgs.settings import RenderSettings
from drgs.tracing import bvh


@functools.lru_cache(maxsize=1)
def _known(name):
    """A case and what the oracle says about it; both traversals follow one another."""
    case = next(c for c in CASES if c.name == name)
    return case, truth_of(case)


def _check(row):
    assert row.finite, row
    assert row.image <= 1e-5, row
    assert row.gradient <= 1e-4, row
    assert row.forward <= 1e-4, row
    assert row.duality <= 1e-4, row
    assert row.fisher is None or row.fisher <= 1e-4, row


def _rows():
    """Every case of the default model on tiles; of the other models and of bvh each sixth, the rest are slow."""
    others = 0
    for case in CASES:
        for traversal in case.traversals:
            is_repeated = False
            if traversal == "bvh" or case.settings.response != "peak":
                is_repeated = others % 6 > 0
                others += 1
            yield pytest.param(case.name, traversal, marks=[pytest.mark.slow] if is_repeated else [])


@pytest.mark.parametrize(("name", "traversal"), list(_rows()), ids=lambda text: text.replace("`", ""))
def test_extremes(name, traversal):
    """Image within 1e-5, derivatives and information within 1e-4 of the oracle, in the worst places too.

    On `bvh` where float32 world space cannot hold these bounds: finite values and a warning.
    """
    case, truth = _known(name)
    row = row_of(case, traversal, truth)
    warns = (traversal, case.bvh) == ("bvh", "warns")
    assert row.finite, row
    assert row.verdict == ("warns" if warns else "holds"), row
    assert ("traversal='tiles'" in row.remark) == warns
    assert "\n" not in row.remark
    if traversal == "tiles" or case.bvh == "holds":
        _check(row)
    assert truth.oracle.good.double().mean() > 0.8
    if len(truth.g):
        assert truth.oracle.out.count.max() > 0


@pytest.mark.core
@pytest.mark.parametrize("case", REFUSALS, ids=lambda c: c.name)
def test_refusals(case):
    """What cannot be rendered is told in one line."""
    row = refused(case)
    assert row.verdict == "warns", row


@pytest.mark.every(3)
@pytest.mark.parametrize("response", ["peak", "integral", "ewa"])
@pytest.mark.parametrize("traversal", ["tiles", "bvh"])
def test_opacity_of_one_half_is_no_kink(response, traversal):
    """The derivative by a logit of exactly 0 is that by 1e-6, both ways."""
    if (response, traversal) == ("ewa", "bvh"):
        pytest.skip("`ewa` has no bvh")
    rng = np.random.default_rng(0)
    g, cam = gaussians(rng, 1, 1, scale=0.5, spread=0.2), camera(rng, (9, 7))
    settings = RenderSettings.preset("exact", response=response, order="center", traversal=traversal)
    slopes = []
    for logit in (0.0, 1e-6):
        with torch.no_grad():
            g.logit_opacities[:] = logit
        back = torch.autograd.grad(render(g, cam, settings).alpha.sum(), g.logit_opacities)[0]
        forward = render_jvp(g, cam, {"logit_opacities": torch.ones(1)}, settings).alpha.sum()
        slopes.append((float(back), float(forward)))
    assert min(slopes[1]) > 0.1
    assert all(math.isclose(a, b, rel_tol=1e-5) for a, b in zip(*slopes, strict=True)), slopes


@pytest.mark.every(3)
@pytest.mark.filterwarnings("ignore:render:UserWarning")
@pytest.mark.parametrize("name", CROWDS)
def test_bvh_finds_the_hits(rng, name):
    """The acceleration structure loses no more than 1 hit in 5,000, whatever the mixture of sizes."""
    g, cam = crowd(name, rng, (24, 20))
    tiles, world = (
        render(g, cam, RenderSettings.preset("exact", traversal=t), outputs=("count",)) for t in ("tiles", "bvh")
    )
    hits = int(tiles.count.sum())
    assert hits > 5000
    assert int((tiles.count - world.count).clamp_min(0).sum()) <= hits / 5000
    if "5,000" not in name:  # where hits themselves are only good to 2e-3
        different = (tiles.rgb - world.rgb).abs().amax(-1) > 1e-5
        assert different.double().mean() <= 0.01


@pytest.mark.parametrize("order", ["ray", "entry"])
@pytest.mark.parametrize("listed", [0, 3, 1000])
def test_rays_that_start_inside(rng, monkeypatch, listed, order):
    """Origins in the midst of Gaussians see those they are inside of, be these listed, moved back behind or both."""
    monkeypatch.setattr(bvh, "_MAX_LISTED", listed)
    g = gaussians(rng, 30, 1, scale=0.4, anisotropy=0.3).detach()
    origins, directions = rng.uniform(-0.7, 0.7, (40, 3)), rng.normal(size=(40, 3))
    settings = RenderSettings.preset("exact", traversal="bvh", order=order, extent=6.0)  # which says what to count
    found = render_rays(g, origins, directions, settings, outputs=("count",))
    rays = torch.tensor(origins), torch.nn.functional.normalize(torch.tensor(directions), dim=1)
    wanted = reference.render(g, None, settings, rays=rays, tolerance=3e-4 if order == "entry" else 1e-5)
    good = ~wanted.ambiguous
    assert good.double().mean() > 0.8
    assert wanted.count.double().mean() > 5
    assert (found.rgb - wanted.rgb)[good].abs().max() < 1e-5
    assert (found.count - wanted.count)[good].abs().max() == 0


@pytest.mark.parametrize(
    ("preset", "traversal"), [("exact", "tiles"), ("exact", "bvh"), ("fast", "tiles"), ("mitsuba", "bvh")]
)
@pytest.mark.parametrize("eye", [(0.1, -0.2, 0.3), (1.1, 2.3, -3.7), (10.3, 20.1, -5.0)])
def test_a_mean_at_the_eye_is_ambiguous(eye, preset, traversal):
    """Whether its peak is in front hangs on the last bit, and all of its opacity with it: the oracle says so, at the
    eye and as near to it as float32 rounds (float64 means are re-centered); where it is farther away, all agree.
    """
    eye = np.float64(np.float32(eye))
    w2c = look_at(tuple(map(float, eye)), (0.3, 0.2, 1.0), (0.0, -1.0, 0.0))
    cam = Camera(K=intrinsics_from_fov(50.0, width=9, height=7), w2c=w2c, width=9, height=7)
    settings = RenderSettings.preset(preset, traversal=traversal)
    cases = [(0.0, np.float32, False), (4e-8, np.float32, False), (1e-3, np.float32, True)]
    for ahead, dtype, known in [*cases, (0.0, np.float64, False), (4e-8, np.float64, True)]:
        means = torch.tensor((eye + ahead * w2c[2, :3]).astype(dtype))[None]
        g = Gaussians.from_arrays(means, np.eye(4)[:1], np.full((1, 3), 0.3), np.full(1, 0.78), np.ones((1, 1, 3)))
        found, wanted = render(g, cam, settings), reference.render(g, cam, settings)
        assert wanted.ambiguous.all() != known
        assert wanted.ambiguous.any() != known
        off = (found.alpha - wanted.alpha)[~wanted.ambiguous].abs()
        assert off.numel() == (63 if known else 0)
        assert (off < 1e-5).all()


def test_float32_means_far_away_are_warned_about():
    """Detail that float32 has already lost cannot be rendered: the constructor says so."""
    from drgs import Gaussians

    means = np.array([[1e6, 0.0, 0.0]], np.float32)
    with pytest.warns(UserWarning, match="float64 means"):
        Gaussians.from_arrays(means, np.eye(4)[:1], np.full((1, 3), 1e-2), np.full(1, 0.5), np.zeros((1, 3)))


@pytest.mark.parametrize("response", ["peak", "integral"])
def test_values_beyond_float32_do_not_become_nan(response):
    """Parameters whose activations overflow or vanish give finite images and gradients."""
    rng = np.random.default_rng(1)
    g, cam = gaussians(rng, 12, 4), camera(rng, (9, 7))
    with torch.no_grad():
        g.log_scales[0], g.log_scales[1] = 60.0, -60.0
        g.log_scales[2] = torch.tensor([-40.0, 0.0, 40.0])
        g.logit_opacities[3], g.logit_opacities[4] = 3e4, -3e4
        g.means[5], g.means[6] = 1e15, -1e15
        g.sh[7] = 1e10
    for traversal in ("tiles", "bvh"):
        settings = RenderSettings.preset("exact", response=response, traversal=traversal)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            out = render(g, cam, settings, outputs="all")
        for field in dataclasses.fields(out):
            value = getattr(out, field.name)
            if isinstance(value, torch.Tensor):
                assert torch.isfinite(value).all(), field.name
        found = gradients(g, cam, out, {"rgb": torch.ones(7, 9, 3), "depth": torch.ones(7, 9)})
        for name, x in found.items():
            assert torch.isfinite(x).all(), name


_DISCS = {
    "exact": RenderSettings.preset("exact"),
    "exact on bvh": RenderSettings.preset("exact", traversal="bvh"),
    "integral": RenderSettings.preset("exact", response="integral"),
    "integral on bvh": RenderSettings.preset("exact", response="integral", traversal="bvh"),
    "fast": RenderSettings.preset("fast"),
    "mitsuba": RenderSettings.preset("mitsuba"),
    "3dgut": RenderSettings.preset("3dgut", culling="extent"),
    "gsplat": RenderSettings.preset("gsplat"),
    "inria": RenderSettings.preset("inria"),
}


def _discs(thin):
    """Three Gaussians as thin as that, each along another axis, and a camera; scales, quaternions and means."""
    scales = torch.tensor([[0.3, 0.2, thin], [thin, 0.3, 0.4], [0.2, thin, 0.3]], dtype=torch.float64)
    quats = torch.tensor([[1, 0.2, 0.3, 0.1], [0.5, -0.4, 0.7, 0.3], [0.3, 0.8, -0.2, 0.1]], dtype=torch.float64)
    means = torch.tensor([[0.1, 0.05, 3.0], [-0.3, 0.2, 3.6], [0.2, -0.3, 4.2]], dtype=torch.float64)
    made = Camera(K=[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]], w2c=np.eye(4), width=16, height=16)
    return scales, quats, means, made


@pytest.mark.parametrize("thin", [1e-3, 1e-12, 0.0])
@pytest.mark.parametrize("name", _DISCS)
def test_derivatives_of_discs(name, thin):
    """By each scale, the thin one's too, which goes to 0 with it; by tensors and, forward, by raw parameters."""
    settings = _DISCS[name]
    scales, quats, means, seen = _discs(thin)
    opacities = torch.tensor([0.8, 0.6, 0.7], dtype=torch.float64)
    colors = torch.tensor([[0.2, 0.5, 0.9], [0.8, 0.3, 0.1], [0.4, 0.9, 0.2]], dtype=torch.float64)
    sh = ((colors - 0.5) / 0.28209479177387814)[:, None]
    leaves = [x.requires_grad_() for x in (scales, quats, means)]
    view = {"viewmats": torch.eye(4, dtype=torch.float64)[None], "Ks": torch.tensor(seen.K)[None]}
    image, _, _ = rasterization(means, quats, scales, opacities, colors, **view, width=16, height=16, preset=settings)
    raw = scales if thin else scales + 1e-20 * (scales == 0)
    g = Gaussians(means, quats, raw.log(), torch.logit(opacities), sh)
    oracle = reference.render(g, seen, settings)
    good = ~oracle.ambiguous[..., None]
    assert float(good.double().mean()) > 0.8
    assert float(((image[0] - oracle.rgb) * good).detach().abs().max()) < 2e-6
    u = good * torch.linspace(-1, 1, image.numel(), dtype=torch.float64).reshape(16, 16, 3)
    found = torch.autograd.grad((u * image[0]).sum(), leaves)
    wanted = torch.autograd.grad((u * oracle.rgb).sum(), leaves)
    assert float(wanted[0].abs().min()) > 1e-3 * max(thin, 1e-20)
    # Single entries, one of which is a small sum of large parts: three times the bound of norms.
    torch.testing.assert_close(found[0], wanted[0], rtol=3e-4, atol=0)
    for got, want in zip(found[1:], wanted[1:], strict=True):
        assert float((got - want).norm() / want.norm()) < 1e-4
    if thin and settings.order != "entry":
        # Forward mode by the thin scales alone.
        tangent = torch.where(raw == thin, 1 / raw, 0).detach()
        moved = render_jvp(g.detach(), seen, {"log_scales": tangent}, settings)
        want = float((wanted[0] * (raw == thin)).sum())
        assert float((u * moved.rgb).sum()) == pytest.approx(want, rel=1e-3)


@pytest.mark.parametrize("name", ["exact", "exact on bvh", "integral", "integral on bvh", "gsplat"])
def test_information_of_discs(name):
    """Of Gaussians without a thickness it is that of thin ones; by the logarithm of a scale of 0 there is none."""
    found = []
    for thin in (1e-6, 1e-20):
        scales, quats, means, seen = _discs(thin)
        g = Gaussians(means, quats, scales.log(), torch.tensor([1.4, 0.4, 0.8]), torch.zeros(3, 1, 3))
        found.append(fisher.diagonal(g, seen, _DISCS[name]))
    for group in ("means", "rotations", "log_scales", "logit_opacities"):
        thin, flat = (x[group].double() for x in found)
        assert float(thin.norm()) > 0, group
        assert float((flat - thin).norm() / thin.norm()) < 1e-5, group
    assert found[1]["log_scales"][0, 2] == 0


@pytest.mark.parametrize("name", ["exact", "exact on bvh", "integral", "integral on bvh", "gsplat"])
def test_log_scales_far_below(name):
    """The logarithm of a scale may be any number: with one of 0 in float64 a Gaussian is a disc, and is seen."""
    _, quats, means, seen = _discs(1.0)
    found = []
    for low in (-46.0, -1e30):
        log_scales = torch.tensor([[-1.2, -1.6, low], [low, -1.2, -0.9], [-1.6, low, -1.2]], requires_grad=True)
        g = Gaussians(means, quats, log_scales, torch.tensor([1.4, 0.4, 0.8]), torch.zeros(3, 1, 3))
        image = render(g, seen, _DISCS[name])
        (slope,) = torch.autograd.grad(image.alpha.sum(), log_scales)
        found.append((image.alpha.detach(), slope, fisher.diagonal(g.detach(), seen, _DISCS[name])["log_scales"]))
    for x, y in zip(*found, strict=True):
        assert float(x.abs().max()) > 0.1
        torch.testing.assert_close(y, x, rtol=1e-5, atol=1e-6)
