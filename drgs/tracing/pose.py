"""Poses of cameras as the renderer reads them: rigid motions in float64, of a world whose origin may be elsewhere."""

from __future__ import annotations

import numpy as np
import torch

from drgs.cameras import Camera, rigid


def rigid_pose(camera: Camera, name: str = "w2c") -> torch.Tensor:
    """(3, 4) of w2c, or of w2c_end, in float64, as the rigid motion that it means; a copy of an array, which may be
    read-only.
    """
    w2c = getattr(camera, name)
    if not isinstance(w2c, torch.Tensor):
        return torch.tensor(w2c).to(torch.float64)[:3]
    # The camera has checked it, but an optimizer may have moved it since. A check has no derivative.
    bad = ~torch.isfinite(w2c.detach())
    if bool(bad.any()):
        at = bad.nonzero()[0].tolist()
        raise ValueError(
            f"render: the pose must be finite, got {float(w2c[tuple(at)]):g} at {at}; go back to the last good one"
        )
    rotation, translation = rigid(w2c.to(torch.float64))
    return torch.cat([rotation, translation[:, None]], 1)


def shifted(pose: torch.Tensor, origin: torch.Tensor) -> torch.Tensor:
    """(12,) of the pose that takes x where `pose` takes x + origin: the re-centered world of the means."""
    translation = pose[:3, 3] + pose[:3, :3] @ origin
    return torch.cat([pose[:3, :3], translation[:, None]], 1).reshape(-1)


def local_directions(camera: Camera) -> torch.Tensor:
    """(H * W, 3) float64 unit directions in camera axes, distortion included."""
    return torch.from_numpy(local_rays(camera))


def local_rays(camera: Camera) -> np.ndarray:
    """What `local_directions` gives, as an array."""
    return camera.local_directions().reshape(-1, 3)


def twisted(pose: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:
    """(3, 4) tangent of w2c along a world-frame twist (6,), rotation first.

    c2w <- exp(xi) c2w is w2c <- w2c exp(-xi).
    """
    generator = torch.zeros(4, 4, dtype=torch.float64)
    generator[:3, :3] = cross_matrix(twist[:3])
    generator[:3, 3] = twist[3:]
    return -pose @ generator


def twists_about(point: np.ndarray) -> torch.Tensor:
    """(6, 6) float64 world-frame twists: rotations about a point, then translations.

    About the world's 0, a rotation of what is far away is nearly a translation, and float64 could not tell them apart.
    """
    twists = np.eye(6)
    twists[:3, 3:] = np.cross(point, np.eye(3))
    return torch.from_numpy(twists)


def turned(omega: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """(P, 3) tangent of vectors along a rotation omega (3,)."""
    return torch.cross(omega.to(x.device).expand_as(x), x, dim=1)


def quaternion_product(w: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """(0, w) * q for (N, 3) and (N, 4) wxyz."""
    s = q[:, :1]
    v = q[:, 1:]
    return torch.cat([-(w * v).sum(1, keepdim=True), s * w + torch.cross(w, v, dim=1)], 1)


def cross_matrix(w: torch.Tensor) -> torch.Tensor:
    """(3, 3) of x -> w x x."""
    zero = w.new_zeros(())
    return torch.stack(
        [torch.stack([zero, -w[2], w[1]]), torch.stack([w[2], zero, -w[0]]), torch.stack([-w[1], w[0], zero])]
    )
