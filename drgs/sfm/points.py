"""Initial points of a scene: the data set's own, from depth maps, triangulated, or proposed (proposals.py)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from drgs.cameras import at_first_time
from drgs.data.dataset import Dataset
from drgs.data.masks import MASK_KEEP
from drgs.data.views import View
from drgs.display.progress import Bar
from drgs.sfm.guided import Matches, Triangulated, detect
from drgs.sfm.match_cache import cached
from drgs.sfm.matching import Progress, nearby_pairs
from drgs.sfm.proposals import (
    FEWEST,
    VisualHull,
    back_project,
    propose_in_view,
    propose_near_triangulated,
    random_subset,
    uncovered_share,
)

__all__ = [
    "added_points",
    "at_first",
    "initial_points",
    "matched_points",
    "shared_points",
    "triangulated_count",
    "triangulated_points",
]

_MIN_TRIANGULATED = 50  # points: fewer may be chance matches, and nothing is proposed beside them
_ENOUGH_TRIANGULATED = 2_000  # triangulated points that need no others beside them; chosen, not tuned
_MAX_RANDOM = 20_000  # points where nothing is known: density control moves them to where they are needed
_MATCHED_NEIGHBORS = 10  # photographs that each one is matched with, the nearest by place and direction; chosen
_FEATURE_SIZE = 1600  # pixels of the longer side that features are detected at, as for structure from motion
_MAX_COMPARED_POINTS = 20_000  # points of depth maps that photographs are compared by; chosen: bounds time
_MAX_DEPTH_MAPS = 100  # photographs, at most, whose depth maps they are drawn from: every map is read twice
# cells along the longer side of a photograph; a cell's nearest point hides what is behind it. Chosen
_OCCLUSION_CELLS = 20
# relative difference of depth to the nearest point of a cell; larger lets hidden points pass behind thin things
_TRACK_DEPTH_TOLERANCE = 0.01
_MAP_DEPTH_TOLERANCE = 0.05  # relative difference of depth to a depth map: sensors are wrong by 1 to 3 %


def initial_points(
    data: Dataset | list[View],
    seed: int = 0,
    max_points: int = 100_000,
    progress: Progress | None = None,
    matches: Matches | None = None,
    train: list[View] | None = None,
) -> tuple[np.ndarray, np.ndarray, str]:
    """Points to start Gaussians from, by the first way that works.

    The data set's own points; back-projected depth maps; SIFT features triangulated with the given poses, and points
    proposed along the rays of pixels that have none of these near, as far away as what is triangulated beside them;
    random points where the cameras look. Given a list of views, nothing but these is read, as active runs need it. Of
    synchronous cameras of a data set, those that are held out are not read. What moves has points where it was at
    first: of views at several times, those at the first one are read, unless they are from one place (a single camera
    that moves: then all).

    Args:
        data: a data set, or views (then there are no given points).
        seed: Seed of all random choices.
        max_points: Number of points at most.
        progress: Called with (stage, done, total) while triangulating.
        matches: Gets the features and matches, if there are any, which `shared_points` goes on with.
        train: Views along whose rays points are proposed for pixels that have none of the data set's own points near,
            where it has their tracks; None: none are proposed.
    Returns:
        points (P,3) float64, colors (P,3) float32 in [0,1], and where they come from, one line.
    """
    rng = np.random.default_rng(seed)
    if isinstance(data, Dataset):
        views = at_first(data.split()[0] if data.camera_names else data.views)  # not of cameras that are held out
    else:
        views = at_first(list(data))
    if not views:
        raise ValueError("initial_points: there must be at least one view, got none; pass the training views")
    if isinstance(data, Dataset) and data.points is not None and len(data.points):
        return _own_points(data, train, max_points, rng, progress)
    if any(view.depth_path is not None for view in views):
        points, colors = _from_depth(views, max_points, rng)
        if len(points):
            used = sum(view.depth_path is not None for view in views)
            return points, colors, f"back-projected from {used} depth maps, holes filled, {len(points)} points"
    tried = ""
    if len(views) >= 2 and all(view.has_image for view in views):
        matches = matches or Matches()
        triangulated = cached(views, lambda: _triangulated(views, matches, progress))
        points, colors = _completed(views, triangulated, seed, max_points, progress)
        count = len(triangulated.points)
        if len(points):
            source = f"triangulated from {len(views)} given poses, {count} points"
            return points, colors, f"{source}; {len(points)} with proposed ones where there are none"
        tried = f" (triangulation gave {count})"
        hull = VisualHull.of(views, progress)
        room = None if hull is None else hull.points(min(max_points, _MAX_RANDOM), rng, progress)
        if room is not None:
            return *room, f"random where none of {len(views)} cameras sees the background, {len(room[0])} points{tried}"
    points, colors = propose_in_view(views, min(max_points, _MAX_RANDOM), rng)
    return points, colors, f"random where {len(views)} cameras look, {len(points)} points{tried}"


def _own_points(
    data: Dataset, train: list[View] | None, max_points: int, rng: np.random.Generator, progress: Progress | None
) -> tuple[np.ndarray, np.ndarray, str]:
    """`initial_points` of a data set that has points."""
    points = data.points
    assert points is not None  # checked
    colors = data.colors if data.colors is not None else np.full(points.shape, 0.5, dtype=np.float32)
    if train and data.tracks is not None:
        tracked, shown = _tracked(*data.tracks, train)
        if len(tracked) >= _MIN_TRIANGULATED:
            proposer = _Proposer(train, VisualHull.of(train, progress), max_points, rng, progress)
            points, colors = proposer.completed(points, colors, tracked, shown)
            return points, colors, f"{data.point_source}; {len(points)} with proposed ones where there are none"
    keep = random_subset(len(points), max_points, rng)
    note = "" if len(keep) == len(points) else f", {len(keep)} kept"
    return points[keep], colors[keep], f"{data.point_source}{note}"


def triangulated_points(
    views: list[View], seed: int, max_points: int, matches: Matches, progress: Progress | None = None
) -> tuple[np.ndarray, np.ndarray, int]:
    """Points to start Gaussians from that all of these views together show, without depth maps.

    Args:
        views: Views with images, at least two.
        seed: Seed of all random choices.
        max_points: Number of points at most.
        matches: Matches, as `added_points` takes them.
        progress: Callback, as `initial_points` takes it.
    Returns:
        points (P,3) float64 and colors (P,3) float32: those triangulated, and where images have none of them, proposed
        ones as far away as those beside; no point at all, if fewer than 50 are triangulated. Third, how many are,
        before any is left out.
    """
    triangulated = _triangulated(views, matches, progress)
    return *_completed(views, triangulated, seed, max_points, progress), len(triangulated.points)


def _completed(
    views: list[View], triangulated: Triangulated, seed: int, max_points: int, progress: Progress | None
) -> tuple[np.ndarray, np.ndarray]:
    """Points and colors of `triangulated_points`."""
    if len(triangulated.points) < _MIN_TRIANGULATED:
        return triangulated.points[:0], triangulated.colors[:0]
    hull = VisualHull.of(views, progress)
    if hull is not None:
        # Two photographs agreed about what others say is not there.
        triangulated = triangulated.only(~hull.is_contradicted(triangulated.points))
    proposer = _Proposer(views, hull, max_points, np.random.default_rng(seed), progress)
    return proposer.completed(triangulated.points, triangulated.colors, triangulated.points, triangulated.shown)


@dataclasses.dataclass(frozen=True)
class _Proposer:
    """Proposes points where images have none.

    Attributes:
        views: V views.
        hull: Their visual hull, in which points are proposed if there is one, else along rays.
        max_points: Number of all points at most.
        rng: Source of all random choices.
        progress: Callback, as `initial_points` takes it.
    """

    views: list[View]
    hull: VisualHull | None
    max_points: int
    rng: np.random.Generator
    progress: Progress | None

    def completed(
        self, points: np.ndarray, colors: np.ndarray, tracked: np.ndarray, shown: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points and colors, (P, 3) each, and proposed ones behind them.

        Args:
            points, colors: (P, 3) each.
            tracked: (N, 3) points of which it is known which views show them: all, or some.
            shown: (V, N) bool, which view shows which of these.
        """
        # What no two views show would stay empty: density control does not leave what there is. Proposed points are as
        # dense as what is triangulated, at most as many, but together they are enough; and the budget is shared by
        # area.
        share = uncovered_share(self.views, tracked, shown)
        # Where all is empty, the share of what is not is 0.
        as_dense = len(points) * min(1.0, share / max(1 - share, 1e-9))
        count = round(min(max(_ENOUGH_TRIANGULATED - len(points), as_dense), share * self.max_points))
        keep = random_subset(len(points), self.max_points - count, self.rng)
        room = None if self.hull is None else self.hull.points(count, self.rng, self.progress)
        more, more_colors = room or propose_near_triangulated(self.views, tracked, shown, count, self.rng)
        return np.concatenate([points[keep], more]), np.concatenate([colors[keep], more_colors])


