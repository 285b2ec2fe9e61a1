"""J^T of a scene that moves: slopes by the raw fields of its Gaussians, pulled back to its own parameters.

`scene_jacobian` is the one way there. Its default is torch's reverse mode through `DeformableScene.deform`, one image
after another; a kind of scene that has a faster one registers it (`drgs.deform` does).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Protocol

import torch

from drgs.ellipsoids import DeformableScene


class SceneJacobian(Protocol):
    """J, the derivative of a scene's Gaussians at one time by some of its parameters.

    Attributes:
        fields: Raw fields of the Gaussians that depend on these parameters: a subset of `means`, `quats`, ...
        moving: (N,) bool, Gaussians whose fields depend on them; None: all may.
    """

    fields: frozenset[str]
    moving: torch.Tensor | None

    def squared_vjps(self, index: torch.Tensor, cotangents: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Squares of J^T u, summed over K cotangents u.

        Args:
            index: (M,) int64, ascending: Gaussians whose cotangents are given; all others have 0.
            cotangents: Field -> (K, M, ...); those of `fields` are there.
        Returns:
            A tensor of the shape of each parameter, by its name.
        """


@functools.singledispatch
def scene_jacobian(scene: DeformableScene, time: float | None, names: Sequence[str]) -> SceneJacobian:
    """J of a scene at a time, by the parameters of these names; parameters may not change while it is in use."""
    return TorchJacobian(scene, time, names)


class TorchJacobian:
    """J^T by torch's reverse mode through `deform`, whose graph is kept."""

    def __init__(self, scene: DeformableScene, time: float | None, names: Sequence[str]) -> None:
        values = {name: x.detach() for name, x in scene.parameters().items()}  # leaves of a graph of their own
        self._leaves = {name: values[name].clone().requires_grad_() for name in names}
        with torch.enable_grad():
            fields = scene.deform({**values, **self._leaves}, time).parameters()
        self._fields = {name: x for name, x in fields.items() if x.requires_grad}
        self.fields = frozenset(self._fields)
        self.moving: torch.Tensor | None = None

    def squared_vjps(self, index: torch.Tensor, cotangents: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """As `SceneJacobian`."""
        total = {name: torch.zeros_like(x, requires_grad=False) for name, x in self._leaves.items()}
        for own in zip(*(cotangents[name] for name in self._fields), strict=True):
            whole = [
                torch.zeros_like(x).index_copy_(0, index.to(x.device), slope.to(x))
                for x, slope in zip(self._fields.values(), own, strict=True)
            ]
            by_leaf = torch.autograd.grad(
                list(self._fields.values()),
                list(self._leaves.values()),
                whole,
                retain_graph=True,
                materialize_grads=True,
                allow_unused=True,
            )
            for x, slope in zip(total.values(), by_leaf, strict=True):
                x.addcmul_(slope, slope)
        return total
