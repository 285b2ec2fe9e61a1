"""The two stages of a fit to what moves: Gaussians that stand still, then a deformation field that moves some of them.

Which Gaussians move is learned. Each has a gate, `motion` in the rows. While it is open the Gaussian moves as the
field says, times a factor between 0 and 1; the loss has `motion_weight` times the mean gate in it, so that a gate stays
open only if photographs need what it lets through. Once it is closed nothing is computed for the Gaussian. In the first
fifth of the stage gates stay open, as the field must learn what it can do; at three fifths all open again for a
twentieth, so that what was closed before a field or a photograph could show its motion moves after all.

What the field cannot bring to where it is at a time, for no Gaussian shows it or it goes too far at once, gets new
Gaussians with a limited lifetime there (lifespans.py).

Adam alone moves a gate as far by a tiny gradient as by a large one. Here its epsilon is of the size of the penalty's
own gradient: where photographs hardly show whether a Gaussian moves, their noise does not decide about its gate.

Reference:
    Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR 2024, and its code: the two stages
    and the regularizers. Gates, planes of space that are smooth along both axes, and rates are not from there.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from drgs.display.progress import Bar
from drgs.fitting.components.base import Checkpoint, Component, Conflict, Fit, RunViews, Setup
from drgs.fitting.networks import Network, saved_networks
from drgs.fitting.stages import Stage, dynamic_stage, first_time, moving_labels
from drgs.io.json_files import check_json

if TYPE_CHECKING:
    from drgs.data import View
    from drgs.deform import DeformationField, DynamicGaussians, FieldConfig
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.fitting.config import FitConfig
    from drgs.fitting.frames import Frame
    from drgs.fitting.rows import GaussianRows
    from drgs.integrator import Output

FIELD = ("deformation.grid", "deformation.mlp")
"""Names of the networks of a fit to what moves."""

WARM_UP = 0.2
"""Share of the dynamic stage at its start in which all gates are held open, until the field has learned some motion;
chosen. Gaussians with a lifetime that are added then, not at the start of the stage: 35.6 in place of 24.6 dB on twelve
blobs (docs/data/moving-trials.csv)."""

_STATIC_BUDGET = 0.5  # of `max_gaussians` in the static stage: the rest is for what appears later; chosen, not tuned
_OPEN_LOGIT = 2.0  # logit of a gate at the start, which lets 0.76 of a motion through and is not saturated; chosen
_UNPENALIZED_LOGIT = -1.0  # logit below which a gate has no penalty, so that it stays able to open again; chosen
# Parts of the dynamic stage; chosen. With all gates closed by force half way, twelve blobs fall to 20.7 dB, and are
# back at 35.7 at the end (docs/data/moving-trials.csv).
_REOPENED_AT = 0.6  # when all gates open again, as at the start: closed ones have no gradient
_REOPENED_FOR = 0.05  # how long they are then held open
# Adam's epsilon of gates over the gradient of their penalty: below it steps are in proportion; chosen.
_GATE_EPSILON = 0.3
_MOST_LOGIT_CHANGE = 0.5  # change of a gate's logit in a step, at most, however short the fit; chosen
# Quantile of the means along each axis, at both ends, that bounds the field: floaters are outside; chosen.
_OUTSIDE_SHARE = 0.005
_MARGIN = 0.1  # of the size within these bounds, added on each side: Gaussians of the scene may move there; chosen
_TIMED_RUNS = 5  # runs whose median is the measured time: odd; chosen
_ADVICE = "restore the file, or fit again in another folder"


class MotionComponent(Component):
    """The two stages of a fit to what moves, the field, and which Gaussians move; where views have several times.

    Attributes:
        times: All that views of the data set have, sorted; none where nothing moves.
        field: None in the static stage.
        field_length: The extent of the scene or of its Gaussians, whichever is less.
    """

    name = "motion"
    option = ("dynamics", "ignore")
    where = "where things move"
    record_kinds = {"times": [float]}
    conflicts = (
        Conflict("begin", "a field is fitted from the first Gaussians on", "leave begin out, or use --dynamics ignore"),
        Conflict("pace", "its stages count steps", "leave pace out, or use --dynamics ignore"),
    )
    block = ("deformation", "a fit of what is still")

    def __init__(self, times: Sequence[float] = ()) -> None:
        self.times = tuple(times)
        self.field: DeformationField | None = None
        self.field_length: float = 1.0
        self._labels: frozenset[int] = frozenset()

    def prepare(self, setup: Setup) -> None:
        """See `Component`."""
        self.times = setup.times
        self._labels = moving_labels(setup.dataset) if self.times else frozenset()

    def setting(self, setup: Setup) -> str | None:
        """See `Component`."""
        return setup.config.motion.dynamics if setup.times else None

    def initial_views(self, views: list[View]) -> list[View]:
        """See `Component`: those of the first time."""
        return first_time(views) if self.times else views

    # --------------------------------------------------------------------------------------------------- stages

    def before_density(self, fit: Fit) -> list[dict]:
        """See `Component`: begins the dynamic stage when that is due."""
        if not self.times or self.field is not None or fit.step_index < dynamic_stage(fit.config).begin:
            return []
        self.begin_field(fit.config, fit.rows, fit.extent)
        fit.begin_stage()
        return [{"event": "stage", "name": "dynamic", "gaussians": len(fit.rows)}]

    def stage(self, fit: Fit) -> Stage | None:
        """See `Component`."""
        if not self.times:
            return None
        dynamic = dynamic_stage(fit.config)
        return Stage(0, dynamic.begin, _STATIC_BUDGET) if self.field is None else dynamic

    def fitted_frames(self, frames: list[Frame]) -> list[Frame]:
        """See `Component`: the static stage is fitted to the first time."""
        return first_time(frames) if self.times and self.field is None else frames

    def begin_field(self, config: FitConfig, rows: GaussianRows, extent: float) -> None:
        """Begin the dynamic stage.

        Args:
            config: Configuration of the fit.
            rows: Get gates.
            extent: Extent of the scene, in world units.
        """
        ends = torch.tensor([_OUTSIDE_SHARE, 1 - _OUTSIDE_SHARE], dtype=torch.float64)
        bounds = torch.quantile(rows.places(), ends, dim=0)
        margin = _MARGIN * (bounds[1] - bounds[0])
        rows.add_tensor("motion", torch.full((len(rows),), _OPEN_LOGIT))
        # Cameras may stand far from what they film, and what they film may reach to the horizon.
        self.field_length = min(extent, float((bounds[1] - bounds[0]).max()) or extent)
        self._use(config, rows, torch.stack([bounds[0] - margin, bounds[1] + margin]))

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`."""
        if self.times and "motion" in fit.rows.tensors:
            check_json(checkpoint.where, checkpoint.header, {"field_length": float}, _ADVICE)
            self.field_length = checkpoint.header["field_length"]
            self._use(fit.config, fit.rows, torch.tensor([[0.0] * 3, [1.0] * 3]))

    def _use(self, config: FitConfig, rows: GaussianRows, bounds: torch.Tensor) -> None:
        """Fit a new field in (2, 3) bounds of the world from now on."""
        from drgs.deform import LENGTHS, DeformationField, FieldConfig

        sizes = FieldConfig.preset(config.motion.field_preset, times=len(self.times))
        self.field = field = DeformationField(sizes, bounds, (self.times[0], self.times[-1]), seed=config.seed)
        stage = dynamic_stage(config)
        begin = stage.begin / config.max_steps

        def rate(ends: tuple[float, float], part: float) -> float:
            share = min(max((part - begin) / (1 - begin), 0.0), 1.0)
            return ends[0] * (ends[1] / ends[0]) ** share

        # Adam's steps have the rate's length: what makes lengths of features has them in units of what it moves.
        lengths = {name.removeprefix("mlp."): self.field_length for name in LENGTHS}
        self.networks = [
            Network(FIELD[0], field.grid, lambda part: rate(config.motion.grid_rate, part), fused=True),
            Network(FIELD[1], field.mlp, lambda part: rate(config.motion.field_rate, part), lengths, fused=True),
        ]
        self.terms = [Smoothness(field, config)]
        self._rest = Rest(rows, config.motion.motion_weight)
        if config.motion.motion_weight:
            self.terms = [*self.terms, self._rest]
        gates = min(config.motion.motion_rate / max(stage.length, 1), _MOST_LOGIT_CHANGE)
        self.rates = {"motion": lambda part: 0.0 if is_held_open(config, round(part * config.max_steps)) else gates}

    # -------------------------------------------------------------------------------------------------- each step

    def before_step(self, fit: Fit) -> list[dict]:
        """See `Component`."""
        if self.field is not None:
            self.prepare_gates(fit.config, fit.rows, fit.step_index)
        return []

    def prepare_gates(self, config: FitConfig, rows: GaussianRows, step: int) -> None:
        """Before a step of the dynamic stage: gates get the epsilon of their optimizer and, once, all open again."""
        self._rest.is_held_open = is_held_open(config, step)
        gates = rows.tensors["motion"]
        group = next(group for group in rows.optimizer.param_groups if group["name"] == "motion")
        group["eps"] = max(_GATE_EPSILON * config.motion.motion_weight / max(len(rows), 1), 1e-15)
        if step == _reopening(config):
            with torch.no_grad():  # leaves are changed in place
                opened = gates.clamp(min=_OPEN_LOGIT)
                limited = limited_lifespans(rows, self.times)
                if limited is not None:  # these drift by themselves
                    opened = torch.where(limited, gates, opened)
                rows.overwrite(torch.arange(len(rows)), {"motion": opened})

    def scene(self, fit: Fit, scene: Scene) -> Scene:
        """See `Component`."""
        if self.field is None:
            return scene
        from drgs.deform import DynamicGaussians

        return DynamicGaussians(scene, self.field, fit.rows.tensors["motion"])  # type: ignore[arg-type]  # Gaussians

    def new_rows(self, fit: Fit, count: int) -> dict[str, torch.Tensor]:
        """See `Component`: what is added may move."""
        return {} if self.field is None else {"motion": torch.full((count,), _OPEN_LOGIT)}

    # --------------------------------------------------------------------------------------------- files and log

    def state(self, fit: Fit) -> tuple[dict[str, torch.Tensor], dict]:
        """See `Component`."""
        if self.field is None:
            return {}, {}
        return {}, {"field": dataclasses.asdict(self.field.config), "field_length": self.field_length}

    def record(self, fit: Fit, before: Mapping[str, Any]) -> dict[str, Any]:
        """See `Component`."""
        return {"times": list(self.times)} if self.times else {}

    def log_fields(self, fit: Fit, terms: Sequence[Mapping[str, float]]) -> dict[str, Any]:
        """See `Component`: the part of the Gaussians that move."""
        return {} if self.field is None else {"moving": moving_share(fit.rows)}

    def evaluation(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`: labels of what moves, whose pixels are measured by themselves."""
        return {"moving": self._labels} if self.times else {}

    def metrics(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`: how many Gaussians move, and what not deforming the others saves.

        Returns:
            `motion` with `moving`, `share`, `seconds` of deforming them and `seconds_all` of deforming all, a step, the
            medians of 5 runs forward and backward, and, where some have one, `living`: how many have a limited
            lifetime. Nothing in the static stage.
        """
        if self.field is None:
            return {}
        from drgs.deform import DynamicGaussians

        rows = fit.rows
        gates = rows.tensors["motion"]
        scenes = [DynamicGaussians(rows.gaussians(), self.field, motion) for motion in (gates, gates.abs() + 1)]
        took: list[list[float]] = [[], []]
        moment = self.times[len(self.times) // 2]
        with Bar("timing the deformation", _TIMED_RUNS) as bar:
            for _ in range(_TIMED_RUNS):
                for scene, spent in zip(scenes, took, strict=True):
                    began = time.perf_counter()
                    parameters = [x for x in scene.parameters().values() if x.requires_grad]
                    seen = scene.at(moment)
                    total = seen.means.sum() + seen.quats.sum() + seen.log_scales.sum()
                    torch.autograd.grad(total, parameters, allow_unused=True, retain_graph=True)
                    spent.append(time.perf_counter() - began)
                bar.advance()
        seconds, everything = (sorted(spent)[_TIMED_RUNS // 2] for spent in took)
        counted = {**moving_counts(scenes[0]), "seconds": seconds, "seconds_all": everything}
        limited = limited_lifespans(rows, self.times)
        return {"motion": counted | ({} if limited is None else {"living": int(limited.sum())})}

    @classmethod
    def run_metrics(cls, run: RunViews) -> dict[str, Any]:
        """See `Component`."""
        scene: Any = run.scene
        if not hasattr(scene, "moving"):
            return {}
        living = {} if scene.lifespans is None else {"living": int(scene.has_lifespan.sum())}
        return {"motion": moving_counts(scene) | living}

    @classmethod
    def load_scene(cls, scene: Scene, checkpoint: Checkpoint) -> Scene:
        """See `Component`."""
        return _moving_scene(scene, checkpoint) if "field" in checkpoint.header else scene  # type: ignore[arg-type]


def is_held_open(config: FitConfig, step: int) -> bool:
    """Whether gates stay as they are in a step, without a penalty, for the field to learn what it can do."""
    stage = dynamic_stage(config)
    again = _reopening(config)
    return step < stage.begin + WARM_UP * stage.length or again <= step < again + _REOPENED_FOR * stage.length


def _reopening(config: FitConfig) -> int:
    """The step before which all gates open again."""
    stage = dynamic_stage(config)
    return stage.begin + round(_REOPENED_AT * stage.length)


def moving_share(rows: GaussianRows) -> float:
    """Part of the Gaussians that move."""
    # Counted, not optimized.
    return float((rows.tensors["motion"].detach() >= 0).float().mean()) if len(rows) else 0.0


def moving_counts(scene: DynamicGaussians) -> dict[str, Any]:
    """How many Gaussians move, and their share of all."""
    moving = int(scene.moving.sum())
    return {"moving": moving, "share": moving / max(len(scene), 1)}


def limited_lifespans(rows: GaussianRows, times: Sequence[float]) -> torch.Tensor | None:
    """(N,) bool, which Gaussians have a limited lifetime; None where lifetimes are not fitted."""
    from drgs.dynamics.lifespans import LIFESPAN_PARAMETERS, is_limited

    widths = rows.tensors.get(LIFESPAN_PARAMETERS[1])
    return None if widths is None else is_limited(widths, times[-1] - times[0])


@dataclasses.dataclass(frozen=True)
class Smoothness:
    """What keeps the planes of a field smooth in time and space, and near 1 (`drgs.dynamics.regularizers`)."""

    field: DeformationField
    config: FitConfig
    name: ClassVar[str] = "field"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`; None where all weights are 0."""
        from drgs.dynamics.regularizers import plane_smoothness, time_l1, time_smoothness

        weights = {
            time_smoothness: self.config.motion.smooth_weight,
            plane_smoothness: self.config.motion.plane_weight,
            time_l1: self.config.motion.l1_time_weight,
        }
        parts = [weight * of(self.field.grid) for of, weight in weights.items() if weight]
        return torch.stack(parts).sum() if parts else None


@dataclasses.dataclass(eq=False)
class Rest:
    """The mean gate, that is what part of the Gaussians moves; closed gates count as they are when just closed.

    Attributes:
        rows: Have the gates.
        weight: Weight of the term.
        is_held_open: Whether gates stay open in this step, without this term.
    """

    rows: GaussianRows
    weight: float
    is_held_open: bool = False
    name: ClassVar[str] = "rest"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`; None while gates stay open."""
        if self.is_held_open:
            return None
        return self.weight * self.rows.tensors["motion"].clamp(min=_UNPENALIZED_LOGIT).sigmoid().mean()


def _moving_scene(gaussians: Gaussians, checkpoint: Checkpoint) -> DynamicGaussians:
    """The scene of a checkpoint of the dynamic stage, for rendering.

    Args:
        gaussians: Its canonical Gaussians.
        checkpoint: Contents of the checkpoint.
    Raises:
        ValueError: If the field is missing, or its tensors have other shapes than its sizes ask for.
    """
    from drgs.deform import DeformationField, DynamicGaussians

    tensors, header, where = dict(checkpoint.tensors), dict(checkpoint.header), checkpoint.where
    networks = saved_networks(tensors, header)
    sizes = _sizes(header, networks, where)
    field = DeformationField(sizes, [[0.0] * 3, [1.0] * 3])
    for name, module in zip(FIELD, (field.grid, field.mlp), strict=True):
        held = networks[name]
        for key, x in module.state_dict().items():
            got = tuple(held[key].shape) if key in held else "none"
            if got != tuple(x.shape):
                raise ValueError(
                    f"{where}: {name}.parameter.{key} must have shape {tuple(x.shape)}, got {got}; {_ADVICE}"
                )
        module.load_state_dict({key: held[key] for key in module.state_dict()})
        if bad := [key for key, x in module.state_dict().items() if not bool(torch.isfinite(x).all())]:
            raise ValueError(f"{where}: {name}.parameter.{bad[0]} must be finite, is not; {_ADVICE}")
    field.requires_grad_(False)
    gates = tensors.get("parameter.motion")
    if gates is None or tuple(gates.shape) != (len(gaussians),) or not bool(torch.isfinite(gates).all()):
        raise ValueError(f"{where}: motion must be {len(gaussians)} finite numbers, one a Gaussian; {_ADVICE}")
    return DynamicGaussians(gaussians, field, gates)


def _sizes(header: dict, networks: dict[str, dict], where: str) -> FieldConfig:
    """The sizes of a checkpoint's field, as far as its tensors bear them out: nothing is made by what a header says."""
    from drgs.deform import FieldConfig

    kind: dict[str, Any] = dict.fromkeys(("channels", "resolution", "time_resolution", "width", "depth"), int)
    check_json(where, header, {"field": {**kind, "levels": [int], "last_std": float}}, _ADVICE)
    # A depth of 0 was one layer, as 1 is, in files of older versions.
    said = {**header["field"], "depth": max(header["field"]["depth"], 1)}
    try:
        sizes = FieldConfig(**{**said, "levels": tuple(said["levels"])})
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}; {_ADVICE}") from None
    if missing := [name for name in FIELD if name not in networks]:
        raise ValueError(f"{where}: networks must have {missing[0]}, got {', '.join(networks) or 'none'}; {_ADVICE}")
    grid, mlp = (networks[name] for name in FIELD)
    layers = sum(key.startswith("trunk.") and key.endswith(".weight") for key in mlp)
    shape = lambda x: None if x is None else tuple(x.shape)  # noqa: E731
    sides = [sizes.resolution * level for level in sizes.levels]
    borne_out = len(grid) == 6 * len(sides) + 2 and layers == sizes.depth
    for k, side in enumerate(sides):
        borne_out = borne_out and shape(grid.get(str(6 * k))) == (side, side, sizes.channels)
        borne_out = borne_out and shape(grid.get(str(6 * k + 3))) == (sizes.time_resolution, side, sizes.channels)
    if not borne_out or shape(mlp.get("trunk.0.weight")) != (sizes.width, sizes.channels * len(sides)):
        raise ValueError(f"{where}: the sizes of the field must be those of its tensors, are {said}; {_ADVICE}")
    return sizes
