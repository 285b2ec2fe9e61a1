"""The float64 oracle: closed forms, quadrature, symmetries, gradients, other people's images."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import oracle_rasterizers
import pytest
import torch

from drgs.oracle import reference, sh_basis
from drgs.reference import render
from drgs.settings import RenderSettings

pytestmark = pytest.mark.core

LEGAL = [
    *[(r, o) for r in ("peak", "integral") for o in ("center", "ray", "entry")],
    ("ewa", "center"),
]
NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh", "features")


def _f64(values):
    return torch.as_tensor(values, dtype=torch.float64)


def _settings(response="peak", order="center", **fields):
    return RenderSettings(response=response, order=order, traversal="tiles" if response == "ewa" else "bvh", **fields)


def _camera(width=8, height=6, focal=8.0, w2c=None, center=None):
    cx, cy = center or (width / 2, height / 2)
    w2c = np.eye(4) if w2c is None else w2c
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    return SimpleNamespace(K=K, w2c=w2c, width=width, height=height)


def _gaussians(*items, K=1, D=None):
    """From dicts of mean, scale, opacity, color, quat."""
    n = len(items)
    sh = torch.zeros(n, K, 3).double()
    if n:
        color = _f64([i.get("color", (0.7, 0.4, 0.2)) for i in items])
        sh[:, 0] = (color - 0.5) * math.sqrt(4 * math.pi)
    scale = [_f64(i.get("scale", 0.1)).expand(3).tolist() for i in items]

    def column(name, default, shape):
        return _f64([i.get(name, default) for i in items]).reshape(n, *shape)

    return SimpleNamespace(
        means=column("mean", (0.0, 0.0, 4.0), (3,)),
        quats=column("quat", (1.0, 0.0, 0.0, 0.0), (4,)),
        log_scales=_f64(scale).reshape(n, 3).log(),
        logit_opacities=torch.logit(column("opacity", 0.6, ())),
        sh=sh,
        features=None if D is None else torch.arange(n * D).double().reshape(n, D) + 1,
    )


def _random(rng, n=6, K=4, D=2, spread=0.5, depth=4.0, scale=-1.2):
    values = {
        "means": rng.normal(size=(n, 3)) * spread + (0, 0, depth),
        "quats": rng.normal(size=(n, 4)),
        "log_scales": rng.normal(size=(n, 3)) * 0.4 + scale,
        "logit_opacities": rng.normal(size=n),
        "sh": rng.normal(size=(n, K, 3)) * 0.2,
        "features": rng.normal(size=(n, D)),
    }
    return SimpleNamespace(**{k: torch.tensor(v) for k, v in values.items()})


def _through(g, points=((0.0, 0.0, 1.0),), origin=(0.0, 0.0, 0.0), **fields):
    """Rays from one origin towards directions, no camera."""
    d = _f64(points)
    return render(g, None, _settings(**fields), rays=(_f64(origin), d))


def _close(a, b, tolerance=1e-12):
    torch.testing.assert_close(_f64(a), _f64(b), rtol=0, atol=tolerance)


def _rigid(rng):
    """A random (4, 4) rigid motion and its quaternion (wxyz)."""
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    w, x, y, z = q
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    motion = np.eye(4)
    motion[:3, :3] = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    motion[:3, 3] = rng.normal(size=3)
    return motion, q


# ------------------------------------------------------------------------------------ closed forms


@pytest.mark.parametrize(("response", "order"), LEGAL)
def test_no_gaussian_is_background(response, order):
    """Nothing renders as background, with zeros everywhere else."""
    out = render(_gaussians(D=3), _camera(), _settings(response, order, background=(0.1, 0.2, 0.3)))
    _close(out.rgb, _f64([0.1, 0.2, 0.3]).expand(6, 8, 3))
    assert out.features.shape == (6, 8, 3)
    assert out.visibility.shape == (0,)
    for field in (out.alpha, out.depth, out.median_depth, out.count, out.features, out.ambiguous):
        assert not field.any()


def test_one_gaussian_peak():
    """A sphere seen under an angle: rho is the ray's distance to the mean in sigmas."""
    g = _gaussians({"mean": (0, 0, 4), "scale": 0.2, "opacity": 0.8}, D=2)
    angle = 0.1
    d = ((math.sin(angle), 0.0, math.cos(angle)), (0.0, 0.0, 1.0))
    out = _through(g, d, background=(1, 0, 0))
    a = 0.8 * math.exp(-0.5 * (4 * math.sin(angle) / 0.2) ** 2)
    _close(out.alpha, [a, 0.8])
    _close(out.rgb[0], [0.7 * a + 1 - a, 0.4 * a, 0.2 * a])
    _close(out.depth, [4 * math.cos(angle), 4])
    _close(out.median_depth, [0, 4])
    _close(out.features[0], [a, 2 * a])
    _close(out.visibility, [a + 0.8])
    assert out.count.tolist() == [1, 1]
    assert not out.ambiguous.any()


