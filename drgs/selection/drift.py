"""Information of single views, kept while the scene drifts: a model that is still being fitted changes at every step.

What a view tells about a Gaussian holds as long as the Gaussian stays what it is. Its change since then is the largest
of

    |mu - mu'| / s              how far it went, in units of its size s, the geometric mean of its scales
    max |log s_k - log s_k'|
    phi (1 - s_min / s_max)     phi the angle that it turned by, radians; a sphere does not turn
    |o - o'|                    opacity
    max |c - c'|                base color, in [0, 1]

and at most 1; that of a Gaussian that was not there is 1. The change of a view is the mean over the Gaussians that it
sees, each counted by how much of the image it makes up: the sum over pixels of w^2, w its weight of compositing. One
that has come since counts as the average of these if its mean is in the image. A view's answer is given again while its
change is at most `bound`; the default was measured (docs/planner.md).
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Y_00, Gaussians, Scene
from drgs.guards.json_files import check_json
from drgs.information.groups import GROUPS
from drgs.information.sums import Information
from drgs.selection.cache import Cache, camera_key, value_key

__all__ = ["DriftCache", "Shapes", "Unanswered", "named_by"]

_COLORS = "sh"  # whose information about base colors is the sum of w^2
_OF_GAUSSIANS = (*GROUPS, "coverage")
_STATE = {"answers": [{"question": str, "view": int, "shapes": int}], "sh": [int], "now": (None, int)}
_ADVICE = "restore the file, or begin anew"


class Unanswered(Exception):  # noqa: N818  # no error: the caller does without the view
    """Nothing is kept of a view, and nothing is to be computed.

    Attributes:
        question: What was to be asked, as keys of a cache begin.
    """

    def __init__(self, question: Hashable) -> None:
        super().__init__("nothing is known of a view")
        self.question = question


@dataclasses.dataclass(frozen=True)
class _Saved:
    """A question that a file names, as long as it has not been asked again."""

    name: str


@dataclasses.dataclass(frozen=True, eq=False)
class Shapes:
    """What of N Gaussians is compared.

    Attributes:
        means: (N, 3) float64 world.
        log_scales: (N, 3).
        quats: (N, 4) unit.
        opacities: (N,).
        colors: (N, 3) base colors, in [0, 1] as far as they are seen.
        sh: Number K of SH coefficients of a channel.
    """

    means: torch.Tensor
    log_scales: torch.Tensor
    quats: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor
    sh: int

    @classmethod
    def of(cls, gaussians: Gaussians) -> Shapes:
        """A copy of what is compared, on the CPU."""
        g = gaussians.detach().to("cpu")
        return cls(
            g.means.double() + torch.from_numpy(np.array(g.origin)),
            g.log_scales.clone(),
            torch.nn.functional.normalize(g.quats, dim=1),
            g.logit_opacities.sigmoid(),
            (0.5 + Y_00 * g.sh[:, 0]).clamp(0, 1),
            g.sh.shape[1],
        )

    def __len__(self) -> int:
        return len(self.means)

    def change_to(self, now: Shapes) -> torch.Tensor:
        """(M,) float32 in [0, 1]: change of each of the M Gaussians that there are now, in the order of both."""
        count = min(len(self), len(now))
        a, b = ({k: x[:count] for k, x in vars(one).items() if k != "sh"} for one in (self, now))
        scales = a["log_scales"]
        # q and -q are one rotation; by the chord, for the arc cosine of nearly 1 has half of the digits.
        chord = torch.minimum((a["quats"] - b["quats"]).norm(dim=1), (a["quats"] + b["quats"]).norm(dim=1))
        turn = 4 * (chord / 2).clamp(max=1).asin()
        flat = 1 - (scales.amin(1) - scales.amax(1)).exp()
        parts = (
            (b["means"] - a["means"]).norm(dim=1) / scales.mean(1).exp(),
            (b["log_scales"] - scales).abs().amax(1),
            turn * flat,
            (b["opacities"] - a["opacities"]).abs(),
            (b["colors"] - a["colors"]).abs().amax(1),
        )
        change = torch.ones(len(now))
        change[:count] = torch.stack([x.float() for x in parts]).amax(0).clamp(max=1)
        return change


class DriftCache(Cache):
    """What views tell, kept while what they see has changed by at most a bound.

    For Gaussians that keep their places in the list; new ones come at its end. Where the list gets shorter everything
    is forgotten. An answer from before they came has
    zeros for them. Only views of cameras that are expected are kept.

    Attributes:
        bound: The largest change of a view whose answer is given again, in [0, 1].
        asks: Whether what has changed by more is computed anew. If not, it is given as it was, and `Unanswered` is
            raised where nothing is kept.
        given: Camera, as `camera_key` gives it -> largest change of what was given of it since it was emptied.
    """

    def __init__(self, bound: float = 0.2, max_bytes: int = 1 << 30) -> None:
        """
        Args:
            bound: The largest change, see the attributes.
            max_bytes: The same as for `Cache`. Of the Gaussians that answers are of, 64 bytes each come on top.
        """
        super().__init__(max_bytes)
        self.bound = bound
        self.asks = True
        self.given: dict[Hashable, float] = {}
        self._cameras: dict[Hashable, Camera] = {}
        self._shapes: dict[Hashable, Shapes] = {}  # key -> the Gaussians that an answer is of
        self._seen: dict[Hashable, torch.Tensor] = {}  # camera -> (N,) how much of its image each Gaussian makes up
        self._now: tuple[Scene | None, Shapes] | None = None
        self._unclaimed: set[str] = set()  # questions of a file that have not been asked again
        # Since then, to the Gaussians as they are now: id of shapes -> (N,); key -> of its view.
        self._changes: dict[int, torch.Tensor] = {}
        self._views_changes: dict[Hashable, float] = {}

    def invalidate(self) -> None:
        """Forget everything, but not which cameras are expected."""
        with self._lock:
            super().invalidate()
            for known in (self._shapes, self._seen, self._changes, self._views_changes, self._unclaimed):
                known.clear()

    def expect(self, cameras: Iterable[Camera]) -> None:
        """Name the cameras that will be asked for; what is kept of all others is forgotten."""
        with self._lock:
            self._cameras = {camera_key(camera): camera for camera in cameras}
            for key in [key for key in self._answers if _parts(key)[1] not in self._cameras]:
                self._forget(key)

    def change(self, scene: Scene, camera: Camera) -> float:
        """Change of a view since the oldest of its answers; infinite where none is kept."""
        with self._lock:
            self._look_at(scene)
            view = camera_key(camera)
            return max((self._change(key, view) for key in self._answers if _parts(key)[1] == view), default=math.inf)

    def seen(self, scene: Scene, camera: Camera) -> torch.Tensor | None:
        """(N,) how much of a view's image each Gaussian made up when it was asked, sum of w^2; None if it was not."""
        with self._lock:
            self._look_at(scene)
            found = self._seen.get(camera_key(camera))
            if found is None:
                return None
            padded = found.new_zeros(len(self._shapes_now()))
            padded[: len(found)] = found
            return padded

    def answered(self, question: Hashable, camera: Camera) -> bool:
        """Whether there is an answer of a view to a question, of whatever age."""
        self._claim(question)
        asked = (question, camera_key(camera))
        return any(_parts(key) == asked for key in self._answers)

    def find(self, scene: Scene, key: Hashable) -> Information | None:
        """What is kept under a key, if its view has changed by little, or whatever it has, see `asks`.

        Raises:
            Unanswered: If nothing is kept and nothing is to be computed.
        """
        question, view = _parts(key)
        with self._lock:
            self._claim(question)
            self._look_at(scene)
            if key not in self._answers:
                if self.asks:
                    return None
                raise Unanswered(question)
            change = self._change(key, view)
            if change > self.bound and self.asks:
                return None
            self.given[view] = max(change, self.given.get(view, 0.0))
            found = super().find(scene, key)
            assert found is not None  # it is there
            return self._padded(found, len(self._shapes[key]))

    def keep(self, scene: Scene, key: Hashable, answer: Information) -> None:
        """Store what was computed of a scene as it is now."""
        with self._lock:
            self.misses += 1
            self._look_at(scene)
            _, view = _parts(key)
            if view not in self._cameras:
                return
            self._store(key, answer)
            if key in self._answers:
                self._shapes[key] = self._shapes_now()
                if _COLORS in answer:
                    self._seen[view] = answer[_COLORS][:, 0].sum(-1).float()

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any], list[Camera]]:
        """Tensors, a header in JSON, and the cameras that are expected.

        Left out are answers of views with a mask, and to a question that `named_by` has no name for.
        """
        with self._lock:
            views = {view: i for i, view in enumerate(self._cameras)}
            shapes = list({id(one): one for one in self._shapes.values()}.values())
            if self._now is not None and all(self._now[1] is not one for one in shapes):
                shapes.append(self._now[1])
            places = {id(one): i for i, one in enumerate(shapes)}
            tensors = {f"seen.{views[view]}": x for view, x in self._seen.items()}
            for i, one in enumerate(shapes):
                tensors |= {f"shapes.{i}.{name}": x for name, x in vars(one).items() if name != "sh"}
            answers: list[dict[str, Any]] = []
            for key, answer in self._answers.items():
                question, view = _parts(key)
                name = question.name if isinstance(question, _Saved) else named_by(question)
                if name is None or key != (question, view, None):
                    continue
                tensors |= {f"answer.{len(answers)}.{group}": x for group, x in answer.items()}
                answers.append({"question": name, "view": views[view], "shapes": places[id(self._shapes[key])]})
            now = None if self._now is None else places[id(self._now[1])]
            header = {"answers": answers, "sh": [one.sh for one in shapes], "now": now}
            return tensors, header, list(self._cameras.values())

    def restore(self, tensors: Mapping[str, torch.Tensor], header: dict, cameras: Sequence[Camera], where: str) -> None:
        """Go on from a `state`. Once a question is asked that none of its answers is to, the others are forgotten.

        Raises:
            ValueError: If it is no such state, or damaged.
        """
        check_json(where, header, _STATE, _ADVICE)
        shapes = [_shapes_of(tensors, i, sh, where) for i, sh in enumerate(header["sh"])]
        now = header["now"]
        places = [row["shapes"] for row in header["answers"]] + ([] if now is None else [now])
        if not all(0 <= i < len(shapes) for i in places) or (now is None and shapes):
            raise ValueError(f"{where}: answers must be of {len(shapes)} states of the Gaussians, are not; {_ADVICE}")
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
                of, answer = shapes[row["shapes"]], groups.get(i)
                if not 0 <= row["view"] < len(views) or not answer or len(of) > most:
                    raise ValueError(f"{where}: answer {i} must be of a view and of Gaussians, is not; {_ADVICE}")
                bad = [k for k, x in answer.items() if not x.ndim or k in _OF_GAUSSIANS and len(x) != len(of)]
                if bad:
                    raise ValueError(f"{where}: answer {i}: {bad[0]} must be of {len(of)} Gaussians, is not; {_ADVICE}")
                key = _Saved(row["question"]), views[row["view"]], None
                self._store(key, answer)
                if key in self._answers:
                    self._shapes[key] = of
                    self._unclaimed.add(row["question"])
                    seen = tensors.get(f"seen.{row['view']}")
                    if seen is not None and seen.ndim == 1 and len(seen) <= most:
                        self._seen[views[row["view"]]] = seen

    def _claim(self, question: Hashable) -> None:
        """Answers of a file that are to this question are found under it from now on."""
        if not self._unclaimed:
            return
        with self._lock:
            name = named_by(question)
            if name not in self._unclaimed:
                if all(_parts(key)[0] != question for key in self._answers):  # what is asked has changed
                    for key in [key for key in self._answers if isinstance(_parts(key)[0], _Saved)]:
                        self._forget(key)
                    self._unclaimed.clear()
                return
            self._unclaimed.discard(name)
            for key in list(self._answers):  # in their order, which is that of their use
                answer, before = self._answers.pop(key), key
                if _parts(key)[0] == _Saved(name):
                    key = question, *cast("tuple[Hashable, Hashable, Hashable]", key)[1:]
                    self._shapes[key] = self._shapes.pop(before)
                self._answers[key] = answer
            self._views_changes.clear()

    def _look_at(self, scene: Scene) -> None:
        """A scene that has changed is compared with what answers are of."""
        if self._now is not None and self._now[0] is scene:
            return
        shapes = Shapes.of(scene.at(None))
        before = shapes if self._now is None else self._now[1]
        if len(shapes) < len(before) or shapes.sh < before.sh:
            self.invalidate()  # some have gone, and nothing says which
        self._now = scene, shapes
        self._changes.clear()
        self._views_changes.clear()

    def _forget(self, key: Hashable) -> None:
        super()._forget(key)
        self._shapes.pop(key, None)
        self._views_changes.pop(key, None)
        _, view = _parts(key)
        if all(_parts(other)[1] != view for other in self._answers):
            self._seen.pop(view, None)

    def _shapes_now(self) -> Shapes:
        assert self._now is not None  # as after `_look_at`
        return self._now[1]

    def _change(self, key: Hashable, view: Hashable) -> float:
        """Change of a view since an answer, see the module's text."""
        found = self._views_changes.get(key)
        if found is None:
            found = self._views_changes[key] = self._changed(self._shapes[key], view)
        return found

    def _changed(self, before: Shapes, view: Hashable) -> float:
        """Change of a view since some Gaussians were what it sees."""
        now = self._shapes_now()
        if before is now:
            return 0.0
        change = self._changes.get(id(before))
        if change is None:
            change = self._changes[id(before)] = before.change_to(now)
        seen = self._seen.get(view)
        seen = torch.ones(len(before)) if seen is None else seen[: len(before)]
        weights = torch.zeros(len(now))
        weights[: len(seen)] = seen
        there = seen > 0
        if len(now) > len(seen) and bool(there.any()):
            weights[len(seen) :] = seen[there].mean() * _inside(self._cameras[view], now.means[len(seen) :])
        total = float(weights.sum())
        if not total:  # it saw nothing: whatever has come counts
            return float(len(now) > len(before) and bool(_inside(self._cameras[view], now.means).any()))
        return float((weights * change).sum()) / total

    def _padded(self, answer: Information, count: int) -> Information:
        """An answer with zeros for Gaussians, and for SH coefficients, that have come since."""
        now = len(self._shapes_now())
        degree = self._shapes_now().sh
        found = {}
        for name, x in answer.items():
            if name in _OF_GAUSSIANS and len(x) == count:
                size = (now, degree, 3) if name == _COLORS else (now, *x.shape[1:])
                if tuple(x.shape) != size:
                    bigger = x.new_zeros(size)
                    bigger[tuple(slice(n) for n in x.shape)] = x
                    x = bigger
            found[name] = x
        return found


