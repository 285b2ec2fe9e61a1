"""The extremes of the renderer: everything finite, and as close to the float64 oracle as anywhere else.

The cases are in scenes_extreme.py; `python benchmarks/numerics.py` prints their errors for docs/numerics.md.
"""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest
import torch
from scenes_extreme import CASES, CROWDS, crowd
from scenes_random import FIELDS, Oracle, camera, compare, gaussians, gradients

from drgs import bvh, reference
from drgs.integrator import render, render_rays
from drgs.settings import RenderSettings

COLORS = tuple(name for name in FIELDS if name != "depth")


def _run(case, traversal):
    rng = np.random.default_rng(3)
    g, cam = case.build(rng)
    oracle = Oracle(g, cam, case.settings, rng, 1e-6, FIELDS if case.depth else COLORS)
    return compare(g, cam, case.settings.replace(traversal=traversal), oracle), oracle


def _check(errors):
    assert errors.finite
    assert max(errors.image.values()) <= 1e-5, errors.image
    assert max(errors.gradient.values()) <= 1e-4, errors.gradient
    assert errors.joint <= 1e-4
    assert errors.duality <= 1e-4


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name.replace("`", ""))
def test_tiles(case):
    """Image within 1e-5 and gradients within 1e-4 of the oracle, in the worst places too."""
    errors, oracle = _run(case, "tiles")
    _check(errors)
    assert oracle.good.double().mean() > 0.8
    if case.name != "0 Gaussians":
        assert oracle.out.count.max() > 0


@pytest.mark.parametrize(
    "case", [c for c in CASES if c.bvh != "skip" and "ewa" not in c.name], ids=lambda c: c.name.replace("`", "")
)
def test_bvh(case):
    """The same bounds on `bvh`; where float32 world space cannot hold them, finite values and a warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        errors, _ = _run(case, "bvh")
    told = [str(w.message) for w in caught if "traversal='tiles'" in str(w.message)]
    assert errors.finite
    assert bool(told) == (case.bvh == "warns")
    assert all("\n" not in message for message in told)
    if case.bvh == "holds":
        _check(errors)


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
    monkeypatch.setattr(bvh, "_LISTED", listed)
    g = gaussians(rng, 30, 1, scale=0.4, anisotropy=0.3).detach()
    origins, directions = rng.uniform(-0.7, 0.7, (40, 3)), rng.normal(size=(40, 3))
    settings = RenderSettings.preset("exact", traversal="bvh", order=order)
    found = render_rays(g, origins, directions, settings, outputs=("count",))
    rays = torch.tensor(origins), torch.nn.functional.normalize(torch.tensor(directions), dim=1)
    wanted = reference.render(g, None, settings, rays=rays, tolerance=3e-4 if order == "entry" else 1e-5)
    good = ~wanted.ambiguous
    assert good.double().mean() > 0.8
    assert wanted.count.double().mean() > 5
    assert (found.rgb - wanted.rgb)[good].abs().max() < 1e-5
    assert (found.count - wanted.count)[good].abs().max() == 0


def test_negative_quaternion_is_the_same_rotation():
    """q and -q, and any positive multiple, render the same image."""
    rng = np.random.default_rng(0)
    g, cam = gaussians(rng, 12, 4), camera(rng, (9, 7))
    settings = RenderSettings.preset("exact")
    a = render(g.detach(), cam, settings)
    b = render(g.replace(quats=-g.quats).detach(), cam, settings)
    assert torch.equal(a.rgb, b.rgb)


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
