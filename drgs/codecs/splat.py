"""`.splat`, the format of antimatter15's viewer: 32 bytes a Gaussian, no SH beyond degree 0, no header and no mark.

Decoded here: it is one NumPy record. The layout is that of antimatter15/splat (convert.py): position and linear scales
as float32, color and opacity as bytes, and a quaternion wxyz in bytes, (byte - 128) / 128. Axes are those of the PLY.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from drgs.codecs.codec import Codec
from drgs.codecs.values import assembled, check_count, dc_of_colors, log_of_scales, logits_of_bytes
from drgs.ellipsoids import Y_00, Gaussians

_log = logging.getLogger(__name__)

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


def encode_splat(g: Gaussians) -> bytes:
    """A .splat file of Gaussians in the axes of PLY files; SH above degree 0 and features are left out.

    The Gaussians that show most come first, by volume times opacity, as viewers that draw while they load want it.
    Values round to the nearest byte (antimatter15's own writer cuts digits off).

    Raises:
        ValueError: If there are none (readers take that for a file that is cut), or a scale is no float32.
    """
    if not len(g):
        raise ValueError("save_gaussians: .splat must hold at least one Gaussian, got none; write a PLY")
    if g.sh_degree:
        _log.warning("SPLAT: left out SH above degree 0, there is no room")
    log_scales = g.log_scales.numpy().astype(np.float64)
    # float64: a logit that was read from a byte must go back to that byte.
    opacities = g.logit_opacities.double().sigmoid().numpy()
    order = np.argsort(-(log_scales.sum(1) + np.log(np.maximum(opacities, 1e-300))), kind="stable")
    with np.errstate(over="ignore", under="ignore"):
        scales = np.exp(log_scales).astype(np.float32)
    if not np.isfinite(scales).all():
        raise ValueError("save_gaussians: .splat must have scales up to 3.4e38, got larger ones; write a PLY")
    colors = g.sh.numpy()[:, 0].astype(np.float64) * Y_00 + 0.5
    outside = int(((colors < -0.5 / 255) | (colors > 255.5 / 255)).sum())
    if outside:
        _log.warning("SPLAT: %d colors were out of its range and went to its end", outside)
    q = g.quats.numpy().astype(np.float64)
    q = q / np.abs(q).max(axis=1, keepdims=True)  # first, so that no square under- or overflows
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    rows = np.empty(len(g), _ROW)
    rows["mean"] = g.means.numpy()
    rows["scale"] = scales
    rows["color"] = np.clip(np.rint(255 * colors), 0, 255)
    rows["opacity"] = np.rint(255 * opacities)
    rows["quat"] = np.clip(np.rint(128 * q + 128), 0, 255)
    return rows[order].tobytes()


SPLAT = Codec(".splat", load_splat, encode=encode_splat)