@pytest.mark.parametrize("response", ["peak", "integral"])
def test_center_hit_has_the_opacity(response):
    """A full pass through the center has a = alpha from every side, whatever the shape."""
    g = _gaussians({"mean": (0, 0, 0), "scale": (1e-3, 0.1, 3), "quat": (0.3, -0.5, 1.1, 0.2), "opacity": 0.37})
    generator = torch.Generator().manual_seed(0)
    o = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator).double(), dim=1) * 100
    out = render(g, None, _settings(response), rays=(o, -o))
    _close(out.alpha, [0.37] * 9, 1e-10)
    _close(out.depth, [100.0] * 9, 1e-9)


def test_behind_the_camera():
    """Behind: no peak; under `integral` only the tail in front counts; `ewa` drops the mean."""
    g = _gaussians({"mean": (0, 0, -0.5), "scale": 0.25, "opacity": 0.9})
    assert _through(g).count.item() == 0
    tau = -math.log(1 - 0.9) * 0.5 * math.erfc(2 / math.sqrt(2))
    _close(_through(g, response="integral").alpha, [-math.expm1(-tau)])
    assert render(g, _camera(), _settings("ewa")).count.sum() == 0
    assert _through(g, points=((0.0, 0.0, -1.0),)).count.item() == 1


def test_grazing_and_outside_the_extent():
    """Hits inside the extent exist, hits beyond do not, and the border is marked ambiguous."""
    g = _gaussians({"mean": (0, 0, 4), "scale": 0.2, "opacity": 0.8})
    rho = _f64([2.9, 3.0 - 1e-7, 3.0 + 1e-7, 3.1])
    o = torch.stack([rho * 0.2, 0 * rho, 0 * rho], 1)
    out = render(g, None, _settings(extent=3.0), rays=(o, _f64([0.0, 0.0, 2.0])))
    assert out.count.tolist() == [1, 1, 0, 0]
    assert out.ambiguous.tolist() == [False, True, True, False]
    _close(out.alpha[0], 0.8 * math.exp(-(2.9**2) / 2))


def test_no_extent():
    """extent=None cuts nothing off, where float64 shows anything; in the order of entries it says where these are."""
    items = [{"mean": (0, 0, 4), "scale": 0.2, "opacity": a} for a in (0.8, 1e-3, 1e-7)]
    g = _gaussians(*items)
    away = _f64([[0.2 * 8.9, 0, 0]]), _f64([0.0, 0.0, 1.0])
    assert render(g, None, _settings(), rays=away).count.item() == 3
    # Three times an opacity, or 1, times (1 + r^2) exp(-r^2 / 2) is 1e-5 at r = 5.6351 and 5.4668.
    for radius, count in ((5.466, 3), (5.468, 1), (5.634, 1), (5.636, 0)):
        o = _f64([[0.2 * radius, 0, 0]])
        assert render(g, None, _settings(order="entry"), rays=(o, away[1])).count.item() == count


def _precision(g, i):
    """Sigma^-1 (3, 3), the rotation built by turning the axes."""
    w, v = g.quats[i, 0], g.quats[i, 1:]
    v, w = v / g.quats[i].norm(), w / g.quats[i].norm()
    columns = [
        e + 2 * w * torch.linalg.cross(v, e) + 2 * torch.linalg.cross(v, torch.linalg.cross(v, e))
        for e in torch.eye(3).double()
    ]
    rotation = torch.stack(columns, 1)
    return rotation @ torch.diag((-2 * g.log_scales[i]).exp()) @ rotation.T


