"""What the studies share: base models, their command line, and the line that says where and when.

Studies of fits are cells of `drgs.studies.cells`, their statistics are in `drgs.studies.statistics`; what `--scale`
means is in `drgs.studies.experiments.SIZES`.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from where import DATA, ran  # noqa: E402

from drgs.data import load, scene_extent  # noqa: E402
from drgs.files import atomic_write, load_state, save_state  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import load_frames  # noqa: E402
from drgs.fitting.rows import GaussianRows  # noqa: E402
from drgs.fitting.timetable import initial_views  # noqa: E402
from drgs.fitting.trainer import Trainer  # noqa: E402
from drgs.sfm.points import initial_points  # noqa: E402
from drgs.studies.cells import Metric, Study, run_cells  # noqa: E402
from drgs.studies.rows import append_row, read_study  # noqa: E402
from drgs.studies.statistics import FEWEST_UNITS, differences, estimate, unit_of, values_of  # noqa: E402

__all__ = [
    "DATA",
    "DIFFERENCE",
    "PAGE_DATA",
    "SCENES",
    "base",
    "command",
    "csv_text",
    "dataset",
    "difference",
    "folder",
    "lead",
    "made",
    "rank_correlation",
    "read_rows",
    "stamp",
    "study_sheets",
    "table_lines",
    "write_csv",
    "write_rows",
]

SCENES = ("office", "head", "still_life")
BASE = {"renderers": ("fast",), "max_pixels": 12_000, "max_gaussians": 15_000}
"""Size of the base models."""
PAGE_DATA = ROOT / "docs" / "data"
"""Data files of the pages."""
DIFFERENCE = ("mean", "low", "high", "detectable", "better", "units", "scenes")
"""Heads of what `difference` says of a pair of policies."""


def folder(name: str, runs: Path) -> Path:
    """A scene's data set; the still life is made where it is not there yet."""
    if name != "still_life":
        return DATA / name
    from drgs.scenes import still_life

    return still_life.generate(runs / "still_life", views=40, width=240, height=180)


def dataset(name: str, runs: Path, **options):
    """A scene's views; `options` as of `drgs.data.load`."""
    return load(folder(name, runs), **options)


def base(name: str, runs: Path, views: int, steps: int) -> tuple:
    """(trainer, pool frames, indices of the training views among them, held-out frames) of a fit to a few views.

    The first training view and those farthest from it; kept as a checkpoint for the next call.
    """
    train, test = dataset(name, runs).split(8)
    config = FitConfig().replace(**BASE, max_steps=steps)
    chosen = initial_views([view.camera for view in train], views)
    pool = load_frames(train, config.data.max_pixels)
    held_out = load_frames(test, config.data.max_pixels)
    frames = [pool[i] for i in chosen]
    path = runs / "base" / f"{name}-{views}-{steps}.safetensors"
    if path.exists():
        tensors, header = load_state(path)
        return Trainer.from_state(config, frames, tensors, header, str(path)), pool, chosen, held_out
    views_seen = [train[i] for i in chosen]
    points, colors, _ = initial_points(views_seen, seed=0, max_points=config.density.max_gaussians)
    dense = any(view.depth_path is not None for view in views_seen)
    import torch

    model = GaussianRows.from_points(
        torch.from_numpy(points),
        torch.from_numpy(colors),
        config.density.dense_opacity if dense else config.density.initial_opacity,
        config.density.dense_scale if dense else 1.0,
    )
    trainer = Trainer(config, frames, model, scene_extent([f.camera for f in frames], points))
    while trainer.step_index < steps:
        trainer.step()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_state(path, *trainer.state())
    return trainer, pool, chosen, held_out


def continued(trainer: Trainer, frames: list, steps: int, seed: int = 0) -> Trainer:
    """A copy of a fit that goes on with other frames: schedule stretched, no density control, another order."""
    tensors, _ = trainer.state()
    config = trainer.config.replace(max_steps=trainer.config.max_steps + steps, refine_stop=0.0, seed=seed)
    copy = Trainer(config, frames, GaussianRows.from_state({k: v.clone() for k, v in tensors.items()}), trainer.extent)
    copy.step_index = trainer.config.max_steps
    for _ in range(steps):
        copy.step()
    return copy


def rank_correlation(a, b, kind: str = "spearman") -> float:
    """Spearman's rho, or Kendall's tau-b."""
    from scipy import stats

    return float((stats.spearmanr if kind == "spearman" else stats.kendalltau)(a, b).statistic)


