"""`drgs report`: the report of a fit as one HTML file."""

from __future__ import annotations

import json
import logging
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from drgs.checks.records import options_in
from drgs.commands.command_line import words_of
from drgs.commands.options import Fit, Report
from drgs.commands.values import override
from drgs.data import Dataset
from drgs.fitting.config import FitConfig
from drgs.fitting.records import FitRecord, fit_record
from drgs.fitting.renderers import own_preset
from drgs.fitting.resume import lock_run
from drgs.io.outputs import check_file
from drgs.io.run import Run
from drgs.pages.report import charts
from drgs.pages.report.page import GENERATOR
from drgs.pages.report.write import FILE, write_report

_log = logging.getLogger(__name__)


def run(args: Report) -> None:
    """`drgs report RUN`."""
    folder = Run(args.run)
    record = fit_record(folder)
    path = args.output
    if path is None or is_same_place(path, folder.path / FILE):
        path = folder.path / FILE
        lock_run(folder, "report").check([FILE])
    else:
        if path.suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"{path}: must be named *.html, which is what is written; choose another (-o)")
        check_file(path, "report", [folder.path / "config.json"], written_by(GENERATOR))
    if not charts.is_available():
        _log.warning("no charts will be drawn: matplotlib is not installed; pip install 'drgs[report]'")
    report_of(folder, path, dataset_of(record, "the report goes without the data set's cameras"))
    args.say(f"report: {path}")


def report_of(run: Run, path: Path, dataset: Dataset | None) -> None:
    """Write the page of a run.

    Args:
        run: Folder of the run.
        path: HTML file to write.
        dataset: Data set that was fitted; None where it is no longer there.
    """
    record = fit_record(run)
    command, beyond = fit_command(record.config, record.data, run.path)
    text = "The command that repeats this fit, in another folder:"
    if beyond:
        text = f"What no option says ({', '.join(beyond)}) needs a file of --config; this command says the rest:"
    if "begin" in run.config():
        text = (
            f"It began with the Gaussians of another fit, which no option says; this command begins with points. {text}"
        )
    write_report(run, path, command, text, dataset)


def is_same_place(path: Path, other: Path) -> bool:
    """Whether two paths name the same entry of the same folder; what the entry links to does not count."""
    return path.parent.resolve() / path.name == other.parent.resolve() / other.name


def dataset_of(record: FitRecord, otherwise: str) -> Dataset | None:
    """The data set of a run, for its cameras; None where it has gone, with a line that ends with what follows."""
    try:
        return record.dataset()
    except (OSError, ValueError) as error:
        _log.warning("%s; %s", str(error).partition(";")[0], otherwise)
        return None


def written_by(generator: str) -> Callable[[Path], bool]:
    """Whether a file is a page that names this generator in its first 1,000 bytes."""
    mark = f'<meta name="generator" content="{generator}">'.encode()

    def is_ours(path: Path) -> bool:
        with path.open("rb") as file:
            return mark in file.read(1000)

    return is_ours


# --------------------------------------------------------------------------------------- the command that repeats a fit


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
