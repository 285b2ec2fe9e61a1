"""Cameras and pictures brought to the size of the photograph: data sets are often reduced after calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.data.checks import image_size

if TYPE_CHECKING:
    from drgs.cameras import Camera

__all__ = ["ASPECT_TOLERANCE", "fit_to_image", "nearest_resized", "resize_area", "resized_to"]

ASPECT_TOLERANCE = 0.01  # of the shape of an image against that of its camera


def fit_to_image(camera: Camera, path: Path, where: str, lazy: bool = False) -> Camera:
    """The camera at the size of its image file, from the file's header.

    Data sets are often downscaled after calibration, so K is scaled when the shapes agree to 1 %. With `lazy` the file
    must exist, but is not opened, and the camera stays as it is.

    Raises:
        FileNotFoundError: No such image.
        ValueError: Not an image, or another shape.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{where}: the image {path} must exist, found none; restore it or drop the view")
    if lazy:
        return camera
    return resized_to(camera, image_size(path), path, where)


def resized_to(camera: Camera, size: tuple[int, int], path: Path, where: str) -> Camera:
    """The camera at the size (width, height) that an image or video has.

    Raises:
        ValueError: Another shape, by more than 1 %.
    """
    width, height = size
    if (width, height) == (camera.width, camera.height):
        return camera
    if abs(width * camera.height / (height * camera.width) - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"{where}: the image {path} must have the shape of its camera "
            f"({camera.width}x{camera.height}), "
            f"got {width}x{height}; give this view its own intrinsics"
        )
    return camera.resized(width, height)


def nearest_resized(data: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    """A mask, label image or depth map (H,W) at the size (width, height) of its image, without mixing pixels.

    Args:
        path: The file that it is of, for the message.
    Raises:
        ValueError: Another shape than the image's, by more than 1 %.
    """
    import cv2

    height, width = data.shape
    if abs(width * size[1] / (height * size[0]) - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"{path}: must have the shape of its image ({size[0]}x{size[1]}), got {width}x{height}; export it again"
        )
    return data if (width, height) == size else cv2.resize(data, size, interpolation=cv2.INTER_NEAREST_EXACT)


def resize_area(data: np.ndarray, width: int, height: int) -> np.ndarray:
    """An image or mask (H,W) or (H,W,C) at another size; pixels are averaged where it shrinks."""
    import cv2

    if data.shape[1::-1] == (width, height):
        return np.ascontiguousarray(data)
    shrinks = width <= data.shape[1] and height <= data.shape[0]
    return cv2.resize(data, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
