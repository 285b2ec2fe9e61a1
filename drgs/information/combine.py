"""How scores of several blocks become one, and what is asked of a view for each.

A block is a part of an image with the parameters that it tells about (`choices.Block`). Their diagonals are ratios,
without a unit, and add up: what colors and features say about the same parameters even before it is divided by what is
known. A trace has a unit, and no divisor: beside it every block is scored alone, by information of its own, whose
groups are named `block.group` then, and its scores are compared with those of the other candidates before they are
added up (z-scores).
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from drgs.gain import Gain, Information, scorer
from drgs.information.backdrop import opacity_of, painted_opacity
from drgs.information.network_groups import NETWORK_GROUPS

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene
    from drgs.information.backdrop import Sphere
    from drgs.information.choices import Block
    from drgs.information.scoring import Scoring
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings

__all__ = ["Asked", "Combination", "Questions", "asked_of"]

_SAME = 1e-6  # relative standard deviation below which a block's scores are the same but for float32 images


@dataclasses.dataclass(frozen=True)
class Asked:
    """One function of `drgs.fisher` that a view is asked by.

    Attributes:
        function: Its name; where it returns one tensor, that is a group of the same name.
        without: Groups of what it returns that do not count.
        options: Of the function, besides scene, camera and settings.
        block: What names of groups begin with; "" where all are scored together.
        groups: Of those of a network, the ones that count; None: all.
        known: Whether views that are known are asked, too: a trace has no use for what they say.
    """

    function: str
    without: tuple[str, ...] = ()
    options: tuple[tuple[str, Hashable], ...] = ()
    block: str = ""
    groups: tuple[str, ...] | None = None
    known: bool = True

    def __call__(
        self,
        scene: Scene,
        camera: Camera,
        settings: RenderSettings,
        mask: torch.Tensor | None = None,
        opacity: list[torch.Tensor] | None = None,
    ) -> Information:
        """What one view says.

        `opacity` gets the view's, where it is found on the way, and is where it is looked for.
        """
        from drgs import fisher  # loads Dr.Jit, which policies that ask nothing need not have

        options: dict[str, Any] = dict(self.options)
        # `diagonal` also knows the parameters that a scene computes its Gaussians from, but no closed form for them.
        own = self.function == "diagonal" and (options.get("groups") is None or options["method"] in _OF_SCENES)
        if self.function == "diagonal" and options.get("method") == "exact":
            options["seen_opacity"] = opacity
        elif self.function == "backdrop" and opacity:
            options["seen_opacity"] = opacity[:1]
        with torch.no_grad():  # information is a number
            seen = scene if own or self.function == "network" else scene.at(camera.time)
            if mask is not None:
                options["masks"] = [mask]
            found = getattr(fisher, self.function)(seen, camera, settings, **options)
        if isinstance(found, torch.Tensor):
            found = {self.function: found}
        wanted = {name: x for name, x in found.items() if name not in self.without}
        if self.groups is not None:
            wanted = {name: x for name, x in wanted.items() if name in self.groups}
        return {f"{self.block}.{name}" if self.block else name: x for name, x in wanted.items()}


_OF_SCENES = ("columns", "probes")
_OPACITY = "opacity"  # the name under which a view's opacity travels as an Information


@dataclasses.dataclass(frozen=True)
class Questions:
    """All that a view is asked, as data, which other processes can be sent.

    Attributes:
        settings: Of the renderer.
        asked: In the order of asking.
        empty_outside: Whether it is known that nothing is outside of masks, so that the view has shown it.
        is_painted: Whether what is told about the backdrop is about the cells of its sphere; else it is the view's
            opacity, by which this is known wherever the sphere is (`painted`).
    """

    settings: RenderSettings
    asked: tuple[Asked, ...]
    empty_outside: bool = False
    is_painted: bool = True

    def __call__(self, scene: Scene, camera: Camera, mask: torch.Tensor | None) -> Information:
        """What one view says, in float32, as it is kept."""
        found: dict[str, torch.Tensor] = {}
        opacity: list[torch.Tensor] = []
        for one in self.asked:
            if one.function != "backdrop":
                found |= one(scene, camera, self.settings, mask, opacity)
            elif self.is_painted:
                found |= one(scene, camera, self.settings, None if self.empty_outside else mask, opacity)
            else:
                found[_OPACITY] = opacity[0] if opacity else opacity_of(scene, camera, self.settings)
        return {name: x.to(torch.float32) for name, x in found.items()}

    def lasting(self) -> Questions:
        """Questions whose answers depend on a view alone, not on the others of its pool, around which the sphere is."""
        asked = tuple(dataclasses.replace(one, options=()) if one.function == "backdrop" else one for one in self.asked)
        return Questions(self.settings, asked, is_painted=False)

    def painted(self, answer: Information, camera: Camera, mask: torch.Tensor | None) -> Information:
        """What a view says to these questions, of its answer to the `lasting` ones: the same bits."""
        found = dict(answer)
        if (opacity := found.pop(_OPACITY, None)) is None:
            return found
        one = next(one for one in self.asked if one.function == "backdrop")
        options: dict[str, Any] = dict(one.options)
        sphere = options["sphere"]
        mask = None if self.empty_outside else mask
        told = painted_opacity(opacity, camera, (1.0, 1.0, 1.0), mask, sphere)
        found[f"{one.block}.backdrop" if one.block else "backdrop"] = told.to(torch.float32)
        return found


@dataclasses.dataclass(frozen=True)
class Combination:
    """How one score is made of what a view says.

    Attributes:
        scoring: Its criterion, lambda and weights.
        apart: The blocks that are scored alone, each with groups of its name; empty: all groups are scored together.
        traced: Of these, the block that is a trace, scored without what is known; "" for none.
    """

    scoring: Scoring
    apart: tuple[str, ...] = ()
    traced: str = ""

    @property
    def pooled(self) -> bool:
        """Whether scores ask for the information of all views together, known ones and candidates."""
        return self.scoring.criterion == "v_opt" and (bool(self.apart) or not self.traced)

    def scorer(self, H: Information, pool: Information | None = None) -> Callable[[Information], Gain]:
        """Gains of candidates against H, that of the known views.

        Args:
            H: Group -> tensor.
            pool: Of all views together, where scores are `pooled`.
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
        """Whether a candidate's score can only fall when more is known, as greedy choice may make use of."""
        return not self.apart


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


