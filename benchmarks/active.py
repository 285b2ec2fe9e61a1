"""From 2 to 12 views by every policy, color alone: held-out quality against the number of views, paired by units.

    python benchmarks/active.py [--set report] [--scale small] [--seeds 5] [--shard K/N]     fits, rows as they come
    python benchmarks/active.py --page [--merge ROWS.jsonl ...]                              docs/active-static.md

The paper's static loop (2 views, one more every 200 steps at `paper` scale) as cells of `drgs.studies.cells`: rows of
benchmarks/active.jsonl (of `--set choice` active-choice.jsonl) and runs that are there are kept, killed ones resumed,
and several processes may work side by side. A unit is (scene, split, initial views); every seed draws other initial
views, and captures are held out from two offsets on. Made scenes (`room-N`, `still-N`, N the seed) have test views
drawn as the candidates are, 24 or more.

Scenes were named before anything was run: constants of policies are chosen on `CHOICE`, the page reports `REPORT`, and
no scene is in both. `blind` everywhere; the paper's protocol on the made scenes of the report, two units each.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")

import numpy as np
import studies
from studies import ROOT

from drgs.studies.cells import Metric, Study, distinct_seeds
from drgs.studies.curves import draw_curves
from drgs.studies.experiments import SIZES, fisher_policy
from drgs.studies.rows import read_study
from drgs.studies.statistics import at_views, values_of
from drgs.studies.tables import fill_between, study_report
from drgs.train import FitConfig, SelectionConfig

CHOICE = ("head", "banana", "room-3", "room-4", "still-5", "still-6")
REPORT = ("office", "statue", "room-5", "room-6", "room-7", "still-1", "still-2", "still-3")
SETS = {"report": REPORT, "choice": CHOICE}


WINNER = "v_opt, with backdrop"
SCRATCH = "fisherrf, from scratch"  # as FisherRF's own code, after each pick
POLICIES = {
    **{name: {"policy": name} for name in ("random", "uniform", "farthest", "moments", "coverage", "fisherrf")},
    SCRATCH: {"policy": "fisherrf", "restart": "always"},
    **{x: fisher_policy(x, "geometry", prior=1e-6) for x in ("eig", "logdet", "block_logdet")},
    "v_opt": fisher_policy("v_opt", "geometry", prior=1e-2),
    "eig, with backdrop": fisher_policy("eig", "geometry", "backdrop", prior=1e-6),
    WINNER: fisher_policy("v_opt", "geometry", "backdrop", prior=1e-2),
}
ONLY = {SCRATCH: ("office", "room-5", "still-1")}
TRIED = {
    "random": "",
    "uniform": "",
    "farthest": "",
    "poses": "k-medoids of camera centers and directions",
    "fisherrf": "",
    "eig": "",
    "v_opt": "Gaussians alone, lambda 1e-6",
    "facility": "places that the pool will show, each seen by a chosen view from near its ray",
    "field": "expected error about where such places are, parallax included",
    "switch": "`farthest` while more than 5 % of the candidates' pixels are empty, then `eig`",
    "diverse": "`eig` times what a pose does not share with known ones",
    "eig, with backdrop": "cells are directions, lambda 1e-6",
    "eig, with backdrop, sphere": "cells are on the sphere, lambda 1e-6",
    "v_opt, backdrop": "without Gaussians; directions, lambda 1e-6",
    "v_opt, with backdrop": "directions, lambda 1e-6",
    "v_opt, with backdrop, lambda 1e-2": "directions",
    "v_opt, with backdrop, lambda 1e-2, sphere": f"`{WINNER}` of the report",
}
"""What the choosing scenes were run with; those of no name in `POLICIES` are in the history, at 9a40b12."""
METRICS = (
    Metric("psnr", "PSNR", 2),
    Metric("ssim", "SSIM"),
    Metric("flip", "FLIP", larger=False),
    Metric("uncovered", "uncovered", larger=False),
)
CHOSEN = ROOT / "benchmarks" / "active-choice.jsonl"
PAGE = ROOT / "docs" / "active-static.md"
CURVES = ROOT / "docs" / "pictures" / "active-curves.png"
SPLITS = {"banana": ((7, 0), (7, 3)), "captures": ((4, 0), (4, 2)), "room": ((3, 0),), "still": ((4, 0),)}
"""What is held out, by scene; seeds take the splits in turn. Not every third view of a still life: its cameras take
three elevations in turn, and the lowest would be held out whole.
"""
SCALES = ("small", "paper")


def study_of(scale: str, runs: Path) -> Study:
    """The study at a scale; made scenes are made where they are not there yet."""
    sizes = SIZES["static", scale]
    width, height = sizes.image
    # Colors alone: what the paper's study says of features holds for none of these fits.
    sized = {"max_pixels": sizes.fit.data.max_pixels, "max_gaussians": sizes.fit.density.max_gaussians}
    fit = FitConfig.of(renderers=("fast",), semantics="ignore", max_steps=sizes.fit.max_steps, **sized)

    def folder(scene: str, split: tuple[int, int]) -> Path:
        name, _, seed = scene.partition("-")
        if not seed:
            return studies.DATA / scene
        from drgs.scenes import room, still_life

        made, views = {"room": (room.generate, 84), "still": (still_life.generate, 96)}[name]
        return made(runs / f"active-{scale}-{scene}", views=views, width=width, height=height, seed=int(seed))

    return Study(
        name=f"active-{scale}",
        folder=folder,
        policies=POLICIES,
        fit=fit.replace(selection=SelectionConfig(initial=2, add=10, every=sizes.every, measure=(3, 4, 6, 8))),
        metrics=METRICS,
        reference="random",
        comparisons=tuple(
            (WINNER, other)
            for other in (
                "farthest",
                "uniform",
                "fisherrf",
                "eig",
                "logdet",
                "block_logdet",
                "v_opt",
                "eig, with backdrop",
            )
        ),
    )


def splits_of(scene: str) -> tuple[tuple[int, int], ...]:
    """What is held out of a scene; seeds take the splits in turn."""
    return SPLITS.get(scene.partition("-")[0], SPLITS["captures"])


def units_of(study: Study, seeds: int, scenes: Sequence[str]) -> list:
    """Seeds outermost; the first two of made scenes once more by the paper's protocol, at the end."""
    drawn = {}
    for scene in scenes:
        for number, split in enumerate(splits_of(scene)):
            count = len(range(number, seeds, len(splits_of(scene))))
            drawn[scene, split] = distinct_seeds(study, scene, split, count) if count else []
    units = []
    for number in range(seeds):
        for scene in scenes:
            turn, place = divmod(number, len(splits_of(scene)))
            split = splits_of(scene)[place]
            units.append((scene, split, "seed", "blind", drawn[scene, split][turn]))
    made = [scene for scene in scenes if "-" in scene]
    for number in range(min(2, seeds)):
        units += [(x, splits_of(x)[0], "seed", "paper", drawn[x, splits_of(x)[0]][number]) for x in made]
    return units


