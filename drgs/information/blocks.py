"""The blocks of an image: what a view is asked for each, which map of a view it makes, and how answers add up.

A block is a part of an image with the parameters that it tells about. Each is one `ImageBlock` in the table
`drgs.information.choices.BLOCKS`, of which everything else that asks views is made: the scores of candidates
(combine.py), `drgs fisher`, the maps of a report and of `drgs view`.

    geometry      colors, about all parameters of Gaussians but the features
    semantic      decoded features, about the features and, coupled, about the geometry
    deformation   both, as far as the other two blocks count, else colors, about the network that moves the Gaussians
    backdrop      opacity, about the color behind all Gaussians

Information of different views, and of different blocks of one view, adds up (`add`): their noise is independent.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from drgs.information.backdrop import BACKDROP, backdrop_sphere, painted_opacity
from drgs.information.choices import BLOCKS
from drgs.information.criteria import criterion_named
from drgs.information.network_groups import NETWORK_GROUPS, network_groups
from drgs.information.nuisances import Nuisances
from drgs.information.prior import Prior
from drgs.information.scoring import Scoring
from drgs.information.seen_view import SeenView
from drgs.information.semantics import SemanticMetric

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.information.backdrop import Sphere
    from drgs.information.choices import Block, NetworkEstimate
    from drgs.information.network import NetworkProbes
    from drgs.information.sums import Information

__all__ = [
    "BACKDROP_BLOCK",
    "DEFORMATION_BLOCK",
    "GEOMETRY_BLOCK",
    "MAP_PRIOR",
    "SEMANTIC_BLOCK",
    "TAKEN",
    "BlockQuestion",
    "CoverageQuestion",
    "DiagonalQuestion",
    "ImageBlock",
    "SceneBlocks",
]

MAP_PRIOR = Prior(1.0)
"""lambda with which a map of the variance follows the error best, of 1e-6, 1e-2 and 1 (docs/active-static.md)."""

_GAUSSIAN_GROUPS = ("means", "rotations", "log_scales", "logit_opacities", "sh", "features")
_WITH_SCENES = ("columns", "probes")  # methods that know the parameters that a scene computes its Gaussians from
_OPACITY = "opacity"  # the name under which a view's opacity travels as an Information
TAKEN = "taken"
"""The name under which what a view's unknowns take of the backdrop travels with it: directions, of either sign."""

_NO_NUISANCES = Nuisances()

Answers = Callable[[Callable, Sequence["Camera"]], Iterable["Information"]]
"""Asks views one question, as `drgs.selection.pool.Pool.answers`."""


# -------------------------------------------------- what a view is asked


class BlockQuestion:
    """What a view is asked for one block, or for several together.

    Frozen dataclasses inherit from it, of plain data: they are parts of a cache's keys, and other processes are sent
    them.

    Attributes:
        asks_known: Whether known views are asked, too; a trace has no use for what they say.
    """

    asks_known: bool = True

    def beside(self, view: SeenView) -> NetworkProbes | None:
        """What a traversal of the view for another question may sum up for this one; None: nothing."""
        return None

    def information(self, view: SeenView) -> Information:
        """What the view says: group -> tensor."""
        raise NotImplementedError(f"blocks: {type(self).__name__} must have a method `information`, has none; add it")

    def variance_map(self, view: SeenView, weights: Information) -> torch.Tensor:
        """(H, W) float32: sum over rows of a pixel and parameters k of J_pk^2 weights_k."""
        raise NotImplementedError(f"blocks: {type(self).__name__} must have a method `variance_map`, has none; add it")

    def lasting(self) -> BlockQuestion:
        """The question whose answer depends on the view alone, not on other views of its pool; caches keep answers to
        that."""
        return self

    def finished(self, answer: Information, camera: Camera, mask: torch.Tensor | None) -> Information:
        """The information of the view, made of its answer to the lasting question: the same bits."""
        return answer


