"""The inputs by which compared rasterizers are differentiated: raw parameters by group, a view's pose, wide colors."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.oracle import float64
from drgs.splats import color_of

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh")  # raw, as crossval and the ladder compare them
POSE = "viewmats"  # (6,) of one view, 0: see `posed`
POSE_END = "viewmats_rs"  # (6,) of the pose at the end of a rolling shutter, likewise
MOTIONS = (POSE, POSE_END)
COLORS = "colors"  # (N, D) in place of `sh`
BACKGROUNDS = "backgrounds"  # (C, D) of the views of a call, where the gradient by them is compared


def around_origin(g: Gaussians, cameras: list[Camera]) -> tuple[Gaussians, list[Camera]]:
    """Gaussians and cameras relative to the origin of the Gaussians, in a world whose 0 that is.

    What is compared takes means and cameras alone, some of it in float32, which has no detail far from 0.
    """
    return g.replace(origin=np.zeros(3)), [camera.relative_to(g.origin) for camera in cameras]


def raw_of(g: Gaussians) -> dict[str, torch.Tensor]:
    """Raw parameters in float64, world frame, without a graph: the leaves of every gradient."""
    # A graph behind them would make these no leaves; float64, so that steps of central differences are exact.
    raw = {name: getattr(g, name).detach().double().cpu() for name in PARAMETERS}
    raw["means"] = raw["means"] + torch.tensor(np.asarray(g.origin, float))
    return raw


def with_pose(raw: dict[str, torch.Tensor], shutter: bool = False) -> dict[str, torch.Tensor]:
    """Raw parameters together with the motion of a view, or of both of its poses if it has two, which is none."""
    return {**raw, **{name: torch.zeros(6, dtype=torch.float64) for name in MOTIONS[: 1 + shutter]}}


def with_colors(raw: dict[str, torch.Tensor], channels: int, seed: int) -> dict[str, torch.Tensor]:
    """Raw parameters with random colors (N, D) in [0, 1] instead of SH."""
    generator = torch.Generator().manual_seed(seed)
    colors = torch.rand(len(raw["means"]), channels, generator=generator).double()
    return {name: x for name, x in raw.items() if name != "sh"} | {COLORS: colors}


def posed(raw: dict[str, torch.Tensor], camera: Camera) -> Camera:
    """The camera moved by raw["viewmats"] if that is there: w2c <- exp(xi) w2c, in the camera's own axes.

    xi is a rotation about the camera's center in radians, then a translation in units of the Gaussians' median depth:
    so both change the image by as much, and neither part of a gradient hides the other. raw["viewmats_rs"] moves the
    pose at the end of a rolling shutter in the same way.
    """
    fields = {"w2c": POSE, "w2c_end": POSE_END}
    moved = {field: _moved(raw, camera, field, raw[name]) for field, name in fields.items() if name in raw}
    return dataclasses.replace(camera, **moved) if moved else camera


def _moved(raw: dict[str, torch.Tensor], camera: Camera, field: str, twist: torch.Tensor) -> torch.Tensor:
    """(4, 4) a pose of a camera moved by a twist (6,)."""
    # The motion is the parameter, not the matrix: a camera whose pose is a leaf gets no gradient here.
    w2c = float64(getattr(camera, field)).detach()
    twist = float64(twist)
    unit = torch.tensor([1.0] * 3 + [depth_of(raw, camera)] * 3, dtype=torch.float64)
    return torch.matrix_exp(((unit * twist)[:, None, None] * twist_basis()).sum(0)) @ w2c


def twist_basis() -> torch.Tensor:
    """(6, 4, 4) generators of rigid motions, rotations first."""
    basis = torch.zeros(6, 4, 4, dtype=torch.float64)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        basis[k, j, i] = 1
        basis[k, i, j] = -1
        basis[3 + k, k, 3] = 1
    return basis


def depth_of(raw: dict[str, torch.Tensor], camera: Camera) -> float:
    """Median depth of the means in front of a camera, 1 where there is none: a unit, so without a derivative."""
    # A unit is a constant: how the median moves with the means is no part of the motion's gradient.
    w2c = float64(camera.w2c).detach()
    means = float64(raw["means"]).detach()
    depths = means @ w2c[2, :3] + w2c[2, 3]
    ahead = depths[depths > 0]
    return float(ahead.median()) if len(ahead) else 1.0


def gaussians_of(raw: dict[str, torch.Tensor]) -> tuple[Gaussians, float]:
    """Gaussians with SH, or with colors of any width, and what was added to the first three channels of those."""
    fields = {name: x for name, x in raw.items() if name not in (*MOTIONS, COLORS)}
    if COLORS not in raw:
        return Gaussians(**fields), 0.0
    sh, features, shift = color_of(raw[COLORS])
    return Gaussians(**fields, sh=sh, features=features), shift


def image_of(out: Any, raw: dict[str, torch.Tensor], shift: float) -> torch.Tensor:
    """(H, W, 3) color of what was rendered of `gaussians_of(raw)`; with colors (N, D) all D channels, on black."""
    if COLORS not in raw:
        return out.rgb
    image = out.rgb[..., : raw[COLORS].shape[1]] - shift * out.alpha[..., None]
    return image if out.features is None else torch.cat([image, out.features], -1)
