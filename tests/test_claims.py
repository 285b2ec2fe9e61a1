"""What `exact` claims, against rays that nothing is cut off from: values, every derivative, Fisher information."""

from __future__ import annotations

import dataclasses
import math

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from scenes_random import Oracle, around_camera, camera, compare, gaussians, gradients, relative
from scipy.optimize import brentq
from test_integrator import check

import drgs
from drgs import fisher, reference, render, render_jvp, runtime
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.settings import RenderSettings
from drgs.tracing.primitives import TOLERANCE, Activated

EXACT = RenderSettings.preset("exact")
KINDS = {
    "tiles": EXACT,
    "bvh": EXACT.replace(traversal="bvh"),
    "center": EXACT.replace(order="center"),
    "integral": EXACT.replace(response="integral"),
    "integral on bvh": EXACT.replace(response="integral", traversal="bvh"),
    "ewa": EXACT.replace(response="ewa", order="center"),
}
GROUPS = ("means", "quats", "log_scales", "logit_opacities", "sh", "features", "camera")
NO_DEPTH = ("rgb", "alpha", "features")  # with a depth, tiles leave fewer tails out


def uncut(settings):
    """Settings of an oracle without any cut: nor does a transmittance end its rays."""
    return settings.replace(transmittance_min=0.0)


def _extents(g, settings):
    """Radii that the renderer gives to Gaussians."""
    lib = runtime.dr_types()
    raw = {name: x.detach().double().numpy().ravel() for name, x in g.parameters().items()}
    pose = lib.Float64(np.eye(4)[:3].ravel())
    at_most_alpha = settings.response != "integral"
    p = {name: lib.Float64(x) for name, x in raw.items()}
    return Activated(lib, p, pose, settings, at_most_alpha).extent.numpy()


@pytest.mark.core
@pytest.mark.parametrize("response", ["peak", "integral"])
def test_extents(rng, response):
    """strength (1 + r^2) exp(-r^2 / 2) = 1e-5, with N times an opacity or optical depth, or 1."""
    g = gaussians(rng, 40, 1, opacity=8.0)
    found = _extents(g, EXACT.replace(response=response))
    logits = g.logit_opacities.detach().double()
    strength = torch.sigmoid(logits) if response == "peak" else torch.nn.functional.softplus(logits)
    for r, s in zip(found, (40 * strength).clamp(min=1).tolist(), strict=True):
        want = brentq(lambda x, s=s: math.log(s) + math.log1p(x * x) - x * x / 2 - math.log(TOLERANCE), 3, 20)
        assert r == pytest.approx(want, rel=1e-5)
    assert found.min() == pytest.approx(5.467, abs=1e-3)
    assert (_extents(g, EXACT.replace(extent=3.0)) == 3.0).all()


@pytest.mark.every(2)
@pytest.mark.parametrize("name", KINDS)
def test_ordinary_scenes(rng, name):
    """Images within 1e-5, derivatives within 1e-4, in quaternions of all lengths and opacities from 1e-4 on, too."""
    settings = KINDS[name]
    for k in range(6):
        cam = camera(rng, (16, 11), skew=0.2)
        options = {"anisotropy": (0.1, 0.5, 1.2)[k % 3], "opacity": (1.0, 3.0)[k % 2]}
        g = gaussians(rng, int(rng.integers(10, 26)), 4, 2, **options)
        if k % 2:
            around_camera(g, cam)
        check(compare(g, cam, settings, Oracle(g, cam, uncut(settings), rng, names=NO_DEPTH), outputs=()))
        check(compare(g, cam, settings, Oracle(g, cam, uncut(settings), rng)))


@pytest.mark.parametrize("name", ["tiles", "bvh"])
def test_lists_that_hold_few_of_many(rng, name):
    """Of 600 Gaussians a tile lists few, and bounds the tails of these alone."""
    settings = KINDS[name]
    cam, g = camera(rng, (32, 24)), gaussians(rng, 600, 1, 2, scale=0.04)
    oracle = Oracle(g, cam, uncut(settings), rng, names=NO_DEPTH)
    errors = compare(g, cam, settings, oracle, outputs=())
    check(errors)
    if name == "tiles":
        pairs = [render(g.detach(), cam, settings, outputs=names).certificate["pairs"] for names in ((), "count")]
        assert pairs[0] < 0.99 * pairs[1]


