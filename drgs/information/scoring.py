"""How a view is scored, as one frozen record; imports nothing heavy, for the options of the command line read it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

from drgs.guards.arguments import must_be
from drgs.information.choices import (
    BLOCK_NAMES,
    BLOCKS,
    COMBINES,
    CRITERION_NAMES,
    METHODS,
    NETWORK_SCORES,
    Block,
    Combine,
    Criterion,
    Method,
    NetworkScore,
    check_combined,
    check_named,
    checked_blocks,
)
from drgs.information.criteria import CRITERIA, criterion_named
from drgs.information.prior import Prior
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.information.semantics import SemanticMetric

__all__ = ["Scoring"]


@dataclasses.dataclass(frozen=True)
class Scoring:
    """How much a view counts: what is computed of it, and how that becomes a number.

    Attributes:
        criterion: One of `drgs.gain.CRITERIA`; of policy `fisher` only.
        settings: Of the renderer.
        method: Of `drgs.fisher.diagonal`; of `fisher` only, not of `block_logdet`.
        prior: lambda. `coverage` takes its `value`, not its `groups`. None: 1e-2 of criterion `v_opt`, for colors that
            are known to 0.3 beforehand and photographs to 0.03; else 1e-6, as in FisherRF.
        weights: Group -> factor, 1 where none is given; of `fisher` and `fisherrf` only.
        groups: Of the parameters that count, as `drgs.fisher.diagonal` takes them; None: all that Gaussians have. Of
            `fisher` only, not of `block_logdet`. Those of a scene's network need method `columns` or `probes`.
        blocks: What of an image tells about what: `geometry`, its colors, about all but the features; `semantic`, its
            decoded features, about the features and, coupled, about the geometry; `deformation`, both as far as the
            other two blocks are named, else its colors, about the network that moves the Gaussians, groups `grid` and
            `mlp`; `backdrop`, its opacity, about what is behind all Gaussians. None: all that the scene has (method
            `fisherrf` knows colors of Gaussians only, `block_logdet` these and features). Of `fisher` only.
        semantics: The metric of the block `semantic`; None: that of features as they are stored, all channels alike.
        network: How the block `deformation` scores: `ratio`, its diagonal by `criterion` against that of the known
            views, like all other groups; `trace` and `paper`, by what a candidate says itself, whatever is known.
        combine: How scores of several blocks become one: `sum`, of all groups' parts; `zscore`, each block alone is
            scored by its own information, less the mean and divided by the standard deviation of the candidates (one
            that is the same for all counts 0), and these are added up. None: `sum`, but `zscore` where a trace stands
            beside another block, for their units differ.
        probes: Random images, or tangents, of each view: of the block `deformation`, and of method `probes`.
    Raises:
        ValueError: If a criterion, method or block is unknown, blocks cannot be combined so, or something else is of
            the wrong kind.
    """

    criterion: Criterion | str = CRITERION_NAMES[0]
    settings: RenderSettings = dataclasses.field(default_factory=lambda: RenderSettings.preset("exact"))
    method: Method = METHODS[0]
    prior: Prior | None = None
    weights: Mapping[str, float] = dataclasses.field(default_factory=dict)
    groups: tuple[str, ...] | None = None
    blocks: tuple[Block, ...] | None = None
    semantics: SemanticMetric | None = None
    network: NetworkScore = NETWORK_SCORES[0]
    combine: Combine | None = None
    probes: int = 16

    def __post_init__(self) -> None:
        check_named("select", CRITERIA, self.criterion)
        choices: dict[str, tuple[str, ...]] = {
            "method": METHODS,
            "network": NETWORK_SCORES,
        }
        for name, known in (choices | ({} if self.combine is None else {"combine": COMBINES})).items():
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"select: {name} must be one of {', '.join(known)}, got {value!r}; choose one")
        must_be("select", "settings", self.settings, RenderSettings, 'drgs.RenderSettings.preset("exact") makes them')
        if self.prior is not None:
            must_be("select", "prior", self.prior, Prior, "e.g. drgs.gain.Prior(1e-6)")
        must_be("select", "weights", self.weights, Mapping, 'e.g. {"means": 0.5}')
        if self.groups is not None:
            must_be("select", "groups", self.groups, (tuple, list), 'e.g. ("means", "sh")')
            object.__setattr__(self, "groups", tuple(self.groups))  # part of a key of the cache
        if self.blocks is not None:
            object.__setattr__(self, "blocks", checked_blocks("select", self.blocks, self.method))
        check_combined("select", self.blocks, self.criterion, self.network, self.combine)
        if not (isinstance(self.probes, int) and self.probes >= 1):
            raise ValueError(f"select: probes must be a whole number >= 1, got {self.probes!r}; try 16")
        if self.semantics is not None:
            from drgs.information.semantics import SemanticMetric  # with torch, which an option list does not need

            must_be("select", "semantics", self.semantics, SemanticMetric, "e.g. SemanticMetric(decoder.metric())")

    def blocks_of(self, gaussians: Gaussians, where: str = "select", scene: Scene | None = None) -> tuple[Block, ...]:
        """The blocks that are scored of a scene.

        Args:
            gaussians: As they are at some time of it.
            where: For messages.
            scene: Itself; None: it is these Gaussians, which do not move.
        Raises:
            ValueError: If one is wanted that the scene does not have.
        """
        missing = {block: BLOCKS[block].lack(gaussians, scene) for block in self.blocks or BLOCK_NAMES}
        if self.blocks is None:
            if self.method == "fisherrf":
                return ("geometry",)
            if criterion_named(self.criterion, "select").of_blocks:  # which only Gaussians have
                return ("geometry", *(("semantic",) if not missing["semantic"] else ()))
            return tuple(block for block in BLOCK_NAMES if not missing.get(block))
        for block in self.blocks:
            if missing.get(block):
                raise ValueError(
                    f"{where}: blocks must be of what the scene has, got {block} {missing[block]}, or use geometry"
                )
        return self.blocks

    def prior_of(self, policy: str = "fisher") -> Prior:
        """lambda of a policy by this scoring."""
        if self.prior is not None:
            return self.prior
        return Prior(criterion_named(self.criterion, "select").prior) if policy == "fisher" else Prior()

    def combined_of(self, blocks: tuple[Block, ...]) -> Combine:
        """How the scores of these blocks become one."""
        traced = "deformation" in blocks and self.network != "ratio"
        return "sum" if len(blocks) < 2 else self.combine or ("zscore" if traced else "sum")
