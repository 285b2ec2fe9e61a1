"""The renderer against the float64 oracle: images, adjoint, forward mode, presets, torch, bad input."""

from __future__ import annotations

import math

import numpy as np
import oracle_rasterizers
import pytest
import torch
from scenes_random import (
    FIELDS,
    Oracle,
    around_camera,
    camera,
    compare,
    gaussians,
    gradients,
    inner,
    leaves,
    relative,
    twist_basis,
)

import drgs
from drgs import reference
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import OUTPUTS, render, render_jvp, render_rays
from drgs.settings import RenderSettings

IMAGE, GRADIENT = 1e-5, 1e-4
# What a hit in float32 world space loses per unit of distance / smallest scale (docs/numerics.md).
WORLD = 8 * 6e-8
CUTS = {
    "extent": 3.0,
    "alpha_min": 1 / 255,
    "alpha_max": 0.9,
    "transmittance_min": 0.013,
    "near": 0.2,
    "background": (0.2, 0.5, 0.9),
}
# Per pair of response and order: two kinds of scene (size, N, K, D, fields). Kernels are compiled once a kind, so the
# kinds together, not each, go through all SH degrees, feature widths, cut-offs, stops, keys and SH directions.
KINDS = {
    ("peak", "center"): (
        ((16, 11), 20, 4, 0, {}),
        ((9, 7), 12, 16, 40, {**CUTS, "depth_key": "z", "alpha_max_gradient": "pass", "stop": "before"}),
    ),
    ("peak", "ray"): (
        ((24, 22), 25, 9, 0, {"background": (0.2, 0.5, 0.9)}),
        ((9, 7), 15, 4, 5, {"sh_direction": "ray", "extent": 4.0, "max_hits": 4}),
    ),
    ("peak", "entry"): (
        ((9, 7), 20, 1, 1, {"transmittance_min": 1e-4}),
        ((13, 8), 12, 4, 0, {**CUTS, "sh_direction": "ray", "max_hits": 3}),
    ),
    ("integral", "center"): (
        ((13, 8), 15, 4, 1, {"sh_direction": "ray", "depth_key": "z"}),
        ((1, 1), 20, 16, 0, {**CUTS, "stop": "before_eq"}),
    ),
    ("integral", "ray"): (
        ((16, 11), 20, 9, 5, {}),
        ((9, 7), 12, 1, 40, {**CUTS, "alpha_max_gradient": "pass"}),
    ),
    ("integral", "entry"): (
        ((9, 7), 20, 4, 0, {}),
        ((1, 1), 15, 9, 1, {"sh_direction": "ray", "extent": 3.5}),
    ),
    ("ewa", "center"): (
        ((24, 22), 25, 1, 5, {"dilation": 0.3, "sh_direction": "ray"}),
        ((9, 7), 15, 16, 0, {**CUTS, "fov_clamp": "gsplat", "depth_key": "z", "stop": "before_eq", "max_hits": 3}),
    ),
}
SCENES = 5  # of each kind and part: 7 x 2 x 3 x 5 = 210


def traversals(response, order):
    """The legal traversals of a response and order."""
    return [t for t in ("tiles", "bvh") if (response != "ewa" or t == "tiles") and (order != "entry" or t == "bvh")]


def scene(rng, kind, **options):
    """Gaussians and skewed camera of a kind, some Gaussians around the camera, of mixed anisotropy and opacity."""
    size, n, K, D, _ = kind
    cam = camera(rng, size, skew=0.2)
    shape = {"anisotropy": rng.choice([0.1, 0.5, 1.2]), "opacity": rng.choice([1.0, 3.0])}
    return around_camera(gaussians(rng, n, K, D, **{**shape, **options}), cam), cam


def check(errors, image=IMAGE, gradient=GRADIENT):
    """Hold every figure of a comparison against its bound."""
    assert errors.finite
    for name, error in errors.image.items():
        assert error <= image, (name, error)
    for name, error in {**errors.gradient, **errors.forward}.items():
        assert error <= gradient, (name, error)
    assert errors.duality <= GRADIENT


# ------------------------------------------------------------------------------------ random scenes