def fisheye(rng, size=(24, 20), degrees=175.0):
    """A fisheye that sees so much across the image."""
    cam = camera(rng, size, center=(size[0] / 2, size[1] / 2))
    f = 0.5 * size[0] / math.radians(degrees / 2)
    K = np.array([[f, 0, size[0] / 2], [0, f, size[1] / 2], [0, 0, 1.0]])
    return dataclasses.replace(cam, K=K, model="opencv_fisheye", distortion=(0.0, 0.0, 0.0, 0.0))


@pytest.mark.every(2)
@pytest.mark.parametrize("name", ["tiles", "bvh", "integral"])
@pytest.mark.parametrize("where", ["in front", "around"])
def test_175_degrees(rng, name, where):
    """Derivatives by the lens, too: those by rays of the oracle, times differences of the camera's own rays."""
    settings = KINDS[name]
    cam = fisheye(rng)
    g = gaussians(rng, 20, 4, 2)
    if where == "around":
        around_camera(g, cam)
    oracle = Oracle(g, cam, uncut(settings), rng, names=NO_DEPTH)
    check(compare(g, cam, settings, oracle, outputs=()))
    lens = torch.tensor(cam.lens_parameters, requires_grad=True)
    out = render(g.detach(), cam, settings, outputs=(), lens=lens)
    (found,) = torch.autograd.grad(sum((getattr(out, n).double() * u).sum() for n, u in oracle.u.items()), lens)
    directions = torch.tensor(cam.pixel_directions(), requires_grad=True)
    unit = torch.nn.functional.normalize(directions, dim=-1)
    plain = Camera(K=cam.K, w2c=cam.w2c.detach(), width=cam.width, height=cam.height)
    rays = torch.tensor(cam.center).expand(unit.shape), unit
    truth = reference.render(g.detach(), plain, uncut(settings), rays=rays)
    loss = sum((getattr(truth, n) * u).sum() for n, u in oracle.u.items())
    (slope,) = torch.autograd.grad(loss, directions)
    at = cam.lens_parameters
    steps = 1e-5 * np.where(np.arange(len(at)) < 5, abs(at) + 1, 0.1)[:, None] * np.eye(len(at))
    ends = [[cam.with_lens(at + sign * step).pixel_directions() for sign in (1, -1)] for step in steps]
    want = [float((slope * torch.tensor(a - b)).sum()) / (2 * s.max()) for (a, b), s in zip(ends, steps, strict=True)]
    assert relative(found, torch.tensor(want)) < 1e-4


@pytest.mark.parametrize("name", KINDS)
def test_faint_gaussians(rng, name):
    """Derivatives and Fisher information of opacities 1e-4, 1e-5 and 1e-8, each relative to itself."""
    settings = KINDS[name]
    cam, g = camera(rng, (16, 11)), gaussians(rng, 12, 4, 2, scale=0.3)
    with torch.no_grad():
        g.logit_opacities[:] = torch.logit(10.0 ** -torch.tensor([4.0, 5.0, 8.0]).double()).repeat(4)
    truth = reference.render(g, cam, uncut(settings))
    # Of one sign, so that no derivative by an opacity is a small sum of large parts.
    u = {name: torch.tensor(rng.uniform(0.5, 1.5, tuple(getattr(truth, name).shape))) for name in NO_DEPTH}
    if settings.traversal == "bvh":
        # A hit that Mitsuba loses (docs/numerics.md) may be a large part of what a Gaussian has.
        whole, found = (
            render(g.detach(), cam, settings.replace(traversal=t), outputs="count").count for t in ("tiles", "bvh")
        )
        assert int((whole != found).sum()) <= 2
        u = {name: x * (whole == found).reshape(*whole.shape, *[1] * (x.ndim - 2)) for name, x in u.items()}
    (slope,) = torch.autograd.grad((truth.alpha * u["alpha"]).sum(), g.logit_opacities, retain_graph=True)
    found, wanted = (gradients(g, cam, out, u) for out in (render(g, cam, settings, outputs=()), truth))
    for group in GROUPS[:-1]:
        for i in range(len(g)):
            assert relative(found[group][i], wanted[group][i], 1e-300) < 1e-4, (group, i)
    assert relative(found["camera"], wanted["camera"], 1e-300) < 1e-4
    pushed = render_jvp(g, cam, {"logit_opacities": torch.eye(12)[2]}, settings, outputs=()).alpha.double()
    assert float((pushed * u["alpha"].detach()).sum()) == pytest.approx(float(slope[2]), rel=1e-4)
    information = fisher.diagonal(g, cam, settings)
    assert all(bool(torch.isfinite(x).all()) for x in information.values())
    assert bool((information["logit_opacities"] > 0).all())
    if settings.traversal == "tiles":
        J = dense.jacobian(g, reference.render(g, cam, uncut(settings)))
        for group, x in dense.squares(J).items():
            found, own = (y.reshape(len(g), -1) for y in (information[group], x))
            assert float(((found - own).abs() / own.amax(1, keepdim=True)).max()) < 1e-4, group


