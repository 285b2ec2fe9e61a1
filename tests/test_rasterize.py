"""`drgs.rasterization` is `gsplat.rasterization`: held against gsplat's own torch code over shapes and modes."""

import importlib.util
import inspect
import math

import numpy as np
import pytest
import torch
import torch_rasterizer as tr

import drgs
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians

needs_gsplat = pytest.mark.skipif(
    importlib.util.find_spec("gsplat") is None, reason="gsplat is not installed: pip install gsplat==1.5.3"
)
LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


def arguments(seed=0, n=60, width=48, height=40, channels=None, cameras=1, degree=2):
    """Float64 arguments of a scene on which clamps, dilation and ends of rays show; `channels` instead of SH."""
    scene = tr.random_scene(seed, n=n, width=width, height=height, degree=degree)
    make = torch.Generator().manual_seed(seed + 100)
    poses = []
    for k in range(cameras):
        move = torch.eye(4, dtype=torch.float64)
        move[:3, 3] = 0.2 * k * torch.tensor([1.0, -0.5, 0.7], dtype=torch.float64)
        poses.append(move @ scene["viewmat"])
    colors = scene["sh"] if channels is None else torch.rand(n, channels, generator=make, dtype=torch.float64)
    width_out = 3 if channels is None else channels
    return {
        "means": scene["means"],
        "quats": scene["quats"],
        "scales": scene["log_scales"].exp(),
        "opacities": torch.sigmoid(scene["logit_opacities"]),
        "colors": colors,
        "viewmats": torch.stack(poses),
        "Ks": scene["K"].expand(cameras, 3, 3).clone(),
        "width": width,
        "height": height,
        "backgrounds": torch.rand(cameras, width_out, generator=make, dtype=torch.float64),
        "sh_degree": degree if channels is None else None,
    }


def drawn(call, given, cotangent=None, **options):
    """Image, alpha and gradients by name, of <u, image> + <v, alpha>."""
    leaves = {k: given[k].clone().requires_grad_() for k in LEAVES if given.get(k) is not None}
    image, alpha, meta = call(**{**given, **leaves}, packed=False, **options)
    if cotangent is None:
        make = torch.Generator().manual_seed(5)
        cotangent = [torch.randint(0, 2, x.shape, generator=make).double() * 2 - 1 for x in (image, alpha)]
    loss = sum((u * x.double()).sum() for u, x in zip(cotangent, (image, alpha), strict=True))
    found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    return image.detach(), alpha.detach(), dict(zip(leaves, found, strict=True)), meta


def along_motions(gradient, poses):
    """(C, 6) derivative along rotations and translations of the cameras: what else a 4x4 matrix can do is no motion."""
    generators = torch.zeros(6, 4, 4, dtype=torch.float64)
    for k, (i, j) in enumerate([(1, 2), (2, 0), (0, 1)]):
        generators[k, i, j], generators[k, j, i] = -1, 1
        generators[3 + k, k, 3] = 1
    return torch.einsum("cij,kil,clj->ck", gradient.double(), generators, poses)


def agree(given, ours, theirs, image=2e-5, gradient=2e-4):
    """Images within float32's rounding, every gradient within it of its norm."""
    poses = given["viewmats"]
    assert ours[0].shape == theirs[0].shape
    assert ours[1].shape == theirs[1].shape
    scale = max(1.0, float(theirs[0].abs().max()))
    assert float((ours[0] - theirs[0]).abs().max()) < image * scale
    assert float((ours[1] - theirs[1]).abs().max()) < image
    for name, expected in theirs[2].items():
        got = ours[2][name]
        if name == "viewmats":
            got, expected = along_motions(got, poses), along_motions(expected, poses)
        if expected is None or not expected.any():
            assert got is None or not got.any(), name
            continue
        error = float((got.double() - expected).norm() / expected.norm())
        assert error < gradient, (name, error)


@pytest.mark.every(4)
@needs_gsplat
@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_every_mode_is_gsplats(mode, rasterize_mode):
    """Image, alpha and the gradients of all arguments, poses and backgrounds included."""
    from examples import gsplat_torch

    given, options = arguments(cameras=2), {"render_mode": mode, "rasterize_mode": rasterize_mode}
    if "RGB" not in mode:
        given["backgrounds"] = None
    agree(given, drawn(drgs.rasterization, given, **options), drawn(gsplat_torch.rasterization, given, **options))


