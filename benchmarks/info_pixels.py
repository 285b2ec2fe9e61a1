"""What a pick among still views costs and how right it is with fewer pixels (`--info-pixels`).

    python benchmarks/info_pixels.py RUN [RUN ...] [--page]

RUN is a fit of something that stands still, begun with `drgs fit --views active`. The views that it has read are known,
all others of its training split are candidates, scored by the default criterion and by `eig`, each with its blocks and
lambda. The right scores are those of views of `FULL` pixels. Appends one row a run, criterion and number of pixels to
benchmarks/info_pixels.jsonl, leaves out what is there; with --page it writes docs/data/info-pixels.csv.
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
from drgs.files import Run  # noqa: E402
from drgs.fitting.records import fitted_views, load_run  # noqa: E402
from drgs.select import Scoring, select  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "info_pixels.jsonl"
CSV = ROOT / "docs" / "data" / "info-pixels.csv"
FULL = 76_800  # as many as 320x240 has
PIXELS = (38_400, 19_200, 9_600, 4_800, 2_400, 1_200)
CRITERIA = ("v_opt", "eig")
MOST = 80  # candidates


def scored(
    scene: Scene, candidates: list[Camera], known: list[Camera], pixels: int, criterion: str
) -> tuple[np.ndarray, float]:
    """Scores of the candidates, and the CPU seconds that they took."""
    scoring = Scoring(settings=RenderSettings.preset("fast"), criterion=criterion)
    began = time.process_time()
    chosen = select(
        scene,
        [at_most(x, pixels) for x in candidates],
        [at_most(x, pixels) for x in known],
        1,
        scoring=scoring,
        halving=False,
    )
    return np.array(chosen.scores), time.process_time() - began


def measure(path: Path) -> None:
    """Rows of one run that are not there yet."""
    run = load_run(path)
    views = {view.name: view.camera.undistorted() for view in load(run.record.data, lazy=True, points=False).split()[0]}
    names = fitted_views(Run(path))
    known = [views[name] for name in names]
    others = [camera for name, camera in views.items() if name not in names]
    order = np.random.default_rng(0).permutation(len(others))[:MOST]
    candidates = [others[i] for i in sorted(order)]
    name = run.record.data.resolve().name
    there = {(row["scene"], row["criterion"], row["pixels"]) for row in read_rows(ROWS)}
    for criterion in CRITERIA:
        wanted = [pixels for pixels in PIXELS if (name, criterion, pixels) not in there]
        if not wanted:
            continue
        scored(run.scene, candidates[:1], known[:1], 1_200, criterion)  # compiles
        truth, exact = scored(run.scene, candidates, known, FULL, criterion)
        for pixels in wanted:
            scores, seconds = scored(run.scene, candidates, known, pixels, criterion)
            row = {
                "scene": name,
                "gaussians": len(run.scene),
                "known": len(known),
                "candidates": len(candidates),
                "criterion": criterion,
                "pixels": pixels,
                "seconds": seconds,
                "full_seconds": exact,
                "tau": rank_correlation(truth, scores, "kendall"),
                "same": bool(scores.argmax() == truth.argmax()),
                "short": float(1 - truth[scores.argmax()] / truth.max()),
            }
            add_row(ROWS, row | ran())
            print(row, flush=True)


def csv_lines(rows: list[dict]) -> Iterator[list[str]]:
    """A line a run, criterion and number of pixels."""
    counts = ("gaussians", "known", "candidates")
    names = ("CPU seconds", f"with {FULL} pixels", "Kendall's tau", "same pick", "what the pick lacks")
    yield ["scene", *counts, "criterion", "pixels", *names, "machine", "date", "commit"]
    for row in sorted(rows, key=lambda row: (row["scene"], row["criterion"], -row["pixels"])):
        seconds = [f"{row['seconds']:.1f}", f"{row['full_seconds']:.1f}"]
        found = [f"{row['tau']:.3f}", "yes" if row["same"] else "no", f"{row['short']:.4f}"]
        told = [str(row[key]) for key in (*counts, "criterion", "pixels")]
        yield [row["scene"], *told, *seconds, *found, row["machine"], row["date"], row["commit"]]


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--page", action="store_true", help="write the data file of what is there")
    args = parser.parse_args()
    for path in args.runs:
        measure(path)
    if args.page:
        write_csv(CSV, csv_lines(read_rows(ROWS)))


if __name__ == "__main__":
    main()
