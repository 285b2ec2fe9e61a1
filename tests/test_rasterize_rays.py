"""`drgs.rasterization` along rays: what gsplat 1.6 has with `with_eval3d`, against the float64 oracle."""

from __future__ import annotations

import dataclasses
import enum
import math
import types

import pytest
import torch
from test_rasterize import arguments

import drgs
from drgs import reference
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.rasterize import _lenses_of
from drgs.settings import RenderSettings


class RollingShutterType(enum.Enum):
    """Names of gsplat's enumeration."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


RADIAL = (0.1, -0.05, 0.02, 0.05, 0.01, 0.0)
TANGENTIAL = (0.01, -0.02)
PRISM = (0.02, -0.01, -0.02, 0.01)
FISHEYE = (0.05, -0.02, 0.01, -0.003)
LENSES = {
    "pinhole": ({}, {}),
    "opencv": (
        {"radial_coeffs": RADIAL, "tangential_coeffs": TANGENTIAL},
        {"model": "opencv", "distortion": (*RADIAL[:2], *TANGENTIAL, *RADIAL[2:])},
    ),
    "thin prism": (
        {"thin_prism_coeffs": PRISM},
        {"model": "opencv", "distortion": (*[0.0] * 8, *PRISM)},
    ),
    "fisheye": (
        {"camera_model": "fisheye", "radial_coeffs": FISHEYE},
        {"model": "opencv_fisheye", "distortion": FISHEYE},
    ),
    "plain fisheye": ({"camera_model": "fisheye"}, {"model": "opencv_fisheye", "distortion": (0.0,) * 4}),
}


def options_of(lens, cameras=1):
    """gsplat's arguments of a lens, and the fields of a camera that has it."""
    given, fields = LENSES[lens]
    as_tensor = lambda x: torch.tensor(x, dtype=torch.float64).expand(cameras, -1)  # noqa: E731
    return {name: x if isinstance(x, str) else as_tensor(x) for name, x in given.items()}, fields