def _density(g, i, o, d, t):
    """exp(-x^T Sigma^-1 x / 2) along o + t d, and the inverse standard deviation along d."""
    precision = _precision(g, i)
    x = o + t[:, None] * d - g.means[i]
    return torch.exp(-0.5 * ((x @ precision) * x).sum(1)), (d @ precision @ d).sqrt()


@pytest.mark.parametrize("depth", [3.0, 0.3, 0.0, -0.2])
def test_integral_is_the_optical_depth(rng, depth):
    """Against quadrature of the density from the camera on, outside, inside and in front."""
    g = _random(rng, n=5, K=1, depth=depth, spread=0.2, scale=-1.5)
    o = _f64([0.05, -0.02, 0.01])
    d = torch.nn.functional.normalize(_f64([0.1, 0.05, 1.0]), dim=0)
    t = torch.linspace(0, 30, 600_001).double()
    for i in range(5):
        one = SimpleNamespace(**{k: v[i : i + 1] for k, v in vars(g).items()})
        shape, speed = _density(g, i, o, d, t)
        # Normalized along the ray: a full pass has optical depth softplus(logit) exp(-rho^2/2).
        scale = torch.nn.functional.softplus(g.logit_opacities[i]) * speed / math.sqrt(2 * math.pi)
        tau = torch.trapezoid(shape, t) * scale
        out = render(one, None, _settings("integral", extent=50.0), rays=(o[None], 3 * d[None]))
        _close(out.alpha[0], -torch.expm1(-tau), 2e-9)


def test_peak_is_the_maximum_along_the_ray(rng):
    """Against dense sampling of the Gaussian along the ray."""
    g = _random(rng, n=5, K=1)
    o = torch.zeros(3).double()
    d = torch.nn.functional.normalize(_f64([0.05, 0.1, 1.0]), dim=0)
    t = torch.linspace(0, 12, 1_200_001).double()
    for i in range(5):
        one = SimpleNamespace(**{k: v[i : i + 1] for k, v in vars(g).items()})
        shape, _ = _density(g, i, o, d, t)
        out = render(one, None, _settings(extent=50.0), rays=(o[None], d[None]))
        _close(out.alpha[0], torch.sigmoid(g.logit_opacities[i]) * shape.max(), 1e-8)
        _close(out.depth[0], t[shape.argmax()], 2e-5)


def test_camera_inside():
    """At the mean, half of the optical depth is in front; a peak just ahead counts in full."""
    g = _gaussians({"mean": (0, 0, 0), "scale": 0.5, "opacity": 0.96})
    _close(_through(g, response="integral").alpha, [1 - math.sqrt(1 - 0.96)])
    assert _through(g).count.item() == 0
    _close(_through(g, origin=(0, 0, -1e-9)).alpha, [0.96])
    assert _through(g, origin=(0, 0, -1e-9)).ambiguous.item() is False
    g = _gaussians({"mean": (0, 0.1, 0), "scale": 0.5})
    assert _through(g, origin=(0, 0, -1e-9)).ambiguous.item() is True


def test_ewa_on_axis():
    """On the optical axis Sigma' = (f s / z)^2 + dilation; depth is z or distance."""
    g = _gaussians({"mean": (0, 0, 4), "scale": (0.5, 0.25, 9.0), "opacity": 0.8})
    for key in ("z", "distance"):
        settings = _settings("ewa", dilation=0.3, depth_key=key)
        out = render(g, _camera(focal=16.0), settings)
        power = 0.5 * (1.5**2 / (2**2 + 0.3) + 0.5**2 / (1 + 0.3))
        _close(out.alpha[3, 5], 0.8 * math.exp(-power))
        _close(out.depth[3, 5], 4)


# ------------------------------------------------------------------------------ order and cut-offs


