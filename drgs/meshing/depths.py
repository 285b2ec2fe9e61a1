"""Depth images for fusion: where each ray ends, with which weight, and its color."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.cameras.sizes import at_most
from drgs.integrator import render
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.meshing.options import DepthKind

_SURFACE_ALPHA = 0.5  # alpha from which on a pixel shows a surface: the median of its depth exists
_LEAST_COSINE = 0.05  # between a ray and a surface; beyond 87 degrees the normal of a depth image says nothing
_PROBE_PIXELS = 2_500  # pixels of the picture whose depths say how far away the subject is; chosen for its seconds
_SEEN_ALPHA = 0.5  # alpha from which on a pixel of that picture shows something
_NEAR_QUANTILE = 0.25  # quantile of its depths: the subject stands in front of a background; chosen
_LEAST_LOG_ARGUMENT = 1e-30  # least argument of a logarithm, which stays finite in float32


@dataclass(frozen=True)
class DepthView:
    """Depths, weights and colors of one camera.

    Attributes:
        camera: The camera.
        depth: (H, W) float32 distance along each ray in scene units; infinite where nothing solid is hit.
        weight: (H, W) float32 in [0, 1], the cosine of the angle between the ray and the surface's normal.
        alpha: (H, W) float32 opacity.
        rgb: (H, W, 3) float32 colors.
        spread: (H, W) float32 standard deviation of the position of what is seen in scene units, for unit noise of
            colors; None where it is not wanted.
    """

    camera: Camera
    depth: np.ndarray
    weight: np.ndarray
    alpha: np.ndarray
    rgb: np.ndarray
    spread: np.ndarray | None = None


def depth_views(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    settings: RenderSettings,
    kind: DepthKind = "median",
    deviations: torch.Tensor | None = None,
    advance: Callable[[], None] | None = None,
) -> list[DepthView]:
    """Render the depth images that `mesh_of` fuses.

    Args:
        gaussians: N Gaussians; those of a skybox are to be left out before.
        cameras: The cameras.
        settings: How they are rendered.
        kind: `median`, where transmittance falls to one half, or `expected`, the mean over the weights.
        deviations: (N,) standard deviation of each mean in scene units; None: no `spread`.
        advance: Called after each view.
    """
    features = (
        None
        if deviations is None
        else deviations.clamp_min(_LEAST_LOG_ARGUMENT).log()[:, None].to(gaussians.means.dtype)
    )
    plain = gaussians.replace(features=features)
    output = "median_depth" if kind == "median" else "depth"
    views = []
    for camera in cameras:
        with torch.no_grad():
            out = render(plain, camera, settings, (output,))
        alpha = out.alpha.cpu().numpy()
        measured = getattr(out, output).cpu().numpy()
        is_solid = (alpha > _SURFACE_ALPHA) & (measured > 0)
        depth = np.where(is_solid, measured, np.inf).astype(np.float32)
        spread = None
        if out.features is not None:
            # The mean of the logarithm, over the weights of what is seen.
            spread = np.exp(out.features[..., 0].cpu().numpy() / np.maximum(alpha, _SURFACE_ALPHA)).astype(np.float32)
        views.append(DepthView(camera, depth, _cosines(camera, depth), alpha, out.rgb.cpu().numpy(), spread))
        if advance:
            advance()
    return views


def _cosines(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """(H, W) cosine between each ray and the normal of the depth image, from differences of neighboring points."""
    directions = camera.pixel_directions()
    points = camera.pixel_origins() + np.where(np.isfinite(depth), depth, np.nan)[..., None] * directions
    if min(depth.shape) < 2:
        return np.ones_like(depth)
    down, right = np.gradient(points, axis=(0, 1))
    normals = np.cross(right, down)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.abs(np.einsum("hwk,hwk->hw", normals, directions)) / np.linalg.norm(normals, axis=-1)
    # Beside an edge of what is solid there is no normal: such pixels count least.
    return np.nan_to_num(cosine, nan=_LEAST_COSINE).clip(_LEAST_COSINE, 1.0).astype(np.float32)


def footprint(views: Sequence[DepthView]) -> float | None:
    """The width of a pixel where it meets the surface, in scene units: the median over all views; None without any.

    It is the angle between the middle pixel and its neighbor times the distance.
    """
    widths = []
    for view in views:
        solid = view.depth[np.isfinite(view.depth)]
        if solid.size:
            rays = view.camera.pixel_directions()
            row, column = rays.shape[0] // 2, rays.shape[1] // 2
            other = rays[row, column - 1] if column else rays[row - 1, column] if row else rays[row, column]
            widths.append(float(np.median(solid)) * float(np.linalg.norm(rays[row, column] - other)))
    positive = [width for width in widths if width > 0]
    return float(np.median(positive)) if positive else None


def seen_distance(gaussians: Gaussians) -> Callable[[Camera], float | None]:
    """A function of a pinhole or distorted camera: the distance, in scene units, of what it looks at (the nearer
    quarter of the depths in the middle of its picture), or None where it sees nothing.
    """
    fast = RenderSettings.preset("fast")

    def distance(camera: Camera) -> float | None:
        small = at_most(camera.undistorted(), _PROBE_PIXELS)
        with torch.no_grad():  # measured, not optimized
            out = render(gaussians, small, fast, ("depth",))
        assert out.depth is not None
        rows, columns = (slice(n // 4, n - n // 4) for n in (small.height, small.width))
        depth = out.depth[rows, columns].cpu().numpy()
        alpha = out.alpha[rows, columns].cpu().numpy()
        solid = alpha > _SEEN_ALPHA
        return float(np.quantile(depth[solid], _NEAR_QUANTILE)) if solid.any() else None

    return distance