@dataclasses.dataclass(frozen=True)
class DiagonalQuestion(BlockQuestion):
    """`drgs.fisher.diagonal` of a view.

    Attributes:
        method: How it is computed.
        groups: Groups that are wanted; None: all that Gaussians have.
        without: Groups of the answer that do not count.
        probes: Random images of method `probes`.
        channel_weights: Inverse noise variances of R, G and B; 0 where colors are no part of the blocks.
        semantics: The metric in which features tell about the geometry; None where they are no part of the blocks.
        nuisances: Unknowns of the view that are eliminated.
    """

    method: str = "exact"
    groups: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    probes: int = 16
    channel_weights: tuple[float, float, float] = (1.0, 1.0, 1.0)
    semantics: SemanticMetric | None = None
    nuisances: Nuisances = _NO_NUISANCES

    def information(self, view: SeenView) -> Information:
        """Squares of the derivatives, and the opacity on the way."""
        from drgs.information.diagonal import diagonal_and_opacity  # loads Dr.Jit, which poses alone need not have

        # A scene's own parameters have no closed form: of other methods, names are those of its Gaussians.
        of_scene = self.groups is None or self.method in _WITH_SCENES
        found, opacities = diagonal_and_opacity(
            view.scene if of_scene else view.gaussians,
            view.camera,
            view.settings,
            self.method,
            groups=self.groups,
            channel_weights=self.channel_weights,
            probes=self.probes,
            semantics=self.semantics,
            masks=view.masks,
            nuisances=self.nuisances,
            beside=[one.sums for one in view.beside.values() if one.semantics is self.semantics],
        )
        if opacities and view.opacity is None:
            view.opacity = opacities[0]
        return {name: x for name, x in found.items() if name not in self.without}

    def variance_map(self, view: SeenView, weights: Information) -> torch.Tensor:
        """`drgs.fisher.variance_map` of the same rows."""
        from drgs import fisher

        return fisher.variance_map(
            view.scene, view.camera, weights, view.settings, self.channel_weights, semantics=self.semantics
        )


@dataclasses.dataclass(frozen=True)
class DenseBlocksQuestion(BlockQuestion):
    """`drgs.fisher.blocks` of a view.

    Attributes:
        channel_weights, semantics, nuisances: The same as of a `DiagonalQuestion`.
    """

    channel_weights: tuple[float, float, float] = (1.0, 1.0, 1.0)
    semantics: SemanticMetric | None = None
    nuisances: Nuisances = _NO_NUISANCES

    def information(self, view: SeenView) -> Information:
        """One dense block a Gaussian."""
        from drgs import fisher
        from drgs.information.gains import DENSE

        found = fisher.blocks(
            view.gaussians,
            view.camera,
            view.settings,
            self.channel_weights,
            self.semantics,
            view.masks,
            self.nuisances,
        )
        return {DENSE: found}


@dataclasses.dataclass(frozen=True)
class NetworkQuestion(BlockQuestion):
    """`drgs.fisher.network` of a view.

    Attributes:
        estimate: What is estimated of H.
        probes: Random images, or tangents.
        groups: Groups of the network that count; None: all.
        channel_weights, semantics, nuisances: The same as of a `DiagonalQuestion`.
    """

    estimate: NetworkEstimate = "diagonal"
    probes: int = 16
    groups: tuple[str, ...] | None = None
    channel_weights: tuple[float, float, float] = (1.0, 1.0, 1.0)
    semantics: SemanticMetric | None = None
    nuisances: Nuisances = _NO_NUISANCES

    @property
    def asks_known(self) -> bool:  # type: ignore[override]
        """A trace is scored without what is known."""
        return self.estimate == "diagonal"

    def beside(self, view: SeenView) -> NetworkProbes | None:
        """The sums of hits along the probes."""
        from drgs.information.network import NetworkProbes  # loads Dr.Jit, which poses alone need not have

        if self.estimate != "diagonal":
            return None
        return NetworkProbes.of(
            view.scene,
            view.camera,
            view.settings,
            mask=view.mask,
            nuisances=self.nuisances,
            **self._rows,
        )

    def information(self, view: SeenView) -> Information:
        """The network's information, by random probes."""
        from drgs import fisher

        if probes := view.beside.get(self):
            found = probes.information()
        else:
            found = fisher.network(
                view.scene,
                view.camera,
                view.settings,
                estimate=self.estimate,
                masks=view.masks,
                nuisances=self.nuisances,
                **self._rows,
            )
        return {name: x for name, x in found.items() if self.groups is None or name in self.groups}

    def variance_map(self, view: SeenView, weights: Information) -> torch.Tensor:
        """`drgs.fisher.network_variance_map` of the same rows."""
        from drgs import fisher

        return fisher.network_variance_map(view.scene, view.camera, weights, view.settings, **self._rows)

    @property
    def _rows(self) -> dict[str, Any]:
        """Which rows of an image are asked, and along how many random images."""
        return {"probes": self.probes, "channel_weights": self.channel_weights, "semantics": self.semantics}


