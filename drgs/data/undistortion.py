"""Where each pixel of an undistorted image lies in its photograph."""

from __future__ import annotations

import functools
import logging
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import Camera

if TYPE_CHECKING:
    import torch

__all__ = ["lens_maps", "undistorted_map"]

# An undistorted border pixel may look this many pixels past the photo before it counts as unseen.
_BORDER = 1.0
# Of an undistorted image, the share that its photo did not see: ordinary lenses leave below a tenth in the corners.
_LOST_WARNED = 0.25
_LOST_MAX = 0.9
_CHANNELS = 64  # of a feature map that are moved at once: 44 MB of 480x360

_log = logging.getLogger(__name__)


def lens_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """OpenCV remap tables of an undistortion (columns, rows) and the pixels (H,W) bool that the photo did not see.

    Raises:
        ValueError: The photo saw next to nothing of its own undistorted image.
    """
    *maps, lost = _cached_lens_maps(camera.K.tobytes(), camera.width, camera.height, camera.model, camera.distortion)
    if lost > _LOST_MAX:
        raise ValueError(
            f"view {camera.name!r}: its lens must show what its undistorted image shows, {lost:.0%} of that lie "
            f"outside the photo or where the lens folds back, got {camera.model} {camera.distortion}; "
            "check the coefficients"
        )
    return tuple(maps)


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
