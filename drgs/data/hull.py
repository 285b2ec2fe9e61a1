"""Where photographs of one moment leave room for something: nothing is where one of them shows what is behind
everything. It is the photo hull of Kutulakos and Seitz (2000) for two colors, the background's and all others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drgs.cameras import Camera
from drgs.data.capture import Focus
from drgs.data.guesses import MASK_KEEP
from drgs.data.views import View

__all__ = ["Hull"]

_FEWEST_VIEWS = 3  # two silhouettes leave most of what is between them
_LEAST_EMPTY = 0.2  # share of the pixels that show the background; below it, it may be a color like others
_BACKGROUND = 0.06  # largest difference of a channel from its color: a sensor's noise, a compressed edge
_WIDTH = 400  # pixels; averages of several are less noisy
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
    def of(cls, views: list[View]) -> Hull | None:
        """The hull of views with images; None where they say nothing about it.

        That is so of fewer than three views, of views of several times, of cameras that do not look at one place, and
        of photographs of whose pixels less than a fifth show the background.
        """
        cameras = [view.camera.undistorted() for view in views]
        focus = Focus.of(cameras) if len(views) >= _FEWEST_VIEWS else None
        if focus is None or len({camera.time for camera in cameras}) > 1:
            return None
        smaller, images, is_empty, counts, reaches = [], [], [], [], []
        for view, camera in zip(views, cameras, strict=True):
            width = min(_WIDTH, camera.width)
            size = (width, max(1, round(camera.height * width / camera.width)))
            smaller.append(camera.resized(*size))
            images.append(view.image(*size))
            behind = np.asarray(view.background, np.float32)
            is_empty.append((np.abs(images[-1] - behind) <= _BACKGROUND).all(axis=2))
            mask = view.mask(*size)
            counts.append(np.ones(size[::-1], bool) if mask is None else mask > MASK_KEEP)
            reaches.append(np.linalg.norm(camera.center - focus.center) * np.hypot(*size) / 2 / smaller[-1].K[0, 0])
        if np.mean([part.mean() for part in is_empty]) < _LEAST_EMPTY:
            return None
        return cls(smaller, images, is_empty, counts, focus.center, float(np.median(reaches)))

    def look(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What photographs show at places (P, 3): (V, P, 3) colors, NaN where one does not show it, and (P,) bool, at
        which some photograph shows the background.
        """
        colors = np.full((len(self.cameras), len(places), 3), np.nan, np.float32)
        is_empty = np.zeros(len(places), bool)
        for index, camera in enumerate(self.cameras):
            pixels, depth = camera.project(places)
            # A place behind a camera projects somewhere, too.
            shown = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
            columns, rows = pixels[shown].astype(np.int64).T
            counted = self.counts[index][rows, columns]
            shown[shown] = counted
            columns, rows = columns[counted], rows[counted]
            colors[index, shown] = self.images[index][rows, columns]
            is_empty[shown] |= self.is_empty[index][rows, columns]
        return colors, is_empty

    def points(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
        """Random places that no photograph shows as empty, among those that at least half as many show as show any.

        Args:
            count: How many at most.
            rng: Generator of the places.
        Returns:
            (P, 3) world points and (P, 3) float32 colors, the medians of what photographs show there; None where
            photographs leave no room that they agree on.
        """
        found, colors, total = [], [], 0
        for _ in range(_ROUNDS):
            places = self.center + self.reach * _in_ball(_ROUND, rng)
            seen, is_empty = self.look(places)
            number = np.isfinite(seen[..., 0]).sum(axis=0)
            keep = ~is_empty & (number >= max(2, number.max() / 2))
            found.append(places[keep])
            colors.append(np.nanmedian(seen[:, keep], axis=0))
            total += int(keep.sum())
            if total >= count:
                break
        if total < min(count, _FEWEST_FOUND):
            return None
        return np.concatenate(found)[:count], np.concatenate(colors)[:count]


def _in_ball(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) uniform in the unit ball."""
    way = rng.normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(size=(count, 1)) ** (1 / 3)
