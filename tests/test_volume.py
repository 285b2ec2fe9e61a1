"""The true volume: closed forms, limits in which it equals sorted compositing, convergence, gradients."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scenes_random
import torch

from drgs import reference
from drgs.settings import RenderSettings

pytestmark = pytest.mark.core

BACKGROUND = (0.1, 0.2, 0.3)
SORTED = RenderSettings(
    response="integral", order="ray", traversal="bvh", extent=12.0, transmittance_min=0.0, background=BACKGROUND
)


def scene(*items, D=0):
    """Gaussians in float64 from dicts of mean, scale, logit, color, on the axis of the ray unless they say so."""
    n, f64 = len(items), torch.float64
    color = torch.tensor(np.array([i.get("color", (0.7, 0.4, 0.2)) for i in items]), dtype=f64).reshape(n, 3)
    scale = np.array([np.broadcast_to(i.get("scale", 0.1), 3) for i in items]).reshape(n, 3)
    return SimpleNamespace(
        means=torch.tensor([i.get("mean", (0.0, 0.0, 4.0)) for i in items], dtype=f64).reshape(n, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]] * n, dtype=f64).reshape(n, 4),
        log_scales=torch.tensor(scale, dtype=f64).log(),
        logit_opacities=torch.tensor([i.get("logit", 0.4) for i in items], dtype=f64).reshape(n),
        sh=((color - 0.5) * math.sqrt(4 * math.pi))[:, None, :],
        features=torch.arange(n * D, dtype=f64).reshape(n, D) + 1 if D else None,
    )


def along_z(g, **options):
    """The volume on the ray along +z from 0."""
    rays = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[0.0, 0, 2.0]], dtype=torch.float64)
    return reference.render_volume(g, None, SORTED, rays, **options)


def softplus(x):
    return math.log1p(math.exp(x))


@pytest.mark.parametrize("inside", [False, True])
def test_single_gaussian_is_the_integral_response(rng, inside):
    """Off axis, rotated, with SH and features; the camera outside or inside of it."""
    cam = scenes_random.camera(rng, (9, 8))
    g = scenes_random.gaussians(rng, n=1, D=2, spread=0.1, scale=0.5, opacity=0.5)
    if inside:
        g = scenes_random.around_camera(g.replace(log_scales=g.log_scales.detach() + 1), cam)
    with torch.no_grad():
        want, got = reference.render(g, cam, SORTED), reference.render_volume(g, cam, SORTED)
    assert float(want.alpha.max()) > 0.1
    for name in ("rgb", "alpha", "features"):
        torch.testing.assert_close(getattr(got, name), getattr(want, name), rtol=0, atol=2e-12)


def test_separated_gaussians_composite_like_sorted_ones(rng):
    """Ten on a line, 16 sigma apart: nothing overlaps, hence order is all there is."""
    spots = [
        {"mean": (0.02 * rng.normal(), 0.02 * rng.normal(), 2.0 + 0.8 * i), "scale": 0.05, "color": rng.random(3)}
        for i in rng.permutation(10)
    ]
    g = scene(*spots, D=2)
    rays = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[0.01, 0, 1.0]], dtype=torch.float64)
    want, got = reference.render(g, None, SORTED, rays), reference.render_volume(g, None, SORTED, rays)
    for name in ("rgb", "alpha", "features"):
        torch.testing.assert_close(getattr(got, name), getattr(want, name), rtol=0, atol=1e-10)
    # Within a Gaussian what is in front counts for more: its mean depth is less than t*, by less than sigma.
    assert 0 < float(want.depth - got.depth) < 0.05


def test_coincident_gaussians_mix():
    """Equal shapes in one place: weights tau_i / sum tau of 1 - exp(-sum tau), where sorting lets one win."""
    logits, colors = (1.5, -0.5), torch.tensor([[0.9, 0.1, 0.2], [0.1, 0.8, 0.6]], dtype=torch.float64)
    g = scene(*({"logit": x, "color": c.tolist()} for x, c in zip(logits, colors, strict=True)))
    tau = torch.tensor([softplus(x) for x in logits], dtype=torch.float64)
    alpha = 1 - torch.exp(-tau.sum())
    want = (tau / tau.sum()) @ colors * alpha + (1 - alpha) * torch.tensor(BACKGROUND, dtype=torch.float64)
    torch.testing.assert_close(along_z(g).rgb[0], want, rtol=0, atol=1e-12)
    rays = torch.zeros(1, 3).double(), torch.tensor([[0.0, 0, 1.0]]).double()
    assert float((reference.render(g, None, SORTED, rays).rgb[0] - want).abs().max()) > 0.05


def test_overlapping_gaussians_by_brute_force(rng):
    """A Riemann sum of 400,000 steps, written out."""
    spots = [
        {"mean": (0, 0, z), "scale": s, "logit": x, "color": rng.random(3)}
        for z, s, x in zip(rng.uniform(-0.5, 3, 8), rng.uniform(0.2, 1, 8), rng.normal(size=8) * 2, strict=True)
    ]
    g = scene(*spots)
    edges = np.linspace(0, 12, 400_001)
    t, dt = (edges[1:] + edges[:-1]) / 2, edges[1]
    density = np.stack(
        [
            softplus(i["logit"]) * np.exp(-(((t - i["mean"][2]) / i["scale"]) ** 2) / 2)
            / (i["scale"] * math.sqrt(2 * math.pi))
            for i in spots
        ]
    )  # fmt: skip
    total = density.sum(0)
    depth = np.cumsum(total) * dt - total * dt / 2
    color = (np.exp(-depth) * density * dt) @ np.ones(len(t))
    end = math.exp(-total.sum() * dt)
    want = color @ np.stack([i["color"] for i in spots]) + end * np.array(BACKGROUND)
    got = along_z(g)
    np.testing.assert_allclose(got.rgb[0], want, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.depth[0], (np.exp(-depth) * total * t).sum() * dt / (1 - end), rtol=0, atol=1e-8)


def test_converged(rng):
    """Twice the nodes, a looser tolerance, and the estimate bounds the difference."""
    cam = scenes_random.camera(rng, (8, 7))
    g = scenes_random.around_camera(scenes_random.gaussians(rng, n=60, scale=0.3, opacity=4), cam)
    with torch.no_grad():
        fine, finer = (reference.render_volume(g, cam, SORTED, split=n) for n in (1, 2))
        loose = reference.render_volume(g, cam, SORTED, tolerance=1e-4)
        in_order = reference.render(g, cam, SORTED)
    assert float((fine.rgb - finer.rgb).abs().max()) < 1e-12
    assert float(fine.error.max()) < 1e-9
    assert (finer.nodes > 1.3 * fine.nodes).all()
    assert (loose.nodes <= fine.nodes).all()
    assert ((loose.rgb - fine.rgb).abs().amax(-1) <= loose.error + 1e-12).all()
    assert float((loose.rgb - fine.rgb).abs().max()) < 1e-5
    assert float((in_order.rgb - fine.rgb).abs().max()) > 1e-3


def test_gradients_against_finite_differences(rng):
    """All groups and the pose, of a scene with overlap, opaque and transparent Gaussians."""
    cam = scenes_random.camera(rng, (3, 2))
    g = scenes_random.around_camera(scenes_random.gaussians(rng, n=8, K=4, D=1, scale=0.5, opacity=3), cam)
    values = {name: x.detach().double() for name, x in g.parameters().items()}
    u = torch.tensor(rng.normal(size=(2, 3, 5)))

    def loss(values, w2c):
        c = SimpleNamespace(K=cam.K, width=3, height=2, w2c=w2c)
        out = reference.render_volume(g.replace(**values), c, SORTED, tolerance=1e-12)
        return (torch.cat([out.rgb, out.alpha[..., None], out.features], -1) * u).sum()

    leaves = {name: x.clone().requires_grad_() for name, x in values.items()}
    pose = cam.w2c.detach().clone().requires_grad_()
    loss(leaves, pose).backward()
    with torch.no_grad():
        for name, x in values.items():
            v = torch.tensor(rng.normal(size=tuple(x.shape)))
            ends = [loss({**values, name: x + h * v}, pose) for h in (1e-5, -1e-5)]
            slope = float(ends[0] - ends[1]) / 2e-5
            want = float((leaves[name].grad * v).sum())
            assert abs(want) > 1e-6, name
            assert slope == pytest.approx(want, rel=1e-5, abs=1e-7), name
        v = (torch.tensor(rng.normal(size=6))[:, None, None] * scenes_random.twist_basis()).sum(0)
        ends = [loss(values, pose @ torch.linalg.matrix_exp(h * v)) for h in (1e-5, -1e-5)]
        assert float(ends[0] - ends[1]) / 2e-5 == pytest.approx(float((pose.grad * (pose @ v)).sum()), rel=1e-5)


@pytest.mark.parametrize(
    ("scale", "logit"), [(1e-7, 1.0), (1e-13, 1.0), (1e4, 8.0), (0.1, 1e3), (0.1, -700.0), (1e-150, 40.0)]
)
def test_extremes_stay_finite(scale, logit):
    """Thin, huge, opaque and invisible beside an ordinary one: the closed form where they do not overlap, no NaN."""
    first = {"mean": (0, 0, 2.0), "scale": scale, "logit": logit, "color": (0.2, 0.9, 0.4)}
    g = scene(first, {"mean": (0, 0, 5.0), "scale": 0.1, "color": (0.8, 0.1, 0.1)})
    leaves = [x.requires_grad_() for x in (g.means, g.quats, g.log_scales, g.logit_opacities, g.sh)]
    out = along_z(g)
    out.rgb.sum().backward()
    assert all(bool(torch.isfinite(x.grad).all()) for x in leaves)
    assert float(out.error) < 1e-9
    rays = torch.zeros(1, 3).double(), torch.tensor([[0.0, 0, 1.0]]).double()
    if scale < 1:
        want = reference.render(g, None, SORTED, rays).rgb
        torch.testing.assert_close(out.rgb.detach(), want.detach(), rtol=0, atol=1e-10)


def test_opaque_overlap_has_a_limit():
    """Two of optical depth 2,000, the nearer one half a sigma in front: the thin layer that is seen is resolved."""
    near, far = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1)
    g = scene(
        {"mean": (0, 0, 4.0), "scale": 1.0, "logit": 2000.0, "color": near},
        {"mean": (0, 0, 4.5), "scale": 1.0, "logit": 2000.0, "color": far},
    )
    out, again = along_z(g), along_z(g, split=3)
    torch.testing.assert_close(out.rgb, again.rgb, rtol=0, atol=1e-11)
    # Their densities are as exp(-u / 2 - 1 / 8) : 1 at u sigma behind the nearer mean: both are seen 3 sigma before it,
    # where the nearer one is denser.
    share = float((out.rgb[0, 0] - far[0]) / (near[0] - far[0]))
    assert 0.5 < share < 1.0


def test_many_coincident_gaussians():
    """2,000 in one place are one of 2,000 times the depth."""
    one = {"mean": (0, 0, 3.0), "logit": -3.0}
    g = scene(*[one] * 2000)
    got = along_z(g)
    alpha = 1 - math.exp(-2000 * softplus(-3.0))
    assert float(got.alpha) == pytest.approx(alpha, abs=1e-12)
    want = alpha * torch.tensor([0.7, 0.4, 0.2]) + (1 - alpha) * torch.tensor(BACKGROUND, dtype=torch.float64)
    torch.testing.assert_close(got.rgb[0], want.double(), rtol=0, atol=1e-7)


def test_nothing_to_see():
    """No Gaussian, and all of them behind the camera."""
    torch.testing.assert_close(along_z(scene()).rgb[0], torch.tensor(BACKGROUND, dtype=torch.float64))
    behind = along_z(scene({"mean": (0, 0, -5.0)}))
    torch.testing.assert_close(behind.rgb[0], torch.tensor(BACKGROUND, dtype=torch.float64))
    assert float(behind.alpha) == 0
    assert int(behind.nodes) == 0


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("preset", "response"),
    [("exact", "peak"), ("exact", "integral"), ("exact", "ewa"), ("inria", "ewa"), ("gsplat", "ewa")],
)
def test_windows_are_parts_of_the_image(rng, preset, response):
    """Both oracles: the window of an image is that part of it, tiles and clamps of the whole image included."""
    cam = scenes_random.camera(rng, (40, 36), focal=24)
    g = scenes_random.around_camera(scenes_random.gaussians(rng, n=40), cam)
    order = "center" if response == "ewa" else "ray"
    s = RenderSettings.preset(preset, response=response, order=order, background=BACKGROUND)
    x, y, w, h = window = (21, 3, 7, 15)
    with torch.no_grad():
        whole, part = reference.render(g, cam, s), reference.render(g, cam, s, window=window)
        volume, piece = reference.render_volume(g, cam, s), reference.render_volume(g, cam, s, window=window)
    rows = slice(y, y + h), slice(x, x + w)
    for name in ("rgb", "alpha", "depth", "median_depth", "count", "ambiguous"):
        torch.testing.assert_close(getattr(part, name), getattr(whole, name)[rows], rtol=1e-13, atol=1e-13, msg=name)
    assert float(part.visibility.sum()) == pytest.approx(float(part.alpha.sum()))
    torch.testing.assert_close(piece.rgb, volume.rgb[rows], rtol=0, atol=1e-9)


def test_bad_arguments(rng):
    """One line each."""
    g, cam = scene({}), scenes_random.camera(rng, (8, 6))
    with pytest.raises(ValueError, match="window: must lie in the image of 8x6 pixels, got .*; correct it"):
        reference.render_volume(g, cam, window=(4, 4, 5, 1))
    with pytest.raises(ValueError, match="must come with a camera's own rays"):
        reference.render_volume(g, cam, rays=(torch.zeros(3), torch.ones(3)), window=(0, 0, 1, 1))
    with pytest.raises(ValueError, match="split must be >= 1"):
        reference.render_volume(g, cam, split=0)
    with pytest.raises(ValueError, match="need cam"):
        reference.render_volume(g, None)
