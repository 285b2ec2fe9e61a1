"""`drgs.rasterization` along rays, as gsplat 1.6 does with eval3d: every argument, against the float64 oracle.

The oracle gives the weight of every Gaussian at every pixel, with a graph; colors, depths, normals and signals are
blended with them here, from their definitions.
"""

import types

import pytest
import torch
from test_rasterize import along_motions, arguments

import drgs
from drgs import reference
from drgs.cameras import Camera
from drgs.cameras.shutters import SHUTTERS
from drgs.ellipsoids import Gaussians, semi_axes
from drgs.settings import RenderSettings
from drgs.splats.covariances import factors

RADIAL = (-0.2, 0.05, 0.01, 0.02, 0.0, 0.0)
TANGENTIAL = (0.003, -0.002)
FISHEYE = (0.05, -0.02, 0.01, -0.003)
TABLE = {
    "pinhole": {},
    "distance": {"global_z_order": False},
    "opencv": {"radial_coeffs": RADIAL, "tangential_coeffs": TANGENTIAL},
    "radial": {"radial_coeffs": RADIAL},
    "fisheye": {"camera_model": "fisheye", "radial_coeffs": FISHEYE},
    "fisheye of no coefficients": {"camera_model": "fisheye"},
    **{name: {"rolling_shutter": name.upper()} for name in SHUTTERS[1:]},
    "opencv rolling": {"radial_coeffs": RADIAL, "rolling_shutter": "ROLLING_TOP_TO_BOTTOM"},
    "rays": {"rays": True},
}
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED", "d", "Ed", "RGB-d", "RGB-Ed")


def scene(seed=0, n=40, **options):
    """Arguments of a small scene whose Gaussians are not all in front of everything."""
    return arguments(seed=seed, n=n, width=26, height=22, **options)


def options_of(kind, given, seed=7):
    """Arguments of a row of the table, tensors for each camera; poses and rays are leaves."""
    count = len(given["viewmats"])
    made = dict(TABLE[kind])
    for name in ("radial_coeffs", "tangential_coeffs"):
        if name in made:
            made[name] = torch.tensor(made[name], dtype=torch.float64).expand(count, -1)
    make = torch.Generator().manual_seed(seed)
    if "rolling_shutter" in made:
        turn = 0.05 * torch.randn(3, generator=make, dtype=torch.float64)
        zero = turn.new_zeros(())
        x, y, z = turn
        rotation = torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3))
        move = torch.eye(4, dtype=torch.float64)
        move[:3, :3] = rotation
        move[:3, 3] = 0.1 * torch.randn(3, generator=make, dtype=torch.float64)
        made["viewmats_rs"] = move @ given["viewmats"]
    if "rays" in made:
        rays = []
        for camera in cameras_of(given, {}):
            shift = 0.02 * torch.randn(camera.height, camera.width, 3, generator=make, dtype=torch.float64)
            size = 0.5 + torch.rand(camera.height, camera.width, 1, generator=make, dtype=torch.float64)
            o = torch.from_numpy(camera.pixel_origins().copy()) + shift
            rays.append(torch.cat([o, size * torch.from_numpy(camera.pixel_directions())], -1))
        made["rays"] = torch.stack(rays)
    return made


def cameras_of(given, options):
    """The cameras that the arguments mean, from the conventions of gsplat's documentation."""
    made = []
    for c in range(len(given["viewmats"])):
        more = {}
        if options.get("camera_model") == "fisheye":
            k = options.get("radial_coeffs")
            more = {"model": "opencv_fisheye", "distortion": (0.0,) * 4 if k is None else tuple(k[c].tolist())}
        elif "radial_coeffs" in options:
            k = options["radial_coeffs"][c].tolist()
            p = options["tangential_coeffs"][c].tolist() if "tangential_coeffs" in options else [0.0, 0.0]
            more = {"model": "opencv", "distortion": (k[0], k[1], p[0], p[1], *k[2:])}
        if "rolling_shutter" in options:
            more |= {"shutter": options["rolling_shutter"].lower(), "w2c_end": options["viewmats_rs"][c]}
        K = given["Ks"][c].detach().numpy()
        made.append(Camera(K=K, w2c=given["viewmats"][c], width=given["width"], height=given["height"], **more))
    return made


