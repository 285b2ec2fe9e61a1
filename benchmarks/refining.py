"""What moving a pick brings for its time, against more candidates.

    python benchmarks/refining.py RUN [RUN ...] [--page]

Of each run the views that it was fitted to are known. A dome of candidates is made as `drgs select --candidates dome`
makes it, from `COUNTS` cameras, and from `START` of them with picks that are moved. Every pick is then scored by the
default criterion in one pool: the known views, the densest dome, and all picks. Appends one row a run and way to
benchmarks/refining.jsonl and leaves out runs that are there; `--page` writes the paragraph of docs/information.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
from pages import fill_between  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

from drgs.cameras import Camera  # noqa: E402
from drgs.commands.options import Select  # noqa: E402
from drgs.commands.scene_input import SceneInput  # noqa: E402
from drgs.commands.viewpoints import known_views, views_to_compare  # noqa: E402
from drgs.select import Refine, Scoring, select  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

ROWS = ROOT / "benchmarks" / "refining.jsonl"
PAGE = ROOT / "docs" / "information.md"
COUNTS = (20, 40, 80, 160)
START = 20
EVALUATIONS = (10, 20, 40, 80)
SHOWN = (str(START), "160", f"{START} + 40")  # of these, on the page
PIXELS = 10_000


def measure(path: Path) -> None:
    """The rows of one run."""
    args = Select(scene=path, candidates="dome", info_pixels=PIXELS)
    given = SceneInput.of(args)
    known = known_views(None, args, given)
    scoring = Scoring(settings=given.over_background(RenderSettings.preset("fast")))

    def dome(count: int) -> list[Camera]:
        return views_to_compare(
            "--candidates", "dome", dataclasses.replace(args, count=count), given, known, fresh=True
        )[0]

    ways: dict[str, tuple[Camera, float]] = {}
    for name, count, refine in (
        *((str(count), count, None) for count in COUNTS),
        *((f"{START} + {most}", START, Refine(evaluations=most)) for most in EVALUATIONS),
    ):
        candidates = dome(count)
        began = time.process_time()
        (pick,) = select(given.scene, candidates, known.cameras, 1, scoring=scoring, refine=refine).picks
        ways[name] = pick.camera or candidates[pick.index], time.process_time() - began
    everyone = [*dome(COUNTS[-1]), *(camera for camera, _ in ways.values())]
    scores = select(given.scene, everyone, known.cameras, 1, scoring=scoring).scores
    for (name, (_, seconds)), score in zip(ways.items(), scores[-len(ways) :], strict=True):
        row = {"run": path.name, "known": len(known.cameras), "way": name, "seconds": seconds, "score": score}
        add_row(ROWS, row | ran())
        print(row, flush=True)


def report(rows: list[dict]) -> str:
    """What the page says: averages over the runs."""
    runs = sorted({row["run"] for row in rows})
    of = {(row["run"], row["way"]): row for row in rows}
    told = []
    for way in SHOWN:
        own = [of[run, way] for run in runs if (run, way) in of]
        gains = [row["score"] / of[row["run"], str(START)]["score"] for row in own]
        seconds = np.mean([row["seconds"] for row in own])
        gained = f", {np.mean(gains):.2f} ({min(gains):.2f} to {max(gains):.2f})" if way != str(START) else ""
        tried = way.partition(" + ")
        what = f"{tried[0]} candidates" + (f" and {tried[2]} moves" if tried[2] else "")
        told.append(f"{what} {seconds:.1f} s{gained}")
    names = ", ".join(f"`{run}`" for run in runs)
    return paragraph(
        f"CPU time of a pick, and its score relative to {START} candidates (range over {names}): {'; '.join(told)} "
        f"(`python benchmarks/refining.py`, {PIXELS:,} pixels a view, {rows[-1]['machine']}, {rows[-1]['date']})."
    )


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--page", action="store_true", help="write the table of what is there")
    args = parser.parse_args()
    there = {row["run"] for row in read_rows(ROWS)}
    for path in args.runs:
        if path.name not in there:
            measure(path)
    text = report(read_rows(ROWS))
    print(text)
    if args.page:
        fill_between(PAGE, "refining", text)


if __name__ == "__main__":
    main()
