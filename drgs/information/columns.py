"""Columns of a view's Jacobian by forward mode, and the diagonal of J^T J from them: exact, for small scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.guards.arguments import must_be
from drgs.guards.inputs import check_view, gaussians_at
from drgs.information.complement import left
from drgs.information.elimination import ViewRows
from drgs.information.groups import Group, Information, groups_of, scene_groups
from drgs.integrator import render_jvp

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.information.nuisances import Nuisances
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings

__all__ = ["by_columns", "jacobian_columns"]

_BATCH = 16  # tangents of one traversal


def jacobian_columns(
    gaussians: Scene,
    camera: Camera,
    index: Mapping[str, Any],
    settings: RenderSettings | None = None,
    batch: int = _BATCH,
) -> torch.Tensor:
    """Columns of the Jacobian by forward mode: how the image changes with single parameters.

    Args:
        gaussians, camera, settings: The same as for `render`.
        index: Group -> integers. (M, 1 + axes) rows (gaussian, component...), (M,) for logit_opacities; `features` rows
            are (gaussian, channel); `camera` (M,) of 0..5, the world-frame twist, rotation first. Of a
            `drgs.ellipsoids.DeformableScene` the groups are its own tensors, by the names of its `parameters()`, and
            rows are places in them.
        batch: Columns carried through one traversal.
    Returns:
        (columns, H, W, 3), float32, in the order of `index`; with features (columns, H, W, 3 + D).
    Raises:
        ValueError: If a group or an index is unknown.
    """
    seen = gaussians_at("fisher.jacobian_columns", gaussians, camera)
    check_view("fisher.jacobian_columns", seen, camera, settings)
    must_be("fisher.jacobian_columns", "index", index, Mapping, 'e.g. {"camera": range(6)}')
    chosen = []
    for name, rows in index.items():
        shape = _tangent_shape(seen, name, gaussians)
        rows = _whole(name, rows, shape)
        if rows.ndim != 2 or rows.shape[1] != len(shape) or (rows < 0).any() or (rows >= shape).any():
            raise ValueError(
                f"fisher.jacobian_columns: index of {name} must be rows of {len(shape)} integers below {shape}, got "
                f"shape {rows.shape}" + (f" up to {rows.max(0).tolist()}" if rows.size else "")
            )
        chosen += [(name, tuple(row)) for row in rows.tolist()]
    images = []
    for start in range(0, len(chosen), batch):
        part = chosen[start : start + batch]
        tangents: dict[str, torch.Tensor] = {}
        for k, (name, at) in enumerate(part):
            shape = _tangent_shape(seen, name, gaussians)
            tangents.setdefault(name, torch.zeros(len(part), *shape, dtype=torch.float64))[(k, *at)] = 1
        out = render_jvp(gaussians, camera, tangents, settings, outputs=())
        images.append(out.rgb if out.features is None else torch.cat([out.rgb, out.features], -1))
    if images:
        return torch.cat(images)
    width = 3 + (0 if seen.features is None else seen.features.shape[1])
    return torch.zeros(0, camera.height, camera.width, width)


def by_columns(
    gaussians: Gaussians,
    camera: Camera,
    settings: RenderSettings,
    wanted: Mapping[str, Group],
    weights: Sequence[float],
    semantics: SemanticMetric | None,
    scene: Scene | None = None,
    mask: torch.Tensor | None = None,
    nuisances: Nuisances | None = None,
) -> Information:
    """The diagonal of J^T J from every column of J.

    Args:
        gaussians: The Gaussians as the camera sees them.
        wanted: Groups: the Gaussians', or with `scene` the scene's own.
        weights: Inverse noise variances of R, G and B.
        semantics: The metric of the features, if these tell about the geometry.
        scene: The scene that the Gaussians come from.
        mask: (H, W) what the image is multiplied by; None: 1.
        nuisances: Unknowns of the view that are eliminated.
    """
    result = {}
    every = None if semantics is None else dataclasses.replace(semantics, estimate="exact")
    rows_of_view = ViewRows.of(gaussians, camera, settings, weights, every, mask, nuisances) if wanted else None
    scale = torch.tensor(weights, dtype=torch.float64)
    # A mask is a number, whatever graph it is in; sums of squares of all pixels are float64, as everywhere here.
    factor = torch.ones(1, 1, dtype=torch.float64) if mask is None else mask.detach().double().cpu()
    for name, group in wanted.items():
        shape = group.tangent(gaussians)
        squares = []
        rows = np.argwhere(np.ones(shape))
        for start in range(0, len(rows), _BATCH):
            index = {name: rows[start : start + _BATCH]}
            columns = jacobian_columns(scene or gaussians, camera, index, settings).cpu().double() * factor[..., None]
            told = torch.zeros(len(columns), dtype=torch.float64)
            if group.outputs == (0, 3):
                told += (columns[..., :3].square() * scale).sum((1, 2, 3))
            if semantics is not None:
                told += semantics.squares(columns[..., 3:]).sum((1, 2))
            elif group.outputs != (0, 3):
                told += columns[..., 3:].square().sum((1, 2, 3))
            if rows_of_view is not None and (group.outputs == (0, 3) or semantics is not None):
                told = left(told, rows_of_view.lost_of_columns(columns, group.outputs == (0, 3)))
            squares.append(told)
        result[name] = group.merge(torch.cat(squares).reshape(shape))
    return result


def _whole(name: str, rows: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Rows of integers as an array; a single axis are rows of one."""
    try:
        found = np.asarray(rows)
    except ValueError:  # rows of several lengths
        found = np.empty(0, object)
    if found.dtype.kind not in "iu" and (found.size or found.dtype == object):
        raise ValueError(
            f"fisher.jacobian_columns: index of {name} must be rows of {len(shape)} integers below {shape}, got "
            f"{rows!r:.60}; use whole numbers, as many in each row"
        )
    found = found.astype(np.int64)
    return found[:, None] if found.ndim == 1 else found


def _tangent_shape(gaussians: Gaussians, name: str, scene: Scene) -> tuple[int, ...]:
    """Of a group's tangent, or the pose's."""
    if name == "camera":
        return (6,)
    known = scene_groups(scene) or groups_of(gaussians)
    if name not in known:
        raise ValueError(f"fisher: a parameter group must be one of {', '.join(known)} or camera, got {name!r}")
    return known[name].tangent(gaussians)
