"""Are the pixels wrong that a model calls uncertain? AUSE of variance maps, on held-out views of active fits.

    python benchmarks/uncertainty.py [--set report] [--scale small] [--seeds 5] [--runs runs/studies]

Of benchmarks/active.py the runs of one policy, `random`, which are there already: twelve views and a model of them.
Area between two sparsification curves: the root of the mean squared error of the pixels that are left when those called
most uncertain are taken out, and the same by the true error; both are divided by the error of all pixels, and 0 is
perfect. Finished units are kept (benchmarks/uncertainty.jsonl); the table goes to docs/active-static.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")

import active
import numpy as np
import studies
import torch
from studies import ROOT

import drgs
from drgs import fisher
from drgs.files import Run
from drgs.fitting.frames import Frame, load_frames
from drgs.fitting.records import load_run
from drgs.gain import Prior, variances
from drgs.studies.cells import Study
from drgs.studies.rows import Cell
from drgs.studies.tables import fill_between

POLICY = "random"
MAPS = {
    "variance, Gaussians alone": ("geometry", Prior(1e-3, relative=True)),
    "variance, Gaussians alone, lambda 1": ("geometry", Prior(1.0)),
    "variance with backdrop, lambda 1e-6": ("both", Prior(1e-6)),
    "variance with backdrop, lambda 1e-2": ("both", Prior(1e-2)),
    "variance with backdrop, lambda 1": ("both", Prior(1.0)),
}
PLAIN = ("1 - alpha", "random order")
VIEWS = 12  # of those held out at most, evenly spaced
ROWS = ROOT / "benchmarks" / "uncertainty.jsonl"


def ause(scene: drgs.Gaussians, train: list[Frame], held_out: list[Frame], settings: drgs.RenderSettings) -> dict:
    """Map -> AUSE; and `covered`, the share of held-out pixels with alpha above 0.5."""
    cameras = [frame.camera for frame in train]
    masks = [frame.mask for frame in train]
    H = fisher.diagonal(scene, cameras, settings, masks=masks)
    sphere = fisher.backdrop_sphere(scene, [*cameras, *(frame.camera for frame in held_out)])
    H["backdrop"] = fisher.backdrop(scene, cameras, settings, sphere=sphere)
    weights = {}
    for name, (which, prior) in MAPS.items():
        counted = {group: x for group, x in H.items() if group != "backdrop" or which == "both"}
        weights[name] = variances(counted, prior)
    maps: dict[str, list[torch.Tensor]] = {name: [] for name in (*MAPS, *PLAIN)}
    wrong = []
    covered = []
    generator = torch.Generator().manual_seed(0)
    for frame in held_out:
        camera = frame.camera
        with torch.no_grad():
            out = drgs.render(scene, camera, settings, outputs=())
        keep = torch.ones(camera.height, camera.width, dtype=torch.bool) if frame.mask is None else frame.mask > 0.5
        wrong.append((out.rgb.clamp(0, 1) - frame.image()).square().mean(2)[keep])
        covered.append(out.alpha[keep] > 0.5)
        for name, weight in weights.items():
            maps[name].append(fisher.variance_map(scene, camera, weight, settings, sphere=sphere)[keep])
        maps["1 - alpha"].append(1 - out.alpha[keep])
        maps["random order"].append(torch.rand(int(keep.sum()), generator=generator))
    error = torch.cat(wrong).double()
    best = curve(error, error)
    found = {name: float((curve(error, torch.cat(x)) - best).mean()) for name, x in maps.items()}
    return found | {"covered": float(torch.cat(covered).double().mean())}


def curve(wrong: torch.Tensor, order: torch.Tensor, points: int = 100) -> torch.Tensor:
    """RMSE of the pixels left after removing the share k / points with the largest `order`, relative to all."""
    sums = wrong[order.argsort()].cumsum(0)
    kept = torch.tensor([max(1, round(len(wrong) * (1 - k / points))) for k in range(points)])
    rmse = (sums[kept - 1] / kept).sqrt()
    return rmse / rmse[0]


def measured(study: Study, cell: Cell, runs: Path) -> dict | None:
    """The row of a unit; None where its run is not there or not finished."""
    run = Run(runs / study.name / cell.name)
    if not (run.path / "metrics.json").exists():
        return None
    known = json.loads((run.path / "selection.json").read_text())
    names = {one["name"] for one in (*known["start"], *known["picks"])}
    train, test = study.dataset(cell).split()
    loaded = load_run(run)
    pixels = study.fit.data.max_pixels
    step = -(-len(test) // VIEWS)
    seen = load_frames([view for view in train if view.name in names], pixels)
    found = ause(loaded.gaussians, seen, load_frames(test[::step], pixels), study.fit.settings)
    return {**cell.to_json(), "study": study.name, "ause": found}


def table(rows: list[dict], scenes: list[str]) -> str:
    """Means over the units of each scene."""
    units = {scene: [row["ause"] for row in rows if row["scene"] == scene] for scene in scenes}
    mean = lambda scene, key: f"{np.mean([unit[key] for unit in units[scene]]):.3f}"  # noqa: E731
    lines = [
        "| map | " + " | ".join(scenes) + " |",
        "|---|" + "---|" * len(scenes),
        "| (units) | " + " | ".join(str(len(units[scene])) for scene in scenes) + " |",
        "| (pixels with alpha > 0.5) | "
        + " | ".join(f"{np.mean([unit['covered'] for unit in units[scene]]):.0%}" for scene in scenes)
        + " |",
    ]
    lines += [f"| {name} | " + " | ".join(mean(scene, name) for scene in scenes) + " |" for name in (*MAPS, *PLAIN)]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--set", choices=list(active.SETS), default="report")
    parser.add_argument("--scale", choices=active.SCALES, default="small")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "studies")
    args = parser.parse_args()
    study = active.study_of(args.scale, args.runs)
    rows = []
    if ROWS.exists():
        rows = [json.loads(line) for line in ROWS.read_text().splitlines()]
    units = [unit for unit in active.units_of(study, args.seeds, active.SETS[args.set]) if unit[3] == "blind"]
    for cell in [cell for cell in study.cells(units) if cell.policy == POLICY]:
        own = {**cell.to_json(), "study": study.name}
        if any(own == {key: row[key] for key in own} for row in rows):
            continue
        row = measured(study, cell, args.runs)
        if row:
            rows.append(row)
            with ROWS.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(cell.name, {name: round(x, 3) for name, x in row["ause"].items()}, flush=True)
    scenes = [scene for scene in active.SETS[args.set] if any(row["scene"] == scene for row in rows)]
    text = table([row for row in rows if row["study"] == study.name], scenes)
    print(text)
    if args.set == "report":
        fill_between(active.PAGE, "uncertainty", f"Made by {studies.stamp('uncertainty')}\n\n{text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
