"""Studies of active fits as cells: one fit each, in a run folder of its own, one row of a JSON-lines file when done.

A study is its list of cells and the file of their rows. Any number of processes may work through the same list side by
side: the lock of the run folder says who has a cell, a finished folder is not fitted again, and that of a process that
was killed is resumed from its checkpoint. `drgs.studies.tables` makes the tables.
"""

from __future__ import annotations

import dataclasses
import logging
import shlex
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drgs.data import Dataset
from drgs.fitting.active import SELECTION, ActiveViews
from drgs.fitting.config import FitConfig, SelectionConfig, Start
from drgs.fitting.evaluation import evaluate_run
from drgs.fitting.frames import load_dataset
from drgs.fitting.metrics import Lpips
from drgs.fitting.records import fit_record
from drgs.fitting.resume import lock_run
from drgs.fitting.timetable import VIEWS_TO_ADD
from drgs.io.atomic import is_full
from drgs.io.json_files import read_json
from drgs.io.locks import InUse
from drgs.io.run import Run
from drgs.runtime.machine import forget_peak_memory
from drgs.studies.protocols import PROTOCOLS
from drgs.studies.rows import Cell, append_row, is_done, read_study
from drgs.studies.statistics import decided
from drgs.train import fit

__all__ = [
    "FAILURES",
    "Metric",
    "Study",
    "changed_field",
    "distinct_seeds",
    "out_of_race",
    "result_line",
    "run_cell",
    "run_cells",
]

FAILURES = (ValueError, OSError, ArithmeticError, RuntimeError, MemoryError)
"""What a fit raises that cannot be done; the next one may do."""

_Unit = tuple[str, tuple[int, int] | str, Start, str, int]

_log = logging.getLogger(__name__)
_ADVICE = "move the run folder away, to have it fitted again"
_RETRY_SECONDS = 5.0  # seconds between two looks for a data set that another process makes; chosen


@dataclasses.dataclass(frozen=True)
class Metric:
    """A number of metrics.json, averaged over the test views there.

    Attributes:
        key: Its name in rows.
        title: Heading in tables.
        digits: Digits behind the decimal point in tables.
        larger: Whether larger is better.
        path: Keys that lead to it in metrics.json; default ("mean", key).
        optional: Not every data set has what it takes: where a key is missing, the number is None.
    """

    key: str
    title: str
    digits: int = 3
    larger: bool = True
    path: tuple[str, ...] = ()
    optional: bool = False

    def read(self, metrics: Mapping[str, Any]) -> float | None:
        """The number in a metrics.json; None where it could not be computed.

        Raises:
            ValueError: If there is no such key.
        """
        value: Any = metrics
        for key in self.path or ("mean", self.key):
            if not isinstance(value, Mapping) or key not in value:
                if self.optional:
                    return None
                raise ValueError(f"metrics.json: must have {'.'.join(self.path or ('mean', self.key))}, has no {key!r}")
            value = value[key]
        return None if value is None else float(value)


@dataclasses.dataclass(frozen=True)
class Study:
    """What its cells have in common.

    Attributes:
        name: Name of the study and its scale; in every row, and the folder of its runs.
        folder: Scene and split -> folder of the data set, made where it is not there yet.
        policies: Label -> fields of `SelectionConfig` and its scoring; None: all views are known from the start, and
            none is picked.
        fit: What every fit does, with a selection; seed, split, initial points, start and policy are the cell's.
        metrics: What a row holds.
        reference: Label of the policy that the others are compared with.
        comparisons: More pairs (policy, reference) to be compared.
        lpips: Weights of a backbone: every row then has LPIPS, those of finished runs, too.
        race: A policy has no more fits once its difference from the reference is known (`drgs.studies.statistics`).
        of_one_camera: Fields of the selection in cells without a held-out camera, where things move: the views of one
            camera that moves about and films.
    """

    name: str
    folder: Callable[[str, tuple[int, int]], Path]
    policies: Mapping[str, Mapping[str, Any] | None]
    fit: FitConfig
    metrics: tuple[Metric, ...]
    reference: str
    comparisons: tuple[tuple[str, str], ...] = ()
    lpips: Path | None = None
    race: bool = False
    of_one_camera: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def measured_later(self) -> tuple[str, ...]:
        """Metrics that finished cells may lack."""
        return () if self.lpips is None else ("lpips",)

    def cells(self, units: Iterable[_Unit]) -> list[Cell]:
        """The cells of units (scene, split or camera held out, start, protocol, seed), units outermost: what is there
        at any time is a complete study of fewer units, one unit aside for each process.
        """
        cells = []
        for scene, held_out, start, protocol, seed in units:
            split, camera = ((0, 0), held_out) if isinstance(held_out, str) else (held_out, "")
            cells += [Cell(scene, split, start, policy, protocol, seed, camera) for policy in self.policies]
        return cells

    def config_of(self, cell: Cell) -> FitConfig:
        """The configuration of the fit of a cell."""
        (every, offset) = cell.split
        protocol = PROTOCOLS[cell.protocol]
        changed: dict[str, Any] = {"seed": cell.seed, "test_every": every, "test_offset": offset}
        changed["init_points"] = protocol.points
        if cell.camera:
            changed["test_cameras"] = (cell.camera,)
        fields = self.policies[cell.policy]
        if fields is None:
            return self.fit.replace(**changed, selection=None)
        start = self.of_one_camera if self.of_one_camera and not cell.camera else {}
        return self.fit.replace(**changed, start=cell.start, **{**start, **protocol.selection, **fields})

    def _folder_of(self, cell: Cell) -> Path:
        """The folder of a cell's data set, once no other process is making it any more."""
        is_announced = False
        while True:
            try:
                return self.folder(cell.scene, cell.split)
            except InUse as busy:
                if not is_announced:
                    _log.warning("waiting: %s", busy)
                is_announced = True
                time.sleep(_RETRY_SECONDS)

    def dataset(self, cell: Cell) -> Dataset:
        """The views of a cell, none of them opened.

        Raises:
            ValueError: If the data set states another split than the cell's: it would win.
        """
        (every, offset) = cell.split
        config = self.config_of(cell)
        dataset = load_dataset(self._folder_of(cell), config, lazy=True, points=PROTOCOLS[cell.protocol].leaks)
        if cell.camera:
            return dataset  # which knows the camera, or has been refused
        names = sorted(view.name for view in (*dataset.views, *dataset.absent))
        held_out = {view.name for view in dataset.split()[1]}
        there = {view.name for view in dataset.views}
        if every and held_out != there & set(names[offset::every]):
            raise ValueError(
                f"{dataset.path}: must hold out every {every}th view from index {offset} on, as the cell does, its "
                "files state other test views; remove what they state"
            )
        return dataset


