"""Fits of few photographs: what makes views better that the fit does not see, by how many views it has.

    python benchmarks/overfitting.py [--scenes banana ...] [--views 3 6 12 0] [--rules "drop 0.2" ...] [--page]

Appends one row a fit to benchmarks/overfitting.jsonl as it ends and leaves out what is there; --page writes
docs/data/overfitting.csv, of which docs/real-data.md tells. A fit of a few views has those that are evenly spaced among
the training views, by name, and initial points of these alone; it is measured on all the others, 12 at most, evenly
spaced. 0 views are all training views, measured on those held out. On the way `fast` draws at most 4 of the measured
views, which says when they were best. Rules were tried on CHOOSING; those that were best there were then measured on
SHOWING. Seconds are those that the process computed in its steps. Made scenes are folders of `--made`. One thread.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from fits import folder_of, psnr_by_renderer, split_of  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import DATA, UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.data import Dataset, View, load  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import Frame, frames_for  # noqa: E402
from drgs.fitting.start import start_plain  # noqa: E402
from drgs.fitting.trainer import Trainer  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.statistics import Unit, estimate  # noqa: E402

ROWS = ROOT / "benchmarks" / "overfitting.jsonl"
CHOOSING = ("banana", "fern", "office", "still0", "room21")
SHOWING = ("head", "statue", "lego", "street", "watch", "still7", "room22")
SEEN = ("fast", "exact", "gsplat")
MEASURED = 12  # views of a fit of few, at most
ON_THE_WAY, WATCHED = 6, 4  # times, and views at most
KEY = ("scene", "rule", "views", "trained", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")

RULES: dict[str, dict[str, Any]] = {
    "none": {},
    "drop 0.2": {"dropout": 0.2},
    "drop 0.4": {"dropout": 0.4},
    "drop 0.6": {"dropout": 0.6},
    "opacity x 5": {"opacity_weight": 0.05},
    "scale x 5": {"scale_weight": 0.05},
    "both x 10": {"opacity_weight": 0.1, "scale_weight": 0.1},
    "both x 0": {"opacity_weight": 0.0, "scale_weight": 0.0},
    "SH 0": {"sh_degree": 0},
    "SH 1": {"sh_degree": 1},
    "SH 2": {"sh_degree": 2},
}
"""Name -> fields of `FitConfig` that it changes. Rows of other rules are of code that lost and was not kept."""


def split(dataset: Dataset, config: FitConfig, views: int) -> tuple[list[View], list[View]]:
    """Views that are fitted to, and those that are measured; 0: as the configuration has them."""
    train, test = split_of(dataset, config)
    if not views or views >= len(train):
        return train, test
    index = [round(i * (len(train) - 1) / max(views - 1, 1)) for i in range(views)]
    few = [train[i] for i in index]
    others = test + [view for i, view in enumerate(train) if i not in index]
    return few, others[:: -(-len(others) // MEASURED)]


def fit(key: tuple, seen: Sequence[str], folder: Path) -> dict:
    """The row of one fit to the data set in a folder, of values of `KEY`."""
    scene, rule, views, trained, seed, offset, steps, pixels, gaussians = key
    dataset = load(folder)
    config = FitConfig().replace(
        renderers=(trained,),
        seed=seed,
        test_offset=offset,
        skybox="off",
        semantics="ignore",
        init_points="views" if views else "auto",
        max_steps=steps,
        max_pixels=pixels,
        max_gaussians=gaussians,
        **({"dropout": 0.0} | RULES[rule]),
    )
    train, test = split(dataset, config, views)
    frames, measured = frames_for(train, config.data), frames_for(test, config.data)
    trainer = start_plain(dataset, train, frames, config)
    begin = len(trainer.rows)
    renderers = {name: RenderSettings.preset(name) for name in seen}
    due = {round(steps * (i + 1) / ON_THE_WAY) for i in range(ON_THE_WAY)}
    curve: list[list[float]] = []
    seconds = 0.0
    while trainer.step_index < steps:
        began = time.process_time()
        trainer.step()
        seconds += time.process_time() - began
        if trainer.step_index in due:
            curve.append([trainer.step_index, *watched(trainer, frames, measured, renderers["fast"])])
    return {
        **dict(zip(KEY, key, strict=True)),
        "fitted": len(train),
        "points": begin,
        "psnr": psnr_by_renderer(trainer.gaussians(), measured, renderers, MEASURED),
        "curve": curve,
        "seconds": seconds,
        **ran(),
    }


def watched(trainer: Trainer, frames: list[Frame], measured: list[Frame], fast: RenderSettings) -> list[float]:
    """Mean PSNR of training views, and of measured ones."""
    gaussians = trainer.gaussians()
    return [
        statistics.mean(psnr_by_renderer(gaussians, some, {"fast": fast}, WATCHED)["fast"])
        for some in (frames, measured)
    ]


def gains(rows: list[dict], rule: str, scenes: Sequence[str], seen: str) -> tuple[dict[Unit, float], dict[Unit, float]]:
    """Unit -> dB that a rule adds to the mean, and to the worst view, where fits with it and without were made."""
    found: tuple[dict[Unit, float], dict[Unit, float]] = ({}, {})
    for row in rows:
        other = next((x for x in rows if all(x[k] == (row | {"rule": "none"})[k] for k in KEY)), None)
        if (row["rule"], row["trained"]) != (rule, "fast") or row["scene"] not in scenes or other is None:
            continue
        if seen not in row["psnr"] or seen not in other["psnr"]:
            continue
        unit = (row["scene"], (8, row["offset"]), (str(row["seed"]),))
        now, before = row["psnr"][seen], other["psnr"][seen]
        found[0][unit] = statistics.mean(now) - statistics.mean(before)
        found[1][unit] = min(now) - min(before)
    return found


def cells(rows: list[dict], rule: str, scenes: Sequence[str]) -> list[str]:
    """Fits, and what a rule adds in each renderer, with the interval over several scenes; empty where none was made."""
    line: list[str] = []
    for seen in SEEN:
        mean, worst = gains(rows, rule, scenes, seen)
        if not mean:
            line.append("")
            continue
        effect = estimate(mean)
        line.append(f"{effect.mean:+.2f} / {estimate(worst).mean:+.2f}")
        if effect.scenes > 1:
            line[-1] += f" [{effect.low:+.2f}, {effect.high:+.2f}]"
        if seen == SEEN[0]:
            line.insert(0, str(effect.units))
    return line if any(line) else []


def write_file(rows: list[dict]) -> None:
    """The data file of every rule and scene."""
    kinds = sorted({(row["views"] or 99, row["views"], row["max_steps"], row["max_pixels"]) for row in rows})
    rules = [rule for rule in dict.fromkeys(row["rule"] for row in rows) if rule != "none"]
    heads = ["rule", "views", "steps", "pixels", "scene", "fits", *(f"{x}: mean / worst, dB" for x in SEEN)]
    everything = [heads]
    for _, *kind in kinds:
        views, steps, pixels = kind
        alike = [row for row in rows if [row["views"], row["max_steps"], row["max_pixels"]] == kind]
        told = [str(views or "all"), f"{steps:,}"]
        for rule in rules:
            for scenes in (CHOOSING, SHOWING):
                own = [scene for scene in scenes if cells(alike, rule, [scene])]
                for some in [[scene] for scene in own] + ([own] if len(own) > 1 else []):
                    everything.append([rule, *told, f"{pixels:,}", ", ".join(some), *cells(alike, rule, some)])
    write_csv(PAGE_DATA / "overfitting.csv", everything)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(CHOOSING), help="names of captures")
    parser.add_argument("--views", nargs="+", type=int, default=[3, 6, 12, 0], help="training views; 0: all")
    parser.add_argument("--rules", nargs="+", choices=RULES, default=list(RULES))
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--pixels", type=int, default=12_000, help="of a photograph, at most")
    parser.add_argument("--gaussians", type=int, default=8_000, help="at most")
    parser.add_argument("--units", nargs="+", type=int, default=[0], help="of (seed, first held-out view): 0, 1, 2")
    parser.add_argument("--trained", default="fast", help="as `drgs fit --for` takes it")
    parser.add_argument("--seen", nargs="+", default=list(SEEN), help="presets that measure, `fast` among them")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the captures")
    parser.add_argument("--made", type=Path, default=ROOT / "runs" / "made", help="folder of the made scenes")
    parser.add_argument("--page", action="store_true", help="fit nothing, write the file of the rows that there are")
    args = parser.parse_args()
    fits = [(s, v, r, u) for s in args.scenes for v in args.views for u in args.units for r in args.rules]
    for scene, views, rule, unit in [] if args.page else fits:
        done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
        key = (scene, rule, views, args.trained, *UNITS[unit], args.steps, args.pixels, args.gaussians)
        if key in done:
            continue
        row = fit(key, args.seen, folder_of(scene, args.made, args.data))
        add_row(ROWS, row)
        mean = [f"{sum(x) / len(x):.2f}/{min(x):.2f}" for x in row["psnr"].values()]
        way = " ".join(f"{x[2]:.2f}" for x in row["curve"])
        print(scene, views, rule, row["points"], *mean, f"({way})", f"{row['seconds']:.1f} s", flush=True)
    if args.page:
        write_file(read_rows(ROWS))


if __name__ == "__main__":
    main()
