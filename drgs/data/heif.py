"""HEIC and AVIF photographs, as phones make them, decoded by a process of its own (heif_decoding.py)."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np

from drgs.data.reader_process import Child

__all__ = ["HEIF_SUFFIXES", "MissingReader", "heif_size", "is_heif", "heif_as_jpeg", "read_heif"]

HEIF_SUFFIXES = (".heic", ".heif", ".hif", ".avif")
_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"avif", b"avis")

_decoder = Child("drgs.data.heif_decoding", "a photograph that can be decoded", "convert it to JPEG, or leave it out")


class MissingReader(ValueError):
    """The package that reads a photograph is missing: nothing is wrong with the photograph."""


def is_heif(path: Path) -> bool:
    """Whether a file begins as HEIC or AVIF, whatever it is called: phones also name them .jpg."""
    with path.open("rb") as file:
        head = file.read(12)
    return head[4:8] == b"ftyp" and head[8:] in _BRANDS


def heif_size(path: Path) -> tuple[int, int]:
    """(width, height) of the photograph as it is shown; no pixel is decoded.

    Raises:
        ValueError: damaged, too large, or pillow-heif is missing.
    """
    _need_library(path)
    width, height = _decoder.ask("size", path)
    return width, height


def read_heif(path: Path) -> np.ndarray:
    """(H, W), (H, W, 3) or (H, W, 4) uint8, RGB: the photograph as it is shown. Of 10 bits and more, the highest 8.

    Raises:
        ValueError: damaged, too large, or pillow-heif is missing.
    """
    _need_library(path)
    return _decoder.ask("pixels", path)


def heif_as_jpeg(path: Path, quality: int) -> bytes:
    """The photograph as it is shown as JPEG, with its EXIF, for a library that reads nothing else.

    Args:
        path: HEIC or AVIF.
        quality: 1 to 100.
    Raises:
        ValueError: As `read_heif`.
    """
    _need_library(path)
    return _decoder.ask("jpeg", path, quality).tobytes()


def _need_library(path: Path) -> None:
    """Raise ValueError without pillow-heif."""
    if importlib.util.find_spec("pillow_heif") is None:
        raise MissingReader(
            f"{path}: HEIC and AVIF photographs need the package pillow-heif, which is missing; "
            "pip install 'drgs[heic]', or convert them to JPEG"
        )
