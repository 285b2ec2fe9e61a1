"""Tests of other people's rasterizers: one assertion, and scenes on which faults show.

from drgs.testing import assert_matches
def test_gradients():
    assert_matches("my_package.rasterizer:rasterization", preset="gsplat")
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera, look_at
from drgs.ellipsoids import Gaussians
from drgs.lab.crossval import VERDICTS, Result, crossval
from drgs.lab.rasterizers import function, is_along_rays, load_rasterizer

__all__ = ["assert_matches", "random_scene"]


def assert_matches(
    rasterizer: str | Callable,
    scene: Gaussians | None = None,
    cameras: list[Camera] | None = None,
    preset: str = "auto",
    *,
    background: tuple = (0.2, 0.4, 0.7),
    allow: tuple[str, ...] = ("known deviation",),
    seeds: tuple[int, ...] = (0, 1, 2),
    **options: Any,
) -> list[Result]:
    """Assert that a rasterizer's images and gradients are those of a model.

    Args:
        rasterizer: A function with gsplat's argument names, or a name as `drgs crossval --rasterizer` takes it.
        scene: Gaussians to compare on; default random scenes of `seeds`.
        cameras: Views of the scene; both are given, or none.
        preset: Preset that it claims to compute, or `auto`. Of one along rays (`3dgut`, `exact`, `fast`) the function
            is called with `with_ut` and `with_eval3d` where it has them, as `drgs crossval` calls it.
        background: RGB of the background; black hides what happens to its gradient.
        allow: Verdicts (drgs.lab.crossval.VERDICTS) besides `agreement` that pass.
        seeds: Seeds of the random scenes.
        options: Further arguments of `drgs.lab.crossval.crossval`.
    Returns:
        A `Result` a scene.
    Raises:
        AssertionError: With one line a finding.
        ValueError: If the rasterizer cannot be called, or `allow` names no verdict.
    """
    if unknown := [name for name in allow if name not in VERDICTS]:
        raise ValueError(f"assert_matches: allow must be among {', '.join(VERDICTS)}, got {unknown[0]!r}")
    if (scene is None) != (cameras is None):
        raise ValueError("assert_matches: scene and cameras must both be given, or none of them")
    scenes = [(scene, cameras)] if scene is not None and cameras is not None else [random_scene(seed) for seed in seeds]
    results = []
    for g, views in scenes:
        if isinstance(rasterizer, str):
            rays = is_along_rays(preset, rasterizer)
            tested = load_rasterizer(rasterizer, g, views, {"background": background}, rays)
        else:
            tested = function(rasterizer, getattr(rasterizer, "__name__", "rasterizer"), is_along_rays(preset))
        result = crossval(tested, g, views, preset, {"background": background}, **options)
        results.append(result)
        if result.verdict not in ("agreement", *allow):
            raise AssertionError("\n".join(result.lines()))
    return results


def random_scene(
    seed: int = 0, count: int = 60, width: int = 48, height: int = 40, aspect: float = 1.03
) -> tuple[Gaussians, list[Camera]]:
    """Gaussians and a camera on which faults of rasterizers show.

    A wide, off-center view (depth keys, field-of-view clamps), opaque Gaussians in front (clamped alpha, rays that
    end), small ones (dilation), some behind the camera, quaternions of any length and sign, SH of degree 2.

    Args:
        seed: Seed of everything random.
        count: Number of Gaussians.
        width, height: Size of the image in pixels.
        aspect: Ratio fy / fx; 1 for renderers that know square pixels only.
    """
    rng = np.random.default_rng(seed)
    focal = 0.55 * width
    K = np.array([[focal, 0, width * rng.uniform(0.42, 0.58)], [0, aspect * focal, height * rng.uniform(0.42, 0.58)]])
    camera = Camera(
        K=np.vstack([K, [0, 0, 1]]),
        w2c=look_at(rng.normal(size=3) * 0.3, np.array([0.3, -0.2, 4.0]), np.array([0.1, -1.0, 0.05])),
        width=width,
        height=height,
        name=f"random_{seed}",
    )
    z = rng.uniform(2.0, 5.0, count)
    local = np.stack([z * rng.uniform(-0.9, 0.9, count), z * rng.uniform(-0.75, 0.75, count), z], 1)
    log_scales = math.log(0.25) + 0.7 * rng.normal(size=(count, 3))
    logits = 1.5 * rng.normal(size=count)
    opaque = count // 3
    near = count // 8
    behind = max(2, count // 15)
    logits[:opaque] = rng.uniform(3, 5, opaque)
    # Clamped alpha needs a center within a tenth of sigma of a pixel's, and not on it: there its slope is 0.
    turn = rng.uniform(0, 2 * np.pi, near)
    sigma = 2.5
    pixel = np.floor(rng.uniform((4, 4), (width - 4, height - 4), (near, 2))) + 0.5
    pixel += 0.03 * sigma * np.stack([np.cos(turn), np.sin(turn)], 1)
    depth = rng.uniform(1.5, 1.9, near)
    local[:near] = depth[:, None] * np.concatenate([(pixel - K[:, 2]) / K[[0, 1], [0, 1]], np.ones((near, 1))], 1)
    log_scales[:near] = np.log(sigma * depth[:, None] / focal) + 0.2 * rng.normal(size=(near, 3))
    logits[:near] = rng.uniform(8, 10, near)
    local[count - behind :, 2] *= -0.5
    c2w = camera.c2w
    values = {
        "means": local @ c2w[:3, :3].T + c2w[:3, 3],
        "quats": rng.normal(size=(count, 4)) * rng.uniform(0.3, 3, (count, 1)),
        "log_scales": log_scales,
        "logit_opacities": logits,
        "sh": 0.4 * rng.normal(size=(count, 9, 3)),
    }
    tensors: dict[str, Any] = {name: torch.tensor(x, dtype=torch.float32) for name, x in values.items()}
    return Gaussians(**tensors), [camera]
