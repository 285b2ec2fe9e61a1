"""Input that must not be rendered: it raises ValueError, or is warned about, with one line that says why."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np

from drgs import fisher
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.lab.accuracy import random_camera, random_gaussians
from drgs.settings import RenderSettings

__all__ = ["REFUSALS", "Refusal"]

Attempts = Iterator[tuple[Callable[[], object], str]]


@dataclasses.dataclass(frozen=True)
class Refusal:
    """One kind of such input.

    Attributes:
        name: Name of the kind, as it is printed.
        attempts: Function that yields pairs of a call and a text that its message must have.
        warns: Whether the message is a warning; else it is a ValueError.
    """

    name: str
    attempts: Callable[[], Attempts]
    warns: bool = False


def _scene() -> tuple[Gaussians, Camera]:
    rng = np.random.default_rng(0)
    # No leaves: their values are changed in place, which torch refuses of leaves.
    return random_gaussians(rng, 4, 4, 2).detach(), random_camera(rng, (9, 7))


def _with(field: str, value: float) -> Gaussians:
    """A small scene with a Gaussian's parameter replaced."""
    g, _ = _scene()
    getattr(g, field)[2] = value
    return g


def _not_finite() -> Attempts:
    """Every parameter, NaN and both infinities, rendered and differentiated."""
    _, cam = _scene()
    for field in ("means", "quats", "log_scales", "logit_opacities", "sh", "features"):
        for value in (math.nan, math.inf, -math.inf):
            g = _with(field, value)
            told = f"{field} must be finite"
            for traversal in ("tiles", "bvh"):
                settings = RenderSettings.preset("exact", traversal=traversal)
                yield lambda g=g, settings=settings: render(g, cam, settings), told
                if field != "features":  # which information does not depend on
                    yield lambda g=g, settings=settings: fisher.diagonal(g, cam, settings), told


def _zero_quaternion() -> Attempts:
    _, cam = _scene()
    g = _with("quats", 0.0)
    for traversal in ("tiles", "bvh"):
        settings = RenderSettings.preset("exact", traversal=traversal)
        yield lambda settings=settings: render(g, cam, settings), "quats must not be 0"


def _broken_camera() -> Attempts:
    """A camera is refused when it is made, and once more when its pose has been moved since."""
    g, cam = _scene()
    for value in (math.nan, math.inf):
        # Copies without a graph: their values are changed in place, which torch refuses of leaves.
        K = cam.K.copy()
        w2c = cam.w2c.detach().clone()
        K[0, 0] = w2c[0, 3] = value
        yield lambda K=K: dataclasses.replace(cam, K=K), "K must"
        yield lambda w2c=w2c: dataclasses.replace(cam, w2c=w2c), "pose must be finite"
        moved = dataclasses.replace(cam, w2c=cam.w2c.detach().clone())  # no leaf: it is changed in place
        moved.w2c[0, 3] = value  # a pose that an optimizer moved
        for traversal in ("tiles", "bvh"):
            settings = RenderSettings.preset("exact", traversal=traversal)
            yield lambda moved=moved, settings=settings: render(g, moved, settings), "pose must be finite"


def _far_away() -> Attempts:
    means = np.array([[1e6, 0.0, 0.0]], np.float32)
    arrays = means, np.eye(4)[:1], np.full((1, 3), 1e-2), np.full(1, 0.5), np.zeros((1, 3))
    yield lambda: Gaussians.from_arrays(*arrays), "float64 means"


REFUSALS = (
    Refusal("NaN and infinite parameters", _not_finite),
    Refusal("quaternion exactly 0", _zero_quaternion),
    Refusal("NaN and infinite cameras", _broken_camera),
    Refusal("world offset 1e6, detail 1e-2, float32 means", _far_away, warns=True),
)
