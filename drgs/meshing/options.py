"""How a surface is made; imports nothing heavy, so that `drgs --help` reads it."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from drgs.guards.arguments import check_fields
from drgs.guards.records import Record

__all__ = ["BRICK", "POINTS", "DepthKind", "MeshOptions"]

BRICK = 16
"""Cells along each axis of the bricks that a surface is computed in."""
POINTS = (BRICK + 1) ** 3
"""Points of the lattice in a brick, those included that it shares with others."""
DepthKind = Literal["median", "expected"]


@dataclasses.dataclass(frozen=True)
class MeshOptions(Record):
    """How a surface is made of depth images.

    Attributes:
        depth: Depth of a ray: where transmittance falls to one half (median), or the mean (expected).
        voxel: Size of a voxel in scene units; default two pixels wide on the surface.
        trunc: Truncation distance of the signed distance field, in voxels.
        max_voxels: Largest number of voxels to compute; the default --voxel grows until they suffice.
        min_views: Remove parts of the surface that fewer views than this see.
        crop: Remove parts of the surface whose position the views leave more uncertain than this many voxels; 0 keeps
            all.
        min_piece: Remove loose pieces with less than this fraction of the largest one's area.
    """

    where: ClassVar[str] = "mesh"

    depth: DepthKind = "median"
    voxel: float | None = None
    trunc: float = 4.0
    max_voxels: int = 100_000_000
    min_views: int = 2
    crop: float = 1.0
    min_piece: float = 0.01

    def __post_init__(self) -> None:
        ranges = {"voxel": (1e-30, 1e30), "trunc": (1.0, 64.0), "max_voxels": (64 * POINTS, 1 << 40)}
        ranges |= {"min_views": (1, 1 << 20), "crop": (0.0, 1e9), "min_piece": (0.0, 1.0)}
        check_fields(self.where, self, ranges)
