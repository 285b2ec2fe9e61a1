"""The frame of nerfstudio's splats: it turns, moves and scales the poses of a data set before it trains, and `ns-export
gaussian-splat` writes Gaussians as they lie then. `dataparser_transforms.json` of the training run says how:

    x_splat = scale (transform @ x)        x in the frame before nerfstudio's `applied_transform`, as COLMAP's

Poses in a `transforms.json` with an `applied_transform` have that one behind them, and keep it here.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs.data.camera_path import quaternion_of
from drgs.ellipsoids import Gaussians
from drgs.io.json_files import check_json, read_json

__all__ = ["DATAPARSER_TRANSFORMS", "in_frame_of_data"]

DATAPARSER_TRANSFORMS = "dataparser_transforms.json"
"""File of a nerfstudio run, to be put beside the splat that was exported of it."""
_ROTATION_ERROR = 1e-3  # largest error of R R^T that float32 and text explain: more is no rotation
_SH_DIRECTIONS = 64  # directions by which SH are rotated, a least-squares fit: four for each of 16 coefficients
_log = logging.getLogger(__name__)


def in_frame_of_data(gaussians: Gaussians, scene: Path, data: Path) -> Gaussians:
    """Gaussians in the frame of a data set's cameras, if a `dataparser_transforms.json` lies beside their file.

    Args:
        gaussians: Gaussians of the file, whose `origin` is 0.
        scene: The file.
        data: The data set, a folder or its transforms.json.
    Returns:
        Moved, turned and scaled ones; the same ones if there is no such file.
    Raises:
        ValueError: If the file, or `applied_transform` of the data set, is no rotation and translation.
    """
    file = scene.parent / DATAPARSER_TRANSFORMS
    if not file.is_file():
        return gaussians
    stated = read_json(file)
    check_json(str(file), stated, {"scale": float}, "copy it again")
    transform, scale = _similarity(f"{file}: transform", stated.get("transform")), stated["scale"]
    poses = data if data.is_file() else data / "transforms.json"
    if poses.suffix == ".json" and poses.is_file() and isinstance(meta := read_json(poses), dict):
        applied = {"applied_scale": meta.get("applied_scale", 1.0)}
        check_json(str(poses), applied, {"applied_scale": float}, "correct it")
        scale /= applied["applied_scale"] or 1.0
        if "applied_transform" in meta:
            applied_transform = _similarity(f"{poses}: applied_transform", meta["applied_transform"])
            transform = transform @ np.linalg.inv(applied_transform)
    if not 0 < scale < np.inf:
        raise ValueError(f"{file}: scale must be above 0, got {scale:g}; copy it again")
    _log.info("%s: is in nerfstudio's frame, brought to that of %s by %s", scene, data, file)
    to_data = np.linalg.inv(transform)
    return _moved(gaussians, to_data[:3, :3], to_data[:3, 3], 1 / scale)


def _similarity(where: str, matrix: Any) -> np.ndarray:
    """(4, 4) of the rotation and translation that a file states in 3 or 4 rows."""
    try:
        found = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape not in ((3, 4), (4, 4)) or not np.isfinite(found).all():
        raise ValueError(f"{where} must be 3x4 finite numbers, got shape {found.shape}; copy it again")
    R = found[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_ERROR or np.linalg.det(R) < 0:
        raise ValueError(f"{where} must hold a rotation, got another matrix; copy it again")
    return np.concatenate([found[:3], [[0.0, 0.0, 0.0, 1.0]]])


def _moved(g: Gaussians, rotation: np.ndarray, translation: np.ndarray, scale: float) -> Gaussians:
    """Gaussians of which each point x is at `rotation @ (scale x) + translation`; with rotations, scales and SH."""
    from drgs.reference import sh_basis

    R = torch.from_numpy(rotation)
    w, *v = (float(x) for x in quaternion_of(rotation))
    a, b = torch.tensor(v, dtype=torch.float64).expand(len(g), 3), g.quats[:, 1:].double()
    s = g.quats[:, :1].double()
    quats = torch.cat([w * s - (a * b).sum(1, keepdim=True), w * b + s * a + torch.linalg.cross(a, b)], dim=1)
    # SH up to a degree stay such SH when they are turned: what is seen from a direction is seen from the turned one.
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(
        torch.randn(_SH_DIRECTIONS, 3, dtype=torch.float64, generator=generator), dim=1
    )
    count = g.sh.shape[1]
    turn = torch.linalg.lstsq(sh_basis(directions @ R.T, count), sh_basis(directions, count)).solution
    means = (scale * g.means.double()) @ R.T + torch.from_numpy(translation)
    return g.replace(
        means=means.to(g.means.dtype),
        quats=quats.to(g.quats.dtype),
        log_scales=g.log_scales + float(np.log(scale)),
        sh=torch.einsum("kj,njc->nkc", turn, g.sh.double()).to(g.sh.dtype).contiguous(),
    )
