"""Quantities of single views, kept while the scene stays what it is, or while what a view sees changes by little."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import math
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.checks.arguments import must_be
from drgs.ellipsoids import Gaussians, Scene
from drgs.information.choices import GAUSSIAN_GROUPS
from drgs.information.sums import Information
from drgs.io.json_files import check_json
from drgs.selection.drift import Shapes, change_of_view

_COLORS = "sh"  # whose information about base colors is the sum of w^2
_OF_GAUSSIANS = (*GAUSSIAN_GROUPS, "coverage")
_STATE = {"answers": [{"question": str, "view": int, "shapes": int}], "sh": [int], "now": (None, int)}
_ADVICE = "restore the file, or begin anew"


class ViewKey(NamedTuple):
    """Key of a quantity of one view.

    Attributes:
        quantity: What was computed, with all options and settings.
        camera: `camera_key` of the view.
        mask: The mask's value; None: there is none.
    """

    quantity: Hashable
    camera: Hashable
    mask: Hashable


class NotCached(Exception):  # noqa: N818  # no error: the caller does without the view
    """Nothing is kept of a view, and nothing is to be computed.

    Attributes:
        quantity: What was to be computed, as in a `ViewKey`.
    """

    def __init__(self, quantity: Hashable) -> None:
        super().__init__("nothing is kept of a view")
        self.quantity = quantity


class _Entry(NamedTuple):
    """A computed quantity of a view, and with a bound the Gaussians that it was computed of."""

    computed: Information
    shapes: Shapes | None


@dataclasses.dataclass(frozen=True)
class _Saved:
    """A quantity that a file names, as long as it has not been looked for again."""

    name: str


class Cache:
    """Quantities of single views, kept while the scene does not change, in a bounded number of bytes: of colors, 4
    bytes a parameter and view, and with the block `backdrop` 4 bytes a pixel. A call holds what is kept until it is
    used, so that up to twice as many bytes are alive meanwhile.

    Forgets everything when it is used with another scene than last time. A scene is another one if a tensor of its
    `parameters()` has come, gone, been replaced, or been changed in place by torch, or if its origin differs; one that
    moves, also if it is another object. Changes behind torch's back (`.data`, NumPy views) need `invalidate`.

    What cannot be recognized is taken for another scene, for which everything is computed anew: one whose
    `parameters()` makes its tensors at each call (`.detach()`, `.clone()`, views), so keep them and return the same
    ones; and one that moves and cannot be weakly referenced (a NamedTuple, a class with slots).

    With a `bound` a scene may change, as a model does that is being fitted: what is kept of a view lasts while what the
    view sees has changed by at most that (`drgs.selection.drift`). This is for Gaussians that keep their places in the
    list; new ones come at its end, and what was computed before has zeros for them. Where the list gets shorter
    everything is forgotten. Only views of cameras that are expected are kept.

    Attributes:
        max_bytes: What is kept has no more; above it, what was used least recently goes.
        bound: The largest change of a view that is still used, in [0, 1]; None: nothing may change.
        computes: With a bound, whether views that have changed by more are to be computed anew. If not, what is kept is
            used as it is, and `NotCached` is raised where nothing is.
        changes: Camera, as `camera_key` gives it -> largest change of what was used of it since this was emptied.
        forgot_saved: Whether what a file had was forgotten, because other quantities were looked for (`restore`).
        bytes: Bytes of all tensors that are kept now.
        hits, misses: Views that were kept, and that were computed, so far. With the block `backdrop` a view counts
            twice: its information, and how far away its surfaces are.
        evictions: Views that went, or did not come in, for lack of room. Those of another scene are not counted.
    """

    def __init__(self, max_bytes: int = 1 << 30, *, bound: float | None = None) -> None:
        """
        Args:
            max_bytes: A whole number, at least 0; 1 GiB by default, 150 views of 30,000 Gaussians of SH degree 3. With
                a bound, 64 bytes a Gaussian come on top for each state of the scene that is kept.
            bound: See the attributes.
        Raises:
            ValueError: If `max_bytes` is no such number.
        """
        must_be("Cache", "max_bytes", max_bytes, int, "bytes that may be kept, e.g. 1 << 30")
        if max_bytes < 0:
            raise ValueError(f"Cache: max_bytes must be at least 0, got {max_bytes}; 0 keeps nothing")
        self._kept: OrderedDict[Hashable, _Entry] = OrderedDict()  # the one that was used last comes last
        self._lock = threading.RLock()  # several Python threads may select at a time
        self.max_bytes = max_bytes
        self.bound = bound
        self.computes = True
        self.changes: dict[Hashable, float] = {}
        self.bytes = 0
        self.hits = self.misses = self.evictions = 0
        self._state: _State | None = None  # of the scene, without a bound
        self._now: tuple[Scene | None, Shapes] | None = None  # with one: the scene, and what of it is compared
        self._cameras: dict[Hashable, Camera] = {}  # that are expected
        self._image_weights: dict[Hashable, torch.Tensor] = {}  # camera -> (N,) sum of w^2 of each Gaussian
        self.forgot_saved = False
        self._unclaimed: set[str] = set()  # quantities of a file that have not been looked for again
        # To the Gaussians as they are now: id of shapes -> (N,); key -> of its view.
        self._changes: dict[int, torch.Tensor] = {}
        self._changes_of_views: dict[Hashable, float] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def __repr__(self) -> str:
        return (
            f"Cache({len(self)} answers, {self.bytes / 1e6:.1f} of {self.max_bytes / 1e6:.1f} MB, {self.hits} hits, "
            f"{self.misses} misses, {self.evictions} evictions)"
        )

    def invalidate(self) -> None:
        """Forget everything, but not which cameras are expected."""
        with self._lock:
            self.bytes = 0
            self._state = None
            for kept in (self._kept, self._image_weights, self._changes, self._changes_of_views, self._unclaimed):
                kept.clear()

    def find(self, scene: Scene, key: Hashable) -> Information | None:
        """The cached quantity for this scene, a hit; None if there is none, or its view has changed too far.

        Args:
            scene: The scene as it is now.
            key: All else that it depends on; with a bound, a `ViewKey`.
        Raises:
            NotCached: If nothing is kept and nothing is to be computed.
        """
        with self._lock:
            if isinstance(key, ViewKey):
                self._claim(key.quantity)
            self._compare(scene)
            kept = self._kept.get(key)
            if isinstance(key, ViewKey) and self.bound is not None:
                if kept is None and not self.computes:
                    raise NotCached(key.quantity)
                if kept is not None and kept.shapes is not None:
                    change = self._change(key, kept.shapes)
                    if change > self.bound and self.computes:
                        return None
                    self.changes[key.camera] = max(change, self.changes.get(key.camera, 0.0))
            if kept is None:
                return None
            self._kept.move_to_end(key)
            self.hits += 1
            return kept.computed if kept.shapes is None else self._padded(kept.computed, len(kept.shapes))

    def keep(self, scene: Scene, key: Hashable, computed: Information) -> None:
        """Store a computed quantity, a miss.

        Args:
            scene: That it was computed of; without a bound, nothing is stored if another one was compared since.
            key: All else that it depends on; with a bound, a `ViewKey`.
            computed: What was computed.
        """
        with self._lock:
            self.misses += 1
            if self.bound is None:
                if self._state is not None and self._state.is_still(scene):
                    self._store(key, _Entry(computed, None))
                return
            self._compare(scene)
            if isinstance(key, ViewKey) and key.camera in self._cameras:
                self._store(key, _Entry(computed, self._shapes()))
                if key in self._kept and _COLORS in computed:
                    self._image_weights[key.camera] = computed[_COLORS][:, 0].sum(-1).float()

    def _store(self, key: Hashable, kept: _Entry) -> None:
        """Store an entry, and drop the oldest ones that no longer fit."""
        self._forget(key)  # computed twice, by two calls at a time
        if (size := size_of(kept.computed)) > self.max_bytes:
            self.evictions += 1
            return
        self._kept[key] = kept
        self.bytes += size
        while self.bytes > self.max_bytes:
            self._forget(next(iter(self._kept)))
            self.evictions += 1

    def _forget(self, key: Hashable) -> None:
        """Let go of what is kept under a key, if anything is."""
        if (before := self._kept.pop(key, None)) is not None:
            self.bytes -= size_of(before.computed)
        self._changes_of_views.pop(key, None)
        if (
            isinstance(key, ViewKey)
            and key.camera in self._image_weights
            and all(other.camera != key.camera for other in self._views())
        ):
            self._image_weights.pop(key.camera, None)

    def _compare(self, scene: Scene) -> None:
        """Forget everything if it is another scene than last time, or one that has changed beyond comparison."""
        if self.bound is None:
            if self._state is None or not self._state.is_still(scene):
                self.invalidate()
                self._state = _State(scene)
            return
        if self._now is not None and self._now[0] is scene:
            return
        shapes = Shapes.of(scene.at(None))
        before = shapes if self._now is None else self._now[1]
        if len(shapes) < len(before) or shapes.sh < before.sh:
            self.invalidate()  # some have gone, and nothing says which
        self._now = scene, shapes
        self._changes.clear()
        self._changes_of_views.clear()

    # -------------------------------------------------- with a bound

    def expect(self, cameras: Iterable[Camera]) -> None:
        """Name the cameras that will be looked for; what is kept of all others is forgotten."""
        with self._lock:
            self._cameras = {camera_key(camera): camera for camera in cameras}
            for key in [key for key in self._views() if key.camera not in self._cameras]:
                self._forget(key)

    def change(self, scene: Scene, camera: Camera) -> float:
        """Change of a view since the oldest of what is kept of it; infinite where nothing is."""
        with self._lock:
            self._compare(scene)
            view = camera_key(camera)
            changes = [self._change(key, kept.shapes) for key, kept in self._views().items() if key.camera == view]
            return max(changes, default=math.inf)

    def image_weights(self, scene: Scene, camera: Camera) -> torch.Tensor | None:
        """(N,) sum of w^2 of each Gaussian over a view's pixels when that was computed; None: never computed."""
        with self._lock:
            self._compare(scene)
            weights = self._image_weights.get(camera_key(camera))
            if weights is None:
                return None
            padded = weights.new_zeros(len(self._shapes()))
            padded[: len(weights)] = weights
            return padded

    def keeps(self, quantity: Hashable, camera: Camera) -> bool:
        """Whether a quantity of a view is kept, of whatever age."""
        self._claim(quantity)
        view = camera_key(camera)
        return any(key.quantity == quantity and key.camera == view for key in self._views())

    def _views(self) -> dict[ViewKey, _Entry]:
        """What is kept, in the order of its use: with a bound, views alone."""
        return {key: kept for key, kept in self._kept.items() if isinstance(key, ViewKey)}

    def _shapes(self) -> Shapes:
        """Of the Gaussians as they are now."""
        assert self._now is not None  # `_compare` was called
        return self._now[1]

    def _change(self, key: ViewKey, before: Shapes | None) -> float:
        """Change of a view since what is kept under a key was computed."""
        now = self._shapes()
        if before is now or before is None:
            return 0.0
        if key not in self._changes_of_views:
            if id(before) not in self._changes:
                self._changes[id(before)] = before.change_to(now)
            self._changes_of_views[key] = change_of_view(
                before, now, self._changes[id(before)], self._cameras[key.camera], self._image_weights.get(key.camera)
            )
        return self._changes_of_views[key]

    def _padded(self, computed: Information, count: int) -> Information:
        """What was computed, with zeros for Gaussians, and for SH coefficients, that have come since."""
        now = self._shapes()
        padded = {}
        for name, x in computed.items():
            if name in _OF_GAUSSIANS and len(x) == count:
                size = (len(now), now.sh, 3) if name == _COLORS else (len(now), *x.shape[1:])
                if tuple(x.shape) != size:
                    bigger = x.new_zeros(size)
                    bigger[tuple(slice(n) for n in x.shape)] = x
                    x = bigger
            padded[name] = x
        return padded

    # -------------------------------------------------- with a bound: a file

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any], list[Camera]]:
        """Tensors, a header in JSON, and the cameras that are expected.

        Left out are views with a mask, and quantities that `named_by` has no name for.
        """
        with self._lock:
            views = {view: i for i, view in enumerate(self._cameras)}
            shapes = list(
                {id(kept.shapes): kept.shapes for kept in self._kept.values() if kept.shapes is not None}.values()
            )
            if self._now is not None and all(self._now[1] is not one for one in shapes):
                shapes.append(self._now[1])
            places = {id(one): i for i, one in enumerate(shapes)}
            tensors = {f"seen.{views[view]}": x for view, x in self._image_weights.items()}
            for i, one in enumerate(shapes):
                tensors |= {f"shapes.{i}.{name}": x for name, x in vars(one).items() if name != "sh"}
            rows: list[dict[str, Any]] = []
            for key, kept in self._views().items():
                name = key.quantity.name if isinstance(key.quantity, _Saved) else named_by(key.quantity)
                if name is None or key.mask is not None:
                    continue
                tensors |= {f"answer.{len(rows)}.{group}": x for group, x in kept.computed.items()}
                rows.append({"question": name, "view": views[key.camera], "shapes": places[id(kept.shapes)]})
            now = None if self._now is None else places[id(self._now[1])]
            header = {"answers": rows, "sh": [one.sh for one in shapes], "now": now}
            return tensors, header, list(self._cameras.values())

    def restore(self, tensors: Mapping[str, torch.Tensor], header: dict, cameras: Sequence[Camera], where: str) -> None:
        """Go on from a `state`. Once a quantity is looked for that the state does not have, the others are forgotten.

        Raises:
            ValueError: If it is no such state, or damaged.
        """
        check_json(where, header, _STATE, _ADVICE)
        shapes = [_shapes_of(tensors, i, sh, where) for i, sh in enumerate(header["sh"])]
        now = header["now"]
        places = [row["shapes"] for row in header["answers"]] + ([] if now is None else [now])
        if not all(0 <= i < len(shapes) for i in places) or (now is None and shapes):
            raise ValueError(f"{where}: answers must refer to {len(shapes)} saved scenes, refer to others; {_ADVICE}")
        most = 0 if now is None else len(shapes[now])
        with self._lock:
            self.invalidate()
            self.expect(cameras)
            views = [camera_key(camera) for camera in cameras]
            self._now = None if now is None else (None, shapes[now])
            groups: dict[int, dict[str, torch.Tensor]] = {}
            for name, x in tensors.items():
                kind, _, rest = name.partition(".")
                number, _, group = rest.partition(".")
                if kind == "answer" and number.isdecimal():
                    groups.setdefault(int(number), {})[group] = x
            for i, row in enumerate(header["answers"]):
                of, computed = shapes[row["shapes"]], groups.get(i)
                if not 0 <= row["view"] < len(views) or not computed or len(of) > most:
                    raise ValueError(f"{where}: answer {i} must be of a view and of Gaussians, is not; {_ADVICE}")
                bad = [k for k, x in computed.items() if not x.ndim or k in _OF_GAUSSIANS and len(x) != len(of)]
                if bad:
                    raise ValueError(f"{where}: answer {i}: {bad[0]} must be of {len(of)} Gaussians, is not; {_ADVICE}")
                key = ViewKey(_Saved(row["question"]), views[row["view"]], None)
                self._store(key, _Entry(computed, of))
                if key in self._kept:
                    self._unclaimed.add(row["question"])
                    weights = tensors.get(f"seen.{row['view']}")
                    if weights is not None and weights.ndim == 1 and len(weights) <= most:
                        self._image_weights[key.camera] = weights

    def _claim(self, quantity: Hashable) -> None:
        """What a file has of this quantity is found under it from now on."""
        if not self._unclaimed:
            return
        with self._lock:
            name = named_by(quantity)
            if name not in self._unclaimed:
                if all(key.quantity != quantity for key in self._views()):  # other quantities are computed now
                    for key in self._views():  # what is left of a view would say that nothing of it has changed
                        self._forget(key)
                    self._unclaimed.clear()
                    self.forgot_saved = True
                return
            self._unclaimed.discard(name)
            saved = _Saved(name)
            views = self._views()
            self._kept.clear()
            for key, kept in views.items():  # in their order, which is that of their use
                self._kept[key._replace(quantity=quantity) if key.quantity == saved else key] = kept
            self._changes_of_views.clear()


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


