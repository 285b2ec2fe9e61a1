"""Point clouds in PLY, whose headers are compared with the file before anything is allocated."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drgs.checks.arguments import said
from drgs.codecs.ply_headers import ply_offset, ply_source
from drgs.io.foreign import is_file, refuse_foreign

_MAX_PLY_HEADER = 65536  # bytes in which a header must end: that of 3DGS takes some 1,500
_PLY_BYTES = {
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


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
    try:
        _check_ply_size(path)
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


def _check_ply_size(path: Path) -> None:
    """Compare the least size that a PLY header claims with the file's, before anything is
    allocated.
    """
    with path.open("rb") as file:
        head = file.read(_MAX_PLY_HEADER)
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        raise ValueError("no PLY header")
    least = 0
    count = 0
    columns = 1
    text = False
    for words in (line.split() for line in head[:end].decode("ascii", "replace").splitlines()):
        if words[:1] == ["format"]:
            text = words[1:2] == ["ascii"]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            if count and not columns:
                raise ValueError(f"{count} rows without a column")
            count = int(words[2])
            columns = 0
        elif words[:1] == ["property"] and len(words) >= 3:
            # A list takes at least its length; a number in text at least a digit and a blank.
            columns += 1
            kind = words[2] if words[1] == "list" else words[1]
            least += count * (2 if text else _PLY_BYTES.get(kind, 1))
    if count and not columns:
        raise ValueError(f"{count} rows without a column")
    held = path.stat().st_size - end - len(b"end_header\n")
    if least > held + text:  # text may lack the last line break
        raise ValueError(f"a header that claims at least {least} bytes of data where the file holds {held}")
