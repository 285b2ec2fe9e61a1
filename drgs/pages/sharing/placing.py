"""Where a page's camera stands: at the photographs, in a world that is upright."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from drgs.cameras import Camera

PhotoKind = Literal["fitted", "next", "other"]
"""A photograph, a photograph to take next, or a view of a scene without photographs."""

_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # of OpenGL's cameras, which look along -z with y up, in ours


def photo(camera: Camera, kind: PhotoKind, origin: np.ndarray) -> dict[str, Any]:
    """A camera as a page reads it.

    Args:
        camera: A pinhole.
        kind: What it is of.
        origin: (3,) world coordinates of the page's 0.
    """
    pose = np.array(camera.c2w, np.float64)
    pose[:3, 3] -= origin
    K = camera.K
    return {
        "name": camera.name,
        "kind": kind,
        "time": camera.time,
        "width": camera.width,
        "height": camera.height,
        "fx": float(K[0, 0]),
        "fy": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "pose": columns(pose @ _AXES),
    }


def columns(matrix: np.ndarray) -> list[float]:
    """The 16 numbers of a matrix column by column, as WebGL takes them."""
    return [float(x) for x in matrix.T.reshape(-1)]


def upright_matrix(up: np.ndarray) -> np.ndarray:
    """(4,4) rotation that takes a direction of the world to +y.

    Args:
        up: (3,) of length 1.
    """
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    turned = np.eye(4)
    turned[:3, :3] = np.stack([side, up, np.cross(side, up)])
    return turned
