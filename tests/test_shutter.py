"""Rolling shutters and a caller's own rays: images, derivatives and lists against the float64 oracle."""

from __future__ import annotations

import dataclasses

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from scenes_random import Oracle, around_camera, camera, compare, gaussians, relative, rotation, weight_of
from test_integrator import check

from drgs import fisher, reference, render, render_jvp
from drgs.cameras import Camera
from drgs.cameras.shutters import SHUTTERS, line_poses, line_times
from drgs.cameras.sizes import cropped
from drgs.settings import RenderSettings
from drgs.tracing import tiles
from drgs.tracing.free_rays import FreeRays

ROLLING = SHUTTERS[1:]
LENSES = {"pinhole": (), "opencv": (-0.2, 0.05, 0.003, -0.002), "opencv_fisheye": (0.05, -0.02, 0.01, -0.003)}
CUTS = {"extent": 3.0, "transmittance_min": 0.01, "alpha_max": 0.9999}


def moved(rng, pose, far=0.15, turn=0.1):
    """A pose that differs by some of the distance to the scene and some radians."""
    change = np.eye(4)
    change[:3, :3] = rotation(turn * rng.normal(size=3))
    change[:3, 3] = far * rng.normal(size=3)
    return change @ pose


def rolling(rng, shutter, model="pinhole", size=(26, 21), wide=1.0, tensors=True, **options):
    """A random camera that moves during its exposure, poses as leaves."""
    cam = camera(rng, size)
    start = cam.w2c.detach().numpy()
    poses = {"w2c": start, "w2c_end": moved(rng, start, **options)}
    if tensors:
        poses = {name: torch.tensor(x).requires_grad_() for name, x in poses.items()}
    K = cam.K.copy()
    K[:2, :2] *= wide
    K[0, 1] = 0.03 * K[0, 0]
    kind = {"model": model, "distortion": LENSES[model], "shutter": shutter}
    return Camera(K=K, width=cam.width, height=cam.height, **poses, **kind)


KINDS = [
    ("rolling_top_to_bottom", "pinhole", {"order": "ray"}),
    ("rolling_top_to_bottom", "opencv_fisheye", CUTS),
    ("rolling_left_to_right", "opencv", {"response": "integral", "alpha_min": 1 / 255, "near": 0.01}),
    ("rolling_bottom_to_top", "pinhole", {"depth_key": "z", "alpha_min": 1 / 255, "stop": "before_eq"}),
    ("rolling_right_to_left", "opencv", {"order": "ray", "sh_direction": "ray"}),
    ("rolling_top_to_bottom", "pinhole", {"order": "ray", "traversal": "bvh"}),
]


@pytest.mark.every(4)
@pytest.mark.parametrize(
    ("shutter", "model", "fields"), KINDS, ids=lambda f: f if isinstance(f, str) else "-".join(map(str, f))
)
def test_images_and_derivatives(rng, shutter, model, fields):
    """Images, adjoint and forward mode, those of both poses among them, within the tolerances of other cameras."""
    settings = RenderSettings(**fields)
    for near in (False, True):
        cam = rolling(rng, shutter, model)
        g = gaussians(rng, 20, 4, 3)
        if near:
            g = around_camera(g, cam)
        oracle = Oracle(g, cam, settings, rng)
        errors = compare(g, cam, settings, oracle)
        check(errors)
        assert "camera_end" in errors.gradient
        assert errors.count <= 1 or settings.response == "integral"
        assert float((~oracle.good).double().mean()) < 0.1


@pytest.mark.parametrize("shutter", ROLLING)
def test_poses_of_lines(rng, shutter):
    """The camera's own rays are those of the oracle; the first line has the first pose, the last one the second."""
    cam = rolling(rng, shutter, tensors=False, turn=0.5)
    g = gaussians(rng, 3, 1)
    settings = RenderSettings()
    whole = reference.render(g, cam, settings)
    rays = torch.from_numpy(cam.pixel_origins().copy()), torch.from_numpy(cam.pixel_directions())
    middle = line_poses(cam.w2c, cam.w2c_end, np.array([0.5]))[0]
    still = dataclasses.replace(cam, w2c=middle, shutter="global", w2c_end=None)
    assert torch.allclose(whole.rgb, reference.render(g, still, settings, rays=rays).rgb, atol=1e-12)
    times = line_times(shutter, cam.width, cam.height)
    by_row = len(times) == cam.height and shutter in ("rolling_top_to_bottom", "rolling_bottom_to_top")
    for k, end in ((0, times[0]), (-1, times[-1])):
        pose = cam.w2c_end if end == 1 else cam.w2c
        center = -pose[:3, :3].T @ pose[:3, 3]
        line = cam.pixel_origins()[k, 0] if by_row else cam.pixel_origins()[0, k]
        assert np.allclose(line, center, atol=1e-12)


