"""Fusion of depth images into a signed distance, and the triangles of its zero: a brick at a time.

A truncated signed distance (Curless and Levoy 1996, A volumetric method for building complex models from range images)
lives on the points of a lattice: the weighted mean, over the views that see a point, of how far in front of the surface
it lies along the view's ray, cut off at `trunc`. Behind the surface by more than that, a view says nothing. Pixels that
hit nothing solid say that their whole ray is free. Marching cubes (Lorensen and Cline 1987, in the topologically sound
form of Lewiner et al. 2003, from scikit-image) make triangles where all eight points of a cell are known.

Only bricks of 16^3 cells that a surface passes through are computed, each with the layer of points that it shares with
the next, and forgotten once its triangles are there: memory is that of the depth images and of the mesh. Vertices on
shared faces come from the same numbers in both bricks, and are joined by the edge of the lattice that they lie on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import Camera, rigid
from drgs.meshing.options import BRICK

if TYPE_CHECKING:
    from drgs.meshing.depths import DepthView

_SNAP_DISTANCE = 1e-4  # of a cell: a vertex nearer to a lattice point than that is put on it; chosen
_RAY_SAMPLES = 9  # samples of each ray, from `trunc` before its surface to `trunc` behind: a voxel apart at the default
_MOST_BRICKS = 1 << 20  # bricks along an axis to either side, so that three numbers fit into 64 bits


def bricks_of(views: Sequence[DepthView], voxel: float, trunc: float, most: int | None = None) -> np.ndarray:
    """(B, 3) int64 indices of the bricks that a surface may pass through, sorted.

    Bricks smaller than the distance of neighboring rays may be missed; `mesh_of_depths` has none that small.

    Args:
        views: Depth images.
        voxel: Distance of neighboring points of the lattice in scene units.
        trunc: Truncation in scene units.
        most: Looking stops once there are more than this many, and gives what it has found.
    """
    keys = np.zeros(0, np.int64)
    for view in views:
        if most is not None and len(keys) > most:
            break
        keys_of_views = []
        is_solid = np.isfinite(view.depth)
        directions, origins = view.camera.pixel_directions()[is_solid], view.camera.pixel_origins()[is_solid]
        depth = view.depth[is_solid].astype(np.float64)
        for shift in np.linspace(-trunc, trunc, _RAY_SAMPLES):
            at = origins + np.maximum(depth + shift, 0.0)[:, None] * directions
            index = np.floor(at / (voxel * BRICK))
            index = index[(np.abs(index) < _MOST_BRICKS).all(axis=1)].astype(np.int64) + _MOST_BRICKS
            keys_of_views.append(np.unique((index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]))
        keys = np.unique(np.concatenate([keys, *keys_of_views]))
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - _MOST_BRICKS


def _projected(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (P, 2), NaN where a point is not in front, and distances (P,) from where the ray of a point starts."""
    if camera.is_distorted or camera.is_rolling:
        pixels, _ = camera.project(points)
        return pixels, np.linalg.norm(points - camera.center, axis=1)
    rotation, translation = rigid(np.asarray(camera.w2c, np.float64))
    # One axis at a time: a product of matrices would round a point differently in another brick.
    local = [
        sum(points[:, k] * row[k] for k in range(3)) + move for row, move in zip(rotation, translation, strict=True)
    ]
    x, y, z = local
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.where(z > 0, x / z, np.nan)
        v = np.where(z > 0, y / z, np.nan)
    K = camera.K
    pixels = np.stack([K[0, 0] * u + K[0, 1] * v + K[0, 2], K[1, 1] * v + K[1, 2]], axis=1)
    return pixels, np.sqrt(x * x + y * y + z * z)


