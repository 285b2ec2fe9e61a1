"""Points where nothing is triangulated, guessed: beside what is, or anywhere that cameras look."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from drgs.cameras import Camera
from drgs.data.capture import Focus, scene_extent
from drgs.data.views import View

__all__ = [
    "FEWEST",
    "MASK_KEEP",
    "back_project",
    "empty_share",
    "points_along_rays",
    "points_anywhere",
    "points_beside",
    "subset",
]

FEWEST = 3
"""Triangulated points of a view that say how far away its other pixels may be."""
MASK_KEEP = 0.5
"""Weight in a mask from which on a pixel counts."""
_MOST = 1_000  # triangulated points of a view that are looked at
_NEAREST = 4  # of these in the image, one of which says how far away a pixel is: on this side of an edge or on that
_CELLS = 16  # along each side of an image
_JITTER = 0.05  # relative standard deviation of that distance: surfaces are slanted
_CHUNK = 2_000  # pixels at a time


def points_beside(
    views: list[View], points: np.ndarray, shown: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """About `count` points along random pixels' rays, as far away as triangulated points that the same view shows
    nearby; of a view that shows next to none: as those of the others. Pixels with a triangulated point in their cell of
    a grid get none; the other cells, of all views alike, as many each.

    Args:
        views: Views, at least one.
        points: (P,3) triangulated ones.
        shown: (V,P) which of them each view shows; one shows one at least.
        count: Number of new points.
        rng: Generator of pixels and depths.
    """
    cameras = [view.camera.undistorted() for view in views]
    own = [camera.project(points[mine]) for camera, mine in zip(cameras, shown, strict=True)]
    anywhere = np.concatenate([depth for _, depth in own])
    open_pixels = [
        _open_pixels(view, camera, places) for view, camera, (places, _) in zip(views, cameras, own, strict=True)
    ]
    shares = np.array(
        [len(pixels) / camera.width / camera.height for pixels, camera in zip(open_pixels, cameras, strict=True)]
    )
    # Where no pixel is open all shares are 0, and so are the numbers, not NaN.
    numbers = np.floor(count * np.cumsum(np.append(0, shares)) / max(shares.sum(), 1e-12)).astype(int)
    found, colors = [], []
    for view, camera, (places, depths), allowed, number in zip(
        views, cameras, own, open_pixels, np.diff(numbers), strict=True
    ):
        if not number:
            continue
        pixels = rng.choice(allowed, number)
        if len(depths) >= FEWEST:
            kept = subset(len(depths), _MOST, rng)
            depth = depths[kept][_one_of_nearest(places[kept], pixels, camera.width, rng)]
        else:
            depth = rng.choice(anywhere, number)
        found.append(back_project(camera, pixels, depth * np.exp(_JITTER * rng.normal(size=number))))
        colors.append(view.image().reshape(-1, 3)[pixels])
    if not found:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.float32)
    return np.concatenate(found), np.concatenate(colors)


def empty_share(views: list[View], points: np.ndarray, shown: np.ndarray) -> float:
    """The share of all views' pixels that have no triangulated point in their cell of the grid of `points_beside`."""
    left = whole = 0
    for view, mine in zip(views, shown, strict=True):
        camera = view.camera.undistorted()
        left += len(_open_pixels(view, camera, camera.project(points[mine])[0]))
        whole += camera.width * camera.height
    return left / max(whole, 1)


