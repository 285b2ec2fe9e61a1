"""The command that repeats a fit, from what its run folder says."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

from drgs.commands.overrides import override
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.fitting.renderers import AUTO, own_preset
from drgs.settings import RenderSettings

__all__ = ["fit_command"]


def fit_command(config: FitConfig, data: Path, output: Path) -> tuple[str, list[str]]:
    """`drgs fit ...` with every option that is not the default's.

    Args:
        config: Configuration of the fit.
        data: Folder of the data set.
        output: Folder of the run.
    Returns:
        The line for a shell, and the fields that no option sets, as `name=value`: these need a file (--config).
    """
    usual = FitConfig()
    words = ["drgs", "fit", str(data), "-o", str(output), *_settings(config.settings, config.renderers)]
    for name in ("max_steps", "seed", "sh_degree", "deterministic"):
        words += _option(name, getattr(config, name), getattr(usual, name))
    for part in ("data", "density", "rates", "loss", "features", "motion", "saving"):
        mine = getattr(config, part)
        for field in dataclasses.fields(mine):
            words += _option(field.name, getattr(mine, field.name), field.default)
    beyond = []
    if (selection := config.selection) is not None:
        words += ["--views", "active"]
        fields = selection.flat()
        carried = {name: fields.pop(name) for name in ("weights", "groups")}
        carried["prior.groups"] = dict(selection.scoring.prior.groups) if selection.scoring.prior else {}
        beyond = [f"{name}={json.dumps(value)}" for name, value in carried.items() if value]
        default = SelectionConfig().flat()
        for name, value in fields.items():
            words += _option(name, value, default[name])
    return shlex.join(words), beyond


def _settings(settings: RenderSettings, renderers: tuple[str, ...]) -> list[str]:
    """The renderers, the preset that is nearest, and what replaces its fields."""
    nearest, differences = settings.nearest_preset()
    words = [] if nearest == own_preset(renderers) else ["--preset", nearest]
    for name, value in differences.items():
        words += ["--set", override(name, value)]
    words = [*([] if renderers == AUTO else ["--for", ",".join(renderers)]), *words]
    return [*words, *_option("background", settings.background, None)]  # photographs may suggest another one


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