@pytest.mark.core
@pytest.mark.every(3)
@pytest.mark.parametrize("part", range(3))
@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize(("response", "order"), KINDS)
def test_random_scenes(rng, response, order, kind, part):
    """Images, adjoint and forward mode on both traversals, which also equal each other."""
    kind = KINDS[response, order][kind]
    base = RenderSettings(response=response, order=order, traversal="bvh" if order == "entry" else "tiles")
    base = base.replace(**kind[4])
    # Entry points are those of proxies, which are slightly larger than thin or grazed Gaussians.
    options, tolerance = ({"anisotropy": 0.3}, 3e-4) if order == "entry" else ({}, 1e-5)
    ambiguous = []
    for _ in range(SCENES):
        g, cam = scene(rng, kind, **options)
        oracle = Oracle(g, cam, base, rng, tolerance)
        ambiguous.append(float((~oracle.good).double().mean()))
        images = []
        for traversal in traversals(response, order):
            errors = compare(g, cam, base.replace(traversal=traversal), oracle)
            check(errors)
            # The oracle's marks cover what can move a weight by 1e-7; a count may still see less than that.
            assert errors.count <= 1
            images.append(errors.out)
        if len(images) == 2:
            _equal(*images, oracle.good, 1e-5)
    assert np.mean(ambiguous) < 0.02


