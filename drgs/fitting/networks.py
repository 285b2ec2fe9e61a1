"""Torch modules that are fitted beside the Gaussians: what has no row a Gaussian, and density control leaves alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch

from drgs.fitting.adam import Adam

_T = TypeVar("_T")

Rate = float | Callable[[float], float]
"""A learning rate, or what gives it from the fraction of the fit that is done."""


def rate_at(rate: Rate, part: float) -> float:
    """The learning rate when the fraction `part` of the fit is done."""
    return rate(part) if callable(rate) else rate


class Network:
    """A torch module with its optimizer, its learning rate and its entries in a checkpoint.

    Parts of a module with rates of their own are networks of their own: `Network("field.grid", field.grid, 1.6e-3)`.

    Attributes:
        name: Name of its entries in a checkpoint: `NAME.parameter.*` (parameters and buffers) and `NAME.adam.*`.
        module: What losses, or the scene, call.
        rate: Its learning rate.
        factors: Factors of the learning rate of some parameters, by name, e.g. of those that have a unit of length.
        constraint: Called after every step that changes the module, to restore what must hold; None: nothing must.
        fused: One pass of the optimizer over the memory of a parameter, for large ones; rounds in other places.
        optimizer: Adam, with torch's defaults.
    """

    def __init__(
        self,
        name: str,
        module: torch.nn.Module,
        rate: Rate,
        factors: Mapping[str, float] | None = None,
        fused: bool = False,
        constraint: Callable[[], None] | None = None,
    ) -> None:
        self.name = name
        self.module = module
        self.rate = rate
        self.constraint = constraint
        self._factors = factors or {}
        groups: dict[float, list] = {}
        for key, x in module.named_parameters():
            groups.setdefault(self._factors.get(key, 1.0), []).append(x)
        self.optimizer = Adam(
            [{"params": listed, "factor": factor} for factor, listed in groups.items()],
            lr=rate_at(rate, 0.0),
            fused=fused or None,
        )

    def set_rate(self, part: float) -> None:
        """The learning rate for a step after the fraction `part` of the fit."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate_at(self.rate, part) * group["factor"]

    def hold(self) -> None:
        """Restore what must hold after a step, unless its rate was 0."""
        if self.constraint is not None and any(group["lr"] for group in self.optimizer.param_groups):
            self.constraint()

    def extend(self, change: Callable[[], _T]) -> _T:
        """Let the module get parameters more, or parameters with more rows, between two steps of its optimizer.

        What was there keeps its moments, and those of what is new are 0, as if its gradient had been 0 until now.

        Args:
            change: Called once. A parameter that it replaces by another has the same rows first.
        Returns:
            What `change` returns.
        """
        before = dict(self.module.named_parameters())
        result = change()
        for key, x in self.module.named_parameters():
            was = before.get(key)
            if was is x:
                continue
            factor = self._factors.get(key, 1.0)
            group = next(group for group in self.optimizer.param_groups if group["factor"] == factor)
            if was is None:
                group["params"].append(x)
                continue
            group["params"] = [x if y is was else y for y in group["params"]]
            moments = self.optimizer.state.pop(was, {})
            for moment, value in moments.items():
                if value.shape == was.shape:  # else it is the count of steps
                    moments[moment] = torch.cat([value, value.new_zeros(len(x) - len(was), *x.shape[1:])])
            if moments:
                self.optimizer.state[x] = moments
        return result

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that a checkpoint needs, by name; a tensor that has several names is copied under each of them."""
        out = {f"{self.name}.parameter.{key}": x.clone() for key, x in self.module.state_dict().items()}
        for key, x in self.module.named_parameters():
            moments = self.optimizer.state.get(x, {})
            out |= {f"{self.name}.adam.{key}.{moment}": value for moment, value in moments.items()}
        return out

    def restore(self, tensors: dict[str, torch.Tensor], where: str) -> None:
        """Continue from `state`; other keys are ignored.

        Args:
            tensors: Tensors of a checkpoint.
            where: It, for the message.
        Raises:
            ValueError: If a parameter is missing, or has another shape.
        """
        saved = _below(tensors, f"{self.name}.parameter.")
        for key, x in self.module.state_dict().items():
            got = tuple(saved[key].shape) if key in saved else "none"
            if got != tuple(x.shape):
                raise ValueError(
                    f"{where}: {self.name}.parameter.{key} must have shape {tuple(x.shape)}, got {got}; fit into "
                    "another run folder (-o)"
                )
        self.module.load_state_dict({key: saved[key] for key in self.module.state_dict()})
        for key, x in self.module.named_parameters():
            if moments := _below(tensors, f"{self.name}.adam.{key}."):
                self.optimizer.state[x] = {moment: value.clone() for moment, value in moments.items()}


def saved_networks(tensors: dict[str, torch.Tensor], header: dict) -> dict[str, dict[str, torch.Tensor]]:
    """What `Module.load_state_dict` takes, by the names of the networks of a checkpoint."""
    return {name: _below(tensors, f"{name}.parameter.") for name in header.get("networks", ())}


def _below(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {key.removeprefix(prefix): x for key, x in tensors.items() if key.startswith(prefix)}
