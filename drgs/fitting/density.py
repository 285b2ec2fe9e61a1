"""What is optimized and how many there are: parameter tensors with their Adam moments, and MCMC density control.

Density control needs no screen-space gradient. Gaussians that have become transparent are moved onto opaque ones, new
ones are added the same way up to a fixed budget, and transparent ones wander by noise. Opacity and scale are chosen
so that n copies in one place look as the one Gaussian did.

Reference:
    [1] Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
"""

from __future__ import annotations

import math

import torch

from drgs.ellipsoids import Gaussians, semi_axes

__all__ = ["Model", "add_gaussians", "divide", "explore", "relocate"]

_MAX_COPIES = 51  # of one Gaussian at a time [1]; binomials up to C(50, k) are exact enough in float64
_MAX_OPACITY = 1 - 1e-6
_UNIT = 5.0  # the noise of [1] has a length in it: its scenes have an extent of about 5


class Model:
    """N Gaussians as leaf tensors, one a parameter group, with an Adam optimizer whose rows follow theirs.

    SH coefficients above degree 0 exist only up to the active degree: what is not there yet costs nothing.

    Attributes:
        tensors: means, quats, log_scales, logit_opacities, sh_dc (N, 1, 3) and sh_rest (N, K - 1, 3).
        optimizer: One parameter group a tensor, named as in `tensors`.
    """

    def __init__(self, tensors: dict[str, torch.Tensor]):
        self.tensors = {name: x.detach().clone().requires_grad_() for name, x in tensors.items()}
        groups = [{"params": [x], "name": name} for name, x in self.tensors.items()]
        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)

    @classmethod
    def from_points(cls, points: torch.Tensor, colors: torch.Tensor, opacity: float = 0.1, scale: float = 1.0) -> Model:
        """One isotropic Gaussian a point, as wide as the points around it are far apart.

        Args:
            points: (N, 3) world.
            colors: (N, 3) in [0, 1].
            opacity: Of all of them.
            scale: Times the root of the mean squared distance to the three nearest points.
        """
        n = len(points)
        quats = torch.zeros(n, 4)
        quats[:, 0] = 1
        return cls(
            {
                "means": points.float(),
                "quats": quats,
                "log_scales": (scale * _spacing(points)).log().float()[:, None].repeat(1, 3),
                "logit_opacities": torch.full((n,), math.log(opacity / (1 - opacity))),
                "sh_dc": ((colors.float() - 0.5) * math.sqrt(4 * math.pi))[:, None, :],
                "sh_rest": torch.zeros(n, 0, 3),
            }
        )

    def __len__(self) -> int:
        return len(self.tensors["means"])

    @property
    def sh_degree(self) -> int:
        """0..3."""
        return math.isqrt(1 + self.tensors["sh_rest"].shape[1]) - 1

    def gaussians(self) -> Gaussians:
        """The Gaussians; gradients reach `tensors`."""
        t = self.tensors
        sh = torch.cat([t["sh_dc"], t["sh_rest"]], dim=1) if self.sh_degree else t["sh_dc"]
        return Gaussians(t["means"], t["quats"], t["log_scales"], t["logit_opacities"], sh)

    def set_rates(self, rates: dict[str, float]) -> None:
        """Learning rates by tensor name."""
        for group in self.optimizer.param_groups:
            group["lr"] = rates[group["name"]]

    def raise_sh_degree(self) -> None:
        """Add the coefficients of the next degree, 0 and with no moments."""
        missing = 2 * self.sh_degree + 3
        self._map("sh_rest", lambda x: torch.cat([x, x.new_zeros(len(x), missing, 3)], dim=1))

    def append(self, rows: dict[str, torch.Tensor]) -> None:
        """Add Gaussians with zero moments."""
        for name, new in rows.items():
            self._map(name, lambda x, new=new: torch.cat([x, new]), lambda m, new=new: torch.cat([m, 0 * new]))

    def overwrite(self, index: torch.Tensor, rows: dict[str, torch.Tensor]) -> None:
        """Replace Gaussians at `index` (unique) and forget the moments of the given tensors there."""
        with torch.no_grad():
            for name, new in rows.items():
                self.tensors[name][index] = new
                for moment in self._moments(name):
                    moment[index] = 0

    def take(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Copies of rows."""
        return {name: x.detach()[index] for name, x in self.tensors.items()}

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that a checkpoint needs, by name."""
        out = {f"parameter.{name}": x.detach() for name, x in self.tensors.items()}
        for name, x in self.tensors.items():
            out |= {f"adam.{name}.{key}": v for key, v in self.optimizer.state.get(x, {}).items()}
        return out

    @classmethod
    def from_state(cls, state: dict[str, torch.Tensor]) -> Model:
        """The inverse of `state`; other keys are ignored."""
        prefix = "parameter."
        model = cls({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
        for name, x in model.tensors.items():
            prefix = f"adam.{name}."
            moments = {k.removeprefix(prefix): v.clone() for k, v in state.items() if k.startswith(prefix)}
            if moments:
                model.optimizer.state[x] = moments
        return model

    def _moments(self, name: str) -> list[torch.Tensor]:
        state = self.optimizer.state.get(self.tensors[name], {})
        return [state[key] for key in ("exp_avg", "exp_avg_sq") if key in state]

    @torch.no_grad()
    def _map(self, name: str, change, change_moments=None) -> None:
        """Replace one tensor by `change(tensor)`, and its moments likewise."""
        old = self.tensors[name]
        new = change(old.detach()).requires_grad_()
        group = next(g for g in self.optimizer.param_groups if g["name"] == name)
        group["params"] = [new]
        state = self.optimizer.state.pop(old, {})
        for key in ("exp_avg", "exp_avg_sq"):
            if key in state:
                state[key] = (change_moments or change)(state[key])
        if state:
            self.optimizer.state[new] = state
        self.tensors[name] = new


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
    top, chosen = n.double()[:, None], k + 1
    log_binomial = torch.lgamma(top + 1) - torch.lgamma(chosen + 1) - torch.lgamma((top - chosen).clamp(min=0) + 1)
    terms = torch.exp(log_binomial + chosen * new.log()[:, None]) * (-1) ** k / chosen.sqrt()
    bottom = torch.where(chosen <= top, terms, 0).sum(1)
    return new.to(opacity.dtype), (old / bottom).to(opacity.dtype)


def relocate(model: Model, min_opacity: float, jitter: float, generator: torch.Generator) -> int:
    """Move Gaussians with opacity <= `min_opacity` onto others, drawn by opacity; how many were moved.

    Args:
        model: Changed in place; moments of all that moved, and of opacity and scale of all that were divided, are 0.
        min_opacity: Below it a Gaussian is dead.
        jitter: Standard deviation of a copy's displacement, in units of the Gaussian's own.
        generator: Of all random choices.
    """
    opacity = model.tensors["logit_opacities"].detach().sigmoid()
    is_dead = opacity <= min_opacity
    dead, alive = is_dead.nonzero()[:, 0], (~is_dead).nonzero()[:, 0]
    if not len(dead) or not len(alive):
        return 0
    source = alive[_draw(opacity[alive], len(dead), generator)]
    model.overwrite(dead, _copies(model, source, min_opacity, jitter, generator))
    return len(dead)


def add_gaussians(model: Model, count: int, min_opacity: float, jitter: float, generator: torch.Generator) -> int:
    """Add `count` copies of Gaussians drawn by opacity; arguments as in `relocate`. How many were added."""
    opacity = model.tensors["logit_opacities"].detach().sigmoid()
    if count <= 0 or not len(model):
        return 0
    source = _draw(opacity, count, generator)
    model.append(_copies(model, source, min_opacity, jitter, generator))
    return count


@torch.no_grad()
def explore(model: Model, rate: float, extent: float, strength: float, generator: torch.Generator) -> None:
    """Move nearly transparent Gaussians by noise shaped as their covariance (eq. 8 of [1]).

    Args:
        model: Changed in place.
        rate: Relative learning rate of the means at this step (1.6e-4 to 1.6e-6 in 3DGS).
        extent: Of the scene; the noise of [1] depends on the unit of length, here it does not.
        strength: Factor; 5e5 in [1].
        generator: Of the noise.
    """
    t = model.tensors
    # A gate that is open below an opacity of about 0.005: visible Gaussians stay where the gradient puts them.
    gate = torch.sigmoid(100 * (0.005 - t["logit_opacities"].sigmoid()))
    moving = (gate > 1e-3).nonzero()[:, 0]
    noise = torch.randn(len(model), 3, generator=generator)[moving]
    axes = semi_axes(t["quats"][moving], t["log_scales"][moving].exp())
    shaped = (axes @ (axes.transpose(1, 2) @ noise[..., None]))[..., 0]
    scale = strength * rate * _UNIT**2 / extent
    t["means"][moving] += gate[moving, None] * scale * shaped


def _copies(
    model: Model, source: torch.Tensor, min_opacity: float, jitter: float, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    """Rows for copies of `source` (with repetitions), after dividing the originals in place."""
    unique, counts = source.unique(return_counts=True)
    rows = model.take(unique)
    opacity, factor = divide(rows["logit_opacities"].sigmoid(), counts + 1)
    opacity = opacity.clamp(min_opacity, _MAX_OPACITY)
    divided = {"logit_opacities": torch.logit(opacity), "log_scales": rows["log_scales"] + factor.log()[:, None]}
    model.overwrite(unique, divided)
    copies = model.take(source)
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


def _spacing(points: torch.Tensor) -> torch.Tensor:
    """(N,) root of the mean squared distance to the three nearest other points, at least 1e-3 of the median."""
    import cv2
    import numpy as np

    n = len(points)
    if n < 2:
        return torch.ones(n)
    table = points.double().numpy()
    table = np.ascontiguousarray(table - table.mean(0), np.float32)
    # Algorithm 4 is one kd-tree; checks = -1 makes its search exact.
    tree = cv2.flann.Index(table, {"algorithm": 4, "leaf_max_size": 10})
    _, squared = tree.knnSearch(table, min(4, n), params={"checks": -1})
    spacing = torch.from_numpy(squared[:, 1:]).mean(1).sqrt()
    return spacing.clamp(min=float(spacing.median()) * 1e-3 or 1e-7)