def middle_pose(camera):
    """(4, 4) pose of the middle of the exposure, differentiable: half of the turn, the mean translation."""
    start = camera.w2c
    if not camera.is_rolling:
        return start
    end = camera.w2c_end
    turn = end[:3, :3] @ start[:3, :3].T
    sine = 0.5 * (turn - turn.T)
    size = (0.5 * sine.square().sum()).sqrt()
    half = torch.linalg.matrix_exp(0.5 * torch.atan2(size, 0.5 * (turn.trace() - 1)) / size * sine)
    upper = torch.cat([half @ start[:3, :3], 0.5 * (start[:3, 3:] + end[:3, 3:])], 1)
    return torch.cat([upper, upper.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def centers(camera):
    poses = [camera.w2c] + ([camera.w2c_end] if camera.is_rolling else [])
    return sum(-(x[:3, :3].T @ x[:3, 3]) for x in poses) / len(poses)


def truth(given, options, mode, signals=None):
    """Image, alpha, normals, signals of every camera and where they do not hang on a tie, from the oracle's weights."""
    key = "z" if options.get("global_z_order", True) else "distance"
    settings = RenderSettings.preset("3dgut", depth_key=key)
    n = len(given["means"])
    logits = torch.log(given["opacities"]) - torch.log1p(-given["opacities"])
    g = Gaussians(
        given["means"], given["quats"], given["scales"].log(), logits,
        torch.zeros(n, 1, 3, dtype=torch.float64), torch.eye(n, dtype=torch.float64),
    )  # fmt: skip
    found = []
    for c, camera in enumerate(cameras_of(given, options)):
        rays = None
        if "rays" in options:
            o, d = options["rays"][c].split(3, -1)
            rays = o, d / d.norm(dim=-1, keepdim=True)
        out = reference.render(g, camera, settings, rays=rays)
        weights = out.features
        alpha = out.alpha[..., None]
        channels = []
        if mode.startswith("RGB"):
            colors = given["colors"]
            if given["sh_degree"] is not None:
                away = given["means"] - centers(camera)
                basis = reference.sh_basis(away / away.norm(dim=1, keepdim=True), colors.shape[1])
                colors = (torch.einsum("nk,nkd->nd", basis, colors) + 0.5).clamp_min(0)
            channels.append(weights @ colors + (1 - alpha) * given["backgrounds"][c])
        depth = None
        if "D" in mode:
            pose = middle_pose(camera)
            seen = given["means"] @ pose[:3, :3].T + pose[:3, 3]
            depth = (weights @ (seen[:, 2] if key == "z" else seen.norm(dim=1)))[..., None]
        elif "d" in mode:
            depth = out.depth[..., None] * alpha.clamp_min(1e-10)
        if depth is not None:
            channels.append(depth / alpha.clamp_min(1e-10) if "E" in mode else depth)
        axes = semi_axes(given["quats"], torch.ones_like(given["scales"]))[:, :, 2]
        d = torch.from_numpy(camera.pixel_directions()) if rays is None else rays[1]
        sign = torch.where(d.detach() @ axes.detach().T > 0, -1.0, 1.0).double()
        normals = (weights * sign) @ axes
        shown = None if signals is None else weights @ signals
        found.append((torch.cat(channels, -1), alpha, normals, shown, ~out.ambiguous))
    return [None if x[0] is None else torch.stack(x) for x in zip(*found, strict=True)]


def compared(given, options, mode, signals=None, normals=True):
    """Largest error of each image, relative error of each gradient, and the share of pixels that were looked at."""
    names = ["means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"]
    tensors = {name: given[name] for name in names} | {
        name: options[name] for name in ("viewmats_rs", "rays") if name in options
    }
    if signals is not None:
        tensors["signals"] = signals

    def run(ours):
        leaves = {name: x.clone().requires_grad_() for name, x in tensors.items()}
        held = {**given, **{k: leaves[k] for k in names}}
        more = {**options, **{k: leaves[k] for k in ("viewmats_rs", "rays") if k in options}}
        extra = leaves.get("signals")
        if not ours:
            return leaves, truth(held, more, mode, extra)
        image, alpha, meta = drgs.rasterization(
            **held, **more, render_mode=mode, with_ut=True, with_eval3d=True, return_normals=normals,
            extra_signals=extra,
        )  # fmt: skip
        return leaves, [image, alpha, meta.get("normals"), meta.get("render_extra_signals")]

    expected_leaves, (*expected, good) = run(False)
    leaves, got = run(True)
    make = torch.Generator().manual_seed(11)
    errors, losses = {}, [0.0, 0.0]
    for name, a, b in zip(("image", "alpha", "normals", "signals"), got, expected, strict=True):
        if a is None:
            continue
        assert a.shape == b.shape, name
        mask = good[..., None]
        size = max(1.0, float(b.detach().abs().max()))
        errors[name] = float(((a - b) * mask).detach().abs().max()) / size
        u = torch.randn(b.shape, generator=make, dtype=torch.float64) * mask
        losses = [total + (u * x).sum() for total, x in zip(losses, (a, b), strict=True)]
    slopes = {}
    found = torch.autograd.grad(losses[0], list(leaves.values()), allow_unused=True)
    wanted = torch.autograd.grad(losses[1], list(expected_leaves.values()), allow_unused=True)
    for name, a, b in zip(leaves, found, wanted, strict=True):
        if b is None or not b.any():
            assert a is None or float(a.abs().max()) < 1e-6, name
            continue
        if name.startswith("viewmats"):
            a, b = (along_motions(x, tensors[name]) for x in (a, b))
        slopes[name] = float((a - b).norm() / b.norm())
    return errors, slopes, float(good.double().mean())


@pytest.mark.every(7)
@pytest.mark.parametrize("kind", TABLE)
def test_every_camera_is_the_oracles(kind):
    """Images with hit distances, normals and signals within 1e-5 and every gradient within 1e-4 of the oracle."""
    given = scene(cameras=2)
    options = options_of(kind, given)
    signals = torch.randn(len(given["means"]), 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    errors, slopes, share = compared(given, options, "RGB-d", signals)
    assert share > 0.9
    assert max(errors.values()) < 1e-5, errors
    assert max(slopes.values()) < 1e-4, slopes
    expected = {"means", "quats", "scales", "opacities", "colors", "backgrounds", "signals"}
    expected |= {name for name in ("viewmats_rs", "rays") if name in options}
    assert expected <= set(slopes)


@pytest.mark.every(4)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", ["pinhole", "rolling_top_to_bottom", "distance"])
def test_every_mode_is_the_oracles(mode, kind):
    """Depths of the Gaussians (D) and along rays (d), summed and over alpha, alone and behind colors."""
    given = scene(seed=1)
    errors, slopes, _ = compared(given, options_of(kind, given), mode, normals=False)
    assert max(errors.values()) < 1e-5, errors
    assert max(slopes.values()) < 1e-4, slopes


def test_no_ray_shows_the_background():
    """A direction of 0 is no ray, and the length of a direction does not matter."""
    given = scene()
    camera = cameras_of(given, {})[0]
    rays = torch.cat([torch.from_numpy(x) for x in (camera.pixel_origins().copy(), camera.pixel_directions())], -1)[
        None
    ]
    plain, alpha, _ = drgs.rasterization(**given, with_eval3d=True)
    rays[..., 3:] *= 3.0
    image, same, _ = drgs.rasterization(**given, with_eval3d=True, rays=rays)
    torch.testing.assert_close(image, plain, rtol=0, atol=2e-6)
    torch.testing.assert_close(same, alpha, rtol=0, atol=2e-6)
    rays[0, 3, 4, 3:] = 0.0
    image, alpha, _ = drgs.rasterization(**given, with_eval3d=True, rays=rays)
    assert float(alpha[0, 3, 4]) == 0
    torch.testing.assert_close(image[0, 3, 4], given["backgrounds"][0])


@pytest.mark.parametrize("preset", ["exact", "fast"])
def test_depth_of_rays_that_are_not_the_cameras(preset):
    """Along parallel rays from the camera's plane the distance is z; where nothing is, both are 0."""
    given = scene()
    pose = given["viewmats"][0]
    grid = torch.stack(torch.meshgrid(torch.arange(26), torch.arange(22), indexing="xy"), -1).double()
    local = torch.cat([(grid - torch.tensor([13.0, 11.0])) / 3, torch.zeros(22, 26, 1, dtype=torch.float64)], -1)
    center = -pose[:3, 3] @ pose[:3, :3]
    ahead = pose[2, :3].expand(22, 26, 3)
    rays = torch.cat([local @ pose[:3, :3] + center, 2 * ahead], -1)[None]
    draw = lambda mode: drgs.rasterization(**given, rays=rays, preset=preset, render_mode=mode)  # noqa: E731
    along, alpha, _ = draw("Ed")
    assert float(alpha.max()) > 0.1
    assert bool((alpha == 0).any())
    torch.testing.assert_close(draw("ED")[0], along, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(draw("D")[0], draw("d")[0], rtol=1e-5, atol=1e-5)


def test_the_order_of_a_named_preset():
    """`gsplat` by its name sorts as the default does."""
    given = scene()
    plain = drgs.rasterization(**given, global_z_order=False)[0]
    assert torch.equal(drgs.rasterization(**given, global_z_order=False, preset="gsplat")[0], plain)
    assert not torch.equal(drgs.rasterization(**given, preset="gsplat")[0], plain)


def test_arguments_of_speed_and_memory_change_nothing():
    """Tile size, renderer, packing and sorting: gsplat's business. So are boxes, but for what lies at their edges."""
    given = scene()
    plain = drgs.rasterization(**given, with_ut=True, with_eval3d=True)[0]
    whole = drgs.rasterization(**given, with_eval3d=True)[0]
    torch.testing.assert_close(plain, whole, rtol=0, atol=1 / 255)
    kernel = types.SimpleNamespace(name="RendererConfig_ParallelBatch")
    free = {"tile_size": 8, "renderer_config": kernel, "ut_params": kernel, "packed": False, "segmented": True}
    same = drgs.rasterization(**given, with_ut=True, with_eval3d=True, channel_chunk=1, eps2d=0.1, **free)[0]
    assert torch.equal(plain, same)
    none = {"thin_prism_coeffs": torch.zeros(1, 4), "radial_coeffs": torch.zeros(1, 6)}
    member = types.SimpleNamespace(name="GLOBAL")
    seen = drgs.rasterization(**given, with_ut=True, with_eval3d=True, rolling_shutter=member, **none)[0]
    torch.testing.assert_close(plain, seen, rtol=1e-5, atol=1e-5)  # a lens without distortion
    other = types.SimpleNamespace(alpha=1.0, beta=2.0, kappa=0.0)
    with pytest.raises(NotImplementedError, match="ut_params must have gsplat's default alpha=0.1, got 1"):
        drgs.rasterization(**given, with_ut=True, with_eval3d=True, ut_params=other)


@pytest.mark.parametrize("lead", [(), (2,), (1, 2)])
@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_shapes(lead, model):
    """Leading axes and every extra output, SH that all batches share, of any number of channels."""
    given = scene(n=12, cameras=3, degree=1)
    for name in ("means", "quats", "scales", "opacities", "viewmats", "Ks"):
        given[name] = given[name].expand(*lead, *given[name].shape)
    make = torch.Generator().manual_seed(0)
    given["colors"] = torch.randn(12, 4, 5, generator=make, dtype=torch.float64)
    given["backgrounds"] = None
    signals = torch.randn(12, 16, 7, generator=make, dtype=torch.float64)
    options = {"camera_model": model, "extra_signals": signals, "extra_signals_sh_degree": 3, "return_normals": True}
    image, alpha, meta = drgs.rasterization(**given, **options, with_eval3d=True, render_mode="RGB-Ed")
    assert image.shape == (*lead, 3, 22, 26, 6)
    assert alpha.shape == (*lead, 3, 22, 26, 1)
    assert meta["normals"].shape == (*lead, 3, 22, 26, 3)
    assert meta["render_extra_signals"].shape == (*lead, 3, 22, 26, 7)
    shapes = {"radii": (2,), "means2d": (2,), "depths": (), "conics": (3,), "opacities": ()}
    for name, tail in shapes.items():
        assert meta[name].shape == (*lead, 3, 12, *tail), name
        assert bool(torch.isfinite(meta[name]).all()), name
    first = lambda x: x[(0,) * len(lead)] if lead else x  # noqa: E731
    alone = {
        k: first(x) if k in ("means", "quats", "scales", "opacities", "viewmats", "Ks") else x for k, x in given.items()
    }
    again = drgs.rasterization(**alone, **options, with_eval3d=True, render_mode="RGB-Ed")
    torch.testing.assert_close(first(image), again[0], rtol=0, atol=1e-6)
    depth = drgs.rasterization(**{**alone, "colors": None}, camera_model=model, with_eval3d=True, render_mode="Ed")[0]
    torch.testing.assert_close(first(image)[..., 5:], depth, rtol=1e-5, atol=1e-5)


def test_harmonics_of_any_width_are_those_of_three_channels():
    """Five channels of SH are three and two more; signals of SH are not clamped."""
    given = scene(degree=2)
    given["backgrounds"] = None
    make = torch.Generator().manual_seed(0)
    wide = torch.cat([given["colors"], torch.randn(40, 9, 2, generator=make, dtype=torch.float64)], 2)
    plain = drgs.rasterization(**given)[0]
    image = drgs.rasterization(**{**given, "colors": wide})[0]
    torch.testing.assert_close(image[..., :3], plain, rtol=0, atol=2e-6)
    lifted = given["colors"].clone()
    lifted[:, 0] += 40.0  # far above the clamp
    high, alpha, meta = drgs.rasterization(
        **{**given, "colors": lifted}, extra_signals=given["colors"], extra_signals_sh_degree=2
    )
    shift = 40.0 / (4 * torch.pi) ** 0.5
    torch.testing.assert_close(meta["render_extra_signals"], high - shift * alpha, rtol=0, atol=1e-4)


def covariances(kind, n, make):
    """(n, 3, 3) whose variances are three, the same twice or three times, or nearly so."""
    axes = torch.linalg.qr(torch.randn(n, 3, 3, generator=make, dtype=torch.float64)).Q
    size = 0.1 * torch.exp(0.4 * torch.randn(n, 1, generator=make, dtype=torch.float64))
    ratio = {"three": (1.0, 1.7, 0.5), "two": (1.0, 1.0, 0.4), "one": (1.0, 1.0, 1.0), "nearly": (1.0, 1.0005, 0.4)}
    scales = size * torch.tensor(ratio[kind], dtype=torch.float64)
    return (axes * scales[:, None].square()) @ axes.transpose(1, 2)


@pytest.mark.parametrize("kind", ["three", "two", "one", "nearly"])
@pytest.mark.parametrize("preset", ["gsplat", "exact"])
def test_derivatives_by_covariances(kind, preset):
    """Against differences of the oracle, in random symmetric directions, also where variances coincide."""
    given = scene(seed=4, n=15)
    make = torch.Generator().manual_seed(1)
    covars = covariances(kind, 15, make)
    del given["quats"], given["scales"], given["backgrounds"]
    camera = cameras_of(given, {})[0]
    settings = RenderSettings.preset(preset)
    logits = torch.log(given["opacities"]) - torch.log1p(-given["opacities"])

    def oracle(C):
        quats, scales, _ = factors("test", C)
        g = Gaussians(given["means"], quats, scales.log(), logits, given["colors"])
        return reference.render(g, camera, settings)

    whole = oracle(covars)
    u = torch.randn(whole.rgb.shape, generator=make, dtype=torch.float64) * ~whole.ambiguous[..., None]
    size = covars.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    h = 1e-5
    directions, differences = [], []
    for _ in range(4):
        D = torch.randn(15, 3, 3, generator=make, dtype=torch.float64)
        D = size * (D + D.transpose(1, 2))
        high, low = oracle(covars + h * D), oracle(covars - h * D)
        u = u * ((high.count == low.count) & (high.count == whole.count))[..., None]
        directions.append(D)
        differences.append((high.rgb - low.rgb) / (2 * h))
    assert float((u != 0).double().mean()) > 0.8
    leaf = covars.clone().requires_grad_()
    image, _, _ = drgs.rasterization(quats=None, scales=None, covars=leaf, preset=preset, **given)
    assert float(((image[0] - whole.rgb) * (u != 0)).abs().max()) < 1e-5
    (found,) = torch.autograd.grad((image[0] * u).sum(), leaf)
    torch.testing.assert_close(found, found.transpose(1, 2))
    got = torch.stack([(found * D).sum() for D in directions])
    expected = torch.stack([(x * u).sum() for x in differences])
    assert float((got - expected).norm() / expected.norm()) < 1e-4


def test_covariances_leave_other_derivatives_as_they_are():
    """Round Gaussians by covariances and by scales: the same image, the same derivatives of everything else."""
    given = scene(n=15)
    given["scales"] = given["scales"][:, :1].expand(-1, 3).clone()
    covars = torch.diag_embed(given["scales"].square())
    names = ("means", "opacities", "colors", "viewmats", "backgrounds")
    found = []
    for shape in ({}, {"quats": None, "scales": None, "covars": covars.requires_grad_()}):
        leaves = {name: given[name].clone().requires_grad_() for name in names}
        image = drgs.rasterization(**{**given, **leaves, **shape}, with_eval3d=True)[0]
        found.append((image, torch.autograd.grad(image.square().sum(), list(leaves.values()))))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=0, atol=1e-5)
    for a, b in zip(found[0][1], found[1][1], strict=True):
        assert float((a - b).norm() / a.norm()) < 1e-4
