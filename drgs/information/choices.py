"""What views can be judged and chosen by, by name; imports nothing, for the options of the command line read it."""

from __future__ import annotations

import typing
from typing import Literal

__all__ = ["METHODS", "Block", "Criterion", "Estimate", "Method", "Policy"]

Criterion = Literal["eig", "logdet", "trace_cov", "block_logdet"]
"""The names in `drgs.gain.CRITERIA`, where the functions are; the first is the default everywhere."""

Policy = Literal["fisher", "fisherrf", "coverage", "moments", "farthest", "uniform", "random"]
"""The names in `drgs.select.POLICIES`, where the functions are."""

Method = Literal["exact", "columns", "probes", "fisherrf"]
"""How `drgs.fisher.diagonal` computes; the first is the default everywhere."""

METHODS: tuple[Method, ...] = typing.get_args(Method)

Block = Literal["geometry", "semantic"]
"""Parts of an image that can tell about a scene: its colors, and its features."""

Estimate = Literal["collapsed", "exact"]
"""How `drgs.fisher.SemanticMetric` sums over the channels of decoded features; the first is the default everywhere."""
