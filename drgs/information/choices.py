"""Names of policies, criteria, methods, blocks and estimates; loads nothing heavy: the command line reads them here.

What stands behind a name is imported when it is first looked up. Rows that other packages add are found by entry points
(`drgs.checks.registry`), and have no part in what is the default.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Sequence
from typing import Any, Literal

from drgs.checks.registry import Registry
from drgs.information.criteria import criterion_named

Criterion = Literal["v_opt", "eig", "logdet", "trace_cov", "block_logdet"]
"""The names of `drgs.information.criteria` that are this package's; views are chosen by the first by default."""

CRITERION_NAMES: tuple[Criterion, ...] = typing.get_args(Criterion)

Policy = Literal["fisher", "fisherrf", "coverage", "moments", "blur", "renderers", "farthest", "uniform", "random"]
"""The names of `POLICIES` that are this package's."""

POLICY_NAMES: tuple[Policy, ...] = typing.get_args(Policy)

POLICIES: Registry[Callable[[Any], Any]] = Registry(
    "policy",
    "drgs.policies",
    {
        "fisher": "drgs.selection.informed:fisher",
        "fisherrf": "drgs.selection.informed:fisherrf",
        "coverage": "drgs.selection.informed:coverage",
        "moments": "drgs.selection.pictures:moments",
        "blur": "drgs.selection.pictures:blur",
        "renderers": "drgs.selection.pictures:renderers",
        "farthest": "drgs.selection.spread:farthest",
        "uniform": "drgs.selection.spread:uniform",
        "random": "drgs.selection.spread:random",
    },
)
"""Name -> policy, a function `drgs.select.Pool` -> `drgs.select.Selection`."""


def check_named(where: str, registry: Registry, name: object) -> None:
    """Raise ValueError if a name is no row's and does not look like `package.module:function`.

    It imports nothing, so that names from files can be checked by it, too.
    """
    if not isinstance(name, str) or (name not in registry and ":" not in name):
        raise ValueError(
            f"{where}: {registry.kind} must be one of {', '.join(registry)}, or package.module:function, got {name!r}; "
            "choose one"
        )


Method = Literal["exact", "columns", "probes", "fisherrf"]
"""How `drgs.fisher.diagonal` computes; the first is the default everywhere."""

METHODS: tuple[Method, ...] = typing.get_args(Method)

Block = Literal["geometry", "semantic", "deformation", "backdrop"]
"""Parts of an image with the parameters that they inform about: colors and features about the Gaussians, the image
about the network that moves them, and opacity about what stands behind them, where they leave a pixel open."""

BLOCK_NAMES: tuple[Block, ...] = typing.get_args(Block)
"""In the order in which results name them. Where no blocks are named, these count, as far as the scene has them."""

BLOCKS: Registry[Any] = Registry(
    "block",
    "drgs.blocks",
    {
        "geometry": "drgs.information.blocks:GEOMETRY_BLOCK",
        "semantic": "drgs.information.blocks:SEMANTIC_BLOCK",
        "deformation": "drgs.information.blocks:DEFORMATION_BLOCK",
        "backdrop": "drgs.information.blocks:BACKDROP_BLOCK",
    },
)
"""Name -> `drgs.information.blocks.ImageBlock`."""


def checked_blocks(where: str, names: Sequence[str], method: str) -> tuple[Block, ...]:
    """The blocks that are named, each once and in their order.

    Raises:
        ValueError: If one is unknown, or the method does not know it, or none is named.
    """
    known = ", ".join(BLOCKS)
    if not isinstance(names, tuple | list) or not names:
        raise ValueError(f"{where}: blocks must be a tuple of one or more of {known}, got {names!r}; correct it")
    for name in names:
        if name not in BLOCKS:
            raise ValueError(f"{where}: blocks must be among {known}, got {name!r}; correct it")
    other = [name for name in BLOCKS if name in names and name != BLOCK_NAMES[0]]
    if method == "fisherrf" and other:
        raise ValueError(f"{where}: blocks must be geometry with method fisherrf, got {other[0]}; use method exact")
    return tuple(name for name in BLOCKS if name in names)  # type: ignore[misc]  # one of another package is no `Block`


GAUSSIAN_GROUPS = ("means", "rotations", "log_scales", "logit_opacities", "sh", "features")
"""The names of `drgs.information.groups.GROUPS`."""

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
    others = [name for name in blocks or () if name not in ("geometry", "semantic")]
    # A function of one's own, which is not imported here, is of a diagonal.
    if others and ":" not in criterion and criterion_named(criterion, where).of_blocks:
        raise ValueError(
            f"{where}: blocks must be geometry or semantic with criterion {criterion}, got {others[0]}; only "
            "Gaussians have blocks of their own, use eig"
        )
    beside = blocks is None or ("deformation" in blocks and len(blocks) > 1)
    if network != NETWORK_SCORES[0] and combine == "sum" and beside:
        raise ValueError(
            f"{where}: combine must be zscore with network {network} beside other blocks, got sum; a trace has another "
            "unit than their ratios"
        )
