"""Gaussians of a fit that are there for a time alone: born where photographs of a time show what the scene does not.

Something that goes further between two photographs than it is large, or that appears, is nowhere near the Gaussians
that were fitted to another time: no pixel sees both where a Gaussian is and where it should be, and photographs of all
other times fade it. So Gaussians are born where it is (births.py), at that time, with the velocity that is seen
there, and photographs of other times do not reach them.

A life that few photographs see is fitted to these alone, and shows from other cameras what it likes. What keeps lives
long makes neighbors in time agree: the loss has `life_weight` times the mean over Gaussians of the time between two
photographs over the width of the life. One that is shorter than that time is left alone: no other time has confirmed
where it would be then, and what shows there at the wrong place is faded by the photographs that see it. A life as long
as ten times all photographs together has ended as one (`drgs.dynamics.lives.LASTING`): the Gaussian is always there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import torch

from drgs.dynamics.lives import LASTING, LIVES, Lives
from drgs.fitting.stages import spacing

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians
    from drgs.fitting.births import Births
    from drgs.fitting.frames import Frame
    from drgs.fitting.rows import GaussianRows
    from drgs.integrator import Output

__all__ = [
    "BIRTHS",
    "MOST_BORN",
    "Lasting",
    "add_births",
    "always",
    "checked_lives",
    "life_rates",
    "lives_of",
]

BIRTHS = "births"
"""Name of the rows' tensor that says when a Gaussian is where its mean is; it is not fitted."""

MOST_BORN = 0.5
"""Share of the Gaussians that there may be: how many are born at most."""

_OPACITY = 0.3  # at birth
_FAINT = 0.1  # opacity below which a Gaussian gives way to one that is born
_WIDTH = 2.0  # times between photographs that a life begins with as its width
_BRIEF = 0.4  # the same, of what other times do not confirm
_CONFIRMED = 0.4  # part of the photographs of other times that must agree
_GAP = 0.75  # the same, of a longer time without photographs beside it
_CENTER_RATE = 0.02  # learning rate of a life's center, in times between photographs
_WIDTH_RATE = 0.01  # of the logarithm of its width


def lives_of(tensors: Mapping[str, torch.Tensor]) -> Lives | None:
    """When Gaussians live, of the tensors of their rows; None where all are always there."""
    if BIRTHS not in tensors:
        return None
    return Lives.of(tensors, tensors[BIRTHS].detach())  # births are constants


def checked_lives(tensors: Mapping[str, torch.Tensor], count: int, where: str) -> Lives | None:
    """`lives_of` of a checkpoint.

    Args:
        tensors: Its contents.
        count: How many Gaussians it has.
        where: It, for messages.
    Raises:
        ValueError: If a tensor is missing, not finite, or not of as many Gaussians.
    """
    held = {name.removeprefix("parameter."): x for name, x in tensors.items() if name.startswith("parameter.")}
    names = (*LIVES, BIRTHS)
    if not any(name in held for name in names):
        return None
    for name in names:
        shape = (count, 3) if name in LIVES[2:] else (count,)
        if name not in held or tuple(held[name].shape) != shape or not bool(torch.isfinite(held[name]).all()):
            raise ValueError(
                f"{where}: {name} must be finite and of shape {shape}, is not; restore the file, or fit again in "
                "another folder"
            )
    return lives_of(held)


def life_rates(times: Sequence[float]) -> dict[str, float]:
    """Learning rates of centers and widths; of births, which stay as they are, 0."""
    return {LIVES[0]: _CENTER_RATE * spacing(times), LIVES[1]: _WIDTH_RATE, BIRTHS: 0.0}


def add_births(rows: GaussianRows, found: Births, times: Sequence[float], gate: float, most: int) -> None:
    """Add Gaussians that are there for a time; where there are `most` already, they take the place of the faintest.

    Args:
        rows: Changed in place; get tensors for lives, by which those that are there already are always there.
        found: Places, times and velocities of theirs.
        times: Times of all photographs, sorted.
        gate: Logit of the gates of those that are added.
        most: How many Gaussians there may be.
    """
    count = len(found.points)
    if not count:
        return
    if BIRTHS not in rows.tensors:
        for name, x in _always(len(rows), times).items():
            rows.add_tensor(name, x)
    new = rows.from_points(found.points, found.colors, _OPACITY).take(torch.arange(count))
    new["log_scales"] = found.sizes.log()[:, None].repeat(1, 3)
    new["motion"] = torch.full((count,), gate)
    moments = found.times.float()
    began = (moments, _widths(found, times).log().float(), found.velocities, found.accelerations)
    new |= dict(zip(LIVES, began, strict=True))
    new[BIRTHS] = moments
    for name, x in rows.tensors.items():  # features and view-dependent colors begin at 0
        if name not in new or new[name].shape[1:] != x.shape[1:]:
            new[name] = x.new_zeros(count, *x.shape[1:])
    # What hardly shows gives way. (A choice, which has no gradient.)
    faint = (rows.tensors["logit_opacities"].detach().sigmoid() < _FAINT).nonzero()[:, 0]
    room = max(0, min(count, most - len(rows)))
    taken = faint[: count - room]
    rows.overwrite(taken, {name: x[room : room + len(taken)] for name, x in new.items()})
    rows.append({name: x[:room] for name, x in new.items()})


def always(count: int, rows: GaussianRows, times: Sequence[float]) -> dict[str, torch.Tensor]:
    """Lives of Gaussians that are always there; nothing where there are no lives."""
    return _always(count, times) if BIRTHS in rows.tensors else {}


def _always(count: int, times: Sequence[float]) -> dict[str, torch.Tensor]:
    width = torch.tensor(2 * LASTING * (times[-1] - times[0]))
    still = torch.zeros(count, 3)
    values = (torch.full((count,), (times[0] + times[-1]) / 2), width.log().repeat(count), still, still)
    return {**dict(zip(LIVES, values, strict=True)), BIRTHS: torch.zeros(count)}


def _widths(found: Births, times: Sequence[float]) -> torch.Tensor:
    """(M,) standard deviations in time that lives begin with.

    What other times have not confirmed is there at its own; else a time without photographs is to be bridged.
    """
    known = torch.tensor(times, dtype=torch.float64)
    at = (known[None] - found.times.double()[:, None]).abs().argmin(1)
    apart = torch.cat([torch.zeros(1, dtype=torch.float64), known.diff(), torch.zeros(1, dtype=torch.float64)])
    gap = torch.maximum(apart[at], apart[at + 1])
    step = torch.full_like(gap, spacing(times))
    long = torch.maximum(_WIDTH * step, _GAP * gap)
    return torch.where(found.lasting > _CONFIRMED, long, _BRIEF * step)


@dataclasses.dataclass(frozen=True, eq=False)
class Lasting:
    """What keeps lives long: the mean over Gaussians of the time between photographs over the width of a life, where
    that is below 1.
    """

    rows: GaussianRows
    spacing: float
    weight: float
    name: ClassVar[str] = "lives"
    outputs: ClassVar[tuple[str, ...]] = ()

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`; None where all Gaussians are always there."""
        if BIRTHS not in self.rows.tensors:
            return None
        parts = self.spacing * (-self.rows.tensors[LIVES[1]]).exp()
        # Which are long enough to be lengthened is a choice, which has no derivative.
        return self.weight * torch.where(parts.detach() < 1, parts, 0).mean()