@dataclasses.dataclass(frozen=True)
class BackdropQuestion(BlockQuestion):
    """`drgs.fisher.backdrop` of a view: about the cells of a sphere, or the opacity that this is made of.

    Attributes:
        sphere: The sphere; None: infinitely far away.
        empty_outside: Whether it is known that nothing is outside of masks, so that the view has shown it.
        is_painted: Whether the answer is about the sphere. Else it is the view's opacity, which does not depend on
            the other views of the pool, around which the sphere is, with what its unknowns take where any are
            eliminated.
        semantics, nuisances: The same as of a `DiagonalQuestion`.
    """

    sphere: Sphere | None = None
    empty_outside: bool = False
    is_painted: bool = True
    semantics: SemanticMetric | None = None
    nuisances: Nuisances = _NO_NUISANCES

    def information(self, view: SeenView) -> Information:
        """(1 - opacity)^2 by cell, or the opacity."""
        from drgs.information.elimination import backdrop_taken  # loads Dr.Jit

        answer = {_OPACITY: view.known_opacity()}
        taken = backdrop_taken(
            view.scene, view.camera, view.settings, (1.0, 1.0, 1.0), self.semantics, view.mask, self.nuisances
        )
        if taken is not None:
            answer[TAKEN] = taken.float()  # as a cache keeps it: the same bits with and without
        return self.finished(answer, view.camera, view.mask) if self.is_painted else answer

    def variance_map(self, view: SeenView, weights: Information) -> torch.Tensor:
        """`drgs.fisher.variance_map` of the color behind."""
        from drgs import fisher

        return fisher.variance_map(view.scene, view.camera, weights, view.settings, sphere=self.sphere)

    def lasting(self) -> BlockQuestion:
        """The opacity."""
        return BackdropQuestion(is_painted=False, semantics=self.semantics, nuisances=self.nuisances)

    def finished(self, answer: Information, camera: Camera, mask: torch.Tensor | None) -> Information:
        """Painted on the sphere of this call."""
        found = dict(answer)
        mask = None if self.empty_outside else mask
        opacity, taken = found.pop(_OPACITY), found.pop(TAKEN, None)
        found[BACKDROP] = painted_opacity(opacity, camera, (1.0, 1.0, 1.0), mask, self.sphere, taken)
        return found


@dataclasses.dataclass(frozen=True)
class CoverageQuestion(BlockQuestion):
    """`drgs.fisher.coverage` of a view; of no block, but of policy `coverage`."""

    def information(self, view: SeenView) -> Information:
        """Sums of squared weights."""
        from drgs import fisher

        return {"coverage": fisher.coverage(view.gaussians, view.camera, view.settings, view.masks)}


# -------------------------------------------------- the blocks


@dataclasses.dataclass(frozen=True)
class ImageBlock:
    """One block. Those with the same `question` are asked together, in one traversal, where they are scored together.

    Attributes:
        groups: Groups of parameters that it tells about.
        question: (`SceneBlocks`, names of blocks) -> what a view is asked for these blocks together; None where none of
            the groups that are wanted is theirs.
        lack: (Gaussians at some time, scene or None where it does not move) -> why there is no such block, as the end
            of a sentence; "" where there is one.
        prepare: (`SceneBlocks` so far, Gaussians at some time, cameras, `Answers` or None) -> what its questions need
            that is the same for all views, and may depend on all of them; None: nothing.
    """

    groups: tuple[str, ...]
    question: Callable[[SceneBlocks, tuple[str, ...]], BlockQuestion | None]
    lack: Callable[[Gaussians, Scene | None], str] = lambda gaussians, scene: ""
    prepare: Callable[[SceneBlocks, Gaussians, Sequence[Camera], Answers | None], Hashable] | None = None


