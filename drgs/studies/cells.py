"""Studies of active fits as cells: one fit each, in a run folder of its own, one row of a JSON-lines file when done.

A study is its list of cells and the file of their rows. Any number of processes may work through the same list side by
side: the lock of the run folder says who has a cell, a finished folder is not fitted again, and that of a process that
was killed is resumed from its checkpoint. `drgs.studies.tables` makes the tables.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np

from drgs import data
from drgs.files import Run
from drgs.fitting.active import SELECTION, ActiveViews
from drgs.fitting.config import SAVING, ActiveConfig, FitConfig, Start
from drgs.fitting.resume import claim_run
from drgs.guards.json_files import read_json
from drgs.guards.locks import InUse
from drgs.train import fit

__all__ = [
    "Cell",
    "Metric",
    "Study",
    "append_row",
    "cell_of",
    "distinct_seeds",
    "read_study",
    "result_line",
    "run_cell",
    "run_cells",
]

_Unit = tuple[str, tuple[int, int] | str, Start, "Protocol", int]
Protocol = Literal["blind", "paper"]
"""`blind`: nothing of a view is read before it is picked. `paper`: initial points of the whole data set (pool_leak)."""

_log = logging.getLogger(__name__)
_PATIENCE = 5.0  # seconds until a data set that another process makes is asked for again


@dataclasses.dataclass(frozen=True)
class Cell:
    """One fit of a study.

    Attributes:
        scene: Name of a data set of the study.
        split: (n, k): every n-th view by name is held out, from index k on.
        start: `first` view by name, or the one that the `seed` draws; the others of the initial views follow from it.
        policy: Label of a policy of the study.
        protocol: `blind` or `paper`.
        seed: Of everything random in the fit.
        camera: Of what several cameras film at once: the one that is held out at all times, in place of `split`, which
            is (0, 0); what is known at the start is what all others see at the first time, whatever `start` says.
    """

    scene: str
    split: tuple[int, int]
    start: Start
    policy: str
    protocol: Protocol
    seed: int
    camera: str = ""

    @property
    def name(self) -> str:
        """Of its run folder."""
        words = re.sub(r"[^a-z0-9.+]+", "-", self.policy.lower()).strip("-")
        held_out = self.camera or "{}+{}".format(*self.split)
        return f"{self.scene}-{held_out}-{self.start}{self.seed}-{self.protocol}-{words}"

    def to_json(self) -> dict:
        """As a row begins; without a camera where none is held out, as in rows of studies that know none."""
        fields = {**dataclasses.asdict(self), "split": list(self.split)}
        return fields if self.camera else {name: x for name, x in fields.items() if name != "camera"}


@dataclasses.dataclass(frozen=True)
class Metric:
    """A number of metrics.json, averaged over the test views there.

    Attributes:
        key: Its name in rows.
        title: In tables.
        digits: Behind the decimal point in tables.
        larger: Whether larger is better.
        path: Keys that lead to it in metrics.json; default ("mean", key).
    """

    key: str
    title: str
    digits: int = 3
    larger: bool = True
    path: tuple[str, ...] = ()

    def read(self, metrics: Mapping[str, Any]) -> float | None:
        """The number in a metrics.json; None where it could not be computed.

        Raises:
            ValueError: If there is no such key.
        """
        value: Any = metrics
        for key in self.path or ("mean", self.key):
            if not isinstance(value, Mapping) or key not in value:
                raise ValueError(f"metrics.json: must have {'.'.join(self.path or ('mean', self.key))}, has no {key!r}")
            value = value[key]
        return None if value is None else float(value)


@dataclasses.dataclass(frozen=True)
class Study:
    """What its cells have in common.

    Attributes:
        name: Of the study and its scale; in every row, and the folder of its runs.
        folder: Scene and split -> folder of the data set, made where it is not there yet.
        policies: Label -> fields of `ActiveConfig`; None: all views are known from the start, and none is picked.
        fit: What every fit does; seed, split and initial points are the cell's.
        active: How views are chosen; start and policy are the cell's.
        metrics: What a row holds.
        reference: Label of the policy that the others are compared with.
        comparisons: More pairs (policy, reference) to be compared.
    """

    name: str
    folder: Callable[[str, tuple[int, int]], Path]
    policies: Mapping[str, Mapping[str, Any] | None]
    fit: FitConfig
    active: ActiveConfig
    metrics: tuple[Metric, ...]
    reference: str
    comparisons: tuple[tuple[str, str], ...] = ()

    def cells(self, units: Iterable[_Unit]) -> list[Cell]:
        """The cells of units (scene, split or camera held out, start, protocol, seed), units outermost: what is there
        at any time is a complete study of fewer units, one unit aside for each process.
        """
        found = []
        for scene, held_out, start, protocol, seed in units:
            split, camera = ((0, 0), held_out) if isinstance(held_out, str) else (held_out, "")
            found += [Cell(scene, split, start, policy, protocol, seed, camera) for policy in self.policies]
        return found

    def configs(self, cell: Cell) -> tuple[FitConfig, ActiveConfig | None]:
        """What the fit of a cell is told."""
        every, offset = cell.split
        points = "all" if cell.protocol == "paper" else "views"
        changed: dict[str, Any] = {"seed": cell.seed, "test_every": every, "test_offset": offset, "init_points": points}
        if cell.camera:
            changed["test_cameras"] = (cell.camera,)
        fields, config = self.policies[cell.policy], dataclasses.replace(self.fit, **changed)
        return config, None if fields is None else dataclasses.replace(self.active, start=cell.start, **fields)

    def _made(self, cell: Cell) -> Path:
        """The folder of a cell's data set, once no other process is making it any more."""
        told = False
        while True:
            try:
                return self.folder(cell.scene, cell.split)
            except InUse as busy:
                if not told:
                    _log.warning("waiting: %s", busy)
                told = True
                time.sleep(_PATIENCE)

    def dataset(self, cell: Cell) -> data.Dataset:
        """The views of a cell, none of them opened.

        Raises:
            ValueError: If the data set states another split than the cell's: it would win.
        """
        every, offset = cell.split
        dataset = data.load(
            self._made(cell),
            test_every=every,
            test_offset=offset,
            background=self.fit.settings.background,
            lazy=True,
            points=cell.protocol == "paper",
            times=self.fit.times,
            test_cameras=(cell.camera,) if cell.camera else None,
        )
        if cell.camera:
            return dataset  # which knows the camera, or has been refused
        names = sorted(view.name for view in (*dataset.views, *dataset.absent))
        held_out = {view.name for view in dataset.split()[1]}
        there = {view.name for view in dataset.views}
        if held_out != there & set(names[offset::every]):
            raise ValueError(
                f"{dataset.path}: must hold out every {every}th view from index {offset} on, as the cell does, its "
                "files state other test views; remove what they state"
            )
        return dataset


