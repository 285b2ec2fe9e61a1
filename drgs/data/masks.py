"""Masks of photographs: images beside them, found by name, that say where a photograph counts, white is kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drgs.data.images import IMAGE_SUFFIXES, read_image, unit_range
from drgs.io.foreign import is_file

MASK_KEEP = 0.5
"""Weight in a mask from which on a pixel counts."""


def mask_file(masks: Path, name: str) -> Path | None:
    """The mask of an image in a folder: COLMAP's own `NAME.EXT.png`, or `NAME.png`, else of another suffix of images,
    as `NAME.jpg`; None without one.
    """
    for suffix in (*IMAGE_SUFFIXES, *(x.upper() for x in IMAGE_SUFFIXES)):
        for candidate in (masks / f"{name}{suffix}", (masks / name).with_suffix(suffix)):
            if is_file(candidate):
                return candidate
    return None


def read_mask(path: Path) -> np.ndarray:
    """(H,W) float32 in [0,1] of a mask as stored: alpha, if it is not opaque throughout, else the first channel; of a
    JPEG 0 or 1, whose compression leaves neither black nor white.
    """
    raw = read_image(path)
    if raw.ndim == 3:
        # Editors add an alpha channel to black and white masks, which then says nothing.
        opaque = np.iinfo(raw.dtype).max if raw.dtype.kind in "iu" else 1
        raw = raw[..., 3] if raw.shape[2] == 4 and raw[..., 3].min() < opaque else raw[..., 0]
    if path.suffix.lower() in (".jpg", ".jpeg"):
        return (raw >= MASK_KEEP * np.iinfo(raw.dtype).max).astype(np.float32)
    # Masks stored as 0 and 1 in 8 bits would otherwise be nearly black.
    return raw.astype(np.float32) if raw.max() <= 1 else unit_range(raw, path)