def test_a_camera_that_stands_still_has_a_global_shutter(rng):
    """With both poses the same the image, and the sum of both poses' gradients, are those of one pose."""
    cam = rolling(rng, "rolling_top_to_bottom")
    cam = dataclasses.replace(cam, w2c_end=cam.w2c.detach().clone().requires_grad_())
    one = dataclasses.replace(cam, shutter="global", w2c_end=None)
    g = gaussians(rng, 20, 4)
    for preset in ("exact", "fast", "3dgut"):
        settings = RenderSettings.preset(preset)
        images = [render(g, each, settings).rgb for each in (cam, one)]
        assert (images[0] - images[1]).abs().max() < 1e-5
        u = torch.tensor(rng.normal(size=tuple(images[0].shape)))
        both = torch.autograd.grad((images[0] * u).sum(), [cam.w2c, cam.w2c_end])
        (whole,) = torch.autograd.grad((images[1] * u).sum(), [one.w2c])
        assert relative(sum(both), whole) < 1e-4


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-4, 2.0])
def test_derivatives_at_any_turn(rng, turn):
    """Finite and right where the camera does not turn at all, and where it turns by more than a right angle."""
    cam = rolling(rng, "rolling_top_to_bottom", turn=0.0, far=0.1)
    end = cam.w2c.detach().numpy().copy()
    end[:3, :3] = rotation(turn * np.array([0.1, -0.3, 0.95])) @ end[:3, :3]
    cam = dataclasses.replace(cam, w2c_end=torch.tensor(end).requires_grad_())
    g = gaussians(rng, 15, 4)
    settings = RenderSettings(order="ray")
    check(compare(g, cam, settings, Oracle(g, cam, settings, rng)))


def _everywhere(self, guides):
    """Bounds beyond any image."""
    return [x * 0 + sign * 1e9 for sign, x in zip((-1, -1, 1, 1), guides, strict=True)]


@pytest.mark.parametrize("anisotropy", [0.5, 2.5])
@pytest.mark.parametrize("kind", ["shutter", "fisheye shutter", "own rays", "parallel rays", "rays anywhere"])
def test_what_bounds_leave_out_changes_nothing(rng, monkeypatch, kind, anisotropy):
    """Listing a Gaussian only where a ray may meet it gives the same bits as listing it everywhere."""
    monkeypatch.setattr(tiles, "_TEST_TILES_FROM", 0)
    pairs = []
    for spread in (1.0, 8.0):
        fisheye = kind == "fisheye shutter"
        model = "opencv_fisheye" if fisheye else "pinhole"
        cam = rolling(rng, rng.choice(ROLLING), model, (61, 45), 0.6 if fisheye else 1.0, tensors=False, turn=0.3)
        rays = None
        if "rays" in kind:
            o, d = cam.pixel_origins().copy(), cam.pixel_directions()
            if kind == "parallel rays":
                o, d = o - 3 * d + 2 * d, np.broadcast_to(cam.c2w[:3, 2], d.shape)
            elif kind == "rays anywhere":
                o, d = rng.normal(size=o.shape) * 2, rng.normal(size=d.shape)
            rays = torch.from_numpy(np.concatenate([o, d], -1))
            cam = dataclasses.replace(cam, shutter="global", w2c_end=None)
        g = gaussians(rng, 40, 1, scale=0.1, spread=spread, anisotropy=anisotropy, opacity=2.5)
        g = around_camera(g, cam).detach()
        images = []
        for whole in (False, True):
            with monkeypatch.context() as patch:
                if whole:
                    patch.setattr(FreeRays, "pixels", _everywhere)
                    patch.setattr(tiles._Tiles, "may_hit", lambda self, x, y: self.lib.Bool(True))
                out = render(g, cam, outputs=("count", "depth"), rays=rays)
                parts = [out.rgb, out.alpha[..., None], out.depth[..., None], out.count[..., None]]
                images.append(torch.cat(parts, -1))
                pairs.append(out.certificate["pairs"])
        assert torch.equal(*images)
    # Rays in all directions may meet everything in every tile.
    assert sum(pairs[::2]) <= (1.0 if kind == "rays anywhere" else 0.8) * sum(pairs[1::2])


