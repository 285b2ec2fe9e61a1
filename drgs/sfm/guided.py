"""Points from photographs with known poses: features matched along epipolar lines, then triangulated.

Where poses are known, a feature's partner lies on one line of the other picture, before both cameras, as large and as
turned as its distance says. That leaves few candidates, so that a match needs to be less alike than one sought in the
whole picture, and views further apart can be matched.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.sfm.matching import Progress

# Chosen by hand; on two views 70 degrees apart, where matching over the whole picture finds nothing, they give 582
# points (commit 6bf76a85). No study varied them.
_MAX_FEATURES = 6000  # features of a picture, the strongest
_MIN_CONTRAST = 0.02  # half of OpenCV's default: weak features still match along a line
_EPIPOLAR_BAND = 3.0  # pixels from the epipolar line
_MIN_TRIANGULATION_ANGLE = 2.0  # degrees between the two rays
# between the sizes of a feature in the two pictures, after the ratio of the distances is taken out
_MAX_SCALE_RATIO = 2.0
_MAX_ROTATION = 45.0  # degrees between the directions of a feature in the two pictures
_MIN_SIMILARITY = 0.8  # scalar product of RootSIFT descriptors, which have length 1
_MAX_RATIO = 0.9  # Lowe's ratio: descriptor distance, of that to the next best candidate on the line
_DISTINCT_DISTANCE = 6.0  # pixels from the best candidate from which on another counts as the next best
_FEATURES_AT_ONCE = 1000  # features whose candidates are compared at once: bounds memory


@dataclasses.dataclass(frozen=True)
class Features:
    """SIFT features of one picture.

    Attributes:
        camera: Pinhole.
        pixels: (N, 2) float64.
        sizes: (N,) pixels.
        angles: (N,) radians, from +x towards +y.
        descriptors: (N, 128) float32 of length 1.
        colors: (N, 3) float32.
    """

    camera: Camera
    pixels: np.ndarray
    sizes: np.ndarray
    angles: np.ndarray
    descriptors: np.ndarray
    colors: np.ndarray

    def rays(self) -> np.ndarray:
        """(N, 3) world directions of length 1."""
        K = self.camera.K
        y = (self.pixels[:, 1] - K[1, 2]) / K[1, 1]
        x = (self.pixels[:, 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.camera.w2c[:3, :3]
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def detect(camera: Camera, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
    """SIFT features of a picture.

    Args:
        camera: Pinhole, of the image's size.
        image: (H, W, 3) in [0, 1].
        mask: (H, W) bool of where they may lie.
    """
    import cv2

    # Luma of BT.601, as OpenCV makes it. Rounding may lead above 255, which a byte would wrap around.
    gray = np.round(255 * image @ np.array([0.299, 0.587, 0.114], image.dtype)).clip(0, 255).astype(np.uint8)
    sift = cv2.SIFT_create(nfeatures=_MAX_FEATURES, contrastThreshold=_MIN_CONTRAST)
    points, descriptors = sift.detectAndCompute(gray, None if mask is None else mask.astype(np.uint8))
    points = points[:_MAX_FEATURES]
    descriptors = np.zeros((0, 128), np.float32) if descriptors is None else descriptors[:_MAX_FEATURES]
    pixels = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.5
    # A descriptor may be all 0.
    rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
    # SIFT refines places to fractions of a pixel, which may leave the image.
    columns, rows = (np.clip(pixels[:, i].astype(int), 0, image.shape[1 - i] - 1) for i in (0, 1))
    return Features(
        camera,
        pixels,
        np.array([point.size for point in points], np.float64),
        np.radians([point.angle for point in points]),
        rooted.astype(np.float32),
        image[rows, columns].astype(np.float32),
    )


@dataclasses.dataclass(frozen=True)
class Triangulated:
    """Points that two or more of V pictures show.

    Attributes:
        points: (P, 3) float64, world.
        colors: (P, 3) float32 in [0, 1].
        shown: (V, P) bool, which picture shows which point.
    """

    points: np.ndarray
    colors: np.ndarray
    shown: np.ndarray

    @classmethod
    def none(cls, pictures: int) -> Triangulated:
        """No point."""
        return cls(np.empty((0, 3)), np.empty((0, 3), np.float32), np.empty((pictures, 0), bool))

    def only(self, kept: np.ndarray) -> Triangulated:
        """Some of the points, by (P,) bool."""
        return Triangulated(self.points[kept], self.colors[kept], self.shown[:, kept])


class Matches:
    """Pictures and what has been matched between them, so that one more costs only its own pairs.

    Attributes:
        pictures: Pictures in the order in which they were added.
    """

    def __init__(self):
        self.pictures: list[Features] = []
        self._matched: dict[tuple[int, int], tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def match(self, pairs: list[tuple[int, int]], progress: Progress | None = None) -> None:
        """Match pairs of pictures (i, j) that have not been matched yet; `progress` gets ("matching", done, total)."""
        left = [pair for pair in pairs if pair not in self._matched]
        for done, (i, j) in enumerate(left):
            if progress:
                progress("matching", done, len(left))
            self._matched[i, j] = _match(self.pictures[i], self.pictures[j])
        if progress:
            progress("matching", len(left), len(left))

    def triangulate(self, pairs: list[tuple[int, int]]) -> Triangulated:
        """The points of the matches of these pairs; matches that share a feature make one point.

        What else was matched, when there were fewer pictures, is left out: points then depend on the pictures alone,
        not on how many of them came at once, and a fit that was killed and resumed has those of one that was not.
        """
        starts = np.cumsum([0] + [len(picture.pixels) for picture in self.pictures])
        matched = [(pair, self._matched[pair]) for pair in sorted(pairs)]
        if not sum(len(points) for _, (_, _, points) in matched):
            return Triangulated.none(len(self.pictures))
        edges = [np.stack([a + starts[i], b + starts[j]], axis=-1) for (i, j), (a, b, _) in matched]
        points = [points for _, (_, _, points) in matched]
        return _tracks(self.pictures, starts, np.concatenate(edges), np.concatenate(points))


def _match(a: Features, b: Features) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of features that are each other's best partner, and the point (3,) of each such pair."""
    nothing = np.empty(0, int), np.empty(0, int), np.empty((0, 3))
    baseline = b.camera.center - a.camera.center
    if not len(a.pixels) or not len(b.pixels) or not np.linalg.norm(baseline) > 0:
        return nothing
    relative = b.camera.w2c @ a.camera.c2w
    x, y, z = relative[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
    F = np.linalg.inv(b.camera.K).T @ essential @ np.linalg.inv(a.camera.K)
    # float32: the product below has as many numbers as there are pairs, and its band is pixels wide.
    homogeneous = _homogeneous(b.pixels).astype(np.float32)
    rays_a, rays_b = a.rays(), b.rays()
    rows = []
    columns = []
    likeness = []
    for start in range(0, len(a.pixels), _FEATURES_AT_ONCE):
        lines = _homogeneous(a.pixels[start : start + _FEATURES_AT_ONCE]) @ F.T
        # The line of the epipole itself is 0, and near everything.
        lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
        near = np.abs(lines.astype(np.float32) @ homogeneous.T) < _EPIPOLAR_BAND
        i, j = np.nonzero(near)
        i += start
        rows.append(i)
        columns.append(j)
        likeness.append(np.einsum("nd,nd->n", a.descriptors[i], b.descriptors[j]))
    i = np.concatenate(rows)
    j = np.concatenate(columns)
    likeness = np.concatenate(likeness)
    keep = _best(i, likeness, b.pixels[j], len(a.pixels))
    keep &= _best(j, likeness, a.pixels[i], len(b.pixels))
    i, j = i[keep], j[keep]
    points, depth_a, depth_b, angle = _meet(a.camera.center, b.camera.center, rays_a[i], rays_b[j])
    # Rays that meet at a camera center have a depth of 0; the sign of the depths drops them below.
    with np.errstate(divide="ignore", invalid="ignore"):
        size = (a.sizes[i] * depth_a / a.camera.K[0, 0]) / (b.sizes[j] * depth_b / b.camera.K[0, 0])
    good = (depth_a > 0) & (depth_b > 0) & (angle > _MIN_TRIANGULATION_ANGLE)
    good &= (size > 1 / _MAX_SCALE_RATIO) & (size < _MAX_SCALE_RATIO)
    # A direction in the picture of a, as one of the world, as one in the picture of b.
    world = np.stack([np.cos(a.angles[i]), np.sin(a.angles[i]), 0 * a.angles[i]], axis=-1) @ a.camera.w2c[:3, :3]
    local = world @ b.camera.w2c[:3, :3].T
    turn = np.arctan2(local[:, 1], local[:, 0]) - b.angles[j]
    good &= np.cos(turn) > np.cos(np.radians(_MAX_ROTATION))
    return i[good], j[good], points[good]


def _homogeneous(pixels: np.ndarray) -> np.ndarray:
    """(N, 3) homogeneous coordinates of (N, 2) pixels."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)


def _best(owner: np.ndarray, likeness: np.ndarray, pixels: np.ndarray, count: int) -> np.ndarray:
    """(C,) bool: candidates that are their owner's best one, alike enough, and clearly more than the next best one
    somewhere else.
    """
    best = np.full(count, -1.0, np.float32)
    np.maximum.at(best, owner, likeness)
    is_best = likeness >= best[owner]
    place = np.zeros((count, 2))
    place[owner[is_best]] = pixels[is_best]
    elsewhere = np.abs(pixels - place[owner]).max(axis=1) > _DISTINCT_DISTANCE
    second = np.full(count, -1.0, np.float32)
    np.maximum.at(second, owner[elsewhere], likeness[elsewhere])
    # |d - e|^2 = 2 - 2 d e
    clear = 1 - best < _MAX_RATIO**2 * (1 - second)
    return is_best & (best > _MIN_SIMILARITY)[owner] & clear[owner]


def _meet(
    eye_a: np.ndarray, eye_b: np.ndarray, rays_a: np.ndarray, rays_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where pairs of rays pass nearest to each other (N, 3), the distances along them, the angles in degrees."""
    between = (rays_a * rays_b).sum(axis=1)
    baseline = eye_b - eye_a
    along_a, along_b = rays_a @ baseline, rays_b @ baseline
    sine = np.maximum(1 - between**2, 1e-12)  # of parallel rays, which the caller drops by their angle
    depth_a = (along_a - between * along_b) / sine
    depth_b = (between * along_a - along_b) / sine
    points = 0.5 * (eye_a + depth_a[:, None] * rays_a + eye_b + depth_b[:, None] * rays_b)
    # The product of two directions of length 1 exceeds 1 by rounding, of which arccos is NaN.
    return points, depth_a, depth_b, np.degrees(np.arccos(np.clip(between, -1, 1)))


def _tracks(pictures: list[Features], starts: np.ndarray, edges: np.ndarray, points: np.ndarray) -> Triangulated:
    """Matches that share features make one point: that of the match which most of their pictures agree with.

    Args:
        pictures: All of them.
        starts: (V + 1,) number of the first feature of each.
        edges: (E, 2) numbers of the features that are matched.
        points: (E, 3) where.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pixels = np.concatenate([picture.pixels for picture in pictures])
    picture_of = np.repeat(np.arange(len(pictures)), np.diff(starts))
    # Every match's point against the features that its two are matched with, which are the two themselves as well.
    ends = np.concatenate([edges, edges[:, ::-1]])
    # Stable: edges of one end stay in the order in which they were found, so that tracks do, too.
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    first = np.searchsorted(ends[:, 0], edges)
    count = np.searchsorted(ends[:, 0], edges, side="right") - first
    match = np.repeat(np.repeat(np.arange(len(edges)), 2), count.ravel())
    begun = np.cumsum(count.ravel()) - count.ravel()
    member = ends[np.repeat(first.ravel() - begun, count.ravel()) + np.arange(len(match)), 1]
    match, member = np.unique(np.stack([match, member], axis=-1), axis=0).T
    agrees = np.zeros(len(match), bool)
    for index, picture in enumerate(pictures):
        mine = np.flatnonzero(picture_of[member] == index)
        projected, depth = picture.camera.project(points[match[mine]])
        agrees[mine] = (depth > 0) & (np.linalg.norm(projected - pixels[member[mine]], axis=1) < _EPIPOLAR_BAND)
    match, member = match[agrees], member[agrees]
    views = np.unique(np.stack([match, picture_of[member]], axis=-1), axis=0)  # two features of one picture count once
    support = np.bincount(views[:, 0], minlength=len(edges))
    # A chance match ties two points together. Two pictures agree with it, more with what each of the two really is.
    most = np.zeros(len(pixels), int)
    np.maximum.at(most, edges.ravel(), np.repeat(support, 2))
    kept = np.flatnonzero((support >= 3) | ((support == 2) & (most[edges] == 2).all(axis=1)))
    if not len(kept):
        return Triangulated.none(len(pictures))
    links = coo_array((np.ones(len(kept), bool), tuple(edges[kept].T)), shape=(len(pixels), len(pixels)))
    label = connected_components(links, directed=False)[1][edges[kept, 0]]
    order = np.lexsort((-support[kept], label))
    chosen = kept[order[np.append(True, np.diff(label[order]) > 0)]]
    # The point nearest to the rays of all that agree; they meet at an angle (_match), so that no system is singular.
    number = np.full(len(edges), -1)
    number[chosen] = np.arange(len(chosen))
    mine = number[match] >= 0
    match, member = number[match[mine]], member[mine]
    rays = np.concatenate([picture.rays() for picture in pictures])[member]
    eyes = np.stack([picture.camera.center for picture in pictures])[picture_of[member]]
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    A = np.zeros((len(chosen), 3, 3))
    b = np.zeros((len(chosen), 3))
    color = np.zeros((len(chosen), 3), np.float32)
    np.add.at(A, match, across)
    np.add.at(b, match, (across @ eyes[:, :, None])[:, :, 0])
    np.add.at(color, match, np.concatenate([picture.colors for picture in pictures])[member])
    nearest = np.linalg.solve(A, b[:, :, None])[:, :, 0]
    shown = np.zeros((len(pictures), len(chosen)), bool)
    shown[picture_of[member], match] = True
    return Triangulated(nearest, color / np.bincount(match)[:, None].astype(np.float32), shown)