def distinct_seeds(study: Study, scene: str, split: tuple[int, int], count: int, protocol: str = "blind") -> list[int]:
    """The first seeds that draw different sets of initial views.

    Args:
        study, scene, split: The cells' own.
        count: How many.
        protocol: A name of `PROTOCOLS`, which may say how many initial views there are.
    Raises:
        ValueError: If there are not as many sets, or too few views for a fit.
    """
    policy = next(label for label, fields in study.policies.items() if fields is not None)
    cell = Cell(scene, split, "seed", policy, protocol, 0)
    train = study.dataset(dataclasses.replace(cell, protocol="blind")).split()[0]  # no points are needed
    selection = study.config_of(cell).selection
    assert selection is not None  # of such a policy
    picked = selection.add or VIEWS_TO_ADD
    if selection.initial + picked > len(train):
        raise ValueError(
            f"{scene}: must have {selection.initial + picked} training views for protocol {protocol}, "
            f"{selection.initial} at the start and {picked} to be picked, has {len(train)}; add photographs, or "
            "hold out fewer"
        )
    seeds: dict[frozenset[int], int] = {}
    for seed in range(100 * count if count <= len(train) else 0):
        config = study.config_of(dataclasses.replace(cell, seed=seed))
        seeds.setdefault(frozenset(ActiveViews(train, config).chosen), seed)
        if len(seeds) == count:
            return list(seeds.values())
    raise ValueError(
        f"{scene}: must have {count} sets of initial views, its {len(train)} training views give fewer; ask for less"
    )


# ------------------------------------------------------------------------------------------------------------ runs


def run_cell(study: Study, cell: Cell, runs: Path, progress: bool = False) -> dict:
    """The row of a cell: fitted now, from its last checkpoint on, or found finished.

    Args:
        study, cell: What to do.
        runs: Folder of all runs.
        progress: Show that of the fit.
    Raises:
        InUse: If another process has the cell.
        ValueError: If the folder holds another fit, or as `drgs.train.fit`.
    """
    run = Run(runs / study.name / cell.name)
    config = study.config_of(cell)
    with lock_run(run, "fit", resume=True) as output:
        if (run.path / "config.json").is_file():
            _check_same(run, config)
        if not (run.path / "metrics.json").is_file():
            forget_peak_memory()  # of the cell before
            fit(study.dataset(cell), run.path, config, resume=True, progress=progress)
        if study.lpips is not None and _metrics(run)["mean"].get("lpips") is None:
            evaluate_run(run, output, lpips=Lpips(study.lpips))
        return _row(study, cell, run)