def asked_of(
    scoring: Scoring, blocks: tuple[Block, ...], metric: SemanticMetric | None, sphere: Sphere | None = None
) -> tuple[list[Asked], Combination]:
    """What views are asked, and how they are scored by it.

    Args:
        scoring: As `drgs.select` takes it.
        blocks: `scoring.blocks_of` the scene, at least one.
        metric: Of the block `semantic`.
        sphere: Of the block `backdrop`.
    Raises:
        ValueError: If `scoring` names groups that no block tells about, or blocks that cannot be combined.
    """
    combined = scoring.combined_of(blocks)
    network = [name for name in scoring.groups or () if name in NETWORK_GROUPS]
    if "backdrop" in (scoring.groups or ()) and "backdrop" not in blocks:
        raise ValueError(
            f"select: groups must be of blocks {', '.join(blocks)}, got backdrop; add its block or drop it"
        )
    theirs = None if scoring.groups is None else tuple(x for x in scoring.groups if x not in (*network, "backdrop"))
    traced = "deformation" if "deformation" in blocks and scoring.network != "ratio" else ""
    apart = blocks if combined == "zscore" else ()
    parts: list[Sequence[str]] = [[block] for block in apart] or [blocks]
    made = [_of_gaussians(scoring, part, metric, theirs, bool(apart)) for part in parts]
    if "deformation" in blocks and (scoring.groups is None or network):
        rows = _rows(tuple(x for x in blocks if x in ("geometry", "semantic")), metric)
        estimate = "diagonal" if scoring.network == "ratio" else scoring.network
        options = {"estimate": estimate, "probes": scoring.probes, **rows}
        name = "deformation" if apart else ""
        made.append(Asked("network", (), tuple(sorted(options.items())), name, tuple(network) or None, not traced))
    if "backdrop" in blocks and (scoring.groups is None or "backdrop" in scoring.groups):
        made.append(Asked("backdrop", options=(("sphere", sphere),), block="backdrop" if apart else ""))
    asked = [one for one in made if one is not None]
    if not asked:
        raise ValueError(
            f"select: groups must have one that blocks {', '.join(blocks)} tell about, got "
            f"{', '.join(scoring.groups or ()) or 'none'}; add the other block, or another group"
        )
    if apart:
        apart = tuple(block for block in apart if any(one.block == block for one in asked))
    return asked, Combination(scoring, apart, traced)


def _of_gaussians(
    scoring: Scoring,
    blocks: Sequence[str],
    metric: SemanticMetric | None,
    groups: tuple[str, ...] | None,
    apart: bool,
) -> Asked | None:
    """What these blocks ask about Gaussians, together; None if that is nothing."""
    blocks = tuple(x for x in blocks if x in ("geometry", "semantic"))
    without: tuple[str, ...] = () if "semantic" in blocks else ("features",)
    if "semantic" in blocks and "geometry" not in blocks:
        without = ("sh",)
    if not blocks or (groups is not None and set(groups) <= set(without)):
        return None
    name = blocks[0] if apart else ""
    rows = _rows(blocks, metric)
    if scoring.criterion == "block_logdet":
        return Asked("blocks", (), tuple(sorted(rows.items())), name)
    options: dict[str, Hashable] = {"method": scoring.method, "groups": groups, **rows}
    if scoring.method == "probes":
        options["probes"] = scoring.probes
    return Asked("diagonal", without, tuple(sorted(options.items())), name)


def _rows(blocks: tuple[str, ...], metric: SemanticMetric | None) -> dict[str, Hashable]:
    """Options that say which rows of the image count; none where colors are all there is."""
    rows: dict[str, Hashable] = {"semantics": metric} if "semantic" in blocks else {}
    if blocks and "geometry" not in blocks:
        rows["channel_weights"] = (0.0, 0.0, 0.0)
    return rows
