"""Point clouds in PLY, whose headers are compared with the file before anything is allocated."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drgs.checks.arguments import said
from drgs.codecs.ply_headers import ply_offset, ply_source, read_ply_header
from drgs.io.foreign import is_file, refuse_foreign


def read_point_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (P,3) float64 world and colors (P,3) float32 of a PLY point cloud; gray where it has no colors. The offset
    of a line `comment offset X Y Z` is added.

    Raises:
        FileNotFoundError: No such file.
        ValueError: No PLY with x, y, z, shorter than it claims, or points or the offset are not finite.
    """
    if not is_file(path):
        raise FileNotFoundError(f"{path}: must be a PLY point cloud, found none; restore it or drop ply_file_path")
    import plyfile

    refuse_foreign(path, "a PLY point cloud")
    read_ply_header(path)
    try:
        vertex = plyfile.PlyData.read(ply_source(path))["vertex"]
        points = np.stack([np.asarray(vertex[axis], dtype=np.float64) for axis in "xyz"], axis=-1)
        names = vertex.data.dtype.names
        colors = np.full(points.shape, 0.5, dtype=np.float32)
        if {"red", "green", "blue"} <= set(names):
            raw = np.stack([vertex[channel] for channel in ("red", "green", "blue")], axis=-1)
            whole = raw.dtype.kind in "iu"
            colors = raw.astype(np.float32) / np.float32(np.iinfo(raw.dtype).max if whole else 1)
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file, whatever its words make plyfile and NumPy raise
        raise ValueError(
            f"{path}: must be a PLY point cloud with x, y, z, got {said(error, 200)}; export it again"
        ) from None
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise ValueError(f"{path}: points must be finite, got NaN or Inf at index {bad[0]}; export it again")
    offset = ply_offset(path)
    return points if offset is None else points + offset, colors
