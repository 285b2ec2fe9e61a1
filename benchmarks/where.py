"""Where and when a benchmark ran: what stands beside every result."""

from __future__ import annotations

import datetime
import subprocess
from pathlib import Path

from drgs import runtime

__all__ = ["ran"]


def ran() -> dict[str, str]:
    """`machine` (processor, threads, variant), `date`, and the `commit` that is checked out."""
    backend = runtime.backend()
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True
    )
    return {
        "machine": f"{runtime.info().get('cpu', 'CPU')}, {backend.threads} threads, {backend.variant}",
        "date": datetime.date.today().isoformat(),
        "commit": commit.stdout.strip(),
    }