@pytest.mark.parametrize(("response", "order"), LEGAL)
def test_compositing_in_the_stated_order(rng, response, order):
    """Each order against a plain loop over single-Gaussian renders sorted by its own key."""
    g, cam = _random(rng, n=7, K=1, scale=-0.7), _camera(4, 3)
    settings = _settings(response, order, extent=4.0, background=(0.3, 0.3, 0.3))
    alone = []
    for i in range(7):
        one = SimpleNamespace(**{k: v[i : i + 1] for k, v in vars(g).items()})
        alone.append(render(one, cam, settings))
    rgb = torch.zeros(3, 4, 3).double()
    for y in range(3):
        for x in range(4):
            keys = []
            for i in range(7):
                if not alone[i].count[y, x]:
                    continue
                key = alone[i].depth[y, x].item()  # t* of the only hit
                if order == "center":
                    key = g.means[i].norm().item()
                elif order == "entry":
                    d = _f64([(x + 0.5 - 2) / 8, (y + 0.5 - 1.5) / 8, 1])
                    d = d / d.norm()
                    p, m = _precision(g, i), g.means[i]
                    key = np.roots([d @ p @ d, -2 * m @ p @ d, m @ p @ m - 4.0**2]).min()
                elif response == "integral":
                    key = max(key, 0)
                keys.append((key, i))
            light = 1.0
            for _, i in sorted(keys):
                a = alone[i].alpha[y, x]
                color = (alone[i].rgb[y, x] - (1 - a) * 0.3) / a
                rgb[y, x] += light * a * color
                light *= 1 - a
            rgb[y, x] += light * 0.3
    _close(render(g, cam, settings).rgb, rgb, 1e-9)


def test_ties_go_by_index():
    """Equal keys keep the order of the arrays, exactly equal ones without a mark."""
    items = [{"color": (1, 0, 0), "opacity": 0.4}, {"color": (0, 1, 0), "opacity": 0.5}]
    for order in ("center", "ray", "entry"):
        for response in ("peak", "integral"):
            out = _through(_gaussians(*items), order=order, response=response, extent=3.0)
            _close(out.rgb[0], [0.4, 0.3, 0])
            assert not out.ambiguous.item()
    out = _through(_gaussians(*[{"opacity": 1e-3}] * 2000), order="ray")
    _close(out.alpha, [1 - 0.999**2000])


@pytest.mark.parametrize("response", ["peak", "integral"])
def test_alpha_max(response):
    """The clamp and both of its gradients, through the hit and through what lies behind."""
    for rule, gain in (("zero", 0.0), ("pass", 1.0)):
        g = _gaussians({"mean": (0, 0, 3), "opacity": 0.95, "color": (1, 1, 1)}, {"opacity": 0.5})
        g.logit_opacities.requires_grad_()
        out = _through(g, response=response, alpha_max=0.9, alpha_max_gradient=rule)
        _close(out.alpha, [0.95])
        (grad,) = torch.autograd.grad(out.rgb[0, 0], g.logit_opacities)
        # d rgb / d a = c - B with B = 0.5 * 0.7 behind; da/dlogit = alpha (1 - alpha).
        _close(grad, [gain * (1 - 0.35) * 0.95 * 0.05, 0.1 * 0.7 * 0.25])


# -------------------------------------------------------------------------------------- symmetries


def test_quaternion_sign_and_length(rng):
    """q, -q and s q are one rotation; the gradient is tangent and scales inversely."""
    g, cam, settings = _random(rng), _camera(), _settings(order="ray")
    base = g.quats.clone()
    grads = []
    for factor in (1.0, -1.0, 1e-12, 300.0):
        g.quats = (base * factor).requires_grad_()
        out = render(g, cam, settings)
        (grad,) = torch.autograd.grad(out.rgb.square().sum(), g.quats)
        grads.append(grad * factor)
        _close((grad * g.quats).sum(1), torch.zeros(6), 1e-12)
    for grad in grads[1:]:
        torch.testing.assert_close(grad, grads[0], rtol=1e-9, atol=1e-12)


