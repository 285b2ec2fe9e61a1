"""How far the Gaussians of a model that is still being fitted have changed, and how much of that a view shows.

The information of a view about a Gaussian holds as long as the Gaussian stays what it is. Its change since then is the
largest of

    |mu - mu'| / s              how far it went, in units of its size s, the geometric mean of its scales
    max |log s_k - log s_k'|
    phi (1 - s_min / s_max)     phi the angle that it turned by, radians; a sphere does not turn
    |o - o'|                    opacity
    max |c - c'|                base color, in [0, 1]

and at most 1; that of a Gaussian that was not there is 1. The change of a view is the mean over the Gaussians that it
sees, each counted by how much of the image it makes up: the sum over pixels of w^2, w its weight of compositing. One
that has come since counts as the average of these if its mean is in the image.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Y_00, Gaussians


@dataclasses.dataclass(frozen=True, eq=False)
class Shapes:
    """The parameters of N Gaussians that are compared.

    Attributes:
        means: (N, 3) float64 world.
        log_scales: (N, 3).
        quats: (N, 4) unit.
        opacities: (N,).
        colors: (N, 3) base colors, in [0, 1] as far as they are seen.
        sh: Number K of SH coefficients of a channel.
    """

    means: torch.Tensor
    log_scales: torch.Tensor
    quats: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor
    sh: int

    @classmethod
    def of(cls, gaussians: Gaussians) -> Shapes:
        """A copy of what is compared, on the CPU."""
        g = gaussians.detach().to("cpu")
        return cls(
            g.means.double() + torch.from_numpy(np.array(g.origin)),
            g.log_scales.clone(),
            torch.nn.functional.normalize(g.quats, dim=1),
            g.logit_opacities.sigmoid(),
            (0.5 + Y_00 * g.sh[:, 0]).clamp(0, 1),
            g.sh.shape[1],
        )

    def __len__(self) -> int:
        return len(self.means)

    def change_to(self, now: Shapes) -> torch.Tensor:
        """(M,) float32 in [0, 1]: change of each of the M Gaussians that there are now, in the order of both."""
        count = min(len(self), len(now))
        a, b = ({k: x[:count] for k, x in vars(one).items() if k != "sh"} for one in (self, now))
        scales = a["log_scales"]
        # q and -q are one rotation; by the chord, for the arc cosine of nearly 1 has half of the digits.
        chord = torch.minimum((a["quats"] - b["quats"]).norm(dim=1), (a["quats"] + b["quats"]).norm(dim=1))
        turn = 4 * (chord / 2).clamp(max=1).asin()
        flat = 1 - (scales.amin(1) - scales.amax(1)).exp()
        parts = (
            (b["means"] - a["means"]).norm(dim=1) / scales.mean(1).exp(),
            (b["log_scales"] - scales).abs().amax(1),
            turn * flat,
            (b["opacities"] - a["opacities"]).abs(),
            (b["colors"] - a["colors"]).abs().amax(1),
        )
        change = torch.ones(len(now))
        change[:count] = torch.stack([x.float() for x in parts]).amax(0).clamp(max=1)
        return change


def change_of_view(
    before: Shapes, now: Shapes, change: torch.Tensor, camera: Camera, weights: torch.Tensor | None
) -> float:
    """Change of the content of a view, in [0, 1].

    Args:
        before, now: The Gaussians as they were, and as they are: the first of these are the former.
        change: (M,) of each that there is now, `before.change_to(now)`.
        camera: The view's camera.
        weights: (N,) or more, how much of the image each Gaussian made up; None: all alike.
    """
    seen = torch.ones(len(before)) if weights is None else weights[: len(before)]
    counted = torch.zeros(len(now))
    counted[: len(seen)] = seen
    there = seen > 0
    if len(now) > len(seen) and bool(there.any()):
        counted[len(seen) :] = seen[there].mean() * _inside(camera, now.means[len(seen) :])
    total = float(counted.sum())
    if not total:  # it saw nothing: whatever has come counts
        return float(len(now) > len(before) and bool(_inside(camera, now.means).any()))
    return float((counted * change).sum()) / total


def _inside(camera: Camera, points: torch.Tensor) -> torch.Tensor:
    """(P,) float32, 1 for points that are in a camera's image."""
    pixels, _ = camera.project(points.numpy())
    return torch.from_numpy(camera.contains(pixels)).float()
