"""How a view is scored, as one frozen record; imports nothing heavy, for the options of the command line read it."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

from drgs.checks.arguments import kind_of, must_be
from drgs.checks.records import TRANSIENT, Record, one_of, option, part
from drgs.information.choices import (
    BLOCK_NAMES,
    BLOCKS,
    COMBINES,
    CRITERION_NAMES,
    METHODS,
    NETWORK_SCORES,
    Block,
    Combine,
    Method,
    NetworkScore,
    check_combined,
    check_named,
    checked_blocks,
)
from drgs.information.criteria import CRITERIA, criterion_named
from drgs.information.nuisances import Nuisance, Nuisances
from drgs.information.prior import Prior
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.information.semantics import SemanticMetric

_EXACT = RenderSettings.preset("exact")  # made once: every record of options has a `Scoring`


@dataclasses.dataclass(frozen=True)
class Scoring(Record):
    """How views are scored: which blocks of information are computed, by which criterion, prior and weights.

    `prior`: None is 1e-2 of criterion `v_opt`, for colors that are known to 0.3 beforehand and photographs to 0.03;
    else 1e-6, as in FisherRF. Policy `coverage` takes its `value`, not its `groups`.

    `blocks`: `geometry` is what the colors of an image say about all but the features; `semantic`, what its decoded
    features say about the features and, coupled, about the geometry; `deformation`, what both say, as far as the
    other two blocks are named, else the colors, about the network that moves the Gaussians, groups `grid` and `mlp`;
    `backdrop`, what its opacity says about what is behind all Gaussians. None is all that the scene has (method
    `fisherrf` knows colors of Gaussians only, `block_logdet` these and features).

    `network`: `ratio` scores the diagonal of the block `deformation` by `criterion` against that of the known views,
    like all other groups; `trace` and `paper` go by what a candidate says itself, whatever is known.

    `combine`: `sum` adds up all groups' parts. With `zscore` each block alone is scored by its own information, less
    the mean and divided by the standard deviation of the candidates (one that is the same for all counts 0), and these
    are added up. None is `sum`, but `zscore` where a trace stands beside another block, for their units differ.

    Criterion, method, groups and blocks are of policy `fisher`, method and groups not of `block_logdet`; weights are of
    `fisher` and `fisherrf`. Groups of a scene's network need method `columns` or `probes`.

    Attributes:
        settings: What `drgs.render` computes of a view.
        semantics: Metric of the block semantic; None: that of features as they are stored, all channels alike.
    Raises:
        ValueError: If a criterion, method or block is unknown, blocks cannot be combined so, or something else is of
            the wrong kind.
    """

    criterion: str = option(
        CRITERION_NAMES[0],
        "Score of policy fisher, or package.module:function of your own; v_opt chooses best from six views on "
        "(docs/next-views.md).",
        metavar=one_of(CRITERION_NAMES),
    )
    settings: RenderSettings = dataclasses.field(default=_EXACT, metadata=TRANSIENT)
    method: Method = option(
        METHODS[0],
        "How information is computed: exactly (columns: slower), by random probes, or as FisherRF's code does.",
    )
    prior: Prior | None = part(None)
    weights: Mapping[str, float] = option(
        {}, "Group -> factor of its part of the score; 1 where none is given.", file_only=True
    )
    groups: tuple[str, ...] | None = option(
        None,
        "Groups of the parameters that count, as `drgs.fisher.diagonal` takes them; None: all that there are.",
        file_only=True,
    )
    blocks: tuple[Block, ...] | None = option(
        None,
        "Outputs of a view that count: geometry (colors), semantic (features), deformation (motion), backdrop "
        "(where no Gaussian is).",
        commas=True,
        metavar="BLOCK,BLOCK",
    )
    semantics: SemanticMetric | None = dataclasses.field(default=None, metadata=TRANSIENT)
    network: NetworkScore = option(
        NETWORK_SCORES[0],
        "Score of block deformation: relative to the information of the training views (ratio), or without it "
        "(trace, paper).",
        rare=True,
    )
    combine: Combine | None = option(
        None,
        "Add the scores of several blocks (sum), or their z-scores over the candidates (zscore); default sum, "
        "with --network trace or paper zscore.",
        rare=True,
    )
    probes: int = option(
        16, "Number of random probes of each view, for block deformation and for --method probes.", rare=True
    )
    nuisances: Nuisances = part(Nuisances())
    where: ClassVar[str] = "select"
    heading: ClassVar[str] = "Views"

    def __post_init__(self) -> None:
        check_named("select", CRITERIA, self.criterion)
        choices: dict[str, tuple[str, ...]] = {"method": METHODS, "network": NETWORK_SCORES}
        for name, known in (choices | ({} if self.combine is None else {"combine": COMBINES})).items():
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"select: {name} must be one of {', '.join(known)}, got {value!r}; choose one")
        must_be("select", "settings", self.settings, RenderSettings, 'drgs.RenderSettings.preset("exact") makes them')
        if self.prior is not None:
            must_be("select", "prior", self.prior, Prior, "e.g. drgs.gain.Prior(1e-6)")
        must_be("select", "weights", self.weights, Mapping, 'e.g. {"means": 0.5}')
        for group, weight in self.weights.items():
            must_be("select", f"weights of {group}", weight, numbers.Real, 'e.g. {"means": 0.5}')
        if self.groups is not None:
            must_be("select", "groups", self.groups, (tuple, list), 'e.g. ("means", "sh")')
            if odd := [group for group in self.groups if not isinstance(group, str)]:
                raise ValueError(f"select: groups must be names of groups, got {kind_of(odd[0])}; correct it")
            object.__setattr__(self, "groups", tuple(self.groups))  # part of a key of the cache
        if self.blocks is not None:
            object.__setattr__(self, "blocks", checked_blocks("select", self.blocks, self.method))
        check_combined("select", self.blocks, self.criterion, self.network, self.combine)
        if not (isinstance(self.probes, int) and self.probes >= 1):
            raise ValueError(f"select: probes must be a whole number >= 1, got {self.probes!r}; try 16")
        must_be("select", "nuisances", self.nuisances, Nuisances, 'e.g. Nuisances(eliminate=("exposure",))')
        if self.nuisances.names and self.method == "fisherrf":
            raise ValueError(
                "select: eliminate must be none with method fisherrf, got "
                f"{', '.join(self.nuisances.names)}; use method exact"
            )
        if self.semantics is not None:
            from drgs.information.semantics import SemanticMetric  # with torch, which an option list does not need

            must_be("select", "semantics", self.semantics, SemanticMetric, "e.g. SemanticMetric(decoder.metric())")

    def over(self, estimated: Sequence[Nuisance]) -> Scoring:
        """With the unknowns of photographs that a fit has estimated eliminated, unless it says itself which are.

        FisherRF's code knows none: with its method it is as it was.
        """
        if self.method == "fisherrf":
            return self
        return dataclasses.replace(self, nuisances=self.nuisances.over(estimated))

    def blocks_of(self, gaussians: Gaussians, where: str = "select", scene: Scene | None = None) -> tuple[Block, ...]:
        """The blocks that are scored of a scene.

        Args:
            gaussians: The Gaussians at some time of it.
            where: What an error begins with.
            scene: The scene; None: it is these Gaussians, which do not move.
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
