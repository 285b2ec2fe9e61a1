"""`mesh_of`: a surface from Gaussians, cut to what their views determine.

What is left out, in this order: what fewer than `min_views` cameras see; what the information of the known views leaves
more uncertain than `max_spread`; and loose pieces that are small beside the largest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from drgs import fisher
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.meshing.depths import DepthView, depth_views, footprint
from drgs.meshing.fusion import bricks_of, sampled, surface
from drgs.meshing.options import POINTS, MeshOptions
from drgs.runtime import memory
from drgs.settings import RenderSettings

__all__ = ["FINENESS", "TriangleMesh", "deviations_of", "mesh_of", "mesh_of_depths"]

_VIEW_BYTES = 40  # of a pixel of a view: depth, weight, colors, spread, and what sampling them takes
_COLOR_NOISE = 0.05  # standard deviation of a color's noise, of the range of colors; chosen
_VOXEL_GROWTH = 1.26  # the cube root of 2: by which a voxel grows until there are few enough
FINENESS = 2.0
"""The default voxel, in widths of a pixel on the surface; chosen."""
_FINEST = 0.125  # the smallest voxel, in widths of a pixel: neighboring rays must not pass a brick on both sides
_UNSEEN_COLOR = 0.5  # of a vertex that no view shows


@dataclasses.dataclass(frozen=True)
class TriangleMesh:
    """Triangles with colors.

    Attributes:
        vertices: (V, 3) float64, relative to `origin`.
        faces: (F, 3) int64 vertices of each triangle, counter-clockwise seen from outside.
        colors: (V, 3) float32 in [0, 1], as the photographs have them, without a transfer function.
        views: (V,) int32 number of views that see each vertex.
        spread: (V,) float32 standard deviation of the position of what is there, in scene units, as the information of
            the known views has it; None where it is not wanted.
        voxel: Distance of neighboring points of the lattice in scene units.
        trunc: Truncation of the fused distance in scene units.
        origin: (3,) float64, added to the vertices.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    views: np.ndarray
    spread: np.ndarray | None
    voxel: float
    trunc: float
    origin: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))

    def only(self, faces: np.ndarray) -> TriangleMesh:
        """The mesh of some of its triangles: (F,) bool; vertices that none has are left out."""
        kept = self.faces[faces]
        used = np.unique(kept)
        number = np.zeros(len(self.vertices), np.int64)
        number[used] = np.arange(len(used))
        spread = None if self.spread is None else self.spread[used]
        arrays = {name: getattr(self, name)[used] for name in ("vertices", "colors", "views")}
        return dataclasses.replace(self, **arrays, spread=spread, faces=number[kept])

    def areas(self) -> np.ndarray:
        """(F,) float64 areas of the triangles in squares of the scene unit."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    def pieces(self) -> np.ndarray:
        """(F,) int number of the connected piece that each triangle is of."""
        count = len(self.vertices)
        ends = self.faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
        graph = coo_array((np.ones(ends.shape[1], bool), tuple(ends)), shape=(count, count))
        return connected_components(graph, directed=False)[1][self.faces[:, 0]]


def mesh_of(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    settings: RenderSettings | None = None,
    options: MeshOptions | None = None,
    *,
    known: Sequence[Camera] | None = None,
    advance: Callable[[str, int, int], None] | None = None,
) -> TriangleMesh:
    """A surface of triangles from the depth of Gaussians in some views.

        mesh = drgs.meshing.extraction.mesh_of(g, cameras)

    Args:
        gaussians: What is seen; without the Gaussians of a skybox, or else the sky is a surface.
        cameras: Views whose depth is fused; what none of them sees is not in the mesh.
        settings: How they are rendered, default `RenderSettings.preset("exact")`.
        options: Default `MeshOptions()`.
        known: Views whose information says how uncertain the surface is; default the same cameras. Read where
            `options.crop` is above 0.
        advance: Called with a label, the steps done and their number.
    Returns:
        The mesh, around the origin of the Gaussians.
    Raises:
        ModuleNotFoundError: If scikit-image is missing (`pip install 'drgs[mesh]'`).
        ValueError: If no view sees a surface, the lattice would have more than `max_voxels` points, or nothing is left.
    Reference:
        Curless and Levoy 1996 (fusion); Lorensen and Cline 1987 (marching cubes).
    """
    settings = settings or RenderSettings.preset("exact")
    options = options or MeshOptions()
    cameras, known = list(cameras), list(cameras if known is None else known)
    if not cameras:
        raise ValueError("mesh: there must be a view, got none; name cameras")
    pixels = sum(camera.width * camera.height for camera in cameras)
    memory.require("mesh", pixels * _VIEW_BYTES, f"the depth of {len(cameras)} views", "use fewer or smaller views")
    origin = np.asarray(gaussians.origin, np.float64)
    gaussians = gaussians.replace(origin=np.zeros(3))  # the lattice is around its zero, wherever the scene is
    cameras, known = ([camera.relative_to(origin) for camera in some] for some in (cameras, known))
    deviations = None
    if options.crop > 0:
        # What is cut at a voxel needs no exact order, which takes eight times as long and moves deviations by 3 %.
        rough = RenderSettings.preset("fast")
        deviations = deviations_of(gaussians, known, rough, _counter("information", len(known), advance))
    views = depth_views(
        gaussians, cameras, settings, options.depth, deviations, _counter("depth", len(cameras), advance)
    )
    return dataclasses.replace(mesh_of_depths(views, options, advance), origin=origin)


def mesh_of_depths(
    views: Sequence[DepthView],
    options: MeshOptions,
    advance: Callable[[str, int, int], None] | None = None,
) -> TriangleMesh:
    """The surface of depth images: fusion, colors, and cuts where views do not determine it.

    Args:
        views: Depth images; with `spread` where `options.crop` is above 0. The lattice is around 0 and ends at 2^24
            voxels from there: cameras far from 0 are moved there first (`Camera.relative_to`).
        options: How it is made.
        advance: Called with a label, the steps done and their number.
    Raises:
        ValueError: If no view sees a surface, the lattice would have more than `max_voxels` points, or nothing is left.
    """
    voxel, bricks = _lattice(views, options)
    trunc = options.trunc * voxel
    advance_bricks = (lambda done: advance("fusion", done, len(bricks))) if advance else None
    vertices, faces = surface(views, voxel, trunc, bricks=bricks, advance=advance_bricks)
    colors, seen, spread = _attributes(views, vertices, trunc)
    mesh = TriangleMesh(vertices, faces, colors, seen, spread, voxel, trunc)
    is_kept = seen >= options.min_views
    if options.crop > 0 and spread is not None:
        is_kept &= spread <= options.crop * voxel
    mesh = mesh.only(is_kept[faces].all(axis=1))
    if len(mesh.faces) and options.min_piece > 0:
        piece = mesh.pieces()
        area = np.bincount(piece, mesh.areas())
        mesh = mesh.only(area[piece] >= options.min_piece * area.max())
    if not len(mesh.faces):
        raise ValueError(
            f"mesh: something must be left of {len(faces)} triangles, nothing is: views see it too rarely, or know too "
            "little of it; lower --min-views, or set --crop 0"
        )
    return mesh


def deviations_of(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    settings: RenderSettings,
    advance: Callable[[], None] | None = None,
) -> torch.Tensor:
    """(N,) float64 standard deviation of each mean in scene units: sqrt(sum over axes of s^2 / (H + s^2 / l^2)).

    H is the diagonal of the Fisher information of the views about the means for unit noise, s = 0.05 the noise of
    colors, and l, what is known beforehand, the largest scale of the Gaussian: nobody takes it for farther away.

    Args:
        gaussians: N Gaussians.
        cameras: The known views.
        settings: How they are rendered.
        advance: Called after each view.
    """
    total = torch.zeros(len(gaussians), 3, dtype=torch.float64)
    for camera in cameras:
        total += fisher.diagonal(gaussians, camera, settings, groups=("means",))["means"]
        if advance:
            advance()
    reach = gaussians.log_scales.detach().cpu().double().exp().amax(1, keepdim=True)
    return (_COLOR_NOISE**2 / (total + _COLOR_NOISE**2 / reach.square())).sum(1).sqrt()


def _lattice(views: Sequence[DepthView], options: MeshOptions) -> tuple[float, np.ndarray]:
    """Distance of the points of the lattice, and its bricks."""
    width = footprint(views)
    if width is None:
        raise ValueError("mesh: a view must see something solid, none does; do the cameras belong to the scene?")
    voxel = FINENESS * width if options.voxel is None else options.voxel
    if voxel < _FINEST * width:
        raise ValueError(
            f"mesh: --voxel must be at least {_FINEST:g} of a pixel, {_FINEST * width:.3g}, got {voxel:g}"
            "; raise it, or --info-pixels"
        )
    most = options.max_voxels // POINTS
    fits, bricks = voxel, bricks_of(views, voxel, options.trunc * voxel, most)
    if not len(bricks):
        raise ValueError(
            f"mesh: surfaces must lie within 2^24 voxels of {voxel:.3g} from 0, all are farther; give the Gaussians an "
            "origin there, or move the cameras of depth images by Camera.relative_to"
        )
    while len(bricks) > most:
        fits *= _VOXEL_GROWTH
        bricks = bricks_of(views, fits, options.trunc * fits, most)
    if options.voxel is not None and fits > voxel:
        raise ValueError(
            f"mesh: the lattice must have at most {options.max_voxels} points, voxels of {voxel:g} take more; "
            f"raise --max-voxels, or --voxel to about {fits:.3g}"
        )
    return fits, bricks


def _attributes(
    views: Sequence[DepthView], vertices: np.ndarray, trunc: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Colors (V, 3), number of views (V,) and least spread (V,) of vertices, from the views that see them."""
    count = len(vertices)
    colors, weights = np.zeros((count, 3)), np.zeros(count)
    seen = np.zeros(count, np.int32)
    spread = np.full(count, np.inf, np.float32) if any(view.spread is not None for view in views) else None
    for view in views:
        signed, weight, pixels = sampled(view, vertices, trunc)
        with np.errstate(invalid="ignore"):
            index = np.flatnonzero(np.abs(signed) < trunc)
        column, row = pixels[index].astype(np.int64).T
        colors[index] += weight[index, None] * view.rgb[row, column]
        weights[index] += weight[index]
        seen[index] += 1
        if spread is not None and view.spread is not None:
            spread[index] = np.minimum(spread[index], view.spread[row, column])
    shown = np.where(weights[:, None] > 0, colors / np.maximum(weights, 1e-30)[:, None], _UNSEEN_COLOR)
    return shown.clip(0, 1).astype(np.float32), seen, spread


def _counter(label: str, total: int, advance: Callable[[str, int, int], None] | None) -> Callable[[], None] | None:
    """A callback that counts the steps of a stage."""
    if advance is None:
        return None
    done = iter(range(1, total + 1))
    return lambda: advance(label, next(done), total)
