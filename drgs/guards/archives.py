"""The parts of a file that torch writes, compared with the file before torch reads it."""

from __future__ import annotations

import zipfile
from pathlib import Path

__all__ = ["check_archive"]

_SHOWN = 120  # characters of a part's name


def check_archive(path: Path) -> None:
    """Refuse a file of `torch.save` that ends early, or has parts that are compressed or claim more than the file.

    Mapped, the bytes of compressed parts would be taken for numbers; torch allocates what a part claims.
    """
    size = path.stat().st_size
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
    except Exception:  # zipfile raises whatever the damage leads to
        raise ValueError(f"{path}: must be a whole file, got one without its index; copy it again") from None
    for part in parts:
        if part.compress_type != zipfile.ZIP_STORED:
            raise ValueError(
                f"{path}: must hold tensors as they are, {part.filename[:_SHOWN]!r} is compressed; save it with "
                "torch.save"
            )
        if part.file_size > size:
            raise ValueError(
                f"{path}: must be a whole file, {part.filename[:_SHOWN]!r} claims {part.file_size} bytes of {size}; "
                "copy it again"
            )
