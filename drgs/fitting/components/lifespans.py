"""Gaussians of a fit that have a limited lifetime: added where photographs of a time show what the scene does not.

Something that goes further between two photographs than it is large, or that appears, is nowhere near the Gaussians
that were fitted to another time: no pixel sees both where a Gaussian is and where it should be, and photographs of all
other times fade it. So new Gaussians are added where it is, at that time, with the velocity that is seen there, and
photographs of other times do not reach them (`drgs.fitting.appearing`).

**Lifetimes.** A Gaussian whose short lifetime few photographs see is fitted to these alone, and shows anything from
other cameras. Long lifetimes make neighbors in time agree: the loss has `life_weight` times the mean over Gaussians of
the time between two photographs over the width of the lifetime. One that is shorter than that time is left alone: no
other time has confirmed where the Gaussian would be then, and what shows there at the wrong place is faded by the
photographs that see it. From ten times the span of all photographs on a lifetime is unlimited
(`drgs.dynamics.lifespans.LASTING`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from drgs.ellipsoids import Gaussians, Scene
from drgs.fitting.appearing import NewGaussians, find_new_gaussians
from drgs.fitting.components.base import Checkpoint, Component, Fit, Setup
from drgs.fitting.components.motion import WARM_UP, limited_lifespans
from drgs.fitting.rates import means_rate
from drgs.fitting.rows import GaussianRows
from drgs.fitting.stages import dynamic_stage, shows_first_time, spacing

if TYPE_CHECKING:
    from drgs.dynamics.lifespans import Lifespans
    from drgs.fitting.config import FitConfig
    from drgs.fitting.frames import Frame
    from drgs.fitting.networks import Rate
    from drgs.integrator import Output

REFERENCE_TIMES = "births"
"""Name of the rows' tensor, and in checkpoints, of the time at which a Gaussian is where its mean is; not fitted."""

MOST_ADDED = 0.5
"""Share of the Gaussians that there may be: how many are added at most, so that what stands still keeps as many."""

# Units of times are the median time between a photograph and the next one. The numbers are chosen, not
# tuned; docs/dynamic-data.md has what lifetimes gain as a whole.
_OPACITY = 0.3  # of a new Gaussian, as of those at points of depth maps: its place is known, too
# Opacity below which a Gaussian gives way to a new one: all have it at the start, and nothing has raised it.
_FAINT_OPACITY = 0.1
_CONFIRMED_WIDTH = 2.0  # times: width of a new lifetime that other times confirm, which then reaches its neighbors
_UNCONFIRMED_WIDTH = 0.4  # times: of one that they do not confirm, which hardly reaches them
_GAP_SHARE = 0.75  # of a longer time without photographs beside it, which the lifetime has to bridge
_CONFIRMED_SHARE = 0.4  # part of the photographs of other times that must agree with where it is then
_CENTER_RATE = 0.02  # times: learning rate of a lifetime's center, a width of `_CONFIRMED_WIDTH` in 100 steps
_WIDTH_RATE = 0.01  # learning rate of the logarithm of its width, a factor of e in 100 steps
_CLOSED_LOGIT = -2.0  # logit of the gate of a new Gaussian: 0.12, so that the field does not move it, and may later
# Times after which velocities, and accelerations, have moved a Gaussian as far as its mean moves in a step.
_VELOCITY_TIMES, _ACCELERATION_TIMES = 2.0, 8.0


