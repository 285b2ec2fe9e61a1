"""Fits with and without depth maps: held-out PSNR, error of held-out depth, and seconds of a step.

    python benchmarks/depths.py [--scenes office ...] [--ways off ...] [--trained fast ...] [--units 3] [--views 0 6]
                                [--steps 300] [--page]

Appends one row a fit to benchmarks/depths.jsonl as it ends, leaves out what is there of this machine, then writes
docs/data/depths.csv and depths-means.csv. Ways are weights of the term, the first and the last, and whether what is
behind a map counts as much (`both sides`). All ways but `off` are `--depth on`; a row has what `auto` found, too.
`--views 6` fits six training views, evenly spaced. Made rooms are COLMAP data sets, whose depth maps this script adds.
Seconds are those that the process computed in its steps; the ways of a scene take turns. Fits of two machines are not
compared.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
from fits import psnr_by_renderer, split_of  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import DATA, UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.data import Dataset, load  # noqa: E402
from drgs.fitting.components.base import Setup  # noqa: E402
from drgs.fitting.components.table import components_of  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import frames_for  # noqa: E402
from drgs.fitting.metrics import evaluate  # noqa: E402
from drgs.fitting.start import start  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.statistics import Unit, estimate  # noqa: E402

ROWS = ROOT / "benchmarks" / "depths.jsonl"
CHOOSING = ("office", "still0", "room21")
SHOWING = ("still7", "room22")
MADE = ("still0", "still7", "room21", "room22")
SIZE = {"max_pixels": 12_000, "max_gaussians": 8_000}
SEEN = ("fast", "exact", "gsplat")
WEIGHTS = {
    "3 to 0.3": (3.0, 0.3, 0.1),
    "0.3 to 0.3, both sides": (0.3, 0.3, 1.0),
    "1 to 0.001, both sides": (1.0, 0.001, 1.0),
    "1 to 0.01, both sides": (1.0, 0.01, 1.0),
    "1 to 0.1, both sides": (1.0, 0.1, 1.0),
    "3 to 0.003, both sides": (3.0, 0.003, 1.0),
    "3 to 0.3, both sides": (3.0, 0.3, 1.0),
}
"""Way -> the first and the last weight of the term, and the factor of what is behind the map."""
DEFAULT = WEIGHTS["3 to 0.3"]
KEY = ("scene", "way", "trained", "views", "steps", "seed", "offset")


def dataset_of(scene: str, data: Path, made: Path) -> Dataset:
    """A data set with metric depth maps in all of its views."""
    dataset = load((made if scene in MADE else data) / scene)
    for view in dataset.views:
        if view.depth_path is None:  # `drgs scene room` makes them in tenths of a millimeter
            number = view.stem.rpartition("_")[2]
            view.depth_path = dataset.path / "depth" / f"depth_{number}.png"
            view.depth_scale = 1e-4
    return dataset


def fit(dataset: Dataset, scene: str, way: str, trained: str, views: int, steps: int, seed: int, offset: int) -> dict:
    """The row of one fit."""
    config = FitConfig().replace(
        settings=RenderSettings.preset("fast" if trained == "any" else trained),
        renderers=(trained,),
        seed=seed,
        test_offset=offset,
        max_steps=steps,
        skybox="off",
        semantics="ignore",
        depth="off" if way == "off" else "on",
        depth_weight=WEIGHTS.get(way, DEFAULT)[:2],
        depth_behind=WEIGHTS.get(way, DEFAULT)[2],
        **SIZE,
    )
    train, test = split_of(dataset, config)
    if views:
        train = [train[i] for i in np.linspace(0, len(train) - 1, views).round().astype(int)]
    frames = frames_for(train, config.data)
    setup = Setup(dataset, config, train, test, train, (), components_of(), frames=frames)
    began = time.process_time()
    for component in setup.components:
        component.begin(setup, False)
    looked = time.process_time() - began
    trainer, _ = start(setup)
    began, clock = time.process_time(), time.perf_counter()
    while trainer.step_index < steps:
        trainer.step()
    seconds, clock = time.process_time() - began, time.perf_counter() - clock
    held_out = frames_for(test, config.data)
    renderers = {name: RenderSettings.preset(name) for name in SEEN}
    measured = evaluate(trainer.gaussians(), held_out, renderers["fast"])
    found = trainer.component("depth").found
    return {
        **dict(zip(KEY, (scene, way, trained, views, steps, seed, offset), strict=True)),
        **SIZE,
        "psnr": psnr_by_renderer(trainer.gaussians(), held_out, renderers),
        **{name: [view[name] for view in measured["views"]] for name in ("cc_psnr", "ssim", "depth_error")},
        "used": trainer.component("depth").used,
        "found": None if found is None else {"clear": found.is_clear, "points": found.points, "agree": found.agreeing},
        "look_seconds": looked,
        "seconds": seconds,
        "clock_seconds": clock,
        **ran(),
    }


Gains = dict[Unit, float]


def gains(rows: list[dict], way: str, scenes: Sequence[str], **chosen: object) -> dict[str, Gains]:
    """What a way changes against none, by unit: `mean` and `worst` PSNR with the renderer that was trained with, dB;
    `depth` and `step`, ratios of the depth error and of the seconds of a step.
    """
    found: dict[str, Gains] = {name: {} for name in ("mean", "worst", "depth", "step")}
    for row in rows:
        if row["way"] != way or row["scene"] not in scenes or any(row[key] != x for key, x in chosen.items()):
            continue
        other = next((x for x in rows if all(x[k] == (row | {"way": "off"})[k] for k in (*KEY, "machine"))), None)
        if other is None:
            continue
        unit = (row["scene"], (8, row["offset"]), (str(row["seed"]),))
        now, before = row["psnr"][row["trained"]], other["psnr"][row["trained"]]
        found["mean"][unit] = statistics.mean(now) - statistics.mean(before)
        found["worst"][unit] = min(now) - min(before)
        errors = [[x for x in one["depth_error"] if x is not None] for one in (row, other)]
        found["depth"][unit] = statistics.mean(errors[0]) / statistics.mean(errors[1])
        found["step"][unit] = row["seconds"] / other["seconds"]
    return found


def lines(rows: list[dict]) -> list[list[str]]:
    """A line a way, trained preset, number of views and of steps, and half of the scenes."""
    found_lines = []
    kinds = {tuple(row[key] for key in KEY[1:5]) for row in rows if row["way"] != "off"}
    for way, trained, views, steps in sorted(kinds, key=lambda kind: (kind[3], kind[2], kind[1], kind[0])):
        for half, scenes in (("tuned on", CHOOSING), ("tested on", SHOWING)):
            found = gains(rows, way, scenes, trained=trained, views=views, steps=steps)
            if not found["mean"]:
                continue
            mean, worst = (estimate(found[key]) for key in ("mean", "worst"))
            ratios = [f"{statistics.geometric_mean(found[key].values()):.2f}" for key in ("depth", "step")]
            interval = f" [{mean.low:+.2f}, {mean.high:+.2f}]" if mean.scenes > 1 else ""
            said = [f"{mean.mean:+.2f}{interval}", f"{worst.mean:+.2f}", *ratios]
            found_lines.append([way, f"`{trained}`", str(views or "all"), str(steps), half, str(mean.units), *said])
    return found_lines


def write_files(rows: list[dict]) -> None:
    """The data files: means, and all fits."""
    heads = ["weight", "fitted for", "views", "steps", "scenes", "fits", "PSNR", "worst", "depth error", "step"]
    found = lines(rows)
    write_csv(PAGE_DATA / "depths-means.csv", [heads, *found])
    everything = [[*KEY, *(f"{seen}, dB" for seen in SEEN), "cc_psnr", "ssim", "depth_error", "used", "seconds"]]
    for row in rows:
        numbers = [*(row["psnr"][seen] for seen in SEEN), *(row[name] for name in ("cc_psnr", "ssim", "depth_error"))]
        means = [f"{statistics.mean(x for x in one if x is not None):.3f}" for one in numbers]
        everything.append([*(str(row[key]) for key in KEY), *means, str(row["used"]), f"{row['seconds']:.1f}"])
    write_csv(PAGE_DATA / "depths.csv", everything)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[*CHOOSING, *SHOWING])
    parser.add_argument("--ways", nargs="+", default=["off", "3 to 0.3"])
    parser.add_argument("--trained", nargs="+", default=["fast"])
    parser.add_argument("--units", type=int, default=1)
    parser.add_argument("--views", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", nargs="+", type=int, default=[300])
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the captures")
    parser.add_argument("--made", type=Path, default=ROOT / "runs" / "made", help="folder of the made scenes")
    parser.add_argument("--page", action="store_true", help="write the data files, fit nothing")
    args = parser.parse_args()
    machine = ran()["machine"]
    there = {tuple(row[key] for key in KEY) for row in read_rows(ROWS) if row["machine"] == machine}
    wanted = [
        (scene, way, trained, views, steps, *unit)
        for unit in UNITS[: args.units]
        for steps in args.steps
        for trained in args.trained
        for views in args.views
        for scene in args.scenes
        for way in args.ways
    ]
    for key in () if args.page else wanted:
        if key not in there:
            row = fit(dataset_of(key[0], args.data, args.made), *key)
            add_row(ROWS, row)
            means = {
                name: statistics.mean(x for x in row[name] if x is not None) for name in ("cc_psnr", "depth_error")
            }
            print(*key, f"{statistics.mean(row['psnr'][key[2]]):.2f} dB", means, f"{row['seconds']:.0f} s", flush=True)
    write_files(read_rows(ROWS))


if __name__ == "__main__":
    main()