def stamp(script: str) -> str:
    """The line that says where and when a study ran."""
    at = ran()
    return f"`python benchmarks/{script}.py`, {at['machine']}, {at['date']}, commit {at['commit']}."


def made(rows: Sequence[Mapping[str, Any]]) -> str:
    """Where and when rows were measured."""
    machines, days = (" and ".join(dict.fromkeys(row[key] for row in rows)) for key in ("machine", "date"))
    commits = dict.fromkeys(row["commit"] for row in rows)
    return f"{machines}, {days}, commit{'s' * (len(commits) > 1)} {', '.join(commits)}"


def write_rows(path: Path, rows) -> None:
    """JSON, atomically: studies are resumed from it."""
    with atomic_write(path) as file:
        file.write(json.dumps(rows, indent=1).encode() + b"\n")


def read_rows(path: Path, default):
    """What `write_rows` wrote, or the default."""
    return json.loads(path.read_text()) if path.exists() else default


def csv_text(lines: Iterable[Sequence[str]]) -> str:
    """Lines of cells, the first one the heads, as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def table_lines(text: str) -> list[list[str]]:
    """A table of Markdown as lines of a data file; columns of `mean / worst` become two, an empty first cell is that
    of the line above.
    """
    lines = [
        [re.sub(r"(?<=\d),(?=\d{3}\b)", "", cell.strip().replace("`", "")) for cell in line[1:-1].split("|")]
        for line in text.splitlines()
    ]
    heads, rows = lines[0], lines[2:]
    pairs = [any(" / " in row[i] for row in rows) for i in range(len(heads))]
    found = [[]]
    for head, pair in zip(heads, pairs, strict=True):
        left, cut, right = head.partition(" / ")
        two = (
            [left, f"{left.rpartition(',')[0]}, {right}"] if cut and "," in left else [f"{head} mean", f"{head} worst"]
        )
        found[0] += two if pair else [head]
    for row in rows:
        cells = []
        for cell, pair in zip(row, pairs, strict=True):
            left, _, right = cell.partition(" / ")
            cells += [left, right] if pair else [cell]
        cells[0] = cells[0] or found[-1][0]
        found.append(cells)
    return found


def write_csv(path: Path, lines: Iterable[Sequence[str]]) -> None:
    """A data file of a page."""
    with atomic_write(path) as file:
        file.write(csv_text(lines).encode())


def difference(
    named: list[str], metric: Metric, rows: Sequence[Mapping[str, Any]], policy: str, other: str
) -> Iterator[list[str]]:
    """A line of a data file, where there are fits of one unit by both: what it is of, then `DIFFERENCE`."""
    values = differences(rows, metric.key, policy, other)
    if values:
        one = estimate(values)
        numbers = (f"{x:+.{metric.digits}f}" for x in (one.mean, one.low, one.high))
        detectable = "" if one.detectable is None else f"{one.detectable:.{metric.digits}f}"
        better = one.positive if metric.larger else one.negative
        yield [*named, *numbers, detectable, str(better), str(one.units), str(one.scenes)]


def lead(found: dict, digits: int) -> str:
    """A mean difference and its interval; bold where there is a verdict."""
    one = estimate(found)
    if one.units == 1:
        return f"{one.mean:+.{digits}f}"
    sure = one.units >= FEWEST_UNITS and not one.low <= 0 <= one.high
    mean = f"{one.mean:+.{digits}f}"
    return f"{f'**{mean}**' if sure else mean} [{one.low:+.{digits}f}, {one.high:+.{digits}f}]"


def study_sheets(study: Study, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[list[str]]]:
    """The data files of a study's page: name -> lines, the first one the heads.

    Args:
        study: What was studied.
        rows: Its rows.
    Returns:
        `units`, every fit; `scenes`, means over the units of a scene, with medians over test views and, at the end,
        median seconds of a pick; `differences` within units, of all policies against the reference, of the study's
        comparisons, and of each policy by the two protocols.
    """
    keys = [metric.key for metric in study.metrics]
    middle = [{**row, "metrics": row["medians"]} for row in rows if row.get("medians")]
    medians = [metric for metric in study.metrics if any(row["metrics"].get(metric.key) for row in middle)]
    heads = [*keys, *(f"{metric.key}_median" for metric in medians), "seconds_a_pick"]
    units = [["protocol", "scene", "held_out_every", "from_index", "initial_views", "policy", "seed", "commit", *heads]]
    scenes = [["protocol", "scene", "policy", "units", *heads]]
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    order = list(study.policies)
    for row in sorted(rows, key=lambda row: (row["protocol"], row["scene"], order.index(row["policy"]))):
        groups.setdefault((row["protocol"], row["scene"], row["policy"]), []).append(row)
    for (protocol, scene, policy), mine in groups.items():
        for row in sorted(mine, key=lambda row: (unit_of(row), row["seed"])):
            every, offset = row["split"]
            start = row.get("camera") or " ".join(sorted(row["initial"]))
            given = [scene, str(every), str(offset), start, policy, str(row["seed"]), row.get("commit") or ""]
            units.append([protocol, *given, *_numbers(study.metrics, medians, [row], policy)])
        count = str(len({unit_of(row) for row in mine}))
        scenes.append([protocol, scene, policy, count, *_numbers(study.metrics, medians, mine, policy)])
    against = [["protocol", "policy", "against", "metric", *DIFFERENCE]]
    pairs = [(policy, study.reference) for policy in study.policies if policy != study.reference]
    for protocol in sorted({row["protocol"] for row in rows}):
        own = [row for row in rows if row["protocol"] == protocol]
        for policy, other in (*pairs, *study.comparisons):
            for metric in study.metrics:
                against += difference([protocol, policy, other, metric.key], metric, own, policy, other)
    for policy in study.policies:
        both = [{**row, "policy": row["protocol"]} for row in rows if row["policy"] == policy]
        for metric in study.metrics:
            named = ["paper against blind", policy, policy, metric.key]
            against += difference(named, metric, both, "paper", "blind")
    return {"units": units, "scenes": scenes, "differences": against}


def _numbers(
    metrics: Sequence[Metric], medians: Sequence[Metric], rows: Sequence[Mapping[str, Any]], policy: str
) -> list[str]:
    """Means over units of the metrics, and of their medians over test views; the median of the seconds of a pick."""
    cells = []
    by_median = [{**row, "metrics": row["medians"]} for row in rows if row.get("medians")]
    for metric, found in (*((one, rows) for one in metrics), *((one, by_median) for one in medians)):
        values = list(values_of(found, metric.key, policy).values())
        cells.append(f"{np.mean(values):.{metric.digits}f}" if values else "")
    seconds = [row["pick_seconds"] for row in rows if row["pick_seconds"] is not None]
    return [*cells, f"{np.median(seconds):.2f}" if seconds else ""]


def command(
    script: str,
    scales: Iterable[str],
    study_of: Callable[[str, Path], Study],
    units_of: Callable[[Study, int], list],
    page: Callable[[Study, list[dict]], None],
    rows: str,
    seeds: int = 3,
) -> int:
    """The command line of a study of fits; rows go to benchmarks/ROWS.jsonl.

    Args:
        script: Name of the script.
        scales: Values of --scale, the default first.
        study_of: Scale, folder of runs -> study.
        units_of: Study, --seeds -> units, as `Study.cells` takes them.
        page: Writes what a page has of a study, its rows.
        rows: Name of the file of rows.
        seeds: The default of --seeds.
    Returns:
        The exit code.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("--scale", choices=list(scales), default=next(iter(scales)))
    parser.add_argument("--seeds", type=int, default=seeds)
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "studies")
    parser.add_argument("--shard", default="0/1", help="K/N: every N-th cell from the K-th on")
    parser.add_argument("--policies", nargs="+", help="cells of these policies alone")
    parser.add_argument("--page", action="store_true", help="run nothing, write the page of the rows that there are")
    parser.add_argument("--merge", type=Path, nargs="+", default=[], help="rows of another checkout, to be added")
    args = parser.parse_args()
    results = ROOT / "benchmarks" / f"{rows}.jsonl"
    for path in args.merge:
        for row in read_study(path):
            append_row(results, row)
    study = study_of(args.scale, args.runs)
    if args.page:
        found = [row for row in read_study(results) if row["study"] == study.name]
        page(study, found)
        return 0
    shard, shards = map(int, args.shard.split("/"))
    units = units_of(study, args.seeds)
    cells = [cell for cell in study.cells(units) if cell.policy in (args.policies or [cell.policy])]
    cells = cells[shard::shards]
    taken, failed = run_cells(study, cells, args.runs, results, say=lambda line: print(line, flush=True))
    print(f"{len(cells)} cells, {len(taken)} with other processes, {len(failed)} failed: {stamp(script)}")
    return 1 if failed else 0
