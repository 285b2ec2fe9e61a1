"""The two stages of a fit to what moves: Gaussians that stand still, then a deformation field that moves some of them.

Which Gaussians move is learned. Each has a gate, `motion` in the rows. While it is open the Gaussian moves as the
field says, times a factor between 0 and 1; the loss has `motion_weight` times the mean gate in it, so that a gate stays
open only if photographs need what it lets through. Once it is closed nothing is computed for the Gaussian. In the first
fifth of the stage gates stay open, as the field must learn what it can do; at three fifths all open again for a
twentieth, so that what was closed before a field or a photograph could tell moves after all.

What the field cannot bring to where it is at a time, for no Gaussian shows it or it goes too far at once, is
born there for a time (births.py, lives.py).

Adam alone moves a gate as far by a tiny gradient as by a large one. Here its epsilon is of the size of the penalty's
own gradient: where photographs hardly tell whether a Gaussian moves, their noise does not decide about its gate.

Reference:
    Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR 2024, and its code: the two stages
    and the regularizers. Gates, planes of space that are smooth along both axes, and rates are not from there.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from drgs.deform import DeformationField, DynamicGaussians, FieldConfig
from drgs.dynamics.lives import Lives, living
from drgs.dynamics.regularizers import plane_smoothness, time_l1, time_smoothness
from drgs.fitting.lives import Lasting, add_births, always, checked_lives, life_rates, lives_of
from drgs.fitting.networks import Network
from drgs.fitting.parts import means_rate
from drgs.fitting.stages import Stage, first_time, shows_first_time, spacing
from drgs.io.json_files import check_json

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians
    from drgs.fitting.births import Births
    from drgs.fitting.config import FitConfig
    from drgs.fitting.frames import Frame
    from drgs.fitting.parts import Parts
    from drgs.fitting.rows import GaussianRows
    from drgs.integrator import Output

__all__ = ["FIELD", "Motion", "moving_scene"]

FIELD = ("deformation.grid", "deformation.mlp")
"""Names of the networks of a fit to what moves."""

_STATIC_BUDGET = 0.5  # of the Gaussians there may be
_WARM_UP = 0.2  # of the dynamic stage, in which all gates stay open: the field must have learned something
_OPEN = 2.0  # logit of a gate at the start, which lets 0.76 of a motion through
_SHUT = -2.0  # logit of the gate of one that is born for a time
_CLOSED = -1.0  # logit below which a gate has no penalty: it must be able to come back
_AGAIN = 0.6  # of the dynamic stage: when all gates open again, those of what stood still as at the start
_LOOK = 0.05  # of the dynamic stage, in which they then stay open
_NOISE = 0.3  # epsilon of a gate's Adam, in weights of its penalty: below, a gate moves in proportion to its gradient
_FASTEST = 0.5  # change of a logit in a step
_OUTSIDE = 0.005  # part of the Gaussians that may lie below the bounds of the field along an axis, and above
_MARGIN = 0.1  # of the field's size
_SOON, _LATE = 2.0, 8.0  # times between photographs
_REPEATS = 5  # of a measured time
_ADVICE = "restore the file, or fit again in another folder"


class Motion:
    """What a fit has besides its parts if things move: stages, the field, and who moves.

    Args:
        config: Configuration of the fit.
        times: All that views of the data set have, sorted; at least two.
    Attributes:
        field: None in the static stage.
        step: The one that is fitted.
    """

    def __init__(self, config: FitConfig, times: Sequence[float]) -> None:
        self.config = config
        self.times = tuple(times)
        self.first_step = round(config.motion.static_share * config.max_steps)
        self.field: DeformationField | None = None
        self.step = 0
        self._length = 1.0  # the field's unit of length: the extent of the scene or of its Gaussians, whichever is less
        self._again = self.first_step + round(_AGAIN * (config.max_steps - self.first_step))

    def has_begun(self, rows: GaussianRows) -> bool:
        """Whether the dynamic stage has."""
        return "motion" in rows.tensors

    def is_due(self, step: int) -> bool:
        """Whether the dynamic stage is to begin before a step."""
        return self.field is None and step >= self.first_step

    def is_to_look(self, step: int, frames: list[Frame]) -> bool:
        """Whether to look, before a step, for what photographs show and the scene does not.

        Where the static stage was fitted to all times it shows nothing that moves, and this is at once. Where it shows
        the first time, the field may carry what it shows to the others, and is given the time for it.
        """
        if self.config.motion.lives == "off":
            return False
        wait = _WARM_UP if shows_first_time(frames) else 0.0
        return step == self.first_step + round(wait * (self.config.max_steps - self.first_step))

    def stage(self) -> Stage:
        """Over which density control runs now."""
        if self.field is None:
            return Stage(0, self.first_step, _STATIC_BUDGET)
        return Stage(self.first_step, self.config.max_steps)

    def shown(self, frames: list[Frame]) -> list[int]:
        """Indices of the photographs that this stage is fitted to."""
        first = {id(frame) for frame in (first_time(frames) if self.field is None else frames)}
        return [i for i, frame in enumerate(frames) if id(frame) in first]

    def begin(self, rows: GaussianRows, parts: Parts, extent: float) -> Parts:
        """Go on to the dynamic stage.

        Args:
            rows: Get gates.
            parts: Parts of the static stage.
            extent: Extent of the scene, in world units.
        Returns:
            With the field's networks, terms and rates, and a scene that moves.
        """
        means = rows.tensors["means"].detach().double()  # where the field lies is a constant
        ends = torch.tensor([_OUTSIDE, 1 - _OUTSIDE], dtype=torch.float64)
        bounds = torch.quantile(means, ends, dim=0)
        margin = _MARGIN * (bounds[1] - bounds[0])
        rows.add_tensor("motion", torch.full((len(rows),), _OPEN))
        # Cameras may stand far from what they film, and what they film may reach to the horizon.
        self._length = min(extent, float((bounds[1] - bounds[0]).max()) or extent)
        return self._extended(rows, parts, torch.stack([bounds[0] - margin, bounds[1] + margin]))

    def restored(self, rows: GaussianRows, parts: Parts, header: dict, where: str) -> Parts:
        """As `begin`, for the rows of a checkpoint of the dynamic stage, whose networks are restored afterwards."""
        check_json(where, header, {"field_length": float}, _ADVICE)
        self._length = header["field_length"]
        return self._extended(rows, parts, torch.tensor([[0.0] * 3, [1.0] * 3]))

    def give_birth(self, rows: GaussianRows, found: Births) -> None:
        """Add Gaussians that are there for a time; they drift by themselves, and the field does not move them."""
        add_births(rows, found, self.times, _SHUT, self.config.density.max_gaussians)

    def new_gates(self, count: int, rows: GaussianRows) -> dict[str, torch.Tensor]:
        """Gates and lives of Gaussians that are added from points: they are always there."""
        gates = {"motion": torch.full((count,), _OPEN)} if self.has_begun(rows) else {}
        return gates | always(count, rows, self.times)

    def prepare(self, rows: GaussianRows, step: int) -> None:
        """Before a step of the dynamic stage: gates get the epsilon of their optimizer and, once, all open again."""
        self.step = step
        gates = rows.tensors["motion"]
        group = next(group for group in rows.optimizer.param_groups if group["name"] == "motion")
        group["eps"] = max(_NOISE * self.config.motion.motion_weight / max(len(rows), 1), 1e-15)
        if step == self._again:
            with torch.no_grad():  # leaves are changed in place
                opened = gates.clamp(min=_OPEN)
                lives = lives_of(rows.tensors)
                if lives is not None:
                    opened = torch.where(self._living(lives), gates, opened)
                rows.overwrite(torch.arange(len(rows)), {"motion": opened})

    def hold(self, rows: GaussianRows) -> None:
        """After gradients are known: what is there for a time alone keeps one color in all directions.

        The few photographs that see it would each have a color of their own, wherever it is.
        """
        lives, rest = lives_of(rows.tensors), rows.tensors["sh_rest"].grad
        if lives is not None and rest is not None:
            rest[self._living(lives)] = 0

    def is_held_open(self, step: int) -> bool:
        """Whether gates stay as they are in a step, without a penalty, for the field to learn what it can do."""
        length = self.config.max_steps - self.first_step
        return step < self.first_step + _WARM_UP * length or self._again <= step < self._again + _LOOK * length

    def header(self) -> dict:
        """What a checkpoint's header says beside the rest."""
        if self.field is None:
            return {}
        return {"field": dataclasses.asdict(self.field.config), "field_length": self._length}

    def share(self, rows: GaussianRows) -> float | None:
        """Part of the Gaussians that move; None in the static stage."""
        if not self.has_begun(rows):
            return None
        # Told, not optimized.
        return float((rows.tensors["motion"].detach() >= 0).float().mean()) if len(rows) else 0.0

    def report(self, rows: GaussianRows, progress: Callable[[int, int], object] | None = None) -> dict | None:
        """How many Gaussians move, and what not deforming the others saves: medians of 5 runs forward and backward.

        Args:
            progress: Called with the runs done and those there are.
        Returns:
            JSON-serializable: `moving`, `share`, `seconds` of deforming them and `seconds_all` of deforming all, a
            step, and, where some were born, `living`, how many are there for a time alone; None in the static stage.
        """
        if self.field is None:
            return None
        gates = rows.tensors["motion"]
        scenes = [DynamicGaussians(rows.gaussians(), self.field, motion) for motion in (gates, gates.abs() + 1)]
        took: list[list[float]] = [[], []]
        moment = self.times[len(self.times) // 2]
        for repeat in range(_REPEATS):
            for scene, spent in zip(scenes, took, strict=True):
                began = time.perf_counter()
                parameters = [x for x in scene.parameters().values() if x.requires_grad]
                seen = scene.at(moment)
                total = seen.means.sum() + seen.quats.sum() + seen.log_scales.sum()
                torch.autograd.grad(total, parameters, allow_unused=True, retain_graph=True)
                spent.append(time.perf_counter() - began)
            if progress:
                progress(repeat + 1, _REPEATS)
        seconds, everything = (sorted(spent)[_REPEATS // 2] for spent in took)
        moving = int(scenes[0].moving.sum())
        share = moving / max(len(rows), 1)
        told = {"moving": moving, "share": share, "seconds": seconds, "seconds_all": everything}
        lives = lives_of(rows.tensors)
        return told | ({} if lives is None else {"living": int(self._living(lives).sum())})

    def _living(self, lives: Lives) -> torch.Tensor:
        """(N,) bool, which Gaussians are there for a time alone."""
        return living(lives.log_widths, self.times[-1] - self.times[0])

    def _extended(self, rows: GaussianRows, parts: Parts, bounds: torch.Tensor) -> Parts:
        """The parts of the dynamic stage, around a new field."""
        config = self.config
        sizes = FieldConfig.preset(config.motion.field_preset, times=len(self.times))
        self.field = field = DeformationField(sizes, bounds, (self.times[0], self.times[-1]), seed=config.seed)
        begin = self.first_step / config.max_steps

        def rate(ends: tuple[float, float], part: float) -> float:
            share = min(max((part - begin) / (1 - begin), 0.0), 1.0)
            return ends[0] * (ends[1] / ends[0]) ** share

        # Adam's steps have the rate's length: what makes lengths of features has them in units of what it moves.
        lengths = dict.fromkeys(("means.3.weight", "means.3.bias"), self._length)
        networks = [
            Network(FIELD[0], field.grid, lambda part: rate(config.motion.grid_rate, part), fused=True),
            Network(FIELD[1], field.mlp, lambda part: rate(config.motion.field_rate, part), lengths, fused=True),
        ]
        terms = [*parts.terms, Smoothness(field, config)]
        if config.motion.motion_weight:
            terms.append(Rest(self, rows, config.motion.motion_weight))
        if config.motion.lives == "auto":
            terms.append(Lasting(rows, spacing(self.times), config.motion.life_weight))
        apart = spacing(self.times)
        steps = max(config.max_steps - self.first_step, 1)
        gates = min(config.motion.motion_rate / steps, _FASTEST)
        return dataclasses.replace(
            parts,
            terms=terms,
            rates={
                **parts.rates,
                "motion": lambda part: 0.0 if self.is_held_open(round(part * config.max_steps)) else gates,
                **life_rates(self.times),
                # They move a Gaussian as far as the rate of the means does, one soon after its birth, the other late.
                "velocities": lambda part: means_rate(config, part) * self._length / (_SOON * apart),
                "accelerations": lambda part: means_rate(config, part) * self._length / (_LATE * apart) ** 2,
            },
            networks=[*parts.networks, *networks],
            scene=lambda rows: DynamicGaussians(
                rows.gaussians(), field, rows.tensors["motion"], lives_of(rows.tensors)
            ),
        )


@dataclasses.dataclass(frozen=True)
class Smoothness:
    """What keeps the planes of a field smooth in time and space, and near 1 (`drgs.dynamics.regularizers`)."""

    field: DeformationField
    config: FitConfig
    name: ClassVar[str] = "field"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`; None where all weights are 0."""
        weights = {
            time_smoothness: self.config.motion.smooth_weight,
            plane_smoothness: self.config.motion.plane_weight,
            time_l1: self.config.motion.l1_time_weight,
        }
        parts = [weight * of(self.field.grid) for of, weight in weights.items() if weight]
        return torch.stack(parts).sum() if parts else None


@dataclasses.dataclass(frozen=True, eq=False)
class Rest:
    """The mean gate, that is what part of the Gaussians moves; closed gates count as they are when just closed."""

    motion: Motion
    rows: GaussianRows
    weight: float
    name: ClassVar[str] = "rest"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`; None while gates stay open."""
        if self.motion.is_held_open(self.motion.step):
            return None
        return self.weight * self.rows.tensors["motion"].clamp(min=_CLOSED).sigmoid().mean()


def moving_scene(
    gaussians: Gaussians, tensors: dict[str, torch.Tensor], networks: dict[str, dict], header: dict, where: str
) -> DynamicGaussians:
    """The scene of a checkpoint of the dynamic stage, to be looked at.

    Args:
        gaussians: Its canonical Gaussians.
        tensors, header: Contents of the checkpoint.
        networks: Result of `saved_networks`.
        where: It, for messages.
    Raises:
        ValueError: If the field is missing, or its tensors have other shapes than its sizes ask for.
    """
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
    return DynamicGaussians(gaussians, field, gates, checked_lives(tensors, len(gaussians), where))


def _sizes(header: dict, networks: dict[str, dict], where: str) -> FieldConfig:
    """The sizes of a checkpoint's field, as far as its tensors bear them out: nothing is made by what a header says."""
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