@needs_gsplat
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 32, 128])
def test_colors_of_any_width_are_gsplats(channels):
    """Plain colors (N, D): the first three travel as color, the others as features; negative ones are not clamped."""
    from examples import gsplat_torch

    given = arguments(seed=1, channels=channels)
    given["colors"] = given["colors"] - 0.3
    given["colors"][::5] = 0.0
    agree(given, drawn(drgs.rasterization, given), drawn(gsplat_torch.rasterization, given))


@needs_gsplat
def test_colors_by_camera_and_fewer_degrees_are_gsplats():
    """(C, N, K, 3) coefficients, of which only the first degrees are asked for; another dilation and near plane."""
    from examples import gsplat_torch

    given = arguments(seed=2, cameras=2)
    make = torch.Generator().manual_seed(0)
    given["colors"] = given["colors"] + 0.1 * torch.randn(2, *given["colors"].shape, generator=make).double()
    options = {"eps2d": 0.1, "near_plane": 1.7, "far_plane": 4.0}
    given["sh_degree"] = 1
    agree(given, drawn(drgs.rasterization, given, **options), drawn(gsplat_torch.rasterization, given, **options))


def in_front(lead, per_camera, degree, n=40, cameras=3, width=30, height=20):
    """Float64 arguments as gsplat's own test of `rasterization` draws them, smaller: a unit cube before three cameras.

    The cube begins at the camera, and standard deviations are up to its size: Gaussians cover the image, some are cut
    by the near plane, and transmittance ends early.
    """
    make = torch.Generator().manual_seed(42)
    uniform = lambda *shape: torch.rand(*lead, *shape, generator=make, dtype=torch.float64)  # noqa: E731
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float64)
    shown = (cameras, n) if per_camera else (n,)
    return {
        "means": uniform(n, 3),
        "quats": torch.randn(*lead, n, 4, generator=make, dtype=torch.float64),
        "scales": uniform(n, 3),
        "opacities": uniform(n),
        "colors": uniform(*shown, 3) if degree is None else uniform(*shown, (degree + 1) ** 2, 3),
        "viewmats": torch.eye(4, dtype=torch.float64).expand(*lead, cameras, 4, 4),
        "Ks": K.expand(*lead, cameras, 3, 3),
        "width": width,
        "height": height,
        "sh_degree": degree,
    }


