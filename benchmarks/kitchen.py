"""The experiments `dynamic`, `prior` and `blocks` of `drgs reproduce`, blind, as the tables of docs/dynamic.md.

    python benchmarks/kitchen.py [--scale small] [--seeds 6] [--shard K/N]     fits, rows as they come
    python benchmarks/kitchen.py --page [--merge ROWS.jsonl ...]               the tables of docs/dynamic.md

The paper's dynamic loop (arXiv 2512.22771): a static stage on the first time of all cameras but the one that is held
out, then, at each later time, one camera that a policy picks. A unit is a kitchen (seeds 1, 2, 3; constants are fixed
on seed 0) with the camera that is held out; the test views are all its times. `all views` is fitted to all cameras at
all times, an upper reference. One thread a process; any number of processes may run side by side, with or without
--shard: the lock of a run folder says who has a cell. Finished rows (benchmarks/dynamic.jsonl) and runs are kept,
killed ones resumed.

Sizes at `small` are so that three units, 39 cells, take about two hours of two processes (a unit is whole before the
next one begins); docs/dynamic.md has the seconds of fits and picks.

As the steps are a nineteenth of the paper's, features and decoder go five times as fast, as in benchmarks/semantic.py,
and so does the field. That was tried on kitchen 0 (all views, 2,700 pixels, 3,000 Gaussians, color alone; the only
variants): PSNR and PSNR of moving pixels of cam00 are 24.64 and 20.22 dB at the default rates, 25.89 and 22.16 at five
times these, 25.98 and 22.11 at ten times; 22.59 without a field.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")

import studies
from studies import ROOT

from drgs.studies import experiments
from drgs.studies.cells import Study
from drgs.studies.experiments import EXPERIMENTS
from drgs.studies.tables import study_report

BASELINES = ("random", "uniform", "farthest", "moments", "fisherrf")
DEFAULT = "joint+backdrop, v_opt"  # the program's own choice where something moves
COMPARISONS = {
    "dynamic": tuple((name, other) for name in ("joint", DEFAULT) for other in BASELINES if other != "random"),
    "prior": (),
    "blocks": (("joint", "geometry+semantic"), ("joint", "geometry+deformation")),
}
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


def report(study: Study, rows: list[dict]) -> str:
    """The three tables, each a study of its own policies."""
    parts = []
    for name, comparisons in COMPARISONS.items():
        table = EXPERIMENTS[name]
        part = dataclasses.replace(
            study,
            policies={label: study.policies[label] for label in table.policies},
            reference=table.reference,
            comparisons=comparisons,
        )
        parts += [f"### {table.title}", table.told, study_report(part, rows, level=4)]
    return "\n\n".join(parts)


def main() -> int:
    return studies.command(
        "kitchen",
        ROOT / "docs" / "dynamic.md",
        SCALES,
        study_of,
        units_of,
        planned=lambda seeds: min(seeds, len(UNITS)) * len(study_of("small", Path()).policies),
        report=report,
        seeds=len(UNITS),
        rows="dynamic",
    )


if __name__ == "__main__":
    sys.exit(main())