def _parts(key: Hashable) -> tuple[Hashable, Hashable]:
    """What was asked, and the view's camera, of a key as `ViewQuestion` makes them."""
    question, view, _ = cast("tuple[Hashable, Hashable, Hashable]", key)
    return question, view


def named_by(x: Any) -> str | None:
    """A name that equal values have in every process, for a file; None where there is none, as of a lambda."""
    if x is None or isinstance(x, str | int | float):
        return repr(x)
    if isinstance(x, torch.Tensor | np.ndarray):
        shape, kind, digest = cast("tuple[Any, str, bytes]", value_key(x))
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
    found = {name: tensors.get(f"shapes.{number}.{name}") for name in kinds}
    means = found["means"]
    count = 0 if means is None or not means.ndim else len(means)
    parts: dict[str, torch.Tensor] = {}
    for name, width in kinds.items():
        x, dtype = found[name], torch.float64 if name == "means" else torch.float32
        shape = (count, width) if width else (count,)
        if x is None or x.dtype != dtype or tuple(x.shape) != shape:
            raise ValueError(f"{where}: {name} of shapes {number} must be {dtype} of shape {shape}, is not; {_ADVICE}")
        parts[name] = x
    return Shapes(**parts, sh=sh)


def _inside(camera: Camera, points: torch.Tensor) -> torch.Tensor:
    """(P,) float32, 1 for points that are in a camera's image."""
    pixels, _ = camera.project(points.numpy())
    inside = (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    return torch.from_numpy(inside).float()
