"""Options of a mesh; imports nothing heavy, so that `drgs --help` reads it."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from drgs.checks.records import Record, option

__all__ = ["BRICK", "POINTS", "DepthKind", "MeshOptions"]

BRICK = 16
"""Cells along each axis of the bricks in which a surface is computed; chosen: 4,913 points, 20 kB of float32."""
POINTS = (BRICK + 1) ** 3
"""Points of the lattice in a brick, those included that it shares with others."""
DepthKind = Literal["median", "expected"]


@dataclasses.dataclass(frozen=True)
class MeshOptions(Record):
    """How depth images are fused into a mesh."""

    where: ClassVar[str] = "mesh"

    depth: DepthKind = option(
        "median", "Depth of a ray: where transmittance falls to one half (median), or the mean (expected)."
    )
    voxel: float | None = option(
        None, "Size of a voxel in scene units; default two pixels wide on the surface.", within=(1e-30, 1e30)
    )
    trunc: float = option(4.0, "Truncation distance of the signed distance field, in voxels.", within=(1.0, 64.0))
    max_voxels: int = option(
        100_000_000,
        "Largest number of voxels to compute; the default --voxel grows until they suffice.",
        within=(64 * POINTS, 1 << 40),
    )
    min_views: int = option(2, "Remove parts of the surface that fewer views than this see.", within=(1, 1 << 20))
    crop: float = option(
        1.0,
        "Remove parts of the surface whose position the views leave more uncertain than this many voxels; 0 keeps all.",
        within=(0.0, 1e9),
    )
    min_piece: float = option(
        0.01, "Remove loose pieces with less than this fraction of the largest one's area.", within=(0.0, 1.0)
    )
