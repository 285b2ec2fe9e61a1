"""Gaussians by their covariances: images and derivatives of `drgs.rasterization(..., covars=)`."""

from __future__ import annotations

import math

import pytest
import torch
from test_rasterize import arguments
from test_rasterize_rays import oracle

import drgs
from drgs.cameras import Camera
from drgs.settings import RenderSettings
from drgs.splats.covariances import factors

SHAPES = {
    "any": (0.5, 0.3, 0.2),
    "sphere": (0.3, 0.3, 0.3),
    "nearly a sphere": (0.3, 0.3 * (1 + 1e-9), 0.3 * (1 - 1e-9)),
    "disc": (0.4, 0.4, 0.01),
    "needle": (0.5, 0.02, 0.02),
}
PATHS = {
    "image plane": ({}, RenderSettings.preset("gsplat")),
    "along rays": ({"with_eval3d": True}, RenderSettings.preset("3dgut", culling="extent")),
    "exact": ({"preset": "exact"}, RenderSettings.preset("exact")),
    "own rays": ({"with_eval3d": True}, RenderSettings.preset("3dgut", culling="extent")),
}


def covariances_of(given, shape=None):
    """The covariances of the arguments, with other standard deviations."""
    scales = given["scales"]
    if shape is not None:
        scales = torch.tensor(shape, dtype=torch.float64).expand(len(given["means"]), 3)
    axes = drgs.ellipsoids.semi_axes(given["quats"], scales)
    return axes @ axes.mT


