"""A small scene that a network moves, with the names that information about a deformation goes by."""

from __future__ import annotations

import torch

from drgs.ellipsoids import Gaussians


class Moving:
    """Means and log-scales moved by a grid over x and time, looked up linearly, and a small network behind it."""

    cells, width = 4, 3

    def __init__(self, start: Gaussians, seed: int = 0, heads: float = 0.3):
        draw = torch.Generator().manual_seed(seed)
        dtype = start.means.dtype
        shapes = {"phi.grid.plane": (self.cells, self.cells, self.width), "phi.mlp.trunk": (self.width, self.width)}
        self.start = start.detach()
        self.weights = {n: torch.randn(s, generator=draw, dtype=dtype) for n, s in shapes.items()}
        self.weights["phi.mlp.means"] = heads * torch.randn(3, self.width, generator=draw, dtype=dtype)
        self.weights["phi.mlp.log_scales"] = heads * torch.randn(3, self.width, generator=draw, dtype=dtype)

    def parameters(self):
        return self.start.parameters() | self.weights

    def at(self, time):
        return self.deform(self.parameters(), time)

    def deform(self, parameters, time):
        p = dict(parameters)
        w = {name: p.pop(name) for name in self.weights}
        x = (torch.tanh(p["means"][:, 0]) + 1) / 2 * (self.cells - 1)
        place, t = x.detach().floor().clamp(0, self.cells - 2).long(), time * (self.cells - 1)
        step = min(int(t), self.cells - 2)
        left, s = (x - place)[:, None], t - step
        rows = (1 - s) * w["phi.grid.plane"][step] + s * w["phi.grid.plane"][step + 1]
        hidden = torch.tanh(((1 - left) * rows[place] + left * rows[place + 1]) @ w["phi.mlp.trunk"].T)
        moved = {
            "means": p["means"] + hidden @ w["phi.mlp.means"].T,
            "log_scales": p["log_scales"] + hidden @ w["phi.mlp.log_scales"].T,
        }
        return self.start.replace(**{**p, **moved})
