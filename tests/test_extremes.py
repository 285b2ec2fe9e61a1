"""The extremes of the renderer: everything finite, and as close to the float64 oracle as anywhere else.

The cases are in scenes_extreme.py; `python benchmarks/numerics.py` prints their errors for docs/numerics.md.
"""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest
import torch
from scenes_extreme import CASES
from scenes_random import FIELDS, Oracle, camera, compare, gaussians, gradients

from drgs.integrator import render
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
