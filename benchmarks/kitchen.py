"""One camera at each later time of a kitchen where things move, by every policy: color and labels of a held-out camera.

    python benchmarks/kitchen.py [--scale small] [--seeds 6] [--shard K/N]     fits, rows as they come
    python benchmarks/kitchen.py --page [--merge ROWS.jsonl ...]               the tables of docs/dynamic.md

The paper's dynamic loop (arXiv 2512.22771): a static stage on the first time of all cameras but the one that is held
out, then, at each later time, one camera that a policy picks. A unit is a kitchen (seeds 1, 2, 3; constants are fixed
on seed 0) with the camera that is held out; the test views are all its times. `all views` is fitted to all cameras at
all times, an upper reference. One thread a process; any number of processes may run side by side, with or without
--shard: the lock of a run folder says who has a cell. Finished rows (benchmarks/kitchen.jsonl) and runs are kept,
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

from drgs.studies.cells import Metric, Study
from drgs.studies.tables import study_report
from drgs.train import ActiveConfig, FitConfig
from scenes import kitchen

BASELINES = {name: {"policy": name} for name in ("random", "uniform", "farthest", "moments", "fisherrf")}
BLOCKS = {
    "geometry": ("geometry",),
    "geometry+semantic": ("geometry", "semantic"),
    "geometry+deformation": ("geometry", "deformation"),
    "joint": ("geometry", "semantic", "deformation"),
}
CRITERIA = {name: {"policy": "fisher", "criterion": "eig", "blocks": blocks} for name, blocks in BLOCKS.items()}
LAMBDAS = {f"joint, lambda {text}": {**CRITERIA["joint"], "prior": float(text)} for text in ("0", "1e-7", "1e-5")}
DEFAULT = "joint+backdrop, v_opt"  # the program's own choice where something moves
POLICIES = {**BASELINES, **CRITERIA, "all views": None, **LAMBDAS, DEFAULT: {"policy": "fisher"}}
TABLES = (
    (
        "Policies",
        "What one camera a time is worth, by who picks it (the paper's second table).",
        (*BASELINES, "joint", DEFAULT, "all views"),
        "random",
        tuple((name, other) for name in ("joint", DEFAULT) for other in BASELINES if other != "random"),
    ),
    (
        "lambda",
        "The joint criterion by its prior precision; `joint` has 1e-6 (the paper's third table).",
        ("joint", *LAMBDAS),
        "joint",
        (),
    ),
    (
        "Blocks",
        "What the criterion counts (the paper's fourth table).",
        tuple(CRITERIA),
        "geometry",
        (("joint", "geometry+semantic"), ("joint", "geometry+deformation")),
    ),
)
METRICS = (
    Metric("psnr", "PSNR", 2),
    Metric("psnr_moving", "PSNR, moving pixels", 2),
    Metric("ssim", "SSIM"),
    Metric("flip", "FLIP", larger=False),
    studies.segmentation("pixel_accuracy", "pixel accuracy"),
    studies.segmentation("miou", "mIoU"),
)
UNITS = tuple((f"kitchen-{seed}", camera) for camera in ("cam00", "cam03") for seed in (1, 2, 3))
"""In the order in which --seeds takes them: cam00 is in the middle of the arc, cam01, ... go from left to right."""


@dataclasses.dataclass(frozen=True)
class Scale:
    """Sizes: of the fit, and of the kitchens as they are filmed."""

    fit: FitConfig
    cameras: int
    times: int
    size: tuple[int, int]
    teacher: tuple[int, int]
    info_pixels: int | None = None


SCALES = {
    "small": Scale(
        FitConfig(
            times=14,
            max_pixels=10_800,
            max_gaussians=8_000,
            max_steps=900,
            feature_width=32,
            feature_rate=5e-3,
            decoder_rate=5e-4,
            grid_rate=(8e-3, 8e-4),
            field_rate=(8e-4, 8e-5),
        ),
        cameras=10,
        times=14,
        size=(120, 90),
        teacher=(40, 30),
        info_pixels=2_700,
    ),
    "paper": Scale(FitConfig(max_steps=17_000), cameras=15, times=40, size=(240, 180), teacher=(60, 45)),
}


def study_of(scale: str, runs: Path) -> Study:
    """The study at a scale; kitchens are filmed where they are not there yet."""
    size = SCALES[scale]

    def folder(scene: str, split: tuple[int, int]) -> Path:
        return kitchen.generate(
            runs / f"{scale}-{scene}",
            cameras=size.cameras,
            times=size.times,
            width=size.size[0],
            height=size.size[1],
            seed=int(scene.partition("-")[2]),
            teacher_width=size.teacher[0],
            teacher_height=size.teacher[1],
        )

    return Study(
        name=f"kitchen-{scale}",
        folder=folder,
        policies=POLICIES,
        fit=size.fit,
        active=ActiveConfig(schedule="times", info_pixels=size.info_pixels),
        metrics=METRICS,
        reference="random",
    )


def units_of(study: Study, seeds: int) -> list:
    """The first so many of `UNITS`."""
    return [(scene, camera, "first", "blind", 0) for scene, camera in UNITS[:seeds]]


def report(study: Study, rows: list[dict]) -> str:
    """The three tables, each a study of its own policies."""
    parts = []
    for title, told, labels, reference, comparisons in TABLES:
        part = dataclasses.replace(
            study,
            policies={label: study.policies[label] for label in labels},
            reference=reference,
            comparisons=comparisons,
        )
        parts += [f"### {title}", told, study_report(part, rows, level=4)]
    return "\n\n".join(parts)


def main() -> int:
    return studies.command(
        "kitchen",
        ROOT / "docs" / "dynamic.md",
        SCALES,
        study_of,
        units_of,
        planned=lambda seeds: min(seeds, len(UNITS)) * len(POLICIES),
        report=report,
        seeds=len(UNITS),
    )


if __name__ == "__main__":
    sys.exit(main())