@pytest.mark.every(4)
@needs_gsplat
@pytest.mark.parametrize("per_camera", [True, False])
@pytest.mark.parametrize("degree", [None, 3])
@pytest.mark.parametrize("lead", [(), (2,), (1, 2)])
def test_the_table_of_gsplats_own_test(lead, degree, per_camera):
    """Colors by camera or not, plain or SH, leading axes, every mode, packed or not: their shapes and numbers.

    Within their test's own tolerance of 1e-4, which is float32's; `packed` changes not a bit.
    """
    from examples import gsplat_torch

    given = in_front(lead, per_camera, degree)
    for mode, channels in (("RGB", 3), ("RGB+D", 4), ("D", 1)):
        image, alpha, _ = drgs.rasterization(**given, render_mode=mode, packed=True)
        assert tuple(image.shape) == (*lead, 3, 20, 30, channels)
        theirs, their_alpha, _ = gsplat_torch.rasterization(**given, render_mode=mode)
        torch.testing.assert_close(image, theirs, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(alpha, their_alpha, rtol=1e-4, atol=1e-4)
    assert torch.equal(image, drgs.rasterization(**given, render_mode=mode, packed=False)[0])
    assert 0.05 < float(alpha.mean()) < 1


@pytest.mark.core
@needs_gsplat
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_degree_is_gsplats(degree):
    """Of 16 coefficients those of the degree count, colors below 0 are clamped: image and gradients."""
    from examples import gsplat_torch

    given = arguments(seed=7, degree=3, n=40, width=30, height=24)
    given["sh_degree"] = degree
    agree(given, drawn(drgs.rasterization, given), drawn(gsplat_torch.rasterization, given))


NAMES = [  # of gsplat 1.6's signature, in its order
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "viewmats",
    "Ks",
    "width",
    "height",
    "near_plane",
    "far_plane",
    "radius_clip",
    "eps2d",
    "sh_degree",
    "packed",
    "tile_size",
    "backgrounds",
    "render_mode",
    "sparse_grad",
    "absgrad",
    "rasterize_mode",
    "distributed",
    "camera_model",
    "segmented",
    "covars",
    "with_ut",
    "with_eval3d",
    "macro_tile",
    "return_normals",
    "global_z_order",
    "rays",
    "radial_coeffs",
    "tangential_coeffs",
    "thin_prism_coeffs",
    "ftheta_coeffs",
    "lidar_coeffs",
    "external_distortion_coeffs",
    "rolling_shutter",
    "viewmats_rs",
    "ut_params",
    "extra_signals",
    "extra_signals_sh_degree",
    "renderer_config",
]


def test_signature_is_gsplats():
    """The names of 1.6 in their order, behind them what 1.5.3 had besides, and `preset`."""
    ours = inspect.signature(drgs.rasterization).parameters
    assert [*NAMES, "channel_chunk", "preset"] == list(ours)
    theirs = inspect.signature(pytest.importorskip("gsplat").rasterization).parameters
    for name, parameter in theirs.items():
        # The one is a member of an enumeration that only they have, the other is 16 or 8 in 1.6.
        if name not in ("rolling_shutter", "tile_size"):
            assert ours[name].default == parameter.default, name


def test_leading_axes_are_batches():
    """(2, N, ...) with (2, C, ...) is each scene by itself."""
    a, b = (arguments(seed=seed, cameras=2) for seed in (3, 4))
    both = {k: torch.stack([a[k], b[k]]) if isinstance(a[k], torch.Tensor) else a[k] for k in a}
    image, alpha, meta = drgs.rasterization(**both)
    assert tuple(image.shape) == (2, 2, 40, 48, 3)
    assert tuple(meta["radii"].shape) == (2, 2, 60, 2)
    assert (meta["n_batches"], meta["n_cameras"]) == (2, 2)
    for k, given in enumerate((a, b)):
        alone, alpha_alone, _ = drgs.rasterization(**given)
        torch.testing.assert_close(image[k], alone, rtol=0, atol=1e-6)
        torch.testing.assert_close(alpha[k], alpha_alone, rtol=0, atol=1e-6)


@needs_gsplat
def test_meta_is_gsplats():
    """Projected means, depths and conics of what is drawn; radii are gsplat's CUDA code's, tighter for faint ones."""
    from examples import gsplat_torch

    given = arguments(cameras=2)
    *_, ours = drgs.rasterization(**given)
    *_, theirs = gsplat_torch.rasterization(**given)
    seen = (ours["radii"] > 0).all(-1)
    assert 0.3 < seen.float().mean() < 1
    assert bool((theirs["radii"] > 0).all(-1)[seen].all())
    assert bool((ours["radii"] <= theirs["radii"])[seen].all())
    for name in ("means2d", "depths", "conics"):
        torch.testing.assert_close(ours[name][seen], theirs[name][seen], rtol=1e-6, atol=1e-6)


def test_far_plane_and_radius_clip_leave_gaussians_out():
    """As if they were not there; both report a radius of 0."""
    given = arguments(seed=5)
    image, _, meta = drgs.rasterization(**given, far_plane=3.0)
    keep = (meta["radii"][0] > 0).any(-1)
    assert 0 < int(keep.sum()) < 60
    less = {k: given[k][keep] for k in ("means", "quats", "scales", "opacities", "colors")}
    torch.testing.assert_close(image, drgs.rasterization(**{**given, **less})[0], rtol=0, atol=1e-6)
    _, _, meta = drgs.rasterization(**given, radius_clip=4.0)
    radii = meta["radii"][0]
    assert bool(((radii == 0).all(-1) | (radii > 4).any(-1)).all())


def test_ends_of_the_ranges_have_finite_gradients():
    """Opacity of 0 and 1, scale of 0, colors of 0: logarithms and logits of them do not exist, derivatives do."""
    given = arguments(channels=3)
    given["opacities"][:4] = torch.tensor([0.0, 1.0, 1.0, 0.0], dtype=torch.float64)
    given["scales"][4:6] = 0.0
    given["colors"][:] = 0.0
    _, _, gradients, _ = drawn(drgs.rasterization, given)
    for name, x in gradients.items():
        assert bool(torch.isfinite(x).all()), name
    assert bool(gradients["colors"].abs().sum(1).gt(0).any())


@pytest.mark.parametrize("lead", [(), (2,)])
@pytest.mark.parametrize("channels", [None, 5])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_no_gaussians_are_the_background(mode, channels, lead):
    """As a scene whose last Gaussian was pruned: the shapes of any other, alpha 0, gradients without entries."""
    given = arguments(n=1, width=8, height=6, channels=channels, cameras=3)
    for name in LEAVES:
        x = given[name] if name in ("viewmats", "backgrounds") else given[name][:0]
        given[name] = x.expand(*lead, *x.shape)
    given["Ks"] = given["Ks"].expand(*lead, 3, 3, 3)
    image, alpha, slopes, meta = drawn(drgs.rasterization, given, render_mode=mode)
    behind = given["backgrounds"][..., None, None, :].expand(*lead, 3, 6, 8, channels or 3)
    torch.testing.assert_close(image[..., : channels or 3], behind, rtol=0, atol=0)
    assert image.shape[-1] == (channels or 3) + ("ED" in mode)
    assert not image[..., channels or 3 :].any()
    assert alpha.shape == (*lead, 3, 6, 8, 1)
    assert not alpha.any()
    assert {name: x.shape for name, x in slopes.items()} == {name: given[name].shape for name in LEAVES}
    assert bool((slopes["backgrounds"] != 0).any())
    assert meta["radii"].shape == (*lead, 3, 0, 2)


def test_float32_in_float32_out_and_any_preset():
    """`exact` through the same call is `drgs.render`."""
    given = {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in arguments().items()}
    image, alpha, _ = drgs.rasterization(**given, preset="exact", render_mode="RGB+ED")
    assert image.dtype == alpha.dtype == torch.float32
    g = Gaussians.from_arrays(*(given[k] for k in ("means", "quats", "scales", "opacities", "colors")))
    camera = Camera(K=given["Ks"][0].numpy(), w2c=given["viewmats"][0].numpy(), width=48, height=40)
    background = tuple(given["backgrounds"][0].tolist())
    out = drgs.render(g, camera, drgs.RenderSettings.preset("exact", background=background))
    torch.testing.assert_close(image[0, ..., :3], out.rgb, rtol=0, atol=2e-6)
    z = camera.pixel_directions() @ given["viewmats"][0, 2, :3].double().numpy()
    np.testing.assert_allclose(image[0, ..., 3], out.depth * z, rtol=1e-4, atol=1e-4)


def test_forward_mode_is_the_transpose():
    """<u, J v> = <J^T u, v> through torch.func.jvp, for all tensors at once."""
    given = arguments(n=20, channels=4)
    names = ("means", "scales", "opacities", "colors", "viewmats")
    make = torch.Generator().manual_seed(2)
    tangents = [torch.randn(given[k].shape, generator=make, dtype=torch.float64) for k in names]
    tangents[2] *= 0.05
    turn = torch.zeros(4, 4, dtype=torch.float64)
    turn[0, 1], turn[1, 0], turn[2, 3] = -0.3, 0.3, 0.5
    tangents[4] = turn @ given["viewmats"]

    def draw(*tensors):
        return drgs.rasterization(**{**given, **dict(zip(names, tensors, strict=True))})[0]

    image, moved = torch.func.jvp(draw, tuple(given[k] for k in names), tuple(tangents))
    u = torch.randn(image.shape, generator=make, dtype=torch.float64)
    leaves = [given[k].clone().requires_grad_() for k in names]
    found = torch.autograd.grad((u * draw(*leaves)).sum(), leaves)
    left = float((u * moved).sum())
    right = sum(float((g * v).sum()) for g, v in zip(found, tangents, strict=True))
    assert left == pytest.approx(right, rel=1e-4)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"camera_model": "fisheye"}, ValueError, "camera models other than pinhole must come with with_eval3d=True"),
        ({"camera_model": "ortho"}, NotImplementedError, "camera_model='ortho' is not supported; pass its rays"),
        ({"camera_model": "mirror"}, ValueError, "camera_model must be one of pinhole, fisheye, ftheta, got 'mirror'"),
        ({"lidar_coeffs": 1}, NotImplementedError, "lidar_coeffs is not supported; pass its rays as rays="),
        ({"covars": torch.eye(3)}, ValueError, r"covars must be a tensor of shape .*got \(3, 3\)"),
        ({"quats": None}, ValueError, "quats and scales must be tensors where there are no covars"),
        (
            {"with_ut": True},
            NotImplementedError,
            "with_ut without with_eval3d is not supported; .* pass with_eval3d=True",
        ),
        ({"with_ut": True, "preset": "gsplat"}, NotImplementedError, "with_ut without with_eval3d is not supported"),
        ({"viewmats_rs": torch.eye(4)}, ValueError, r"viewmats_rs must have shape \(1, 4, 4\), got \(4, 4\)"),
        ({"colors": torch.zeros(60, 9, 5)}, ValueError, r"backgrounds must have shape \(1, 5\), got \(1, 3\)"),
        ({"render_mode": "XYZ"}, ValueError, "render_mode must be one of RGB, D, ED, RGB\\+D, .*, got 'XYZ'"),
        ({"render_mode": "RGB-d"}, ValueError, "render modes with d and Ed must come with with_eval3d=True"),
        ({"return_normals": True}, ValueError, "return_normals must come with with_eval3d=True"),
        ({"rays": torch.zeros(1, 40, 48, 6)}, ValueError, "rays must come with with_eval3d=True"),
        ({"rays": torch.zeros(40, 48, 6), "with_eval3d": True}, ValueError, r"rays must have shape \(1, 40, 48, 6\)"),
        ({"rolling_shutter": "ROLLING_UP"}, ValueError, "rolling_shutter must be one of global, rolling_top"),
        ({"rolling_shutter": "ROLLING_TOP_TO_BOTTOM"}, ValueError, "viewmats_rs must be there for rolling shutters"),
        ({"radial_coeffs": torch.zeros(1, 5), "with_eval3d": True}, ValueError, r"radial_coeffs must have .*\(1, 6"),
        ({"extra_signals": torch.zeros(3, 2)}, ValueError, r"extra_signals must have shape \(\.\.\., N, E\)"),
        ({"preset": "exact", "rasterize_mode": "antialiased"}, NotImplementedError, "use preset='gsplat'"),
        ({"viewmats": torch.eye(4)}, ValueError, r"viewmats must have shape \(\.\.\., C, 4, 4\).*viewmat\[None\]"),
        ({"quats": torch.ones(60, 3)}, ValueError, r"quats must have shape \(60, 4\).*got \(60, 3\)"),
        ({"sh_degree": 3}, ValueError, "colors must have at least 16 coefficients for sh_degree 3, got 9"),
        ({"near_plane": 10, "far_plane": 1}, ValueError, "near_plane must be less than far_plane, got 10 and 1; swap"),
        ({"far_plane": math.nan}, ValueError, "near_plane must be less than far_plane, got 0.01 and nan"),
        ({"sh_degree": 4}, ValueError, "sh_degree must be None or 0 to 3, got 4"),
        ({"opacities": torch.full((60,), 1.5)}, ValueError, r"opacities must be in \[0, 1\].*got 1.5 at index \[0\]"),
        ({"scales": torch.full((60, 3), -1.0)}, ValueError, r"scales must be in \[0, inf\).*got -1 at index \[0, 0\]"),
        ({"means": np.zeros((60, 3))}, ValueError, "means must be a torch tensor, got ndarray"),
        ({"backgrounds": torch.zeros(3)}, ValueError, r"backgrounds must have shape \(1, 3\)"),
        (
            {"colors": torch.zeros(60, 0), "sh_degree": None, "backgrounds": None},
            ValueError,
            r"colors must have at least one channel, got \(60, 0\)",
        ),
        (
            {name: torch.zeros(0, *shape) for name, shape in (("viewmats", (4, 4)), ("Ks", (3, 3)))}
            | {"backgrounds": None},
            ValueError,
            r"viewmats must hold at least one camera, got shape \(0, 4, 4\); skip",
        ),
        (
            {name: x.expand(0, *x.shape) for name, x in arguments().items() if isinstance(x, torch.Tensor)},
            ValueError,
            r"viewmats must hold at least one camera, got shape \(0, 1, 4, 4\); skip",
        ),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(change, error, message):
    with pytest.raises(error, match=message) as raised:
        drgs.rasterization(**{**arguments(), **change})
    assert "\n" not in str(raised.value)
