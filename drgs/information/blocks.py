"""The blocks of an image, and which quantity of a view each is.

A block is a part of an image with the parameters that it has information about. Each is one `ImageBlock` in the table
`drgs.information.choices.BLOCKS`, by which views are scored (`drgs.selection.combine`), and which `drgs fisher` and the
maps of a report and of `drgs view` are made of.

    geometry      colors, about all parameters of Gaussians but the features
    semantic      decoded features, about the features and, coupled, about the geometry
    deformation   both, as far as the other two blocks count, else colors, about the network that moves the Gaussians
    backdrop      opacity, about the color behind all Gaussians

Information of different views, and of different blocks of one view, adds up (`drgs.information.sums`): their noise is
independent.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians, Scene
from drgs.information.backdrop import BACKDROP, Backdrop, ComputeViews, backdrop_sphere
from drgs.information.choices import BLOCKS, GAUSSIAN_GROUPS, Block, NetworkEstimate
from drgs.information.criteria import criterion_named
from drgs.information.network_groups import NETWORK_GROUPS, network_groups
from drgs.information.nuisances import Nuisances
from drgs.information.prior import Prior
from drgs.information.quantity import Quantity, ViewContext
from drgs.information.scoring import Scoring
from drgs.information.semantics import SemanticMetric
from drgs.information.sums import Information

MAP_PRIOR = Prior(1.0)
"""lambda with which a map of the variance follows the error best, of 1e-6, 1e-2 and 1 (docs/uncertainty.md)."""

_WITH_SCENES = ("columns", "probes")  # methods that know the parameters that a scene computes its Gaussians from


@dataclasses.dataclass(frozen=True)
class ImageBlock:
    """One block. Those with the same `quantity` are computed as one, in one traversal, where they are scored together.

    Attributes:
        groups: Groups of parameters that it has information about.
        quantity: (`SceneBlocks`, names of blocks) -> the quantity of a view that is these blocks together; None where
            none of the groups that are wanted is theirs.
        lack: (Gaussians at some time, scene or None where it does not move) -> why there is no such block, as the end
            of a sentence; "" where there is one.
        prepare: (`SceneBlocks` so far, Gaussians at some time, cameras, `ComputeViews` or None) -> what its quantity
            needs that is the same for all views, and may depend on all of them; None: nothing.
    """

    groups: tuple[str, ...]
    quantity: Callable[[SceneBlocks, tuple[str, ...]], Quantity | None]
    lack: Callable[[Gaussians, Scene | None], str] = lambda gaussians, scene: ""
    prepare: Callable[[SceneBlocks, Gaussians, Sequence[Camera], ComputeViews | None], Hashable] | None = None


@dataclasses.dataclass(frozen=True)
class SceneBlocks:
    """The blocks of images that count for a scene, with what their quantities need.

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
        compute: ComputeViews | None = None,
        empty_outside: bool = False,
    ) -> SceneBlocks:
        """The blocks that a scoring names, or all that the scene has.

        Args:
            scene: The scene that is seen.
            scoring: What counts, and how it is computed.
            cameras: All views that will be compared, known ones and others; at least one.
            where: What an error begins with.
            compute: Computes a quantity of views, in place of one after another here.
            empty_outside: Whether it is known that nothing is outside of masks.
        Raises:
            ValueError: If the scene does not have a block that is named.
        """
        with torch.no_grad():  # only the names of the Gaussians' fields are read
            seen = scene.at(cameras[0].time)
        names = scoring.blocks_of(seen, where, scene)
        prepared: dict[str, Any] = {}
        blocks = cls(scene, scoring, names, prepared, empty_outside)
        for name in names:
            if prepare := BLOCKS[name].prepare:
                prepared[name] = prepare(blocks, seen, cameras, compute)
        return blocks

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
        """Raise ValueError if the scoring wants a group of a block that does not count."""
        known = {group for name in self.names for group in BLOCKS[name].groups}
        for group in self.scoring.groups or ():
            if group in _other_groups() - known:
                raise ValueError(
                    f"select: groups must be of blocks {', '.join(self.names)}, got {group}; add its block or drop it"
                )

    def quantities(self, names: Sequence[str]) -> list[tuple[str, Quantity]]:
        """The quantities of a view that some of the blocks are together, each with its first block."""
        together: dict[Callable, list[str]] = {}
        for name in names:
            together.setdefault(BLOCKS[name].quantity, []).append(name)
        quantities = [(own[0], quantity(self, tuple(own))) for quantity, own in together.items()]
        return [(name, quantity) for name, quantity in quantities if quantity is not None]

    def information(self, camera: Camera) -> dict[str, Information]:
        """Block -> the information of a view by it alone.

        Each block has a view context of its own: what `drgs fisher` writes of the backdrop is of the opacity that is
        rendered, which is up to 6e-6 off the one of a diagonal's traversal. Unknowns of the view are eliminated from
        each by its own rows: the information of colors and features together, with a pose eliminated from both at once,
        is more than the sum of these.
        """
        with torch.no_grad():  # information is a number
            return {
                name: quantity.summand(quantity.compute(self._view(camera)), camera, None)
                for name, quantity in self._apart()
            }

    def with_unknowns(self) -> SceneBlocks:
        """The same, but that nothing is eliminated from the information of views."""
        return dataclasses.replace(self, scoring=dataclasses.replace(self.scoring, nuisances=Nuisances(eliminate=())))

    def variance_maps(self, camera: Camera, weights: Information) -> dict[str, torch.Tensor]:
        """Block -> (H, W) float32 map of its rows: sums of J_pk^2 weights_k, see `drgs.fisher.variance_map`.

        Args:
            camera: The view's camera.
            weights: Group -> tensor; each block takes those of its groups.
        """
        with torch.no_grad():  # a map is a number a pixel
            return {
                name: quantity.variance_map(
                    self._view(camera), {group: x for group, x in weights.items() if group in BLOCKS[name].groups}
                )
                for name, quantity in self._apart()
            }

    def variance_map(self, camera: Camera, weights: Information) -> torch.Tensor:
        """(H, W) float32 map of all blocks together; see `variance_maps`."""
        return functools.reduce(torch.add, self.variance_maps(camera, weights).values())

    def _apart(self) -> list[tuple[str, Quantity]]:
        """The quantity of each block alone."""
        return [pair for name in self.names for pair in self.quantities([name])]

    def _view(self, camera: Camera) -> ViewContext:
        return ViewContext(self.scene, camera, self.scoring.settings)


