"""Information of single views, kept while the scene stays what it is."""

from __future__ import annotations

import dataclasses
import hashlib
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians, Scene
from drgs.guards.arguments import must_be
from drgs.information.sums import Information

__all__ = ["Cache", "camera_key", "size_of", "value_key"]


class Cache:
    """What views tell, kept while the scene does not change, in a bounded number of bytes: of colors, 4 bytes a
    parameter and view, and with the block `backdrop` 4 bytes a pixel. A call holds what it has found until it is used,
    so that up to twice as many bytes are alive meanwhile.

    Forgets everything when it is asked about another scene than last time. A scene is another one if a tensor of its
    `parameters()` has come, gone, been replaced, or been changed in place by torch, or if its origin differs; one that
    moves, also if it is another object. Changes behind torch's back (`.data`, NumPy views) need `invalidate`.

    What cannot be recognized is taken for another scene, for which everything is computed anew: one whose
    `parameters()` makes its tensors at each call (`.detach()`, `.clone()`, views), so keep them and return the same
    ones; and one that moves and cannot be weakly referenced (a NamedTuple, a class with slots).

    Attributes:
        max_bytes: What is kept has no more; above it, what was used least recently goes.
        bytes: Bytes of all tensors that are kept now.
        hits, misses: Answers found and computed so far. With the block `backdrop` a view has two: what it tells, and
            how far away its surfaces are.
        evictions: Answers that went, or did not come in, for lack of room. Those of another scene are not counted.
    """

    def __init__(self, max_bytes: int = 1 << 30) -> None:
        """
        Args:
            max_bytes: A whole number, at least 0; 1 GiB by default, 150 views of 30,000 Gaussians of SH degree 3.
        Raises:
            ValueError: If it is no such number.
        """
        must_be("Cache", "max_bytes", max_bytes, int, "bytes that may be kept, e.g. 1 << 30")
        if max_bytes < 0:
            raise ValueError(f"Cache: max_bytes must be at least 0, got {max_bytes}; 0 keeps nothing")
        self._answers: OrderedDict[Hashable, Information] = OrderedDict()  # the one that was used last comes last
        self._scene: _State | None = None
        self._lock = threading.RLock()  # several Python threads may select at a time
        self.max_bytes = max_bytes
        self.bytes = 0
        self.hits = self.misses = self.evictions = 0

    def __len__(self) -> int:
        return len(self._answers)

    def __repr__(self) -> str:
        return (
            f"Cache({len(self)} answers, {self.bytes / 1e6:.1f} of {self.max_bytes / 1e6:.1f} MB, {self.hits} hits, "
            f"{self.misses} misses, {self.evictions} evictions)"
        )

    def invalidate(self) -> None:
        """Forget everything."""
        with self._lock:
            self._answers.clear()
            self.bytes = 0
            self._scene = None

    def find(self, scene: Scene, key: Hashable) -> Information | None:
        """What is stored under a key for this scene, which is a hit; None if nothing is."""
        with self._lock:
            self._look_at(scene)
            if key not in self._answers:
                return None
            self._answers.move_to_end(key)
            self.hits += 1
            return self._answers[key]

    def keep(self, scene: Scene, key: Hashable, answer: Information) -> None:
        """Store what was computed, which is a miss.

        Args:
            scene: That it was computed of; if another one was asked about since, nothing is stored.
            key: All else that it depends on: what is computed, its options, settings and camera.
            answer: The information.
        """
        with self._lock:
            self.misses += 1
            if self._scene is None or not self._scene.is_still(scene):
                return
            self._store(key, answer)

    def _look_at(self, scene: Scene) -> None:
        """Forget everything if it is another scene than last time."""
        if self._scene is None or not self._scene.is_still(scene):
            self.invalidate()
            self._scene = _State(scene)

    def _store(self, key: Hashable, answer: Information) -> None:
        """Keep an answer in place of one that is there, and let go of what there is no room for."""
        self._forget(key)  # computed twice, by two calls at a time
        if (size := size_of(answer)) > self.max_bytes:
            self.evictions += 1
            return
        self._answers[key] = answer
        self.bytes += size
        while self.bytes > self.max_bytes:
            self._forget(next(iter(self._answers)))
            self.evictions += 1

    def _forget(self, key: Hashable) -> None:
        """Let go of an answer, if it is there."""
        if (before := self._answers.pop(key, None)) is not None:
            self.bytes -= size_of(before)

    def get(self, scene: Scene, key: Hashable, compute: Callable[[], Information]) -> Information:
        """What is stored under a key for this scene, else what `compute` returns, which is then kept."""
        if (found := self.find(scene, key)) is not None:
            return found
        found = compute()
        self.keep(scene, key, found)
        return found


def size_of(information: Information) -> int:
    """Bytes of its tensors."""
    return sum(x.nbytes for x in information.values())


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
    """Equal for cameras that see the same: every field but the name by its value, so that a new field is in it, too."""
    names = [field.name for field in dataclasses.fields(camera) if field.name != "name"]
    return tuple(value_key(getattr(camera, name)) for name in names)


def value_key(x: Any) -> Hashable:
    """A hashable stand-in: arrays and tensors, which compare by entry, become a digest of their bytes."""
    if isinstance(x, torch.Tensor):  # a key is a value, whatever graph it is in
        x = x.detach().cpu().numpy()
    if not isinstance(x, np.ndarray):
        return x
    return (x.shape, x.dtype.str, hashlib.blake2b(x.tobytes(), digest_size=16).digest())
