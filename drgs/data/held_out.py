"""`held_out.json` beside a data set: names of the views that are held out, whatever others join them later."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.io.journal import SCHEMA
from drgs.io.json_files import check_json, read_json
from drgs.io.outputs import write_json

if TYPE_CHECKING:
    from drgs.data.dataset import Dataset

__all__ = ["HELD_OUT", "apply_held_out", "write_held_out"]

HELD_OUT = "held_out.json"
"""File of a data set that says which of its views are held out."""
_ADVICE = "restore the file, or delete it to hold out every 8th view"


def write_held_out(folder: str | os.PathLike, names: Iterable[str], command: str) -> None:
    """Say which views of a data set are held out from now on.

    Args:
        folder: The data set.
        names: Names of these views.
        command: Name of the command that says so.
    """
    write_json(Path(folder) / HELD_OUT, {"schema": SCHEMA, "command": command, "test": sorted(names)})


def apply_held_out(dataset: Dataset) -> None:
    """Note in the views of a data set what its `held_out.json` says, if it has one and its own files say nothing.

    Raises:
        ValueError: If the file is damaged, or names a view that is not there.
    """
    file = Path(dataset.path) / HELD_OUT
    views = [*dataset.views, *dataset.absent]
    if not file.is_file() or any(view.split for view in views):
        return
    value = read_json(file, "a list of held-out views", _ADVICE)
    check_json(str(file), value, {"test": [str]}, _ADVICE)
    if missing := sorted(set(value["test"]) - {view.name for view in views}):
        raise ValueError(f"{file}: test must name views of the data set, got {missing[0]!r}; {_ADVICE}")
    for view in views:
        view.split = "test" if view.name in value["test"] else "train"
