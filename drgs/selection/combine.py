"""How scores of several blocks become one.

Diagonals of blocks (`drgs.information.blocks`) are ratios in a score, without a unit, and add up; those of colors and
features about the same parameters even before they are divided by what is known. A trace has a unit, and no divisor:
beside it every block is scored alone, by information of its own, whose groups are named `block.group` then, and its
scores are compared with those of the other candidates before they are added up (z-scores).
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping, Sequence

import torch

from drgs.information.blocks import SceneBlocks
from drgs.information.criteria import criterion_named
from drgs.information.gains import Gain, scorer
from drgs.information.prior import Prior
from drgs.information.quantity import Joint
from drgs.information.scoring import Scoring
from drgs.information.sums import Information

_CONSTANT_BELOW = 1e-6  # relative standard deviation below which a block's scores are the same but for float32 images


@dataclasses.dataclass(frozen=True)
class Combination:
    """How the information of a view becomes one score.

    Attributes:
        scoring: The scoring that has criterion, lambda and weights.
        zscored: The blocks that are scored alone, each with groups of its name; empty: all groups are scored together.
        trace_block: The block that is a trace, scored without what is known; "" for none.
    """

    scoring: Scoring
    zscored: tuple[str, ...] = ()
    trace_block: str = ""

    def with_prior(self, prior: Prior) -> Combination:
        """With this prior."""
        return dataclasses.replace(self, scoring=dataclasses.replace(self.scoring, prior=prior))

    @property
    def pooled(self) -> bool:
        """Whether scores need the information of all views together, known ones and candidates."""
        needed = criterion_named(self.scoring.criterion, "select").needs_pool
        return needed and (bool(self.zscored) or not self.trace_block)

    def scorer(
        self, H: Information, pool: Information | None = None, shares: Information | None = None
    ) -> Callable[[Information], Gain]:
        """Gains of candidates against H, that of the known views.

        Args:
            H: Group -> tensor.
            pool: The information of all views together, where scores are `pooled`.
            shares: Factors of what each parameter adds, as `drgs.information.gains.scorer` takes them; None: 1.
        Raises:
            ValueError: If the prior or weights name a group that there is not.
        """
        scoring = self.scoring
        if not self.zscored:
            if self.trace_block:
                return _Trace(scoring.weights, shares)
            return scorer(H, scoring.criterion, scoring.prior_of(), scoring.weights, pool, shares)
        known = {name.partition(".")[2] for name in H}
        lambdas = scoring.prior_of()
        for what, names in (("Prior: groups", lambdas.groups), ("information_gain: weights", scoring.weights)):
            for name in names:
                if name not in known:
                    raise ValueError(f"{what} must be of {', '.join(sorted(known))}, got {name!r}; correct or drop it")
        by_block: dict[str, Callable[[Information], Gain]] = {}
        for block in self.zscored:
            own = _own(H, block)
            weights = {name: x for name, x in scoring.weights.items() if name in own}
            theirs = {name: x for name, x in lambdas.groups.items() if name in own}
            prior = dataclasses.replace(lambdas, groups=theirs)
            its_shares = None if shares is None else _own(shares, block)
            if block == self.trace_block:
                by_block[block] = _Trace(weights, its_shares)
            else:
                everything = None if pool is None else _own(pool, block)
                by_block[block] = scorer(own, scoring.criterion, prior, weights, everything, its_shares)

        def score(candidate: Information) -> Gain:
            gains = {block: one(_own(candidate, block)) for block, one in by_block.items()}
            merged = lambda field: {  # noqa: E731
                f"{block}.{name}": x for block, gain in gains.items() for name, x in getattr(gain, field).items()
            }
            total = sum(gain.total for gain in gains.values())
            repaired = max(gain.repaired for gain in gains.values())
            return Gain(total, merged("parts"), merged("left_out"), merged("unseen"), repaired)

        return score

    def compared(self, gains: Sequence[Gain]) -> list[Gain]:
        """The gains of all candidates that are left, as they are ranked by: where blocks are scored alone, each block's
        less its mean, over its standard deviation. Parts still add up to the total."""
        if not self.zscored or not gains:
            return list(gains)
        parts: list[dict[str, float]] = [{} for _ in gains]
        unseen: list[dict[str, float]] = [{} for _ in gains]
        for block in self.zscored:
            names = [name for name in gains[0].parts if name.startswith(f"{block}.")]
            scores = [math.fsum(gain.parts[name] for name in names) for gain in gains]
            mean, spread = statistics.fmean(scores), statistics.pstdev(scores)
            # A block that is the same for all ranks none above another.
            factor = 1 / spread if spread > _CONSTANT_BELOW * abs(mean) else 0.0
            for name in names:
                middle = statistics.fmean(gain.parts[name] for gain in gains)
                for i, gain in enumerate(gains):
                    parts[i][name] = (gain.parts[name] - middle) * factor
                    unseen[i][name] = gain.unseen.get(name, 0.0) * factor
        return [
            dataclasses.replace(gain, total=math.fsum(own.values()), parts=own, unseen=rest)
            for gain, own, rest in zip(gains, parts, unseen, strict=True)
        ]

    @property
    def scores_fall(self) -> bool:
        """Whether a candidate's score can only fall when more is known, as greedy choice may make use of.

        A trace stays as it is; z-scores rise as those of other candidates fall.
        """
        fall = criterion_named(self.scoring.criterion, "select").scores_fall
        return not self.zscored and (bool(self.trace_block) or fall)


class _Trace:
    """Scores of candidates by their own information alone: it is a trace already."""

    def __init__(self, weights: Mapping[str, float], shares: Information | None = None) -> None:
        self.weights = dict(weights)
        self.shares = shares

    def __call__(self, candidate: Information) -> Gain:
        """The gain of one candidate."""
        if unknown := [name for name in self.weights if name not in candidate]:
            known = ", ".join(candidate)
            raise ValueError(f"information_gain: weights must be of {known}, got {unknown[0]!r}; drop it")
        counted = {name: x.double() if self.shares is None else x * self.shares[name] for name, x in candidate.items()}
        parts = {name: self.weights.get(name, 1.0) * float(x.sum()) for name, x in counted.items()}
        return Gain(math.fsum(parts.values()), parts, {}, dict.fromkeys(parts, 0.0))


def _own(information: Information, block: str) -> dict[str, torch.Tensor]:
    """The groups of a block, by their own names."""
    prefix = f"{block}."
    return {name.removeprefix(prefix): x for name, x in information.items() if name.startswith(prefix)}


def joint_and_combination(blocks: SceneBlocks) -> tuple[Joint, Combination]:
    """The quantity of a view that blocks are together, and how views are scored by it.

    Args:
        blocks: The blocks of the scene that count, at least one.
    Raises:
        ValueError: If the scoring names groups that are of no block, or blocks that cannot be combined.
    """
    scoring = blocks.scoring
    blocks.check_groups()
    zscored = blocks.names if scoring.combined_of(blocks.names) == "zscore" else ()
    together: list[Sequence[str]] = [[block] for block in zscored] or [blocks.names]
    parts = [(name if zscored else "", quantity) for some in together for name, quantity in blocks.quantities(some)]
    if not parts:
        raise ValueError(
            f"select: groups must have one that blocks {', '.join(blocks.names)} have information about, got "
            f"{', '.join(scoring.groups or ()) or 'none'}; add the other block, or another group"
        )
    traced = [name for name, quantity in blocks.quantities(blocks.names) if not quantity.needs_known_views]
    scored = tuple(block for block in zscored if any(name == block for name, _ in parts))
    return Joint(tuple(parts)), Combination(scoring, scored, *traced[:1])