def test_pixels_are_independent(rng, monkeypatch):
    """Chunks, subsets of rays and shapes of rays give the same values, and chunks the gradients."""
    g, cam, settings = _random(rng), _camera(), _settings(order="ray")
    g.means.requires_grad_()
    whole = render(g, cam, settings)
    (gradient,) = torch.autograd.grad(whole.rgb.square().sum(), g.means)
    monkeypatch.setattr(reference, "_PAIRS", 6 * 5)
    split = render(g, cam, settings)
    (split_gradient,) = torch.autograd.grad(split.rgb.square().sum(), g.means)
    for field in ("rgb", "alpha", "depth", "median_depth", "visibility", "features"):
        _close(getattr(split, field), getattr(whole, field), 1e-14)
    _close(split_gradient, gradient, 1e-12)
    y, x = torch.meshgrid(torch.arange(6) + 0.5, torch.arange(8) + 0.5, indexing="ij")
    d = torch.stack([(x - 4) / 8, (y - 3) / 8, torch.ones_like(x)], -1).double()
    # Without a camera each ray's own origin takes the place of its center.
    for order in ("ray", "center", "entry"):
        whole = render(g, cam, _settings(order=order))
        for c in (cam, None):
            rays = render(g, c, _settings(order=order), rays=(torch.zeros(3), d[2:5, ::3]))
            _close(rays.rgb, whole.rgb[2:5, ::3], 1e-13)
            _close(rays.features, whole.features[2:5, ::3], 1e-13)
    assert render(g, None, settings, rays=(torch.zeros(0, 3), torch.zeros(0, 3))).rgb.shape == (
        0,
        3,
    )


def test_origin_and_lens(rng):
    """Means relative to an origin, and directions that come from a distorted camera."""
    g, cam = _random(rng), _camera()
    plain = render(g, cam, _settings())
    origin = np.array([1e6, -2e6, 5.0])
    w2c = np.eye(4)
    w2c[:3, 3] = -origin
    far = render(SimpleNamespace(**vars(g), origin=origin), _camera(w2c=w2c), _settings())
    _close(far.rgb, plain.rgb, 1e-12)
    y, x = np.meshgrid(np.arange(6) + 0.5, np.arange(8) + 0.5, indexing="ij")
    d = np.stack([(x - 4) / 8, (y - 3) / 8, np.ones_like(x)], -1)
    lens = SimpleNamespace(**vars(cam), model="opencv", pixel_directions=lambda: d)
    _close(render(g, lens, _settings()).rgb, plain.rgb, 1e-13)
    with pytest.raises(ValueError, match="pinhole"):
        render(g, lens, _settings("ewa"))
    with pytest.raises(ValueError, match="pinhole"):
        render(g, cam, _settings("ewa"), rays=(torch.zeros(1, 3), torch.ones(1, 3)))
    with pytest.raises(ValueError, match="cam"):
        render(g, None, _settings())


# --------------------------------------------------------------------------------------- gradients


def _twist(xi):
    """(4, 4) exp of a world-frame twist, rotation first."""
    r, t, zero = xi[:3], xi[3:], torch.zeros((), dtype=xi.dtype)
    rows = [zero, -r[2], r[1], t[0], r[2], zero, -r[0], t[1], -r[1], r[0], zero, t[2]]
    return torch.linalg.matrix_exp(torch.stack(rows + [zero] * 4).reshape(4, 4))


@pytest.mark.every(3)
@pytest.mark.parametrize("fields", [{}, {"sh_direction": "ray", "extent": 6.0, "near": 0.2}])
@pytest.mark.parametrize(("response", "order"), LEGAL)
def test_gradcheck(response, order, fields):
    """Every parameter group and the camera pose against central differences."""
    g = _random(np.random.default_rng(5), n=3, scale=-0.6, spread=0.3)
    if response == "integral" and not fields:
        g.means[0, 2] = 0.1  # the camera is inside this one
    settings = _settings(response, order, dilation=0.3 if response == "ewa" else 0.0, **fields)
    tensors = [getattr(g, k).requires_grad_() for k in NAMES]
    pose = (torch.randn(6) * 0.1).double().requires_grad_()

    def image(*values):
        cam = _camera(2, 2, focal=4.0, w2c=_twist(values[-1]))
        out = render(SimpleNamespace(**dict(zip(NAMES, values[:-1], strict=True))), cam, settings)
        return out.rgb, out.depth, out.alpha, out.features, out.visibility, out.median_depth

    assert not render(g, _camera(2, 2, 4.0, _twist(pose)), settings).ambiguous.any()
    assert torch.autograd.gradcheck(image, (*tensors, pose), eps=1e-6, atol=1e-7, rtol=1e-5)


