"""Scenes that benchmarks share."""

from __future__ import annotations

import numpy as np

import drgs
from drgs.cameras import intrinsics_from_fov
from drgs.ellipsoids import Y_00


def cube(count: int = 100_000, scale: float | None = None, seed: int = 0, sh_degree: int = 0) -> drgs.Gaussians:
    """Gaussians of random orientation and color in the cube [-1, 1]^3.

    Args:
        count: Number of Gaussians.
        scale: Median standard deviation; None keeps the projected coverage of 100,000 at 0.01 for any count.
        seed: Seed of everything.
        sh_degree: SH degree of the colors.
    """
    rng = np.random.default_rng(seed)
    scale = 0.01 * (1e5 / count) ** 0.5 if scale is None else scale
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(0, 1, (count, 3)) - 0.5) / Y_00
    sh[:, 1:] = 0.1 * rng.normal(size=sh[:, 1:].shape)
    return drgs.Gaussians.from_arrays(
        rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)),
        scale * np.exp(0.3 * rng.normal(size=(count, 3))),
        rng.uniform(0.05, 0.95, count),
        sh,
    )


def camera(width: int = 512, height: int | None = None, fov: float = 45.0, distance: float = 4.0) -> drgs.Camera:
    """Pinhole at (0, 0, -distance) looking along +z; a square image unless a height is given."""
    height = height or width
    w2c = np.eye(4)
    w2c[2, 3] = distance
    return drgs.Camera(K=intrinsics_from_fov(fov, width, height), w2c=w2c, width=width, height=height)
