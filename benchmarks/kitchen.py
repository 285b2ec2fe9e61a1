"""The experiments `dynamic`, `prior` and `blocks` of `drgs reproduce`, blind, for docs/next-views.md.

    python benchmarks/kitchen.py [--scale small] [--seeds 6] [--shard K/N]     fits, rows as they come
    python benchmarks/kitchen.py --page [--merge ROWS.jsonl ...]               the page

The page is docs/data/moving-units.csv (every fit) and moving-differences.csv, and a table of docs/next-views.md. The
rows of the table, benchmarks/kitchens.jsonl, are of six kitchens by color alone, with 1,500 steps (max_steps = 1500 and
semantics = "ignore" in fit.toml):

    drgs reproduce dynamic --protocol blind --seeds 6 --config fit.toml --policy uniform --policy farthest \
        --policy "joint+backdrop, v_opt" -o OUT --no-figures

The paper's dynamic loop (arXiv 2512.22771): a static stage on the first time of all cameras but the one that is held
out, then, at each later time, one camera that a policy picks. A unit is a kitchen (seeds 1, 2, 3; constants are fixed
on seed 0) with the camera that is held out; the test views are all its times. `all views` is fitted to all cameras at
all times, an upper reference. One thread a process; any number of processes may run side by side, with or without
--shard: the lock of a run folder says who has a cell. Finished rows (benchmarks/dynamic.jsonl) and runs are kept,
killed ones resumed.

Sizes at `small` are so that three units, 39 cells, take about two hours of two processes (a unit is whole before the
next one begins); docs/data/moving-units.csv has the seconds of fits and picks.

As the steps are a nineteenth of the paper's, features and decoder go five times as fast, as in benchmarks/semantic.py,
and so does the field. That was tried on kitchen 0 (all views, 2,700 pixels, 3,000 Gaussians, color alone; the only
variants): PSNR and PSNR of moving pixels of cam00 are 24.64 and 20.22 dB at the default rates, 25.89 and 22.16 at five
times these, 25.98 and 22.11 at ten times; 22.59 without a field.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")

import numpy as np
import studies
from pages import fill_between
from policies import Rows
from studies import DIFFERENCE, ROOT, difference, lead

from drgs.studies import experiments
from drgs.studies.cells import Study
from drgs.studies.rows import read_study
from drgs.studies.statistics import coverage, differences, estimate, unit_of, values_of
from drgs.studies.tables import markdown_table, paragraph

PAGE = ROOT / "docs" / "next-views.md"
DATA = ROOT / "docs" / "data"
COLOR = ROOT / "benchmarks" / "kitchens.jsonl"
BASELINES = ("random", "uniform", "farthest", "moments", "fisherrf")
DEFAULT = "joint+backdrop, v_opt"  # the program's own choice where something moves
SHOWN = (*BASELINES, "geometry", "joint", "all views")
"""What the table compares the default with."""
BLOCKS = ("geometry", "geometry+semantic", "geometry+deformation")
LEADS = {"psnr": "PSNR", "psnr_moving": "moving pixels"}
"""Metrics of the table."""
UNITS = tuple((f"kitchen-{seed}", camera) for camera in ("cam00", "cam03") for seed in (1, 2, 3))
"""In the order in which --seeds takes them: cam00 is in the middle of the arc, cam01, ... go from left to right."""
SCALES = ("small", "paper")


def study_of(scale: str, runs: Path) -> Study:
    """The study at a scale; kitchens are filmed where they are not there yet. Its first rows have no class means."""
    study = experiments.study_of("dynamic", scale, runs / "scenes")
    return dataclasses.replace(study, metrics=tuple(x for x in study.metrics if x.key != "class_accuracy"))


def units_of(study: Study, seeds: int) -> list:
    """The first so many of `UNITS`."""
    return [(scene, camera, "first", "blind", 0) for scene, camera in UNITS[:seeds]]


def pairs_of(study: Study) -> list[tuple[str, str]]:
    """The pairs of policies whose differences are kept."""
    pairs = [(label, "random") for label in study.policies if label != "random"]
    pairs += [(DEFAULT, label) for label in study.policies if label not in (DEFAULT, "random")]
    pairs += [("joint", label) for label in study.policies if label not in ("joint", DEFAULT, "random", "all views")]
    return pairs + [(label, "geometry") for label in BLOCKS[1:]]


def report(study: Study, rows: Rows) -> str:
    """The table: means of every policy, and by how much the default is ahead of it within units."""
    leads = {key: x for key, x in LEADS.items() if rows[0]["metrics"].get(key) is not None}
    metrics = {metric.key: metric for metric in study.metrics if metric.key in leads}
    heads = ["policy", *leads.values(), "s a pick", *(f"default less it: {x}" for x in leads.values())]
    lines = []
    for label in (DEFAULT, *SHOWN):
        mine = [row for row in rows if row["policy"] == label]
        if not mine:
            continue
        means = (np.mean(list(values_of(mine, key, label).values())) for key in leads)
        seconds = [x for row in mine if (x := row["pick_seconds"]) is not None]
        cells = [f"{x:.{metrics[key].digits}f}" for key, x in zip(leads, means, strict=True)]
        cells.append(f"{np.median(seconds):.1f}" if seconds else "–")
        for key in leads:
            found = differences(rows, key, DEFAULT, label)
            cells.append(lead(found, metrics[key].digits) if found and label != DEFAULT else "–")
        lines.append([f"`{label}`", *cells])
    return "\n\n".join([paragraph(told(rows)), markdown_table(heads, lines)])


def told(rows: Rows) -> str:
    """How many fits the table is of, and how to read it."""
    scenes = {unit_of(row)[0] for row in rows}
    commits = dict.fromkeys((row.get("commit") or "unknown")[:7] for row in rows)
    found = next((x for label in SHOWN if (x := differences(rows, "psnr", DEFAULT, label))), {})
    size = f"{len(rows)} fits, commit{'s' * (len(commits) > 1)} {', '.join(commits)}, {len(scenes)} kitchens"
    if len(found) < 2:
        return f"{size}."
    held = f"{100 * coverage(len({unit[0] for unit in found}), len(found)):.0f} %"
    seen = [
        one.detectable
        for label in SHOWN
        if (values := differences(rows, "psnr", DEFAULT, label)) and (one := estimate(values)).detectable is not None
    ]
    least = f"; {np.median(seen):.2f} dB would be detectable" if seen else ""
    return f"{size}. {held} of such intervals contain the true mean{least}."


def unit_lines(study: Study, rows: Rows) -> Iterator[list[str]]:
    """Every fit: means over its test views and, of what has them, medians; seconds of the fit and of a pick."""
    numbers = [metric.key for metric in study.metrics]
    medians = [f"{key}_median" for key in numbers]
    more = ["fit_seconds", "pick_seconds", "picks"]
    yield ["protocol", "kitchen", "held_out", "seed", "policy", "commit", "test_views", *numbers, *medians, *more]
    order = list(study.policies)
    for row in sorted(rows, key=lambda row: (unit_of(row), order.index(row["policy"]), row["seed"])):
        cells = [
            "" if (x := (row.get(held) or {}).get(metric.key)) is None else f"{x:.{metric.digits}f}"
            for held in ("metrics", "medians")
            for metric in study.metrics
        ]
        spent = ["" if row.get(key) is None else f"{row[key]:.2f}" for key in ("seconds", "pick_seconds")]
        names = [row["protocol"], row["scene"], row["camera"], str(row["seed"]), row["policy"], row["commit"]]
        yield [*names, str(row.get("views", "")), *cells, *spent, " ".join(row.get("picks") or ())]


def difference_lines(study: Study, rows: Rows) -> Iterator[list[str]]:
    """Differences within units of every pair."""
    yield ["policy", "against", "metric", *DIFFERENCE]
    for policy, other in pairs_of(study):
        for metric in study.metrics:
            yield from difference([policy, other, metric.key], metric, rows, policy, other)


def page(study: Study, rows: Rows) -> None:
    """Writes the data files, and the table of fits by color alone."""
    color = read_study(COLOR)
    if color:
        fill_between(PAGE, "kitchens", report(study, color))
    blind = [row for row in rows if row["protocol"] == "blind"]  # those by the paper's are of benchmarks/results.py
    studies.write_csv(DATA / "moving-units.csv", unit_lines(study, blind))
    studies.write_csv(DATA / "moving-differences.csv", difference_lines(study, blind))


def main() -> int:
    return studies.command(
        "kitchen",
        SCALES,
        study_of,
        units_of,
        page=page,
        seeds=len(UNITS),
        rows="dynamic",
    )


if __name__ == "__main__":
    sys.exit(main())
