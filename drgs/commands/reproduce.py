"""`drgs reproduce`: the paper's tables and figures, from fits that are kept."""

from __future__ import annotations

import datetime
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.commands.command_line import config_fields
from drgs.commands.fisher import InformationMaps
from drgs.commands.options import Reproduce, Views
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import check_lenses, held_out_views, known_views
from drgs.display import tables
from drgs.display.progress import Bar
from drgs.fitting.config import FitConfig
from drgs.fitting.metrics import Lpips
from drgs.information.blocks import MAP_PRIOR
from drgs.information.scoring import Scoring
from drgs.io.journal import SCHEMA
from drgs.io.json_files import check_json, read_json
from drgs.io.outputs import lock_folder, write_json, write_whole
from drgs.runtime.machine import commit, cpu_model
from drgs.settings import RenderSettings
from drgs.studies.cells import Study, changed_field, run_cells
from drgs.studies.plan import StudyPlan, plan_of
from drgs.studies.results import results_page, results_rows
from drgs.studies.rows import Cell, cell_of, read_study
from drgs.studies.sheets import comparison_sheet

if TYPE_CHECKING:
    from drgs.cluster.workers import Cluster

# of all experiments in one folder: they share cells
_ROWS = "rows.jsonl"
_GIVEN = "data.json"
_FITS = "fits.json"
_FIGURE = "all views"  # is given what the others choose from: no row of the sheet is the better for it


def run(args: Reproduce) -> None:
    """`drgs reproduce static -o OUT`."""
    out: Path = args.output
    lock_folder(
        out, "reproduce", [_GIVEN, _FITS, *(f"{args.what}.{kind}" for kind in ("md", "json", "png"))], args.data
    )
    known = _data_of_rows(out, args.data)
    weights = args.lpips_weights and args.lpips_weights.resolve()
    if weights:
        Lpips(weights)  # which every fit would else find out at its end
    say = (lambda line: None) if args.quiet else print
    with args.cluster() as workers:  # before scenes are made: whether there are any
        plan = plan_of(
            args.what,
            args.scale,
            (out / "scenes").resolve(),  # workers have a working directory of their own
            args.data,
            args.seeds,
            args.protocol,
            args.policies,
            (args.test_every, args.test_offset),
            weights,
            {} if args.config is None else config_fields(args.config, {"policy": None}),  # each cell has its own
        )
        fits = _fits_of_rows(out, plan.study)
        write_json(out / _GIVEN, known)
        write_json(out / _FITS, fits)
        for note in plan.notes:
            say(f"note: {note}")
        done = {cell_of(row) for row in read_study(out / _ROWS)}
        there = sum((plan.study.name, cell) in done for cell in plan.cells)
        say(f"{len(plan.cells)} cells, {there} of them are finished: {out / _ROWS}")
        where = plan.study, plan.cells, out / "runs", out / _ROWS, say
        taken, failed = run_cells(*where, not args.quiet) if workers is None else _run_on(workers, *where)
    if taken:
        say(f"{len(taken)} cells are with other processes: repeat the command when these have ended")
    rows = [row for row in read_study(out / _ROWS) if cell_of(row) in {(plan.study.name, cell) for cell in plan.cells}]
    _write(plan, rows, out, args, [])  # first: whatever becomes of the figures, the tables are there
    if args.figures:
        _write(plan, rows, out, args, _figures(plan, out, args))
    if not args.quiet:
        _print(plan, rows, out, args.what)
    if failed:
        cell, reason = next(iter(failed.items()))
        count = f"{len(failed)} of {len(plan.cells)}"
        raise ValueError(
            f"reproduce: all cells must end, {count} failed, the first, {cell.name}, with: {reason}; correct that and "
            "repeat the command, finished cells are kept"
        )


def _run_on(workers: Cluster, *where: Any) -> tuple[list[Cell], dict[Cell, str]]:
    """`run_cells` on workers; loads Dask."""
    from drgs.cluster.cells import run_cells_on

    return run_cells_on(workers, *where)


def _data_of_rows(out: Path, given: Sequence[Path]) -> dict[str, str]:
    """Name -> data set of a folder's rows and of those that are given; refuses a name that rows have of another one."""
    path = out / _GIVEN
    known = read_json(path, "data sets by name", "restore it") if path.exists() else {}
    check_json(str(path), known, {}, "restore it")
    for folder in given:
        real = folder.resolve()
        if known.setdefault(real.name, str(real)) != str(real):
            raise ValueError(f"{out}: must be of one {real.name}, holds rows of {known[real.name]}; choose another -o")
    return known


