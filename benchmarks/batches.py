"""Photographs in two batches: a fit that goes on as `drgs capture --add` does, against one to all of them anew.

    python benchmarks/batches.py [--page]

Appends one row a split and way to benchmarks/batches.jsonl as it ends, leaves out what is there, then writes
docs/data/batches.csv, which docs/tutorials/phone.md links to. Of the capture `banana`, ten photographs (or fourteen)
are captured, every eighth of them held out; the other ones join by `--add`, held out stay the same two; and fits to all
of them begin anew, on the same poses, with as many Gaussians as those that joined. From the rows was chosen from how
many on `--add` begins anew, which is switched off here. Photographs have 12,000 pixels. One seed; seconds are those
that the process computed, of the first two ways with poses and pages.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from studies import write_csv  # noqa: E402
from where import DATA, add_row, ran, read_rows  # noqa: E402

from drgs.capturing import fit as capture_fit  # noqa: E402
from drgs.commands.capture import capture_photographs  # noqa: E402
from drgs.commands.options import Capture  # noqa: E402
from drgs.data import load  # noqa: E402
from drgs.data.images import list_images  # noqa: E402
from drgs.files import Run  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.train import fit  # noqa: E402

ROWS = ROOT / "benchmarks" / "batches.jsonl"
TABLE = ROOT / "docs" / "data" / "batches.csv"
JOINING = {6: (1, 3, 6, 9, 11, 15), 2: (3, 11)}
"""Number of photographs that join -> which of the sixteen, in the order of their names."""
ANEW = (200, 400, 600)
CONFIG = FitConfig().replace(max_steps=400, max_pixels=12_000, max_gaussians=8_000, exposure="auto")


def measure(count: int, folder: Path) -> None:
    """All ways of one split."""
    capture_fit.NEW_FIT_SHARE = float("inf")
    photographs = list_images(DATA / "banana" / "images")
    more = tuple(photographs[k] for k in JOINING[count])
    first = tuple(path for path in photographs if path not in more)
    run = folder / "run"

    def added(way: str, path: Path, began: float) -> None:
        run_of = Run(path)
        metrics = json.loads((path / "metrics.json").read_text())
        row = {
            "joining": count,
            "way": way,
            "photographs": len(run_of.config()["train"]),
            "held_out": run_of.config()["test"],
            "steps": metrics["step"],
            "gaussians": metrics["gaussians"],
            "psnr": metrics["mean"]["psnr"],
            "seconds": time.process_time() - began,
        }
        add_row(ROWS, row | ran())
        print(row, flush=True)

    began = time.process_time()
    capture_photographs(Capture(paths=first, output=run, quiet=True), CONFIG)
    added("first", run, began)
    shutil.copytree(run, folder / "before", symlinks=True, ignore=shutil.ignore_patterns(".drgs.lock"))
    began = time.process_time()
    capture_photographs(Capture(paths=more, output=run, add=True, quiet=True), CONFIG)
    added("joined", run, began)
    config = FitConfig.from_json(Run(run).config()["fit"])
    for steps in ANEW:
        began = time.process_time()
        fit(load(run / "capture/scene"), folder / f"anew{steps}", config.replace(max_steps=steps), progress=False)
        added("anew", folder / f"anew{steps}", began)


def table(rows: list[dict]) -> list[list[str]]:
    """A row a split and way."""
    words = {"first": "{n}", "joined": "and {k} that join", "anew": "all {n} from the beginning"}
    lines = [["photographs", "steps", "Gaussians", "held-out PSNR (dB)"]]
    for row in rows:
        what = words[row["way"]].format(n=row["photographs"], k=row["joining"])
        steps = f"and {row['steps']}" if row["way"] == "joined" else f"{row['steps']}"
        lines.append([what, steps, f"{row['gaussians']}", f"{row['psnr']:.2f}"])
    return lines


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help="measure nothing, write the data file of what is there")
    args = parser.parse_args()
    done = {row["joining"] for row in read_rows(ROWS) if row["way"] == "anew" and row["steps"] == ANEW[-1]}
    for count in () if args.page else [x for x in JOINING if x not in done]:
        with tempfile.TemporaryDirectory() as folder:
            measure(count, Path(folder))
    write_csv(TABLE, table(read_rows(ROWS)))


if __name__ == "__main__":
    main()
