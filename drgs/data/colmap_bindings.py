"""pycolmap, imported in one place: at import it puts its own handler on SIGTERM, which prints a C++ stack."""

import os
from pathlib import Path
from typing import Any

import pycolmap

from drgs.io import interrupts
from drgs.io.atomic import check_room

__all__ = ["opened_database", "pycolmap"]

interrupts.reinstall()


def opened_database(database: str | os.PathLike) -> Any:
    """COLMAP's database, for a `with` block; where the disk is full, even reading one ends in an error of C++.

    Raises:
        OSError: If there is no room for what SQLite writes beside a database.
    """
    check_room(Path(database).parent)
    return pycolmap.Database.open(database)