def _fits_of_rows(out: Path, study: Study) -> dict[str, Any]:
    """Study -> configuration of its fits, of a folder's rows and of this study; refuses another one than its rows have.

    A folder without the file goes on: its rows may be of a time before there was one, or copied.
    """
    path = out / _FITS
    advice = "restore it, or choose another -o"
    known = read_json(path, "configurations by study", advice) if path.exists() else {}
    check_json(str(path), known, {}, advice)
    if study.name in known:
        try:
            was = FitConfig.from_json(known[study.name])
        except (ValueError, NotImplementedError) as error:
            raise ValueError(f"{path}: {error}; {advice}") from None
        if change := changed_field(study.fit, was):
            name, now, before = change
            raise ValueError(
                f"{out}: must be of one configuration of {study.name}, {name} was {before!r} and is {now!r}; choose "
                "another -o"
            )
    return {**known, study.name: study.fit.to_json()}


def _figures(plan: StudyPlan, out: Path, args: Reproduce) -> list[tuple[str, str]]:
    """(file, caption) of the figures, of the first unit that has most policies' runs."""
    units: dict[tuple, dict[str, Cell]] = {}
    for cell in plan.cells:
        run = out / "runs" / plan.study.name / cell.name
        if cell.policy != _FIGURE and (run / "metrics.json").is_file():
            units.setdefault((cell.scene, cell.split, cell.camera, cell.seed), {})[cell.policy] = cell
    if not units:
        return []
    cells = max(units.values(), key=len)
    folders = {label: out / "runs" / plan.study.name / cell.name for label, cell in cells.items()}
    cell = next(iter(cells.values()))
    with Bar("comparison sheet"):
        view = comparison_sheet(
            {plan.experiment.policies[x]: path for x, path in folders.items()}, out / f"{args.what}.png"
        )
    shown = f"{cell.scene}, {view}: what each policy's fit makes of a view that none has seen, the truth last"
    last = list(folders)[-1]
    maps = _maps(folders[last], out / f"{args.what}-maps")
    caption = f"What moments, FisherRF and our blocks look at in a view of {cell.scene}, after `{last}`"
    return [(f"{args.what}.png", shown), *((f"{path.parent.name}/{path.name}", caption) for path in maps)]


def _maps(run: Path, folder: Path) -> list[Path]:
    """Write maps by which policies score the first held-out view of a run; returns their files."""
    given = SceneInput.at(run)
    assert given.record is not None
    settings = RenderSettings.preset("fast", background=given.record.config.settings.background)
    reading = Views()
    known = known_views(None, reading, given, given.keeps_lenses())
    views = held_out_views(reading, given, known)[:1]
    check_lenses("reproduce", settings, [*known.cameras, *views])
    scoring = given.scoring(Scoring(), settings)
    output = lock_folder(folder, "fisher", ["information.safetensors", "fisher.json"], [run])
    maps = InformationMaps(run, given, scoring, MAP_PRIOR, known, views, f"{run} (test)", compare=True)
    _, rows = maps.write(output)
    # Not what another data set has left there.
    return [folder / name for row in rows for name in row.files if name.endswith(".maps.png")]


def _write(plan: StudyPlan, rows: list[dict], out: Path, args: Reproduce, pictures: list[tuple[str, str]]) -> None:
    """The page, and the same for machines."""
    where = (
        f"Made by `{_command(args)}` on {cpu_model()}, {datetime.date.today()}, commit {(commit() or 'unknown')[:7]}."
    )
    text = ["# Policies, compared", where, results_page(plan.study, plan.experiment, rows, remarks=plan.notes)]
    text += [f"![{caption}]({name})\n\n{caption}." for name, caption in pictures]
    write_whole(out / f"{args.what}.md", ("\n\n".join(text) + "\n").encode())
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


def _command(args: Reproduce) -> str:
    """The line for a shell that makes the same cells."""
    words = ["drgs", "reproduce", args.what, "-o", str(args.output), "--scale", args.scale, "--seeds", str(args.seeds)]
    words += ["--protocol", args.protocol]
    for folder in args.data:
        words += ["--data", str(folder)]
    for label in args.policies:
        words += ["--policy", label]
    if args.data:
        words += ["--test-every", str(args.test_every), "--test-offset", str(args.test_offset)]
    if args.config:
        words += ["--config", str(args.config)]
    if args.lpips_weights:
        words += ["--lpips-weights", str(args.lpips_weights)]
    return shlex.join(words if args.figures else [*words, "--no-figures"])


def _print(plan: StudyPlan, rows: list[dict], out: Path, what: str) -> None:
    """The means on stdout."""
    results = results_rows(plan.study, plan.experiment, rows)
    metrics = [metric for metric in plan.study.metrics if any(row[metric.key] is not None for row in results)]
    lines = [
        (
            row["name"],
            *("-" if row[m.key] is None else f"{row[m.key]:.{m.digits}f}" for m in metrics),
            f"{row['best']['units']}/{row['best']['of']}",
        )
        for row in results
    ]
    tables.show(plan.experiment.title, ("policy", *(m.title for m in metrics), "best"), lines)
    print(f"tables and figures: {out / what}.md")
