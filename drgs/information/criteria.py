"""Criteria: the score that a parameter adds to a view, and the inputs that a score needs.

Imports nothing heavy, for the options of the command line read the names; `drgs.gain` computes by the functions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

from drgs.checks.registry import Registry

if TYPE_CHECKING:
    import torch


@dataclasses.dataclass(frozen=True)
class ViewCriterion:
    """How the information of a view becomes a score.

    Symbols as in `drgs.gain`: H is the information of the known views, Hc that of a candidate, P that of all views
    together, l the prior precision lambda.

    Attributes:
        term: (ratio, variance) -> what each parameter adds to the score, of ratio = Hc / (H + l), which it may
            overwrite, and variance = 1 / (H + l); all float64, one entry a parameter, and 0 where the ratio is 0. None
            with `of_blocks`.
        needs_pool: Whether `variance` is P / (H + l), for which P must be known.
        scores_fall: Whether no score rises as H grows. Greedy choice then scores only what could still win; where it
            is wrongly said, picks may be wrong.
        of_blocks: Whether it is of one dense block a Gaussian, `drgs.fisher.blocks`, instead of a diagonal.
        prior: lambda where none is given.
    """

    term: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] | None
    needs_pool: bool = False
    scores_fall: bool = False
    of_blocks: bool = False
    prior: float = 1e-6


def _variance_drop(ratio: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    # 1/a - 1/(a + c) = (1/a) r / (1 + r), r = c/a: no difference of nearly equal numbers; r = inf gives NaN.
    return ratio.div_(ratio + 1).mul_(variance)


def _ratio(ratio: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    return ratio


def _log_ratio(ratio: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    return ratio.log1p_()


CRITERIA: Registry[ViewCriterion] = Registry(
    "criterion",
    "drgs.criteria",
    {
        # 1e-2: the variance of a photograph's noise, 0.03^2, over that of a color beforehand, 0.3^2.
        "v_opt": ViewCriterion(_variance_drop, needs_pool=True, scores_fall=True, prior=1e-2),
        "eig": ViewCriterion(_ratio, scores_fall=True),
        "logdet": ViewCriterion(_log_ratio, scores_fall=True),
        "trace_cov": ViewCriterion(_variance_drop, scores_fall=True),
        "block_logdet": ViewCriterion(None, scores_fall=True, of_blocks=True),
    },
)
"""Name -> criterion; `drgs.select` chooses by the first by default. A plain function is taken as the `term`
of a criterion of which nothing else is known."""


def criterion_named(name: str, where: str = "criterion") -> ViewCriterion:
    """The criterion of a name, or of the function that `package.module:function` names.

    Args:
        name: A name in `CRITERIA`, or `package.module:function`. Never one that a file holds: importing runs the
            module.
        where: What an error begins with.
    Raises:
        ValueError: If there is none.
    """
    criterion = CRITERIA.find(where, name)
    return criterion if isinstance(criterion, ViewCriterion) else ViewCriterion(criterion)
