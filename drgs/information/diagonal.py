"""Fisher information of a view about the parameters of its Gaussians: the diagonal of J^T J, dense blocks, and
coverage.

Methods of the diagonal:

    exact      squares of every derivative of each pixel and channel, hit by hit in one replay (replay.py)
    columns    the same from forward-mode columns of J, one for every parameter
    probes     mean of (J^T v)^2 over random images v, one reverse pass each
    fisherrf   a replay that sums channels before it squares, as FisherRF's rasterizer does
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch

from drgs.ellipsoids import DeformableScene, Scene
from drgs.information.choices import METHODS, Method
from drgs.information.columns import BATCH, jacobian_columns
from drgs.information.complement import remaining, remaining_blocks
from drgs.information.elimination import BLOCK_INPUTS, ViewRows
from drgs.information.gains import DENSE
from drgs.information.groups import Group, groups_of
from drgs.information.jacobian import GEOMETRY, BlockSums
from drgs.information.maps import variance_map
from drgs.information.nuisances import NO_NUISANCES, Nuisances
from drgs.information.pullback import Pullback
from drgs.information.quantity import Quantity, ViewContext
from drgs.information.semantics import SemanticMetric
from drgs.information.sums import Information
from drgs.runtime import alone
from drgs.tracing.call import Call
from drgs.tracing.errors import own_errors


@dataclasses.dataclass(frozen=True)
class Diagonal(Quantity):
    """The diagonal of J^T J; `drgs.fisher.diagonal` has the equations, and more about each field.

    Attributes:
        method: How it is computed.
        groups: Groups that are wanted; None: all that the Gaussians have.
        without: Groups of the result that are left out.
        of_gaussians: Whether groups are those of the Gaussians, also where the scene has a tensor of the same name.
        probes, seed: Random images of method `probes`, and their seed; the number of the view is added to it.
        channel_weights: Inverse noise variances of R, G and B; 0 where colors are no part of the image.
        semantics: The metric of the features that are a part of the image; None: they are none.
        nuisances: Unknowns of the view that are eliminated.
    """

    method: Method = "exact"
    groups: Sequence[str] | None = None
    without: tuple[str, ...] = ()
    of_gaussians: bool = False
    probes: int = 16
    seed: int = 0
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0)
    semantics: SemanticMetric | None = None
    nuisances: Nuisances = NO_NUISANCES
    where: ClassVar[str] = "fisher.diagonal"

    @alone
    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """Group -> float64 tensor on the CPU; 0 of a view without Gaussians. A replay gives the view its opacity."""
        gaussians = view.gaussians
        scene = gaussians if self.of_gaussians else view.scene
        wanted = self._checked_groups(groups_of(gaussians, self.groups, scene))
        if self.semantics is not None:
            self.semantics.check(self.where, gaussians)
        if not len(gaussians):
            result = {name: torch.zeros(group.shape(gaussians)) for name, group in wanted.items()}
        elif self.method in ("columns", "probes"):
            compute = _by_columns if self.method == "columns" else _by_probes
            result = compute(self, view, {n: group for n, group in wanted.items() if group.owner != "scene"})
            if own := {n: group for n, group in wanted.items() if group.owner == "scene"}:
                assert isinstance(scene, DeformableScene)  # which alone has tensors of its own
                result |= compute(self, view, own, scene)
        else:
            result = self._by_replay(view, wanted)
        return {name: result[name].to(torch.float64) for name in wanted if name not in self.without}

    def variance_map(self, view: ViewContext, weights: Information) -> torch.Tensor:
        """`drgs.fisher.variance_map` of the same rows."""
        return variance_map(view, weights, self.channel_weights, self.semantics)

    def _by_replay(self, view: ViewContext, wanted: dict[str, Group]) -> dict[str, torch.Tensor]:
        replay = view.replay(self.semantics)
        along = [one.sums for one in view.shared_sums.values() if one.semantics is self.semantics]
        result = dict(replay.diagonal(wanted, self.channel_weights, self.method == "fisherrf", along))
        rows = ViewRows.of(view, self.channel_weights, self.semantics, self.nuisances)
        if rows is not None:
            result |= {name: remaining(result[name], lost) for name, lost in rows.lost(wanted).items()}
        return result

    def _checked_groups(self, wanted: dict[str, Group]) -> dict[str, Group]:
        """Those of the wanted groups that a method has, which must know tensors of a scene where there are any."""
        method, where = self.method, self.where
        if method not in METHODS:
            raise ValueError(f"{where}: method must be one of {', '.join(METHODS)}, got {method!r}")
        if self.semantics is not None and method == "fisherrf":
            raise ValueError(f"{where}: method fisherrf must have no semantics, got some; it is about colors only")
        if self.nuisances.names and method == "fisherrf":
            raise ValueError(f"{where}: method fisherrf must have no nuisances, got some; it knows images only")
        for name, group in wanted.items():
            methods = ("columns",) if group.outputs != (0, 3) else ("columns", "probes")
            if group.owner == "scene" and method not in methods:
                raise ValueError(
                    f"{where}: method of group {name!r} must be {' or '.join(map(repr, methods))}, got {method!r}; "
                    "it is a tensor of the scene: for those of its Gaussians pass scene.at(time)"
                )
        known = {name: group for name, group in wanted.items() if method != "fisherrf" or group.fisherrf}
        if wanted and not known:
            raise ValueError(
                f"{where}: groups of method fisherrf must have more than {', '.join(wanted)}, which it does not "
                "know; name another one, or use method exact"
            )
        return known


@dataclasses.dataclass(frozen=True)
class DenseBlocks(Quantity):
    """One dense block of J^T J for every Gaussian: {"blocks": (N, 13, 13)}, as of `drgs.fisher.blocks`.

    Attributes:
        channel_weights, semantics, nuisances: The same as of a `Diagonal`.
    """

    channel_weights: Sequence[float] = (1.0, 1.0, 1.0)
    semantics: SemanticMetric | None = None
    nuisances: Nuisances = NO_NUISANCES
    where: ClassVar[str] = "fisher.blocks"

    @property
    def signed(self) -> tuple[str, ...]:
        """Entries off the diagonal."""
        return (DENSE,)

    @alone
    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """Float64 on the CPU."""
        gaussians = view.gaussians
        if self.semantics is not None:
            self.semantics.check(self.where, gaussians)
        if not len(gaussians):
            return {DENSE: torch.zeros(0, BlockSums.SIZE, BlockSums.SIZE, dtype=torch.float64)}
        blocks = view.replay(self.semantics).blocks(self.channel_weights)
        rows = ViewRows.of(view, self.channel_weights, self.semantics, self.nuisances)
        if rows is not None:
            blocks = remaining_blocks(blocks, rows.taken_of_blocks(groups_of(gaussians, BLOCK_INPUTS)))
        return {DENSE: blocks}


@dataclasses.dataclass(frozen=True)
class Coverage(Quantity):
    """{"coverage": (N,)}: sum over pixels of w^2, the information about a color without direction."""

    where: ClassVar[str] = "fisher.coverage"

    @alone
    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """Float64 on the CPU."""
        if not len(view.gaussians):
            return {"coverage": torch.zeros(0, dtype=torch.float64)}
        sums = view.replay(geometry=False).sums((GEOMETRY,), [1.0] * 3)
        return {"coverage": sums[:, GEOMETRY].cpu().contiguous()}


# -------------------------------------------------- methods


def _exact_rows(quantity: Diagonal, view: ViewContext) -> ViewRows | None:
    """The view's rows with one for each direction that the decoder sees; None where nothing is eliminated."""
    semantics = quantity.semantics
    every = None if semantics is None else dataclasses.replace(semantics, estimate="exact")
    return ViewRows.of(view, quantity.channel_weights, every, quantity.nuisances)


