"""Where photographs of one moment leave room for something: nothing is where one of them shows what is behind
everything. It is the photo hull of Kutulakos and Seitz (2000) for two colors, the background's and all others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drgs.cameras import Camera
from drgs.data.capture import Focus
from drgs.data.views import View
from drgs.sfm.proposals import MASK_KEEP

__all__ = ["Hull"]

_FEWEST_VIEWS = 3  # two silhouettes leave most of what is between them
_LEAST_EMPTY = 0.2  # share of the pixels that show the background; below it, it may be a color like others
_BACKGROUND = 0.06  # largest difference of a channel from its color: a sensor's noise, a compressed edge
_SOME = 8  # photographs that say whether there is a background at all
_WIDTH = 400  # pixels; averages of several are less noisy
_DENIED = 0.1  # of the photographs that show a place, part that may deny what two have agreed about: edges are soft
_ROUND = 50_000  # places at a time
_ROUNDS = 40
_FEWEST_FOUND = 100  # of all rounds; fewer say that silhouettes do not agree


@dataclass(frozen=True)
class Hull:
    """What photographs say about where nothing is.

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
    def of(cls, views: list[View], progress: Callable[[str, int, int], None] | None = None) -> Hull | None:
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
        some = views[:: -(-len(views) // _SOME)]
        if np.mean([_is_behind(view, view.image(*_size(view.camera))).mean() for view in some]) < _LEAST_EMPTY:
            return None
        smaller, images, is_empty, counts, reaches = [], [], [], [], []
        for number, (view, camera) in enumerate(zip(views, cameras, strict=True)):
            size = _size(camera)
            smaller.append(camera.resized(*size))
            images.append(view.image(*size))
            is_empty.append(_is_behind(view, images[-1]))
            mask = view.mask(*size)
            counts.append(np.ones(size[::-1], bool) if mask is None else mask > MASK_KEEP)
            reaches.append(np.linalg.norm(camera.center - focus.center) * np.hypot(*size) / 2 / smaller[-1].K[0, 0])
            if progress:
                progress("silhouettes", number + 1, len(views))
        return cls(smaller, images, is_empty, counts, focus.center, float(np.median(reaches)))

    def room(self, places: np.ndarray) -> np.ndarray:
        """(P,) how many photographs show each of places (P, 3), where none of these shows the background; else -1."""
        number = np.zeros(len(places), np.int64)
        left = np.arange(len(places))  # what one photograph shows as empty need not be looked at in the next
        for index in range(len(self.cameras)):
            shown, columns, rows = self._pixels(index, places[left])
            number[left[shown]] += 1
            denied = np.zeros(len(left), bool)
            denied[shown] = self.is_empty[index][rows, columns]
            number[left[denied]] = -1
            left = left[~denied]
        return number

    def is_denied(self, places: np.ndarray) -> np.ndarray:
        """(P,) bool, whether more than a tenth of the photographs that show places (P, 3) show the background there.

        For places that two others agree about: of a hundred photographs some show each point of a surface at the edge
        of its silhouette, where a pixel decides.
        """
        denials, number = np.zeros((2, len(places)))
        for index in range(len(self.cameras)):
            shown, columns, rows = self._pixels(index, places)
            number[shown] += 1
            denials[shown] += self.is_empty[index][rows, columns]
        return denials > _DENIED * number

    def colors(self, places: np.ndarray) -> np.ndarray:
        """(P, 3) float32 medians of what photographs show at places (P, 3), each of which one shows."""
        found = np.full((len(self.cameras), len(places), 3), np.nan, np.float32)
        for index in range(len(self.cameras)):
            shown, columns, rows = self._pixels(index, places)
            found[index, shown] = self.images[index][rows, columns]
        return np.nanmedian(found, axis=0)

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
        found, total = [], 0
        for _ in range(_ROUNDS):
            places = self.center + self.reach * _in_ball(_ROUND, rng)
            number = self.room(places)
            found.append(places[number >= max(2, number.max() / 2)])
            total += len(found[-1])
            if progress:
                progress("room for points", min(total, count), count)
            if total >= count:
                break
        if total < min(count, _FEWEST_FOUND):
            return None
        points = np.concatenate(found)[:count]
        return points, self.colors(points)

    def _pixels(self, index: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which places (P, 3) a photograph shows inside its mask, and the columns and rows of these."""
        camera = self.cameras[index]
        pixels, depth = camera.project(places)
        # A place behind a camera projects somewhere, too.
        shown = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        columns, rows = pixels[shown].astype(np.int64).T
        counted = self.counts[index][rows, columns]
        shown[shown] = counted
        return shown, columns[counted], rows[counted]


def _size(camera: Camera) -> tuple[int, int]:
    """Width and height at which its photograph is looked at."""
    width = min(_WIDTH, camera.width)
    return width, max(1, round(camera.height * width / camera.width))


def _is_behind(view: View, image: np.ndarray) -> np.ndarray:
    """(H, W) bool, which pixels of an image have the color of the background."""
    return (np.abs(image - np.asarray(view.background, np.float32)) <= _BACKGROUND).all(axis=2)


def _in_ball(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) uniform in the unit ball."""
    way = rng.normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(size=(count, 1)) ** (1 / 3)