def matched_points(
    views: list[View], matches: Matches, progress: Progress | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) points that two or more of V views show, as far as they are triangulated, and (V, P) bool of which show
    which; arguments as of `triangulated_points`.
    """
    triangulated = _triangulated(views, matches, progress)
    return triangulated.points, triangulated.shown


def shared_points(
    dataset: Dataset,
    views: list[View],
    seed: int = 0,
    matches: Matches | None = None,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Points that photographs are compared by, and which photographs show them: by projecting alone, a point that
    something hides would be taken for what hides it.

    By the first way that there is: tracks of the data set, depth maps, features that are matched.

    Args:
        dataset: The data set, for its tracks.
        views: V views of it, still, with images; nothing of others is read.
        seed: Seed of the pixels that are drawn from depth maps.
        matches: Matches between these views, as `initial_points` filled them; empty ones are made here, which takes
            seconds. None: nothing is matched.
        progress: Callback, as `initial_points` takes it.
    Returns:
        Points (P, 3) and (V, P) bool; None where nothing says what hides them.
    """
    if dataset.tracks is not None:
        return _shown_beside(views, *_tracked(*dataset.tracks, views))
    if any(view.depth_path is not None for view in views):
        return _shown_by_depth(views, np.random.default_rng(seed))
    if matches is None or len(views) < 2:
        return None
    triangulated = cached(views, lambda: _triangulated(views, matches, progress))
    return _shown_beside(views, triangulated.points, triangulated.shown)


