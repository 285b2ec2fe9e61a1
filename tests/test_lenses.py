"""Lenses on tiles: images and derivatives against the float64 oracle, and bounds that miss no pixel."""

from __future__ import annotations

import warnings

import pytest
import torch
from scenes_random import Oracle, around_camera, camera, compare, gaussians
from test_integrator import check
from test_tiles import listed_gaussians

from drgs import reference
from drgs.cameras import Camera
from drgs.settings import RenderSettings
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
    "turning back": ("opencv_fisheye", (-0.15, 0.0, 0.0, 0.0), 0.2),
}


def lens_camera(rng, name, size=(26, 21), **options):
    """A random camera with a lens that sees the scene."""
    model, distortion, factor = LENSES[name]
    cam = camera(rng, size, **options)
    K = cam.K.copy()
    K[:2, :2] *= factor
    K[0, 1] = 0.03 * K[0, 0]
    return Camera(K=K, w2c=cam.w2c, width=cam.width, height=cam.height, model=model, distortion=distortion)


def quietly(function, *args, **options):
    """What a function gives, without warnings of lenses that have no inverse."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*cannot be inverted")
        return function(*args, **options)


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
        extent = (2 * torch.log((g.opacities.double() * 25 / 1e-5).clamp(min=1))).sqrt()
        for i in range(len(g)):
            radius = max(float(extent[i]), 1e-3)
            one = quietly(reference.render, g.take([i]), cam, settings.replace(extent=radius))
            hit = (one.count > 0) & (one.alpha > 1e-12)
            if response == "integral":
                # Behind the ray's origin, what there is lies below the tails that the extent leaves out.
                hit &= one.alpha > 1e-5 / 25
            for y, x in hit.nonzero().tolist():
                assert i in listed[(y // TILE) * columns + x // TILE], (i, x, y)


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
]


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
