"""Learning rates for fits of some hundred steps: those of 3DGS, which are for 30,000, and larger ones.

    python benchmarks/rates.py [--scenes banana ...] [--steps 400 1500] [--page]

Appends one row a fit to benchmarks/rates.jsonl as it ends, leaves out what is there, then writes
docs/data/rates.csv and rates-whole.csv. Scenes are captures by name, or paths of scenes that move or have a teacher:
those are fitted with the defaults of `drgs fit`, and have a table of their own. One thread, one seed.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from fits import fitted, psnr_by_renderer  # noqa: E402
from studies import PAGE_DATA, table_lines, write_csv  # noqa: E402
from where import DATA, add_row, ran, read_rows  # noqa: E402

from drgs.data import load  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import frames_for  # noqa: E402
from drgs.fitting.renderers import renderers_to_measure  # noqa: E402
from drgs.train import fit  # noqa: E402

ROWS = ROOT / "benchmarks" / "rates.jsonl"
SCENES = ("banana", "fern", "statue")
SIZE = {"max_pixels": 12_000, "max_gaussians": 8_000}
SEEN = ("exact", "fast", "gsplat")
BEFORE = {
    "means_rate": (1.6e-4, 1.6e-6),
    "scale_rate": 5e-3,
    "rest_rate": 1.25e-4,
    "rotation_rate": 1e-3,
    "opacity_rate": 0.05,
    "dc_rate": 2.5e-3,
}
# Name -> factors of what `BEFORE` says
FACTORS: dict[str, dict[str, float]] = {
    "3DGS": {},
    "scales x 4": {"scale_rate": 4},
    "scales, means, SH x 4": {"scale_rate": 4, "means_rate": 4, "rest_rate": 4},
    "scales, means, SH x 4, opacities x 2": {"scale_rate": 4, "means_rate": 4, "rest_rate": 4, "opacity_rate": 2},
    "scales, means, SH, colors x 4": {"scale_rate": 4, "means_rate": 4, "rest_rate": 4, "dc_rate": 4},
    "scales, means, SH x 8": {"scale_rate": 8, "means_rate": 8, "rest_rate": 8},
    "scales, means, SH, rotations x 4": {"scale_rate": 4, "means_rate": 4, "rest_rate": 4, "rotation_rate": 4},
    "scales, means x 4, SH x 8": {"scale_rate": 4, "means_rate": 4, "rest_rate": 8},
}
SCORES = ("psnr", "ssim", "miou")
KEY = ("scene", "rates", "steps", "max_pixels", "max_gaussians")


def options_of(rates: str) -> dict:
    """The rates that a name stands for, as options of a fit."""
    options = dict(BEFORE)
    for name, factor in FACTORS[rates].items():
        value = BEFORE[name]
        options[name] = tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value
    return options


def measured(scene: str, rates: str, steps: int) -> dict:
    """One fit for all renderers, and its held-out views; by the defaults where more than color is fitted."""
    dataset = load(DATA / scene)
    if dataset.is_dynamic or dataset.semantics is not None:
        return measured_whole(scene, rates, steps)
    config = FitConfig().replace(renderers=("any",), max_steps=steps, **SIZE, **options_of(rates))
    done = fitted(scene, config)
    renderers = renderers_to_measure(config.renderers, config.settings, "all")
    return {
        **dict(zip(KEY, (scene, rates, steps, *SIZE.values()), strict=True)),
        "psnr": psnr_by_renderer(done.gaussians, frames_for(done.test, config.data), renderers),
        "seconds": done.process_seconds,
        **ran(),
    }


def measured_whole(scene: str, rates: str, steps: int) -> dict:
    """A fit of what moves or has a teacher, with the defaults of `drgs fit` but for its size, and its scores."""
    config = FitConfig().replace(max_steps=steps, **SIZE, **options_of(rates))
    with tempfile.TemporaryDirectory() as folder:
        metrics = fit(load(DATA / scene), Path(folder) / "run", config, progress=False).metrics
    scores = metrics["scores"] | {"worst": min(view["psnr"] for view in metrics["views"])}
    return {
        **dict(zip(KEY, (Path(scene).name, rates, steps, *SIZE.values()), strict=True)),
        "scores": {name: value for name, value in scores.items() if name in (*SCORES, "worst")},
        "seconds": metrics["seconds"],
        **ran(),
    }


def whole_table(found: list[dict]) -> str:
    """Scores of fits of what moves or has a teacher, with the rates of 3DGS and with larger ones."""
    lines = ["| scene | steps | rates | PSNR, mean / worst | SSIM | mIoU |", "|---|---|---|---|---|---|"]
    for row in sorted((row for row in found if "scores" in row), key=lambda row: (row["scene"], row["steps"])):
        scores = row["scores"]
        labels = f"{scores['miou']:.3f}" if "miou" in scores else "-"
        cells = [row["scene"], f"{row['steps']:,}", row["rates"], f"{scores['psnr']:.2f} / {scores['worst']:.2f}"]
        lines.append(f"| {' | '.join(cells)} | {scores['ssim']:.3f} | {labels} |")
    return "\n".join(lines)


def table(found: list[dict]) -> str:
    """Means and worst views with the rates of 3DGS, and what others add."""
    lines = ["| capture | steps | rates | `exact` | `fast` | `gsplat` | seconds |", "|---|---|---|---|---|---|---|"]
    found = [row for row in found if "psnr" in row]
    for scene, steps in sorted({(row["scene"], row["steps"]) for row in found}):
        by_rates = {row["rates"]: row for row in found if (row["scene"], row["steps"]) == (scene, steps)}
        plain = by_rates.get("3DGS")
        if plain is None:
            continue
        for name in FACTORS:
            if (row := by_rates.get(name)) is None:
                continue
            cells = []
            for seen in SEEN:
                mean, worst = statistics.mean(row["psnr"][seen]), min(row["psnr"][seen])
                if row is plain:
                    cells.append(f"{mean:.2f} / {worst:.2f}")
                else:
                    mean -= statistics.mean(plain["psnr"][seen])
                    worst -= min(plain["psnr"][seen])
                    cells.append(f"{mean:+.2f} / {worst:+.2f}")
            lines.append(f"| {scene} | {steps:,} | {name} | {' | '.join(cells)} | {row['seconds']:.0f} |")
    return "\n".join(lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures")
    parser.add_argument("--steps", nargs="+", type=int, default=[400, 1500])
    parser.add_argument("--rates", nargs="+", choices=FACTORS, default=list(FACTORS))
    parser.add_argument("--page", action="store_true", help="fit nothing, write the tables of the rows that there are")
    args = parser.parse_args()
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    for steps in args.steps:
        for scene in [] if args.page else args.scenes:
            for rates in args.rates:
                if (Path(scene).name, rates, steps, *SIZE.values()) not in done:
                    row = measured(scene, rates, steps)
                    add_row(ROWS, row)
                    said = row.get("scores") or {x: statistics.mean(row["psnr"][x]) for x in SEEN}
                    print(scene, steps, rates, {name: round(x, 3) for name, x in said.items()}, flush=True)
    rows = read_rows(ROWS)
    for name, text in (("rates", table(rows)), ("rates-whole", whole_table(rows))):
        print(text)
        write_csv(PAGE_DATA / f"{name}.csv", table_lines(text))


if __name__ == "__main__":
    main()