def view_key(quantity: Hashable, camera: Camera, mask: torch.Tensor | None = None) -> ViewKey:
    """Key of a quantity of one view; `quantity` has all other arguments that it depends on."""
    return ViewKey(quantity, camera_key(camera), None if mask is None else _value_key(mask))


def camera_key(camera: Camera) -> tuple:
    """Equal for cameras of equal fields (all but the name), so that a new field is part of it, too."""
    names = [field.name for field in dataclasses.fields(camera) if field.name != "name"]
    return tuple(_value_key(getattr(camera, name)) for name in names)


def _value_key(x: Any) -> Hashable:
    """A hashable stand-in: arrays and tensors, which compare by entry, become a digest of their bytes."""
    return _array_key(x) if isinstance(x, torch.Tensor | np.ndarray) else x


def _array_key(x: torch.Tensor | np.ndarray) -> tuple[tuple[int, ...], str, bytes]:
    """Shape, type and digest of the values."""
    if isinstance(x, torch.Tensor):  # a key is a value, whatever graph it is in
        x = x.detach().cpu().numpy()
    return (x.shape, x.dtype.str, hashlib.blake2b(x.tobytes(), digest_size=16).digest())


def named_by(x: Any) -> str | None:
    """A name that equal values have in every process, for a file; None where there is none, as of a lambda."""
    if x is None or isinstance(x, str | int | float):
        return repr(x)
    if isinstance(x, torch.Tensor | np.ndarray):
        shape, kind, digest = _array_key(x)
        return f"array({shape}, {kind}, {digest.hex()})"
    parts: dict[str, Any]
    if inspect.isfunction(x) or inspect.isclass(x):
        name = f"{x.__module__}.{x.__qualname__}"
        return None if "<" in name else name
    if isinstance(x, functools.partial):
        parts = {"func": x.func, "args": x.args, **x.keywords}
    elif dataclasses.is_dataclass(x):
        parts = {field.name: getattr(x, field.name) for field in dataclasses.fields(x)}
    elif isinstance(x, Mapping):
        parts = {repr(key): x[key] for key in sorted(x, key=repr)}
    elif isinstance(x, tuple | list):
        parts = {str(i): one for i, one in enumerate(x)}
    else:
        return None
    names = {key: named_by(one) for key, one in parts.items()}
    if None in names.values():
        return None
    return f"{type(x).__qualname__}({', '.join(f'{key}={name}' for key, name in names.items())})"


def _shapes_of(tensors: Mapping[str, torch.Tensor], number: int, sh: int, where: str) -> Shapes:
    """The shapes of that number in a file."""
    kinds = {"means": 3, "log_scales": 3, "quats": 4, "opacities": 0, "colors": 3}
    given = {name: tensors.get(f"shapes.{number}.{name}") for name in kinds}
    means = given["means"]
    count = 0 if means is None or not means.ndim else len(means)
    parts: dict[str, torch.Tensor] = {}
    for name, width in kinds.items():
        x, dtype = given[name], torch.float64 if name == "means" else torch.float32
        shape = (count, width) if width else (count,)
        if x is None or x.dtype != dtype or tuple(x.shape) != shape:
            raise ValueError(f"{where}: {name} of shapes {number} must be {dtype} of shape {shape}, is not; {_ADVICE}")
        parts[name] = x
    return Shapes(**parts, sh=sh)
