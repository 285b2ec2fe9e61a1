"""Information of views, and its sums: that of different views, and of different blocks of one, adds up."""

from __future__ import annotations

from collections.abc import Mapping

import torch

Information = Mapping[str, torch.Tensor]
"""Group of parameters -> tensor with one entry a parameter, as `drgs.fisher.diagonal` returns it."""


def add(total: dict[str, torch.Tensor], part: Information) -> None:
    """Add the information of one more view, or one more block, to a sum, group by group.

    Args:
        total: Group -> float64 tensor; changed, groups that are new become its own.
        part: The information that is added.
    Raises:
        ValueError: If a group is of other parameters than in the total.
    """
    for name, x in part.items():
        if name not in total:
            # float64: of thousands of views a float32 sum would lose what the last ones say.
            total[name] = x.to(torch.float64, copy=True)
        elif total[name].shape != x.shape:
            raise ValueError(
                f"information: {name} must be of the same parameters in every view, got shapes "
                f"{tuple(total[name].shape)} and {tuple(x.shape)}; take views of one scene"
            )
        else:
            total[name] += x


def together(by_block: Mapping[str, Information]) -> dict[str, torch.Tensor]:
    """The information of all blocks together, from that of each alone."""
    total: dict[str, torch.Tensor] = {}
    for part in by_block.values():
        add(total, part)
    return total