def _by_columns(
    quantity: Diagonal, view: ViewContext, wanted: Mapping[str, Group], scene: Scene | None = None
) -> dict[str, torch.Tensor]:
    """The diagonal of J^T J from every column of J.

    Args:
        quantity: The diagonal.
        view: The view.
        wanted: Groups: the Gaussians', or with `scene` the scene's own.
        scene: The scene that the Gaussians come from.
    """
    gaussians, semantics, mask = view.gaussians, quantity.semantics, view.mask
    result = {}
    rows_of_view = _exact_rows(quantity, view) if wanted else None
    scale = torch.tensor(quantity.channel_weights, dtype=torch.float64)
    # A mask is a number, whatever graph it is in; sums of squares of all pixels are float64, as everywhere here.
    factor = torch.ones(1, 1, dtype=torch.float64) if mask is None else mask.detach().double().cpu()
    for name, group in wanted.items():
        shape = group.tangent(gaussians)
        parts = []
        rows = np.argwhere(np.ones(shape))
        for start in range(0, len(rows), BATCH):
            index = {name: rows[start : start + BATCH]}
            columns = (
                jacobian_columns(scene or gaussians, view.camera, index, view.settings).cpu().double()
                * factor[..., None]
            )
            squared = torch.zeros(len(columns), dtype=torch.float64)
            if group.outputs == (0, 3):
                squared += (columns[..., :3].square() * scale).sum((1, 2, 3))
            if semantics is not None:
                squared += semantics.squares(columns[..., 3:]).sum((1, 2))
            elif group.outputs != (0, 3):
                squared += columns[..., 3:].square().sum((1, 2, 3))
            if rows_of_view is not None and (group.outputs == (0, 3) or semantics is not None):
                squared = remaining(squared, rows_of_view.lost_of_columns(columns, group.outputs == (0, 3)))
            parts.append(squared)
        result[name] = group.merge(torch.cat(parts).reshape(shape))
    return result


