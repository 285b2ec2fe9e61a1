"""Sizes of views: how large their images are looked at."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drgs.cameras import Camera

__all__ = ["at_most", "reduced_size", "resized_alike"]


def reduced_size(camera: Camera, max_pixels: int) -> tuple[int, int]:
    """(width, height) of a camera's image at no more than `max_pixels` pixels, and never larger than it is."""
    scale = min(1.0, math.sqrt(max_pixels / (camera.width * camera.height)))
    return max(1, int(camera.width * scale)), max(1, int(camera.height * scale))


def at_most(camera: Camera, pixels: int) -> Camera:
    """The camera with its image reduced to at most so many pixels."""
    return camera.resized(*reduced_size(camera, pixels))


def resized_alike(camera: Camera, sizes: dict[tuple[int, int], tuple[int, int]]) -> Camera:
    """The camera at the size that its image probably has: images reduced after calibration are reduced alike.

    Args:
        camera: Camera of the size that the camera file states.
        sizes: Stated (width, height) -> (width, height) of the file, for images that have been opened.
    """
    size = sizes.get((camera.width, camera.height))
    return camera.resized(*size) if size else camera
