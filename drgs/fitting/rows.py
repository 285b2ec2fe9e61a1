"""The parameters of the Gaussians that are fitted: tensors with one row a Gaussian, and their Adam moments.

Density control (density.py) adds, moves and replaces rows of all tensors alike, whatever they mean. What has no row a
Gaussian is fitted beside them (networks.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from drgs.ellipsoids import Y_00, Gaussians
from drgs.fitting.adam import Adam


class GaussianRows:
    """N Gaussians as leaf tensors, one a parameter group, with an Adam optimizer whose rows follow theirs.

    SH coefficients above degree 0 exist only up to the active degree: what is not there yet costs nothing.

    Attributes:
        tensors: means, quats, log_scales, logit_opacities, sh_dc (N, 1, 3) and sh_rest (N, K - 1, 3), perhaps features
            (N, D), and any others (N, ...) whose rows shall follow the Gaussians.
        far: How many of the first rows are far away, beyond the scene (a skybox): density control leaves them alone,
            and means over all Gaussians leave them out.
        origin: (3,) float64 world that means are relative to.
        optimizer: One parameter group a tensor, named as in `tensors`.
    """

    def __init__(self, tensors: dict[str, torch.Tensor], origin: np.ndarray | None = None) -> None:
        self.far = 0
        self.origin = np.zeros(3) if origin is None else origin
        # Leaves of their own: what the caller has is neither changed nor differentiated.
        self.tensors = {name: x.detach().clone().requires_grad_() for name, x in tensors.items()}
        groups = [{"params": [x], "name": name} for name, x in self.tensors.items()]
        # eps as in 3DGS: gradients of a mean over pixels are far below torch's default of 1e-8.
        self.optimizer = Adam(groups, lr=0.0, eps=1e-15, fused=True)

    @classmethod
    def from_points(
        cls,
        points: torch.Tensor,
        colors: torch.Tensor,
        opacity: float = 0.1,
        scale: float = 1.0,
        origin: np.ndarray | None = None,
    ) -> GaussianRows:
        """One isotropic Gaussian a point, as wide as the points around it are far apart.

        Args:
            points: (N, 3) world; far from 0 in float64.
            colors: (N, 3) in [0, 1].
            opacity: Opacity of all of them.
            scale: Times the root of the mean squared distance to the three nearest points.
            origin: (3,) world that means are relative to; None for 0.
        """
        n = len(points)
        means = points if origin is None else points.double() - torch.from_numpy(origin)
        quats = torch.zeros(n, 4)
        quats[:, 0] = 1
        return cls(
            {
                "means": means.float(),
                "quats": quats,
                "log_scales": (scale * _spacing(points)).log().float()[:, None].repeat(1, 3),
                "logit_opacities": torch.full((n,), math.log(opacity / (1 - opacity))),
                "sh_dc": ((colors.float() - 0.5) * (1 / Y_00))[:, None, :],
                "sh_rest": torch.zeros(n, 0, 3),
            },
            origin,
        )

    def __len__(self) -> int:
        return len(self.tensors["means"])

    @property
    def sh_degree(self) -> int:
        """The degree of SH that is in use, 0 to 3."""
        return math.isqrt(1 + self.tensors["sh_rest"].shape[1]) - 1

    def gaussians(self) -> Gaussians:
        """The Gaussians; gradients reach `tensors`."""
        t = self.tensors
        sh = torch.cat([t["sh_dc"], t["sh_rest"]], dim=1) if self.sh_degree else t["sh_dc"]
        features = t.get("features")
        return Gaussians(t["means"], t["quats"], t["log_scales"], t["logit_opacities"], sh, features, self.origin)

    def places(self) -> torch.Tensor:
        """(N, 3) float64 means in the world, values without a graph."""
        return self.tensors["means"].detach().double() + torch.from_numpy(self.origin)  # measured, not optimized

    def set_rates(self, rates: dict[str, float]) -> None:
        """Learning rates by tensor name."""
        for group in self.optimizer.param_groups:
            group["lr"] = rates[group["name"]]

    def raise_sh_degree(self) -> None:
        """Add the coefficients of the next degree, 0 and with no moments."""
        old = self.tensors["sh_rest"]
        self._extend("sh_rest", old.new_zeros(len(old), 2 * self.sh_degree + 3, 3), 1)

    def add_tensor(self, name: str, values: torch.Tensor) -> None:
        """One more tensor with a row a Gaussian, with no moments; the others keep theirs."""
        self.tensors[name] = x = values.detach().clone().requires_grad_()  # a leaf of its own, as in `__init__`
        self.optimizer.add_param_group({"params": [x], "name": name})

    def add_far(self, rows: dict[str, torch.Tensor]) -> None:
        """Put the Gaussians of a shell before all others, with no moments; before the first step alone.

        Raises:
            ValueError: If the optimizer has made a step, whose moments would be lost.
        """
        if self.optimizer.state:
            raise ValueError("fit: a skybox must be there before the first step, got one later; begin a fit with it")
        count = len(rows["means"])
        first = {name: rows.get(name, x.new_zeros(count, *x.shape[1:])) for name, x in self.tensors.items()}
        whole = GaussianRows({name: torch.cat([first[name], x.detach()]) for name, x in self.tensors.items()})
        self.tensors, self.optimizer = whole.tensors, whole.optimizer
        self.far = count

    def scale_colors(self, factors: torch.Tensor) -> None:
        """Multiply the colors that directions see by (3,) factors of R, G and B; moments stay.

        A color is 0.5 plus the sum of its SH.
        """
        with torch.no_grad():  # leaves are changed in place
            self.tensors["sh_dc"].mul_(factors).add_((factors - 1) * (0.5 / Y_00))
            self.tensors["sh_rest"].mul_(factors)

    def append(self, rows: dict[str, torch.Tensor]) -> None:
        """Add Gaussians with zero moments; in tensors that `rows` lacks, their rows are 0."""
        count = len(rows["means"])
        for name, old in list(self.tensors.items()):
            new = rows[name] if name in rows else old.new_zeros(count, *old.shape[1:])
            self._extend(name, new, 0)

    def overwrite(self, index: torch.Tensor, rows: dict[str, torch.Tensor]) -> None:
        """Replace Gaussians at `index` (unique) and forget the moments of the given tensors there."""
        with torch.no_grad():  # leaves are changed in place
            for name, new in rows.items():
                self.tensors[name][index] = new
                for moment in self._moments(name):
                    moment[index] = 0

    def keep(self, index: torch.Tensor) -> None:
        """Remove all Gaussians but those at `index`, sorted, with all of a shell; their moments stay."""
        for name, values in self.take(index).items():
            self._replace(name, values, lambda moment: moment[index])

    def take(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Copies of rows, values without a graph."""
        # Indexing copies, so that density control may change the tensors afterwards.
        return {name: x.detach()[index] for name, x in self.tensors.items()}

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that a checkpoint needs, by name; values without a graph."""
        # Detached: a file holds values.
        out = {f"parameter.{name}": x.detach() for name, x in self.tensors.items()}
        for name, x in self.tensors.items():
            out |= {f"adam.{name}.{key}": v for key, v in self.optimizer.state.get(x, {}).items()}
        return out

    def header(self) -> dict:
        """What a checkpoint's header says of the rows."""
        origin = {"origin": self.origin.tolist()} if self.origin.any() else {}
        return ({"skybox": self.far} if self.far else {}) | origin

    @classmethod
    def from_state(cls, state: dict[str, torch.Tensor], header: Mapping[str, Any] | None = None) -> GaussianRows:
        """The inverse of `state` and `header`; other keys are ignored."""
        prefix = "parameter."
        header = header or {}
        origin = np.array(header.get("origin", [0.0] * 3), np.float64)
        rows = cls({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}, origin)
        for name, x in rows.tensors.items():
            prefix = f"adam.{name}."
            moments = {k.removeprefix(prefix): v.clone() for k, v in state.items() if k.startswith(prefix)}
            if moments:
                rows.optimizer.state[x] = moments
        rows.far = header.get("skybox", 0)
        return rows

    def _moments(self, name: str) -> list[torch.Tensor]:
        state = self.optimizer.state.get(self.tensors[name], {})
        return [state[key] for key in ("exp_avg", "exp_avg_sq") if key in state]

    def _extend(self, name: str, more: torch.Tensor, dim: int) -> None:
        """Concatenate a tensor with `more` along `dim`, and its moments with 0."""
        new = torch.cat([self.tensors[name].detach(), more.detach()], dim)  # values of a new leaf
        self._replace(name, new, lambda moment: torch.cat([moment, torch.zeros_like(more)], dim))

    def _replace(self, name: str, new: torch.Tensor, moments: Callable[[torch.Tensor], torch.Tensor]) -> None:
        """Put other values in the place of a tensor's; `moments` makes those of the optimizer from the old ones."""
        old, self.tensors[name] = self.tensors[name], new.requires_grad_()
        group = next(g for g in self.optimizer.param_groups if g["name"] == name)
        group["params"] = [new]
        state = self.optimizer.state.pop(old, {})
        for key in {"exp_avg", "exp_avg_sq"} & state.keys():
            state[key] = moments(state[key])
        if state:
            self.optimizer.state[new] = state


def _spacing(points: torch.Tensor) -> torch.Tensor:
    """(N,) root of the mean squared distance to the three nearest other points, at least 1e-3 of the median."""
    import cv2

    n = len(points)
    if n < 2:
        return torch.ones(n)
    table = points.double().numpy()
    table = np.ascontiguousarray(table - table.mean(0), np.float32)
    # Algorithm 4 is one kd-tree; checks = -1 makes its search exact.
    tree = cv2.flann.Index(table, {"algorithm": 4, "leaf_max_size": 10})
    _, squared = tree.knnSearch(table, min(4, n), params={"checks": -1})
    spacing = torch.from_numpy(squared[:, 1:]).mean(1).sqrt()
    # Coincident points must not become Gaussians of no size; where all coincide, any small size will do.
    return spacing.clamp(min=float(spacing.median()) * 1e-3 or 1e-7)
