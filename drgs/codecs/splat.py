"""`.splat`, the format of antimatter15's viewer: 32 bytes a Gaussian, no SH beyond degree 0, no header and no mark.

Decoded here: it is one NumPy record. The layout is that of antimatter15/splat (convert.py): position and linear scales
as float32, color and opacity as bytes, and a quaternion wxyz in bytes, (byte - 128) / 128. Axes are those of the PLY.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.codecs.codec import Codec
from drgs.codecs.values import assembled, check_count, dc_of_colors, log_of_scales, logits_of_bytes

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians

__all__ = ["LEAST_FLOAT", "SPLAT", "load_splat"]

LEAST_FLOAT = float(np.finfo(np.float32).tiny)
"""What a float32 scale of 0 is taken for: the least normal number, a log scale of -87.3."""
_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("quat", "u1", 4)])


def load_splat(path: Path) -> Gaussians:
    """Gaussians of a .splat file, SH degree 0.

    Raises:
        ValueError: If it is empty, no whole number of rows, or a value is not finite (the first index is named).
    """
    size = path.stat().st_size
    if size == 0 or size % _ROW.itemsize:
        raise ValueError(
            f"{path}: a .splat file must have {_ROW.itemsize} bytes a Gaussian, got {size} bytes; "
            "it is truncated or damaged, copy it again"
        )
    check_count(path, size // _ROW.itemsize, 1)
    rows = np.fromfile(path, _ROW)
    return assembled(
        path,
        rows["mean"],
        (rows["quat"].astype(np.float32) - 128) / 128,
        log_of_scales(path, rows["scale"], LEAST_FLOAT),
        logits_of_bytes(rows["opacity"]),
        dc_of_colors(rows["color"] / 255.0),
    )


SPLAT = Codec(
    ".splat",
    load_splat,
    made_by="`python convert.py {ply} --output {path}` of github.com/antimatter15/splat, or SuperSplat "
    "(superspl.at/editor)",
)