def _open_pixels(view: View, camera: Camera, places: np.ndarray) -> np.ndarray:
    """Flat indices of the pixels inside the mask in whose cell none of the places (P,2) is."""
    across, down = (-(-size // _CELLS) for size in (camera.width, camera.height))
    taken = np.zeros((_CELLS, _CELLS), bool)
    # Points that project outside count for the cell at the edge: the size need not be a multiple of the cells.
    columns, rows = (places // (across, down)).astype(int).clip(0, _CELLS - 1).T
    taken[rows, columns] = True
    is_open = ~np.kron(taken, np.ones((down, across), bool))[: camera.height, : camera.width]
    if view.mask_path is not None:
        is_open &= view.mask() > MASK_KEEP
    return np.flatnonzero(is_open)


def _one_of_nearest(places: np.ndarray, pixels: np.ndarray, width: int, rng: np.random.Generator) -> np.ndarray:
    """Index, for each flat pixel, of one of the places (P,2) that are nearest to it."""
    centers = np.stack([pixels % width, pixels // width], axis=-1) + 0.5
    count = min(_NEAREST, len(places))
    which = rng.integers(0, count, len(pixels))
    found = np.empty(len(pixels), np.int64)
    for start in range(0, len(pixels), _CHUNK):
        part = slice(start, start + _CHUNK)
        squares = ((centers[part, None] - places[None]) ** 2).sum(axis=2)
        nearest = np.argpartition(squares, count - 1, axis=1)[:, :count]
        found[part] = nearest[np.arange(len(nearest)), which[part]]
    return found


def points_anywhere(views: list[View], count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points along random pixels' rays, kept where at least half as many cameras look as look at the best point, and
    two if two look anywhere.
    """
    cameras = [view.camera.undistorted() for view in views]
    masks = [view.mask() if view.mask_path is not None else None for view in views]
    return points_along_rays(cameras, [view.image if view.has_image else None for view in views], masks, count, rng)


def points_along_rays(
    cameras: list[Camera],
    images: Sequence[Callable[[], np.ndarray] | None],
    masks: Sequence[np.ndarray | None],
    count: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """`points_anywhere` of cameras without a lens: (P, 3) world points, at most `count`, and their (P, 3) colors.

    Args:
        cameras: The cameras that look.
        images: What each of them sees, (H, W, 3) in [0, 1], when it is called; None: gray.
        masks: (H, W) in [0, 1], where points may be; None: everywhere.
        count: Number of points at most.
        rng: Source of all random choices.
    """
    distance = _focus_distance(cameras)
    drawn = 8 * count
    points, colors = [], []
    for index, camera in enumerate(cameras):
        number = drawn // len(cameras) + (index < drawn % len(cameras))
        size = camera.width * camera.height
        allowed = np.arange(size) if masks[index] is None else np.flatnonzero(masks[index] > MASK_KEEP)
        if not len(allowed) or not number:
            continue
        pixels = rng.choice(allowed, number)
        # Uniform in disparity between half and three times the distance: near things need more
        # points.
        depth = 1.0 / rng.uniform(1 / (3 * distance), 2 / distance, number)
        points.append(back_project(camera, pixels, depth))
        image = images[index]
        gray = np.full((number, 3), 0.5, dtype=np.float32)
        colors.append(gray if image is None else image().reshape(-1, 3)[pixels])
    if not points:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.float32)
    points, colors = np.concatenate(points), np.concatenate(colors)
    seen = np.zeros(len(points), dtype=np.int64)
    for camera, mask in zip(cameras, masks, strict=True):
        pixels, _ = camera.project(points)
        inside = (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        if mask is not None:
            columns, rows = pixels[inside].astype(np.int64).T
            inside[inside] = mask[rows, columns] > MASK_KEEP
        seen += inside
    candidates = np.flatnonzero(seen >= max(seen.max() / 2, min(2, seen.max())))
    keep = candidates[subset(len(candidates), count, rng)]
    return points[keep], colors[keep]


def _focus_distance(cameras: list[Camera]) -> float:
    """How far the cameras look: to the point that they look at, if there is one, else their extent."""
    focus = Focus.of(cameras)
    if focus is not None:
        return float(np.median(np.linalg.norm(focus.eyes - focus.center, axis=1)))
    return scene_extent(cameras) * (1.0 if len(cameras) == 1 else 3.0)


def back_project(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """(P,3) world points of flat pixel indices (P,) of the undistorted image at z-depths (P,)."""
    K = camera.K
    y = (pixels // camera.width + 0.5 - K[1, 2]) / K[1, 1]
    x = (pixels % camera.width + 0.5 - K[0, 2] - K[0, 1] * y) / K[0, 0]
    # Depth maps are float32; a world may be far from its origin, where that has no digits left.
    local = np.stack([x, y, np.ones_like(x)], axis=-1) * depth[:, None].astype(np.float64)
    c2w = camera.c2w
    return local @ c2w[:3, :3].T + c2w[:3, 3]


def subset(count: int, limit: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of all, or of `limit` random ones in their order."""
    return np.arange(count) if count <= limit else np.sort(rng.choice(count, limit, replace=False))
