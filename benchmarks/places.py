"""How many cameras a fit of what moves needs: the camera that is held out, met from two to eight others.

    python benchmarks/places.py [--quick]     writes benchmarks/places.json and docs/data/moving-cameras.csv
    python benchmarks/places.py --page        measures nothing, writes the data file of what is there

Kitchens are made here, small, one a seed; of their cameras the first, in the middle of the arc, is held out, and the
others are taken evenly from it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import numpy as np  # noqa: E402
from studies import write_csv  # noqa: E402
from where import ran  # noqa: E402

from drgs import cli  # noqa: E402
from drgs.scenes import kitchen  # noqa: E402

COUNTS = (2, 3, 4, 6, 8)
CAMERAS = 9
TIMES = 4
SIZE = (64, 48)
STEPS = 240
GAUSSIANS = 1200
RESULT = ROOT / "benchmarks" / "places.json"
CSV = ROOT / "docs" / "data" / "moving-cameras.csv"


def some(made: Path, folder: Path, count: int) -> Path:
    """The data set with the first camera and `count` of the others, evenly from left to right."""
    folder.mkdir()
    films = sorted(made.glob("cam*.*"))
    rows = np.load(made / "poses_bounds.npy")
    kept = [0, *(1 + round(i) for i in np.linspace(0, len(films) - 2, count))]
    np.save(folder / "poses_bounds.npy", rows[kept])
    for k in kept:
        (folder / films[k].name).symlink_to(films[k].resolve())
    return folder


def held_out(data: Path, run: Path, steps: int) -> float:
    """PSNR in dB of the first camera, of a fit to the others."""
    line = f"fit {data} -o {run} --max-steps {steps} --max-gaussians {GAUSSIANS} --no-report --quiet"
    if cli.main(line.split()):
        raise SystemExit(f"{data}: the fit has failed")
    return float(json.loads((run / "metrics.json").read_text())["mean"]["psnr"])


def csv_lines(r: dict) -> Iterator[list[str]]:
    """PSNR in dB of the held-out camera: a line a kitchen, a column a number of training cameras."""
    yield ["kitchen", *(f"{count} training cameras" for count in r["rows"])]
    for i in range(r["seeds"]):
        yield [str(i), *(f"{row[i]:.2f}" for row in r["rows"].values())]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="one kitchen, few steps: checks that the script runs")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the data file of what is there")
    args = parser.parse_args()
    if args.page:
        write_csv(CSV, csv_lines(json.loads(RESULT.read_text())))
        return
    seeds, steps, counts = (1, 12, COUNTS[:1]) if args.quick else (3, STEPS, COUNTS)
    result: dict = {**ran(), "seeds": seeds, "rows": {str(count): [] for count in counts}}
    with tempfile.TemporaryDirectory() as name:
        for seed in range(seeds):
            work = Path(name) / str(seed)
            size = {"width": SIZE[0], "height": SIZE[1], "cameras": CAMERAS, "times": TIMES}
            made = kitchen.generate(work / "kitchen", **size, spp=2 if args.quick else 16, seed=seed)
            for count in counts:
                psnr = held_out(some(made, work / f"of{count}", count), work / f"run{count}", steps)
                result["rows"][str(count)].append(psnr)
                print(f"kitchen {seed}, {count} cameras: {psnr:.2f} dB", flush=True)
    if not args.quick:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")
        write_csv(CSV, csv_lines(result))


if __name__ == "__main__":
    main()
