"""What an image loses with one Gaussian: the change of a view if it were not there, of every Gaussian at once.

Of a hit of opacity a and color c in front of what lies behind, B, the camera gets T (a c + (1 - a) B). Without it the
pixel is C' = C - T a (c - B), exactly, as an image is linear in the opacity of each of its hits. T (c - B) = dC/da is
what rows of the Jacobian are made of (jacobian.py), so that the sum of |C - C'|^2 over pixels and channels takes one
traversal, as the diagonal does. For the response `peak` it is the diagonal's entry of the logit over (1 - alpha)^2,
which has no digits left where alpha is near 1: a sum of its own is formed, of every response.

That is the error of one Gaussian that goes alone. Where many go, the changes D of a pixel add up before they are
squared: |sum D|^2 is sum |D|^2 where they cancel, and (sum |D|)^2 where they have the same sign, as those of a veil of
faint Gaussians have, each of which changes next to nothing. A sum of squares ranks by the one, of lengths |D| over the
channels by the other; `drgs.prune` ranks by |D|^1.5, between them (docs/prune.md).

A ray ends behind an opaque hit, but would not without it: B has to be what is there. So opacities are at most 1 - 1e-6
here, which changes C - C' by that share, and rays go on to where they would end without any one of their hits. All
other cut-offs are those of the settings. That with the Gaussian rays do end there moves C by `transmittance_min` at
most, as each end of a ray does; it is left out.

GaussianPOP (arXiv 2602.06830, 2026) has the criterion |D|^2 for a rasterizer's images; LightGaussian (Fan et al.
2024) and PUP 3D-GS (Hanson et al. 2025) have others for the same purpose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import torch

from drgs.information.quantity import Quantity, ViewContext
from drgs.information.semantics import SemanticMetric
from drgs.runtime import alone
from drgs.settings import RenderSettings

REMOVAL = "removal"
"""Name of what `RemovalError` computes."""

_OPAQUE = 1 - 1e-6  # largest opacity of a hit: 17 times what float32 can tell from 1


@dataclasses.dataclass(frozen=True)
class RemovalError(Quantity):
    """{"removal": (N,)}: sum over pixels of how much the image changes without each Gaussian.

    Attributes:
        power: Of a change's length over the channels: 2, 1.5 or 1. Below 2, of more features than one traversal has,
            those of each traversal have a length of their own.
        channel_weights: Factors of the squares of R, G and B.
        semantics: The metric of the features that are a part of the image; None: they are none.
    """

    power: float = 2
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0)
    semantics: SemanticMetric | None = None
    where: ClassVar[str] = "fisher.removal_error"

    @alone
    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """Float64 on the CPU; 0 of a view without Gaussians."""
        from drgs.information.replay import Replay  # loads Dr.Jit, which poses alone need not have

        gaussians = view.gaussians
        if self.semantics is not None:
            self.semantics.check(self.where, gaussians)
        if not len(gaussians):
            return {REMOVAL: torch.zeros(0, dtype=torch.float64)}
        # A replay of its own: the view's ends its rays at opaque hits.
        replay = Replay(gaussians, view.camera, seen_through(view.settings), True, self.semantics, view.mask)
        return {REMOVAL: replay.removal_errors(self.channel_weights, self.power)}


def seen_through(settings: RenderSettings) -> RenderSettings:
    """Settings by which rays end no earlier than they would by these ones without any one of their hits."""
    alpha_max = min(settings.alpha_max, _OPAQUE)
    ends = settings.least_transmittance * (1 - alpha_max)
    return settings.replace(alpha_max=alpha_max, transmittance_min=ends, max_hits=None, tolerance=None)
