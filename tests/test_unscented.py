"""Culling by the box of the unscented transform, against the float64 oracle."""

from __future__ import annotations

import numpy as np
import pytest
from scenes_random import Oracle, around_camera, camera, compare, gaussians
from test_integrator import check
from test_lenses import lens_camera, quietly
from test_shutter import rolling

from drgs import reference, render
from drgs.cameras import Camera
from drgs.settings import RenderSettings

UT = {"culling": "ut", "depth_key": "z", "extent": 3.0, "alpha_min": 1 / 255, "near": 0.01}


def seen(rng, kind, size=(61, 45)):
    """A random camera."""
    if kind == "rolling":
        return rolling(rng, "rolling_top_to_bottom", size=size)
    return camera(rng, size) if kind == "pinhole" else lens_camera(rng, kind, size)


@pytest.mark.every(4)
@pytest.mark.parametrize("kind", ["pinhole", "barrel", "fisheye", "f-theta", "panorama", "rolling"])
def test_what_is_left_out(rng, kind):
    """Large Gaussians around the camera are cut off at the tiles of their boxes, where the oracle cuts them off."""
    settings = RenderSettings(**UT)
    changed = 0.0
    for _ in range(8):
        cam = seen(rng, kind)
        g = around_camera(gaussians(rng, 40, 1, scale=0.3, anisotropy=1.0), cam).detach()
        out = quietly(render, g, cam, settings).rgb.double()
        whole = quietly(render, g, cam, settings.replace(culling="extent")).rgb.double()
        ref = quietly(reference.render, g, cam, settings, tolerance=1e-5)
        good = ~ref.ambiguous
        assert good.double().mean() > 0.95
        assert (out - ref.rgb)[good].abs().max() < 1e-5
        changed += float(((out - whole).abs().amax(-1) > 1 / 255).double().mean())
    assert changed > 0.05  # it does leave something out


@pytest.mark.every(3)
@pytest.mark.parametrize("kind", ["pinhole", "fisheye", "rolling"])
def test_derivatives(rng, kind):
    """Boxes have none: what is drawn has the derivatives that it has."""
    settings = RenderSettings(**UT)
    cam = seen(rng, kind, (26, 21))
    g = around_camera(gaussians(rng, 20, 4, scale=0.3), cam)
    check(quietly(compare, g, cam, settings, quietly(Oracle, g, cam, settings, rng)))


@pytest.mark.parametrize("kind", ["pinhole", "barrel", "fisheye"])
def test_small_gaussians_are_whole(rng, kind):
    """Of what is small on the image nothing is left out: the two pictures are the same."""
    settings = RenderSettings(**UT)
    for _ in range(3):
        cam = seen(rng, kind)
        g = gaussians(rng, 60, 1, scale=0.02, spread=1.5).detach()
        out, whole = (quietly(render, g, cam, settings.replace(culling=x)).rgb for x in ("ut", "extent"))
        assert (out - whole).abs().max() < 1 / 255


def test_tiles_of_large_images(rng):
    """Images of 1080 rows and more have tiles of 16 pixels."""
    w2c = np.eye(4)
    w2c[2, 3] = 4.0
    g = gaussians(rng, 30, 1, scale=0.3, anisotropy=1.0)
    for rows in (1079, 1080):
        K = np.array([[12.0, 0.0, 6.0], [0.0, 600.0, rows / 2], [0.0, 0.0, 1.0]])
        cam = Camera(K=K, w2c=w2c, width=12, height=rows)
        g = around_camera(g, cam).detach()
        out = render(g, cam, RenderSettings(**UT)).rgb.double()
        ref = reference.render(g, cam, RenderSettings(**UT), tolerance=1e-5)
        assert (out - ref.rgb)[~ref.ambiguous].abs().max() < 1e-5


def test_where_it_belongs():
    """Along rays, on tiles."""
    for fields in ({"response": "ewa"}, {"traversal": "bvh"}):
        with pytest.raises(NotImplementedError, match="culling='ut' belongs to responses along rays"):
            RenderSettings(culling="ut", **fields)