def test_gradcheck_rays(rng):
    """Origins and directions of free rays are differentiable too."""
    g, settings = _random(rng, n=3, scale=-0.6), _settings("integral", "ray")
    o = torch.tensor(rng.normal(size=(4, 3)) * 0.1).requires_grad_()
    d = torch.tensor(rng.normal(size=(4, 3)) * 0.1 + (0, 0, 2.0)).requires_grad_()

    def color(o, d):
        return render(g, None, settings, rays=(o, d)).rgb

    assert torch.autograd.gradcheck(color, (o, d))


@pytest.mark.parametrize(("response", "order"), LEGAL)
@pytest.mark.parametrize(
    "change",
    [
        {"log_scales": -16.0},
        {"log_scales": 9.0},
        {"logit_opacities": -18.0},
        {"logit_opacities": 16.0},
        {"sh": -5.0},
        {"quats": 1e-20},
        {"means": (0.0, 0.0, 0.0)},
    ],
    ids=lambda change: str(*change.items()),
)
def test_extremes_stay_finite(rng, response, order, change):
    """Values and all gradients are finite where float32 code has a hard time."""
    g, cam = _random(rng, n=4), _camera(4, 4)
    for name, value in change.items():
        value = torch.as_tensor(value).double()
        getattr(g, name)[0] = getattr(g, name)[0] * value if name == "quats" else value
    tensors = [getattr(g, k).requires_grad_() for k in NAMES]
    out = render(g, cam, _settings(response, order))
    loss = out.rgb.sum() + out.depth.sum() + out.features.sum() + out.median_depth.sum()
    assert torch.isfinite(loss)
    for grad in torch.autograd.grad(loss, tensors):
        assert torch.isfinite(grad).all()


# --------------------------------------------------------------------------------------- ambiguity


def test_near_ties_are_marked():
    """Marked: order swapped by less than the tolerance. Not marked: the same without effect."""
    front = {"mean": (0, 0, 4), "opacity": 0.4}
    for gap, marked in ((1e-3, False), (1e-6, True), (0.0, False)):
        g = _gaussians(front, {"mean": (0, 0, 4 + gap), "opacity": 0.5})
        assert _through(g, order="ray").ambiguous.item() is marked
        # A hit between them that does not matter hides nothing.
        third = {"mean": (0, 0, 4 + gap / 2), "opacity": 1e-8}
        g = _gaussians(front, {"mean": (0, 0, 4 + gap), "opacity": 0.5}, third)
        assert _through(g, order="ray").ambiguous.item() is marked
    g = _gaussians(front, {"mean": (0, 0, 4 + 1e-6), "opacity": 1e-8})
    assert _through(g, order="ray").ambiguous.item() is False
    behind = [{"mean": (0, 0, 3), "opacity": 1 - 1e-9}, front, {"mean": (0, 0, 4 + 1e-6)}]
    assert _through(_gaussians(*behind), order="ray").ambiguous.item() is False
    g = _gaussians(front, {"mean": (0, 0, 4 + 1e-3), "opacity": 0.5})
    rays = torch.zeros(1, 3), _f64([0.0, 0.0, 1.0])
    assert render(g, None, _settings(), rays=rays, tolerance=1e-2).ambiguous.item() is True


def test_few_pixels_are_marked(rng):
    """On a dense scene the marks stay a small part, or comparisons would test little."""
    g = _random(rng, n=60, spread=0.8)
    for preset, most in (("exact", 0.05), ("fast", 0.05), ("inria", 0.05), ("gsplat", 0.05), ("3dgut", 0.05)):
        out = render(g, _camera(16, 12, 15.0), RenderSettings.preset(preset))
        assert out.ambiguous.double().mean() < most
        assert out.alpha.max() > 0.9


