"""Lenses on tiles: images and derivatives against the float64 oracle, and bounds that miss no pixel."""

from __future__ import annotations

import dataclasses
import warnings

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from scenes_random import Oracle, around_camera, camera, compare, gaussians, relative, weight_of
from test_integrator import check
from test_tiles import listed_gaussians

from drgs import fisher, reference, render, render_jvp, runtime
from drgs.cameras import Camera, intrinsics
from drgs.oracle import activate
from drgs.settings import RenderSettings
from drgs.tracing import tiles
from drgs.tracing.lens_rays import LensRays, lens_of
from drgs.tracing.tiles import TILE

# Name -> model, coefficients, focal length as a multiple of what the pinhole of the same scene has.
LENSES = {
    "barrel": ("opencv", (-0.2, 0.05, 0.003, -0.002), 1.0),
    "cushion": ("opencv", (0.3, 0.1, 0.01, 0.02, 0.02), 1.2),
    "rational": ("opencv", (0.4, -0.2, 0.01, -0.01, 0.05, 0.3, 0.1, 0.02), 0.8),
    # The polynomial turns back within the image: no inverse there, rays are approximate.
    "folded": ("opencv", (-0.9, 0.1, 0.0, 0.0), 0.7),
    "fisheye": ("opencv_fisheye", (0.05, -0.02, 0.01, -0.003), 1.0),
    "half sphere": ("opencv_fisheye", (-0.03, 0.004, 0.0, 0.0), 0.3),
    "beyond": ("opencv_fisheye", (0.0, 0.0, 0.0, 0.0), 0.12),
    "thin prism": ("opencv", (0.2, -0.1, 0.01, -0.01, 0.05, 0.1, 0.1, 0.02, 0.06, -0.02, -0.05, 0.03), 0.8),
    "f-theta": ("ftheta", (1.0, 0.02, -0.06, 0.01, -0.002, 1.05, 0.03, -0.02), 0.3),
    "f-theta, narrow": ("ftheta", (0.9, 0.0, 0.05, 0.01, 0.0, 1.0, 0.0, 0.01), 1.0),
    "f-theta, inverse": ("ftheta_inverse", (1.0, -0.02, 0.04, 0.003, 0.0, 1.05, 0.03, -0.02), 0.35),
    # K takes longitude and latitude to pixels: here the seam is within the image, and a part of a panorama is seen.
    "panorama": ("equirectangular", (), None),
    "part of a panorama": ("equirectangular", (), 0.4),
    "turning back": ("opencv_fisheye", (-0.15, 0.0, 0.0, 0.0), 0.2),
}


