"""Gaussians that are there for a time: opacity by a center and a width in time, and a drift while they live.

    o(t) = sigmoid(logit) exp(-((t - center) / width)^2 / 2)
    mean(t) = mean + velocity (t - birth) + acceleration (t - birth)^2 / 2

The moment that the mean is stated at, `birth`, is a constant of each Gaussian, and not its center: so the center and
the width change the opacity alone, velocity and acceleration the mean alone.

Reference:
    Yang et al., "Real-time Photorealistic Dynamic Scene Representation and Rendering with 4D Gaussian Splatting", ICLR
    2024 (opacity and mean at a time); Li et al., "Spacetime Gaussian Feature Splatting for Real-Time Dynamic View
    Synthesis", CVPR 2024 (opacity by center and width, polynomials of motion). That most Gaussians have no life, and
    which have one, is not from there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch

__all__ = ["LASTING", "LIVES", "Lives", "drift", "living", "logit_at"]

LASTING = 10.0
"""Widths, in spans of time, from which on a Gaussian is always there: its opacity at the ends would be 0.995 times that
in the middle."""

LIVES = ("life_centers", "life_log_widths", "velocities", "accelerations")
"""Names of the parameters of a scene that say when its Gaussians live, and how they drift, in the order of `Lives`."""

_LEAST = -1e-30  # of a logarithm of an opacity: the logit of what is opaque stays finite


class Lives(NamedTuple):
    """Of N Gaussians, when each is there.

    Attributes:
        centers: (N,) time at which it is seen best.
        log_widths: (N,) natural logarithm of the standard deviation in time. At and above that of 10 spans of the
            field it is always there, and nothing of this is computed for it.
        velocities: (N, 3) world units in a unit of time, at birth.
        accelerations: (N, 3) what these change by in a unit of time.
        births: (N,) time at which its mean is where the Gaussians say; a constant.
    """

    centers: torch.Tensor
    log_widths: torch.Tensor
    velocities: torch.Tensor
    accelerations: torch.Tensor
    births: torch.Tensor

    @classmethod
    def of(cls, parameters: Mapping[str, torch.Tensor], births: torch.Tensor) -> Lives:
        """Those of a scene's parameters, named as in `LIVES`."""
        centers, log_widths, velocities, accelerations = (parameters[name] for name in LIVES)
        return cls(centers, log_widths, velocities, accelerations, births)

    def take(self, index: torch.Tensor) -> Lives:
        """Those of some of the Gaussians."""
        return Lives(*[x[index] for x in self])


def living(log_widths: torch.Tensor, span: float) -> torch.Tensor:
    """(N,) bool, which Gaussians are there for a time alone.

    Args:
        log_widths: (N,) of `Lives`.
        span: Last time less first time.
    """
    return log_widths.detach() < torch.tensor(LASTING * span, dtype=torch.float64).log()  # who lives has no derivative


def logit_at(logits: torch.Tensor, lives: Lives, time: float | torch.Tensor) -> torch.Tensor:
    """(N,) logit of the opacity at a time.

    With a = log o(t) it is a - log(1 - exp a), in which nothing cancels however opaque or transparent a Gaussian is.
    """
    z = (time - lives.centers) * (-lives.log_widths).exp()
    a = (torch.nn.functional.logsigmoid(logits) - 0.5 * z.square()).clamp(max=_LEAST)
    return a - (-a.expm1()).log()


def drift(lives: Lives, time: float | torch.Tensor) -> torch.Tensor:
    """(N, 3) how far from its place at birth each is at a time."""
    ahead = (time - lives.births.double()).to(lives.velocities.dtype)[:, None]
    return ahead * (lives.velocities + 0.5 * ahead * lives.accelerations)
