"""How many Gaussians there are, and where: MCMC density control.

It needs no screen-space gradient. Gaussians that have become transparent are moved onto opaque ones, new ones are
added the same way up to a fixed budget, and transparent ones wander by noise. Opacity and scale are chosen so that n
copies in one place look as the one Gaussian did.

Reference:
    [1] Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
"""

from __future__ import annotations

import torch

from drgs.data.camera_layout import REFERENCE_EXTENT
from drgs.ellipsoids import semi_axes
from drgs.fitting.rows import GaussianRows

_MAX_COPIES = 51  # of one Gaussian at a time [1]; binomials up to C(50, k) are exact enough in float64
_MAX_OPACITY = 1 - 1e-6  # its logit is finite in float32


def divide(opacity: torch.Tensor, copies: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Opacity and scale of `copies` coincident Gaussians that together look as one of `opacity`.

    The center keeps its opacity, 1 - (1 - o')^n = o; the scale keeps the integral of the composite along a line
    through the center (eq. 9 of [1]): s' = s o / sum_{i=1..n} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1).

    Args:
        opacity: (M,) in (0, 1).
        copies: (M,) whole numbers >= 1.
    Returns:
        (M,) opacity of each copy and (M,) factor of its scales, in the type of `opacity`.
    """
    n = copies.clamp(max=_MAX_COPIES)
    old = opacity.double().clamp(max=_MAX_OPACITY)
    new = -torch.expm1(torch.log1p(-old) / n)
    # sum_{i=k+1..n} C(i-1, k) = C(n, k+1): the double sum is a single one.
    k = torch.arange(_MAX_COPIES, dtype=torch.float64, device=old.device)
    top = n.double()[:, None]
    chosen = k + 1
    log_binomial = torch.lgamma(top + 1) - torch.lgamma(chosen + 1) - torch.lgamma((top - chosen).clamp(min=0) + 1)
    terms = torch.exp(log_binomial + chosen * new.log()[:, None]) * (-1) ** k / chosen.sqrt()
    bottom = torch.where(chosen <= top, terms, 0).sum(1)
    return new.to(opacity.dtype), (old / bottom).to(opacity.dtype)


def relocate(rows: GaussianRows, min_opacity: float, jitter: float, generator: torch.Generator) -> int:
    """Move Gaussians with opacity <= `min_opacity` onto others, drawn by opacity; returns how many were moved.

    Args:
        rows: Changed in place; moments of all that moved, and of opacity and scale of all that were divided, are 0.
        min_opacity: Opacity below which a Gaussian is dead.
        jitter: Standard deviation of a copy's displacement, in units of the Gaussian's own.
        generator: Generator of all random choices.
    """
    opacity = rows.tensors["logit_opacities"].detach().sigmoid()  # for a decision, which has no gradient
    is_dead = opacity <= min_opacity
    # What is far away stays where it is, and no copy of it would be of use in the scene.
    dead = is_dead[rows.far :].nonzero()[:, 0] + rows.far
    alive = (~is_dead[rows.far :]).nonzero()[:, 0] + rows.far
    if not len(dead) or not len(alive):
        return 0
    source = alive[_draw(opacity[alive], len(dead), generator)]
    rows.overwrite(dead, _copies(rows, source, min_opacity, jitter, generator))
    return len(dead)


def add_gaussians(rows: GaussianRows, count: int, min_opacity: float, jitter: float, generator: torch.Generator) -> int:
    """Add `count` copies of Gaussians drawn by opacity; arguments as in `relocate`. How many were added."""
    opacity = rows.tensors["logit_opacities"].detach().sigmoid()  # weights of a draw, which has no gradient
    if count <= 0 or len(rows) == rows.far:
        return 0
    source = _draw(opacity[rows.far :], count, generator) + rows.far
    rows.append(_copies(rows, source, min_opacity, jitter, generator))
    return count


@torch.no_grad()  # leaves are changed in place
def explore(rows: GaussianRows, rate: float, extent: float, strength: float, generator: torch.Generator) -> None:
    """Move nearly transparent Gaussians by noise shaped as their covariance (eq. 8 of [1]).

    Args:
        rows: Changed in place.
        rate: Relative learning rate of the means at this step (1.6e-4 to 1.6e-6 in 3DGS).
        extent: Extent of the scene; the noise of [1] has a length in it, that of scenes of `REFERENCE_EXTENT`.
        strength: Factor; 5e5 in [1].
        generator: Generator of the noise.
    """
    t = rows.tensors
    # A gate that is open below an opacity of about 0.005: visible Gaussians stay where the gradient puts them.
    gate = torch.sigmoid(100 * (0.005 - t["logit_opacities"].sigmoid()))
    gate[: rows.far] = 0  # of a shell that is wide: it would be carried away
    moving = (gate > 1e-3).nonzero()[:, 0]
    noise = torch.randn(len(rows), 3, generator=generator)[moving]
    axes = semi_axes(t["quats"][moving], t["log_scales"][moving].exp())
    shaped = (axes @ (axes.transpose(1, 2) @ noise[..., None]))[..., 0]
    scale = strength * rate * REFERENCE_EXTENT**2 / extent
    t["means"][moving] += gate[moving, None] * scale * shaped


def _copies(
    rows: GaussianRows, source: torch.Tensor, min_opacity: float, jitter: float, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    """Rows for copies of `source` (with repetitions), after dividing the originals in place."""
    unique, counts = source.unique(return_counts=True)
    originals = rows.take(unique)
    opacity, factor = divide(originals["logit_opacities"].sigmoid(), counts + 1)
    opacity = opacity.clamp(min_opacity, _MAX_OPACITY)
    divided = {"logit_opacities": torch.logit(opacity), "log_scales": originals["log_scales"] + factor.log()[:, None]}
    rows.overwrite(unique, divided)
    copies = rows.take(source)
    # Coincident Gaussians get equal gradients and would stay one Gaussian for ever.
    noise = jitter * torch.randn(len(source), 3, generator=generator)
    axes = semi_axes(copies["quats"], copies["log_scales"].exp())
    copies["means"] = copies["means"] + (axes @ noise[..., None])[..., 0]
    return copies


def _draw(weights: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
    """`count` indices with replacement, by weight."""
    # torch.multinomial takes at most 2^24 categories and float32 sums drift: invert the distribution in float64.
    total = weights.double().cumsum(0)
    uniform = torch.rand(count, generator=generator, dtype=torch.float64) * total[-1]
    return torch.searchsorted(total, uniform).clamp(max=len(weights) - 1)
