"""J^T of a view by a scene's own parameters: what images say through the geometry of the Gaussians that these move.

What a hit says about the geometry of its Gaussian is summed up along all images in one traversal (hit_sums.py), of the
Gaussians alone that the parameters move. From there on it is torch's reverse mode through the scene.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from drgs.information.hit_sums import HitSums
from drgs.information.replay import Replay
from drgs.tracing.pose import quaternion_product

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import DeformableScene
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings

__all__ = ["NetworkRows"]

_FIELDS = {"means": 0, "quats": 3, "log_scales": 6, "logit_opacities": 9}
"""Fields of Gaussians -> where the geometry of a row has theirs; rotations in place of quats."""


class NetworkRows:
    """J^T of a view by parameters of its scene."""

    def __init__(
        self,
        scene: DeformableScene,
        camera: Camera,
        settings: RenderSettings,
        semantics: SemanticMetric | None,
        names: Sequence[str],
        mask: torch.Tensor | None = None,
    ) -> None:
        """
        Args:
            scene: The scene; where it knows which of its Gaussians `moving`, (N,) bool, says move, the others are not
                asked.
            camera, settings: The view.
            semantics: The metric of the features, whose channels follow the colors; None: colors alone.
            names: Parameters of the scene.
            mask: (H, W) what the rows are multiplied by; None: 1.
        """
        self._scene = scene
        self._view = camera, settings
        self._semantics = semantics
        self._mask = mask
        self._names = names
        with torch.no_grad():  # information is a number
            self._seen = scene.at(camera.time)
        # A scene that pulls images back by itself needs no graph of them.
        self._fields = None if hasattr(scene, "squared_slopes") else _Fields.of(scene, camera.time, names)

    @property
    def are_of_geometry(self) -> bool:
        """Whether the parameters reach the image by the geometry of the Gaussians alone; else there is no J^T here."""
        return self._fields is None or set(self._fields.made) <= set(_FIELDS)

    def along(self, images: torch.Tensor) -> HitSums:
        """Sums of the view's hits along (K, pixels, C) float32 cotangents of the rows, none added yet."""
        moves = getattr(self._scene, "moving", None)
        which = torch.ones(len(self._seen), dtype=torch.bool) if moves is None else moves.cpu()
        return HitSums(images, which)

    def squares(self, sums: HitSums) -> dict[str, torch.Tensor]:
        """Squared slopes of the parameters by name, summed over the images; the hits are walked along if no other
        traversal has added them.
        """
        if not sums.is_full:
            self._replay.add_up(sums)
        geometry = sums.geometry()
        told = geometry.any(2).any(0)  # a view shows few of those that move
        rows = sums.asked.to(told.device)[told]
        quats = self._seen.quats.detach().to(geometry.device)
        slopes = _raw(geometry[:, told], quats[rows])
        if self._fields is None:
            scene: Any = self._scene  # that has `squared_slopes`
            found = scene.squared_slopes(self._view[0].time, rows, slopes)
            return {name: found[name] for name in self._names}
        return self._fields.squares(slopes, rows)

    @functools.cached_property
    def _replay(self) -> Replay:
        seen = self._seen if self._semantics else self._seen.replace(features=None)
        return Replay(seen, *self._view, semantics=self._semantics, mask=self._mask)


class _Fields(NamedTuple):
    """Fields of a scene's Gaussians at a time, as a function of some of its parameters.

    Attributes:
        leaves: The parameters by name.
        made: The fields that depend on them.
    """

    leaves: dict[str, torch.Tensor]
    made: dict[str, torch.Tensor]

    @classmethod
    def of(cls, scene: DeformableScene, time: float | None, names: Sequence[str]) -> _Fields:
        """The scene as it is; its graph is kept."""
        values = {name: x.detach() for name, x in scene.parameters().items()}  # leaves of a graph of their own
        leaves = {name: values[name].clone().requires_grad_() for name in names}
        with torch.enable_grad():
            fields = scene.deform({**values, **leaves}, time).parameters()
        return cls(leaves, {name: x for name, x in fields.items() if x.requires_grad})

    def squares(self, slopes: Mapping[str, torch.Tensor], rows: torch.Tensor) -> dict[str, torch.Tensor]:
        """Squared slopes of the parameters, summed over K, from (K, M, ...) ones of the fields in M rows; in the other
        rows they are 0.
        """
        total = {name: torch.zeros_like(x, requires_grad=False) for name, x in self.leaves.items()}
        for own in zip(*(slopes[name] for name in self.made), strict=True):
            whole = [
                torch.zeros_like(x).index_copy_(0, rows.to(x.device), slope.to(x))
                for x, slope in zip(self.made.values(), own, strict=True)
            ]
            found = torch.autograd.grad(
                list(self.made.values()),
                list(self.leaves.values()),
                whole,
                retain_graph=True,
                materialize_grads=True,
                allow_unused=True,
            )
            for x, slope in zip(total.values(), found, strict=True):
                x.addcmul_(slope, slope)
        return total


def _raw(geometry: torch.Tensor, quats: torch.Tensor) -> dict[str, torch.Tensor]:
    """Slopes of raw fields, (K, M, ...) each, from (K, M, 10) ones of the geometry; `quats` are (M, 4).

    A rotation w, of the world, changes q by (0, w) q / 2. Along q nothing changes, so that the slope of q is in the
    span of these three, each |q| / 2 long and at right angles to the others.
    """
    q = quats.double()  # its square may be far from 1
    axes = torch.eye(3, dtype=q.dtype, device=q.device)
    ways = torch.stack([quaternion_product(axis.expand(len(q), 3), q) for axis in axes], 1)  # (M, 3, 4)
    ways = (ways * (2 / q.square().sum(1))[:, None, None]).to(geometry.dtype)
    parts = {name: geometry[..., at : at + 3] for name, at in _FIELDS.items()}
    by_quats = (parts["quats"][..., None] * ways).sum(-2)
    return parts | {"quats": by_quats, "logit_opacities": geometry[..., 9]}
