"""PLY files with lists, whose lengths no header has: they are read from memory, where they can claim nothing."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import BinaryIO

__all__ = ["ply_source"]

_MAX_HEADER = 1 << 18  # bytes


def ply_source(path: Path) -> BinaryIO | str:
    """What plyfile is to read: the path, which it maps; or the whole file, where it has lists.

    plyfile asks the file for as many bytes as a list claims, and a file makes room for them before it reads.
    """
    with path.open("rb") as file:
        has_lists = re.search(rb"property\s+list", file.read(_MAX_HEADER))
    return io.BytesIO(path.read_bytes()) if has_lists else str(path)
