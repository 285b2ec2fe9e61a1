"""The cases of `drgs.lab.extremes`, and crowds in which the acceleration structure may lose hits."""

from __future__ import annotations

import math

from scenes_random import camera, gaussians

from drgs.lab.extremes import CASES, ExtremeCase

__all__ = ["CASES", "CROWDS", "ExtremeCase", "crowd"]


def _huge_crowd(g):
    g.log_scales[:20], g.logit_opacities[:20] = math.log(1e4), -3.0


def _large_crowd(g):
    g.log_scales[::5] += 4.0
    g.logit_opacities[::5] = -3.0


def _tiny_one(g):
    g.log_scales[0] = math.log(1e-4)


def _far_one(g):
    g.means[0] = 1e5


# Crowds in which the acceleration structure may lose hits: name -> (options of `gaussians`, distance of the camera,
# change in place).
CROWDS = {
    "20 hits a ray": ({"n": 150, "scale": 0.12}, 4.0, None),
    "170 hits a ray": ({"n": 1000, "scale": 0.12}, 4.0, None),
    "170 hits a ray, one Gaussian tiny": ({"n": 1000, "scale": 0.12}, 4.0, _tiny_one),
    "160 hits a ray, thin (log-scales spread by 1.8)": ({"n": 1000, "scale": 0.07, "anisotropy": 1.8}, 4.0, None),
    "50 hits a ray, 20 Gaussians of scale 1e4": ({"n": 300, "scale": 0.1}, 4.0, _huge_crowd),
    "85 hits a ray, every fifth Gaussian 55 times as large": ({"n": 300, "scale": 0.1}, 4.0, _large_crowd),
    "30 hits a ray, one Gaussian 1e5 away": ({"n": 300, "scale": 0.1}, 4.0, _far_one),
    "40 hits a ray, 5,000 sigma away": ({"n": 300, "scale": 0.12}, 600.0, None),
}


def crowd(name, rng, size):
    """(Gaussians, Camera) of one of `CROWDS`, detached."""
    options, distance, change = CROWDS[name]
    g = gaussians(rng, **options).detach()
    if change:
        change(g)
    return g, camera(rng, size, distance=distance)
