"""Information of single views, kept while the scene stays what it is."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians, Scene
from drgs.gain import Information

__all__ = ["Cache", "camera_key", "value_key"]


class Cache:
    """Information of views, kept while the scene does not change: 4 bytes a parameter and view.

    Forgets everything when it is asked about another scene than last time. A scene is another one if a tensor of its
    `parameters()` has come, gone, been replaced, or been changed in place by torch, or if its origin differs; one that
    moves, also if it is another object. Changes behind torch's back (`.data`, NumPy views) need `invalidate`.

    What cannot be recognized is taken for another scene, for which everything is computed anew: one whose
    `parameters()` makes its tensors at each call (`.detach()`, `.clone()`, views), so keep them and return the same
    ones; and one that moves and cannot be weakly referenced (a NamedTuple, a class with slots).

    Attributes:
        hits, misses: Views found and computed so far.
    """

    def __init__(self) -> None:
        self._views: dict[Hashable, Information] = {}
        self._scene: _State | None = None
        self.hits = self.misses = 0

    def __len__(self) -> int:
        return len(self._views)

    def invalidate(self) -> None:
        """Forget everything."""
        self._views.clear()
        self._scene = None

    def recognizes(self, scene: Scene) -> bool:
        """Whether a scene is taken for itself when it comes again, so that what is stored for it is found."""
        return _State(scene).is_still(scene)

    def has(self, scene: Scene, key: Hashable) -> bool:
        """Whether `get` would find something stored."""
        return self._scene is not None and self._scene.is_still(scene) and key in self._views

    def get(self, scene: Scene, key: Hashable, compute: Callable[[], Information]) -> Information:
        """What is stored under a key for this scene, else what `compute` returns.

        Args:
            scene: As it is now.
            key: Of all else that the information depends on: what is computed, its options, settings and camera.
            compute: Called where nothing is stored.
        """
        if self._scene is None or not self._scene.is_still(scene):
            self.invalidate()
            self._scene = _State(scene)
        if key not in self._views:
            self._views[key] = compute()
            self.misses += 1
        else:
            self.hits += 1
        return self._views[key]


class _State:
    """What a scene was when information was computed. Weak: a cache must not keep an earlier state alive.

    A reference that has died is to something that has gone, so it equals nothing.
    """

    def __init__(self, scene: Scene):
        self.parameters = {name: (weakref.ref(x), x._version) for name, x in scene.parameters().items()}
        # Gaussians are their parameters and an origin; what else another kind of scene is made of, only it knows.
        self.origin = scene.origin.tobytes() if isinstance(scene, Gaussians) else None
        self.itself = None if isinstance(scene, Gaussians) else _reference(scene)

    def is_still(self, scene: Scene) -> bool:
        """Whether a scene has the same tensors, unchanged, and all else as it was."""
        origin = scene.origin.tobytes() if isinstance(scene, Gaussians) else None
        if origin != self.origin or (self.itself is not None and self.itself() is not scene):
            return False
        now = scene.parameters()  # alive while it is compared
        if now.keys() != self.parameters.keys():
            return False
        return all(
            now[name] is old() and now[name]._version == version for name, (old, version) in self.parameters.items()
        )


def _reference(scene: Scene) -> Callable[[], Scene | None]:
    """A weak reference, or one that is dead from the start."""
    try:
        return weakref.ref(scene)
    except TypeError:
        return lambda: None


def camera_key(camera: Camera) -> tuple:
    """Equal for cameras that see the same: every field by its value, so that a new field is in the key, too."""
    return tuple(value_key(getattr(camera, field.name)) for field in dataclasses.fields(camera))


def value_key(x: Any) -> Hashable:
    """A hashable stand-in: arrays and tensors, which compare by entry, become their bytes."""
    if isinstance(x, torch.Tensor):  # a key is a value, whatever graph it is in
        x = x.detach().cpu().numpy()
    return (x.shape, x.dtype.str, x.tobytes()) if isinstance(x, np.ndarray) else x