def turned(viewmats, angle=0.05, move=0.1):
    """Poses at the end of an exposure."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    turn[:3, 3] = move * torch.tensor([1.0, -0.5, 0.3], dtype=torch.float64)
    return turn @ viewmats


def gaussians_of(given, features=None):
    """The scene of the arguments."""
    return Gaussians.from_arrays(
        given["means"], given["quats"], given["scales"], given["opacities"], given["colors"], features=features
    )


def oracle(given, fields, settings, **options):
    """Image with the background, alpha, and what else the oracle gives, of the first camera."""
    w2c = given["viewmats"][0]
    camera = Camera(K=given["Ks"][0].numpy(), w2c=w2c, width=given["width"], height=given["height"], **fields)
    out = reference.render(gaussians_of(given), camera, settings, tolerance=1e-5, **options)
    return out, out.rgb + (1 - out.alpha[..., None]) * given["backgrounds"][0]


UT = RenderSettings.preset("3dgut", culling="ut")


@pytest.mark.every(5)
@pytest.mark.parametrize("lens", LENSES)
def test_images_and_gradients_through_lenses(lens):
    """Image and every gradient are the oracle's; no gradient is gsplat's that is none of ours."""
    options, fields = options_of(lens)
    given = arguments(n=40, width=30, height=26)
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
    leaves = {name: given[name].clone().requires_grad_() for name in names}
    ours, alpha, _ = drgs.rasterization(**{**given, **leaves}, **options, with_ut=True, with_eval3d=True)
    theirs = {name: given[name].clone().requires_grad_() for name in names}
    out, image = oracle({**given, **theirs}, fields, UT)
    good = ~out.ambiguous
    assert good.double().mean() > 0.8
    assert float((ours[0] - image).abs()[good].max()) < 2e-5
    assert float((alpha[0, ..., 0] - out.alpha).abs()[good].max()) < 2e-5
    u = torch.randn(image.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * good[..., None]
    mine = torch.autograd.grad((ours[0] * u).sum(), list(leaves.values()))
    expected = torch.autograd.grad((image * u).sum(), list(theirs.values()))
    for name, a, b in zip(names, mine, expected, strict=True):
        assert float((a - b).norm()) < 2e-4 * float(b.norm()), name


def test_ftheta():
    """gsplat's own parameters: pixels by a polynomial of the angle, from the center of the first pixel."""
    given = arguments(n=30, width=30, height=26)
    polynomial = (0.0, 16.0, 0.3, -0.5, 0.1, 0.0)
    made = types.SimpleNamespace(
        reference_poly=types.SimpleNamespace(name="ANGLE_TO_PIXELDIST"),
        angle_to_pixeldist_poly=polynomial,
        linear_cde=(1.02, 0.01, -0.02),
        max_angle=2.0,
    )
    found = drgs.rasterization(**given, camera_model="ftheta", ftheta_coeffs=made, with_ut=True, with_eval3d=True)[0]
    K = given["Ks"][0].numpy()
    x, y = (torch.arange(n, dtype=torch.float64) for n in (30, 26))  # pixel centers, as that model counts them
    u, v = torch.meshgrid(x - K[0, 2], y - K[1, 2], indexing="xy")
    c, d, e = made.linear_cde
    p, q = (u - d * v) / (c - e * d), (c * v - e * u) / (c - e * d)
    radius = torch.hypot(p, q)
    angle = radius / polynomial[1]
    for _ in range(50):
        value = sum(k * angle**i for i, k in enumerate(polynomial))
        slope = sum(i * k * angle ** (i - 1) for i, k in enumerate(polynomial) if i)
        angle = angle - (value - radius) / slope
    scale = torch.where(radius > 0, angle.sin() / radius, 0.0)
    local = torch.stack([p * scale, q * scale, angle.cos()], -1)
    w2c = given["viewmats"][0]
    d = local @ w2c[:3, :3]
    rays = (-w2c[:3, 3] @ w2c[:3, :3]).expand_as(d), d
    out, image = oracle(given, {}, RenderSettings.preset("3dgut", culling="extent"), rays=rays)
    whole = drgs.rasterization(**given, camera_model="ftheta", ftheta_coeffs=made, with_eval3d=True)[0]
    assert float((whole[0] - image).abs()[~out.ambiguous].max()) < 2e-5
    own = {"model": "ftheta", "distortion": (*polynomial[1:], *made.linear_cde)}
    own["K"] = [[1.0, 0.0, K[0, 2] + 0.5], [0.0, 1.0, K[1, 2] + 0.5], [0.0, 0.0, 1.0]]
    camera = Camera(w2c=w2c, width=30, height=26, **own)
    culled = reference.render(gaussians_of(given), camera, UT, tolerance=1e-5)
    seen = culled.rgb + (1 - culled.alpha[..., None]) * given["backgrounds"][0]
    assert float((found[0] - seen).abs()[~culled.ambiguous].max()) < 2e-5
    # K has the focal length: with one of 1 all guides are in one cell, and each Gaussian is listed on all tiles.
    fields = _lenses_of("ftheta", (), 1, None, None, None, made, given["Ks"])[0][0]
    assert fields["K"][0, 0] == fields["K"][1, 1] == polynomial[1]
    assert fields["distortion"] == pytest.approx((*(k / polynomial[1] for k in polynomial[1:]), *made.linear_cde))
    made.reference_poly = "PIXELDIST_TO_ANGLE"
    made.pixeldist_to_angle_poly = back = (0.0, 1 / 16, 2e-5, -1e-6, 0.0, 1e-9)
    angle = sum(k * radius**i for i, k in enumerate(back))
    scale = torch.where(radius > 0, angle.sin() / radius, 0.0)
    d = torch.stack([p * scale, q * scale, angle.cos()], -1) @ w2c[:3, :3]
    out, image = oracle(given, {}, RenderSettings.preset("3dgut", culling="extent"), rays=(rays[0], d))
    whole = drgs.rasterization(**given, camera_model="ftheta", ftheta_coeffs=made, with_eval3d=True)[0]
    assert float((whole[0] - image).abs()[~out.ambiguous].max()) < 2e-5
    made.pixeldist_to_angle_poly = (0.1, *back[1:])
    with pytest.raises(NotImplementedError, match="must have a reference polynomial without a constant term.*rays="):
        drgs.rasterization(**given, camera_model="ftheta", ftheta_coeffs=made, with_eval3d=True)
    with pytest.raises(ValueError, match="ftheta_coeffs must come with camera_model='ftheta'"):
        drgs.rasterization(**given, camera_model="ftheta", with_eval3d=True)


