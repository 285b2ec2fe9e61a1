"""The rays of a camera with a rolling shutter, in torch, as functions of both of its poses (shutters.py)."""

from __future__ import annotations

import torch

from drgs.cameras import Camera
from drgs.cameras.shutters import BY_COLUMN, line_times
from drgs.tracing.pose import shifted

_SERIES_BELOW = 1e-6  # of a squared sine or angle, below which series replace quotients of zeros


def rolling_view(
    camera: Camera, start: torch.Tensor, end: torch.Tensor, local: torch.Tensor, zero: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The pose in the middle of the exposure, (3, 4), whose depths count, and origins and unit directions (P, 3) of all
    pixels, in the world.

    Args:
        camera: Says which way lines are exposed, and the size of its image.
        start, end: (3, 4) world-to-camera matrices of the first and of the last line; differentiable.
        local: (P, 3) unit directions in camera axes; differentiable.
        zero: (3,) the Gaussians' origin, where translations are 0: those between two poses depend on where that is.
    """
    start, end = (shifted(pose, zero).reshape(3, 4) for pose in (start, end))
    times = torch.from_numpy(line_times(camera.shutter, camera.width, camera.height).copy())
    every = _poses(start, end, torch.cat([times, times.new_tensor([0.5])]))
    poses, middle = every[:-1], every[-1]
    turns = poses[:, :, :3]
    centers = -torch.einsum("tj,tjk->tk", poses[:, :, 3], turns)
    image = local.reshape(camera.height, camera.width, 3)
    if camera.shutter in BY_COLUMN:
        directions = torch.einsum("hwj,wjk->hwk", image, turns)
        origins = centers[None].expand_as(directions)
    else:
        directions = torch.einsum("hwj,hjk->hwk", image, turns)
        origins = centers[:, None].expand_as(directions)
    return shifted(middle, -zero).reshape(3, 4), origins.reshape(-1, 3) + zero, directions.reshape(-1, 3)


def middle_pose(start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """(3, 4) in the middle between two poses, (3, 4) each."""
    return _poses(start, end, start.new_tensor([0.5]))[0]


def _poses(start: torch.Tensor, end: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
    """(T, 3, 4) between two poses."""
    turn = end[:, :3] @ start[:, :3].T
    sine = 0.5 * torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    cosine = 0.5 * (turn.diagonal().sum() - 1)
    squared = (sine * sine).sum()
    small = squared < _SERIES_BELOW
    length = torch.where(small, 1.0, squared).sqrt()
    # asin(s) / s: of no turn at all the quotient has no derivative, but its series does.
    ratio = torch.where(small, 1 + squared * (1 / 6 + squared * (3 / 40)), torch.atan2(length, cosine) / length)
    axis = ratio * sine
    x, y, z = axis
    zero = torch.zeros_like(x)
    generator = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    angles2 = (times * times * (axis * axis).sum())[:, None, None]
    small = angles2 < _SERIES_BELOW
    angles = torch.where(small, 1.0, angles2).sqrt()
    first = torch.where(small, 1 - angles2 / 6 + angles2**2 / 120, angles.sin() / angles)
    second = torch.where(small, 0.5 - angles2 / 24 + angles2**2 / 720, (1 - angles.cos()) / angles**2)
    t = times[:, None, None]
    identity = torch.eye(3, dtype=torch.float64, device=start.device)
    turns = identity + t * first * generator + t * t * second * (generator @ generator)
    translations = (1 - times)[:, None] * start[:, 3] + times[:, None] * end[:, 3]
    return torch.cat([turns @ start[:, :3], translations[:, :, None]], 2)
