"""Information of single views, kept while the scene stays what it is."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.gain import Information

__all__ = ["Cache", "camera_key"]


class Cache:
    """Information of views, kept while the scene does not change: 4 bytes a parameter and view.

    Forgets everything when it is asked about another scene than last time. A scene is another one if a tensor of its
    `parameters()` has come, gone, been replaced, or been changed in place by torch, or if its origin differs. Changes
    behind torch's back (`.data`, NumPy views) need `invalidate`.

    Attributes:
        hits, misses: Views found and computed so far.
    """

    def __init__(self) -> None:
        self._views: dict[Hashable, Information] = {}
        self._scene: _Scene | None = None
        self.hits = self.misses = 0

    def __len__(self) -> int:
        return len(self._views)

    def invalidate(self) -> None:
        """Forget everything."""
        self._views.clear()
        self._scene = None

    def get(self, scene: Gaussians, key: Hashable, compute: Callable[[], Information]) -> Information:
        """What is stored under a key for this scene, else what `compute` returns.

        Args:
            scene: As it is now.
            key: Of all else that the information depends on: what is computed, its options, settings and camera.
            compute: Called where nothing is stored.
        """
        if self._scene is None or not self._scene.is_still(scene):
            self.invalidate()
            self._scene = _Scene(scene)
        if key not in self._views:
            self._views[key] = compute()
            self.misses += 1
        else:
            self.hits += 1
        return self._views[key]


class _Scene:
    """What a scene was when information was computed. Weak: a cache must not keep an earlier state alive."""

    def __init__(self, scene: Gaussians):
        self.parameters = {name: (weakref.ref(x), x._version) for name, x in scene.parameters().items()}
        self.origin = scene.origin.tobytes()

    def is_still(self, scene: Gaussians) -> bool:
        """Whether a scene has the same tensors, unchanged."""
        now = scene.parameters()
        if now.keys() != self.parameters.keys() or scene.origin.tobytes() != self.origin:
            return False
        pairs = [(now[name], *then) for name, then in self.parameters.items()]
        return all(then() is x and version == x._version for x, then, version in pairs)


def camera_key(camera: Camera) -> tuple:
    """Equal for cameras that see the same: every field by its value, so that a new field is in the key, too."""
    return tuple(_by_value(getattr(camera, field.name)) for field in dataclasses.fields(camera))


def _by_value(x: Any) -> Hashable:
    """A hashable stand-in: arrays and tensors, which compare by entry, become their bytes."""
    if isinstance(x, torch.Tensor):
        x = x.detach().cpu().numpy()
    return (x.shape, x.dtype.str, x.tobytes()) if isinstance(x, np.ndarray) else x
