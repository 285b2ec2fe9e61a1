"""Columns of a view's Jacobian by forward mode: exact, for small scenes, and for the pose of its camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.checks.arguments import must_be
from drgs.ellipsoids import Gaussians, Scene
from drgs.information.groups import groups_of, scene_groups
from drgs.information.quantity import Quantity, ViewContext
from drgs.integrator import render_jvp
from drgs.settings import RenderSettings
from drgs.tracing.inputs import check_view, gaussians_at
from drgs.tracing.pose import twists_about

BATCH = 16  # tangents of one traversal; chosen: bounds memory


def jacobian_columns(
    gaussians: Scene,
    camera: Camera,
    index: Mapping[str, Any],
    settings: RenderSettings | None = None,
    batch: int = BATCH,
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


@dataclasses.dataclass(frozen=True)
class PoseInformation(Quantity):
    """{"pose": (6, 6)}: Fisher information of a view about the pose of its camera, as
    `drgs.fisher.pose_information`.
    """

    where: ClassVar[str] = "fisher.pose_information"

    @property
    def signed(self) -> tuple[str, ...]:
        """Entries off the diagonal."""
        return ("pose",)

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """Float64."""
        colors = view.gaussians.replace(features=None)  # else their columns would be computed, too, for nothing
        out = render_jvp(colors, view.camera, {"camera": twists_about(colors.origin)}, view.settings, outputs=())
        columns = out.rgb.reshape(6, -1).double()
        return {"pose": columns @ columns.T}


def _whole(name: str, rows: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Rows of integers as an array; a single axis are rows of one."""
    try:
        array = np.asarray(rows)
    except ValueError:  # rows of several lengths
        array = np.empty(0, object)
    if array.dtype.kind not in "iu" and (array.size or array.dtype == object):
        raise ValueError(
            f"fisher.jacobian_columns: index of {name} must be rows of {len(shape)} integers below {shape}, got "
            f"{rows!r:.60}; use whole numbers, as many in each row"
        )
    array = array.astype(np.int64)
    return array[:, None] if array.ndim == 1 else array


def _tangent_shape(gaussians: Gaussians, name: str, scene: Scene) -> tuple[int, ...]:
    """Of a group's tangent, or the pose's."""
    if name == "camera":
        return (6,)
    known = scene_groups(scene) or groups_of(gaussians)
    if name not in known:
        raise ValueError(f"fisher: a parameter group must be one of {', '.join(known)} or camera, got {name!r}")
    return known[name].tangent(gaussians)