@dataclasses.dataclass(frozen=True)
class SceneBlocks:
    """The blocks of images that count for a scene, with what their questions need.

    Attributes:
        scene: The scene that is seen.
        scoring: What counts, and how it is computed.
        names: The blocks, in the order of the table.
        prepared: Block -> what its `prepare` returned.
        empty_outside: Whether it is known that nothing is outside of masks.
    """

    scene: Scene
    scoring: Scoring
    names: tuple[Block, ...]
    prepared: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    empty_outside: bool = False

    @classmethod
    def of(
        cls,
        scene: Scene,
        scoring: Scoring,
        cameras: Sequence[Camera],
        where: str = "select",
        answers: Answers | None = None,
        empty_outside: bool = False,
    ) -> SceneBlocks:
        """The blocks that a scoring names, or all that the scene has.

        Args:
            scene: The scene that is seen.
            scoring: What counts, and how it is computed.
            cameras: All views that will be compared, known ones and others; at least one.
            where: What an error begins with.
            answers: Asks views, in place of one after another here.
            empty_outside: Whether it is known that nothing is outside of masks.
        Raises:
            ValueError: If the scene does not have a block that is named.
        """
        with torch.no_grad():  # only what there is is looked at
            seen = scene.at(cameras[0].time)
        names = scoring.blocks_of(seen, where, scene)
        prepared: dict[str, Any] = {}
        found = cls(scene, scoring, names, prepared, empty_outside)
        for name in names:
            if prepare := BLOCKS[name].prepare:
                prepared[name] = prepare(found, seen, cameras, answers)
        return found

    @property
    def metric(self) -> SemanticMetric | None:
        """The metric in which features count, where they do."""
        return self.prepared.get("semantic")

    def wanted(self, groups: Sequence[str]) -> tuple[str, ...] | None:
        """Those of a block's groups that the scoring wants; None: all, it names none."""
        if self.scoring.groups is None:
            return None
        return tuple(name for name in self.scoring.groups if name in groups)

    def check_groups(self) -> None:
        """Raise ValueError if the scoring wants a group that only a block tells about which does not count."""
        told = {group for name in self.names for group in BLOCKS[name].groups}
        for group in self.scoring.groups or ():
            if group in _other_groups() - told:
                raise ValueError(
                    f"select: groups must be of blocks {', '.join(self.names)}, got {group}; add its block or drop it"
                )

    def questions(self, names: Sequence[str]) -> list[tuple[str, BlockQuestion]]:
        """What a view is asked for some of the blocks together, each question with the first block that asks it."""
        asking: dict[Callable, list[str]] = {}
        for name in names:
            asking.setdefault(BLOCKS[name].question, []).append(name)
        found = [(own[0], question(self, tuple(own))) for question, own in asking.items()]
        return [(name, one) for name, one in found if one is not None]

    def information(self, camera: Camera) -> dict[str, Information]:
        """Block -> what it alone says of a view.

        Each looks at the view anew: what `drgs fisher` writes of the backdrop is of the opacity that is rendered, which
        is up to 6e-6 off the one that a diagonal has found on its way. Unknowns of the view are eliminated from each by
        its own rows: what colors and features tell together, with a pose eliminated from both at once, is more than the
        sum of these.
        """
        with torch.no_grad():  # information is a number
            return {name: one.information(self._view(camera)) for name, one in self._apart()}

    def with_unknowns(self) -> SceneBlocks:
        """The same, but that nothing is eliminated from what views tell."""
        return dataclasses.replace(self, scoring=dataclasses.replace(self.scoring, nuisances=Nuisances(eliminate=())))

    def variance_maps(self, camera: Camera, weights: Information) -> dict[str, torch.Tensor]:
        """Block -> (H, W) float32 map of its rows: sums of J_pk^2 weights_k, see `drgs.fisher.variance_map`.

        Args:
            camera: The view's camera.
            weights: Group -> tensor; each block takes those of its groups.
        """
        with torch.no_grad():  # a map is a number a pixel
            return {
                name: one.variance_map(
                    self._view(camera), {group: x for group, x in weights.items() if group in BLOCKS[name].groups}
                )
                for name, one in self._apart()
            }

    def variance_map(self, camera: Camera, weights: Information) -> torch.Tensor:
        """(H, W) float32 map of all blocks together; see `variance_maps`."""
        return functools.reduce(torch.add, self.variance_maps(camera, weights).values())

    def _apart(self) -> list[tuple[str, BlockQuestion]]:
        """What a view is asked for each block alone."""
        return [found for name in self.names for found in self.questions([name])]

    def _view(self, camera: Camera) -> SeenView:
        return SeenView(self.scene, camera, self.scoring.settings)


