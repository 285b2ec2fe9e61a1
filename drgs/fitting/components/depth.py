"""Depth maps of a data set, as a term of the loss: metric ones of sensors, or of networks up to scale and shift.

Photographs do not say how far away a plain wall is; a depth map does [1]. But maps have the wrong unit, belong to
another photograph, or to poses of another scale, and a fit to them would be worse than one without. So `auto` compares
them, before the first step, with points that photographs triangulate: with the tracks of a data set, else with features
that are matched. Metric maps must agree with these points as they are. Of each relative map (z = a m + b, or
1 / z = a m + b, one of the two for all of them) a and b are fitted to its points once, robustly, and must agree then.

A map says that nothing is before a surface, and what is rendered there shows in other photographs; mirror images of
glossy surfaces are behind them, so that depth behind the map's counts for less.

Rendered depth is compared by its relative error r with c log(1 + |r| / c): beyond c it counts for less and less. Pixels
at edges of a map are left out: rendered depth is a mean over what a pixel shows, a map has one of these. The weight
falls over the fit, as photographs show more and more details that maps do not.

Reference:
    [1] Deng et al., "Depth-supervised NeRF: Fewer Views and Faster Training for Free", CVPR 2022.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch.nn.functional import max_pool2d

from drgs.display.progress import Bar
from drgs.fitting.components.base import Checkpoint, Component, Fit, Setup
from drgs.fitting.depths import axis_cosines, renders_z
from drgs.io.json_files import check_json
from drgs.sfm.guided import Matches
from drgs.sfm.points import shared_points

if TYPE_CHECKING:
    from drgs.data import View
    from drgs.ellipsoids import Gaussians
    from drgs.fitting.frames import Frame
    from drgs.integrator import Output

# Where nothing measured is named: chosen, not tuned.
_SAME_DEPTH = 0.1  # relative difference of two depths of one point
# Of the compared points whose depth is the same: `office` 0.81, the still life 0.88, a made room 0.98, and where each
# photograph has the map of its neighbor 0.18, 0.45 and 0.43.
_CLEAR_SHARE = 0.5
# The same of relative maps, two numbers of which are fitted to these points: 0.83, 0.89 and 0.98, and where each
# photograph has the map of one far away 0.48, 0.64 and 0.56.
_CLEAR_RELATIVE = 0.75
_VIEW_SHARE = 0.25  # of those of one photograph, below which its map is left out
_FEWEST_POINTS = 100  # that are compared, in all photographs, for a verdict
_FEWEST_OF_VIEW = 10  # of one photograph: for its own verdict, and for a relative map's scale and shift
_LINES_TRIED = 300  # lines through two random points of a relative map; one of them has two right points, almost surely
_FARTHEST = 3.0  # times the farthest triangulated point of a view, beyond which a relative map says nothing
_COMPARED_VIEWS = 48  # photographs that are compared at most, in groups of neighbors by name: features take seconds
_GROUP = 6  # photographs of such a group
_EDGE = 0.05  # relative difference of depths within a window of a map, above which its middle is at an edge
_WINDOW = 5  # pixels of a side of that window, at the size of the fit
_BEND = 0.1  # relative error of depth from which on it counts by its logarithm


@dataclasses.dataclass(frozen=True)
class Line:
    """z = scale m + shift of a relative map's numbers m, or 1 / z of an inverse one; `farthest` z that it says."""

    inverse: bool
    scale: float
    shift: float
    farthest: float

    def z(self, values: np.ndarray) -> np.ndarray:
        """z-depth, 0 where unknown."""
        with np.errstate(invalid="ignore", divide="ignore"):
            line = self.scale * values + self.shift
            z = 1 / line if self.inverse else line
            return np.where((z > 0) & (z < self.farthest), z, 0.0).astype(np.float32)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """What depth maps say of points that photographs triangulate.

    Attributes:
        kind: `metric` or `relative`.
        maps: How many maps there are.
        points: How many points were compared, each once a photograph that shows it.
        agreeing: Share of them whose depth is the same.
        ratio: Median of the maps' depth over the triangulated one.
        at_ratio: Share of the points whose depth is the same once it is divided by `ratio`.
        left_out: Names of photographs whose maps differ from points, or, of relative ones, have too few.
        lines: Photograph -> scale and shift of its relative map.
    """

    kind: str
    maps: int
    points: int
    agreeing: float
    ratio: float
    at_ratio: float
    left_out: tuple[str, ...]
    lines: Mapping[str, Line]

    @property
    def is_clear(self) -> bool:
        """Whether the maps are of use."""
        return self.points >= _FEWEST_POINTS and self.agreeing > self.clear_share and len(self.left_out) < self.maps

    @property
    def clear_share(self) -> float:
        """Share of the points that must agree."""
        return _CLEAR_SHARE if self.kind == "metric" else _CLEAR_RELATIVE

    @property
    def has_wrong_unit(self) -> bool:
        """Whether metric maps clearly agree with points but for one factor."""
        is_clear = self.points >= _FEWEST_POINTS and self.at_ratio > _CLEAR_SHARE
        return self.kind == "metric" and is_clear and not self.is_clear and abs(math.log(self.ratio)) > _SAME_DEPTH

    def words(self) -> str:
        """What was found, in one line."""
        if self.points < _FEWEST_POINTS:
            return f"photographs triangulate {self.points} points to compare {self.maps} depth maps with, too few"
        said = (
            f"{self.maps} {self.kind} depth maps and what photographs triangulate agree within {100 * _SAME_DEPTH:g} % "
            f"at {100 * self.agreeing:.0f} % of {self.points} points (clear above "
            f"{100 * self.clear_share:g} %"
        )
        if self.kind == "metric":
            said += f"; median ratio {self.ratio:.3g}"
        said += f"; {len(self.left_out)} maps left out" if self.left_out else ""
        return said + ")"

    def to_json(self) -> dict[str, Any]:
        """The comparison as config.json and a checkpoint have it."""
        return dataclasses.asdict(self) | {"left_out": list(self.left_out)}

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> Comparison:
        """The comparison of a checkpoint."""
        fields = {field.name: record[field.name] for field in dataclasses.fields(cls)}
        lines = {name: Line(**line) for name, line in record["lines"].items()}
        return cls(**(fields | {"left_out": tuple(record["left_out"]), "lines": lines}))


