"""How precisely parameters are known before any view; imports nothing heavy, as `drgs.information.scoring`."""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

__all__ = ["Prior"]


@dataclasses.dataclass(frozen=True)
class Prior:
    """lambda: how precisely each parameter is known before any view, added to H once.

    A relative one makes `eig` and `logdet` independent of the unit of a group. A group that no view sees has no median:
    its lambda is 0.

    Attributes:
        value: lambda of every group, >= 0. With 0, parameters that no training view sees are left out of every score.
        relative: lambda is its value (--prior) times the median of the nonzero information of a parameter's group.
        groups: Group -> lambda in place of `value`.
    Raises:
        ValueError: If a lambda is negative, infinite or NaN.
    """

    value: float = 1e-6
    relative: bool = False
    groups: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, value in (("value", self.value), *self.groups.items()):
            if not (isinstance(value, numbers.Real) and 0 <= value < math.inf):
                raise ValueError(f"Prior: lambda ({name}) must be in [0, inf), got {value!r}; try 1e-6")
        if not isinstance(self.value, (int, float)):  # NumPy's, which no file holds
            object.__setattr__(self, "value", float(self.value))

    @classmethod
    def given(cls, value: float | None, relative: bool) -> Prior | None:
        """As options name it; None where they leave it to the criterion."""
        if value is None:
            return cls(relative=True) if relative else None
        return cls(value, relative)

    def to_json(self) -> dict:
        """As files hold it."""
        return {"value": self.value, "relative": self.relative}

    def per_group(self, train: Mapping[str, torch.Tensor]) -> dict[str, float]:
        """lambda of every group of H.

        Raises:
            ValueError: If `groups` names one that H does not have.
        """
        for name in self.groups:
            if name not in train:
                raise ValueError(f"Prior: groups must be among {', '.join(train)}, got {name!r}; correct or drop it")
        values = {name: float(self.groups.get(name, self.value)) for name in train}
        if self.relative:
            for name, H in train.items():
                positive = H[H > 0]
                values[name] *= float(positive.median()) if positive.numel() else 0.0
        return values
