"""What color photographs with an alpha channel are composited on, if nobody says: by their edges, then by layout."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drgs.data.checks import read_image, unit_range
from drgs.data.image_headers import png_has_alpha

if TYPE_CHECKING:
    from drgs.data.dataset import Dataset
    from drgs.data.views import View

__all__ = ["default_background"]

_PHOTOGRAPHS = 8  # whose edges are looked at, evenly spaced
_SOLID = 0.995  # alpha from which on a pixel shows the object alone
_EDGE = (0.2, 0.8)  # alpha of pixels that show both
_LEAST_EDGE = 200  # color values of edges below which these say nothing
_BRIGHTNESS = (0.8, 1.25)  # of edges, in that of the object beside them, which is shaded differently there
_CLEAR = 0.5  # share of the error of unmixed colors below which a mix is clear: 0.05 to 0.4 where one was made
_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def default_background(dataset: Dataset, lazy: bool = False) -> tuple[tuple[float, float, float], str]:
    """The color to composite the photographs of a data set on, and why, in words; no words where none has alpha.

    Colors of half-transparent pixels should be those of the object. If they are clearly mixed with black or white, the
    object was cut out of photographs on that color, and another one behind it would leave a rim. Otherwise data of
    Blender's and D-NeRF's layout (`transforms_train.json`) are put on white, as the other readers of these data do, and
    all others on black.

    Args:
        dataset: Its training views are looked at, PNGs alone.
        lazy: Open none but the first training view, and of that the header alone.
    Returns:
        RGB in [0, 1], and one line.
    """
    views = [view for view in dataset.split()[0] if view.image_path is not None]
    views = [view for view in (views[:1] if lazy else views) if png_has_alpha(view.image_path)]
    if not views:
        return _COLORS["black"], ""
    found = "" if lazy else _mixed_with(views[:: -(-len(views) // _PHOTOGRAPHS)])
    if found:
        return _COLORS[found], f"{found}, which half-transparent pixels at the edges of objects are mixed with"
    if dataset.format == "transforms" and dataset.path.is_dir() and not (dataset.path / "transforms.json").is_file():
        return _COLORS["white"], "white, as readers of Blender's and D-NeRF's data sets take it"
    return _COLORS["black"], "black"


def _mixed_with(views: list[View]) -> str:
    """`black` or `white` if colors of half-transparent pixels are clearly mixed with it, else empty."""
    parts = [_edges(view) for view in views]
    alpha, object_color, color = (np.concatenate(x) for x in zip(*parts, strict=True))
    if len(color) < _LEAST_EDGE:
        return ""

    def error(base: np.ndarray, ground: np.ndarray | float) -> float:
        """Mean absolute error of the colors as `base`, as bright as fits best, over the ground."""
        factor = np.dot(base, color - ground) / max(np.dot(base, base), 1e-12)
        return float(np.abs(color - ground - np.clip(factor, *_BRIGHTNESS) * base).mean())

    errors = {"black": error(alpha * object_color, 0.0), "white": error(alpha * object_color, 1 - alpha)}
    best = min(errors, key=errors.__getitem__)
    return best if errors[best] < _CLEAR * error(object_color, 0.0) else ""


def _edges(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(P,) alpha, color of the object beside it, and color, of each channel of half-transparent pixels of a photo."""
    import cv2

    assert view.image_path is not None
    data = unit_range(read_image(view.image_path), view.image_path)
    if data.ndim != 3 or data.shape[2] != 4:
        return (np.empty(0, np.float32),) * 3
    color, alpha = data[..., :3], data[..., 3]
    solid = (alpha >= _SOLID).astype(np.float32)
    # Sums over 5x5 pixels; nothing is added beyond the border.
    count, total = (
        cv2.boxFilter(x, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for x in (solid, color * solid[..., None])
    )
    chosen = (alpha > _EDGE[0]) & (alpha < _EDGE[1]) & (count >= 3)
    beside = total[chosen] / count[chosen][:, None]
    return np.repeat(alpha[chosen], 3), beside.ravel(), color[chosen].ravel()
