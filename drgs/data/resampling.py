"""Cameras and pictures brought to another size or lens: that of the photograph, and without distortion."""

from __future__ import annotations

import functools
import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import Camera
from drgs.data.images import image_size

if TYPE_CHECKING:
    import torch

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


# An undistorted border pixel may look this many pixels past the photo before it counts as unseen.
_BORDER = 1.0
# Of an undistorted image, the share that its photo did not see: ordinary lenses leave below a tenth in the corners.
_LOST_WARNED = 0.25
_LOST_MAX = 0.9  # the share from which on nothing useful is left, and the image is refused; chosen
_CHANNELS = 64  # of a feature map that are moved at once: 44 MB of 480x360

_log = logging.getLogger(__name__)


def lens_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """OpenCV remap tables of an undistortion (columns, rows) and the pixels (H,W) bool that the photo did not see.

    Raises:
        ValueError: The photo saw next to nothing of its own undistorted image.
    """
    lens = camera.K.tobytes(), camera.width, camera.height, camera.model, camera.distortion
    columns, rows, unseen, lost = _cached_lens_maps(*lens)
    if lost > _LOST_MAX:
        raise ValueError(
            f"view {camera.name!r}: its lens must show what its undistorted image shows, {lost:.0%} of that lie "
            f"outside the photo or where the lens folds back, got {camera.model} {camera.distortion}; "
            "check the coefficients"
        )
    return columns, rows, unseen


def undistorted_map(values: torch.Tensor, camera: Camera) -> torch.Tensor:
    """A feature map (C, h, w) of a photo as one of its undistorted image, of the same type; some channels at a time."""
    import torch

    h, w = values.shape[1:]
    columns, rows, _ = lens_maps(camera.resized(w, h))
    places = np.stack([(columns + 0.5) * (2 / w) - 1, (rows + 0.5) * (2 / h) - 1], axis=-1)
    # grid_sample wants places of the type of what it samples, here float32: a map has at most thousands of cells.
    grid = torch.from_numpy(places.astype(np.float32))[None]
    moved = torch.empty(values.shape, dtype=values.dtype)
    for start in range(0, len(values), _CHANNELS):
        # In float32: between cells of float16 a weighted sum would keep three digits.
        part = values[start : start + _CHANNELS].float()[None]
        moved[start : start + _CHANNELS] = torch.nn.functional.grid_sample(
            part, grid, mode="bilinear", padding_mode="border", align_corners=False
        )[0]
    return moved


@functools.lru_cache(maxsize=8)
def _cached_lens_maps(
    K: bytes, width: int, height: int, model: str, distortion: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, float]:
    """The tables of `lens_maps`, and the share of pixels that were not seen."""
    matrix = np.frombuffer(K, dtype=np.float64).reshape(3, 3)
    lens = Camera(K=matrix, w2c=np.eye(4), width=width, height=height, model=model, distortion=distortion)
    rays = lens.undistorted().pixel_directions().reshape(-1, 3)
    pixels = lens.project(rays)[0].reshape(height, width, 2)
    x, y = pixels[..., 0], pixels[..., 1]
    unseen = ~((x > -_BORDER) & (x < width + _BORDER) & (y > -_BORDER) & (y < height + _BORDER))
    # Past the radius where the lens polynomial turns back, rays land on pixels that show something
    # else.
    radius = np.hypot(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]).reshape(height, width)
    probe = np.linspace(0.0, radius.max(), 1024)
    spread = lens.project(np.stack([probe, np.zeros(1024), np.ones(1024)], axis=-1))[0][:, 0]
    folds = np.flatnonzero(np.diff(spread) <= 0)
    if len(folds):
        unseen |= radius > probe[folds[0]]
    lost = float(unseen.mean())
    if lost > _LOST_WARNED:
        _log.warning(
            "lens %s %s: %.0f%% of the undistorted image was not seen by the photo%s; check the coefficients",
            model,
            distortion,
            100 * lost,
            ", the lens folds back inside it" if len(folds) else "",
        )
    # OpenCV counts pixel centers at integers; its tables are float32.
    table = np.clip(np.nan_to_num(pixels - 0.5, nan=-1e6), -1e6, 1e6).astype(np.float32)
    return table[..., 0].copy(), table[..., 1].copy(), unseen if unseen.any() else None, lost