_LINE = {"inverse": bool, "scale": float, "shift": float, "farthest": float}
_RECORD = {
    "used": bool,
    "kind": str,
    "maps": int,
    "points": int,
    "agreeing": float,
    "ratio": float,
    "at_ratio": float,
    "left_out": [str],
    "lines": dict,
}


class DepthComponent(Component):
    """Rendered depth is fitted to depth maps: `depth` on, or auto, where they agree with what photographs triangulate.
    It is its own term of the loss.

    Attributes:
        found: What maps say of triangulated points; None where there are no maps, or nobody asked.
        used: Whether they are fitted to.
    """

    name = "depth"
    outputs: ClassVar[tuple[str, ...]] = ("depth",)
    option = ("depth", "off")
    where = "where depth maps are fitted to"
    header_kinds: ClassVar[Mapping[str, Any]] = {"depth": _RECORD}

    def __init__(self) -> None:
        self.found: Comparison | None = None
        self.used = False
        self._compared: list[str] = []  # names of the photographs whose features `_matches` has, in their order
        self._matches = Matches()
        self._kept: dict[str, torch.Tensor] = {}  # name of a photograph -> z-depth
        self._cosines: dict[tuple, torch.Tensor] = {}  # by what they depend on: photographs of one lens share them
        self._target: torch.Tensor | None = None
        self._weight = self._behind = 0.0

    # -------------------------------------------------------------------------------------- before the first step

    def prepare(self, setup: Setup) -> None:
        """See `Component`.

        Raises:
            ValueError: If depth maps are asked for and there are none.
        """
        if setup.config.loss.depth == "on" and not _have_maps(setup.train):
            raise ValueError(
                f"{setup.dataset.path}: must have depth maps for --depth on, has none; add them "
                "(docs/datasets.md, transforms.json), or leave --depth out"
            )

    def setting(self, setup: Setup) -> str | None:
        """See `Component`."""
        use = setup.config.loss.depth
        return None if use == "off" or not _have_maps(setup.train) else use

    def begin(self, setup: Setup, resumed: bool) -> None:
        """See `Component`: compares maps with points."""
        if not resumed and self.setting(setup) is not None:
            self.look(setup, setup.views)

    def look(self, setup: Setup, views: Sequence[View]) -> None:
        """Compare maps with points that photographs triangulate, and decide."""
        with Bar("depth maps") as bar:
            compared = _some(_of_one_time(views))
            # What maps say themselves is not what they are compared with.
            plain = [dataclasses.replace(view, depth_path=None) for view in compared]
            tracked = plain if len(plain) > 1 and all(view.has_image for view in plain) else []
            names = [view.name for view in tracked]
            if names[: len(self._compared)] != self._compared:
                self._matches = Matches()
            self._compared = names
            seed = setup.config.seed
            shared = shared_points(setup.dataset, tracked, seed, self._matches, bar.stage) if tracked else None
            if not setup.is_active:  # features take megabytes a photograph, and nobody asks again
                self._matches, self._compared = Matches(), []
            points, shown = shared or (np.empty((0, 3)), np.zeros((len(compared), 0), bool))
            self.found = compare(compared, points, shown)
            self.used = self.found.is_clear
            if setup.config.loss.depth == "on" and not self.used:
                metric = self.found.kind == "metric"
                self.found = dataclasses.replace(self.found, left_out=()) if metric else self.found
                self.used = metric or bool(self.found.lines)
                if not self.used and not setup.is_active:
                    raise ValueError(
                        f"{setup.dataset.path}: --depth on must have metric depth maps, or triangulated points in view "
                        f"of relative ones, got {self.found.points} points; add photographs, or leave --depth out"
                    )
            bar.note(f"depth: {self.found.words()}; {self._effect()}")
        self.terms = [self] if self.used else []

    def _effect(self) -> str:
        """What follows from the comparison, in words."""
        assert self.found is not None
        if self.used:
            return "fitted to" + ("" if self.found.is_clear else " nevertheless, by --depth on")
        if self.found.has_wrong_unit:
            return (
                "left out, also of initial points, as their unit is wrong: multiply depth_unit_scale_factor by "
                f"{1 / self.found.ratio:.3g}"
            )
        return "left out; --depth on uses them"

    def initial_views(self, views: list[View]) -> list[View]:
        """See `Component`: maps that are clearly wrong give no initial points either."""
        if self.found is None or not (self.found.left_out or self.found.has_wrong_unit):
            return views
        every, some = self.found.has_wrong_unit and not self.used, self.found.left_out
        return [dataclasses.replace(x, depth_path=None) if every or x.name in some else x for x in views]

    def start(self, fit: Fit, setup: Setup) -> None:
        """See `Component`: reads all maps, so that one that cannot be read is refused before the first step.

        Raises:
            FileNotFoundError, ValueError: As `drgs.data.View.depth`.
        """
        self._read(fit.frames)

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`; raises as `start`."""
        record = checkpoint.header.get("depth")
        if record is not None:
            self.found, self.used = Comparison.from_json(record), record["used"]
            self.terms = [self] if self.used else []
        self._read(fit.frames)

    def _read(self, frames: Sequence[Frame]) -> None:
        """Read the maps of photographs, if they are fitted to."""
        if self.used:
            with Bar("depth maps", len(frames)) as bar:
                for frame in frames:
                    self._z(frame)
                    bar.advance()

    # ---------------------------------------------------------------------------------------------------- each step

    def frame(self, fit: Fit, frame: Frame) -> Frame:
        """See `Component`: keeps what the step's rendering is compared with."""
        self._target = None
        if self.used and (z := self._z(frame)) is not None:
            first, last = fit.config.loss.depth_weight
            self._behind = fit.config.loss.depth_behind
            self._weight = first ** (1 - fit.part) * last**fit.part
            self._target = z if renders_z(fit.renderers.settings_at(fit.step_index)) else self._along(frame, z)
        return frame

    def _z(self, frame: Frame) -> torch.Tensor | None:
        """(H, W) z-depth of a photograph, read once; None where there is none to be used."""
        assert self.found is not None
        if frame.name in self.found.left_out:
            return None
        if frame.name not in self._kept:
            if frame.depth is not None and self.found.kind == "metric":
                z = frame.depth()
            elif frame.relative_depth is not None and frame.name in self.found.lines:
                z = self.found.lines[frame.name].z(frame.relative_depth())
            else:
                return None
            self._kept[frame.name] = _without_edges(torch.from_numpy(z))
        return self._kept[frame.name]

    def _along(self, frame: Frame, z: torch.Tensor) -> torch.Tensor:
        """(H, W) distance along rays, 0 where unknown."""
        camera = frame.camera
        lens = camera.K.tobytes(), camera.width, camera.height, camera.model, tuple(camera.distortion)
        if lens not in self._cosines:
            self._cosines[lens] = axis_cosines(camera)
        cosines = self._cosines[lens]
        return torch.where(cosines > 0, z / cosines, 0.0)

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `drgs.fitting.losses.LossTerm`: w mean(alpha b c log(1 + |r| / c)) of the relative errors r of rendered
        depth, 0 where a map says nothing; b is 1 before the map's depth, `depth_behind` behind it.

        It is a mean over all pixels, so that a map that knows few counts for little; gradients reach depth, not alpha.
        """
        if self._target is None:
            return None
        assert output.depth is not None  # an output of every step's rendering
        depth = output.depth
        target = _nearest(self._target, depth.shape[0], depth.shape[1]).to(depth)
        counts = (target > 0).to(depth) * output.alpha.detach()  # where next to nothing is, its depth is noise
        if frame.mask is not None:
            counts = counts * frame.mask
        if frame.transient is not None:
            counts = counts * ~frame.transient
        error = torch.where(target > 0, depth / target.clamp_min(1e-30) - 1, 0.0)
        robust = _BEND * torch.log1p(error.abs() / _BEND)
        return self._weight * (counts * robust * torch.where(error > 0, self._behind, 1.0)).mean()

    # ------------------------------------------------------------------------------------ photographs that come

    def join(self, fit: Fit, frame: Frame, setup: Setup) -> list[dict]:
        """See `Component`: maps of the photographs so far are compared again, that of the new one among them."""
        if self.setting(setup) is None:
            return []
        views = {view.name: view for view in setup.train}
        before = self.used
        self.look(setup, [views[x.name] for x in (*fit.frames, frame)])
        assert self.found is not None
        if self.found.kind == "relative":  # other points, other scales
            self._kept.clear()
        record = self.found.to_json()
        del record["lines"]
        return [{"event": "depth", **record, "used": self.used}] if self.used or before else []

    # ------------------------------------------------------------------------------- files, log, metrics and report

    def state(self, fit: Fit) -> tuple[dict[str, torch.Tensor], dict]:
        """See `Component`."""
        return {}, {} if self.found is None else {"depth": {"used": self.used, **self.found.to_json()}}

    def record(self, fit: Fit, before: Mapping[str, Any]) -> dict[str, Any]:
        """See `Component`."""
        return self.state(fit)[1]

    @classmethod
    def check(cls, checkpoint: Checkpoint) -> str | None:
        """See `Component`."""
        for name, line in checkpoint.header.get("depth", {"lines": {}})["lines"].items():
            try:
                check_json(name, line, _LINE, "")
            except ValueError as error:
                return f"the depth map of {str(error).rstrip('; ')}"
        return None


def compare(views: Sequence[View], points: np.ndarray, shown: np.ndarray) -> Comparison:
    """What the depth maps of some views say of points that are triangulated.

    Args:
        views: V views; the maps that are compared are metric ones if there are any, else relative ones.
        points: (P, 3) triangulated points, world.
        shown: (V, P) which views show which points.
    """
    is_metric = any(view.depth_path is not None for view in views)
    measured: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # numbers of the map, and triangulated z
    for view, row in zip(views, shown, strict=True):
        values = view.depth() if is_metric else view.relative_depth()
        if values is None:
            continue
        camera = view.shown_camera
        pixels, z = camera.project(points[row])
        inside = camera.contains(pixels, z)
        columns, lines = pixels[inside].astype(int).T
        at, z = values[lines, columns], z[inside]
        known = np.isfinite(at) & (z > 0) & ((at > 0) | (not is_metric))
        measured[view.name] = at[known].astype(np.float64), z[known]
    lines_of: dict[str, Line] = {}
    if not is_metric:
        tried = [_lines(measured, inverse) for inverse in (True, False)]
        lines_of = max(tried, key=lambda found: sum(_agreement(x, *measured[name]) for name, x in found.items()))
    left_out, ratios = [], []
    for name, (at, z) in measured.items():
        if is_metric:
            ratios.append(at / z)
        elif name in lines_of:
            ratios.append(lines_of[name].z(at) / z)
        else:
            left_out.append(name)
            continue
        if len(z) >= _FEWEST_OF_VIEW and _is_same(ratios[-1]).mean() < _VIEW_SHARE:
            left_out.append(name)
    every = np.concatenate([*ratios, np.empty(0)])
    ratio = float(np.median(every)) if len(every) else 1.0
    return Comparison(
        kind="metric" if is_metric else "relative",
        maps=len(measured),
        points=len(every),
        agreeing=float(_is_same(every).mean()) if len(every) else 0.0,
        ratio=ratio,
        at_ratio=float(_is_same(every / ratio).mean()) if is_metric and len(every) else 0.0,
        left_out=tuple(left_out),
        lines=lines_of,
    )


def _lines(measured: Mapping[str, tuple[np.ndarray, np.ndarray]], inverse: bool) -> dict[str, Line]:
    """The line of each view with enough points that most of them agree with, of lines through two of them."""
    found = {}
    for name, (values, z) in measured.items():
        if len(z) < _FEWEST_OF_VIEW:
            continue
        target = 1 / z if inverse else z
        rng = np.random.default_rng(0)
        first, second = rng.integers(0, len(z), (2, _LINES_TRIED))
        with np.errstate(invalid="ignore", divide="ignore"):
            scales = (target[first] - target[second]) / (values[first] - values[second])
        shifts = target[first] - scales * values[first]
        farthest = _FARTHEST * float(z.max())
        lines = [
            Line(inverse, float(a), float(b), farthest) for a, b in zip(scales, shifts, strict=True) if 0 < a < np.inf
        ]
        if not lines:
            continue
        best = max(lines, key=lambda line: _agreement(line, values, z))
        kept = _is_same(best.z(values) / z)
        if kept.sum() >= 2 and np.ptp(values[kept]) > 0:
            scale, shift = np.polyfit(values[kept], target[kept], 1)
            best = max(
                best, Line(inverse, float(scale), float(shift), farthest), key=lambda line: _agreement(line, values, z)
            )
        found[name] = best
    return found


def _agreement(line: Line, values: np.ndarray, z: np.ndarray) -> float:
    """How well a map's line agrees with points, each of which counts up to 1; wrong ones do not."""
    return float((1 - np.abs(line.z(values) / z - 1) / _SAME_DEPTH).clip(0, 1).sum())


def _is_same(ratio: np.ndarray) -> np.ndarray:
    """Which depths are the same, by their ratio."""
    return np.abs(ratio - 1) < _SAME_DEPTH


def _without_edges(z: torch.Tensor) -> torch.Tensor:
    """(H, W) z-depth, 0 where it is unknown, and where known depths around differ."""
    known = z > 0
    nearest, farthest = (
        sign * max_pool2d(torch.where(known, sign * z, -torch.inf)[None], _WINDOW, 1, _WINDOW // 2)[0]
        for sign in (-1, 1)
    )
    return torch.where(known & (farthest < (1 + _EDGE) * nearest), z, 0.0)


def _nearest(values: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """(H, W) values at a smaller size, of the nearest pixel."""
    if tuple(values.shape) == (height, width):
        return values
    rows, columns = (
        ((torch.arange(few) + 0.5) * many / few).long() for few, many in zip((height, width), values.shape, strict=True)
    )
    return values[rows][:, columns]


def _have_maps(views: Sequence[View]) -> bool:
    return any(view.depth_path is not None or view.relative_depth_path is not None for view in views)


def _of_one_time(views: Sequence[View]) -> list[View]:
    """Those at the first time: what moves is in no two places at once."""
    times = sorted({view.camera.time for view in views if view.camera.time is not None})
    return [view for view in views if len(times) < 2 or view.camera.time == times[0]]


def _some(views: list[View]) -> list[View]:
    """All of a few views with maps, else some groups of neighbors; of relative maps all, as each needs a scale."""
    views = [view for view in views if _have_maps([view])]
    if len(views) <= _COMPARED_VIEWS or all(view.depth_path is None for view in views):
        return views
    begins = np.linspace(0, len(views) - _GROUP, _COMPARED_VIEWS // _GROUP).astype(int)
    return [views[i] for i in sorted({begin + k for begin in begins for k in range(_GROUP)})]
