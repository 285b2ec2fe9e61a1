"""How scores of several blocks become one, and all that a view is asked for them.

Diagonals of blocks (`drgs.information.blocks`) are ratios in a score, without a unit, and add up: what colors and
features say about the same parameters even before it is divided by what is known. A trace has a unit, and no divisor:
beside it every block is scored alone, by information of its own, whose groups are named `block.group` then, and its
scores are compared with those of the other candidates before they are added up (z-scores).
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import torch

from drgs.information.blocks import BlockQuestion, SceneBlocks
from drgs.information.criteria import criterion_named
from drgs.information.gains import Gain, scorer
from drgs.information.once_per_time import once_per_time
from drgs.information.seen_view import SeenView
from drgs.information.sums import Information

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene
    from drgs.information.scoring import Scoring
    from drgs.settings import RenderSettings

__all__ = ["Asked", "Combination", "Questions", "asked_of"]

_SAME = 1e-6  # relative standard deviation below which a block's scores are the same but for float32 images


@dataclasses.dataclass(frozen=True)
class Asked:
    """One question to a view, and how its answer is named.

    Attributes:
        question: What is asked.
        block: The block that names of groups begin with; "" where all blocks are scored together.
    """

    question: BlockQuestion
    block: str = ""

    def named(self, information: Information) -> dict[str, torch.Tensor]:
        """Information by the names that scores know it by."""
        return {f"{self.block}.{name}" if self.block else name: x for name, x in information.items()}


@dataclasses.dataclass(frozen=True)
class Questions:
    """All that a view is asked, as data, which other processes can be sent.

    Attributes:
        settings: Settings of the renderer.
        asked: The questions in the order of asking: what one finds out on its way, those after it make use of.
    """

    settings: RenderSettings
    asked: tuple[Asked, ...]

    def __call__(self, scene: Scene, camera: Camera, mask: torch.Tensor | None) -> Information:
        """What one view says, in float32, as it is kept: half the memory, of sums that are of float32 images."""
        found: dict[str, torch.Tensor] = {}
        view = SeenView(once_per_time(scene), camera, self.settings, mask)
        with torch.no_grad():  # information is a number
            if len(self.asked) > 1:  # else nobody walks along the view for another one
                beside = {one.question: one.question.beside(view) for one in self.asked}
                view.beside = {question: sums for question, sums in beside.items() if sums}
            for one in self.asked:
                found |= one.named(one.question.information(view))
        return {name: x.to(torch.float32) for name, x in found.items()}

    def lasting(self) -> Questions:
        """Questions whose answers depend on a view alone, not on the others of its pool."""
        return Questions(self.settings, tuple(Asked(one.question.lasting(), one.block) for one in self.asked))

    def finished(self, answer: Information, camera: Camera, mask: torch.Tensor | None) -> Information:
        """What a view says to these questions, of its answer to the `lasting` ones: the same bits."""
        found = dict(answer)
        for one in self.asked:
            # Where all blocks are scored together, a question gets the whole answer, and returns it.
            own = _own(found, one.block) if one.block else found
            rest = {name: x for name, x in found.items() if name not in one.named(own)}
            found = rest | one.named(one.question.finished(own, camera, mask))
        return {name: x.to(torch.float32) for name, x in found.items()}


@dataclasses.dataclass(frozen=True)
class Combination:
    """How one score is made of what a view says.

    Attributes:
        scoring: The scoring that has criterion, lambda and weights.
        apart: The blocks that are scored alone, each with groups of its name; empty: all groups are scored together.
        traced: The block that is a trace, scored without what is known; "" for none.
    """

    scoring: Scoring
    apart: tuple[str, ...] = ()
    traced: str = ""

    @property
    def pooled(self) -> bool:
        """Whether scores ask for the information of all views together, known ones and candidates."""
        needed = criterion_named(self.scoring.criterion, "select").needs_pool
        return needed and (bool(self.apart) or not self.traced)

    def scorer(self, H: Information, pool: Information | None = None) -> Callable[[Information], Gain]:
        """Gains of candidates against H, that of the known views.

        Args:
            H: Group -> tensor.
            pool: The information of all views together, where scores are `pooled`.
        Raises:
            ValueError: If the prior or weights name a group that there is not.
        """
        scoring = self.scoring
        if not self.apart:
            if self.traced:
                return _Trace(scoring.weights)
            return scorer(H, scoring.criterion, scoring.prior_of(), scoring.weights, pool)
        known = {name.partition(".")[2] for name in H}
        lambdas = scoring.prior_of()
        for what, names in (("Prior: groups", lambdas.groups), ("information_gain: weights", scoring.weights)):
            for name in names:
                if name not in known:
                    raise ValueError(f"{what} must be of {', '.join(sorted(known))}, got {name!r}; correct or drop it")
        by_block: dict[str, Callable[[Information], Gain]] = {}
        for block in self.apart:
            own = _own(H, block)
            weights = {name: x for name, x in scoring.weights.items() if name in own}
            theirs = {name: x for name, x in lambdas.groups.items() if name in own}
            prior = dataclasses.replace(lambdas, groups=theirs)
            if block == self.traced:
                by_block[block] = _Trace(weights)
            else:
                everything = None if pool is None else _own(pool, block)
                by_block[block] = scorer(own, scoring.criterion, prior, weights, everything)

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
        if not self.apart or not gains:
            return list(gains)
        parts: list[dict[str, float]] = [{} for _ in gains]
        unseen: list[dict[str, float]] = [{} for _ in gains]
        for block in self.apart:
            names = [name for name in gains[0].parts if name.startswith(f"{block}.")]
            scores = [math.fsum(gain.parts[name] for name in names) for gain in gains]
            mean, spread = statistics.fmean(scores), statistics.pstdev(scores)
            # A block that is the same for all tells none from another.
            factor = 1 / spread if spread > _SAME * abs(mean) else 0.0
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
    def falls(self) -> bool:
        """Whether a candidate's score can only fall when more is known, as greedy choice may make use of.

        A trace stays as it is; z-scores rise as those of other candidates fall.
        """
        return not self.apart and (bool(self.traced) or criterion_named(self.scoring.criterion, "select").scores_fall)


class _Trace:
    """Scores of candidates by their own information alone: it is a trace already."""

    def __init__(self, weights: Mapping[str, float]) -> None:
        self.weights = dict(weights)

    def __call__(self, candidate: Information) -> Gain:
        """The gain of one candidate."""
        if unknown := [name for name in self.weights if name not in candidate]:
            known = ", ".join(candidate)
            raise ValueError(f"information_gain: weights must be of {known}, got {unknown[0]!r}; drop it")
        parts = {name: self.weights.get(name, 1.0) * float(x.double().sum()) for name, x in candidate.items()}
        return Gain(math.fsum(parts.values()), parts, {}, dict.fromkeys(parts, 0.0))


def _own(information: Information, block: str) -> dict[str, torch.Tensor]:
    """The groups of a block, by their own names."""
    prefix = f"{block}."
    return {name.removeprefix(prefix): x for name, x in information.items() if name.startswith(prefix)}


def asked_of(of: SceneBlocks) -> tuple[list[Asked], Combination]:
    """What views are asked, and how they are scored by it.

    Args:
        of: The blocks of the scene that count, at least one.
    Raises:
        ValueError: If the scoring names groups that no block tells about, or blocks that cannot be combined.
    """
    scoring = of.scoring
    of.check_groups()
    apart = of.names if scoring.combined_of(of.names) == "zscore" else ()
    parts: list[Sequence[str]] = [[block] for block in apart] or [of.names]
    asked = [Asked(question, name if apart else "") for part in parts for name, question in of.questions(part)]
    if not asked:
        raise ValueError(
            f"select: groups must have one that blocks {', '.join(of.names)} tell about, got "
            f"{', '.join(scoring.groups or ()) or 'none'}; add the other block, or another group"
        )
    traced = [name for name, question in of.questions(of.names) if not question.asks_known]
    told = tuple(block for block in apart if any(one.block == block for one in asked))
    return asked, Combination(scoring, told, *traced[:1])