def sampled(view: DepthView, points: np.ndarray, trunc: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distances and weights of points by one view.

    Depth is interpolated between the four pixels around where their values agree within `trunc`, else it is the nearest
    pixel's: across the edge of an object there is no surface. Within a pixel of an edge a view does not say that a
    point is free, since the pixel beside it says otherwise: every silhouette would take half a pixel off the surface.

    Args:
        view: Its depth image.
        points: (P, 3) float64 world.
        trunc: Truncation in scene units.
    Returns:
        Distance in front of the surface along the ray (P,), infinite where the ray hits nothing solid and NaN outside
        of the image and beside edges; weight (P,); and pixels (P, 2).
    """
    height, width = view.depth.shape
    pixels, distance = _projected(view.camera, points)
    is_inside = view.camera.contains(pixels)
    signed = np.full(len(points), np.nan)
    weight = np.zeros(len(points))
    at = pixels[is_inside]
    if not len(at):
        return signed, weight, pixels
    column, row = at.astype(np.int64).T
    nearest = view.depth[row, column].astype(np.float64)
    left = np.clip(np.floor(at - 0.5), 0, [max(width - 2, 0), max(height - 2, 0)]).astype(np.int64)
    share = np.clip(at - 0.5 - left, 0.0, 1.0)
    x0, y0 = left.T
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    corners = np.stack([view.depth[y, x] for y in (y0, y1) for x in (x0, x1)]).astype(np.float64)
    sx, sy = share.T
    parts = np.stack([(1 - sx) * (1 - sy), sx * (1 - sy), (1 - sx) * sy, sx * sy])
    with np.errstate(invalid="ignore"):
        agree = corners.max(0) - corners.min(0) < trunc
        smooth = (parts * corners).sum(0)
    difference = np.where(agree, smooth, nearest) - distance[is_inside]
    with np.errstate(invalid="ignore"):
        is_at_edge = (difference >= trunc) & (corners.min(0) - distance[is_inside] < trunc)
    signed[is_inside] = np.where(is_at_edge, np.nan, difference)
    weight[is_inside] = view.weight[row, column]
    return signed, weight, pixels


def distances(views: Sequence[DepthView], points: np.ndarray, trunc: float) -> tuple[np.ndarray, np.ndarray]:
    """The fused truncated signed distance. The whole ray of a pixel that hits nothing solid is free, with weight 1.

    Args:
        views: Depth images.
        points: (P, 3) float64 world.
        trunc: Truncation in scene units.
    Returns:
        (P,) float64 in [-1, 1], in units of `trunc`, positive in front of the surface, and (P,) the sum of the weights,
        0 where no view says anything.
    """
    total, weights = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        signed, weight, _ = sampled(view, points, trunc)
        with np.errstate(invalid="ignore"):
            counts = signed >= -trunc  # not NaN, and not hidden
        weight = np.where(np.isinf(signed), 1.0, weight) * counts
        total += weight * np.where(counts, np.minimum(signed / trunc, 1.0), 0.0)
        weights += weight
    return np.where(weights > 0, total / np.maximum(weights, 1e-300), 1.0), weights


def surface(
    views: Sequence[DepthView],
    voxel: float,
    trunc: float,
    *,
    bricks: np.ndarray | None = None,
    advance: Callable[[int], None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64, world, and triangles (F, 3) int64 of the fused surface, seen from outside in
    counter-clockwise order.

    Args:
        views: Depth images.
        voxel: Distance of neighboring points of the lattice in scene units.
        trunc: Truncation in scene units.
        bricks: What `bricks_of` gives; None: it is called here.
        advance: Called with the number of bricks that were done.
    """
    bricks = bricks_of(views, voxel, trunc) if bricks is None else bricks
    cones = [_ViewFrustum.of(view) for view in views]
    offsets = np.stack(np.meshgrid(*[np.arange(BRICK + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    keys, places, faces = [], [], []
    count = 0
    for number, brick in enumerate(bricks, 1):
        points = (brick * BRICK + offsets) * float(voxel)
        middle, reach = points.mean(0), float(np.linalg.norm(np.ptp(points, axis=0)) / 2)
        near = [seen.view for seen in cones if seen.may_see(middle, reach)]
        values, weights = distances(near, points, trunc)
        found = _triangles(values, weights > 0)
        if found is not None:
            local, triangles = found
            keys.append(_edges(brick, local))
            places.append((brick * BRICK + local) * float(voxel))
            faces.append(triangles + count)
            count += len(local)
        if advance:
            advance(number)
    if not faces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    _, first_of, joined = np.unique(np.concatenate(keys), axis=0, return_index=True, return_inverse=True)
    triangles = joined.reshape(-1)[np.concatenate(faces)]
    is_whole = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)  # two corners of others are one point
    return np.concatenate(places)[first_of], triangles[is_whole]


def _triangles(values: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices in cells of the brick and triangles, in cells whose eight points are known; None without any."""
    if values.min() >= 0 or values.max() <= 0 or not known.any():
        return None
    from skimage.measure import marching_cubes

    side = (BRICK + 1,) * 3
    known = known.reshape(side)
    cells = known[:-1, :-1, :-1].copy()
    for x in (0, 1):
        for y in (0, 1):
            for z in (0, 1):
                cells &= known[x : x + BRICK, y : y + BRICK, z : z + BRICK]
    if not cells.any():
        return None
    vertices, triangles, _, _ = marching_cubes(values.reshape(side), 0.0, gradient_direction="descent")
    vertices = vertices.astype(np.float64)
    cell = np.clip(np.floor(vertices[triangles].mean(axis=1)).astype(np.int64), 0, BRICK - 1)
    triangles = triangles[cells[cell[:, 0], cell[:, 1], cell[:, 2]]].astype(np.int64)
    used = np.unique(triangles)
    if not len(used):
        return None
    number = np.zeros(len(vertices), np.int64)
    number[used] = np.arange(len(used))
    whole = np.rint(vertices[used])
    return np.where(np.abs(vertices[used] - whole) < _SNAP_DISTANCE, whole, vertices[used]), number[triangles]


def _edges(brick: np.ndarray, local: np.ndarray) -> np.ndarray:
    """(V, 4) int64 by which vertices of bricks are the same: the point of the lattice below, and which way they lie
    from it, bits of the axes.
    """
    below = np.floor(local)
    way = ((local > below) * np.array([1, 2, 4])).sum(axis=1)
    return np.column_stack([brick * BRICK + below.astype(np.int64), way])


class _ViewFrustum:
    """A view with a fast test of whether a ball may be in its frustum."""

    def __init__(self, view: DepthView, axis: np.ndarray | None, angle: float):
        self.view = view
        self._center = view.camera.center
        self._axis = axis
        self._angle = angle

    @classmethod
    def of(cls, view: DepthView) -> _ViewFrustum:
        """The cone of a pinhole; other lenses see all around."""
        camera = view.camera
        if camera.is_distorted or camera.is_rolling:
            return cls(view, None, np.pi)
        rays = camera.pixel_directions()
        axis = rays[rays.shape[0] // 2, rays.shape[1] // 2]
        corners = rays[[0, 0, -1, -1], [0, -1, 0, -1]]
        return cls(view, axis, float(np.arccos(np.clip((corners @ axis).min(), -1, 1))) + 0.02)

    def may_see(self, middle: np.ndarray, reach: float) -> bool:
        """Whether a ball may be in the image."""
        way = middle - self._center
        distance = float(np.linalg.norm(way))
        if self._axis is None or distance <= reach:
            return True
        angle = float(np.arccos(np.clip(way @ self._axis / distance, -1, 1)))
        return angle < self._angle + float(np.arcsin(reach / distance))