def report(study: Study, rows: list[dict]) -> str:
    """The tables, and the picture of the curves."""
    blind = [row for row in rows if row["protocol"] == "blind"]
    if draw_curves(study, blind, METRICS[0], CURVES):
        shown = f"![PSNR against the number of views](pictures/{CURVES.name})"
        return f"{shown}\n\n{study_report(study, rows)}"
    return study_report(study, rows)


def tried(rows: list[dict]) -> str:
    """PSNR on the choosing scenes, one unit each, and its mean over them at smaller numbers of views."""
    lines = [
        "| policy | " + " | ".join(CHOICE) + " | mean, 12 views | 8 views | 6 views |",
        "|---|" + "---|" * (len(CHOICE) + 3),
    ]
    for label, what in TRIED.items():
        mine = [row for row in rows if row["policy"] == label]
        at = [values_of(at_views(mine, count), "psnr", label) for count in (12, 8, 6)]
        by_scene = {unit[0]: value for unit, value in at[0].items()}
        cells = [*(by_scene[scene] for scene in CHOICE), *(float(np.mean(list(values.values()))) for values in at)]
        name = f"{label} ({what})" if what else label
        lines.append(f"| {name} | " + " | ".join(f"{x:.2f}" for x in cells) + " |")
    return "\n".join(lines)


def planned(seeds: int) -> int:
    """Cells of the report."""
    everywhere = [policy for policy in POLICIES if policy not in ONLY]
    made = [scene for scene in REPORT if "-" in scene]
    units = [*REPORT * seeds, *made * min(2, seeds)]
    return len(units) * len(everywhere) + sum(unit in scenes for scenes in ONLY.values() for unit in units)


def main() -> int:
    code = studies.command(
        "active", PAGE, SCALES, study_of, units_of, planned=planned, report=report, seeds=5, sets=SETS, only=ONLY
    )
    if "--page" in sys.argv:
        fill_between(PAGE, "choice", tried(read_study(CHOSEN)))
    return code


if __name__ == "__main__":
    sys.exit(main())