def _other_groups() -> set[str]:
    """Groups of parameters that are none of Gaussians, of all blocks there are."""
    return {group for name in BLOCKS for group in BLOCKS[name].groups} - {*_GAUSSIAN_GROUPS}


def _rows(of: SceneBlocks, names: Sequence[str]) -> dict[str, Any]:
    """Which rows of an image count for these blocks: colors where none of them has rows of its own."""
    return {
        "channel_weights": (0.0, 0.0, 0.0) if "geometry" not in names and "semantic" in names else (1.0, 1.0, 1.0),
        "semantics": of.prepared["semantic"] if "semantic" in names else None,
    }


def _of_gaussians(of: SceneBlocks, names: tuple[str, ...]) -> BlockQuestion | None:
    """What colors and features tell about Gaussians."""
    scoring = of.scoring
    told = {group for name in names for group in BLOCKS[name].groups}
    without = tuple(group for group in _GAUSSIAN_GROUPS if group not in told)
    others = _other_groups()
    # Not only `_GAUSSIAN_GROUPS`: a scene's own tensors have names of their own, which some methods know.
    groups = None if scoring.groups is None else tuple(name for name in scoring.groups if name not in others)
    if groups is not None and set(groups) <= {*without}:
        return None
    rows = _rows(of, names)
    rows |= {"nuisances": scoring.nuisances}
    if criterion_named(scoring.criterion).of_blocks:
        return DenseBlocksQuestion(**rows)
    if scoring.method != "probes":
        return DiagonalQuestion(scoring.method, groups, without, **rows)
    return DiagonalQuestion(scoring.method, groups, without, scoring.probes, **rows)


def _of_network(of: SceneBlocks, names: tuple[str, ...]) -> BlockQuestion | None:
    """What the rows of the other blocks tell about the network that moves the Gaussians."""
    groups = of.wanted(DEFORMATION_BLOCK.groups)
    if groups == ():
        return None
    scoring = of.scoring
    estimate: NetworkEstimate = "diagonal" if scoring.network == "ratio" else scoring.network
    return NetworkQuestion(estimate, scoring.probes, groups, **_rows(of, of.names), nuisances=scoring.nuisances)


def _of_backdrop(of: SceneBlocks, names: tuple[str, ...]) -> BlockQuestion | None:
    """What the opacity tells about the color behind everything."""
    if of.wanted(BACKDROP_BLOCK.groups) == ():
        return None
    nuisances = of.scoring.nuisances
    # Features show where the camera stands, too. Without unknowns, questions are alike whatever else counts.
    semantics = of.prepared.get("semantic") if nuisances.names else None
    return BackdropQuestion(of.prepared["backdrop"], of.empty_outside, semantics=semantics, nuisances=nuisances)


def _metric(of: SceneBlocks, seen: Gaussians, cameras: Sequence[Camera], answers: Answers | None) -> SemanticMetric:
    """The metric that the scoring names, else that of features as they are stored, all channels alike."""
    assert seen.features is not None  # else there is no such block
    return of.scoring.semantics or SemanticMetric.of(None, seen.features.shape[1])


GEOMETRY_BLOCK = ImageBlock(tuple(group for group in _GAUSSIAN_GROUPS if group != "features"), _of_gaussians)
SEMANTIC_BLOCK = ImageBlock(
    tuple(group for group in _GAUSSIAN_GROUPS if group != "sh"),
    _of_gaussians,
    lack=lambda gaussians, scene: (
        "for Gaussians without features; fit them to a data set with teacher maps" if gaussians.features is None else ""
    ),
    prepare=_metric,
)
DEFORMATION_BLOCK = ImageBlock(
    tuple(NETWORK_GROUPS),
    _of_network,
    lack=lambda gaussians, scene: "" if scene and network_groups(scene) else "for a scene that no network moves",
)
BACKDROP_BLOCK = ImageBlock(
    (BACKDROP,),
    _of_backdrop,
    prepare=lambda of, seen, cameras, answers: backdrop_sphere(of.scene, cameras, answers),
)
