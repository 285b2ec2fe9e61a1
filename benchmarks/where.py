"""Where and when a benchmark ran, where the captures are, and the units of studies of them."""

from __future__ import annotations

import argparse
import datetime
import json
import os
from collections.abc import Callable
from pathlib import Path

from drgs import runtime
from drgs.runtime import machine

__all__ = ["DATA", "ROOT", "UNITS", "add_row", "ran", "read_rows", "rows_of_runs"]

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("DRGS_DATA", ROOT.parent / "shared" / "data"))
"""Folder of the captures that people took."""
UNITS = ((0, 0), (1, 3), (2, 6))
"""(seed, index of the first held-out view): other views are held out for each seed, where a capture has no split of its
own."""


def ran() -> dict[str, str]:
    """`machine` (processor, threads, variant), `date`, and the `commit` that is checked out."""
    backend = runtime.backend()
    return {
        "machine": f"{machine.cpu_model()}, {backend.threads} threads, {backend.variant}",
        "date": datetime.date.today().isoformat(),
        "commit": machine.commit() or "unknown",
    }


def read_rows(path: Path) -> list[dict]:
    """What a study has measured so far: a JSON object a line."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def add_row(path: Path, row: dict) -> None:
    """Add a row to a study, as soon as it is there."""
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")


def rows_of_runs(path: Path, measured: Callable[[Path], dict], about: str | None) -> list[dict]:
    """The rows of a study of runs, once those that its command line names are among them.

    Args:
        path: The rows that are kept.
        measured: Makes the row of a run folder, whose name is its `run`.
        about: What --help says.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    there = {row.get("run") for row in read_rows(path)}
    for run in parser.parse_args().runs:
        if run.name not in there:
            add_row(path, measured(run))
    return read_rows(path)