class LifespansComponent(Component):
    """Gaussians with a limited lifetime in a dynamic fit: `lives` auto.

    Attributes:
        times: Times of all photographs, sorted; none in a fit without.
    """

    name = "lifespans"
    option = ("lives", "off")
    where = "where Gaussians have a limited lifetime"

    def __init__(self, times: Sequence[float] = ()) -> None:
        self.times = tuple(times)

    def prepare(self, setup: Setup) -> None:
        """See `Component`."""
        self.times = setup.times if setup.config.motion.lives == "auto" else ()

    def before_density(self, fit: Fit) -> list[dict]:
        """See `Component`: once, search for what photographs show and the scene does not.

        Where the static stage was fitted to all times it shows nothing that moves, and this is at once. Where it shows
        the first time, the field may carry what it shows to the others, and is given the time for it.
        """
        if not self.times or REFERENCE_TIMES in fit.rows.tensors:
            return []
        stage = dynamic_stage(fit.config)
        wait = WARM_UP if shows_first_time(fit.frames) else 0.0
        if fit.step_index != stage.begin + round(wait * stage.length):
            return []
        most = round(MOST_ADDED * fit.config.density.max_gaussians) - fit.reserved
        if most <= 0:
            return []
        new = find_new_gaussians(
            fit.photographs(), fit.scene(), fit.config.settings, fit.extent, most, fit.generator, fit.as_photograph
        )
        self._use(fit)
        added = add_new_gaussians(fit.rows, new, self.times, _CLOSED_LOGIT, fit.config.density.max_gaussians)
        return [
            {
                "event": "births",
                "found": len(new.points),
                "added": added,
                "photographs": new.photographs,
                "of": len(fit.frames),
                "gaussians": len(fit.rows),
            }
        ]

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`."""
        if self.times and REFERENCE_TIMES in fit.rows.tensors:
            self._use(fit)

    def _use(self, fit: Fit) -> None:
        """The term of lifetimes, and rates of their tensors, in the unit of length of the field."""
        self.terms = [LifetimeTerm(fit.rows, spacing(self.times), fit.config.motion.life_weight)]
        length = next((x.field_length for x in fit.components if x.field_length is not None), fit.extent)
        self.rates = lifespan_rates(fit.config, self.times, length)

    def scene(self, fit: Fit, scene: Scene) -> Scene:
        """See `Component`."""
        return _with_lifespans(scene, lifespans_of(fit.rows.tensors))

    def after_backward(self, fit: Fit) -> None:
        """See `Component`: Gaussians with a limited lifetime keep one color in all directions.

        The few photographs that see it would each have a color of their own, wherever it is.
        """
        rest = fit.rows.tensors["sh_rest"].grad
        if self.times and rest is not None:
            limited = limited_lifespans(fit.rows, self.times)
            if limited is not None:
                rest[limited] = 0

    def new_rows(self, fit: Fit, count: int) -> dict[str, torch.Tensor]:
        """See `Component`: Gaussians that are added are visible at all times."""
        return _unlimited(count, self.times) if REFERENCE_TIMES in fit.rows.tensors else {}

    def describe(self, event: Mapping[str, Any]) -> str | None:
        """See `Component`."""
        if event["event"] != "births":
            return None
        if not event["found"]:
            return "photographs agree with the scene at their times: no Gaussian with a limited lifetime is added"
        without = event["found"] - event["added"]
        left = f", {without} more have no room (more --max-gaussians gives it)" if without else ""
        return (
            f"{event['photographs']} of {event['of']} photographs show what is not there at most times: "
            f"{event['added']} Gaussians with a limited lifetime are added{left} (--lives off: none)"
        )

    @classmethod
    def load_scene(cls, scene: Scene, checkpoint: Checkpoint) -> Scene:
        """See `Component`."""
        if "field" not in checkpoint.header:
            return scene
        count = len(checkpoint.tensors["parameter.means"])
        return _with_lifespans(scene, checked_lifespans(checkpoint.tensors, count, checkpoint.where))


def _with_lifespans(scene: Scene, lifespans: Lifespans | None) -> Scene:
    """A `DynamicGaussians` with these lifespans."""
    if lifespans is None:
        return scene
    from drgs.deform import DynamicGaussians

    assert isinstance(scene, DynamicGaussians)  # what has lifetimes has a field
    return DynamicGaussians(scene.gaussians, scene.field, scene.motion, lifespans)


def lifespans_of(tensors: Mapping[str, torch.Tensor]) -> Lifespans | None:
    """When Gaussians live, of the tensors of their rows; None where all are always there."""
    if REFERENCE_TIMES not in tensors:
        return None
    from drgs.dynamics.lifespans import Lifespans

    return Lifespans.of(tensors, tensors[REFERENCE_TIMES].detach())  # constants


def checked_lifespans(tensors: Mapping[str, torch.Tensor], count: int, where: str) -> Lifespans | None:
    """`lifespans_of` of a checkpoint.

    Args:
        tensors: Its contents.
        count: How many Gaussians it has.
        where: It, for messages.
    Raises:
        ValueError: If a tensor is missing, not finite, or not of as many Gaussians.
    """
    from drgs.dynamics.lifespans import LIFESPAN_PARAMETERS

    held = {name.removeprefix("parameter."): x for name, x in tensors.items() if name.startswith("parameter.")}
    names = (*LIFESPAN_PARAMETERS, REFERENCE_TIMES)
    if not any(name in held for name in names):
        return None
    for name in names:
        shape = (count, 3) if name in LIFESPAN_PARAMETERS[2:] else (count,)
        if name not in held or tuple(held[name].shape) != shape or not bool(torch.isfinite(held[name]).all()):
            raise ValueError(
                f"{where}: {name} must be finite and of shape {shape}, is not; restore the file, or fit again in "
                "another folder"
            )
    return lifespans_of(held)


def lifespan_rates(config: FitConfig, times: Sequence[float], length: float) -> dict[str, Rate]:
    """Learning rates of lifetimes; of reference times, which stay as they are, 0.

    Args:
        config: Configuration of the fit.
        times: Times of all photographs, sorted.
        length: Unit of length of the field, world units.
    """
    from drgs.dynamics.lifespans import LIFESPAN_PARAMETERS

    apart = spacing(times)
    return {
        LIFESPAN_PARAMETERS[0]: _CENTER_RATE * apart,
        LIFESPAN_PARAMETERS[1]: _WIDTH_RATE,
        # They move a Gaussian as far as the rate of the means does, one soon after its reference time, the other late.
        LIFESPAN_PARAMETERS[2]: lambda part: means_rate(config, part) * length / (_VELOCITY_TIMES * apart),
        LIFESPAN_PARAMETERS[3]: lambda part: means_rate(config, part) * length / (_ACCELERATION_TIMES * apart) ** 2,
        REFERENCE_TIMES: 0.0,
    }


def add_new_gaussians(rows: GaussianRows, places: NewGaussians, times: Sequence[float], gate: float, most: int) -> int:
    """Add Gaussians with a limited lifetime; where there are `most` already, they take the place of the faintest.

    Args:
        rows: Changed in place; get tensors of lifetimes, by which the present ones are visible at all times.
        places: Places, times and velocities of theirs.
        times: Times of all photographs, sorted.
        gate: Logit of the gates of those that are added.
        most: How many Gaussians there may be.
    Returns:
        How many are added: fewer than there are places where neither room nor faint Gaussians are left.
    """
    count = len(places.points)
    if not count:
        return 0
    if REFERENCE_TIMES not in rows.tensors:
        for name, x in _unlimited(len(rows), times).items():
            rows.add_tensor(name, x)
    new = _rows_at(places, times, gate)
    for name, x in rows.tensors.items():  # features and view-dependent colors begin at 0
        if name not in new or new[name].shape[1:] != x.shape[1:]:
            new[name] = x.new_zeros(count, *x.shape[1:])
    # The faintest give way. (A choice, which has no gradient.)
    faint = (rows.tensors["logit_opacities"].detach().sigmoid() < _FAINT_OPACITY).nonzero()[:, 0]
    room = max(0, min(count, most - len(rows)))
    taken = faint[: count - room]
    rows.overwrite(taken, {name: x[room : room + len(taken)] for name, x in new.items()})
    rows.append({name: x[:room] for name, x in new.items()})
    return room + len(taken)


def _rows_at(places: NewGaussians, times: Sequence[float], gate: float) -> dict[str, torch.Tensor]:
    """Rows of Gaussians at places, as far as these say them; arguments as of `add_new_gaussians`."""
    from drgs.dynamics.lifespans import LIFESPAN_PARAMETERS

    count = len(places.points)
    new = GaussianRows.from_points(places.points, places.colors, _OPACITY).take(torch.arange(count))
    new["log_scales"] = places.sizes.log()[:, None].repeat(1, 3)
    new["motion"] = torch.full((count,), gate)
    centers = places.times.float()
    start = (centers, _first_widths(places, times).log().float(), places.velocities, places.accelerations)
    return {**new, **dict(zip(LIFESPAN_PARAMETERS, start, strict=True)), REFERENCE_TIMES: centers}


def _unlimited(count: int, times: Sequence[float]) -> dict[str, torch.Tensor]:
    from drgs.dynamics.lifespans import LASTING, LIFESPAN_PARAMETERS

    width = torch.tensor(2 * LASTING * (times[-1] - times[0]))
    still = torch.zeros(count, 3)
    values = (torch.full((count,), (times[0] + times[-1]) / 2), width.log().repeat(count), still, still)
    return {**dict(zip(LIFESPAN_PARAMETERS, values, strict=True)), REFERENCE_TIMES: torch.zeros(count)}


def _first_widths(places: NewGaussians, times: Sequence[float]) -> torch.Tensor:
    """(M,) first widths of lifetimes: standard deviations in time.

    Gaussians that other times do not confirm are visible at their own; others bridge times without photographs.
    """
    known = torch.tensor(times, dtype=torch.float64)
    at = (known[None] - places.times.double()[:, None]).abs().argmin(1)
    apart = torch.cat([torch.zeros(1, dtype=torch.float64), known.diff(), torch.zeros(1, dtype=torch.float64)])
    gap = torch.maximum(apart[at], apart[at + 1])
    step = torch.full_like(gap, spacing(times))
    long = torch.maximum(_CONFIRMED_WIDTH * step, _GAP_SHARE * gap)
    return torch.where(places.confirmed > _CONFIRMED_SHARE, long, _UNCONFIRMED_WIDTH * step)


@dataclasses.dataclass(frozen=True, eq=False)
class LifetimeTerm:
    """Term of the loss that keeps lifetimes long: the mean over Gaussians of the time between photographs over
    the width of a lifetime, where that is below 1.
    """

    rows: GaussianRows
    spacing: float
    weight: float
    name: ClassVar[str] = "lives"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`; None where all Gaussians are always there."""
        if REFERENCE_TIMES not in self.rows.tensors:
            return None
        from drgs.dynamics.lifespans import LIFESPAN_PARAMETERS

        parts = self.spacing * (-self.rows.tensors[LIFESPAN_PARAMETERS[1]]).exp()
        # Which are long enough to be lengthened is a choice, which has no derivative.
        return self.weight * torch.where(parts.detach() < 1, parts, 0).mean()
