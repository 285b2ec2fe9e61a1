"""The command that repeats a fit, from what its run folder says."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

from drgs.commands.options import Fit
from drgs.fitting.config import ActiveConfig, FitConfig
from drgs.settings import RenderSettings

__all__ = ["fit_command"]


def fit_command(config: FitConfig, active: ActiveConfig | None, data: Path, output: Path) -> tuple[str, list[str]]:
    """`drgs fit ...` with every option that is not the default's.

    Args:
        config: Configuration of the fit.
        active: How views were chosen; None: it was fitted to all views.
        data: Folder of the data set.
        output: Folder of the run.
    Returns:
        The line for a shell, and the fields of `config` that no option sets, as `name=value`: these need Python.
    """
    options = {field.name: field.default for field in dataclasses.fields(Fit)}
    words = ["drgs", "fit", str(data), "-o", str(output), *_settings(config.settings)]
    beyond = []
    usual = FitConfig()
    for field in dataclasses.fields(FitConfig):
        value = getattr(config, field.name)
        if field.name == "settings":
            continue
        if field.name in options:
            words += _option(field.name, value, options[field.name])
        elif value != getattr(usual, field.name):
            beyond.append(f"{field.name}={json.dumps(value)}")
    if active is not None:
        words += ["--views", "active"]
        for field in dataclasses.fields(ActiveConfig):
            words += _option(field.name, getattr(active, field.name), options[field.name])
    return shlex.join(words), beyond


def _settings(settings: RenderSettings) -> list[str]:
    """The preset that is nearest, and what replaces its fields."""
    nearest, differences = settings.nearest_preset()
    words = [] if nearest == Fit.preset else ["--preset", nearest]
    for name, value in differences.items():
        words += ["--set", f"{name}={_value(value)}"]
    return words + _option("background", settings.background, RenderSettings.background)


def _option(name: str, value: Any, default: Any) -> list[str]:
    """The words of an option, none if it has its default."""
    if value == default:
        return []
    option = "--" + name.replace("_", "-")
    if isinstance(value, bool):
        return [option if value else "--no-" + option[2:]]
    if name in ("blocks", "test_cameras"):
        return [option, ",".join(value) or "none"]
    return [option, *(map(_value, value) if isinstance(value, tuple | list) else [_value(value)])]


def _value(value: Any) -> str:
    """A value as the command line reads it."""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, float) else str(value)