@pytest.mark.every(7)
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_of_covariances(shape, path):
    """Central differences of the oracle along every element of every covariance, where eigenvalues coincide, too."""
    options, settings = PATHS[path]
    given = {**arguments(n=3, width=20, height=16, seed=2), "quats": None, "scales": None}
    given["means"] = torch.tensor([[-0.4, 0.1, 3.0], [0.5, 0.3, 3.5], [0.1, -0.3, 4.0]], dtype=torch.float64)
    given["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    given["opacities"] = torch.tensor([0.7, 0.8, 0.6], dtype=torch.float64)
    make = torch.Generator().manual_seed(7)
    quats = torch.randn(3, 4, generator=make, dtype=torch.float64)
    covars = covariances_of({**given, "quats": quats}, SHAPES[shape]).requires_grad_()
    camera = Camera(K=given["Ks"][0].numpy(), w2c=given["viewmats"][0].numpy(), width=20, height=16)
    if path == "own rays":
        d = torch.from_numpy(camera.pixel_directions())
        options = {**options, "rays": torch.cat([torch.zeros_like(d), d], -1)[None]}
    image = drgs.rasterization(**given, covars=covars, **options)[0]

    def drawn(moved):
        quats, scales, _ = factors("test", moved)
        return oracle({**given, "quats": quats, "scales": scales}, {}, settings)

    out, expected = drawn(covars.detach())
    good = ~out.ambiguous[..., None]
    assert float(((image[0] - expected).abs() * good).max()) < 2e-5
    u = torch.randn(image[0].shape, generator=make, dtype=torch.float64) * good
    (found,) = torch.autograd.grad((image[0] * u).sum(), [covars])
    assert torch.allclose(found, found.mT)
    values, axes = torch.linalg.eigh(covars.detach())
    h = 1e-5
    for i in range(3):
        slopes, wanted = [], []
        for j, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
            along = torch.zeros(3, 3, dtype=torch.float64)  # as large as the Gaussian is along these of its axes
            along[j, k] = along[k, j] = (values[i, j] * values[i, k]).sqrt()
            step = torch.zeros(3, 3, 3, dtype=torch.float64)
            step[i] = axes[i] @ along @ axes[i].mT
            sums = [float((drawn(covars.detach() + sign * h * step)[1] * u).sum()) for sign in (1, -1)]
            wanted.append((sums[0] - sums[1]) / (2 * h))
            slopes.append(float((found * step).sum()))
        slopes, wanted = torch.tensor(slopes), torch.tensor(wanted)
        assert float((slopes - wanted).norm()) < 1e-3 * float(wanted.norm())


@pytest.mark.parametrize("mode", ["classic", "antialiased", "rays"])
def test_covariances_of_quaternions_and_scales(mode):
    """Images are the same, and so are gradients of what covariances are made of, in both modes of differentiation."""
    options = {"with_eval3d": True} if mode == "rays" else {"rasterize_mode": mode}
    given = arguments(n=12, width=20, height=16)
    make = torch.Generator().manual_seed(5)
    names = ("quats", "scales")

    def direct(quats, scales):
        return drgs.rasterization(**{**given, "quats": quats, "scales": scales}, **options)[0]

    def through(quats, scales):
        covars = covariances_of({"means": given["means"], "quats": quats, "scales": scales})
        return drgs.rasterization(**{**given, "quats": None, "scales": None}, covars=covars, **options)[0]

    u = torch.randn(1, 16, 20, 3, generator=make, dtype=torch.float64)
    results = []
    for call in (direct, through):
        leaves = [given[name].clone().requires_grad_() for name in names]
        image = call(*leaves)
        results.append((image.detach(), *torch.autograd.grad((image * u).sum(), leaves)))
    assert torch.allclose(results[0][0], results[1][0], atol=2e-5)
    for a, b in zip(results[0][1:], results[1][1:], strict=True):
        assert float((a - b).norm()) < 1e-4 * float(a.norm())
    tangents = tuple(0.1 * torch.randn(given[name].shape, generator=make, dtype=torch.float64) for name in names)
    moved = [torch.func.jvp(call, tuple(given[name] for name in names), tangents)[1] for call in (direct, through)]
    assert float((moved[0] - moved[1]).norm()) < 1e-4 * float(moved[0].norm())


def test_covariances_that_are_none():
    given = {**arguments(n=8), "quats": None, "scales": None}
    covars = covariances_of(arguments(n=8))
    for bad, message in (
        (covars - 2 * torch.eye(3), "without a negative eigenvalue"),
        (covars + torch.ones(3, 3).triu(1), "symmetric to 1e-5"),
        (covars[:4], r"covars must be a tensor of shape \(8, 3, 3\), got \(4, 3, 3\); pass matrices"),
        (covars.numpy(), r"covars must be a tensor of shape \(8, 3, 3\), got ndarray; pass matrices"),
        (covars * math.nan, "covars must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            drgs.rasterization(**given, covars=bad)
    flat = torch.zeros(8, 3, 3, dtype=torch.float64).requires_grad_()
    image = drgs.rasterization(**given, covars=flat)[0]
    (found,) = torch.autograd.grad(image.square().sum(), [flat])
    assert torch.isfinite(found).all()
    assert found.any()  # a point is dilated, and would be wider


@pytest.mark.parametrize("path", PATHS)
def test_flat_gaussians(path):
    """Without an extent along one axis: images and derivatives are those of a Gaussian with next to none."""
    options, _ = PATHS[path]
    given = {**arguments(n=3, width=20, height=16, seed=2), "quats": None, "scales": None}
    given["means"] = torch.tensor([[-0.4, 0.1, 3.0], [0.5, 0.3, 3.5], [0.1, -0.3, 4.0]], dtype=torch.float64)
    given["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    given["opacities"] = torch.tensor([0.7, 0.8, 0.6], dtype=torch.float64)
    quats = torch.randn(3, 4, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    if path == "own rays":
        camera = Camera(K=given["Ks"][0].numpy(), w2c=given["viewmats"][0].numpy(), width=20, height=16)
        d = torch.from_numpy(camera.pixel_directions())
        options = {**options, "rays": torch.cat([torch.zeros_like(d), d], -1)[None]}
    found = []
    for thin in (2e-5, 0.0):
        covars = covariances_of({**given, "quats": quats}, (0.4, 0.3, thin)).requires_grad_()
        image = drgs.rasterization(**given, covars=covars, **options)[0]
        u = torch.linspace(-1, 1, image.numel(), dtype=torch.float64).reshape(image.shape)
        found.append((image.detach(), torch.autograd.grad((u * image).sum(), covars)[0]))
    (near, slopes), (flat, at_zero) = found
    torch.testing.assert_close(flat, near, rtol=0, atol=1e-5)
    axes = drgs.ellipsoids.semi_axes(quats, torch.ones(3, 3, dtype=torch.float64))
    slopes, at_zero = (axes.mT @ x @ axes for x in (slopes, at_zero))
    torch.testing.assert_close(at_zero, slopes, rtol=2e-3, atol=1e-4)
