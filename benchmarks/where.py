"""Where and when a benchmark ran, where the captures are, and the units of studies of them."""

from __future__ import annotations

import datetime
import json
import os
from pathlib import Path

from drgs import runtime
from drgs.runtime import machine

__all__ = ["DATA", "ROOT", "UNITS", "add_row", "ran", "read_rows"]

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
