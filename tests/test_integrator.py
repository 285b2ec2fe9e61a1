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
    rotation,
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
        ((9, 7), 15, 4, 5, {"sh_direction": "ray", "extent": 4.0}),
    ),
    ("peak", "entry"): (
        ((9, 7), 20, 1, 1, {"transmittance_min": 1e-4}),
        ((13, 8), 12, 4, 0, {**CUTS, "sh_direction": "ray"}),
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
        ((9, 7), 15, 16, 0, {**CUTS, "fov_clamp": "gsplat", "depth_key": "z", "stop": "before_eq"}),
    ),
}
SCENES = 15  # of each kind: 7 x 2 x 15 = 210


def traversals(response, order):
    """The legal traversals of a response and order."""
    return [t for t in ("tiles", "bvh") if (response != "ewa" or t == "tiles") and (order != "entry" or t == "bvh")]


def scene(rng, kind, **options):
    """Gaussians and camera of a kind, some Gaussians around the camera, of mixed anisotropy and opacity."""
    size, n, K, D, _ = kind
    cam = camera(rng, size)
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


@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize(("response", "order"), KINDS)
def test_random_scenes(rng, response, order, kind):
    """Images, adjoint and forward mode on both traversals, which also equal each other."""
    ambiguous = []
    kind = KINDS[response, order][kind]
    for _ in range(SCENES):
        g, cam = scene(rng, kind)
        settings = RenderSettings(response=response, order=order, traversal="bvh" if order == "entry" else "tiles")
        settings = settings.replace(**kind[4])
        oracle = Oracle(g, cam, settings, rng)
        ambiguous.append(float((~oracle.good).double().mean()))
        images = []
        for traversal in traversals(response, order):
            errors = compare(g, cam, settings.replace(traversal=traversal), oracle)
            check(errors)
            # The oracle's marks cover what can move a weight by 1e-7; a count may still see less than that.
            assert errors.count <= 1
            images.append(errors.out)
        for name in FIELDS:
            if len(images) == 2 and getattr(images[0], name) is not None:
                a, b = (getattr(x, name).detach()[oracle.good] for x in images)
                torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
    assert np.mean(ambiguous) < 0.02
