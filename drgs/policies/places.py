"""Places that views will show: on what the model has, and where it has nothing, anywhere along the ray.

Information speaks of Gaussians that exist. What most of an early model's error is about does not exist yet, so a
policy that is to find it must say what may be there. Here it is places along the rays of all views of the pool, the
known ones among them: for each of some pixels one where the model stops the ray, with the pixel's opacity as its
weight, and one at a depth that known views have seen, with what is left of the light. How much of a place another view
sees is the transmittance of the model up to it: 1 in front of what that view shows, 1 - opacity behind.

References:
    FisherRF and AG-SLAM (random opaque Gaussians in unknown cells) and GAVIS, arXiv 2605.30342 (virtual particles seen
    through the model's transmittance), for counting what is not there; places along rays of the pool, weighted by what
    the rays have left, are drgs's own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.ellipsoids import colors_only
from drgs.settings import RenderSettings
from drgs.sizes import at_most

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene

__all__ = ["Places", "Sight", "places", "sight_of"]

_PIXELS = 1200  # of a view as the model is looked at
_SOLID = 0.5  # opacity from which on the model's depth is that of a surface
_TOLERANCE = 0.05  # relative depth by which a place may lie behind a surface that it is on
_NEAREST = 0.05  # of the distance of cameras from their middle: free space in front of a camera


@dataclasses.dataclass(frozen=True)
class Sight:
    """What a view shows of the model, in small.

    Attributes:
        camera: Of that size.
        alpha: (H, W) float64 opacity.
        depth: (H, W) float64 distance along the ray at which half of the light is gone; of less opaque pixels the
            average of what there is; infinite where nothing is.
    """

    camera: Camera
    alpha: np.ndarray
    depth: np.ndarray

    def reach(self, points: np.ndarray) -> np.ndarray:
        """(P,) share of the light from world points (P, 3) that reaches the camera; 0 outside of the image."""
        camera = self.camera
        pixels, z = camera.project(points)
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        columns, rows = np.where(inside[:, None], pixels, 0).astype(int).T
        behind = np.linalg.norm(points - camera.center, axis=1) > self.depth[rows, columns] * (1 + _TOLERANCE)
        return np.where(inside, np.where(behind, 1 - self.alpha[rows, columns], 1.0), 0.0)


def sight_of(scene: Scene, camera: Camera, pixels: int = _PIXELS) -> Sight:
    """What a view shows of a scene at its time, at most so many pixels."""
    from drgs.integrator import render  # loads Dr.Jit, which policies by poses need not have

    small = at_most(camera, pixels)
    with torch.no_grad():
        # `exact` and `fast` measure depth along the ray, `ewa` along the axis of the camera.
        out = render(
            colors_only(scene, camera.time), small, RenderSettings.preset("fast"), outputs=("depth", "median_depth")
        )
    assert out.depth is not None
    assert out.median_depth is not None
    alpha, mean, median = (x.double().cpu().numpy() for x in (out.alpha, out.depth, out.median_depth))
    depth = np.where(median > 0, median, np.where(alpha > 1e-3, mean, np.inf))
    return Sight(small, alpha.clip(0, 1), depth)


@dataclasses.dataclass(frozen=True)
class Places:
    """Where something is or may be, as the pool's views will show it.

    Attributes:
        points: (P, 3) world.
        views: (P,) index of the view whose pixel it is.
        weights: (P,) how much of the pixel it may be; those of a view add up to 1.
        rays: (P, 3) unit directions from that view.
        distances: (P,) along it.
    """

    points: np.ndarray
    views: np.ndarray
    weights: np.ndarray
    rays: np.ndarray
    distances: np.ndarray


def places(sights: Sequence[Sight], known: int, count: int, rng: np.random.Generator) -> Places:
    """Draw `count` pixels of each view, and two places of each.

    Args:
        sights: Of all views; the first `known` of them are those that photographs are known of.
        known: Whose depths are those that may be elsewhere; where they show nothing solid, distances are drawn evenly
            in 1 / distance, from a part of the cameras' own distances on.
        count: Of pixels of a view.
        rng: Of the pixels and of the depths.
    """
    depths = _depths(sights, known)
    found: list[list[np.ndarray]] = []
    for number, sight in enumerate(sights):
        camera = sight.camera
        chosen = rng.integers(0, camera.width * camera.height, count)
        rows, columns = np.divmod(chosen, camera.width)
        rays = camera.pixel_directions()[rows, columns]
        alpha, depth = sight.alpha[rows, columns], sight.depth[rows, columns]
        guess = depths[rng.integers(0, len(depths), count)]
        there = np.isfinite(depth)
        for distance, weight in ((np.where(there, depth, 0.0), np.where(there, alpha, 0.0)), (guess, 1 - alpha)):
            kept = weight > 0
            found.append([
                camera.center + distance[kept, None] * rays[kept],
                np.full(int(kept.sum()), number),
                weight[kept] / count,
                rays[kept],
                distance[kept],
            ])  # fmt: skip
    return Places(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _depths(sights: Sequence[Sight], known: int) -> np.ndarray:
    """Distances that something may be at: those of surfaces in known views."""
    seen = [sight.depth[(sight.alpha >= _SOLID) & np.isfinite(sight.depth)] for sight in sights[:known]]
    solid = np.concatenate(seen) if seen else np.empty(0)
    if len(solid):
        return solid
    centers = np.stack([sight.camera.center for sight in sights])
    size = float(np.linalg.norm(centers - centers.mean(0), axis=1).max()) or 1.0
    return 1 / np.linspace(1 / (10 * size), 1 / (_NEAREST * size), 256)
