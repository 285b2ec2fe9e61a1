"""The rows of a view as a differentiable image, without the part that the view's own unknowns explain.

The equations are in `drgs.information.complement`. N of the pose is forward mode, that of the exposure the image
itself. The six numbers of the pose are a rotation about the camera's center and a translation: the same span as the
world's twist, without the leverage of an origin that is far away.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import torch

from drgs.information.complement import Eliminated
from drgs.information.pullback import Pullback
from drgs.tracing.bridge import differentiable
from drgs.tracing.call import Call
from drgs.tracing.errors import own_errors
from drgs.tracing.pose import twists_about
from drgs.tracing.tangents import push_forward

if TYPE_CHECKING:
    from drgs.information.groups import Group
    from drgs.information.nuisances import Nuisances
    from drgs.information.quantity import ViewContext
    from drgs.information.semantics import SemanticMetric
    from drgs.information.sums import Information


@torch.no_grad()  # information is a number
def eliminated_of(call: Call, scales: torch.Tensor, nuisances: Nuisances) -> Eliminated:
    """The part of a view's rows, with pixels and Gaussians, that its unknowns explain.

    Args:
        call: The call of the view, whose channels are the rows: colors, then features.
        scales: (C,) or (pixels, C) what these are multiplied by.
        nuisances: The unknowns.
    """
    columns: list[torch.Tensor] = []
    precision: list[float] = []
    width = scales.shape[-1]
    if "exposure" in nuisances.names:
        with own_errors():
            image = call.output(differentiable(call)).rgb.reshape(-1, 3).double().cpu()
        for channel in range(3):
            column = image.new_zeros(len(image), width)
            column[:, channel] = image[:, channel]
            columns.append(column)
        precision += [_precision(nuisances.exposure_std)] * 3
    if "pose" in nuisances.names:
        assert call.camera is not None  # as of every view; rays have no pose
        with own_errors():
            moved = push_forward(call, {"camera": twists_about(call.camera.center)})
        rows = moved.rgb if moved.features is None else torch.cat([moved.rgb, moved.features], -1)
        columns += rows.reshape(6, -1, width).double().cpu()
        turn, shift = nuisances.pose_std or (None, None)
        precision += [_precision(turn)] * 3 + [_precision(shift)] * 3
    if not columns:
        return Eliminated(scales.new_zeros(call.pixels, width, 0), scales.new_zeros(0))
    return Eliminated.spanned(
        torch.stack(columns, -1) * scales[..., None], torch.tensor(precision, dtype=torch.float64)
    )


def _precision(std: float | None) -> float:
    return 0.0 if std is None else 1 / std**2


BLOCK_INPUTS = ("means", "rotations", "log_scales", "logit_opacities", "sh")
"""Groups in the order of a block's rows."""


