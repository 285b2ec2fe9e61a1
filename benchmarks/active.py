"""From 2 to 12 views by every policy, color alone: held-out quality, paired over scenes and seeds.

    python benchmarks/active.py [--scale small] [--seeds 3] [--start first] [--scenes ...] [--policies ...]
    python benchmarks/active.py --page

The paper's static loop (2 views, one more every 200 steps at `paper` scale) as cells of `drgs.lab.study`: rows of
benchmarks/active.jsonl and runs that are there are kept, killed ones resumed, and several processes may work side by
side. Every 8th view is held out. The rows that are there begin with the first view whatever the seed: three units, one
a scene, with three seeds each. `--start seed` makes every seed a unit. The page, docs/active-static.md, is of one of
both.
"""

from __future__ import annotations

import argparse
import sys
import textwrap
from pathlib import Path

import studies
from studies import ROOT, SCALES

from drgs.lab.study import Metric, Study, read_study, run_cells
from drgs.lab.study_plot import draw_curves
from drgs.lab.study_report import fill_between, study_report
from drgs.train import ActiveConfig, FitConfig

POLICIES = {
    "fisher, logdet": {"policy": "fisher", "criterion": "logdet"},
    "fisher, eig": {"policy": "fisher", "criterion": "eig"},
    "fisher, logdet, relative 1e-3": {
        "policy": "fisher",
        "criterion": "logdet",
        "prior": 1e-3,
        "relative_prior": True,
    },
    "fisherrf": {"policy": "fisherrf"},
    "coverage": {"policy": "coverage"},
    "farthest": {"policy": "farthest"},
    "uniform": {"policy": "uniform"},
    "random": {"policy": "random"},
}
METRICS = (Metric("psnr", "PSNR", 2), Metric("ssim", "SSIM"), Metric("flip", "FLIP", larger=False))
RESULTS = ROOT / "benchmarks" / "active.jsonl"
SPLIT = 8, 0


def study_of(scale: str, runs: Path) -> Study:
    """The study at a scale."""
    size = dict(SCALES[scale])
    every = size.pop("every")
    return Study(
        name=f"active-{scale}",
        folder=lambda scene, split: studies.folder(scene, runs),
        policies=POLICIES,
        fit=FitConfig(**size),
        active=ActiveConfig(initial=2, add=10, every=every, measure=(3, 4, 6, 8)),
        metrics=METRICS,
        reference="random",
    )


def page_of(scale: str, start: str) -> str:
    """The part of docs/active-static.md."""
    size = SCALES[scale]
    rows = [row for row in read_study(RESULTS) if row["start"] == start]
    seeds = len({row["seed"] for row in rows})
    text = (
        f"`python benchmarks/active.py --scale {scale} --start {start}`: {size['max_gaussians']:,} Gaussians, at most "
        f"{size['max_pixels']:,} pixels, {size['max_steps']:,} steps, 2 views and one more every {size['every']} steps "
        f"until 12; {seeds} seeds. Nothing of a view is read before it is picked."
    )
    return textwrap.fill(text, 120, break_on_hyphens=False) + "\n\n" + study_report(study_of(scale, Path()), rows)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scale", choices=list(SCALES), default="small")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--start", choices=("first", "seed"), default="first", help="what the initial views begin with")
    parser.add_argument("--scenes", nargs="+", default=list(studies.SCENES))
    parser.add_argument("--policies", nargs="+", default=list(POLICIES), choices=list(POLICIES))
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "studies")
    parser.add_argument("--shard", default="0/1", help="K/N: every N-th cell from the K-th on")
    parser.add_argument("--page", action="store_true", help="run nothing, write the tables of the rows that there are")
    args = parser.parse_args()
    if args.page:
        fill_between(ROOT / "docs" / "active-static.md", "active", page_of(args.scale, args.start))
        rows = [row for row in read_study(RESULTS) if row["start"] == args.start]
        draw_curves(study_of(args.scale, Path()), rows, METRICS[0], ROOT / "docs" / "pictures" / "active-curves.png")
        return 0
    study = study_of(args.scale, args.runs)
    units = [(scene, SPLIT, args.start, "blind", seed) for seed in range(args.seeds) for scene in args.scenes]
    shard, shards = map(int, args.shard.split("/"))
    cells = [cell for cell in study.cells(units) if cell.policy in args.policies][shard::shards]
    taken, failed = run_cells(study, cells, args.runs, RESULTS, say=lambda line: print(line, flush=True))
    print(f"{len(cells)} cells, {len(taken)} with other processes, {len(failed)} failed: {studies.stamp('active')}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
