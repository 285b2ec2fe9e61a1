"""Are the pixels wrong that a model calls uncertain? AUSE of variance maps, on held-out views of active fits.

    python benchmarks/uncertainty.py [RUN ...]

Runs are folders of active fits, of `drgs fit --views active` or `drgs reproduce`; those of the rows that are there had
picked twelve views at random.
Area between two sparsification curves: the root of the mean squared error of the pixels that are left when those called
most uncertain are taken out, and the same by the true error; both are divided by the error of all pixels, and 0 is
perfect. Rows are kept (benchmarks/uncertainty.jsonl); their means go to a data file of docs/uncertainty.md.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")

import numpy as np
import studies
import torch
from studies import ROOT
from where import ran, rows_of_runs

import drgs
from drgs import fisher
from drgs.fitting.frames import Frame, load_dataset, load_frames
from drgs.fitting.records import load_run
from drgs.gain import Prior, variances

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


def measured(path: Path) -> dict:
    """The row of a run."""
    loaded = load_run(path)
    config = loaded.record.config
    known = json.loads((path / "selection.json").read_text())
    names = {one["name"] for one in (*known["start"], *known["picks"])}
    train, test = load_dataset(loaded.record.data, config, lazy=True, points=False).split()
    pixels = config.data.max_pixels
    step = -(-len(test) // VIEWS)
    seen = load_frames([view for view in train if view.name in names], pixels)
    found = ause(loaded.gaussians, seen, load_frames(test[::step], pixels), config.settings)
    return {"run": path.name, "scene": Path(loaded.record.data).name, "ause": found, **ran()}


def lines(rows: list[dict]) -> list[list[str]]:
    """Means over the runs of each scene."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    units = {scene: [row["ause"] for row in rows if row["scene"] == scene] for scene in scenes}
    means = [
        [name, *(f"{np.mean([unit[key] for unit in units[scene]]):.3f}" for scene in scenes)]
        for name, key in {"share of pixels with alpha > 0.5": "covered", **{x: x for x in (*MAPS, *PLAIN)}}.items()
    ]
    return [["map", *scenes], ["runs", *(str(len(units[scene])) for scene in scenes)], *means]


def main() -> int:
    table = lines(rows_of_runs(ROWS, measured, __doc__))
    print(studies.csv_text(table))
    studies.write_csv(ROOT / "docs" / "data" / "uncertainty.csv", table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