def run_cells(
    study: Study,
    cells: Sequence[Cell],
    runs: Path,
    rows: Path,
    say: Callable[[str], object] = print,
    progress: bool = False,
) -> tuple[list[Cell], dict[Cell, str]]:
    """Work through cells, in their order; rows are appended as they come.

    A fit that fails is reported and left for the next call; the others go on, unless there is no room left on the disk.

    Args:
        study, cells: What to do.
        runs: Folder of all runs.
        rows: The JSON-lines file; cells that it has are skipped.
        say: Takes a line whenever a cell begins or ends.
        progress: Show that of every fit.
    Returns:
        Cells that other processes have, and those that failed, with the reason.
    Raises:
        OSError: If there is no room left.
    """
    taken = list[Cell]()
    failed = dict[Cell, str]()
    announced = set[str]()
    for number, cell in enumerate(cells, 1):
        known = read_study(rows)
        if is_done(study.name, cell, known, study.measured_later):
            continue
        out = out_of_race(study, known, cell.protocol)
        for sentence in out.values():
            if sentence not in announced:
                say(sentence)
                announced.add(sentence)
        if cell.policy in out:
            continue
        say(f"{number} of {len(cells)}: {cell.name}")
        try:
            row = run_cell(study, cell, runs, progress)
        except InUse:
            taken.append(cell)
            continue
        except FAILURES as error:
            if is_full(error):
                raise
            say(f"{cell.name}: failed: {error}")
            failed[cell] = str(error)
            continue
        append_row(rows, row)
        say(result_line(study, cell, row))
    return taken, failed


def out_of_race(study: Study, rows: Iterable[Mapping[str, Any]], protocol: str) -> dict[str, str]:
    """Policies that have left a study's race, and a sentence each that says why; none where there is no race."""
    if not study.race:
        return {}
    return decided([row for row in rows if row["study"] == study.name], study.reference, protocol)


def result_line(study: Study, cell: Cell, row: Mapping[str, Any]) -> str:
    """The metrics of a finished cell, in a line."""
    values = [(metric, row["metrics"][metric.key]) for metric in study.metrics]
    numbers = ", ".join(f"{m.title} {'none' if x is None else f'{x:.{m.digits}f}'}" for m, x in values)
    return f"{cell.name}: {numbers}" + (f", {row['seconds']:.0f} s" if row["seconds"] is not None else "")


def changed_field(config: FitConfig, was: FitConfig) -> tuple[str, Any, Any] | None:
    """The first field that makes another fit, of its selection, too: its name, its value and that in `was`, as JSON."""
    change = config.difference(was)
    if change is None and config.selection is not None:
        mine, theirs = config.selection.flat(), (was.selection or SelectionConfig()).flat()
        change = next(((name, x, theirs[name]) for name, x in mine.items() if x != theirs[name]), None)
    return change


def _check_same(run: Run, config: FitConfig) -> None:
    """Refuse a run folder that was begun by another fit: by a study that had other numbers under the same name."""
    was = fit_record(run).config
    if config.data.undistort == "auto":  # the run has recorded what that was
        was = was.replace(data=dataclasses.replace(was.data, undistort="auto"))
    change = changed_field(config.resuming(was), was)
    if change is not None:
        name, now, before = change
        raise ValueError(
            f"{run.path}: must be the run of this cell, {name} was {before!r} and is {now!r}; "
            "give the study another name, or move the folder away"
        )


def _metrics(run: Run) -> dict:
    """What a finished run's test views show."""
    metrics = read_json(run.path / "metrics.json", "the metrics of a fit", _ADVICE)
    if metrics.get("split") != "test":
        raise ValueError(
            f"{run.path / 'metrics.json'}: must be of the test views, is of {metrics.get('split')!r}; "
            f"run `drgs eval {shlex.quote(str(run.path))}`"
        )
    return metrics


def _row(study: Study, cell: Cell, run: Run) -> dict:
    """The row of a finished run."""
    metrics = _metrics(run)
    env = read_json(run.path / "env.json", "where a run ran", _ADVICE)
    measured: list[dict] = []
    if study.policies[cell.policy] is None:
        start = run.config()["train"]
        picks = []
        leak = PROTOCOLS[cell.protocol].leaks
    else:
        chosen = read_json(run.path / SELECTION, "the record of the chosen views", _ADVICE)
        start = [view["name"] for view in chosen["start"]]
        picks = chosen["picks"]
        leak = chosen["pool_leak"]
        measured = chosen.get("measured", [])
    done = next((event for event in run.events()[::-1] if event.get("event") == "done"), {})
    return {
        "study": study.name,
        **cell.to_json(),
        "initial": start,
        "picks": [pick["name"] for pick in picks],
        "metrics": {metric.key: metric.read(metrics) for metric in study.metrics},
        "medians": {metric.key: metrics.get("median", {}).get(metric.key) for metric in study.metrics},
        "curve": {str(x["views"]): {metric.key: metric.read(x) for metric in study.metrics} for x in measured},
        "views": metrics["count"],
        "gaussians": metrics.get("gaussians"),
        "seconds": metrics.get("seconds", done.get("seconds")),
        "peak_memory": done.get("peak_memory"),
        "pick_seconds": float(np.mean([pick["seconds"] for pick in picks])) if picks else None,
        "pool_leak": leak,
        "commit": env["commit"],
        "drgs": env["drgs"],
    }
