"""What a pick in a scene that moves costs and how right it is: fewer pixels, fewer probes.

    python benchmarks/picks.py RUN [RUN ...] [--candidates 30] [--page]

Of each run the training cameras of the first time are known, and cameras of later times are scored: by the default
criterion with all blocks but `semantic`, as a pick of `drgs fit --views active` does. The right scores are those of all
pixels and `EXACT` probes. Appends one row a run, share of the pixels and number of probes to benchmarks/picks.jsonl,
leaves out what is there; with --page it writes docs/data/moving-picks.csv.
"""

from __future__ import annotations

import argparse
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
from studies import rank_correlation, write_csv  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

from drgs.cameras import Camera  # noqa: E402
from drgs.cameras.sizes import at_most  # noqa: E402
from drgs.data import load  # noqa: E402
from drgs.ellipsoids import Scene  # noqa: E402
from drgs.fitting.records import load_run  # noqa: E402
from drgs.select import Scoring, select  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "picks.jsonl"
CSV = ROOT / "docs" / "data" / "moving-picks.csv"
EXACT = 64  # probes of the right scores
SHARES = (1, 4, 16)  # of all pixels one in so many
PROBES = (4, 8, 16)
BLOCKS = ("geometry", "deformation", "backdrop")


def scored(scene: Scene, candidates: list[Camera], known: list[Camera], pixels: int, probes: int) -> tuple:
    """Scores of the candidates, and the CPU seconds that they took."""
    scoring = Scoring(settings=RenderSettings.preset("fast"), blocks=BLOCKS, probes=probes)
    began = time.process_time()
    chosen = select(
        scene, [at_most(x, pixels) for x in candidates], [at_most(x, pixels) for x in known], 1, scoring=scoring
    )
    return np.array(chosen.scores), time.process_time() - began


def measure(path: Path, count: int) -> None:
    """Rows of one run that are not there yet."""
    run = load_run(path)
    views = load(run.record.data).split()[0]
    times = sorted({view.camera.time for view in views})
    known = [view.camera.undistorted() for view in views if view.camera.time == times[0]]
    later = [view.camera.undistorted() for view in views if view.camera.time != times[0]]
    order = np.random.default_rng(0).permutation(len(later))[:count]
    candidates = [later[i] for i in sorted(order)]
    pixels = candidates[0].width * candidates[0].height
    there = {(row["run"], row["share"], row["probes"]) for row in read_rows(ROWS)}
    wanted = [(share, probes) for share in SHARES for probes in PROBES if (path.name, share, probes) not in there]
    if not wanted:
        return
    scene = run.moving
    assert scene is not None, f"{path}: nothing moves"
    truth, exact = scored(scene, candidates, known, pixels, EXACT)
    for share, probes in wanted:
        scores, seconds = scored(scene, candidates, known, max(pixels // share, 1), probes)
        row = {
            "run": path.name,
            "gaussians": len(scene),
            "moving": int(scene.moving.sum()),
            "pixels": pixels,
            "known": len(known),
            "candidates": len(candidates),
            "share": share,
            "probes": probes,
            "seconds": seconds,
            "exact_seconds": exact,
            "tau": rank_correlation(truth, scores, "kendall"),
            "short": float(1 - truth[scores.argmax()] / truth.max()),
        }
        add_row(ROWS, row | ran())
        print(row, flush=True)


def csv_lines(rows: list[dict]) -> Iterator[list[str]]:
    """A line a run, share of the pixels and number of probes."""
    counts = ("gaussians", "moving", "pixels", "known", "candidates")
    names = ("pixels used, one in", "probes", "CPU seconds", "Kendall's tau", "what the best lacks")
    yield ["run", *counts, *names, "machine", "date", "commit"]
    for row in sorted(rows, key=lambda row: (row["run"], row["share"], row["probes"])):
        found = [f"{row['seconds']:.1f}", f"{row['tau']:.2f}", f"{row['short']:.3f}"]
        told = [str(row[key]) for key in (*counts, "share", "probes")]
        yield [row["run"], *told, *found, row["machine"], row["date"], row["commit"]]


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--candidates", type=int, default=30, help="how many are scored")
    parser.add_argument("--page", action="store_true", help="write the data file of what is there")
    args = parser.parse_args()
    for path in args.runs:
        measure(path, args.candidates)
    if args.page:
        write_csv(CSV, csv_lines(read_rows(ROWS)))


if __name__ == "__main__":
    main()