def _equal(a, b, good, tolerance):
    for name in FIELDS:
        if getattr(a, name) is not None:
            x, y = (getattr(o, name).detach()[good] for o in (a, b))
            torch.testing.assert_close(x, y, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("ratio", [400, 5000])
@pytest.mark.parametrize("response", ["peak", "integral"])
def test_far(rng, response, ratio):
    """Distance / smallest scale as in real scenes: tiles keep the bounds of small scenes, `bvh` has its own."""
    kind = KINDS[response, "ray"][0]
    size, n, K, D, fields = kind
    settings = RenderSettings(response=response, order="ray").replace(**fields)
    bound, lost = WORLD * ratio, []
    for i in range(4):
        # Far away and round; or near, flat and needle-like.
        if i % 2 == 0:
            cam, g = camera(rng, size, distance=0.15 * ratio), gaussians(rng, n, K, D, anisotropy=0.1)
        else:
            cam, g = camera(rng, size), gaussians(rng, n, K, D)
            with torch.no_grad():
                g.log_scales[:, i // 2] = math.log(4.0 / ratio)
        colors = [name for name in FIELDS if name != "depth"]
        oracle = Oracle(g, cam, settings, rng, 1e-6, colors)
        check(compare(g, cam, settings, oracle))
        # The derivative of depth subtracts depths, each rounded to 6e-8 of the distance.
        if i < 2:
            depth = Oracle(g, cam, settings, rng, 1e-6, ["depth"])
            check(compare(g, cam, settings, depth), gradient=max(GRADIENT, bound))
        world = settings.replace(traversal="bvh")
        there, found = (render(g.detach(), cam, each, outputs=("count",)).count for each in (settings, world))
        lost.append(float((found != there)[oracle.good].double().mean()))
        oracle = Oracle(g, cam, settings, rng, 1e-6, colors, skip=found != there)
        check(compare(g, cam, world, oracle), max(IMAGE, bound), max(GRADIENT, 4 * bound))
    assert np.mean(lost) < 0.01


def test_images_jump_where_gaussians_change_places():
    """Two spheres, one behind the other: as their order turns around the pixel jumps, and no derivative tells of it.

    The gradient is that of either side, where differences agree with it; across, they grow as 1 / step. The oracle
    marks the pixel.
    """
    colors = torch.tensor([[[0.95, 0.05, 0.2]], [[0.05, 0.05, 0.95]]]) - 0.5
    cam = Camera(K=np.array([[8.0, 0, 0.5], [0, 8.0, 0.5], [0, 0, 1]]), w2c=np.eye(4), width=1, height=1)

    def at(offset, grad=False):
        means = torch.tensor([[0.05, 0.0, 4.0 + offset], [0.0, 0.05, 4.0]], dtype=torch.float64, requires_grad=grad)
        return Gaussians(
            means=means,
            quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
            log_scales=torch.full((2, 3), math.log(0.3)),
            logit_opacities=torch.full((2,), 0.8),
            sh=colors / math.sqrt(1 / (4 * math.pi)),
        )

    def red(offset):
        return float(render(at(offset), cam, outputs=()).rgb[0, 0, 0])

    front, behind = red(-1e-3), red(1e-3)
    assert front - behind > 0.3
    for eps in (1e-1, 1e-2, 1e-4):
        across = (red(-eps) - red(eps)) / (2 * eps)
        assert across == pytest.approx((front - behind) / (2 * eps), rel=0.05)
    for offset in (-0.1, 0.1):
        g = at(offset, True)
        render(g, cam, outputs=()).rgb[0, 0, 0].backward()
        slope = (red(offset + 0.03) - red(offset - 0.03)) / 0.06
        assert abs(float(g.means.grad[0, 2])) < 0.1
        assert float(g.means.grad[0, 2]) == pytest.approx(slope, abs=1e-4)  # float32 images, 6e-8 / 0.06, and curvature
    settings = RenderSettings.preset("exact")
    assert bool(reference.render(at(1e-6), cam, settings).ambiguous.all())
    assert not bool(reference.render(at(1e-2), cam, settings).ambiguous.any())


def test_deep_stacks(rng):
    """Rays that meet more Gaussians than a buffer holds, derivatives too."""
    cam = camera(rng, (9, 7))
    g = gaussians(rng, 150, 4, 5, scale=0.5)
    with torch.no_grad():
        g.logit_opacities.sub_(3.0)
    base = RenderSettings(order="ray", extent=4.0, sh_direction="ray")
    oracle = Oracle(g, cam, base, rng, 1e-6)
    assert oracle.out.count.max() > 60
    for traversal in ("tiles", "bvh"):
        errors = compare(g, cam, base.replace(traversal=traversal), oracle)
        check(errors)
        assert errors.count <= 1
    center = base.replace(order="center")
    check(compare(g, cam, center, Oracle(g, cam, center, rng)))


# ------------------------------------------------------------------ other people's rasterizers


def _rasterizer_scene(rng, size):
    """Thin, large, opaque, near, beside and behind; the camera is not at the origin of the world."""
    g, cam = gaussians(rng, 30, 16, 0, scale=0.2, anisotropy=0.8), camera(rng, size, center=(size[0] / 2, size[1] / 2))
    around_camera(g, cam)
    with torch.no_grad():
        # Below the clamp: two hits at 0.99 leave T = 1e-4, the very limit.
        g.logit_opacities[8:14] = 4.0
        g.logit_opacities[18] = 6.0
        g.means[8:14] = torch.tensor([0.1, 0.2, 0.0]) + 0.05 * torch.arange(6)[:, None]
        g.log_scales[14] += 2.0
        g.log_scales[15:17, 0] -= 5.0
        g.logit_opacities[17] = -6.0
    return g, cam


@pytest.mark.every(2)
@pytest.mark.parametrize("preset", ["inria", "gsplat"])
def test_presets_equal_the_rasterizers(rng, preset):
    """Images to 1e-5 of an oracle written from those systems' formulas, gradients to 1e-4 of ours."""
    for size in ((32, 24), (24, 22)):
        g, cam = _rasterizer_scene(rng, size)
        if preset == "gsplat":
            K = cam.K.copy()
            K[0, 2] *= 0.7
            cam = Camera(K=K, w2c=cam.w2c, width=cam.width, height=cam.height)
        settings = RenderSettings.preset(preset, background=(0.2, 0.5, 0.9))
        oracle = Oracle(g, cam, settings, rng)
        errors = compare(g, cam, settings, oracle)
        check(errors)
        with torch.no_grad():
            arrays = [x.double().numpy() for x in (g.means, g.quats, g.scales.double(), g.opacities, g.sh)]
        rasterizer = getattr(oracle_rasterizers, preset)
        want = rasterizer(*arrays, cam.K, cam.w2c.detach().numpy(), *size, settings.background)
        good = oracle.good.numpy()
        assert good.mean() > 0.98
        assert np.abs(errors.out.rgb.detach().numpy() - want[0])[good].max() < IMAGE
        assert np.abs(errors.out.alpha.detach().numpy() - want[1])[good].max() < IMAGE
        assert np.array_equal(errors.out.count.numpy()[good], want[2][good])


def test_gsplat_image(data_dir):
    """The image that gsplat's CUDA kernels made: premultiplied RGBA on black, raw parameters."""
    path = data_dir / "gsplat_reference" / "tiny_case.safetensors"
    if not path.is_file():
        pytest.skip(f"no gsplat reference image: {path} does not exist")
    from safetensors.torch import load_file

    data = load_file(path)
    image = data["out_img"]
    height, width = image.shape[:2]
    w2c = np.eye(4)
    w2c[:3, 3] = (-0.123, -0.456, 8.0)
    K = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
    g = Gaussians(data["means"], data["quats"], data["scales"], data["opacities"], data["coeffs"])
    out = render(g, Camera(K=K, w2c=w2c, width=width, height=height), RenderSettings.preset("gsplat"))
    assert (out.rgb - image[..., :3]).abs().max() < IMAGE
    assert (out.alpha - image[..., 3]).abs().max() < IMAGE


# ------------------------------------------------------------------------- finite differences


@pytest.mark.core
@pytest.mark.parametrize("response", ["peak", "integral", "ewa"])
def test_finite_differences(response):
    """Central differences of the renderer itself converge to its derivatives with slope 2, group by group."""
    # A seed with no third derivative near 0, which would leave the slope to the fifth.
    rng = np.random.default_rng(5)
    # Nothing that jumps: layers far apart in depth, no cut-off in reach, the camera outside.
    cam = camera(rng, (9, 7))
    g = gaussians(rng, 8, 4, 5, scale=0.4, anisotropy=0.2, opacity=1.0)
    with torch.no_grad():
        along = torch.tensor(cam.c2w[:3, 2], dtype=torch.float32)
        g.means.add_(along * (torch.linspace(-1.6, 1.6, 8)[:, None] - (g.means @ along)[:, None]))
    g = g.replace(**{name: x.detach().double() for name, x in g.parameters().items()})
    pose = cam.w2c.detach()
    order = "center" if response == "ewa" else "ray"
    settings = RenderSettings(response=response, order=order, extent=9.0, transmittance_min=0.0)
    for name in (*g.parameters(), "camera"):
        v = torch.tensor(rng.normal(size=6 if name == "camera" else tuple(getattr(g, name).shape)))
        pushed = render_jvp(g, cam, {name: v}, settings)
        # Seen along itself a change stands out most against rounding.
        u = {n: getattr(pushed, n).double() for n in FIELDS}
        want = inner(u, u)

        def loss(step, name=name, v=v, u=u):
            moved, at = g, pose
            if name == "camera":
                # c2w <- exp(step xi) c2w
                twist = torch.einsum("k,kij->ij", v, twist_basis())
                at = pose @ torch.linalg.matrix_exp(-step * twist)
            else:
                moved = g.replace(**{name: getattr(g, name) + step * v})
            out = render(moved, Camera(K=cam.K, w2c=at, width=9, height=7), settings)
            return inner(u, {n: getattr(out, n).double() for n in u})

        steps = 1.28 * 2.0 ** -np.arange(11)
        errors = [abs((loss(h) - loss(-h)) / (2 * h) - want) / want for h in steps]
        if name in ("sh", "features"):
            # Linear (where no color is clamped): exact at any step, up to rounding.
            assert min(errors) < 1e-4
            continue
        slopes = np.log2(np.array(errors[:-1]) / np.maximum(errors[1:], 1e-300))
        region = (np.abs(slopes - 2) < 0.3).astype(int)
        longest = max(len(run) for run in "".join(map(str, region)).split("0"))
        assert longest >= 2, (name, errors, slopes)
        assert min(errors) < 1e-3


# ---------------------------------------------------------------------------- torch and the API


@pytest.mark.parametrize("fields", [{}, {"traversal": "bvh", "sh_direction": "ray"}])
def test_torch_transforms(rng, fields):
    """`torch.func.grad`, `torch.func.jvp` and dual numbers give what `backward` and `render_jvp` give."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 4, 5)
    fields = {**fields, "extent": 4.0}
    settings = RenderSettings.preset("exact", **fields)
    out = render(g, cam, settings)
    u = {n: torch.tensor(rng.normal(size=tuple(getattr(out, n).shape))) for n in FIELDS}
    want = gradients(g, cam, out, u)
    values = {n: x.detach() for n, x in g.parameters().items()}

    def image(values):
        out = render(Gaussians(**values), cam, settings)
        return {n: getattr(out, n).double() for n in FIELDS}

    def loss(values):
        return sum((x * u[n]).sum() for n, x in image(values).items())

    found = torch.func.grad(loss)(values)
    for name in values:
        assert relative(found[name].double(), want[name]) < 1e-5
    v = {n: torch.tensor(rng.normal(size=tuple(x.shape)), dtype=x.dtype) for n, x in values.items()}
    pushed = render_jvp(g, cam, v, settings)
    _, tangent = torch.func.jvp(image, (values,), (v,))
    with torch.autograd.forward_ad.dual_level():
        dual = image({n: torch.autograd.forward_ad.make_dual(x, v[n]) for n, x in values.items()})
        dual = {n: torch.autograd.forward_ad.unpack_dual(x).tangent for n, x in dual.items()}
    for name in FIELDS:
        assert relative(tangent[name], getattr(pushed, name).double()) < 1e-5
        assert relative(dual[name], getattr(pushed, name).double()) < 1e-5


def test_gradients_reach_the_arrays(rng):
    """`from_arrays`: the derivative goes through logarithm and logit to the tensors passed in."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 4, 5)
    linear = {"scales": g.scales.detach().requires_grad_(), "opacities": g.opacities.detach().requires_grad_()}
    settings = RenderSettings.preset("exact", extent=4.0)
    made = drgs.Gaussians.from_arrays(g.means, g.quats, linear["scales"], linear["opacities"], g.sh, g.features)
    drgs.render(made, cam, settings).rgb.square().sum().backward()
    got = {name: x.grad for name, x in {**linear, "means": g.means, "sh": g.sh}.items()}
    drgs_raw = torch.autograd.grad(
        render(g, cam, settings).rgb.square().sum(), [g.log_scales, g.logit_opacities, g.means, g.sh]
    )
    a = linear["opacities"].detach()
    for name, want in zip(
        ("scales", "opacities", "means", "sh"),
        (drgs_raw[0] / linear["scales"].detach(), drgs_raw[1] / (a * (1 - a)), *drgs_raw[2:]),
        strict=True,
    ):
        assert relative(got[name].double(), want.double()) < 1e-4


def test_tangents(rng):
    """K columns at once equal one at a time; `rotations` is a left perturbation in the world frame."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 4, 5)
    settings = RenderSettings.preset("exact", extent=4.0)
    v = {name: torch.tensor(rng.normal(size=(3, *x.shape))) for name, x in g.parameters().items()}
    v |= {"rotations": torch.tensor(rng.normal(size=(3, 12, 3))), "camera": torch.tensor(rng.normal(size=(3, 6)))}
    batch = render_jvp(g, cam, v, settings)
    for k in range(3):
        one = render_jvp(g, cam, {name: x[k] for name, x in v.items()}, settings)
        for name in FIELDS:
            torch.testing.assert_close(getattr(batch, name)[k], getattr(one, name), rtol=1e-4, atol=1e-5)
    # R <- exp([w] x) R is q <- q + (0, w) q / 2.
    w, q = v["rotations"][0], g.quats.detach().double()
    real = -(w * q[:, 1:]).sum(1, keepdim=True)
    change = 0.5 * torch.cat([real, q[:, :1] * w + torch.linalg.cross(w, q[:, 1:])], 1)
    a = render_jvp(g, cam, {"rotations": w}, settings)
    b = render_jvp(g, cam, {"quats": change}, settings)
    assert relative(a.rgb, b.rgb) < 1e-5
    for bad, message in (
        ({"means": torch.zeros(5, 3)}, "shape"),
        ({"colors": torch.zeros(12, 3)}, "named among"),
        ({"means": torch.zeros(2, 12, 3), "camera": torch.zeros(3, 6)}, "leading axis"),
    ):
        with pytest.raises(ValueError, match=message):
            render_jvp(g, cam, bad, settings)


def test_rays(rng):
    """Arbitrary rays against the oracle, gradients of origins and directions included."""
    g = gaussians(rng, 20, 4, 5)
    o = torch.tensor(rng.normal(size=(7, 9, 3)) * 0.3 + (0, 0, -3.0)).requires_grad_()
    d = torch.tensor(rng.normal(size=(7, 9, 3)) * 0.3 + (0, 0, 1.0)).requires_grad_()
    for order in ("ray", "center"):
        settings = RenderSettings(order=order, traversal="bvh", sh_direction="ray", extent=4.0)
        if order == "center":
            o = o.detach()[:1, :1].expand(7, 9, 3).clone().requires_grad_()
        out, ref = render_rays(g, o, d, settings), reference.render(g, None, settings, rays=(o, d))
        good = ~ref.ambiguous
        _equal(out, ref_like(ref), good, IMAGE)
        u = torch.tensor(rng.normal(size=(7, 9, 3))) * good[..., None]
        ours = torch.autograd.grad((out.rgb.double() * u).sum(), [o, d, g.means])
        want = torch.autograd.grad((ref.rgb * u).sum(), [o, d, g.means])
        for a, b in zip(ours, want, strict=True):
            assert relative(a.double(), b.double()) < GRADIENT


def test_rays_from_one_place(rng):
    """Colors by SH of a Gaussian's direction are seen from there, with their derivative; several places have none."""
    g = gaussians(rng, 20, 4, 5)
    o = torch.tensor([0.1, -0.2, -3.0], dtype=torch.float64, requires_grad=True)
    d = torch.tensor(rng.normal(size=(7, 9, 3)) * 0.3 + (0, 0, 1.0))
    settings = RenderSettings(order="ray", traversal="bvh", sh_direction="gaussian", extent=4.0)
    out, ref = render_rays(g, o, d, settings), reference.render(g, None, settings, rays=(o.expand(d.shape), d))
    good = ~ref.ambiguous
    _equal(out, ref_like(ref), good, IMAGE)
    u = torch.tensor(rng.normal(size=(7, 9, 3))) * good[..., None]
    (ours,) = torch.autograd.grad((out.rgb.double() * u).sum(), o)
    (want,) = torch.autograd.grad((ref.rgb * u).sum(), o)
    assert relative(ours, want) < GRADIENT
    apart = o.detach() + torch.tensor([[0.0, 0, 0], [1, 0, 0]])
    with pytest.raises(ValueError, match="origins must be one and the same with SH .*sh_direction='ray'"):
        render_rays(g, apart, d[0, :2], settings)
    with pytest.raises(ValueError, match=r"shapes that broadcast, got \(2, 3\) and \(9, 3\)"):
        render_rays(g, apart, d[0], settings)


def ref_like(ref):
    """The oracle's output with the renderer's precision."""
    for name in FIELDS:
        setattr(ref, name, getattr(ref, name).float())
    return ref


@pytest.mark.parametrize("model", ["opencv", "opencv_fisheye"])
def test_distorted_cameras(rng, model):
    """`bvh` follows the lens (tiles: test_lenses.py); a model of the image plane is refused, and what to do is said."""
    cam = camera(rng, (9, 7))
    bent = Camera(K=cam.K, w2c=cam.w2c, width=9, height=7, model=model, distortion=(0.1, -0.05, 0.01, 0.02))
    g = gaussians(rng, 12, 4, 5)
    with pytest.raises(NotImplementedError, match="'ewa' is a model of a pinhole.*undistorted.*exact, fast or 3dgut"):
        render(g, bent, RenderSettings.preset("gsplat"))
    settings = RenderSettings(order="ray", traversal="bvh", extent=4.0, sh_direction="ray")
    check(compare(g, bent, settings, Oracle(g, bent, settings, rng)))


def test_skew(rng):
    """A skewed K on tiles equals its rays on `bvh`."""
    cam, g = camera(rng, (16, 11)), gaussians(rng, 20, 1, 0)
    K = cam.K.copy()
    K[0, 1] = 0.2 * K[0, 0]
    cam = Camera(K=K, w2c=cam.w2c, width=16, height=11)
    settings = RenderSettings.preset("exact")
    tiles, world = (render(g, cam, settings.replace(traversal=t)) for t in ("tiles", "bvh"))
    _equal(tiles, world, torch.ones(11, 16, dtype=bool), 2e-5)


@pytest.mark.core
def test_outputs_asked_for(rng):
    """Outputs that are not asked for are absent, and do not change the others but, on tiles, for tails."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 1, 0)
    for fields in ({}, {"order": "center"}, {"traversal": "bvh"}):
        settings = RenderSettings.preset("exact", **fields)
        some, every = (render(g.detach(), cam, settings, outputs=names) for names in ((), "all"))
        assert all(getattr(some, name) is None for name in (*OUTPUTS, "features"))
        assert torch.equal(some.rgb, every.rgb) if fields else relative(some.rgb, every.rgb) < 1e-6
    with pytest.raises(ValueError, match="outputs must be among"):
        render(g, cam, outputs=("normals",))


@pytest.mark.core
@pytest.mark.parametrize("fields", [{}, {"traversal": "bvh", "order": "center"}])
def test_list_of_cameras(rng, fields):
    """A list is its views with a leading axis: bit for bit in images, to rounding in what threads add up.

    Gradients and visibility are sums in an order that two threads do not fix: 1e-5 of them is float32's rounding.
    """
    settings, g = RenderSettings.preset("exact", **fields), gaussians(rng, 12, 4, 2)
    cameras = [camera(rng, (9, 7)) for _ in range(2)]
    u = torch.tensor(rng.normal(size=(2, 7, 9, 3))).float()
    inputs = [*g.parameters().values(), *(cam.w2c for cam in cameras)]
    every = render(g, tuple(cameras), settings, outputs="all")
    slopes = torch.autograd.grad((u * every.rgb).sum() + every.depth.sum(), inputs, allow_unused=True)
    single, total = [], 0.0
    for cam, part in zip(cameras, u, strict=True):
        single.append(render(g, cam, settings, outputs="all"))
        total = total + (part * single[-1].rgb).sum() + single[-1].depth.sum()
    assert len(every.certificate) == 2
    for name in ("rgb", "alpha", "features", *OUTPUTS):
        got, want = getattr(every, name), torch.stack([getattr(out, name) for out in single])
        assert torch.equal(got, want) or (name == "visibility" and relative(got, want) < 1e-5), name
    for got, want in zip(slopes, torch.autograd.grad(total, inputs, allow_unused=True), strict=True):
        assert (got is None and want is None) or relative(got, want) < 1e-5


# ------------------------------------------------------------------------------------- bad input


@pytest.mark.core
@pytest.mark.parametrize(
    ("fields", "alternative"),
    [
        ({"response": "ewa", "traversal": "bvh"}, "traversal='tiles'"),
        ({"response": "ewa", "order": "ray"}, "order='center'"),
        ({"order": "entry"}, "traversal='bvh'"),
        ({"culling": "inria"}, "culling='extent'"),
        ({"dilation": 0.3}, "dilation=0"),
    ],
)
def test_illegal_combinations(fields, alternative):
    """One line that names the alternative."""
    with pytest.raises(NotImplementedError, match=alternative) as error:
        RenderSettings(**fields)
    assert "\n" not in str(error.value)


@pytest.mark.core
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "sh", "features"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_parameters_that_are_not_finite(rng, name, value):
    """One line with the first index, for every group and entry point."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 4, 5)
    bad = getattr(g, name).detach().clone()
    bad[7].view(-1)[0] = value
    bad[9].view(-1)[0] = value
    g = g.replace(**{name: bad})
    directions = torch.zeros(1, 3) + 1
    for call in (
        lambda: render(g, cam),
        lambda: render_jvp(g, cam, {"camera": torch.zeros(6)}),
        lambda: render_rays(g, torch.zeros(1, 3), directions),
    ):
        with pytest.raises(ValueError, match=rf"{name} must be finite.*index 7 \(2 of 12\)") as error:
            call()
        assert "\n" not in str(error.value)


def test_zero_quaternion(rng):
    """A quaternion of 0 is no rotation."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 4, 5)
    with torch.no_grad():
        g.quats[4] = 0
    with pytest.raises(ValueError, match="index 4"):
        render(g, cam)


@pytest.mark.core
@pytest.mark.parametrize(("response", "order"), KINDS)
def test_no_gaussian(rng, response, order):
    """Nothing renders as background, and is differentiable."""
    size, _, K, D, fields = KINDS[response, order][0]
    cam, g = camera(rng, size), gaussians(rng, 0, K, D)
    for traversal in traversals(response, order):
        settings = RenderSettings(response=response, order=order, traversal=traversal).replace(**fields)
        settings = settings.replace(background=(0.1, 0.2, 0.3))
        out = render(g, cam, settings, outputs="all")
        torch.testing.assert_close(out.rgb.detach(), torch.tensor([0.1, 0.2, 0.3]).expand(*size[::-1], 3))
        for name in ("alpha", "depth", "median_depth", "count"):
            assert not getattr(out, name).any()
        assert out.visibility.shape == (0,)
        found = torch.autograd.grad(out.rgb.sum() + out.depth.sum(), list(leaves(g, cam).values()), allow_unused=True)
        assert all(x is None or not x.any() for x in found)
        pushed = render_jvp(g, cam, {"camera": torch.ones(6)}, settings)
        assert not pushed.rgb.any()


@pytest.mark.parametrize(
    ("origins", "directions", "options", "message"),
    [
        ([[0, 0, 0]], [[0, 0, 0]], {}, "directions must be finite and not 0"),
        ([[0, 0, 0]], [[0, 0, math.nan]], {}, "directions must be finite and not 0"),
        ([[0, math.inf, 0]], [[0, 0, 1]], {}, "origins must be finite"),
        ([[0, 0, 0]], [[0, 1]], {}, r"directions must have shape \(..., 3\)"),
        ([[0, 0, 0]], [[0, 0, 1]], {"near": 0.2}, "near and depth_key='z' are about a camera's axis"),
        ([[0, 0, 0]], [[0, 0, 1]], {"order": "center", "depth_key": "z"}, "near and depth_key='z' are about"),
    ],
)
def test_rays_that_cannot_be_traced(rng, origins, directions, options, message):
    """One line that names the first of them."""
    settings = RenderSettings.preset("exact", traversal="bvh", **options)
    with pytest.raises(ValueError, match=message):
        render_rays(gaussians(rng, 3, 1), torch.tensor(origins), torch.tensor(directions), settings)


@pytest.mark.every(2)
@pytest.mark.parametrize("traversal", ["tiles", "bvh"])
def test_float64_parameters_have_gradients(rng, traversal):
    """Parameters in float64 get the gradients of the same ones in float32, the SH among them."""
    g, cam = gaussians(rng, 12, 4), camera(rng, (9, 7))
    settings = RenderSettings.preset("exact", traversal=traversal)
    found = []
    for dtype in (torch.float32, torch.float64):
        values = {name: x.detach().to(dtype).requires_grad_() for name, x in g.parameters().items()}
        render(g.replace(**values), cam, settings).rgb.square().sum().backward()
        found.append({name: x.grad.double() for name, x in values.items()})
    for name, x in found[0].items():
        assert x.norm() > 0
        assert (x - found[1][name]).norm() <= 1e-5 * x.norm(), name


@pytest.mark.parametrize("traversal", ["tiles", "bvh"])
def test_graph_that_is_retained(rng, traversal):
    """A second backward pass has the gradient of its own output, not the first one's again; torch refuses one through a
    graph that was not retained.
    """
    g, cam = gaussians(rng, 20, 1, scale=0.3).detach(), camera(rng)
    settings = RenderSettings.preset("exact", traversal=traversal)
    means = g.means.clone().requires_grad_()

    def fresh(name):
        out = render(g.replace(means=means), cam, settings)
        return torch.autograd.grad(getattr(out, name).sum(), means)[0]

    wanted = {name: fresh(name) for name in ("rgb", "alpha", "depth")}
    out = render(g.replace(means=means), cam, settings)
    for name in ("rgb", "alpha", "depth", "rgb"):
        (found,) = torch.autograd.grad(getattr(out, name).sum(), means, retain_graph=True)
        torch.testing.assert_close(found, wanted[name], rtol=1e-4, atol=1e-4 * float(wanted[name].abs().max()))
    out.rgb.sum().backward()
    with pytest.raises(RuntimeError, match="second time"):
        out.alpha.sum().backward()


def test_no_rays_have_empty_images(rng):
    """Their shape is kept, each Gaussian has a visibility of 0, and gradients are 0, not an error."""
    g = gaussians(rng, 3, 1).replace(features=torch.ones(3, 2))
    out = render_rays(g, torch.zeros(3), torch.zeros(4, 0, 3), outputs="all")
    assert [tuple(x.shape) for x in (out.rgb, out.alpha, out.depth, out.features)] == [
        (4, 0, 3),
        *2 * [(4, 0)],
        (4, 0, 2),
    ]
    assert [tuple(x.shape) for x in (out.median_depth, out.count)] == 2 * [(4, 0)]
    assert out.visibility.tolist() == [0, 0, 0]
    out.rgb.sum().backward()
    assert float(g.means.grad.abs().max()) == 0


def test_rays_have_no_time(rng):
    """A scene that moves has no Gaussians for them; which to take is said."""

    class Moving:
        def at(self, time):
            return gaussians(rng, 3, 1)

        def parameters(self):
            return {}

    with pytest.raises(ValueError, match=r"render_rays: .* as rays have no time, got .*; use scene\.at\(time\)$"):
        render_rays(Moving(), torch.zeros(3), torch.ones(3))
