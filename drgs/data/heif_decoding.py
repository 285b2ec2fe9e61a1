"""HEIC and AVIF with Pillow (libheif, libavif), in a process of its own (reader_process.py): files come from elsewhere.

The container says how the stored pixels are turned and mirrored to be shown, and that is part of the photograph: pixels
are those that are shown, and EXIF's own orientation, which repeats it, is left out. (A JPEG has EXIF's orientation
alone, and its pixels are taken as they are stored.)
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
from PIL import Image, ImageOps, UnidentifiedImageError

from drgs.checks.arguments import said
from drgs.data.hdr import HDR, in_srgb
from drgs.data.reader_process import serve
from drgs.runtime import memory

_SIDE = 1 << 15  # pixels, libheif's own limit; a compressed byte stands for any number of them
_BYTES = 12  # a pixel: planes as decoded, interleaved, turned, and the copy that is answered
# EXIF: the tag of the orientation, the header in a JPEG, and the bytes that a JPEG segment holds at most
_ORIENTATION = 0x0112
_EXIF = b"Exif\0\0"
_MAX_EXIF_BYTES = 65_533
_COPY = "it is damaged, or no such photograph: copy it again, or convert it to JPEG"

Image.MAX_IMAGE_PIXELS = None  # bounded here, and phones make 200 million
pillow_heif.register_heif_opener(thumbnails=False, depth_images=False, aux_images=False)


def size(path: Path, report: Any) -> list[int]:
    """[width, height] as it is shown, by the header.

    Raises:
        ValueError: None, or too large.
    """
    with _opened(path) as image:
        width, height = image.size
        is_turned = image.format == "AVIF" and image.getexif().get(_ORIENTATION, 1) >= 5  # by a quarter
        return [height, width] if is_turned else [width, height]


def pixels(path: Path, report: Any) -> np.ndarray:
    """(H, W), (H, W, 3) or (H, W, 4) uint8, as it is shown.

    Raises:
        ValueError: Damaged, or too large.
    """
    return np.asarray(_shown(path))


def encoded_jpeg(path: Path, quality: int, report: Any) -> np.ndarray:
    """The bytes of a JPEG, uint8: the photograph as it is shown and without alpha, with its EXIF.

    Raises:
        ValueError: Damaged, or too large.
    """
    image = _shown(path)
    exif = image.info.get("exif") or b""  # None of an HEIC without, as messengers make it
    if exif and not exif.startswith(_EXIF):
        exif = _EXIF + exif
    exif = exif if len(exif) <= _MAX_EXIF_BYTES else b""
    encoded = io.BytesIO()
    image.convert("RGB").save(encoded, "JPEG", quality=quality, subsampling=0, exif=exif)
    return np.frombuffer(encoded.getbuffer(), np.uint8)


def _shown(path: Path) -> Image.Image:
    """The photograph as it is shown, in 8 bits; its EXIF states no orientation, or that there is nothing to turn."""
    with _opened(path) as image:
        try:
            # libheif turns; for AVIF, Pillow puts what the container says in the place of EXIF's own.
            shown = ImageOps.exif_transpose(image) if image.format == "AVIF" else image.copy()
        except Exception as error:  # decoders raise whatever the damage leads to
            raise _damaged(path, error) from None
    if shown.mode not in ("L", "RGB", "RGBA"):
        shown = shown.convert("RGBA" if shown.has_transparency_data else "RGB")
    transfer = (shown.info.get("nclx_profile") or {}).get("transfer_characteristics")  # Pillow reports none of AVIF
    if transfer in HDR:
        converted = Image.fromarray(in_srgb(257 * np.asarray(shown.convert("RGB"), np.uint16), transfer))
        converted.info = shown.info
        return converted
    return shown


def _opened(path: Path) -> Image.Image:
    """The photograph, whose header has been read and is within bounds."""
    try:
        image = Image.open(path, formats=("HEIF", "AVIF"))
    except FileNotFoundError:
        raise
    except UnidentifiedImageError:
        raise ValueError(f"{path}: must be an HEIC or AVIF photograph, could not be opened; {_COPY}") from None
    except Exception as error:
        raise _damaged(path, error) from None
    width, height = image.size
    if not (1 <= width <= _SIDE and 1 <= height <= _SIDE):
        raise ValueError(f"{path}: must have sides of 1 to {_SIDE} pixels, its header says {width}x{height}; {_COPY}")
    memory.require(f"{path}", _BYTES * width * height, f"its {width}x{height} pixels", "reduce the image")
    return image


def _damaged(path: Path, error: Exception) -> ValueError:
    return ValueError(f"{path}: must be a whole HEIC or AVIF photograph, got {said(error)}; {_COPY}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # of Pillow about EXIF
    serve({"size": size, "pixels": pixels, "jpeg": encoded_jpeg})
