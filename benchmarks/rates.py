"""Learning rates for fits of some hundred steps: those of 3DGS, which are for 30,000, and larger ones.

    python benchmarks/rates.py [--scenes banana ...] [--steps 400 1500] [--page]

Appends one row a fit to benchmarks/rates.jsonl as it ends, leaves out what is there, then writes the table of
docs/real-data.md. Scenes are captures by name. One thread, one seed.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from fits import fitted, psnr_by_renderer  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

from drgs.fitting.config import FitConfig, RateConfig  # noqa: E402
from drgs.fitting.frames import load_frames  # noqa: E402
from drgs.fitting.renderers import renderers_to_measure  # noqa: E402
from drgs.studies.tables import fill_between  # noqa: E402

ROWS = ROOT / "benchmarks" / "rates.jsonl"
PAGE = ROOT / "docs" / "real-data.md"
SCENES = ("banana", "fern", "statue")
SIZE = {"max_pixels": 12_000, "max_gaussians": 8_000}
SEEN = ("exact", "fast", "gsplat")
BEFORE = RateConfig(means_rate=(1.6e-4, 1.6e-6), scale_rate=5e-3, rest_rate=1.25e-4)
# Name -> factors of the rates of `BEFORE`
FACTORS: dict[str, dict[str, float]] = {
    "3DGS": {},
    "scales x 4": {"scale_rate": 4},
    "scales, means, SH x 4": {"scale_rate": 4, "means_rate": 4, "rest_rate": 4},
}
KEY = ("scene", "rates", "steps", "max_pixels", "max_gaussians")


def measured(scene: str, rates: str, steps: int) -> dict:
    """One fit for all renderers, and its held-out views."""
    changed = {}
    for name, factor in FACTORS[rates].items():
        value = getattr(BEFORE, name)
        changed[name] = tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value
    same = {name: getattr(BEFORE, name) for name in ("means_rate", "scale_rate", "rest_rate")}
    config = FitConfig.of(renderers=("any",), max_steps=steps, **SIZE, **(same | changed))
    fit = fitted(scene, config)
    renderers = renderers_to_measure(config.renderers, config.settings, "all")
    return {
        **dict(zip(KEY, (scene, rates, steps, *SIZE.values()), strict=True)),
        "psnr": psnr_by_renderer(fit.gaussians, load_frames(fit.test, config.data.max_pixels), renderers),
        "seconds": fit.process_seconds,
        **ran(),
    }


def table(found: list[dict]) -> str:
    """Means and worst views with the rates of 3DGS, and what others add."""
    lines = ["| capture | steps | rates | `exact` | `fast` | `gsplat` | seconds |", "|---|---|---|---|---|---|---|"]
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
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    for steps in args.steps:
        for scene in [] if args.page else args.scenes:
            for rates in FACTORS:
                if (scene, rates, steps, *SIZE.values()) not in done:
                    row = measured(scene, rates, steps)
                    add_row(ROWS, row)
                    print(scene, steps, rates, {x: round(statistics.mean(row["psnr"][x]), 2) for x in SEEN}, flush=True)
    text = table(read_rows(ROWS))
    print(text)
    fill_between(PAGE, "rates", text)


if __name__ == "__main__":
    main()
