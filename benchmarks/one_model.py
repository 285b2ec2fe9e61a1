"""One model in every renderer: fits with one renderer alone and with several in turn, each seen with all of them.

    python benchmarks/one_model.py [--scenes head bonsai ...] [--trained fast any ...] [--seeds 3] [--steps 400]
    python benchmarks/one_model.py --page

Appends one row a fit to benchmarks/one_model.jsonl as it ends, leaves out what is there, then writes the table of
docs/one-model.md and docs/data/one-model*.csv. Scenes are captures by name, or folders. Each seed holds out other
views, but of data sets that have a split of their own. The cycles were chosen on banana, fern, statue and lego, which
the averages leave out. One thread. What a mix costs is the average of the medians of its presets' steps over the median
of the steps with `fast` of the same fit, so that other work on the machine takes from both.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from fits import fitted, psnr_by_renderer  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, table_lines, write_csv  # noqa: E402
from where import UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import frames_for  # noqa: E402
from drgs.fitting.renderers import ANY, RendererSchedule, renderers_to_measure  # noqa: E402
from drgs.settings import PRESETS, RenderSettings  # noqa: E402
from drgs.studies.statistics import Unit, estimate  # noqa: E402

SHOWN = tuple(name for name in ANY if name != "inria")  # on the page; of `inria` there is one seed
ROWS = ROOT / "benchmarks" / "one_model.jsonl"
PAGE = ROOT / "docs" / "one-model.md"
SCENES = ("head", "bonsai", "office", "lego", "banana", "fern", "statue")
TUNED_ON = ("banana", "fern", "statue", "lego")
SIZE = {"max_steps": 400, "max_pixels": 12_000, "max_gaussians": 8_000}
KEY = ("scene", "trained", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")


def measured(scene: str, trained: str, seed: int, offset: int, size: dict) -> dict:
    """One fit, and its held-out views in each renderer."""
    names = tuple(trained.split(","))
    settings = RenderSettings.preset(trained if trained in PRESETS else "fast")
    config = FitConfig().replace(settings=settings, renderers=names, seed=seed, test_offset=offset, **size)
    fit = fitted(scene, config)
    schedule = RendererSchedule.of(config.renderers, config.settings)
    took: dict[RenderSettings, list[float]] = {}
    for step, seconds in enumerate(fit.step_seconds):
        took.setdefault(schedule.settings_at(step), []).append(seconds)
    renderers = renderers_to_measure(names, config.settings, "all")
    psnr = psnr_by_renderer(fit.gaussians, frames_for(fit.test, config.data), renderers)
    step_ms = {settings.nearest_preset()[0]: 1000 * statistics.median(each) for settings, each in took.items()}
    average = sum(step_ms[settings.nearest_preset()[0]] * len(each) for settings, each in took.items())
    average /= config.max_steps
    return {
        **dict(zip(KEY, (Path(scene).name, trained, seed, offset, *size.values()), strict=True)),
        "psnr": {name: views for name, views in psnr.items() if name in ANY},
        "step_ms": step_ms,
        "over_fast": average / step_ms["fast"] if "fast" in step_ms else None,
        **ran(),
    }


def _unit(row: dict) -> tuple[str, int, int]:
    """What fits that are compared have in common: capture, seed, first held-out view."""
    return row["scene"], row["seed"], row["offset"]


def _lags(found: list[dict], trained: str, name: str) -> dict[tuple, list[float]]:
    """Unit -> dB by which each held-out view, seen with a renderer, is behind that of a fit with it alone."""
    by_fit = {(_unit(row), row["trained"]): row["psnr"] for row in found}
    return {
        unit: [a - b for a, b in zip(psnr[name], by_fit[unit, trained][name], strict=True)]
        for (unit, other), psnr in by_fit.items()
        if other == name and (unit, trained) in by_fit
    }


def behind(found: list[dict], seen: Sequence[str] = ANY) -> str:
    """How far fits are behind the one for each renderer alone, of the same capture, split and seed.

    Args:
        found: Rows of one length.
        seen: Renderers that they are seen with.
    """
    lines = [
        "| trained with | seen with | behind, on average (95 %) | most, of a capture | most, of a view | captures |"
    ]
    lines += ["|---|---|---|---|---|---|"]
    reported = [row for row in found if row["scene"] not in TUNED_ON]
    for trained in ("any", "fast", "gsplat"):
        for name in seen:
            lags: dict[Unit, list[float]] = {}
            if name != trained:
                lags = {(unit[0], unit[1:], ()): views for unit, views in _lags(reported, trained, name).items()}
            if not lags:
                continue
            effect = estimate({key: statistics.mean(views) for key, views in lags.items()})
            scenes = {scene: [statistics.mean(v) for k, v in lags.items() if k[0] == scene] for scene, *_ in lags}
            most, scene = max((statistics.mean(means), scene) for scene, means in scenes.items())
            view, where = max((max(views), key[0]) for key, views in lags.items())
            average = f"{effect.mean:.2f} ({effect.low:.2f} to {effect.high:.2f})"
            cells = [f"`{name}`", average, f"{most:.2f} ({scene})", f"{view:.1f} ({where})", f"{effect.scenes}"]
            lines.append(f"| {trained} | {' | '.join(cells)} |")
    return "\n".join(lines)


def longer(found: list[dict]) -> str:
    """How far `any` is behind in fits of several lengths: for each capture, over the units that all lengths have."""
    lines = ["| capture (fits) | steps | seen with | fit for it alone | `any` is behind | most, of a view |"]
    lines += ["|---|---|---|---|---|---|"]
    for scene in dict.fromkeys(row["scene"] for row in found if row["max_steps"] != SIZE["max_steps"]):
        mine = [row for row in found if row["scene"] == scene]
        lengths = sorted({row["max_steps"] for row in mine})
        for name in ANY:
            lags = {steps: _lags([row for row in mine if row["max_steps"] == steps], "any", name) for steps in lengths}
            units = set.intersection(*(set(each) for each in lags.values()))
            for steps in lengths if units else ():
                views = [lag for unit in units for lag in lags[steps][unit]]
                alone = [
                    statistics.mean(row["psnr"][name])
                    for row in mine
                    if (row["max_steps"], row["trained"]) == (steps, name) and _unit(row) in units
                ]
                cells = [f"{scene} ({len(units)})", f"{steps:,}", f"`{name}`", f"{statistics.mean(alone):.2f}"]
                lines.append(f"| {' | '.join(cells)} | {statistics.mean(views):.2f} | {max(views):.1f} |")
    return "\n".join(lines)


def tables(found: list[dict]) -> str:
    """Mean and worst held-out PSNR by scene, and what a step of a mix costs."""
    lines = ["| capture (held out) | trained with | " + " | ".join(f"`{name}`" for name in ANY) + " | step / `fast` |"]
    lines += ["|---|---|" + "---|" * len(ANY) + "---|"]
    for scene in dict.fromkeys(row["scene"] for row in found):
        mine = [row for row in found if row["scene"] == scene]
        for trained in dict.fromkeys(row["trained"] for row in mine):
            group = [row for row in mine if row["trained"] == trained]
            cells = []
            for name in ANY:
                means = [statistics.mean(row["psnr"][name]) for row in group]
                worst = min(min(row["psnr"][name]) for row in group)
                cells.append(f"{statistics.mean(means):.2f} / {worst:.2f}")
            count = "+".join(str(len(row["psnr"][ANY[0]])) for row in group)
            ratios = [row["over_fast"] for row in group if row["over_fast"]]
            ratio = f"{statistics.mean(ratios):.2f}" if ratios else "-"
            lines.append(f"| {scene} ({count}) | {trained} | {' | '.join(cells)} | {ratio} |")
    return "\n".join(lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures, or folders")
    parser.add_argument("--trained", nargs="+", default=[*ANY, "any"], help="as `drgs fit --for` takes them")
    parser.add_argument("--seeds", type=int, default=len(UNITS), choices=range(1, len(UNITS) + 1))
    parser.add_argument("--steps", type=int, default=SIZE["max_steps"])
    parser.add_argument("--page", action="store_true", help="fit nothing, write the tables of the rows that there are")
    args = parser.parse_args()
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    size = SIZE | {"max_steps": args.steps}
    for scene in [] if args.page else args.scenes:
        for trained in args.trained:
            for seed, offset in UNITS[: args.seeds]:
                if (Path(scene).name, trained, seed, offset, *size.values()) not in done:
                    row = measured(scene, trained, seed, offset, size)
                    add_row(ROWS, row)
                    means = {name: round(statistics.mean(values), 2) for name, values in row["psnr"].items()}
                    print(scene, trained, seed, means, flush=True)
    found = read_rows(ROWS)
    short = [row for row in found if row["max_steps"] == SIZE["max_steps"]]
    few = behind(short, SHOWN).splitlines()  # the page leaves worst views, and fits for one, to the data file
    few = ["|".join(line.split("|")[:5]) + "|" for line in few if not line.startswith(("| fast |", "| gsplat |"))]
    print(*few, sep="\n")
    fill_between(PAGE, "behind", "\n".join(few))
    write_csv(PAGE_DATA / "one-model.csv", table_lines(tables(short)))
    write_csv(PAGE_DATA / "one-model-behind.csv", table_lines(behind(short)))
    write_csv(PAGE_DATA / "one-model-steps.csv", table_lines(longer(found)))


if __name__ == "__main__":
    main()