@pytest.mark.parametrize("traversal", ["tiles", "bvh"])
def test_opacities_of_0_and_1(rng, traversal):
    """`rasterization` returns the derivative by an opacity of 0, so that a Gaussian can come back: sum T (c - B) g."""
    n = 10
    g, cam = gaussians(rng, n, 1).detach(), camera(rng, (16, 11))
    means, quats, scales = g.means.double(), g.quats.double(), g.scales.double()
    view = {"viewmats": cam.w2c.detach()[None], "Ks": torch.tensor(cam.K)[None], "width": 16, "height": 11}
    colors = torch.tensor(rng.uniform(0, 1, (n, 3)))
    opacities = torch.tensor([0.0, 1.0, 0.5, 0.0, 0.7, 1.0, 0.3, 0.0, 0.6, 0.4], dtype=torch.float64)
    u = torch.tensor(rng.normal(size=(1, 11, 16, 3)))

    def slope(values):
        leaf = values.clone().requires_grad_()
        settings = EXACT.replace(traversal=traversal)
        image, alpha, _ = drgs.rasterization(means, quats, scales, leaf, colors, **view, preset=settings)
        assert torch.isfinite(image).all()
        assert torch.isfinite(alpha).all()
        return torch.autograd.grad((image * u).sum(), leaf)[0]

    found = slope(opacities)
    sh = ((colors - 0.5) / 0.28209479177387814)[:, None]
    inner = opacities.clamp(1e-12, 1 - 2.0**-26)
    made = Gaussians(means, quats, scales.log(), torch.logit(inner).requires_grad_(), sh)
    truth = reference.render(made, cam, uncut(EXACT))
    assert bool(~truth.ambiguous.any())
    by_logit = torch.autograd.grad((truth.rgb * u[0]).sum(), made.logit_opacities)[0]
    want = by_logit / (inner * (1 - inner))
    assert float(want[opacities == 0].abs().min()) > 1e-3
    for i in range(n):
        assert float(found[i]) == pytest.approx(float(want[i]), rel=1e-4), i


@pytest.mark.parametrize("traversal", ["tiles", "bvh"])
@pytest.mark.parametrize("n", [0, 1])
def test_one_gaussian_and_none(rng, traversal, n):
    """Whatever the opacity, everything is finite; and of one Gaussian it is the oracle's."""
    settings = EXACT.replace(traversal=traversal)
    for logit in (-200.0, -30.0, 0.0, 30.0, 200.0):
        g, cam = gaussians(rng, n, 1, scale=0.5), camera(rng, (9, 7))
        with torch.no_grad():
            g.logit_opacities[:] = logit
        errors = compare(g, cam, settings, Oracle(g, cam, uncut(settings), rng))
        check(errors)
        for x in fisher.diagonal(g, cam, settings).values():
            assert torch.isfinite(x).all()


def test_presets_with_an_extent_keep_it(rng):
    """Where an extent is given the adaptive one has no part: as the oracle, which cuts there, they lose hits."""
    cam, g = camera(rng, (24, 22)), gaussians(rng, 20, 1)
    for name in ("fast", "mitsuba"):
        settings = RenderSettings.preset(name)
        truth = reference.render(g, cam, settings)
        image = render(g, cam, settings)
        assert float((image.rgb - truth.rgb)[~truth.ambiguous].detach().abs().max()) < 1e-5
        whole = reference.render(g, cam, settings.replace(extent=12.0))
        assert float((truth.rgb - whole.rgb).detach().abs().max()) > 1e-3