@own_errors()
def _by_probes(
    quantity: Diagonal, view: ViewContext, groups: Mapping[str, Group], scene: DeformableScene | None = None
) -> dict[str, torch.Tensor]:
    """Mean of (J^T v)^2 over Rademacher images v of RGB and decoded features; what only features inform about is exact.

    v has a sign for each direction that the decoder sees, and L v is what the features get of it, for E (J^T L v)^2 =
    diag(J^T M J). Of what the view's own unknowns explain v is freed, for E (J^T W^(1/2) v)^2.

    Args:
        quantity: The diagonal.
        view: The view.
        groups: The Gaussians', or with `scene` the scene's own.
        scene: The scene that the Gaussians come from.
    """
    gaussians, semantics, mask, probes = view.gaussians, quantity.semantics, view.mask, quantity.probes
    weights = quantity.channel_weights
    if not (isinstance(probes, int) and probes >= 1):
        raise ValueError(f"fisher.diagonal: probes must be >= 1 and whole, got {probes!r}; try 16")
    other = {name: group for name, group in groups.items() if group.outputs != (0, 3)}
    groups = {name: group for name, group in groups.items() if name not in other}
    total = {name: torch.zeros(group.shape(gaussians), dtype=torch.float64) for name, group in groups.items()}
    # Detached: information is a number, and its derivatives are taken by Dr.Jit. Features that are no part of the
    # image would be composited for nothing.
    seen = gaussians.detach() if semantics else gaussians.detach().replace(features=None)
    call = Call(seen, view.camera, view.settings, frozenset(), scene=scene)
    generator = torch.Generator().manual_seed(quantity.seed + view.number)
    pull = Pullback(call, [group.input for group in groups.values()])
    root = torch.tensor(weights).sqrt()
    # float32, as cotangents of images are; squares of the slopes are summed in float64.
    factor = torch.ones(1, 1) if mask is None else mask.detach().float().cpu().reshape(-1, 1)
    rows = _exact_rows(quantity, view)
    for _ in range(probes if groups else 0):
        sign = torch.randint(0, 2, (call.pixels, 3), generator=generator).float() * 2 - 1
        signs = semantics.signs(call.pixels, generator) if semantics else None
        if rows is not None:
            v = rows.eliminated.root(sign.double() if signs is None else torch.cat([sign.double(), signs], 1))
            sign, signs = v[:, :3].float(), None if signs is None else v[:, 3:]
        features = semantics.cotangent(signs) * factor if semantics and signs is not None else None
        slopes = pull(sign * root * factor, features)
        for name, group in groups.items():
            total[name] += group.to_group(slopes[group.input], call.inputs[group.input].double().cpu()).square()
    result = {name: x / probes for name, x in total.items()}
    if other:
        replay = view.replay(semantics, geometry=False)
        result |= replay.diagonal(other, weights, False)
        if rows is not None:
            result |= {name: remaining(result[name], lost) for name, lost in rows.lost(other).items()}
    return result