def test_marks_cover_float32(rng):
    """Rounding the means to float32 moves unmarked pixels little, marked ones at will."""
    layers = [{"mean": (0.3 * i, 0.2 * i, 4), "scale": 1.0, "opacity": 0.9} for i in range(3)]
    g = _gaussians(*layers, {"mean": (0.1, 0, 4), "scale": 1.0, "color": (0, 1, 0)})
    cam, settings = _camera(), _settings(order="ray")
    g.means += torch.tensor(rng.normal(size=(4, 3)) * 1e-6)
    a = render(g, cam, settings)
    g.means = g.means.float()
    b = render(g, cam, settings)
    moved = (a.rgb - b.rgb).abs().amax(-1)
    assert a.ambiguous.any()
    assert moved[~a.ambiguous].max() < 1e-6


# ---------------------------------------------------------------------------- spherical harmonics


def test_sh_basis_is_orthonormal():
    """Integrals over the sphere, by Gauss-Legendre in z and equal steps in the angle."""
    z, w = (torch.tensor(v) for v in np.polynomial.legendre.leggauss(8))
    phi = torch.arange(16).double() * (2 * math.pi / 16)
    r = (1 - z * z).sqrt()[:, None]
    d = torch.stack([r * phi.cos(), r * phi.sin(), z[:, None].expand(8, 16)], -1)
    basis = sh_basis(d, 16)
    gram = torch.einsum("zp,zpi,zpj->ij", w[:, None].expand(8, 16) * (2 * math.pi / 16), basis, basis)
    _close(gram, torch.eye(16), 1e-13)


def test_sh_basis_has_3dgs_order_and_sign(rng):
    """Against the published polynomials, for every degree."""
    d = torch.nn.functional.normalize(torch.tensor(rng.normal(size=(20, 3))), dim=1)
    want = torch.tensor(np.array([oracle_rasterizers.sh_polynomials(v) for v in d.numpy()]))
    for K in (1, 4, 9, 16):
        _close(sh_basis(d, K), want[:, :K], 1e-14)


def test_negative_color_is_clamped():
    """max(0.5 + SH, 0): black, and no gradient, where negative."""
    g = _gaussians({"color": (-0.2, 0.3, -3.0), "opacity": 0.5})
    g.sh.requires_grad_()
    out = _through(g)
    _close(out.rgb[0], [0, 0.15, 0])
    (grad,) = torch.autograd.grad(out.rgb.sum(), g.sh)
    assert (grad[0, 0] != 0).tolist() == [False, True, False]


# -------------------------------------------------------------------- rasterizers by other people


def _rasterizer_scene(rng, n=25):
    """Gaussians inside, beside, near and behind the image, thin, large and opaque."""
    g = _random(rng, n=n, K=16, depth=0.0, spread=0.8)
    g.means[:, 2] += 3
    # Too near for one or both, and behind.
    g.means[:3] = _f64([[0.01, 0.02, 0.15], [0.0005, 0.0002, 0.005], [0, 0, -1]])
    g.log_scales[:2], g.logit_opacities[:2] = _f64([[-5.0], [-8.0]]), 0.5
    # Beside the image, reaching into it.
    g.means[3:5] = _f64([[6, 0.5, 2.9], [-6, 0.2, 3.15]])
    g.log_scales[3:5], g.logit_opacities[3:5] = 0.7, 3.0
    g.log_scales[7:9] += 2.0
    g.log_scales[9:11, 0] -= 6.0
    g.logit_opacities[11:20] = 8.0
    g.logit_opacities[20] = -6.0
    # An opaque pile in the middle: transmittance runs out.
    g.means[12:18] = _f64([0, 0, 3]) + torch.arange(6)[:, None] * _f64([0.01, 0.02, 0.1])
    # Opaque, with pixels beyond 3 sigma (in the next tile at 32x32) that are still above 1/255.
    g.means[22], g.log_scales[22] = _f64([-0.7125, -0.4125, 1.5]), math.log(0.216)
    g.logit_opacities[22] = 8.0
    # A wide one at the back whose opacity exceeds both clamps over some pixels.
    g.means[21], g.log_scales[21], g.logit_opacities[21] = _f64([-1.2, -1.5, 6]), 2.3, 9.0
    return g


def _as_arrays(g):
    return (
        g.means.numpy(),
        g.quats.numpy(),
        g.log_scales.exp().numpy(),
        torch.sigmoid(g.logit_opacities).numpy(),
        g.sh.numpy(),
    )


