"""Sizes of views: the size at which their images are used."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.shutters import BY_COLUMN, FORWARD


def reduced_size(camera: Camera, max_pixels: int) -> tuple[int, int]:
    """(width, height) of a camera's image at no more than `max_pixels` pixels, and never larger than it is."""
    scale = min(1.0, math.sqrt(max_pixels / (camera.width * camera.height)))
    return max(1, int(camera.width * scale)), max(1, int(camera.height * scale))


def at_most(camera: Camera, pixels: int) -> Camera:
    """The camera with its image reduced to at most so many pixels; itself where it has no more."""
    if camera.width * camera.height <= pixels:
        return camera
    return camera.resized(*reduced_size(camera, pixels))


def by_share(camera: Camera, share: float) -> Camera:
    """The camera with a share of its width and of its height, a pixel of each at least."""
    if share == 1:
        return camera
    return camera.resized(max(1, round(camera.width * share)), max(1, round(camera.height * share)))


def cropped(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    """A camera that shows a part of another one's image: column `x` and row `y` of that are its first ones.

    Of a rolling shutter each line keeps the pose that it has in the whole; poses are then numbers.
    """
    K = np.array(camera.K, float)
    K[:2, 2] -= x, y
    part = dataclasses.replace(camera, K=K, width=width, height=height)
    if not camera.is_rolling:
        return part
    start, count = (x, width) if camera.shutter in BY_COLUMN else (y, height)
    poses = camera.line_poses()[start : start + count]
    first, last = (poses[0], poses[-1]) if camera.shutter in FORWARD else (poses[-1], poses[0])
    return dataclasses.replace(part, w2c=first, w2c_end=last)


def resized_alike(camera: Camera, sizes: dict[tuple[int, int], tuple[int, int]]) -> Camera:
    """The camera at the size that its image probably has: images reduced after calibration are reduced alike.

    Args:
        camera: Camera of the size that the camera file states.
        sizes: Stated (width, height) -> (width, height) of the file, for images that have been opened.
    """
    size = sizes.get((camera.width, camera.height))
    return camera.resized(*size) if size else camera
