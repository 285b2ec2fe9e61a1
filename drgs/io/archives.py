"""Files of `torch.save`: zip archives whose entries are compared with the file's size before torch reads them."""

from __future__ import annotations

import zipfile
from pathlib import Path

_SHOWN = 120  # characters of an entry's name in a message


def check_archive(path: Path) -> None:
    """Raise ValueError for a file that ends early, or has entries that are compressed or claim more than the file.

    Mapped, the bytes of a compressed entry would be taken for numbers; torch allocates what an entry claims.
    """
    size = path.stat().st_size
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except Exception:  # zipfile raises whatever the damage leads to
        raise ValueError(f"{path}: must be a whole file, got one without its index; copy it again") from None
    for entry in entries:
        if entry.compress_type != zipfile.ZIP_STORED:
            raise ValueError(
                f"{path}: must hold tensors as they are, {entry.filename[:_SHOWN]!r} is compressed; save it with "
                "torch.save"
            )
        if entry.file_size > size:
            raise ValueError(
                f"{path}: must be a whole file, {entry.filename[:_SHOWN]!r} claims {entry.file_size} bytes of {size}; "
                "copy it again"
            )
