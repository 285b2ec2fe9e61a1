"""Masks for structure from motion: where features may be detected, and the pixels that replace the rest."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.data.images import image_size, read_image, unit_range
from drgs.data.masks import MASK_KEEP, mask_file, read_mask
from drgs.data.resampling import nearest_resized

if TYPE_CHECKING:
    from drgs.sfm.matching import Progress

ALPHA_MASKS = "alpha"  # in place of a folder: the photographs' own alpha channel
_SHOWN = 3  # photographs without a mask that a message names


def find_masks(photos: list[Path], masks: str | os.PathLike) -> list[Path]:
    """Where the mask of each photograph is: its mask in a folder, or, of `"alpha"`, the photograph itself.

    No mask is decoded.

    Raises:
        FileNotFoundError: No such folder, or a photograph has no mask there.
        ValueError: a folder without masks.
    """
    if masks == ALPHA_MASKS:
        return photos
    folder = Path(masks)
    if not folder.is_dir():
        kind = "a file" if folder.is_file() else "none"
        raise FileNotFoundError(
            f"{folder}: --masks must be a folder of masks or the word {ALPHA_MASKS}, found {kind}; check the path"
        )
    found = [mask_file(folder, photo.name) for photo in photos]
    if folder.resolve() == photos[0].parent.resolve():  # where NAME.png may be the photograph itself
        found = [file if file and file.name != photo.name else None for photo, file in zip(photos, found, strict=True)]
    missing = [photo.name for photo, file in zip(photos, found, strict=True) if file is None]
    example = f"{photos[0].name}.png or {photos[0].with_suffix('.png').name}"
    if len(missing) == len(photos):
        raise ValueError(
            f"{folder}: must hold a mask of every photo, named as {example}, found none; rename them, or name "
            "another folder"
        )
    if missing:
        shown = ", ".join(missing[:_SHOWN]) + (", ..." if len(missing) > _SHOWN else "")
        raise FileNotFoundError(
            f"{folder}: must hold a mask of every photo, named as {example}, has none of {len(missing)} of "
            f"{len(photos)} ({shown}); add them, or move these photos away"
        )
    return [file for file in found if file is not None]


def _feature_mask(photo: Path, mask: Path) -> np.ndarray:
    """(H,W) uint8 of the photograph's size: 255 where features may lie, else 0.

    Args:
        photo: The photograph.
        mask: Its mask; the photograph itself for its alpha channel.
    Raises:
        ValueError: No alpha channel, another shape than the photograph's, or nothing is kept.
    """
    if mask == photo:
        raw = read_image(photo)
        if raw.ndim != 3 or raw.shape[2] != 4:
            raise ValueError(
                f"{photo}: must have an alpha channel for --masks {ALPHA_MASKS}, has none; save it as a PNG with "
                "transparency, or name a folder of masks"
            )
        weights = unit_range(raw[..., 3], photo)
    else:
        weights = nearest_resized(read_mask(mask), image_size(photo), mask)
    kept = weights >= MASK_KEEP
    if not kept.any():
        raise ValueError(
            f"{mask}: must keep something of its photo (white), is black all over; draw it again, or move the photo "
            "away"
        )
    return np.where(kept, np.uint8(255), np.uint8(0))


def _masked_photo(photo: Path, kept: np.ndarray) -> np.ndarray:
    """(H,W) or (H,W,3) of the photograph's own bit depth: its mean color where nothing is kept.

    Detectors then find no features there, of which they keep the strongest alone, and descriptors near the outline hold
    nothing of a background that is another one in the next photograph.

    Args:
        photo: The photograph.
        kept: (H,W) uint8, 0 where nothing is kept, as `_feature_mask` makes it.
    """
    pixels = read_image(photo)
    pixels = np.ascontiguousarray(pixels[..., :3]) if pixels.ndim == 3 else pixels
    # The mean is a float64; the photograph keeps its own 8 or 16 bits.
    pixels[kept == 0] = pixels[kept > 0].mean(axis=0).astype(pixels.dtype)
    return pixels


def write_masked_photos(image_dir: Path, names: list[str], masks: list[Path], target: Path, report: Progress) -> None:
    """Write what COLMAP detects features in: `photos` without their surroundings, and `masks` of their sizes, black or
    white, `NAME.EXT.png`.

    Args:
        image_dir, names: The photographs.
        masks: Their masks, as `find_masks` lists them.
        target: Folder that gets both folders.
        report: Called with ("masks", done, total).
    """
    import cv2

    (target / "photos").mkdir()
    (target / "masks").mkdir()
    for done, (name, mask) in enumerate(zip(names, masks, strict=True)):
        report("masks", done, len(names))
        kept = _feature_mask(image_dir / name, mask)
        pixels = _masked_photo(image_dir / name, kept)
        # OpenCV writes blue first.
        pixels = pixels[..., ::-1] if pixels.ndim == 3 else pixels
        for file, image in ((target / "masks" / f"{name}.png", kept), (target / "photos" / name, pixels)):
            suffix = file.suffix.lower()
            if image.dtype != np.uint8:  # whatever its name: COLMAP goes by the content, and JPEG has 8 bits
                suffix = ".png"
            elif suffix not in (".png", ".tif", ".tiff", ".bmp"):  # COLMAP decodes no WebP
                suffix = ".jpg"
            best = [cv2.IMWRITE_JPEG_QUALITY, 100] if suffix == ".jpg" else []
            file.write_bytes(cv2.imencode(suffix, image, best)[1].tobytes())
    report("masks", len(names), len(names))