@pytest.mark.every(3)
@pytest.mark.parametrize("preset", ["exact", "fast", "3dgut", "bvh"])
def test_rays_of_the_caller(rng, preset):
    """Images and derivatives by rays, in both modes; a pixel without a ray shows the background."""
    kind = {"traversal": "bvh"} if preset == "bvh" else {}
    settings = RenderSettings.preset("exact" if kind else preset, background=(0.2, 0.3, 0.4), **kind)
    cam = camera(rng, (17, 13))
    g = gaussians(rng, 15, 4)
    o = cam.center + 0.2 * rng.normal(size=(13, 17, 3))
    d = cam.pixel_directions() * rng.uniform(0.5, 2.0, (13, 17, 1))
    d[3, 4] = 0.0
    rays = torch.from_numpy(np.concatenate([o, d], -1)).requires_grad_()
    out = render(g, cam, settings, rays=rays)
    there = torch.ones(13, 17, dtype=torch.bool)
    there[3, 4] = False
    pair = (rays[..., :3], torch.where(there[..., None], rays[..., 3:], rays.new_tensor([0.0, 0.0, 1.0])))
    ref = reference.render(g, cam, settings, rays=pair, tolerance=1e-5)
    good = there & ~ref.ambiguous
    assert (out.rgb - ref.rgb)[good].abs().max() < 1e-5
    weight = weight_of("depth", ref)
    assert ((out.depth - ref.depth) * weight / ref.depth.clamp_min(1))[good].abs().max() < 1e-5
    assert torch.allclose(out.rgb[3, 4], torch.tensor([0.2, 0.3, 0.4]))
    assert out.alpha[3, 4] == 0
    u = torch.tensor(rng.normal(size=(13, 17, 3))) * good[..., None]
    (ours,) = torch.autograd.grad((out.rgb.double() * u).sum(), [rays])
    (theirs,) = torch.autograd.grad((ref.rgb * u).sum(), [rays])
    assert relative(ours, theirs) < 1e-4
    assert not ours[3, 4].any()
    v = torch.tensor(rng.normal(size=tuple(rays.shape)))
    pushed = render_jvp(g, cam, {"rays": v}, settings, rays=rays).rgb.double()
    assert abs(float((pushed * u).sum() - (ours * v).sum())) < 1e-4 * float((pushed * u).norm()) + 1e-5


@pytest.mark.parametrize("preset", ["fast", "exact"])
def test_own_rays_are_those_of_the_camera(rng, preset):
    """A camera's own rays give its image."""
    cam = camera(rng, (33, 27))
    g = gaussians(rng, 30, 4).detach()
    rays = np.concatenate([np.broadcast_to(cam.center, (27, 33, 3)), cam.pixel_directions()], -1)
    settings = RenderSettings.preset(preset)
    assert (render(g, cam, settings, rays=rays).rgb - render(g, cam, settings).rgb).abs().max() < 3e-6


@pytest.mark.parametrize("order", ["center", "ray"])
def test_information_of_a_rolling_shutter(rng, order):
    """The Fisher diagonal is the sum of squares of the oracle's Jacobian."""
    settings = RenderSettings(order=order)
    for _ in range(50):
        g = gaussians(rng, 8, 4, scale=0.25)
        cam = rolling(rng, "rolling_top_to_bottom", size=(12, 10))
        out = reference.render(g, cam, settings, tolerance=1e-5)
        if not out.ambiguous.any():
            break
    expected = dense.squares(dense.jacobian(g, out))
    found = fisher.diagonal(g.detach(), cam, settings)
    for name in dense.GROUPS:
        assert dense.error(found[name].reshape(expected[name].shape), expected[name]) < 1e-4, name


