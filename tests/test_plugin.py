"""The Mitsuba integrator `drgs`: under `mi.load_dict` and `mi.render`, with Mitsuba's AD, and with a lens."""

from __future__ import annotations

import dataclasses

import drjit as dr
import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians

import drgs
from drgs import plugin, runtime  # noqa: F401 - the plugin registers the integrator
from drgs.ellipsoids import ellipsoids_shape
from drgs.settings import RenderSettings

pytestmark = pytest.mark.core

mi = runtime.mitsuba()


def _scene(seed=0, K=4, size=(20, 16)):
    rng = np.random.default_rng(seed)
    g, cam = gaussians(rng, 15, K, scale=0.2).detach(), camera(rng, size)
    # Mitsuba's pixels are square.
    K_square = cam.K.copy()
    K_square[1, 1] = K_square[0, 0]
    return g, dataclasses.replace(cam, K=K_square, w2c=cam.w2c.detach().numpy())


def _load(g, cam, **integrator):
    sensor = cam.to_mitsuba()
    sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "drgs", **integrator},
            "gaussians": ellipsoids_shape(g),
            "sensor": sensor,
        }
    )


@pytest.mark.parametrize(
    "options",
    [
        {"preset": "exact"},
        {"preset": "fast"},
        {"preset": "exact", "response": "integral"},
        {"preset": "exact", "sh_direction": "ray"},
        {"preset": "mitsuba", "background": [0.25, 0.5, 1.0]},
        {"preset": "exact", "near": 3.6, "order": "center", "depth_key": "z"},
    ],
    ids=str,
)
def test_the_center_of_a_pixel_is_what_render_shows(options):
    """A box filter and one sample at the center: the same image as `drgs.render`, for presets and single settings."""
    g, cam = _scene()
    image = np.array(mi.render(_load(g, cam, **options), spp=1))
    fields = {name: tuple(x) if isinstance(x, list) else x for name, x in options.items() if name != "preset"}
    settings = RenderSettings.preset(options["preset"], traversal="bvh", **fields)
    # Mitsuba's rays start on the near plane, one centimeter on; nothing is there.
    assert np.abs(image - drgs.render(g, cam, settings).rgb.numpy()).max() < 2e-5


def test_gradients_of_shape_parameters():
    """Reverse mode reaches the shape's arrays: the gradients of `drgs.render` by linear scales and opacities."""
    g, cam = _scene()
    scene = _load(g, cam, preset="exact")
    params = mi.traverse(scene)
    keys = ("gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs")
    for key in keys:
        dr.enable_grad(params[key])
    weights = np.random.default_rng(1).normal(size=(cam.height, cam.width, 3)).astype(np.float32)
    image = mi.render(scene, params=params, spp=1, spp_grad=1)
    dr.backward(dr.sum(image.array * mi.Float(weights.ravel())))
    data, opacity, sh = (np.array(dr.grad(params[key])) for key in keys)

    scales, opacities = g.scales.clone().requires_grad_(), g.opacities.clone().requires_grad_()
    moving = g.replace(
        means=g.means.clone().requires_grad_(),
        sh=g.sh.clone().requires_grad_(),
        log_scales=scales.log(),
        logit_opacities=opacities.logit(),
    )
    out = drgs.render(moving, cam, RenderSettings.preset("exact", traversal="bvh"), outputs=())
    (out.rgb * torch.from_numpy(weights)).sum().backward()
    data = data.reshape(len(g), 10)
    for found, want in (
        (data[:, :3], moving.means.grad),
        (data[:, 3:6], scales.grad),
        (opacity, opacities.grad),
        (sh.reshape(g.sh.shape), moving.sh.grad),
    ):
        want = want.numpy()
        assert np.linalg.norm(found - want) <= 1e-3 * np.linalg.norm(want)


def test_forward_mode():
    """`dr.forward` through `mi.render` is the same derivative."""
    g, cam = _scene()
    scene = _load(g, cam, preset="exact")
    params = mi.traverse(scene)
    key = "gaussians.opacities"
    dr.enable_grad(params[key])
    dr.set_grad(params[key], 1)
    image = mi.render(scene, params=params, spp=1, spp_grad=1)
    tangent = np.array(dr.forward_to(image))
    opacity = g.opacities
    moved = drgs.render_jvp(
        g,
        cam,
        {"logit_opacities": 1 / (opacity * (1 - opacity))},
        RenderSettings.preset("exact", traversal="bvh"),
        outputs=(),
    ).rgb.numpy()
    assert np.linalg.norm(tangent - moved) <= 1e-3 * np.linalg.norm(moved)


def test_thin_lens():
    """A lens that is no pinhole: in focus it shows the pinhole's image, out of focus a blurred one."""
    g, cam = _scene(size=(24, 20))
    K = cam.K.copy()
    K[:2, 2] = 12, 10  # this sensor has no off-center principal point
    cam = dataclasses.replace(cam, K=K)
    sharp = drgs.render(g, cam, RenderSettings.preset("exact", traversal="bvh")).rgb.numpy()
    images = {}
    for focus in (4.0, 2.0):
        sensor = cam.to_mitsuba() | {"type": "thinlens", "aperture_radius": 0.15, "focus_distance": focus}
        for name in ("principal_point_offset_x", "principal_point_offset_y"):
            sensor.pop(name)
        scene = mi.load_dict(
            {"type": "scene", "integrator": {"type": "drgs"}, "gaussians": ellipsoids_shape(g), "sensor": sensor}
        )
        images[focus] = np.array(mi.render(scene, spp=128, seed=1))
    error = {focus: np.abs(image - sharp).mean() for focus, image in images.items()}
    assert all(np.isfinite(image).all() for image in images.values())
    assert error[4.0] < 0.5 * error[2.0]
    assert error[4.0] < 0.05


def test_wrong_scenes():
    """No shape, two shapes, a shape without colors: one line that says so."""
    g, cam = _scene()
    shape = ellipsoids_shape(g)
    bare = {name: x for name, x in shape.items() if name != "sh_coeffs"}
    for shapes, message in (
        ({}, "exactly one ellipsoids shape, got 0"),
        ({"a": shape, "b": shape}, "exactly one ellipsoids shape, got 2"),
        ({"a": bare}, "must have the attribute 'sh_coeffs'"),
    ):
        scene = mi.load_dict({"type": "scene", "integrator": {"type": "drgs"}, "sensor": cam.to_mitsuba(), **shapes})
        with pytest.raises(Exception, match="custom differentiable operation") as caught:
            mi.render(scene, spp=1)
        # Mitsuba wraps what its integrators raise.
        assert message in str(caught.value.__cause__)
