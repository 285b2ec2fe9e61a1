"""Feature images: against the float64 oracle, in both modes, coupled to geometry and not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes_random import FIELDS, Oracle, camera, compare, gaussians, gradients, relative, twist_basis

import drgs
from drgs import reference
from drgs.integrator import OUTPUTS, render, render_jvp, render_rays
from drgs.tracing import composite, walk, weights

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
    rays = torch.zeros(3), torch.ones(3)
    for call in (
        lambda: render(g, cam, couple_features=0),
        lambda: render_jvp(g, cam, {"camera": torch.zeros(6)}, couple_features=0),
        lambda: render_rays(g, *rays, couple_features=0),
    ):
        with pytest.raises(ValueError, match="couple_features must be a bool, got the int 0"):
            call()


WIDTHS = {
    1: {"preset": "exact", "extent": 4.0, "background": (0.2, 0.5, 0.9)},
    3: {"preset": "exact", "order": "center", "response": "integral", "alpha_max": 0.9, "extent": 3.0},
    128: {"preset": "fast", "transmittance_min": 0.2, "background": (0.2, 0.5, 0.9)},
    512: {"preset": "inria", "near": 0.0, "max_hits": 4},
}


def settings_of(width):
    """Of `WIDTHS`."""
    fields = dict(WIDTHS[width])
    return Preset(fields.pop("preset"), **fields)


@pytest.mark.every(4)
@pytest.mark.parametrize("width", WIDTHS)
def test_any_width(rng, width):
    """Images, all gradients and forward mode against the oracle."""
    settings = settings_of(width)
    # Opacities from nearly none to nearly 1, behind which there is next to nothing.
    cam, g = camera(rng, (11, 9)), gaussians(rng, 24, 4, width, scale=0.3, opacity=6.0)
    errors = compare(g, cam, settings, Oracle(g, cam, settings, rng))
    assert errors.finite
    for name, error in errors.image.items():
        assert error <= IMAGE * (max(1, float(g.features.detach().abs().max())) if name == "features" else 1), name
    for name, error in {**errors.gradient, **errors.forward}.items():
        assert error <= GRADIENT, (name, error)
    assert errors.duality <= GRADIENT


def everything(g, cam, settings, **options):
    """Image of features, gradients of a loss of all images by all groups, and tangents."""
    rng = np.random.default_rng(3)
    out = render(g, cam, settings, outputs="all", **options)
    u = {n: torch.tensor(rng.normal(size=tuple(getattr(out, n).shape))) for n in FIELDS}
    v = {name: torch.tensor(rng.normal(size=tuple(x.shape))) for name, x in g.parameters().items()}
    pushed = render_jvp(g, cam, v, settings, **options)
    return {
        **{name: getattr(out, name).detach() for name in (*FIELDS, "visibility")},
        **{f"gradient of {name}": x for name, x in gradients(g, cam, out, u).items()},
        **{f"tangent of {name}": getattr(pushed, name) for name in FIELDS},
    }


@pytest.mark.slow
@pytest.mark.parametrize("width", [128, 1])
def test_blocks_of_weights(rng, width, monkeypatch):
    """Weights that are held for a few tiles at a time give the same, and are never more than the bound."""
    cam, g = camera(rng, (29, 21)), gaussians(rng, 40, 4, 24)
    settings, sizes, zeros = settings_of(width), [], weights.Weights.zeros
    monkeypatch.setattr(walk, "BUFFER", 2)

    def noted(held):
        sizes.append((len(held.lengths), zeros(held)))
        return sizes[-1][1]

    for couple in (True, False)[: 1 + (width == 128)]:  # each compiles kernels
        whole = everything(g, cam, settings, couple_features=couple)
        with monkeypatch.context() as small:
            small.setattr(composite, "MATRIX", 12 << 10)
            small.setattr(weights, "_PRODUCT_BYTES", 1 << 10)
            small.setattr(weights.Weights, "zeros", noted)
            parts = everything(g, cam, settings, couple_features=couple)
        for name, x in whole.items():
            # Sums in another order, in float32.
            assert relative(parts[name].double(), x.double()) < 1e-5, name
    assert len(sizes) > 20
    # One row more than there are entries; a tile alone may need more than the bound.
    assert all(tiles == 1 or 4 * (len(x) - weights.PIXELS) <= 12 << 10 for tiles, x in sizes)


def test_threads_of_torch_do_not_matter(rng):
    """A list of 2,000 faint Gaussians in one tile: the same bits of the image with any number of torch's threads."""
    cam, threads, images = camera(rng, (8, 8)), torch.get_num_threads(), []
    g = gaussians(rng, 2000, 1, 24, scale=0.3).detach().replace(logit_opacities=torch.full((2000,), -5.0))
    settings = Preset("exact", order="center", transmittance_min=0.0)
    try:
        for count in (1, 2, 3, 8):
            torch.set_num_threads(count)
            images.append(render(g, cam, settings).features.detach())
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(images[0], image) for image in images)


def test_products_are_bounded(rng, monkeypatch):
    """However few entries tiles have, no product holds more rows of features, or of pixels, than there is room for."""
    sizes, gathered = [], weights._gathered

    def noted(cotangent, group):
        sizes.append(gathered(cotangent, group))
        return sizes[-1]

    monkeypatch.setattr(weights, "_PRODUCT_BYTES", 4 * 24 * 64 * 2)  # bytes of the pixels of two tiles
    monkeypatch.setattr(weights, "_gathered", noted)
    g, cam = gaussians(rng, 40, 4, 24), camera(rng, (29, 21))
    render(g, cam, settings_of(128)).features.square().sum().backward()
    assert max(len(x) for x in sizes) == 2


def test_without_features_nothing_is_held(rng, monkeypatch):
    """A scene without features asks for no weights and no products; one without Gaussians has an image of zeros."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 4, 0)

    def fails(*arguments):
        raise AssertionError("weights are held")

    for name in ("__init__", "zeros", "survey", "image", "gradient", "push"):
        monkeypatch.setattr(weights.Weights, name, fails)
    render(g, cam, Preset("fast"), outputs=OUTPUTS).rgb.sum().backward()
    render_jvp(g, cam, {"means": torch.ones(12, 3)}, Preset("fast"))
    with pytest.raises(RuntimeError):  # Dr.Jit's, of the error above
        render(g.replace(features=torch.ones(12, 3)), cam, Preset("fast"))
    empty = gaussians(rng, 0, 1, 5)
    assert render(empty, cam, Preset("fast")).features.shape == (7, 9, 5)
    assert not render(empty, cam, Preset("fast")).features.any()


def test_features_that_are_no_numbers(rng):
    """NaN and infinite features are refused; a loss that leaves the features out has no gradient by them."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 1, 3)
    for bad in (float("nan"), float("inf")):
        features = g.features.detach().clone()
        features[4, 1] = bad
        with pytest.raises(ValueError, match="features must be finite"):
            render(g.replace(features=features), cam, Preset("fast"))
    render(g, cam, Preset("fast")).rgb.sum().backward()
    assert not g.features.grad.any()