@pytest.mark.parametrize("shutter", ROLLING)
def test_points_are_seen_by_their_own_line(rng, shutter):
    """A point on the ray of a pixel is projected to that pixel's center."""
    for model, wide in (("pinhole", 1.0), ("opencv", 1.0), ("opencv_fisheye", 0.7)):
        cam = rolling(rng, shutter, model, tensors=False, wide=wide, far=0.05, turn=0.05)
        points = cam.pixel_origins() + 3.0 * cam.pixel_directions()
        pixels, z = cam.project(points.reshape(-1, 3))
        columns, rows = np.meshgrid(np.arange(cam.width) + 0.5, np.arange(cam.height) + 0.5)
        assert np.abs(pixels - np.stack([columns, rows], -1).reshape(-1, 2)).max() < 1e-6
        assert model == "opencv_fisheye" or (z > 0).all()


@pytest.mark.parametrize("shutter", ROLLING)
def test_crops_keep_the_poses_of_lines(rng, shutter):
    """A part of an image has the pixels of the whole one, whose order along each ray is its own."""
    cam = rolling(rng, shutter, "opencv", (40, 30), tensors=False)
    g = gaussians(rng, 30, 1).detach()
    settings = RenderSettings(order="ray")
    part = cropped(cam, 9, 7, 17, 14)
    whole = render(g, cam, settings).rgb[7:21, 9:26]
    assert (render(g, part, settings).rgb - whole).abs().max() < 1e-5


def test_errors_are_one_line(rng):
    """What is no rolling shutter, or no rays of this camera."""
    cam = rolling(rng, "rolling_top_to_bottom", tensors=False)
    g = gaussians(rng, 3, 1).detach()
    back = cam.w2c.copy()
    back[:3, :3] = rotation(np.array([0.0, 3.1, 0.0])) @ back[:3, :3]
    bad = [
        ({"shutter": "rolling"}, "shutter must be one of global, rolling_top_to_bottom"),
        ({"shutter": "global"}, "w2c_end must be there for rolling shutters, and for no other"),
        ({"w2c_end": None}, "w2c_end must be there"),
        ({"w2c_end": np.eye(3)}, r"w2c_end must have shape \(4, 4\)"),
        ({"w2c_end": np.full((4, 4), np.nan)}, "the pose must be finite"),
        ({"w2c_end": back}, "at most 170 degrees, got 178"),
    ]
    for fields, message in bad:
        with pytest.raises(ValueError, match=message) as caught:
            dataclasses.replace(cam, **fields)
        assert "\n" not in str(caught.value)
    with pytest.raises(NotImplementedError, match="pinhole's image plane, got a rolling shutter"):
        render(g, cam, RenderSettings.preset("gsplat"))
    with pytest.raises(ValueError, match="needs a global shutter"):
        cam.to_mitsuba()
    still = camera(rng, (5, 4))
    rays = torch.ones(4, 5, 6)
    with pytest.raises(NotImplementedError, match="image plane, got rays"):
        render(g, still, RenderSettings.preset("inria"), rays=rays)
    with pytest.raises(ValueError, match=r"rays must have shape \(4, 5, 6\)"):
        render(g, still, rays=rays[:3])
    rays[1, 2, 3] = torch.inf
    with pytest.raises(ValueError, match=r"rays must be finite, got .* at pixel \[1, 2\]"):
        render(g, still, rays=rays)
    with pytest.raises(ValueError, match="named among .*camera_end"):
        render_jvp(g, cam, {"rays": rays})


def test_torch_functions_of_both_poses(rng):
    """`torch.func.jvp` through a camera whose poses it differentiates gives what `render_jvp` gives."""
    cam = rolling(rng, "rolling_left_to_right", tensors=False)
    g = gaussians(rng, 10, 4).detach()
    settings = RenderSettings.preset("fast")
    basis = torch.zeros(6, 4, 4, dtype=torch.float64)
    for k in range(3):
        basis[k, (k + 2) % 3, (k + 1) % 3], basis[k, (k + 1) % 3, (k + 2) % 3] = 1, -1
        basis[3 + k, k, 3] = 1
    poses = [torch.tensor(x) for x in (cam.w2c, cam.w2c_end)]
    twists = [torch.tensor(rng.normal(size=6)) for _ in poses]
    tangents = [-pose @ (t[:, None, None] * basis).sum(0) for pose, t in zip(poses, twists, strict=True)]

    def image(start, end):
        return render(g, dataclasses.replace(cam, w2c=start, w2c_end=end), settings).rgb

    _, pushed = torch.func.jvp(image, tuple(poses), tuple(tangents))
    expected = render_jvp(g, cam, {"camera": twists[0], "camera_end": twists[1]}, settings).rgb
    assert relative(pushed, expected) < 1e-5