@pytest.mark.parametrize("lens", ["pinhole", "opencv"])
@pytest.mark.parametrize("shutter", list(RollingShutterType)[:2])
def test_rolling_shutters(lens, shutter):
    """Images and the gradients of both poses; colors are seen from the middle of both centers."""
    options, fields = options_of(lens)
    given = arguments(n=40, width=30, height=26, degree=2)
    poses = {"viewmats": given["viewmats"].clone().requires_grad_()}
    poses["viewmats_rs"] = turned(given["viewmats"]).requires_grad_()
    ours, _, _ = drgs.rasterization(
        **{**given, **poses}, **options, rolling_shutter=shutter, with_ut=True, with_eval3d=True
    )
    start, end = (x.detach().clone().requires_grad_() for x in poses.values())
    fields = {**fields, "shutter": shutter.name.lower(), "w2c_end": end[0]}
    center = sum(-x[0, :3, 3] @ x[0, :3, :3] for x in (start, end)) / 2
    from drgs.oracle import sh_colors  # the truth's own colors, towards that point

    plain = sh_colors(given["colors"], given["means"] - center)
    # Colors as SH of degree 0 whose clamp is out of the way.
    flat = {**given, "viewmats": start, "colors": ((plain + 0.5) / 0.28209479177387814)[:, None]}
    out, _ = oracle(flat, fields, UT)
    image = out.rgb - out.alpha[..., None] + (1 - out.alpha[..., None]) * given["backgrounds"][0]
    good = ~out.ambiguous
    assert float((ours[0] - image).abs()[good].max()) < 3e-5
    u = torch.randn(image.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * good[..., None]
    mine = torch.autograd.grad((ours[0] * u).sum(), list(poses.values()))
    expected = torch.autograd.grad((image * u).sum(), [start, end])
    for a, b, pose in zip(mine, expected, (start, end), strict=True):
        for k in range(3):  # along translations, and rotations
            move = torch.zeros(4, 4, dtype=torch.float64)
            move[k, 3] = 1.0
            turn = torch.zeros(4, 4, dtype=torch.float64)
            turn[k, (k + 1) % 3], turn[(k + 1) % 3, k] = 1.0, -1.0
            for change in (move, turn):
                along = change @ pose[0].detach()
                got, want = float((a[0] * along).sum()), float((b[0] * along).sum())
                assert got == pytest.approx(want, rel=5e-4, abs=2e-3)


def test_depths_of_gaussians_and_along_rays():
    """D and ED blend the Gaussian's own depth, z or distance; d and Ed the distance along each ray."""
    given = arguments(n=40, width=30, height=26)
    call = lambda mode, **o: drgs.rasterization(**given, render_mode=mode, with_ut=True, with_eval3d=True, **o)  # noqa: E731
    camera = Camera(K=given["Ks"][0].numpy(), w2c=given["viewmats"][0], width=30, height=26)
    local = given["means"] @ given["viewmats"][0, :3, :3].T + given["viewmats"][0, :3, 3]
    for by_z, own in ((True, local[:, 2:]), (False, local.norm(dim=1, keepdim=True))):
        settings = UT.replace(depth_key="z" if by_z else "distance")
        out = reference.render(gaussians_of(given, own), camera, settings, tolerance=1e-5)
        good = ~out.ambiguous
        expected = {"D": out.features, "d": out.depth[..., None] * out.alpha[..., None]}
        for mode, total in expected.items():
            sums = call(mode, global_z_order=by_z)
            assert float((sums[0][0] - total).abs()[good].max()) < 1e-4
            mean = call("E" + mode, global_z_order=by_z)
            size = total / out.alpha.clamp_min(1e-10)[..., None]
            assert float(((mean[0][0] - size).abs() * (out.alpha > 1e-3)[..., None])[good].max()) < 1e-4
            both = call("RGB+D" if mode == "D" else "RGB-d", global_z_order=by_z)[0]
            assert both.shape == (1, 26, 30, 4)
            assert torch.equal(both[0, ..., 3:], sums[0][0])
            assert call("RGB+ED" if mode == "D" else "RGB-Ed", global_z_order=by_z)[0].shape == (1, 26, 30, 4)


def test_colors_may_be_missing_from_depths():
    """As in gsplat, where only a depth is drawn."""
    given = {**arguments(n=20), "colors": None, "sh_degree": None, "backgrounds": None}
    assert drgs.rasterization(**given, render_mode="D")[0].shape == (1, 40, 48, 1)
    assert drgs.rasterization(**given, render_mode="Ed", with_eval3d=True)[0].shape == (1, 40, 48, 1)


def test_normals():
    """Third axes, turned against each ray, blended with the weights."""
    given = arguments(n=30, width=30, height=26)
    _, _, meta = drgs.rasterization(**given, with_ut=True, with_eval3d=True, return_normals=True)
    camera = Camera(K=given["Ks"][0].numpy(), w2c=given["viewmats"][0], width=30, height=26)
    weights = reference.render(gaussians_of(given, torch.eye(30, dtype=torch.float64)), camera, UT, tolerance=1e-5)
    w, x, y, z = torch.nn.functional.normalize(given["quats"], dim=1).unbind(1)
    axes = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    along = torch.from_numpy(camera.pixel_directions()) @ axes.T
    expected = torch.einsum("hwn,nk->hwk", weights.features * torch.where(along > 0, -1.0, 1.0), axes)
    assert meta["normals"].shape == (1, 26, 30, 3)
    assert float((meta["normals"][0] - expected).abs()[~weights.ambiguous].max()) < 2e-5


def test_extra_signals():
    """Channels beside the colors, on nothing, plain or as coefficients that are not clamped."""
    given = arguments(n=30, width=30, height=26)
    make = torch.Generator().manual_seed(3)
    plain = torch.randn(30, 5, generator=make, dtype=torch.float64)
    image, alpha, meta = drgs.rasterization(**given, extra_signals=plain, render_mode="RGB+D")
    both = drgs.rasterization(**{**given, "colors": plain, "sh_degree": None, "backgrounds": None})[0]
    assert image.shape == (1, 26, 30, 4)
    assert torch.allclose(meta["render_extra_signals"], both, atol=2e-5)
    assert torch.allclose(image, drgs.rasterization(**given, render_mode="RGB+D")[0], atol=1e-6)
    coefficients = torch.randn(30, 4, 2, generator=make, dtype=torch.float64)
    meta = drgs.rasterization(**given, extra_signals=coefficients, extra_signals_sh_degree=1)[2]
    center = -given["viewmats"][0, :3, 3] @ given["viewmats"][0, :3, :3]
    from drgs.oracle import sh_basis

    basis = sh_basis(torch.nn.functional.normalize(given["means"] - center, dim=1), 4)
    values = 0.5 + torch.einsum("nk,nkd->nd", basis, coefficients)
    expected = drgs.rasterization(**{**given, "colors": values, "sh_degree": None, "backgrounds": None})[0]
    assert torch.allclose(meta["render_extra_signals"], expected, atol=2e-5)


@pytest.mark.parametrize("channels", [1, 2, 5])
def test_coefficients_of_any_number_of_channels(channels):
    """SH of other channels than three: each is what it would be among three."""
    given = arguments(n=30, width=30, height=26)
    wide = given["colors"].repeat(1, 1, 2)[..., :channels]
    behind = given["backgrounds"].repeat(1, 2)[..., :channels]
    found = drgs.rasterization(**{**given, "colors": wide, "backgrounds": behind})[0]
    expected = drgs.rasterization(**given)[0].repeat(1, 1, 1, 2)[..., :channels]
    assert torch.allclose(found, expected, atol=2e-5)


def test_coefficients_are_shared_by_batches():
    """(N, K, 3) of gsplat 1.6 beside scenes with leading axes."""
    given = arguments(n=20, cameras=2)
    names = ("means", "quats", "scales", "opacities", "viewmats", "Ks", "backgrounds")
    batch = {name: given[name].expand(2, *given[name].shape) for name in names}
    found = drgs.rasterization(**{**given, **batch})[0]
    assert found.shape == (2, 2, 40, 48, 3)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], drgs.rasterization(**given)[0])


