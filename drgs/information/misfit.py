"""How far a view's photograph is from the rendering, put on the Gaussians that are seen.

With e_p the squared residual of a pixel (mean over channels; colors of the rendering are clamped to [0, 1], as they are
shown) and w_ip the compositing weights, a view adds to Gaussian i

    W_i = sum_p w_ip      pixels in which it is seen
    R_i = sum_p w_ip e_p  their squared residuals

so that R_i / W_i is the mean squared residual where Gaussian i is seen. Of a view whose residuals are given, such as 1
where a label is wrong, e_p is these, and the view needs no photograph. What lies behind everything gets the same sums
with the transmittance 1 - alpha_p in place of w_ip. All of them add up over views, and are linear in the image, so that
a traversal of the view for something else, such as the diagonal, fills them on its way.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import drjit as dr
import torch

from drgs.information.quantity import Quantity, ViewContext
from drgs.runtime import alone
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.bridge import to_drjit
from drgs.tracing.sums import add_row

if TYPE_CHECKING:
    from drgs.information.jacobian import Row
    from drgs.information.replay import Replay, Walk, WalkSums
    from drgs.information.semantics import SemanticMetric

__all__ = ["BEHIND", "CONTRAST", "RESIDUALS", "WEIGHTS", "Misfit"]

WEIGHTS, RESIDUALS = "misfit.weights", "misfit.residuals"
BEHIND = "misfit.behind"
CONTRAST = "misfit.contrast"
_WIDTH = 2  # floats of a Gaussian: sum w, sum w e


@dataclasses.dataclass(frozen=True)
class Misfit(Quantity):
    """Sums of squared residuals by Gaussian, of a view with a photograph or with residuals of another kind; a mask
    multiplies weights and transmittance.

    misfit.weights    (N,) sum of w, in pixels
    misfit.residuals  (N,) sum of w e, squared units of color
    misfit.behind     (2,) the same two of the transmittance 1 - alpha, for what lies behind everything
    misfit.contrast   (2,) sum of the mask, and of the squared differences between photograph and background; not where
                      there is no photograph
    """

    where: ClassVar[str] = "expected_error"

    @alone
    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """Float32 on the CPU, as one traversal sums it up."""
        return dict((view.shared_sums.get(self) or self.shared_sums(view)).information())

    def shared_sums(self, view: ViewContext) -> MisfitSums:
        """The sums of a view."""
        return MisfitSums(view)


class MisfitSums:
    """The sums of one view, which a traversal for another quantity may fill.

    Attributes:
        sums: These.
        semantics: None: they are about colors.
    """

    semantics: SemanticMetric | None = None

    def __init__(self, view: ViewContext) -> None:
        """
        Args:
            view: A view with a photograph, or with residuals.
        """
        assert view.photograph is not None or view.residual is not None  # a view without has been refused
        self.sums: WalkSums = self
        self._view = view
        self._photograph = None if view.photograph is None else view.photograph.detach().float().cpu()
        self._residual = None if view.residual is None else view.residual.detach().float().cpu()  # (H, W)
        self._buffer: Float | None = None

    def sink(self, replay: Replay, walk: Walk) -> _Sink:
        """The sink of one walk of the view."""
        lib = replay.lib
        if self._buffer is None:
            self._buffer = dr.zeros(lib.Float, _WIDTH * replay.count)
        values = self._residual_of(replay.image)
        residual = to_drjit(lib, values.reshape(-1).to(replay.call.home)).array
        return _Sink(lib, walk, residual, self._buffer)

    def _residual_of(self, image: torch.Tensor) -> torch.Tensor:
        """(H, W) what is given, or the squared residuals of a rendering, computed once."""
        if self._residual is None:
            assert self._photograph is not None  # one of both is there
            self._residual = (image.clamp(0, 1) - self._photograph).square().mean(2)
        return self._residual

    def information(self) -> dict[str, torch.Tensor]:
        """The sums, by the names that `Misfit` gives them."""
        view = self._view
        count = len(view.gaussians)
        background = torch.tensor(view.settings.background)
        if self._buffer is None and count:
            view.replay(geometry=False).add_up(self)
        if self._buffer is None:  # of no Gaussians the background alone is seen
            by_gaussian = torch.zeros(0, _WIDTH)
        else:
            by_gaussian = self._buffer.torch().cpu().reshape(count, _WIDTH)
        residual = self._residual_of(background)
        mask = torch.ones(residual.shape) if view.mask is None else view.mask.detach().float().cpu()
        behind = (1 - view.opacity).clamp(min=0) * mask
        sums = {
            WEIGHTS: by_gaussian[:, 0].clone(),
            RESIDUALS: by_gaussian[:, 1].clone(),
            BEHIND: torch.stack([behind.sum(), (behind * residual).sum()]),
        }
        if self._photograph is not None:
            contrast = (self._photograph - background).square().mean(2) * mask
            sums[CONTRAST] = torch.stack([mask.sum(), contrast.sum()])
        return sums


class _Sink:
    """The sink of one walk.

    Args:
        walk: The walk.
        residual: (pixels,) squared residuals.
        buffer: (N 2) added to.
    """

    needs_color = False

    def __init__(self, lib: Lib, walk: Walk, residual: Float, buffer: Float) -> None:
        self.lib = lib
        self.part = walk.part
        self.residual = residual
        self.buffer = buffer

    def init(self, k: int) -> dict:
        """The residual of a ray's pixel."""
        return {"residual": dr.gather(self.lib.Float, self.residual, self.part.flat[k], self.part.inside[k])}

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """Add a hit's weight, and its weight times the residual."""
        weight = sum((row.w for row in rows), lib.Float(0))
        residual = sum((row.w * state["residual"] for row, state in zip(rows, states, strict=True)), lib.Float(0))
        add_row(lib, self.buffer, [weight, residual], index, _WIDTH, 0, hits, self.part.reduction)
        return states