def distinct_seeds(study: Study, scene: str, split: tuple[int, int], count: int, first: int = 0) -> list[int]:
    """The first seeds, from `first` on, that draw different sets of initial views.

    Raises:
        ValueError: If there are not as many sets.
    """
    policy = next(label for label, fields in study.policies.items() if fields is not None)
    cell = Cell(scene, split, "seed", policy, "blind", first)
    train = study.dataset(cell).split()[0]
    found: dict[frozenset[int], int] = {}
    for seed in range(first, first + (100 * count if count <= len(train) else 0)):
        config, active = study.configs(dataclasses.replace(cell, seed=seed))
        assert active is not None  # of such a policy
        found.setdefault(frozenset(ActiveViews(active, train, config).chosen), seed)
        if len(found) == count:
            return list(found.values())
    raise ValueError(
        f"{scene}: must have {count} sets of initial views, its {len(train)} training views give fewer; ask for less"
    )


# ------------------------------------------------------------------------------------------------------------ rows


def cell_of(row: Mapping[str, Any]) -> tuple[str, Cell]:
    """The study and the cell of a row."""
    fields = {field.name: row[field.name] for field in dataclasses.fields(Cell) if field.name != "camera"}
    return row["study"], Cell(**{**fields, "split": tuple(fields["split"]), "camera": row.get("camera", "")})


