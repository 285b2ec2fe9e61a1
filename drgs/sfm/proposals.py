"""Points proposed where nothing is triangulated: beside what is, in the visual hull, or anywhere that cameras look."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drgs.cameras import Camera
from drgs.data.camera_layout import Focus, scene_extent
from drgs.data.masks import MASK_KEEP
from drgs.data.views import View

FEWEST = 3
"""Triangulated points of a view that say how far away its other pixels may be."""
_MAX_POINTS_PER_VIEW = 1_000  # triangulated points of a view that are used: bounds time; chosen
_NEAREST_IN_IMAGE = 4  # of these, one of which, at random, gives a pixel's distance: on this side of an edge or on that
# cells along each side of an image; pixels in a cell without a triangulated point get proposals. Chosen
_CELLS_PER_SIDE = 16
_DISTANCE_JITTER = 0.05  # relative standard deviation of that distance: surfaces are slanted; chosen
_PIXELS_AT_ONCE = 2_000  # pixels compared with the points at once: bounds memory


def propose_near_triangulated(
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
        _uncovered_pixels(view, camera, places) for view, camera, (places, _) in zip(views, cameras, own, strict=True)
    ]
    shares = np.array(
        [len(pixels) / camera.width / camera.height for pixels, camera in zip(open_pixels, cameras, strict=True)]
    )
    # Where no pixel is open all shares are 0, and so are the numbers, not NaN.
    numbers = np.floor(count * np.cumsum(np.append(0, shares)) / max(shares.sum(), 1e-12)).astype(int)
    proposed, colors = [], []
    for view, camera, (places, depths), allowed, number in zip(
        views, cameras, own, open_pixels, np.diff(numbers), strict=True
    ):
        if not number:
            continue
        pixels = rng.choice(allowed, number)
        if len(depths) >= FEWEST:
            kept = random_subset(len(depths), _MAX_POINTS_PER_VIEW, rng)
            depth = depths[kept][_one_of_nearest(places[kept], pixels, camera.width, rng)]
        else:
            depth = rng.choice(anywhere, number)
        proposed.append(back_project(camera, pixels, depth * np.exp(_DISTANCE_JITTER * rng.normal(size=number))))
        colors.append(view.image().reshape(-1, 3)[pixels])
    if not proposed:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.float32)
    return np.concatenate(proposed), np.concatenate(colors)


def uncovered_share(views: list[View], points: np.ndarray, shown: np.ndarray) -> float:
    """The share of all views' pixels that have no triangulated point in their cell of a 16 x 16 grid on the image."""
    left = whole = 0
    for view, mine in zip(views, shown, strict=True):
        camera = view.camera.undistorted()
        left += len(_uncovered_pixels(view, camera, camera.project(points[mine])[0]))
        whole += camera.width * camera.height
    return left / max(whole, 1)


