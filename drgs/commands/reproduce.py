"""`drgs reproduce`: the paper's tables and figures, from fits that are kept."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.commands import fisher
from drgs.commands.options import Fisher
from drgs.display import tables
from drgs.display.progress import Bar
from drgs.files import SCHEMA, atomic_write, write_json
from drgs.guards.json_files import check_json, read_json
from drgs.guards.outputs import claim
from drgs.machine import commit, cpu_model
from drgs.studies.cells import run_cells
from drgs.studies.plan import StudyPlan, plan_of
from drgs.studies.results import results_page, results_rows
from drgs.studies.rows import Cell, cell_of, read_study
from drgs.studies.sheets import comparison_sheet

if TYPE_CHECKING:
    from drgs.commands.making_options import Reproduce

__all__ = ["run"]

_ROWS, _GIVEN = "rows.jsonl", "data.json"  # of all experiments in one folder: they share cells
_FIGURE = "all views"  # is given what the others choose from: no row of the sheet is the better for it


def run(args: Reproduce) -> None:
    """`drgs reproduce static -o OUT`."""
    out: Path = args.output
    claim(out, "reproduce", [_GIVEN, *(f"{args.what}.{kind}" for kind in ("md", "json", "png"))], args.data)
    _same_data(out, args.data)
    plan = plan_of(
        args.what,
        args.scale,
        out / "scenes",
        args.data,
        args.seeds,
        args.protocol,
        args.policies,
        (args.test_every, args.test_offset),
        args.lpips_weights,
    )
    say = (lambda line: None) if args.quiet else print
    for note in plan.notes:
        say(f"note: {note}")
    done = {cell_of(row) for row in read_study(out / _ROWS)}
    there = sum((plan.study.name, cell) in done for cell in plan.cells)
    say(f"{len(plan.cells)} cells, {there} of them are finished: {out / _ROWS}")
    taken, failed = run_cells(plan.study, plan.cells, out / "runs", out / _ROWS, say, progress=not args.quiet)
    rows = [row for row in read_study(out / _ROWS) if cell_of(row) in {(plan.study.name, cell) for cell in plan.cells}]
    pictures = _figures(plan, out, args) if args.figures else []
    _write(plan, rows, out, args, pictures)
    if not args.quiet:
        _print(plan, rows, out, args.what)
    if failed:
        cell, reason = next(iter(failed.items()))
        count = f"{len(failed)} of {len(plan.cells)}"
        raise ValueError(
            f"reproduce: all cells must end, {count} failed, the first, {cell.name}, with: {reason}; correct that and "
            "repeat the command, finished cells are kept"
        )


def _same_data(out: Path, given: Sequence[Path]) -> None:
    """Refuse a name that rows of this folder have of another data set, and remember those that are new."""
    path = out / _GIVEN
    known = read_json(path, "data sets by name", "restore it") if path.exists() else {}
    check_json(str(path), known, {}, "restore it")
    for folder in given:
        real = folder.resolve()
        if known.setdefault(real.name, str(real)) != str(real):
            raise ValueError(f"{out}: must be of one {real.name}, holds rows of {known[real.name]}; choose another -o")
    write_json(path, known)


def _figures(plan: StudyPlan, out: Path, args: Reproduce) -> list[tuple[str, str]]:
    """(file, what it shows) of the figures, of the first unit that has most policies' runs."""
    units: dict[tuple, dict[str, Cell]] = {}
    for cell in plan.cells:
        run = out / "runs" / plan.study.name / cell.name
        if cell.policy != _FIGURE and (run / "metrics.json").is_file():
            units.setdefault((cell.scene, cell.split, cell.camera, cell.seed), {})[cell.policy] = cell
    if not units:
        return []
    found = max(units.values(), key=len)
    folders = {label: out / "runs" / plan.study.name / cell.name for label, cell in found.items()}
    cell = next(iter(found.values()))
    with Bar("comparison sheet"):
        view = comparison_sheet(
            {plan.experiment.policies[x]: path for x, path in folders.items()}, out / f"{args.what}.png"
        )
    shown = f"{cell.scene}, {view}: what each policy's fit makes of a view that none has seen, the truth last"
    last = list(folders)[-1]
    fisher.run(
        Fisher(
            scene=folders[last],
            cameras=str(plan.study.folder(cell.scene, cell.split)),
            split="test",
            limit=1,
            maps=True,
            output=out / f"{args.what}-maps",
            preset="fast",
            quiet=True,
        )
    )
    maps = sorted((out / f"{args.what}-maps").glob("*.maps.png"))
    told = f"What moments, FisherRF and our blocks look at in a view of {cell.scene}, after `{last}`"
    return [(f"{args.what}.png", shown), *((f"{path.parent.name}/{path.name}", told) for path in maps)]


def _write(plan: StudyPlan, rows: list[dict], out: Path, args: Reproduce, pictures: list[tuple[str, str]]) -> None:
    """The page, and the same for machines."""
    made = f"`drgs reproduce {args.what} --scale {args.scale} --seeds {args.seeds} --protocol {args.protocol}`"
    where = f"Made by {made} on {cpu_model()}, {datetime.date.today()}, commit {(commit() or 'unknown')[:7]}."
    text = ["# arXiv 2512.22771, repeated", where, results_page(plan.study, plan.experiment, rows, told=plan.notes)]
    text += [f"![{told}]({name})\n\n{told}." for name, told in pictures]
    with atomic_write(out / f"{args.what}.md") as file:
        file.write(("\n\n".join(text) + "\n").encode())
    write_json(
        out / f"{args.what}.json",
        {
            "schema": SCHEMA,
            "command": "reproduce",
            "experiment": args.what,
            "scale": args.scale,
            "seeds": args.seeds,
            "cells": len(plan.cells),
            "finished": len(rows),
            "notes": list(plan.notes),
            "rows": results_rows(plan.study, plan.experiment, rows),
        },
    )


def _print(plan: StudyPlan, rows: list[dict], out: Path, what: str) -> None:
    """The means on stdout."""
    found = results_rows(plan.study, plan.experiment, rows)
    metrics = [metric for metric in plan.study.metrics if any(row[metric.key] is not None for row in found)]
    lines = [
        (
            row["name"],
            *("-" if row[m.key] is None else f"{row[m.key]:.{m.digits}f}" for m in metrics),
            f"{row['best']['units']}/{row['best']['of']}",
        )
        for row in found
    ]
    tables.show(plan.experiment.title, ("policy", *(m.title for m in metrics), "best"), lines)
    print(f"tables and figures: {out / what}.md")
