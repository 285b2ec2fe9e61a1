"""`drgs report`: what a fit looked like, as one HTML file."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.commands.repeat import fit_command
from drgs.fitting.frames import load_dataset
from drgs.fitting.records import fit_record
from drgs.fitting.resume import lock_run
from drgs.io.outputs import check_file
from drgs.io.run import Run
from drgs.report.page import GENERATOR
from drgs.report.write import FILE, write_report

if TYPE_CHECKING:
    from drgs.commands.options import Report
    from drgs.data import Dataset

__all__ = ["report_of", "run"]

_log = logging.getLogger(__name__)


def run(args: Report) -> None:
    """`drgs report RUN`."""
    folder = Run(args.run)
    record = fit_record(folder)
    path = args.output
    if path is None:
        path = folder.path / FILE
        lock_run(folder, "report").check([FILE])
    else:
        if path.suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"{path}: must be named *.html, which is what is written; choose another (-o)")
        check_file(path, "report", [folder.path / "config.json"], is_report)
    try:
        dataset = load_dataset(record.data, record.config, lazy=True, points=False, semantics=False)
        dataset = record.with_refined_poses(dataset)
    except (OSError, ValueError) as error:
        _log.warning("%s; the report goes without the data set's cameras", str(error).partition(";")[0])
        dataset = None
    report_of(folder, path, dataset)
    if not args.quiet:
        print(f"report: {path}")


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


def is_report(path: Path) -> bool:
    """Whether a file says that `drgs report` wrote it."""
    with path.open("rb") as file:
        return f'<meta name="generator" content="{GENERATOR}">'.encode() in file.read(1000)
