"""A picture in steps: a small one first, then one as large as the browser shows, a band of rows at a time.

Between two steps the worker may turn to something else, so that a browser whose camera has moved waits for one band of
the picture that is no longer wanted, not for all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from drgs.ellipsoids import colors_only
from drgs.integrator import render
from drgs.sizes import at_most, cropped

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene
    from drgs.integrator import Output
    from drgs.settings import RenderSettings

__all__ = ["Done", "Steps", "bands", "drawn", "over", "stages"]


class Done(NamedTuple):
    """How far a picture is.

    Attributes:
        share: Share that is done.
        rows: (h, W, 3) uint8 rows from the top that are done; None where colors are not known before the end.
    """

    share: float
    rows: np.ndarray | None = None


Steps = Generator[Done, None, np.ndarray]
"""Yields its progress between its steps, and returns what it has made."""

_FIRST = 16_000  # pixels of the first picture
_BAND = 48_000  # pixels that are drawn in one step


def stages(camera: Camera, most: int) -> list[Camera]:
    """The cameras of one view in the order in which they are drawn: a small picture, then one of `most` pixels.

    Args:
        camera: The view, as large as the browser's window.
        most: Largest number of pixels; no picture is larger than the window either.
    """
    last = at_most(camera, most)
    first = at_most(camera, _FIRST)
    return [first, last] if 2 * first.width * first.height < last.width * last.height else [last]


def bands(camera: Camera, pixels: int = _BAND) -> list[Camera]:
    """Cameras that show the rows of a view from top to bottom, each at most so many pixels, but a row at least."""
    rows = max(1, pixels // camera.width)
    parts = []
    for top in range(0, camera.height, rows):
        parts.append(cropped(camera, 0, top, camera.width, min(rows, camera.height - top)))
    return parts


def drawn(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    read: Callable[[Output], np.ndarray],
    features: bool = False,
    colors: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Steps:
    """What `read` takes of the rendering of a view, (H, W, ...).

    Args:
        scene: What is drawn.
        camera: The view, as large as the picture.
        settings: Render settings.
        read: Function that takes a band's rendering, with its depth, and returns rows of the picture.
        features: Whether it reads the features, which else cost nothing.
        colors: What makes rows of the picture of that, where a row does not depend on others.
    """
    parts = []
    shown: list[np.ndarray] = []
    with torch.no_grad():  # a picture is looked at only; a graph would keep every band's intermediates
        seen = scene.at(camera.time) if features else colors_only(scene.at(camera.time), None)
    below = 0
    for part in bands(camera):
        with torch.no_grad():  # entered for each band: between two of them the thread does other work
            parts.append(read(render(seen, part, settings, ("depth",))))
        below += part.height
        if colors is not None:
            shown.append(colors(parts[-1]))
        yield Done(below / camera.height, np.concatenate(shown) if shown else None)
    return np.concatenate(parts)


def over(before: np.ndarray, rows: np.ndarray, height: int) -> np.ndarray:
    """(height, W, 3) uint8 picture whose first rows are done, over a smaller one of the same view.

    Args:
        before: (h, w, 3) uint8 smaller picture.
        rows: (r, W, 3) uint8 rows that are done.
        height: H.
    """
    import cv2

    picture = cv2.resize(before, (rows.shape[1], height), interpolation=cv2.INTER_LINEAR)
    picture[: len(rows)] = rows
    return picture
