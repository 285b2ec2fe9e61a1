"""The command that repeats a fit, from what its run folder says."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

from drgs.commands.command_line import words_of
from drgs.commands.options import Fit
from drgs.commands.values import override
from drgs.fitting.config import FitConfig
from drgs.fitting.renderers import own_preset
from drgs.guards.records import options_in

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
    options = options_in(Fit)
    nearest, differences = config.settings.nearest_preset()
    given: dict[str, Any] = {"background": config.settings.background}  # photographs may suggest another one
    if nearest != own_preset(config.renderers):
        given["preset"] = nearest
    if config.selection is not None:
        given["views"] = "active"
    for name, option in options.items():
        if option.path[0] == "fit":
            value: Any = config
            for step in option.path[1:]:
                value = None if value is None else getattr(value, step)
            if value is not None:
                given[name] = value
    changed = {name: value for name, value in given.items() if value != options[name].default}
    beyond = [f"{name}={json.dumps(x)}" for name, x in changed.items() if options[name].spec.file_only]
    words = ["drgs", "fit", str(data), "-o", str(output)]
    for name, value in changed.items():
        if not options[name].spec.file_only:
            words += words_of(options[name], value)
    for name, value in differences.items():
        words += [options["overrides"].flag, override(name, value)]
    return shlex.join(words), beyond