def _other_groups() -> set[str]:
    """Groups of parameters that are none of Gaussians, of all blocks there are."""
    return {group for name in BLOCKS for group in BLOCKS[name].groups} - {*GAUSSIAN_GROUPS}


def _rows(of: SceneBlocks, names: Sequence[str]) -> dict[str, Any]:
    """Which rows of an image count for these blocks: colors where none of them has rows of its own."""
    return {
        "channel_weights": (0.0, 0.0, 0.0) if "geometry" not in names and "semantic" in names else (1.0, 1.0, 1.0),
        "semantics": of.prepared["semantic"] if "semantic" in names else None,
    }


def _of_gaussians(of: SceneBlocks, names: tuple[str, ...]) -> Quantity | None:
    """Information of colors and features about Gaussians."""
    from drgs.information.diagonal import DenseBlocks, Diagonal  # loads Dr.Jit, which poses alone need not have

    scoring = of.scoring
    own = {group for name in names for group in BLOCKS[name].groups}
    without = tuple(group for group in GAUSSIAN_GROUPS if group not in own)
    others = _other_groups()
    # Not only `GAUSSIAN_GROUPS`: a scene's own tensors have names of their own, which some methods know.
    groups = None if scoring.groups is None else tuple(name for name in scoring.groups if name not in others)
    if groups is not None and set(groups) <= {*without}:
        return None
    rows = _rows(of, names) | {"nuisances": scoring.nuisances}
    if criterion_named(scoring.criterion).of_blocks:
        return DenseBlocks(**rows)
    # A scene's own parameters have no closed form: of other methods, names are those of its Gaussians.
    of_gaussians = groups is not None and scoring.method not in _WITH_SCENES
    if scoring.method == "probes":
        rows["probes"] = scoring.probes
    return Diagonal(scoring.method, groups, without, of_gaussians, **rows)


def _of_network(of: SceneBlocks, names: tuple[str, ...]) -> Quantity | None:
    """Information of the rows of the other blocks about the network that moves the Gaussians."""
    from drgs.information.network import NetworkInformation  # loads Dr.Jit, which poses alone need not have

    groups = of.wanted(DEFORMATION_BLOCK.groups)
    if groups == ():
        return None
    scoring = of.scoring
    estimate: NetworkEstimate = "diagonal" if scoring.network == "ratio" else scoring.network
    rows = _rows(of, of.names) | {"nuisances": scoring.nuisances}
    return NetworkInformation(estimate, probes=scoring.probes, groups=groups, **rows)


def _of_backdrop(of: SceneBlocks, names: tuple[str, ...]) -> Quantity | None:
    """Information of the opacity about the color behind everything."""
    if of.wanted(BACKDROP_BLOCK.groups) == ():
        return None
    nuisances = of.scoring.nuisances
    # Features show where the camera stands, too. Without unknowns, quantities are alike whatever else counts.
    semantics = of.prepared.get("semantic") if nuisances.names else None
    return Backdrop(of.prepared["backdrop"], of.empty_outside, semantics=semantics, nuisances=nuisances)


def _metric(
    of: SceneBlocks, seen: Gaussians, cameras: Sequence[Camera], compute: ComputeViews | None
) -> SemanticMetric:
    """The metric that the scoring names, else that of features as they are stored, all channels alike."""
    assert seen.features is not None  # else there is no such block
    return of.scoring.semantics or SemanticMetric.of(None, seen.features.shape[1])


GEOMETRY_BLOCK = ImageBlock(tuple(group for group in GAUSSIAN_GROUPS if group != "features"), _of_gaussians)
SEMANTIC_BLOCK = ImageBlock(
    tuple(group for group in GAUSSIAN_GROUPS if group != "sh"),
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
    prepare=lambda of, seen, cameras, compute: backdrop_sphere(of.scene, cameras, compute),
)
