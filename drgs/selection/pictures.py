"""Policies by renderings of candidates, each by itself: no training view is needed, nothing is differentiated.

Picks do not change the scores: k picks are the k best, whatever they share.

Reference:
    [1] Pech-Pacheco et al.: Diatom autofocusing in brightfield microscopy: a comparative study, 2000.
"""

from __future__ import annotations

import dataclasses

import torch

from drgs.information.quantity import Quantity, ViewContext
from drgs.selection.pool import Pool, Selection
from drgs.settings import RenderSettings

_COMPARED = ("exact", "fast", "gsplat", "3dgut")
_LUMA = (0.299, 0.587, 0.114)  # of R, G and B, ITU-R BT.601
_SHARPNESS_FLOOR = 1e-12  # squared luma in [0, 1]; added to a sharpness, whose logarithm is infinite of one color


def moments(pool: Pool) -> Selection:
    """Largest variance of the features along the rays, on average over pixels; of colors where there are no features.

    "Magic Moments"; see `drgs.information.maps`.
    """
    return _ranked(pool, "moments", _RayVariance())


def blur(pool: Pool) -> Selection:
    """Least sharp rendering: smallest variance of the Laplacian of the luma over the image [1].

    The score is minus the logarithm of that variance. A view that is rendered without detail is taken to be a bad one;
    whether detail is missing or was never there is unknown.
    """
    return _ranked(pool, "blur", _Blur())


def renderers(pool: Pool) -> Selection:
    """Largest variance of a pixel's color between renderers of the same Gaussians, on average over pixels and channels.

    The presets `exact`, `fast`, `gsplat` and `3dgut`: they differ where Gaussians overlap, are large or near the
    camera, which is where few photographs have said what they are.
    """
    return _ranked(pool, "renderers", _Renderers())


def _ranked(pool: Pool, name: str, quantity: Quantity) -> Selection:
    """The candidates that score highest, one by one."""
    scores = []
    for number, computed in enumerate(pool.compute_each(quantity, pool.candidates), 1):
        scores.append(float(computed[name]))
        if pool.progress:
            pool.progress(number, len(pool.candidates))
    order = sorted(range(len(scores)), key=lambda i: -scores[i])  # stable: ties by index
    picks = []
    for place, i in enumerate(order[: pool.k]):
        margin = scores[i] - scores[order[place + 1]] if place + 1 < len(order) else None
        picks.append(pool.pick(i, scores[i], margin=margin))
    notes = [f"{name} ranks candidates one by one: picks do not take each other into account"] if pool.k > 1 else []
    return Selection(picks, scores, evaluations=len(scores), notes=notes)


# What loads Dr.Jit is imported when it is first computed.


@dataclasses.dataclass(frozen=True)
class _RayVariance(Quantity):
    """The mean over a view's pixels of the variance along their rays."""

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """A float64 number."""
        from drgs.information.maps import moments_map

        return {"moments": moments_map(view.gaussians, view.camera, view.settings).double().mean()}


@dataclasses.dataclass(frozen=True)
class _Blur(Quantity):
    """How far a view is from sharp."""

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """A float64 number."""
        luma = _rendered(view, view.settings) @ torch.tensor(_LUMA, dtype=torch.float64)
        inner = luma[1:-1, 1:-1]
        laplacian = luma[:-2, 1:-1] + luma[2:, 1:-1] + luma[1:-1, :-2] + luma[1:-1, 2:] - 4 * inner
        sharp = laplacian.var(correction=0) if laplacian.numel() else torch.zeros((), dtype=torch.float64)
        return {"blur": -(sharp + _SHARPNESS_FLOOR).log()}


@dataclasses.dataclass(frozen=True)
class _Renderers(Quantity):
    """The mean over a view's pixels and channels of the variance between renderers."""

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """A float64 number."""
        background = view.settings.background
        rendered = torch.stack(
            [_rendered(view, RenderSettings.preset(name, background=background)) for name in _COMPARED]
        )
        return {"renderers": rendered.var(0, correction=0).mean()}


def _rendered(view: ViewContext, settings: RenderSettings) -> torch.Tensor:
    """(H, W, 3) float64 colors of a view."""
    from drgs.integrator import render

    with torch.no_grad():
        gaussians = view.gaussians.detach().replace(features=None)
        return render(gaussians, view.camera, settings, outputs=()).rgb.double().cpu()
