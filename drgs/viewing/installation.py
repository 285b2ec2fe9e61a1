"""Whether viser, which the viewer needs, is installed, and what commands say where it is not. Imports nothing heavy."""

from __future__ import annotations

import importlib.util
import shlex
from pathlib import Path

_INSTALL = "pip install 'drgs[view]'"


def require_viser() -> None:
    """Raise ValueError unless viser is installed."""
    if not _has_viser():
        raise ValueError(f"view: viser must be installed, is not; {_INSTALL}")


def view_command(run: Path) -> str:
    """The command that shows a run in the browser, for a line of advice; where viser is missing, with how to get it."""
    command = f"drgs view {shlex.quote(str(run))}"
    return command if _has_viser() else f"{command} (after {_INSTALL})"


def _has_viser() -> bool:
    return importlib.util.find_spec("viser") is not None
