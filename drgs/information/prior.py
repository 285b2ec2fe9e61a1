"""How precisely parameters are known before any view; imports nothing heavy, as `drgs.information.scoring`."""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

from drgs.checks.records import option

if TYPE_CHECKING:
    import torch

__all__ = ["Prior"]


@dataclasses.dataclass(frozen=True)
class Prior:
    """lambda: how precisely each parameter is known before any view, added to H once.

    A relative one makes `eig` and `logdet` independent of the unit of a group. A group that no view sees has no median:
    its lambda is 0.

    Raises:
        ValueError: If a lambda is negative, infinite or NaN.
    """

    value: float = option(
        1e-6,
        "Prior information about every parameter (lambda): 1e-2 with v_opt, 1 in drgs fisher, else 1e-6. With 0, "
        "parameters that no training view sees are left out of every score.",
        flag="prior",
        shown="",
    )
    relative: bool = option(
        False,
        "lambda is its value (--prior) times the median of the nonzero information of a parameter's group.",
        rare=True,
        flag="relative_prior",
    )
    groups: Mapping[str, float] = option(
        {}, "Group -> lambda in place of `value`.", name="prior_groups", file_only=True
    )
    heading: ClassVar[str] = "Views"

    def __post_init__(self) -> None:
        for name, value in (("value", self.value), *self.groups.items()):
            if not (isinstance(value, numbers.Real) and 0 <= value < math.inf):
                raise ValueError(f"Prior: lambda ({name}) must be in [0, inf), got {value!r}; try 1e-6")
        if not isinstance(self.value, (int, float)):  # NumPy's, which no file holds
            object.__setattr__(self, "value", float(self.value))

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
