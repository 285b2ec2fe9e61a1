"""What views can be judged and chosen by, by name; imports nothing, for the options of the command line read it."""

from __future__ import annotations

import typing
from typing import Literal

__all__ = ["METHODS", "Criterion", "Method", "Policy"]

Criterion = Literal["eig", "logdet", "trace_cov", "block_logdet"]
"""The names in `drgs.gain.CRITERIA`, where the functions are; the first is the default everywhere."""

Policy = Literal["fisher", "fisherrf", "coverage", "farthest", "uniform", "random"]
"""The names in `drgs.select.POLICIES`, where the functions are."""

Method = Literal["exact", "columns", "probes", "fisherrf"]
"""How `drgs.fisher.diagonal` computes; the first is the default everywhere."""

METHODS: tuple[Method, ...] = typing.get_args(Method)