def lens_camera(rng, name, size=(26, 21), **options):
    """A random camera with a lens that sees the scene."""
    model, distortion, factor = LENSES[name]
    cam = camera(rng, size, **options)
    K = cam.K.copy()
    if factor is None:
        K = intrinsics(size[0] / (2 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2)
    else:
        K[:2, :2] *= factor
        K[0, 1] = 0.03 * K[0, 0]
    return Camera(K=K, w2c=cam.w2c, width=cam.width, height=cam.height, model=model, distortion=distortion)


def quietly(function, *args, **options):
    """What a function gives, without warnings of lenses that have no inverse."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*cannot be inverted")
        return function(*args, **options)


@pytest.mark.every(7)
@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("response", ["peak", "integral"])
@pytest.mark.parametrize("name", LENSES)
def test_every_hit_is_listed(rng, name, response, near):
    """Whatever the oracle finds at a pixel is in the list of its tile: Gaussians far off, near, around and behind."""
    settings = RenderSettings(response=response, order="ray")
    for _ in range(3):
        cam = lens_camera(rng, name, (45, 37))
        g = gaussians(rng, 25, 1, anisotropy=1.2, spread=1.0 if near else 4.0)
        g = (around_camera(g, cam) if near else g).detach()
        listed, columns = quietly(listed_gaussians, g, cam, settings)
        extent = activate(g, settings.replace(order="entry", traversal="bvh")).extent  # the adaptive one
        for i in range(len(g)):
            one = quietly(reference.render, g.take([i]), cam, settings.replace(extent=float(extent[i])))
            hit = (one.count > 0) & (one.alpha > 1e-12)
            if response == "integral":
                # Behind the ray's origin, what there is lies below the tails that the extent leaves out.
                hit &= one.alpha > 1e-5 / 25
            for y, x in hit.nonzero().tolist():
                assert i in listed[(y // TILE) * columns + x // TILE], (i, x, y)


def _everywhere(self, guides):
    """Bounds beyond any image."""
    return [x * 0 + sign * 1e9 for sign, x in zip((-1, -1, 1, 1), guides, strict=True)]


@pytest.mark.every(7)
@pytest.mark.parametrize("anisotropy", [0.5, 2.5])
@pytest.mark.parametrize("name", LENSES)
def test_what_bounds_leave_out_changes_nothing(rng, monkeypatch, name, anisotropy):
    """Listing a Gaussian only where it may be seen gives the same bits as listing it everywhere."""
    monkeypatch.setattr(tiles, "_TEST_TILES_FROM", 0)
    pairs = []
    for spread in (1.0, 8.0):
        cam = lens_camera(rng, name, (61, 45), turn=1.0)
        g = gaussians(rng, 40, 1, scale=0.1, spread=spread, anisotropy=anisotropy, opacity=2.5)
        g = around_camera(g, cam).detach()
        images = []
        for whole in (False, True):
            with monkeypatch.context() as patch:
                if whole:
                    patch.setattr(LensRays, "pixels", _everywhere)
                    patch.setattr(tiles._Tiles, "may_hit", lambda self, x, y: self.lib.Bool(True))
                out = quietly(render, g, cam, outputs=("count", "depth"))
                parts = [out.rgb, out.alpha[..., None], out.depth[..., None], out.count[..., None]]
                images.append(torch.cat(parts, -1))
                pairs.append(out.certificate["pairs"])
        assert torch.equal(*images)
    assert sum(pairs[::2]) < 0.7 * sum(pairs[1::2])


CUTS = {"extent": 3.0, "transmittance_min": 0.01, "alpha_max": 0.9999}
KINDS = [
    ("barrel", {"order": "ray"}),
    ("cushion", {"response": "integral", "alpha_min": 1 / 255, "near": 0.01}),
    ("rational", CUTS),
    ("folded", {"order": "ray"}),
    ("fisheye", {"order": "ray", "sh_direction": "ray"}),
    ("fisheye", CUTS),
    ("half sphere", {"response": "integral", "order": "ray"}),
    ("half sphere", CUTS),
    ("beyond", {"order": "ray"}),
    ("beyond", {"response": "integral", "depth_key": "z"}),
    ("turning back", {"order": "ray", "sh_direction": "ray"}),
    ("thin prism", {"order": "ray"}),
    ("f-theta", {"order": "ray", "sh_direction": "ray"}),
    ("f-theta, narrow", CUTS),
    ("f-theta, inverse", {"order": "ray", "sh_direction": "ray"}),
    ("panorama", {"order": "ray", "sh_direction": "ray"}),
    ("panorama", CUTS),
    ("part of a panorama", {"response": "integral", "order": "ray"}),
]


@pytest.mark.every(7)
@pytest.mark.parametrize(("name", "fields"), KINDS, ids=lambda f: f if isinstance(f, str) else "-".join(map(str, f)))
def test_images_and_derivatives(rng, name, fields):
    """Images, adjoint and forward mode, the pose's among them, within the tolerances of pinholes."""
    settings = RenderSettings(**fields)
    for near in (False, True):
        cam = lens_camera(rng, name)
        g = gaussians(rng, 20, 4, 3)
        if near:
            g = around_camera(g, cam)
        oracle = quietly(Oracle, g, cam, settings, rng)
        errors = quietly(compare, g, cam, settings, oracle)
        check(errors)
        # Of `integral` the oracle counts what lies behind the ray's origin, below the tails that the extent leaves out.
        assert errors.count <= 1 or settings.response == "integral"
        assert float((~oracle.good).double().mean()) < 0.1


INFORMED = [
    ("barrel", "peak", "ray"),
    ("fisheye", "integral", "center"),
    ("beyond", "peak", "center"),
    ("half sphere", "integral", "ray"),
    ("panorama", "peak", "ray"),
    ("f-theta", "peak", "center"),
]


@pytest.mark.every(4)
@pytest.mark.parametrize(("name", "response", "order"), INFORMED)
def test_information(rng, name, response, order):
    """Fisher diagonal, blocks, columns and the pose's information equal those of the oracle's dense Jacobian."""
    settings = RenderSettings.preset("exact", response=response, order=order, background=(0.2, 0.5, 0.9))
    for _ in range(50):
        g, cam = gaussians(rng, 8, 4, scale=0.25), lens_camera(rng, name, (12, 10))
        out = quietly(reference.render, g, cam, settings)
        if not out.ambiguous.any() and out.count.max() > 1:
            break
    J = dense.jacobian(g, out)
    truth = dense.squares(J)
    found = quietly(fisher.diagonal, g, cam, settings)
    columns = quietly(fisher.diagonal, g, cam, settings, "columns")
    for group in dense.GROUPS:
        assert dense.error(found[group], truth[group]) <= 1e-4, group
        assert dense.error(columns[group], truth[group]) <= 1e-4, group
    rows = dense.stacked(J)
    truth = torch.einsum("pni,pnj->nij", rows, rows)
    scale = truth.diagonal(dim1=1, dim2=2).amax(0).sqrt().clamp_min(1e-12)
    found = quietly(fisher.blocks, g, cam, settings)
    assert float(((found - truth) / (scale[:, None] * scale)).abs().max()) <= 1e-4
    pose = dense.pose_jacobian(cam, out)
    assert dense.error(quietly(fisher.pose_information, g, cam, settings), pose.T @ pose) <= 1e-4


MOVED = [
    ("pinhole", {"order": "ray"}),
    ("barrel", {"order": "ray"}),
    ("barrel", {"order": "ray", "traversal": "bvh"}),
    ("rational", {"response": "integral", "sh_direction": "ray"}),
    ("folded", CUTS),
    ("fisheye", {"order": "ray"}),
    ("half sphere", {"response": "integral", "order": "ray", "sh_direction": "ray"}),
    ("beyond", CUTS),
    ("beyond", {"order": "ray", "traversal": "bvh", "sh_direction": "ray"}),
    ("thin prism", {"order": "ray", "sh_direction": "ray"}),
    ("f-theta", {"order": "ray"}),
    ("f-theta", {"order": "ray", "traversal": "bvh"}),
    ("f-theta, narrow", CUTS),
    ("f-theta, inverse", {"order": "ray"}),
    ("panorama", {"order": "ray", "sh_direction": "ray"}),
    ("part of a panorama", {"response": "integral", "order": "ray"}),
]
LENSES["pinhole"] = ("pinhole", (), 1.0)


@pytest.mark.every(5)
@pytest.mark.parametrize(("name", "fields"), MOVED, ids=lambda f: f if isinstance(f, str) else "-".join(map(str, f)))
def test_derivatives_by_the_lens(rng, name, fields):
    """Reverse and forward, by focal lengths, principal point, skew and distortion: the oracle's along its rays, times
    finite differences of these, in float64.
    """
    settings = RenderSettings(**fields)
    cam = lens_camera(rng, name)
    g = gaussians(rng, 20, 4, 3)
    at = cam.lens_parameters
    with torch.no_grad():
        rays = quietly(cam.pixel_directions)
    directions = torch.tensor(rays).requires_grad_()
    origins = torch.tensor(cam.center).expand(directions.shape)
    plain = Camera(K=cam.K, w2c=cam.w2c.detach(), width=cam.width, height=cam.height)
    # The oracle normalizes no direction: a ray's length does not change.
    unit = torch.nn.functional.normalize(directions, dim=-1)
    truth = reference.render(g.detach(), plain, settings, rays=(origins, unit))
    # Where a lens has no inverse, rays do not move.
    seen = cam.project(rays.reshape(-1, 3) + cam.center)[0].reshape(*rays.shape[:2], 2)
    columns, rows = np.meshgrid(np.arange(cam.width) + 0.5, np.arange(cam.height) + 0.5)
    inverse = torch.tensor(np.hypot(seen[..., 0] - columns, seen[..., 1] - rows) < 1e-3)
    assert inverse.double().mean() > 0.2
    good = ~truth.ambiguous & inverse
    names = ("rgb", "alpha", "depth", "features")
    u = {k: torch.tensor(rng.normal(size=tuple(getattr(truth, k).shape))) for k in names}
    for k, x in u.items():
        x *= good.reshape(*good.shape, *[1] * (x.ndim - 2)) * weight_of(k, truth)
        x.requires_grad_()
    loss = sum((getattr(truth, k) * x).sum() for k, x in u.items())
    (slope,) = torch.autograd.grad(loss, directions, create_graph=True)
    moved = torch.zeros(len(at), *directions.shape, dtype=torch.float64)
    for k in range(len(at)):
        step = 1e-5 * max(abs(at[k]), 0.1 if k >= 5 else 1.0)
        ends = [quietly(cam.with_lens(at + s * step * np.eye(len(at))[k]).pixel_directions) for s in (1, -1)]
        moved[k] = torch.tensor((ends[0] - ends[1]) / (2 * step)) * inverse[..., None]
    want = torch.einsum("hwc,khwc->k", slope, moved)

    lens = torch.tensor(at, requires_grad=True)
    out = quietly(render, g.detach(), cam, settings, outputs=("depth",), lens=lens)
    for k in names:
        pair = ((getattr(x, k) * weight_of(k, truth))[good].double() for x in (out, truth))
        torch.testing.assert_close(*pair, rtol=1e-5, atol=1e-5)
    sum((getattr(out, k).double() * x.detach()).sum() for k, x in u.items()).backward()
    assert relative(lens.grad, want.detach()) < 1e-4
    v = torch.tensor(rng.normal(size=len(at))) * (1 + abs(torch.tensor(at)))
    (pushed,) = (torch.autograd.grad(want @ v, list(u.values()), retain_graph=True),)
    got = quietly(render_jvp, g.detach(), cam, {"lens": v}, settings)
    for k, x in zip(names, pushed, strict=True):
        assert relative(*((y.double() * weight_of(k, truth))[good] for y in (getattr(got, k), x))) < 1e-4, k


@pytest.mark.parametrize("order", ["center", "ray"])
def test_panoramas_have_no_seam(rng, order):
    """Turned by half a circle a panorama is the same one, its halves exchanged; upside down, it is turned over."""
    size = 48, 24
    K = intrinsics(size[0] / (2 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2)
    g = gaussians(rng, 60, 4, scale=0.15, spread=2.0).detach()
    settings = RenderSettings(order=order)
    images = []
    for turn in ((1, 1, 1), (-1, 1, -1), (-1, -1, 1)):
        camera = Camera(K, np.diag([*turn, 1.0]), *size, "equirectangular")
        out = render(g, camera, settings, outputs=("depth",))
        images.append(torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None]], -1))
    assert (images[0][..., 3] > 0.1).double().mean() > 0.3
    torch.testing.assert_close(images[1], images[0].roll(size[0] // 2, 1), rtol=1e-4, atol=2e-5)
    torch.testing.assert_close(images[2], images[0].flip(0, 1), rtol=1e-4, atol=2e-5)


@pytest.mark.slow
def test_derivatives_by_the_lens_through_torch(rng):
    """`torch.func` in both modes, and cameras that share a lens."""
    cam, g = lens_camera(rng, "barrel", (9, 7)), gaussians(rng, 10, 1).detach()
    cam = dataclasses.replace(cam, w2c=cam.w2c.detach())
    lens = torch.tensor(cam.lens_parameters)
    loss = lambda x: render(g, cam, lens=x).rgb.double().square().sum()  # noqa: E731
    slope = torch.func.grad(loss)(lens)
    v = torch.tensor(rng.normal(size=9))
    value, pushed = torch.func.jvp(loss, (lens,), (v,))
    assert float(pushed) == pytest.approx(float(slope @ v), rel=1e-4)
    lens.requires_grad_()
    both = render(g, [cam, cam], lens=lens).rgb.double().square().sum()
    assert float(both) == pytest.approx(2 * float(value), rel=1e-6)
    both.backward()
    torch.testing.assert_close(lens.grad, 2 * slope, rtol=1e-5, atol=1e-8)
    moved = render(g, cam, lens=lens.detach() * 1.01).rgb
    assert torch.equal(moved, render(g, cam.with_lens(cam.lens_parameters * 1.01)).rgb)


def test_what_has_no_derivative_by_the_lens(rng):
    """Said in one line, with what to do."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 5, 1).detach()
    lens = torch.tensor(cam.lens_parameters)
    with pytest.raises(NotImplementedError, match="by the lens.*'ewa'; use preset exact"):
        render(g, cam, RenderSettings.preset("gsplat"), lens=lens)
    with pytest.raises(ValueError, match=r"must have shape \(5,\).*got \(6,\)"):
        render(g, cam, lens=torch.ones(6))
    with pytest.raises(ValueError, match="lens must be"):
        render(g, cam, lens=cam.lens_parameters)


@pytest.mark.parametrize(
    ("fields", "focal", "distortion"),
    [
        ({"order": "ray", "sh_direction": "ray"}, 18.0, (-1.5, 2.3, -0.6, 3.7, -35.6, 17.7, -12.2, -25.0)),
        ({"order": "ray", "traversal": "bvh"}, 18.0, (-1.5, 2.3, -0.6, 3.7, -35.6, 17.7, -12.2, -25.0)),
        (CUTS, 30.0, (-11.8, -9.1, -9.3, 2.1, 0.3, 2.2, -7.6, 3.7)),
    ],
)
def test_pixels_without_a_ray(rng, fields, focal, distortion):
    """Where OpenCV finds no number the background is seen, and nothing has a derivative; elsewhere all is as ever."""
    settings = RenderSettings(**fields, background=(0.2, 0.5, 0.9))
    cam, g = camera(rng, (30, 24)), gaussians(rng, 20, 4, 3)
    cam = dataclasses.replace(cam, K=intrinsics(focal, focal, 14, 13), model="opencv", distortion=distortion)
    holes = ~np.isfinite(quietly(cam.pixel_directions)).all(-1)
    assert 0 < holes.mean() < 0.7
    lens = torch.tensor(cam.lens_parameters).requires_grad_()
    out = quietly(render, g, cam, settings, outputs=("depth",), lens=lens)
    assert (out.rgb[holes] == torch.tensor(settings.background)).all()
    assert not out.alpha[holes].any()
    assert not out.features[holes].any()
    truth = quietly(reference.render, g.detach(), dataclasses.replace(cam, w2c=cam.w2c.detach()), settings)
    good = torch.tensor(~holes) & ~truth.ambiguous
    for name in ("rgb", "alpha", "depth", "features"):
        pair = ((getattr(x, name) * weight_of(name, truth))[good].double() for x in (out, truth))
        torch.testing.assert_close(*pair, rtol=1e-5, atol=1e-5)
    out.rgb.square().sum().backward()
    for x in (*g.parameters().values(), cam.w2c, lens):
        assert torch.isfinite(x.grad).all()


def test_cameras_of_a_lens_share_its_table(rng):
    """Wherever they are; another size has another one."""
    lib = runtime.dr_types()
    cam = lens_camera(rng, "fisheye")
    moved = lens_camera(rng, "fisheye")
    moved = dataclasses.replace(moved, K=cam.K)
    assert lens_of(lib, cam, TILE) is lens_of(lib, moved, TILE)
    assert lens_of(lib, cam.resized(13, 11), TILE) is not lens_of(lib, cam, TILE)
    assert lens_of(lib, camera(rng), TILE) is None
    assert [lens_of(lib, lens_camera(rng, k), TILE).wide for k in ("barrel", "fisheye", "beyond")] == [
        False,
        False,
        True,
    ]
