"""How often a pick of one view is the same, and how much sooner it is there, when candidates are scored by a quarter of
their pixels first (`drgs.select_views(halving=True)`).

    python benchmarks/halving.py RUN [RUN ...]

Of each run, of a scene that stands still, `CHOICES` times 2 to 12 training views are known and 10 to 30 others are
candidates, all at random, of `PIXELS` pixels, scored by the default criterion. A pick lacks what its score by all
pixels is below the best. Times are those of one pick with up to 12 known views and 80 candidates, nothing cached. Adds
a row a run to benchmarks/halving.jsonl, leaves out what is there, and writes docs/data/halving.csv.
"""

from __future__ import annotations

import functools
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
from studies import write_csv  # noqa: E402
from where import ran, rows_of_runs  # noqa: E402

from drgs.cameras.sizes import at_most  # noqa: E402
from drgs.data import load  # noqa: E402
from drgs.fitting.records import load_run  # noqa: E402
from drgs.select import Cache, Scoring, select  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "halving.jsonl"
CSV = ROOT / "docs" / "data" / "halving.csv"
PIXELS = 76_800  # as many as 320x240 has
CHOICES = 15  # of a scene
VIEWS = 60  # that choices draw from, at most, so that all their information is kept
KNOWN, CANDIDATES = 12, 80  # at most, of the pick that is timed
CHOSEN_ON = ("banana", "fern", "office")  # the scenes that the margin was chosen on


def measured(path: Path) -> dict:
    """The row of one run."""
    run = load_run(path)
    views = load(run.record.data, lazy=True, points=False).split()[0]
    cameras = [at_most(view.camera.undistorted(), PIXELS) for view in views]
    rng = np.random.default_rng(0)
    cameras = [cameras[i] for i in rng.permutation(len(cameras))]
    scoring = Scoring(settings=RenderSettings.preset("fast"), blocks=("geometry", "backdrop"))
    choose = functools.partial(select, run.scene, scoring=scoring)
    count = min(KNOWN, len(cameras) // 3)
    timed = cameras[count : count + CANDIDATES], cameras[:count]
    if not choose(timed[0][:8], timed[1]).pixels:  # compiles, too
        sys.exit(f"{path}: views must have enough pixels for some to be left out, have {PIXELS} or fewer; leave it out")
    seconds = {}
    for halving in (False, True):
        began = time.process_time()
        choose(*timed, halving=halving)
        seconds[halving] = time.process_time() - began
    cache, lacks = Cache(1 << 32), []
    drawn = cameras[:VIEWS]
    for _ in range(CHOICES):
        order = rng.permutation(len(drawn))
        known = int(rng.integers(2, min(12, len(drawn) // 3) + 1))
        some = order[known : known + int(rng.integers(10, 31))]
        told = [drawn[i] for i in some], [drawn[i] for i in order[:known]]
        scores = choose(*told, halving=False, cache=cache).scores
        lacks.append(1 - scores[choose(*told, cache=cache).picks[0].index] / max(scores))
    return {
        "run": path.name,
        "gaussians": len(run.scene),
        "pixels": cameras[0].width * cameras[0].height,
        "choices": CHOICES,
        "same": sum(x == 0 for x in lacks),
        "lacks": float(np.mean(lacks)),
        "worst": max(lacks),
        "known": count,
        "candidates": len(timed[0]),
        "seconds": seconds[True],
        "full_seconds": seconds[False],
        **ran(),
    }


def csv_lines(rows: list[dict]) -> Iterator[list[str]]:
    """A line a run; those that the margin was chosen on come last."""
    told = ("run", "gaussians", "pixels", "choices")
    picks = ("same pick", "the pick lacks, mean", "worst")
    times = ("known", "candidates", "CPU seconds", "by all pixels")
    yield [*told, *picks, *times, "margin chosen on it", "machine", "date", "commit"]
    for row in sorted(rows, key=lambda row: (row["run"] in CHOSEN_ON, row["run"])):
        lacks = [f"{row['lacks']:.5f}", f"{row['worst']:.4f}"]
        seconds = [f"{row['seconds']:.2f}", f"{row['full_seconds']:.2f}"]
        counts = [str(row["known"]), str(row["candidates"])]
        where = ["yes" if row["run"] in CHOSEN_ON else "no", row["machine"], row["date"], row["commit"]]
        yield [*(str(row[key]) for key in told), str(row["same"]), *lacks, *counts, *seconds, *where]


def main() -> None:
    """The program."""
    write_csv(CSV, csv_lines(rows_of_runs(ROWS, measured, __doc__)))


if __name__ == "__main__":
    main()
