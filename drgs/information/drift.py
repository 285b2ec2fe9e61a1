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
import math
from collections.abc import Hashable, Iterable
from typing import cast

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Y_00, Gaussians, Scene
from drgs.gain import Information
from drgs.information.cache import Cache, camera_key
from drgs.information.groups import GROUPS

__all__ = ["DriftCache", "Shapes", "Unanswered"]

_COLORS = "sh"  # whose information about base colors is the sum of w^2
_OF_GAUSSIANS = (*GROUPS, "coverage")


class Unanswered(Exception):  # noqa: N818  # no error: the caller does without the view
    """Nothing is kept of a view, and nothing is to be computed.

    Attributes:
        question: What was to be asked, as keys of a cache begin.
    """

    def __init__(self, question: Hashable) -> None:
        super().__init__("nothing is known of a view")
        self.question = question


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
        self._now: tuple[Scene, Shapes] | None = None
        # Since then, to the Gaussians as they are now: id of shapes -> (N,); key -> of its view.
        self._changes: dict[int, torch.Tensor] = {}
        self._views_changes: dict[Hashable, float] = {}

    def invalidate(self) -> None:
        """Forget everything, but not which cameras are expected."""
        with self._lock:
            super().invalidate()
            for known in (self._shapes, self._seen, self._changes, self._views_changes):
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
        asked = (question, camera_key(camera))
        return any(_parts(key) == asked for key in self._answers)

    def find(self, scene: Scene, key: Hashable) -> Information | None:
        """What is kept under a key, if its view has changed by little, or whatever it has, see `asks`.

        Raises:
            Unanswered: If nothing is kept and nothing is to be computed.
        """
        question, view = _parts(key)
        with self._lock:
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


def _inside(camera: Camera, points: torch.Tensor) -> torch.Tensor:
    """(P,) float32, 1 for points that are in a camera's image."""
    pixels, _ = camera.project(points.numpy())
    inside = (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    return torch.from_numpy(inside).float()
