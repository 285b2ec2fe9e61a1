"""Unknowns of a photograph besides the scene (exposure, pose), as one frozen record; imports nothing heavy."""

from __future__ import annotations

import dataclasses
import numbers
import typing
from collections.abc import Sequence
from typing import ClassVar, Literal

from drgs.checks.records import Record, option

Nuisance = Literal["exposure", "pose"]
"""Unknowns of a photograph: three log gains of its channels, and the six numbers of its camera's pose."""

NUISANCES: tuple[Nuisance, ...] = typing.get_args(Nuisance)

_STD_RANGE = (1e-9, 1e9)  # allowed prior standard deviations: their squares and inverses are far inside float64


@dataclasses.dataclass(frozen=True, kw_only=True)
class Nuisances(Record):
    """Unknowns of a view that are eliminated from its information, and how well they are known before it is seen.

    A view that shows only its own exposure has no information about the scene. `drgs.information.elimination` has the
    equations.

    Raises:
        ValueError: If a name is unknown, or a standard deviation is out of range.
    """

    eliminate: tuple[Nuisance, ...] | None = option(
        None,
        "Unknowns of each view to marginalize in its information: exposure (three log gains), pose; none; default"
        " those that the fit estimated.",
        rare=True,
        commas=True,
        none="none",
        metavar="UNKNOWN,UNKNOWN|none",
    )
    exposure_std: float | None = option(
        None, "Prior standard deviation of a log gain of a view; default unknown.", rare=True
    )
    pose_std: tuple[float, float] | None = option(
        None,
        "Prior standard deviations of a camera's rotation about its center (radians) and of its center (world "
        "units); default unknown.",
        rare=True,
    )
    where: ClassVar[str] = "nuisances"
    heading: ClassVar[str] = "Views"

    def __post_init__(self) -> None:
        if self.eliminate is not None:
            known = ", ".join(NUISANCES)
            if not isinstance(self.eliminate, tuple | list):
                raise ValueError(f"nuisances: eliminate must be a tuple of {known}, got {self.eliminate!r}; correct it")
            for name in self.eliminate:
                if name not in NUISANCES:
                    raise ValueError(f"nuisances: eliminate must be among {known}, or none, got {name!r}; correct it")
            object.__setattr__(self, "eliminate", tuple(name for name in NUISANCES if name in self.eliminate))
        if self.exposure_std is not None:
            self._check("exposure_std", self.exposure_std)
        if self.pose_std is not None:
            if not isinstance(self.pose_std, tuple | list) or len(self.pose_std) != 2:
                raise ValueError(
                    f"nuisances: pose_std must be two numbers, radians and world units, got {self.pose_std!r}; e.g. "
                    "(0.001, 0.01)"
                )
            for value in self.pose_std:
                self._check("pose_std", value)
            object.__setattr__(self, "pose_std", tuple(self.pose_std))  # part of a key of the cache

    @staticmethod
    def _check(name: str, value: object) -> None:
        low, high = _STD_RANGE
        if isinstance(value, bool) or not (isinstance(value, numbers.Real) and low <= float(value) <= high):
            raise ValueError(
                f"nuisances: {name} must be within {low:g} and {high:g}, got {value!r}; leave it out where nothing is "
                "known"
            )

    @property
    def names(self) -> tuple[Nuisance, ...]:
        """Those that are eliminated."""
        return self.eliminate or ()

    def if_any(self) -> dict[str, dict]:
        """As files hold them, under their name; nothing where none are eliminated."""
        return {"nuisances": self.to_json()} if self.names else {}

    def over(self, fitted: Sequence[Nuisance]) -> Nuisances:
        """With those that a fit has estimated, unless these say themselves which."""
        return self if self.eliminate is not None else self.replace(eliminate=tuple(fitted))


NO_NUISANCES = Nuisances(eliminate=())
