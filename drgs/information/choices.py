"""What views can be judged and chosen by, by name; imports nothing, for the options of the command line read it."""

from __future__ import annotations

import typing
from collections.abc import Sequence
from typing import Literal

__all__ = [
    "BLOCK_NAMES",
    "COMBINES",
    "ESTIMATES",
    "METHODS",
    "NETWORK_SCORES",
    "NETWORK_ESTIMATES",
    "Block",
    "Combine",
    "CRITERION_NAMES",
    "Criterion",
    "Estimate",
    "Method",
    "NetworkScore",
    "NetworkEstimate",
    "POLICY_NAMES",
    "Policy",
    "check_combined",
    "checked_blocks",
]

Criterion = Literal["v_opt", "eig", "logdet", "trace_cov", "block_logdet"]
"""The names in `drgs.gain.CRITERIA`, where the functions are; views are chosen by the first unless told otherwise."""

CRITERION_NAMES: tuple[Criterion, ...] = typing.get_args(Criterion)

Policy = Literal["fisher", "fisherrf", "coverage", "moments", "farthest", "uniform", "random"]
"""The names in `drgs.select.POLICIES`, where the functions are."""

POLICY_NAMES: tuple[Policy, ...] = typing.get_args(Policy)

Method = Literal["exact", "columns", "probes", "fisherrf"]
"""How `drgs.fisher.diagonal` computes; the first is the default everywhere."""

METHODS: tuple[Method, ...] = typing.get_args(Method)

Block = Literal["geometry", "semantic", "deformation", "backdrop"]
"""What is asked of a view: what its colors and its features tell about the Gaussians, what the image tells about the
network that moves them, and about what stands behind them, where they leave a pixel open."""

BLOCK_NAMES: tuple[Block, ...] = typing.get_args(Block)
"""In the order in which results name them."""


def checked_blocks(where: str, names: Sequence[str], method: str) -> tuple[Block, ...]:
    """The blocks that are named, each once and in their order.

    Raises:
        ValueError: If one is unknown, or the method does not know it, or none is named.
    """
    known = ", ".join(BLOCK_NAMES)
    if not isinstance(names, tuple | list) or not names:
        raise ValueError(f"{where}: blocks must be a tuple of one or more of {known}, got {names!r}; correct it")
    for name in names:
        if name not in BLOCK_NAMES:
            raise ValueError(f"{where}: blocks must be among {known}, got {name!r}; correct it")
    other = [name for name in BLOCK_NAMES[1:] if name in names]
    if method == "fisherrf" and other:
        raise ValueError(f"{where}: blocks must be geometry with method fisherrf, got {other[0]}; use method exact")
    return tuple(name for name in BLOCK_NAMES if name in names)


Estimate = Literal["principal", "collapsed", "exact"]
"""How `drgs.fisher.SemanticMetric` sums over the channels of decoded features; the first is the default everywhere."""

ESTIMATES: tuple[Estimate, ...] = typing.get_args(Estimate)

NetworkEstimate = Literal["diagonal", "trace", "paper"]
"""What `drgs.fisher.network` estimates of H, a network's information; the first is the default everywhere."""

NETWORK_ESTIMATES: tuple[NetworkEstimate, ...] = typing.get_args(NetworkEstimate)

NetworkScore = Literal["ratio", "trace", "paper"]
"""How the block `deformation` scores: as the diagonal does against that of the known views, by the trace of the
candidate's own information, or by the trace of its square; the first is the default everywhere."""

NETWORK_SCORES: tuple[NetworkScore, ...] = typing.get_args(NetworkScore)

Combine = Literal["sum", "zscore"]
"""How the scores of several blocks become one."""

COMBINES: tuple[Combine, ...] = typing.get_args(Combine)


def check_combined(where: str, blocks: Sequence[str] | None, criterion: str, network: str, combine: str | None) -> None:
    """Raise ValueError if these blocks (None: all there are) cannot be scored so, or not together."""
    others = [name for name in ("deformation", "backdrop") if name in (blocks or ())]
    if others and criterion == "block_logdet":
        raise ValueError(
            f"{where}: blocks must be geometry or semantic with criterion block_logdet, got {others[0]}; only "
            "Gaussians have blocks of their own, use eig"
        )
    beside = blocks is None or ("deformation" in blocks and len(blocks) > 1)
    if network != NETWORK_SCORES[0] and combine == "sum" and beside:
        raise ValueError(
            f"{where}: combine must be zscore with network {network} beside other blocks, got sum; a trace has another "
            "unit than their ratios"
        )