@pytest.mark.parametrize(
    ("preset", "size", "center"),
    [
        ("inria", (32, 32), None),
        ("inria", (24, 20), None),
        ("gsplat", (32, 32), (9.3, 20.1)),
        ("gsplat", (24, 20), None),
    ],
)
def test_presets_equal_the_rasterizers(rng, preset, size, center):
    """Presets against oracles written from those systems' formulas, and each cut-off at work."""
    g = _rasterizer_scene(rng)
    motion, _ = _rigid(rng)
    turn = torch.tensor(motion)
    g.means = (g.means - turn[:3, 3]) @ turn[:3, :3]
    cam = _camera(*size, focal=20.0, w2c=motion, center=center)
    settings = RenderSettings.preset(preset, background=(0.2, 0.5, 0.9))
    oracle = getattr(oracle_rasterizers, preset)
    want = oracle(*_as_arrays(g), cam.K, cam.w2c, *size, settings.background)
    out = render(g, cam, settings, tolerance=1e-12)
    assert not out.ambiguous.any()
    _close(out.rgb, want[0], 1e-9)
    _close(out.alpha, want[1], 1e-9)
    _close(out.visibility, want[3], 1e-9)
    assert torch.equal(out.count, torch.tensor(want[2]))
    changes = [
        {"dilation": 0.0},
        {"alpha_min": 0.0},
        {"alpha_max": 1.0},
        {"transmittance_min": 0.0},
        {"stop": "after"},
        {"near": 0.0},
        {"fov_clamp": "none"},
        {"depth_key": "distance"},
    ]
    if preset == "inria":
        changes.append({"culling": "gsplat"})
    for change in changes:
        other = render(g, cam, settings.replace(**change))
        assert (other.rgb - out.rgb).abs().max() > 1e-6, change


def test_gsplat_image(data_dir):
    """The image that gsplat's CUDA kernels made: premultiplied RGBA on black, raw parameters."""
    path = data_dir / "gsplat_reference" / "tiny_case.safetensors"
    if not path.is_file():
        pytest.skip(f"no gsplat reference image: {path} does not exist")
    from safetensors.torch import load_file

    data = load_file(path)
    image = data["out_img"].double()
    height, width = image.shape[:2]
    w2c = np.eye(4)
    w2c[:3, 3] = (-0.123, -0.456, 8.0)
    cam = _camera(width, height, focal=width / 2, w2c=w2c)
    g = SimpleNamespace(
        means=data["means"],
        quats=data["quats"],
        log_scales=data["scales"],
        logit_opacities=data["opacities"],
        sh=data["coeffs"],
        features=None,
    )
    out = render(g, cam, RenderSettings.preset("gsplat"))
    assert not out.ambiguous.any()
    _close(out.rgb, image[..., :3], 1e-6)
    _close(out.alpha, image[..., 3], 2e-6)
    arrays = _as_arrays(SimpleNamespace(**{k: getattr(g, k).double() for k in NAMES[:-1]}))
    _close(out.rgb, oracle_rasterizers.gsplat(*arrays, cam.K, w2c, width, height)[0], 1e-9)


@pytest.mark.parametrize("response", ["peak", "integral", "ewa"])
def test_derivatives_of_discs(response):
    """By the thin scale s they are c s, c from differences of the image: no quotient by it cancels."""
    g = _gaussians({"mean": (0.1, 0.05, 3.0), "quat": (1.0, 0.2, 0.3, 0.1), "opacity": 0.8})

    def image(thin):
        g.log_scales = torch.stack([_f64(0.3), _f64(0.2), thin]).log()[None]
        return render(g, _camera(), _settings(response)).rgb[..., 1].square().sum()

    h = 1e-3
    c = 2 * (image(_f64(h)) - image(_f64(1e-20))) / h**2
    assert abs(c) > 0.1
    for thin in (1e-6, 1e-12, 1e-20):
        s = torch.tensor(thin, dtype=torch.float64, requires_grad=True)
        assert float(torch.autograd.grad(image(s), s)[0]) == pytest.approx(float(c) * thin, rel=1e-3)
