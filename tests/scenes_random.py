"""Random scenes and their comparison with the float64 oracle: `drgs.lab.accuracy`, under the names that tests use."""

from __future__ import annotations

import torch

from drgs import runtime
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.lab.accuracy import (
    FIELDS,
    Errors,
    Oracle,
    compare,
    gradients,
    inner,
    leaves,
    pose_gradient,
    relative,
    rotation,
    twist_basis,
    weight_of,
)
from drgs.lab.accuracy import random_camera as camera
from drgs.lab.accuracy import random_gaussians as gaussians

__all__ = [
    "FIELDS",
    "Errors",
    "Oracle",
    "around_camera",
    "assert_same_sums",
    "camera",
    "compare",
    "gaussians",
    "gradients",
    "inner",
    "leaves",
    "pose_gradient",
    "relative",
    "rotation",
    "twist_basis",
    "weight_of",
]


def assert_same_sums(found, wanted) -> None:
    """Of the same bits, as one thread sums; on a card, whose order of sums is not fixed, to rounding of float32."""
    found, wanted = (torch.as_tensor(x, dtype=torch.float64) for x in (found, wanted))
    if runtime.backend().name == "cuda":
        size = float(wanted.abs().max()) if wanted.numel() else 0.0
        torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6 * size)
    else:
        assert torch.equal(found, wanted)


def around_camera(g: Gaussians, cam: Camera) -> Gaussians:
    """Move the first Gaussians: in front of, around, beside and behind the camera, in its plane, into its center."""
    c2w = cam.c2w
    places = ([0.05, 0.02, 0.4], [0.1, 0.0, 0.1], [0.3, 0.2, -0.25], [0, 0, -1.5], [1.5, 0.3, 0.3])
    with torch.no_grad():
        for i, place in enumerate(places[: len(g)]):
            g.means[i] = torch.tensor(c2w[:3, :3] @ place + c2w[:3, 3], dtype=torch.float32)
    return g
