"""Videos of made scenes whose cameras are known: a walk past three walls, a turn on the spot, a camera at rest."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from test_data_points import HEIGHT, WIDTH, texture
from test_dynamic_data import write_video
from test_sfm import corner_photo, corner_walls

from drgs.cameras import Camera, intrinsics, look_at

RATE = 10  # frames a second: each is looked at


def walk_cameras(count: int, step: float = 0.03, focal: float = 1.2) -> list[Camera]:
    """Along an arc around the corner, looking at it; angles in radians, the focal length over the width."""
    eyes = [(4 * np.sin(a), 1.5, 4 * np.cos(a)) for a in 0.3 + step * np.arange(count)]
    K = intrinsics(focal * WIDTH, focal * WIDTH, WIDTH / 2, HEIGHT / 2)
    return [Camera(K, look_at(eye, (-0.8, -0.8, -0.8), (0, 1, 0)), WIDTH, HEIGHT) for eye in eyes]


def turn_cameras(start: Camera, count: int, step: float = 0.03) -> list[Camera]:
    """Turns of a camera about its own vertical axis, by so many radians each."""
    found = []
    for angle in step * np.arange(1, count + 1):
        turn = np.eye(4)
        turn[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        found.append(Camera(start.K, turn @ start.w2c, WIDTH, HEIGHT))
    return found


def pictures(cameras: Sequence[Camera]) -> list[np.ndarray]:
    """(H, W, 3) uint8 of each camera: the walls, and around them a backdrop at infinity."""
    rng = np.random.default_rng(5)
    walls = corner_walls(rng)
    backdrop = np.tile(texture(rng), (3, 6, 1))  # about as fine as the walls
    found = []
    for camera in cameras:
        photo, seen = corner_photo(camera, walls)
        x, y, z = np.moveaxis(camera.pixel_directions(), -1, 0)
        u = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * (backdrop.shape[1] - 1)
        v = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * (backdrop.shape[0] - 1)
        behind = cv2.remap(backdrop, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        found.append(np.round(np.where(seen[..., None], photo, behind) * 255).astype(np.uint8))
    return found


def film(path: Path, images: Sequence[np.ndarray], code: str = "mp4v", rate: int = RATE) -> Path:
    """A video of RGB pictures."""
    return write_video(path, [np.ascontiguousarray(image[..., ::-1]) for image in images], code, rate)
