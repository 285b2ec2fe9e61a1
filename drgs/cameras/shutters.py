"""Rolling shutters: the pose that each row, or column, of a photograph is exposed at; `drgs.cameras.Camera` is the way
in.

The sensor is read line by line while the camera moves. As in gsplat the first line that is read has the pose `w2c`, the
last one `w2c_end`; between the two the translation of the world-to-camera matrix is interpolated linearly and its
rotation along the shortest turn, at a constant rate (slerp: Shoemake 1985). Where the camera is in between depends on
where 0 is: by about an eighth of its distance times the square of the turn. Renderings take the Gaussians' origin for
that 0; whoever asks a camera far from 0 for the poses of its lines moves it there first (`Camera.relative_to`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

SHUTTERS = (
    "global",
    "rolling_top_to_bottom",
    "rolling_left_to_right",
    "rolling_bottom_to_top",
    "rolling_right_to_left",
)
"""Which way the lines of a photograph are exposed: all at once, or one after the other."""
FORWARD = SHUTTERS[1:3]
"""Those that begin with the first row or column."""
BY_COLUMN = ("rolling_left_to_right", "rolling_right_to_left")
"""Shutters whose lines are columns, not rows."""


def line_times(shutter: str, width: int, height: int) -> np.ndarray:
    """When the lines of an image are exposed, from 0 (the first) to 1 (the last): rows, (H,), or columns, (W,), of the
    shutters left to right and back. A single line is exposed in the middle, at 0.5.
    """
    count = width if shutter in BY_COLUMN else height
    times = np.linspace(0.0, 1.0, count) if count > 1 else np.full(1, 0.5)
    return times if shutter in FORWARD else times[::-1].copy()


def turn_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(3,) axis times angle, in radians, of the shortest turn that takes one rotation (3, 3) to another one."""
    turn = end @ start.T
    sine = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    length = np.linalg.norm(sine)
    angle = np.arctan2(length, 0.5 * (np.trace(turn) - 1))
    return sine * (angle / length if length > 0 else 1.0)


def line_poses(start: np.ndarray, end: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(T, 4, 4) world-to-camera matrices at times (T,) between two, (4, 4) each."""
    turn = turn_between(start[:3, :3], end[:3, :3])
    angle = np.linalg.norm(turn)
    axis = turn / angle if angle > 0 else np.array([1.0, 0.0, 0.0])
    x, y, z = axis
    generator = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angles = (times * angle)[:, None, None]
    turns = np.eye(3) + np.sin(angles) * generator + (1 - np.cos(angles)) * (generator @ generator)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = turns @ start[:3, :3]
    poses[:, :3, 3] = (1 - times)[:, None] * start[:3, 3] + times[:, None] * end[:3, 3]
    return poses


def points_in_moving_camera(
    start: np.ndarray, end: np.ndarray, points: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """Function of times (P,) that gives points (P, 3) in the axes of the camera at each point's own time.

    Args:
        start, end: (4, 4) world-to-camera matrices.
        points: (P, 3) in the world.
    """
    turn = turn_between(start[:3, :3], end[:3, :3])
    angle = np.linalg.norm(turn)
    axis = turn / angle if angle > 0 else turn
    first = np.einsum("pk,jk->pj", points, start[:3, :3])  # no `@`, as in `Camera.pixel_directions`
    # Rodrigues' formula: what of a point moves with the sine of the angle, and what with 1 minus its cosine.
    across = np.cross(axis, first)
    back = np.cross(axis, across)

    def at(times: np.ndarray) -> np.ndarray:
        t = times[:, None]
        moved = first + np.sin(t * angle) * across + (1 - np.cos(t * angle)) * back
        return moved + (1 - t) * start[:3, 3] + t * end[:3, 3]

    return at