@dataclasses.dataclass(frozen=True, eq=False)
class ViewRows:
    """The rows of a view of Gaussians as an image that can be differentiated, and what its unknowns explain of them.

    Attributes:
        call: The call, whose features are the channels P^T f of the semantics' estimate.
        weights: (C,) roots of the channels' weights.
        scales: (C,) or (pixels, C) what channels are multiplied by: these, times the mask.
        eliminated: The part that the unknowns explain.
        semantics: The metric of the features; None where they are no rows.
        reduction: (D, K) P; None likewise.
    """

    call: Call
    weights: torch.Tensor
    scales: torch.Tensor
    eliminated: Eliminated
    semantics: SemanticMetric | None = None
    reduction: torch.Tensor | None = None

    @classmethod
    def of(
        cls, view: ViewContext, weights: Sequence[float], semantics: SemanticMetric | None, nuisances: Nuisances
    ) -> ViewRows | None:
        """None where nothing is to be eliminated, or seen.

        Args:
            view: The view.
            weights: Inverse noise variances of R, G and B.
            semantics: The metric of the features, if these are rows, too.
            nuisances: The unknowns.
        """
        camera, mask = view.camera, view.mask
        if not nuisances.names or not len(view.gaussians) or not camera.width * camera.height:
            return None
        roots = torch.tensor(list(weights), dtype=torch.float64).sqrt()
        seen = view.gaussians.detach()  # as everywhere here: a number
        reduction = None
        if semantics is None:
            seen = seen.replace(features=None)
        else:
            assert seen.features is not None  # `SemanticMetric.check` has refused it
            reduction = semantics.directions(seen.features)
            seen = seen.replace(features=semantics.channels(seen.features))
            roots = torch.cat([roots, roots.new_full((reduction.shape[1],), semantics.weight**0.5)])
        # A mask is a number, whatever graph it is in.
        scales = roots if mask is None else mask.detach().double().cpu().reshape(-1, 1) * roots
        call = Call(seen, camera, view.settings, frozenset())
        return cls(call, roots, scales, eliminated_of(call, scales, nuisances), semantics, reduction)

    def slopes(self, groups: Mapping[str, Group]) -> Iterator[tuple[float, dict[str, torch.Tensor]]]:
        """Share of each direction, and group -> its slopes U_j^T J, float64, shaped like the group's parameters."""
        if not len(self.eliminated):
            return
        pull = Pullback(self.call, [group.input for group in groups.values()])
        for share, direction in zip(self.eliminated.shares, self.eliminated.directions.unbind(-1), strict=True):
            rows = (direction * self.scales).float()  # as cotangents of images are
            slopes = pull(rows[:, :3], rows[:, 3:] if rows.shape[1] > 3 else None)
            yield (
                float(share),
                {
                    name: group.to_group(slopes[group.input], self.call.inputs[group.input].double().cpu())
                    for name, group in groups.items()
                },
            )

    def lost(self, groups: Mapping[str, Group]) -> Information:
        """Group -> information that the unknowns take from the diagonal, shaped like it.

        Features that are no rows are known by themselves only, and nothing is taken of them.
        """
        informed = {name: group for name, group in groups.items() if name != "features" or self.semantics is not None}
        total: dict[str, torch.Tensor] = {}
        for share, slopes in self.slopes(informed):
            for name, x in slopes.items():
                part = share * (self._squares(x) if name == "features" else x.square())
                total[name] = total[name] + part if name in total else part
        return total

    def _squares(self, slopes: torch.Tensor) -> torch.Tensor:
        """(N,) mean over the D channels of squared slopes, of (N, K) those by the channels P^T f.

        The information about features has all of M, of which an estimate has P P^T on average only: what is lost is the
        same share of both.
        """
        assert self.reduction is not None  # else features are no rows
        assert self.semantics is not None
        P = self.reduction
        whole = float(self.semantics.matrix.trace()) / float(P.square().sum())
        return whole * (slopes @ P.T).square().mean(1)

    def lost_of_columns(self, columns: torch.Tensor, colors: bool) -> torch.Tensor:
        """(K,) information that the unknowns take from the squared lengths of columns, and so of J^T J's diagonal.

        Args:
            columns: (K, H, W, 3 + D) float64 columns of J, times the mask.
            colors: Whether their colors count.
        """
        flat = columns.flatten(1, 2)
        rows = flat[..., :3] * self.weights[:3] * float(colors)
        if self.reduction is not None:
            rows = torch.cat([rows, flat[..., 3:] @ self.reduction * self.weights[3:]], -1)
        return self.eliminated.lost(rows)

    def taken_of_blocks(self, groups: Mapping[str, Group]) -> torch.Tensor:
        """(N, 13, 13) information that the unknowns take from the blocks.

        Args:
            groups: Those of `BLOCK_INPUTS`.
        """
        total = torch.zeros(self.call.count, 13, 13, dtype=torch.float64)
        for share, slopes in self.slopes(groups):
            parts = [slopes[name] for name in BLOCK_INPUTS[:3]]
            parts += [slopes["logit_opacities"][:, None], slopes["sh"][:, 0]]
            row = torch.cat(parts, 1)
            total += share * row[:, :, None] * row[:, None, :]
        return total


def backdrop_taken(
    view: ViewContext, weights: Sequence[float], semantics: SemanticMetric | None, nuisances: Nuisances
) -> torch.Tensor | None:
    """(pixels, 3, r) float64 of a view: S_j^(1/2) U_j of the colors times what these are multiplied by; None where
    nothing is eliminated.

    Times 1 - alpha, which is the derivative by the color behind everything, and summed up over a cell, these are roots
    of what the unknowns take of H_c. Outside of a mask rows are 0, and so is U: pixels that are known to be empty there
    have no information about the unknowns.
    """
    rows = ViewRows.of(view, weights, semantics, nuisances)
    if rows is None:
        return None
    return rows.eliminated.directions[:, :3] * rows.scales[..., :3, None] * rows.eliminated.shares.sqrt()
