"""Feature images: against the float64 oracle, in both modes, coupled to geometry and not."""

from __future__ import annotations

import pytest
import torch
from scenes_random import FIELDS, camera, gaussians, gradients, relative, twist_basis

import drgs
from drgs import reference
from drgs.integrator import render, render_jvp

IMAGE, GRADIENT = 1e-5, 1e-4  # those of tests/test_integrator.py
Preset = drgs.RenderSettings.preset


def uncoupled(g, cam, settings):
    """The oracle's images, the features being all that its feature image has a derivative by."""
    ref = reference.render(g, cam, settings)
    fixed = g.detach().replace(features=g.features)
    ref.features = reference.render(
        fixed, drgs.Camera(cam.K, cam.w2c.detach(), cam.width, cam.height), settings
    ).features
    return ref


def tangent_of(ref, g, cam, v):
    """The oracle's forward mode along v: J^T u is linear in u, so that its derivative by u is J v."""
    images = {name: getattr(ref, name) for name in FIELDS}
    u = {name: torch.zeros_like(x, requires_grad=True) for name, x in images.items()}
    leaves = {**g.parameters(), "camera": cam.w2c}
    loss = sum((images[name] * u[name]).sum() for name in FIELDS)
    back = dict(zip(leaves, torch.autograd.grad(loss, leaves.values(), create_graph=True), strict=True))
    change = {**v, "camera": -cam.w2c.detach() @ (v["camera"][:, None, None] * twist_basis()).sum(0)}
    found = torch.autograd.grad(sum((back[n].double() * change[n]).sum() for n in leaves), list(u.values()))
    return dict(zip(u, found, strict=True))


@pytest.mark.parametrize(
    "fields", [{}, {"preset": "exact", "extent": 4.0}, {"preset": "exact", "traversal": "bvh", "extent": 4.0}]
)
def test_uncoupled(rng, fields):
    """`couple_features=False`: the feature image has derivatives by the features only, the others by all, both ways."""
    fields = dict(fields)
    settings = Preset(fields.pop("preset", "fast"), **fields)
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 4, 40)
    ref = uncoupled(g, cam, settings)
    u = {n: torch.tensor(rng.normal(size=tuple(getattr(ref, n).shape))) for n in FIELDS}
    for n in FIELDS:
        u[n][ref.ambiguous] = 0
    v = {name: torch.tensor(rng.normal(size=tuple(x.shape))) for name, x in g.parameters().items()}
    v["camera"] = torch.tensor(rng.normal(size=6))
    pushed, wanted = render_jvp(g, cam, v, settings, couple_features=False), tangent_of(ref, g, cam, v)
    for name in FIELDS:
        good = ~ref.ambiguous
        assert relative(getattr(pushed, name)[good].double(), wanted[name][good]) < GRADIENT, name
    out = render(g, cam, settings, couple_features=False)
    found, want = gradients(g, cam, out, u), gradients(g, cam, ref, u)
    for name in want:
        assert relative(found[name], want[name]) < GRADIENT, name
    coupled = gradients(g, cam, render(g, cam, settings), u)
    assert relative(coupled["means"], want["means"]) > 0.1


def test_uncoupled_through_torch(rng):
    """Dual numbers and `torch.func.grad` know `couple_features`, too; a number for it is refused."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 4, 40)
    still = drgs.Camera(cam.K, cam.w2c.detach(), cam.width, cam.height)
    values = {n: x.detach() for n, x in g.parameters().items()}

    def image(values):
        return render(drgs.Gaussians(**values), still, Preset("fast"), couple_features=False).features

    slopes = torch.func.grad(lambda values: image(values).square().sum())(values)
    assert all(bool(x.any()) == (name == "features") for name, x in slopes.items())
    v = {n: torch.tensor(rng.normal(size=tuple(x.shape)), dtype=x.dtype) for n, x in values.items()}
    _, tangent = torch.func.jvp(image, (values,), (v,))
    only = render(drgs.Gaussians(**{**values, "features": v["features"]}), still, Preset("fast")).features
    torch.testing.assert_close(tangent, only, rtol=1e-6, atol=1e-6)  # linear in the features, in float32
    with pytest.raises(ValueError, match="couple_features must be a bool, got the int 0"):
        render(g, cam, couple_features=0)
