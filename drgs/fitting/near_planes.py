"""A warning where other renderers' near planes cut a scene: they are in world units, for worlds as COLMAP scales them.

`inria` leaves out what is nearer than 0.2 world units, `gsplat` and `3dgut` 0.01, as the systems do that they stand
for. In a world of kilometers that is all there is. `exact` and `fast` have no near plane.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.data.camera_layout import REFERENCE_EXTENT, scene_extent

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.settings import RenderSettings

_WARNED_SHARE = 0.05  # of what photographs show; captures in COLMAP's units lose less than 0.01 to 0.2. Chosen
_MOST_CAMERAS, _MOST_POINTS = 16, 10_000  # evenly chosen ones: a share needs no more
_log = logging.getLogger("drgs.train")


def share_cut(near: float, cameras: Sequence[Camera], points: np.ndarray) -> float:
    """Share of the points in photographs that a near plane cuts, nearer to the camera's plane; 0 where none is shown.

    Args:
        near: Distance of the near plane, world units.
        cameras: Cameras of the photographs.
        points: (P, 3) world points.
    """
    shown = cut = 0
    for camera in cameras[:: -(-len(cameras) // _MOST_CAMERAS)]:
        pixels, depth = camera.project(points[:: -(-len(points) // _MOST_POINTS)])
        inside = camera.contains(pixels, depth)
        shown += int(inside.sum())
        cut += int((depth[inside] < near).sum())
    return cut / shown if shown else 0.0


def warn_of_near_planes(
    renderers: Mapping[str, RenderSettings], cameras: Sequence[Camera], points: np.ndarray | None
) -> None:
    """Log the renderers whose near plane cuts a scene, and by how much its world must be scaled.

    Args:
        renderers: Name -> settings.
        cameras: Cameras of the photographs, at least one.
        points: (P, 3) world points that they show; None: not known, and nothing is said.
    """
    if points is None or not len(points):
        return
    shares = {name: share_cut(x.near, cameras, points) for name, x in renderers.items() if x.near > 0}
    cut = {name: share for name, share in shares.items() if share > _WARNED_SHARE}
    if not cut:
        return
    named = ", ".join(f"{name} {share:.0%} (near {renderers[name].near:g})" for name, share in cut.items())
    factor = 10 ** round(math.log10(REFERENCE_EXTENT / scene_extent(list(cameras), points)))
    remedy = f"multiply positions of cameras and points by about {factor:g}; " if factor > 1 else ""
    _log.warning(
        "near planes cut the points that photographs show: %s; %sexact and fast (--for drgs) have none", named, remedy
    )
