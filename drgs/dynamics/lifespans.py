"""Lifespans of Gaussians: opacity at a time by a center and a width in time, and the motion of the mean.

    o(t) = sigmoid(logit) exp(-((t - center) / width)^2 / 2)
    mean(t) = mean + velocity (t - reference) + acceleration (t - reference)^2 / 2

The reference time, at which `means` holds, is a constant of each Gaussian and not its center: so the center and the
width change the opacity alone, velocity and acceleration the mean alone.

Reference:
    Yang et al., "Real-time Photorealistic Dynamic Scene Representation and Rendering with 4D Gaussian Splatting", ICLR
    2024 (opacity and mean at a time); Li et al., "Spacetime Gaussian Feature Splatting for Real-Time Dynamic View
    Synthesis", CVPR 2024 (opacity by center and width, polynomials of motion). That most Gaussians have no lifespan,
    and which have one, is not from there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch

LASTING = 10.0
"""Widths, in spans of time, from which on a Gaussian is always there: its opacity at the ends would be 0.995 times that
in the middle."""

LIFESPAN_PARAMETERS = ("life_centers", "life_log_widths", "velocities", "accelerations")
"""Names of a scene's parameters of lifespans (in checkpoints and in information, too), in the order of `Lifespans`."""

_LARGEST_LOG_OPACITY = -1e-30  # natural logarithm: the logit of an opacity of 1 stays finite; any tiny value does


class Lifespans(NamedTuple):
    """When each of N Gaussians is visible, and how it moves then.

    Attributes:
        centers: (N,) time at which its opacity is largest.
        log_widths: (N,) natural logarithm of the standard deviation in time. At and above that of 10 spans of the
            field it is always there, and nothing of this is computed for it.
        velocities: (N, 3) world units per unit of time, at the reference time.
        accelerations: (N, 3) world units per unit of time squared.
        reference_times: (N,) time at which its mean is that of the Gaussians; a constant.
    """

    centers: torch.Tensor
    log_widths: torch.Tensor
    velocities: torch.Tensor
    accelerations: torch.Tensor
    reference_times: torch.Tensor

    @classmethod
    def of(cls, parameters: Mapping[str, torch.Tensor], reference_times: torch.Tensor) -> Lifespans:
        """Lifespans of a scene's parameters, named as in `LIFESPAN_PARAMETERS`."""
        centers, log_widths, velocities, accelerations = (parameters[name] for name in LIFESPAN_PARAMETERS)
        return cls(centers, log_widths, velocities, accelerations, reference_times)

    def take(self, index: torch.Tensor) -> Lifespans:
        """Lifespans of the Gaussians at `index`."""
        return Lifespans(*[x[index] for x in self])


def is_limited(log_widths: torch.Tensor, span: float) -> torch.Tensor:
    """(N,) bool, which Gaussians have a limited lifespan.

    Args:
        log_widths: (N,) of `Lifespans`.
        span: Last time less first time.
    """
    return log_widths.detach() < torch.tensor(LASTING * span, dtype=torch.float64).log()  # the choice has no derivative


def logit_at(logits: torch.Tensor, lifespans: Lifespans, time: float | torch.Tensor) -> torch.Tensor:
    """(N,) logit of the opacity at a time.

    With a = log o(t) it is a - log(1 - exp a), in which nothing cancels however opaque or transparent a Gaussian is.
    """
    z = (time - lifespans.centers) * (-lifespans.log_widths).exp()
    a = (torch.nn.functional.logsigmoid(logits) - 0.5 * z.square()).clamp(max=_LARGEST_LOG_OPACITY)
    return a - (-a.expm1()).log()


def drift(lifespans: Lifespans, time: float | torch.Tensor) -> torch.Tensor:
    """(N, 3) displacement of each mean at a time from where it is at its reference time, world units."""
    ahead = (time - lifespans.reference_times.double()).to(lifespans.velocities.dtype)[:, None]
    return ahead * (lifespans.velocities + 0.5 * ahead * lifespans.accelerations)
