"""A scene whose Gaussians are computed once for each time: what several views of it, or questions to one, share."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import torch

from drgs.ellipsoids import DeformableScene, Gaussians, Scene

__all__ = ["once_per_time"]

_BYTES = 64 << 20  # of what is held, or those of one time


def once_per_time(scene: Scene) -> Scene:
    """The scene as it is now, its Gaussians as numbers, without a graph, each time's computed once.

    Parameters may not change while it is in use, so that it lives no longer than one call. What else the scene has is
    there, too. Gaussians, and what is no scene, are returned as they are.
    """
    if isinstance(scene, Gaussians | _OncePerTime) or not isinstance(scene, Scene):
        return scene
    return (_DeformableOncePerTime if isinstance(scene, DeformableScene) else _OncePerTime)(scene)


class _OncePerTime:
    """Such a scene; the times that were asked for least recently are given up for new ones."""

    def __init__(self, scene: Scene) -> None:
        self._scene: Any = scene
        self._seen: OrderedDict[float | None, Gaussians] = OrderedDict()
        self._most = 0  # times that are held; known when there are two

    def at(self, time: float | None) -> Gaussians:
        """The Gaussians at a time."""
        if time not in self._seen:
            with torch.no_grad():  # information is a number
                self._seen[time] = self._scene.at(time)
            if len(self._seen) > 1:
                self._most = self._most or max(1, _BYTES // max(1, self._own_bytes(self._seen[time])))
                if len(self._seen) > self._most:
                    self._seen.popitem(last=False)
        self._seen.move_to_end(time)
        return self._seen[time]

    def parameters(self) -> dict[str, torch.Tensor]:
        """Those of the scene."""
        return self._scene.parameters()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scene, name)

    def _own_bytes(self, seen: Gaussians) -> int:
        """Bytes of the tensors that are not parameters of the scene."""
        shared = {x.data_ptr() for x in self.parameters().values()}
        return sum(x.nbytes for x in seen.parameters().values() if x.data_ptr() not in shared)


class _DeformableOncePerTime(_OncePerTime):
    """The same of a scene that is a function of its parameters."""

    def deform(self, parameters: dict[str, torch.Tensor], time: float | torch.Tensor | None) -> Gaussians:
        """As the scene."""
        return self._scene.deform(parameters, time)