def _uncovered_pixels(view: View, camera: Camera, places: np.ndarray) -> np.ndarray:
    """Flat indices of the pixels inside the mask in whose cell none of the places (P,2) is."""
    across, down = (-(-size // _CELLS_PER_SIDE) for size in (camera.width, camera.height))
    taken = np.zeros((_CELLS_PER_SIDE, _CELLS_PER_SIDE), bool)
    # Points that project outside count for the cell at the edge: the size need not be a multiple of the cells.
    columns, rows = (places // (across, down)).astype(int).clip(0, _CELLS_PER_SIDE - 1).T
    taken[rows, columns] = True
    is_open = ~np.kron(taken, np.ones((down, across), bool))[: camera.height, : camera.width]
    if view.mask_path is not None:
        is_open &= view.mask() > MASK_KEEP
    return np.flatnonzero(is_open)


def _one_of_nearest(places: np.ndarray, pixels: np.ndarray, width: int, rng: np.random.Generator) -> np.ndarray:
    """Index, for each flat pixel, of one of the places (P,2) that are nearest to it."""
    centers = np.stack([pixels % width, pixels // width], axis=-1) + 0.5
    count = min(_NEAREST_IN_IMAGE, len(places))
    which = rng.integers(0, count, len(pixels))
    chosen = np.empty(len(pixels), np.int64)
    for start in range(0, len(pixels), _PIXELS_AT_ONCE):
        part = slice(start, start + _PIXELS_AT_ONCE)
        squares = ((centers[part, None] - places[None]) ** 2).sum(axis=2)
        nearest = np.argpartition(squares, count - 1, axis=1)[:, :count]
        chosen[part] = nearest[np.arange(len(nearest)), which[part]]
    return chosen


def propose_in_view(views: list[View], count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points along random pixels' rays, kept where at least half as many cameras look as look at the best point, and
    two if two look anywhere.
    """
    cameras = [view.camera.undistorted() for view in views]
    masks = [view.mask() if view.mask_path is not None else None for view in views]
    return propose_along_rays(cameras, [view.image if view.has_image else None for view in views], masks, count, rng)


def propose_along_rays(
    cameras: list[Camera],
    images: Sequence[Callable[[], np.ndarray] | None],
    masks: Sequence[np.ndarray | None],
    count: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """`propose_in_view` of cameras without a lens: (P, 3) world points, at most `count`, and their (P, 3) colors.

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
        inside = camera.contains(pixels)
        if mask is not None:
            columns, rows = pixels[inside].astype(np.int64).T
            inside[inside] = mask[rows, columns] > MASK_KEEP
        seen += inside
    candidates = np.flatnonzero(seen >= max(seen.max() / 2, min(2, seen.max())))
    keep = candidates[random_subset(len(candidates), count, rng)]
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


def random_subset(count: int, limit: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of all, or of `limit` random ones in their order."""
    return np.arange(count) if count <= limit else np.sort(rng.choice(count, limit, replace=False))


# ---------------------------------------------------------------- visual hull

_FEWEST_VIEWS = 3  # silhouettes: two leave most of what is between them
# share of the pixels that show the background; below it, it may be a color like others. Chosen
_MIN_BACKGROUND_SHARE = 0.2
# largest difference of a channel, of 1, from the background: noise, a compressed edge. Chosen
_BACKGROUND_TOLERANCE = 0.06
_BACKGROUND_PROBES = 8  # photographs that decide whether there is a background at all
_SILHOUETTE_WIDTH = 400  # pixels across a silhouette: means of several pixels have less noise
# share of the photographs showing a point whose silhouettes may exclude it: edges are soft. Chosen
_MAX_CONTRADICTING = 0.1
_POINTS_PER_ROUND = 50_000  # random points a round: bounds memory
_MAX_ROUNDS = 40  # rounds, at most: 2 million points in all
_FEWEST_POINTS = 100  # points of all rounds; fewer mean that the silhouettes do not agree


@dataclass(frozen=True)
class VisualHull:
    """Where photographs of one moment leave room for something: nothing is where one of them shows the background. It
    is the photo hull of Kutulakos and Seitz (2000) for two colors, the background's and all others.

    A photograph shows a place as empty where its pixel has the color that is behind everything (`View.background`):
    then its whole ray is empty, or looks as if it were.

    Attributes:
        cameras: Those of the images below, without lenses.
        images: (H, W, 3) each.
        is_empty: (H, W) bool each, which pixels show the background.
        counts: (H, W) bool each, which pixels are inside the view's mask.
        center: (3,) where the cameras look, world.
        reach: Half the diagonal of what a camera sees at that distance, world units.
    """

    cameras: list[Camera]
    images: list[np.ndarray]
    is_empty: list[np.ndarray]
    counts: list[np.ndarray]
    center: np.ndarray
    reach: float

    @classmethod
    def of(cls, views: list[View], progress: Callable[[str, int, int], None] | None = None) -> VisualHull | None:
        """The hull of views with images; None where they say nothing about it.

        That is so of fewer than three views, of views of several times, of cameras that do not look at one place, and
        of photographs of whose pixels less than a fifth show the background, by eight of them.

        Args:
            views: Views with images.
            progress: Callback, as `initial_points` takes it.
        """
        cameras = [view.camera.undistorted() for view in views]
        focus = Focus.of(cameras) if len(views) >= _FEWEST_VIEWS else None
        if focus is None or len({camera.time for camera in cameras}) > 1:
            return None
        if progress:
            progress("silhouettes", 0, len(views))
        some = views[:: -(-len(views) // _BACKGROUND_PROBES)]
        if (
            np.mean([_is_background(view, view.image(*_size(view.camera))).mean() for view in some])
            < _MIN_BACKGROUND_SHARE
        ):
            return None
        smaller, images, is_empty, counts, reaches = [], [], [], [], []
        for number, (view, camera) in enumerate(zip(views, cameras, strict=True)):
            size = _size(camera)
            smaller.append(camera.resized(*size))
            images.append(view.image(*size))
            is_empty.append(_is_background(view, images[-1]))
            mask = view.mask(*size)
            counts.append(np.ones(size[::-1], bool) if mask is None else mask > MASK_KEEP)
            reaches.append(np.linalg.norm(camera.center - focus.center) * np.hypot(*size) / 2 / smaller[-1].K[0, 0])
            if progress:
                progress("silhouettes", number + 1, len(views))
        return cls(smaller, images, is_empty, counts, focus.center, float(np.median(reaches)))

    def support(self, places: np.ndarray) -> np.ndarray:
        """(P,) how many photographs show each of places (P, 3), where none of these shows the background; else -1."""
        number = np.zeros(len(places), np.int64)
        left = np.arange(len(places))  # a point that one silhouette excludes need not be tested by the next
        for index in range(len(self.cameras)):
            shown, columns, rows = self._pixels(index, places[left])
            number[left[shown]] += 1
            contradicted = np.zeros(len(left), bool)
            contradicted[shown] = self.is_empty[index][rows, columns]
            number[left[contradicted]] = -1
            left = left[~contradicted]
        return number

    def is_contradicted(self, places: np.ndarray) -> np.ndarray:
        """(P,) bool, whether more than a tenth of the photographs that show places (P, 3) show the background there.

        For places that two others agree about: of a hundred photographs some show each point of a surface at the edge
        of its silhouette, where a pixel decides.
        """
        contradictions, number = np.zeros((2, len(places)))
        for index in range(len(self.cameras)):
            shown, columns, rows = self._pixels(index, places)
            number[shown] += 1
            contradictions[shown] += self.is_empty[index][rows, columns]
        return contradictions > _MAX_CONTRADICTING * number

    def colors(self, places: np.ndarray) -> np.ndarray:
        """(P, 3) float32 medians of what photographs show at places (P, 3), each of which one shows."""
        seen = np.full((len(self.cameras), len(places), 3), np.nan, np.float32)
        for index in range(len(self.cameras)):
            shown, columns, rows = self._pixels(index, places)
            seen[index, shown] = self.images[index][rows, columns]
        return np.nanmedian(seen, axis=0)

    def points(
        self, count: int, rng: np.random.Generator, progress: Callable[[str, int, int], None] | None = None
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Random places that no photograph shows as empty, of these the ones that at least half as many show as show
        any.

        Args:
            count: How many at most.
            rng: Generator of the places.
            progress: Callback, as `initial_points` takes it.
        Returns:
            (P, 3) world points and (P, 3) float32 colors, the medians of what photographs show there; None where
            photographs leave no room that they agree on.
        """
        kept, total = [], 0
        for _ in range(_MAX_ROUNDS):
            places = self.center + self.reach * _in_ball(_POINTS_PER_ROUND, rng)
            number = self.support(places)
            kept.append(places[number >= max(2, number.max() / 2)])
            total += len(kept[-1])
            if progress:
                progress("room for points", min(total, count), count)
            if total >= count:
                break
        if total < min(count, _FEWEST_POINTS):
            return None
        points = np.concatenate(kept)[:count]
        return points, self.colors(points)

    def _pixels(self, index: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which places (P, 3) a photograph shows inside its mask, and the columns and rows of these."""
        camera = self.cameras[index]
        pixels, depth = camera.project(places)
        # A place behind a camera projects somewhere, too.
        shown = camera.contains(pixels, depth)
        columns, rows = pixels[shown].astype(np.int64).T
        counted = self.counts[index][rows, columns]
        shown[shown] = counted
        return shown, columns[counted], rows[counted]


def _size(camera: Camera) -> tuple[int, int]:
    """Width and height of its silhouette, px."""
    width = min(_SILHOUETTE_WIDTH, camera.width)
    return width, max(1, round(camera.height * width / camera.width))


def _is_background(view: View, image: np.ndarray) -> np.ndarray:
    """(H, W) bool, which pixels of an image have the color of the background."""
    return (np.abs(image - np.asarray(view.background, np.float32)) <= _BACKGROUND_TOLERANCE).all(axis=2)


def _in_ball(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) uniform in the unit ball."""
    way = rng.normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(size=(count, 1)) ** (1 / 3)