def read_study(*paths: Path) -> list[dict]:
    """The rows of JSON-lines files, merged by cell; of two rows of one cell the later one counts.

    A last line that a killed process left half written is left out, as is a file that is not there.

    Raises:
        ValueError: If another line is damaged.
    """
    rows = {}
    for path in paths:
        lines = path.read_bytes().split(b"\n") if path.exists() else []
        for number, line in enumerate(lines, 1):
            if not line.strip():
                continue
            try:
                row = json.loads(line)
                rows[cell_of(row)] = row
            except (ValueError, KeyError, TypeError) as error:
                if number == len(lines):  # every whole line ends with a newline
                    continue
                raise ValueError(
                    f"{path}: line {number} must be a row of a study, is not ({error}); remove it"
                ) from None
    return list(rows.values())


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Add a row to a file that other processes add to as well, unless its cell is there already."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with _alone(path) as file:
        if cell_of(row) in {cell_of(other) for other in read_study(path)}:
            return
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)  # a killed process may have left half a line
        file.write(json.dumps(row).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _alone(path: Path) -> Iterator[Any]:
    """A file, opened for reading and appending, locked against the other processes that do the same."""
    with path.open("a+b") as file:
        with suppress(OSError, ImportError):  # a file system without it
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield file


# ------------------------------------------------------------------------------------------------------------ runs


def run_cell(study: Study, cell: Cell, runs: Path) -> dict:
    """The row of a cell: fitted now, from its last checkpoint on, or found finished.

    Args:
        study, cell: What to do.
        runs: Folder of all runs.
    Raises:
        InUse: If another process has the cell.
        ValueError: If the folder holds another fit, or as `drgs.train.fit`.
    """
    run = Run(runs / study.name / cell.name)
    config, active = study.configs(cell)
    with claim_run(run, "fit", resume=True):
        if (run.path / "config.json").is_file():
            _check_same(run, config, active)
        if not (run.path / "metrics.json").is_file():
            fit(study.dataset(cell), run.path, config, active=active, resume=True, progress=False)
        return _row(study, cell, run)


def run_cells(
    study: Study, cells: Sequence[Cell], runs: Path, rows: Path, say: Callable[[str], object] = print
) -> tuple[list[Cell], list[Cell]]:
    """Work through cells, in their order; rows are appended as they come.

    A fit that fails is told and left for the next call; the others go on.

    Args:
        study, cells: What to do.
        runs: Folder of all runs.
        rows: The JSON-lines file; cells that it has are skipped.
        say: Takes a line whenever a cell begins or ends.
    Returns:
        Cells that other processes have, and cells that failed.
    """
    taken, failed = [], []
    for number, cell in enumerate(cells, 1):
        if (study.name, cell) in {cell_of(row) for row in read_study(rows)}:
            continue
        say(f"{number} of {len(cells)}: {cell.name}")
        try:
            row = run_cell(study, cell, runs)
        except InUse:
            taken.append(cell)
            continue
        except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
            say(f"{cell.name}: failed: {error}")
            failed.append(cell)
            continue
        append_row(rows, row)
        say(result_line(study, cell, row))
    return taken, failed


def result_line(study: Study, cell: Cell, row: Mapping[str, Any]) -> str:
    """What a finished cell has found, in a line."""
    numbers = ", ".join(f"{m.title} {row['metrics'][m.key]}" for m in study.metrics)
    return f"{cell.name}: {numbers}" + (f", {row['seconds']:.0f} s" if row["seconds"] is not None else "")


def _check_same(run: Run, config: FitConfig, active: ActiveConfig | None) -> None:
    """Refuse a run folder that was begun by another fit: by a study that had other numbers under the same name."""
    recorded = run.config()
    for wanted, found in ((config, recorded.get("fit")), (active, recorded.get("active"))):
        if wanted is None:
            continue
        now = json.loads(json.dumps(wanted.to_json()))
        found = found or {}
        was = wanted.recorded(found) if isinstance(wanted, ActiveConfig) else {**FitConfig().to_json(), **found}
        for key, value in now.items():
            if value != was[key] and key not in SAVING:
                raise ValueError(
                    f"{run.path}: must be the run of this cell, {key} was {was[key]!r} and is {value!r}; "
                    "give the study another name, or move the folder away"
                )


def _row(study: Study, cell: Cell, run: Run) -> dict:
    """What a finished run found."""
    advice = "move the run folder away, to have it fitted again"
    metrics = read_json(run.path / "metrics.json", "the metrics of a fit", advice)
    if metrics.get("split") != "test":
        raise ValueError(
            f"{run.path / 'metrics.json'}: must be of the test views, is of {metrics.get('split')!r}; "
            f"run `drgs eval {run.path}`"
        )
    env = read_json(run.path / "env.json", "where a run ran", advice)
    measured: list[dict] = []
    if study.policies[cell.policy] is None:
        start, picks, leak = run.config()["train"], [], cell.protocol == "paper"
    else:
        chosen = read_json(run.path / SELECTION, "the record of the chosen views", advice)
        start, picks, leak = [view["name"] for view in chosen["start"]], chosen["picks"], chosen["pool_leak"]
        measured = chosen.get("measured", [])
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
        "seconds": metrics.get("seconds"),
        "pick_seconds": float(np.mean([pick["seconds"] for pick in picks])) if picks else None,
        "pool_leak": leak,
        "commit": env["commit"],
        "drgs": env["drgs"],
    }