def test_rays_of_the_caller():
    """The camera's own rays give its image; others their own, with a gradient."""
    given = arguments(n=30, width=30, height=26, cameras=2)
    cameras = [
        Camera(K=K.numpy(), w2c=w2c.numpy(), width=30, height=26)
        for K, w2c in zip(given["Ks"], given["viewmats"], strict=True)
    ]
    rays = torch.stack(
        [
            torch.cat([torch.from_numpy(c.pixel_origins().copy()), torch.from_numpy(c.pixel_directions())], -1)
            for c in cameras
        ]
    ).requires_grad_()
    image = drgs.rasterization(**given, rays=rays, with_eval3d=True, with_ut=True)[0]
    expected = drgs.rasterization(**given, with_eval3d=True, with_ut=True)[0]
    assert torch.allclose(image, expected, atol=2e-5)
    image.square().sum().backward()
    assert rays.grad.shape == rays.shape
    assert torch.isfinite(rays.grad).all()
    assert rays.grad.abs().sum() > 0


def test_gradient_of_projected_means():
    """meta["means2d"] is a leaf with the gradient by the projected means, all else held, in pixels."""
    given = arguments(n=12, width=20, height=16)
    leaves = {"means": given["means"].clone().requires_grad_()}
    image, _, meta = drgs.rasterization(**{**given, **leaves})
    means2d = meta["means2d"]
    means2d.retain_grad()
    u = torch.randn(image.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    (image * u).sum().backward()
    assert means2d.shape == (1, 12, 2)
    # Moving the principal point moves all projected means by as much, and their Jacobians' clamps, which are far here.
    camera = Camera(K=given["Ks"][0].numpy(), w2c=given["viewmats"][0], width=20, height=16)
    settings = RenderSettings.preset("gsplat", fov_clamp="none", alpha_min=0.0, culling="extent", transmittance_min=0.0)
    whole, _, meta = drgs.rasterization(**{**given, **leaves}, preset=settings)
    (whole * u).sum().backward()
    h = 1e-4
    for axis in range(2):
        sums = []
        for sign in (1, -1):
            K = camera.K.copy()
            K[axis, 2] += sign * h
            shifted = dataclasses.replace(camera, K=K)
            out = reference.render(gaussians_of(given), shifted, settings)
            moved = out.rgb + (1 - out.alpha[..., None]) * given["backgrounds"][0]
            sums.append(float((moved * u[0]).sum()))
        expected = (sums[0] - sums[1]) / (2 * h)
        assert float(meta["means2d"].grad[0, :, axis].sum()) == pytest.approx(expected, rel=1e-3)
    assert drgs.rasterization(**given)[2]["means2d"].requires_grad is False


@pytest.mark.parametrize("channels", [None, 5])
def test_absolute_gradients_of_projected_means(channels):
    """absgrad is the sum over pixels of the absolute value of what each alone gives."""
    given = arguments(n=12, width=12, height=10, channels=channels)
    means = given["means"].clone().requires_grad_()
    image, _, meta = drgs.rasterization(**{**given, "means": means}, absgrad=True)
    u = torch.randn(image.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    (image * u).sum().backward()
    total = torch.zeros(12, 2, dtype=torch.float64)
    signed = torch.zeros(12, 2, dtype=torch.float64)
    for y in range(10):
        for x in range(12):
            image, _, one = drgs.rasterization(**{**given, "means": means})
            (found,) = torch.autograd.grad((image[0, y, x] * u[0, y, x]).sum(), [one["means2d"]])
            total += found[0].abs()
            signed += found[0]
    assert torch.allclose(meta["means2d"].absgrad[0], total, rtol=1e-4, atol=1e-5 * float(total.max()))
    assert torch.allclose(meta["means2d"].grad[0], signed, rtol=1e-4, atol=1e-5 * float(total.max()))
    assert float((total - signed.abs()).max()) > 0.01 * float(total.max())


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_meta_by_the_unscented_transform(lens):
    """Radii are the boxes that cull: a Gaussian with radius 0 is not drawn, one alone stays within its box's tiles."""
    options, _ = options_of(lens)
    given = {**arguments(n=30, channels=3), "backgrounds": None}
    _, _, meta = drgs.rasterization(**given, **options, with_ut=True, with_eval3d=True)
    for i in range(30):
        one = {
            **given,
            **{name: given[name][i : i + 1] for name in ("means", "quats", "scales", "opacities", "colors")},
        }
        alpha = drgs.rasterization(**one, **options, with_ut=True, with_eval3d=True)[1][0, ..., 0]
        radius = meta["radii"][0, i].double()
        if not bool((radius > 0).all()):
            assert not alpha.any()
            continue
        rows, columns = alpha.nonzero().unbind(1)
        low = ((meta["means2d"][0, i] - radius) / 8).floor() * 8
        high = ((meta["means2d"][0, i] + radius) / 8).ceil() * 8
        inside = (columns + 0.5 > low[0]) & (columns + 0.5 < high[0]) & (rows + 0.5 > low[1]) & (rows + 0.5 < high[1])
        assert bool(inside.all())


def test_near_and_far_are_distances_of_what_is_sorted_by_distance():
    """A fisheye sees behind itself, and gsplat leaves nothing out there when it sorts by distance."""
    given = {**arguments(n=60, channels=3), "backgrounds": None}
    given["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    given["means"] = given["means"] - torch.tensor([0.0, 0.0, 3.0])  # all around
    options = {"camera_model": "fisheye", "with_ut": True, "with_eval3d": True}
    given["Ks"] = torch.tensor([[[8.0, 0.0, 24.0], [0.0, 8.0, 20.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    z, distance = given["means"][:, 2], given["means"].norm(dim=1)
    for by_z, depths in ((True, z), (False, distance)):
        _, alpha, meta = drgs.rasterization(**given, **options, global_z_order=by_z, near_plane=0.5, far_plane=2.5)
        seen = (meta["radii"][0] > 0).all(-1)
        assert bool(((depths > 0.5) & (depths <= 2.5))[seen].all())
        assert torch.allclose(meta["depths"][0][seen], depths[seen])
        left = {name: given[name][seen] for name in ("means", "quats", "scales", "opacities", "colors")}
        alone = drgs.rasterization(**{**given, **left}, **options, global_z_order=by_z, near_plane=0.0)[1]
        assert torch.allclose(alpha, alone, atol=1e-6)
        assert alpha.any()
        assert bool((z[seen] < 0).any()) is not by_z


def test_a_hit_counts_down_to_the_least_opacity():
    """gsplat 1.6's kernels have no other cut: what is 3.2 standard deviations off a ray counts if it is opaque."""
    given = {
        "means": torch.tensor([[0.0, 0.0, 4.0]], dtype=torch.float64),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        "scales": torch.full((1, 3), 0.2, dtype=torch.float64),
        "colors": torch.ones(1, 1, dtype=torch.float64),
        "viewmats": torch.eye(4, dtype=torch.float64)[None],
        "Ks": torch.tensor([[[100.0, 0.0, 32.5], [0.0, 100.0, 0.5], [0.0, 0.0, 1.0]]], dtype=torch.float64),
        "width": 65,
        "height": 1,
    }
    x = (torch.arange(65, dtype=torch.float64) - 32) / 100
    rho = 20 * x / (1 + x * x).sqrt()
    for opacity in (1.0, 0.5):
        response = opacity * torch.exp(-0.5 * rho**2)
        expected = torch.where(response < 1 / 255, 0.0, response.clamp(max=0.99))
        opacities = torch.tensor([opacity], dtype=torch.float64)
        alpha = drgs.rasterization(**given, opacities=opacities, with_ut=True, with_eval3d=True)[1][0, 0, :, 0]
        assert float((alpha - expected).abs().max()) < 1e-5
        assert float(rho[alpha > 0].max()) == pytest.approx(3.2 if opacity == 1 else 3.0, abs=0.15)


def test_what_boxes_leave_out_of_a_large_near_gaussian():
    """Beside the image by more than a tenth of it: gsplat does not draw it, rays see it in every pixel."""
    given = {
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "opacities": torch.tensor([0.9]),
        "colors": torch.ones(1, 1),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]]]),
        "width": 48,
        "height": 32,
        "with_eval3d": True,
    }
    aside, ahead = torch.tensor([[0.6, 0.0, 0.6]]), torch.tensor([[0.0, 0.0, 0.6]])
    whole, boxed = (
        drgs.rasterization(aside, scales=torch.full((1, 3), 0.3), with_ut=ut, **given)[1] for ut in (False, True)
    )
    assert bool((whole > 1 / 255).all())
    assert not boxed.any()
    whole, boxed = (
        drgs.rasterization(ahead, scales=torch.full((1, 3), 0.02), with_ut=ut, **given)[1] for ut in (False, True)
    )
    assert torch.equal(whole, boxed)
