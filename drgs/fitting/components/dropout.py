"""Gaussians that a step leaves out at random, so that none of them comes to explain one photograph alone.

Few photographs are fitted by Gaussians before their cameras as well as by those of the scene, and views between them
show it. DropGaussian [1] renders each step with a random part of the Gaussians, and divides the opacities of the others
by that part: what is left must show the photograph, so that it has larger gradients, and nothing can depend on one
Gaussian before a camera. The share that is left out rises from 0 over the steps. It helps where a fit overfits, and
costs where it does not (docs/real-data.md): so `auto` has it for 3 photographs and fewer. Each step renders another
number of Gaussians, so that its kernels are recorded anew (`drgs.tracing.recordings`), which takes 7 % of its time.

Reference:
    [1] Park et al., "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting", CVPR 2025.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch

from drgs.fitting.components.base import Checkpoint, Component, Fit, Setup

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drgs.ellipsoids import Gaussians
    from drgs.fitting.frames import Frame

_FEW, _SHARE = 3, 0.4  # photographs at most for which `auto` leaves Gaussians out, and their share at the end


def fewer(gaussians: Gaussians, kept: torch.Tensor, rate: float) -> Gaussians:
    """The Gaussians that a step renders, more opaque by how many there would be [1].

    Args:
        gaussians: N Gaussians.
        kept: (M,) indices of those that are not left out.
        rate: Share that is left out on average, in [0, 1).
    Gradients:
        Reach the Gaussians that are kept; the opacity of one that becomes opaque has none.
    """
    few = gaussians.take(kept.to(gaussians.means.device))
    # By logarithms: what float32 cannot hold as an opacity, as far from a Gaussian's time, stays finite as a logit.
    logs = (torch.nn.functional.logsigmoid(few.logit_opacities) - math.log1p(-rate)).clamp(max=-1e-6)
    return few.replace(logit_opacities=logs - (-logs.expm1()).log())


class DropoutComponent(Component):
    """Gaussians left out of steps: `dropout`, the share at the end, or auto, by the number of photographs.

    Attributes:
        share: Share of the Gaussians that the last steps leave out; 0 where none are.
    """

    name = "dropout"
    option = ("dropout", "0")
    where = "where steps leave Gaussians out at random"
    header_kinds = {"dropout": float}

    def __init__(self) -> None:
        self.share = self._rate = 0.0
        self._kept: torch.Tensor | None = None  # indices of what the next step renders; None: all

    def start(self, fit: Fit, setup: Setup) -> None:
        """See `Component`: `auto` is for few photographs of what stands still, of which none join later."""
        share = fit.config.density.dropout
        is_few = len(fit.frames) <= _FEW and not setup.times and not setup.is_active
        self.share = share if share is not None else _SHARE if is_few else 0.0

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`: fits of versions that had no dropout go on without."""
        self.share = checkpoint.header.get("dropout", 0.0)

    def before_step(self, fit: Fit) -> list[dict]:
        """See `Component`: what is kept is drawn by the seed and the number of the step alone."""
        self._rate, self._kept = self.share * fit.part, None
        if self._rate:
            generator = torch.Generator().manual_seed(fit.config.seed * 1_000_003 + fit.step_index)
            is_kept = torch.rand(len(fit.rows), generator=generator) >= self._rate
            is_kept[: fit.rows.far] = True  # nothing is behind them
            self._kept = is_kept.nonzero()[:, 0]
        return []

    def rendered(self, gaussians: Gaussians, frame: Frame) -> Gaussians:
        """See `Component`: those that are kept."""
        return gaussians if self._kept is None else fewer(gaussians, self._kept, self._rate)

    def state(self, fit: Fit) -> tuple[dict[str, torch.Tensor], dict]:
        """See `Component`."""
        return {}, {"dropout": self.share} if self.share else {}

    @classmethod
    def check(cls, checkpoint: Checkpoint) -> str | None:
        """See `Component`."""
        share = checkpoint.header.get("dropout", 0.0)
        return None if 0 <= share < 1 else f"dropout must be in [0, 1), got {share}"

    def metrics(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`."""
        return {"dropout": self.share} if self.share else {}

    @classmethod
    def report(cls, config: Mapping[str, Any], metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
        """See `Component`."""
        share = metrics.get("dropout")
        return [("Dropout", f"steps leave Gaussians out at random, up to {share:.0%}")] if share else []