def triangulated_count(views: list[View], matches: Matches, progress: Progress | None = None) -> int:
    """The third value of `triangulated_points` alone."""
    return len(_triangulated(views, matches, progress).points)


def at_first(views: list[View]) -> list[View]:
    """Those of `drgs.cameras.at_first_time`."""
    return [views[i] for i in at_first_time([view.camera for view in views])] if views else views


def added_points(
    views: list[View],
    seed: int,
    matches: Matches,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Points that the last view adds to what those before it show, without depth maps.

    Args:
        views: Views, at least one; nothing but these is read.
        seed: Seed of all random choices.
        matches: Features and matches of the first ones of these views, by earlier calls; those of the others are added.
        progress: Callback, as `initial_points` takes it.
    Returns:
        points (P,3) float64 and colors (P,3) float32: first those triangulated with the last view, whose number is the
        third value, then proposed ones: along rays of the last view as far away as what is triangulated near them, or,
        where these are next to none, random ones where the views look.
    """
    triangulated = _triangulated(views, matches, progress)
    mine = triangulated.shown[-1]
    own = triangulated.only(mine)
    rng = np.random.default_rng(seed)
    if mine.sum() >= FEWEST:
        more, more_colors = propose_near_triangulated(
            views[-1:], triangulated.points, triangulated.shown[-1:], _MAX_RANDOM, rng
        )
    else:
        more, more_colors = propose_in_view(views, _MAX_RANDOM, rng)
    return np.concatenate([own.points, more]), np.concatenate([own.colors, more_colors]), int(mine.sum())


# -------------------------------------------------- depth


def _from_depth(views: list[View], limit: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Back-projected pixels, an even share a view, at most `limit`.

    Not thinned in space: what is close to many cameras gets many points, and that is where pixels are to be explained.
    (Voxels of even size gave most points to the walls of a room and 4 dB less on the still life.)
    """
    with_depth = [view for view in views if view.depth_path is not None]
    share = max(1, limit // len(with_depth))
    points, colors = [], []
    for view in with_depth:
        depth, mask = view.depth(), view.mask()
        if not (depth > 0).any():
            continue
        # A sensor sees no depth at edges, on dark and on far surfaces: 40 % of the pixels of an office. Without a
        # point there, nothing ever grows there; the nearest known depth is a fair start.
        depth = _filled(depth)
        valid = np.ones(depth.shape, bool) if mask is None else mask > MASK_KEEP
        pixels = np.flatnonzero(valid)
        if not len(pixels):
            continue
        # A random phase on a regular step through the valid pixels: even, without the grid's moire
        # between views.
        step = max(1.0, len(pixels) / share)
        chosen = pixels[np.arange(rng.uniform(0, min(step, len(pixels))), len(pixels), step).astype(np.int64)]
        points.append(back_project(view.camera, chosen, depth.reshape(-1)[chosen]))
        if not view.has_image:
            colors.append(np.full((len(chosen), 3), 0.5, dtype=np.float32))
        else:
            colors.append(view.image().reshape(-1, 3)[chosen])
    if not points:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.float32)
    return np.concatenate(points)[:limit], np.concatenate(colors)[:limit]


def _tracked(points: np.ndarray, tracks: Mapping[str, np.ndarray], views: list[View]) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points whose tracks contain one of V views, and (V, N) bool, the views of each track."""
    mine = [tracks.get(view.name, np.empty(0, np.int64)) for view in views]
    kept = np.unique(np.concatenate(mine))
    shown = np.zeros((len(views), len(kept)), bool)
    for row, track in enumerate(mine):
        shown[row, np.searchsorted(kept, track)] = True
    return points[kept], shown


def _shown_beside(views: list[View], points: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points, and which views show them: `shown`, and where they are as far away as the nearest point that the view
    shows by its tracks in their part of the picture. Tracks alone are short: errors add up from one to the next.
    """
    visible = shown.copy()
    for row, view in enumerate(views):
        inside, pixels, depth = _inside(view, points)
        cells = (pixels * _OCCLUSION_CELLS / max(view.camera.width, view.camera.height)).astype(int) @ (
            1,
            _OCCLUSION_CELLS,
        )
        nearest = np.full(_OCCLUSION_CELLS * _OCCLUSION_CELLS, np.inf)
        mine = shown[row, inside]
        np.minimum.at(nearest, cells[mine], depth[mine])
        visible[row, inside[np.abs(depth / nearest[cells] - 1) < _TRACK_DEPTH_TOLERANCE]] = True
    return points, visible


def _shown_by_depth(views: list[View], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points of depth maps, an even share a map, and which views show them, by their own depth maps."""
    points = []
    some = views[:: -(-len(views) // _MAX_DEPTH_MAPS)]
    share = -(-_MAX_COMPARED_POINTS // len(some))
    for view in some:
        if (depth := view.depth()) is not None:
            known = np.flatnonzero(depth)
            pixels = rng.choice(known, min(share, len(known)), replace=False)
            points.append(back_project(view.camera, pixels, depth.reshape(-1)[pixels]))
    drawn = np.concatenate([np.empty((0, 3)), *points])
    shown = np.zeros((len(views), len(drawn)), bool)
    for row, view in enumerate(views):
        if (depth := view.depth()) is not None:
            inside, pixels, own = _inside(view, drawn)
            columns, rows = pixels.astype(int).T
            shown[row, inside] = np.abs(depth[rows, columns] / own - 1) < _MAP_DEPTH_TOLERANCE
    return drawn, shown


def _inside(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the points in a view's picture, their pixels (N, 2) and depths (N,)."""
    camera = view.shown_camera
    pixels, depth = camera.project(points)
    inside = np.flatnonzero(camera.contains(pixels, depth))
    return inside, pixels[inside], depth[inside]


def _filled(depth: np.ndarray) -> np.ndarray:
    """(H,W) depth with every unknown pixel (<= 0) set to the depth of the nearest known one."""
    import cv2

    unknown = (depth <= 0).astype(np.uint8)
    # Labels number the known pixels, and every pixel carries the label of the nearest one.
    _, label = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    known = np.zeros(label.max() + 1, depth.dtype)
    known[label[unknown == 0]] = depth[unknown == 0]
    return known[label]


def _triangulated(views: list[View], matches: Matches, progress: Progress | None) -> Triangulated:
    """SIFT features inside the masks, matched along the epipolar lines of the given poses and triangulated."""
    import cv2

    new = views[len(matches.pictures) :]
    for done, view in enumerate(new):
        if progress:
            progress("features", done, len(new))
        camera = view.camera.undistorted()
        scale = min(1.0, _FEATURE_SIZE / max(camera.width, camera.height))
        camera = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        mask = view.mask(camera.width, camera.height)
        if mask is not None:
            # Features reach past their center; a few pixels of margin keep the outline itself out.
            mask = cv2.erode((mask > MASK_KEEP).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        matches.pictures.append(detect(camera, view.image(camera.width, camera.height), mask))
    if progress:
        progress("features", len(new), len(new))
    poses = np.stack([picture.camera.c2w for picture in matches.pictures])
    pairs = nearby_pairs(poses[:, :3, 3], poses[:, :3, 2], _MATCHED_NEIGHBORS)
    matches.match(pairs, progress)
    with Bar("triangulation"):
        return matches.triangulate(pairs)
