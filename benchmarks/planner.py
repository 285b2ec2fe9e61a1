"""What `drgs.Planner` costs over many photographs, and what it loses by keeping what views told of an earlier model.

    python benchmarks/planner.py DATA --frames 500           rows as they come, kept: benchmarks/planner.jsonl
    python benchmarks/planner.py DATA --frames 200 --bounds
    python benchmarks/planner.py --page                      docs/planner.md and its data files

DATA is a sequence with depth: `drgs scene room --views 560 --size 120x90 --test-every 10 -o DATA`, or a capture. Its
training views come in their order, 10 steps of the fit after each, and after each one 30 of the held-out views are
scored within a second and three are picked; of a third of the held-out views PSNR is measured.

With `--bounds` nothing else is measured but every tenth photograph: planners with other bounds are asked the same about
the same model, without a limit of time. What is right is the answer of bound 0, which asks every view anew.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "examples")]

import dataclasses  # noqa: E402

import numpy as np  # noqa: E402
from pages import fill_between  # noqa: E402
from plan_views import depth_of, psnr  # noqa: E402
from studies import PAGE_DATA, rank_correlation, write_csv  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

import drgs  # noqa: E402
from drgs.runtime.machine import peak_memory  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

ROWS = ROOT / "benchmarks" / "planner.jsonl"
PAGE = ROOT / "docs" / "planner.md"
BOUNDS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 1.0)
CANDIDATES = 30
STEPS = 10
SECONDS = 1.0
COMPARED_EVERY = 10
WINDOW = 100  # photographs of a line of the data file


def measure(path: Path, frames: int, bounds: bool) -> None:
    """Rows of the photographs of a data set, or of the bounds that are compared on the way."""
    dataset = drgs.load_data(path)
    train, held_out = dataset.split()
    train = train[:frames]
    measured = held_out[::3]
    places = [view.camera.undistorted() for view in held_out if view not in measured][:CANDIDATES]
    cameras = [dataclasses.replace(view.camera.undistorted(), name=view.name) for view in train]
    where = {"data": path.resolve().name} | ran()
    planner = drgs.Planner()
    others = {bound: drgs.Planner(bound=bound) for bound in BOUNDS}
    for number, (view, camera) in enumerate(zip(train, cameras, strict=True)):
        began = time.monotonic()
        planner.observe(view.image(), camera, depth_of(dataset, view))
        observed = time.monotonic()
        planner.fit(steps=STEPS)
        fitted = time.monotonic()
        scene = planner.scene
        assert scene is not None
        if bounds:
            if number % COMPARED_EVERY == 0 and number:
                known = [one for one in cameras[: number + 1] if one.name in planner.views]
                for row in compared(scene, known, places, others):
                    add_row(ROWS, row | {"number": number} | where)
                    print(row, flush=True)
            continue
        plan = planner.scores(places, seconds=SECONDS)
        picked = planner.next(min(3, len(places)), seconds=0)
        row = {
            "what": "photograph",
            "number": number,
            "gaussians": len(scene),
            "known": len(planner.views),
            "observe": observed - began,
            "fit": fitted - observed,
            "scores": plan.seconds,
            "next": picked.seconds,
            "computed": plan.computed,
            "unscored": sum(score is None for score in plan.scores),
            "left_out": plan.left_out,
            "changed": plan.changed,
            "memory": peak_memory(),
        }
        if number % 50 == 49:
            row["psnr"] = psnr(scene, measured[:12], 12_000)
        add_row(ROWS, row | where)
        print({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}, flush=True)


def compared(
    scene: drgs.Gaussians, known: list[drgs.Camera], places: list[drgs.Camera], others: dict[float, drgs.Planner]
) -> list[dict]:
    """A row of each bound, the smallest first: what it asks of a model, and how right its answer is."""
    rows = []
    truth: np.ndarray | None = None
    for bound, other in others.items():
        other.scene = scene
        for one in known:
            if one.name not in other.views:
                other.observe(None, one)
        plan = other.scores(places)
        scores = np.array(plan.scores, float)
        truth = scores if truth is None else truth
        rows.append(
            {
                "what": "bound",
                "bound": bound,
                "seconds": plan.seconds,
                "computed": plan.computed,
                "changed": plan.changed,
                "tau": rank_correlation(truth, scores, "kendall"),
                "short": float(1 - truth[scores.argmax()] / truth.max()),
            }
        )
    return rows


def summary(rows: list[dict]) -> str:
    """What the page says: ranges over the hundreds of photographs but the first, in which the planner fills up."""
    heads, *lines = photographs(rows)
    parts = []
    for name in dict.fromkeys(row["data"] for row in rows):
        frames = [row for row in rows if row["data"] == name and row["what"] == "photograph"]
        last = frames[-1]
        columns = zip(*[line for line in lines if line[0] == name][1:], strict=True)
        told = {
            head: f"{min(cells, key=float)} to {max(cells, key=float)}"
            for head, cells in zip(heads, columns, strict=True)
            if head.endswith("_median")
        }
        parts.append(
            paragraph(
                f"From photograph {WINDOW + 1} to {len(frames)} of `{name}` ({last['gaussians']:,} Gaussians), as "
                f"medians of hundreds, `observe` takes {told['observe_median']} s, `scores` {told['scores_median']} s "
                f"and `next` {told['next_median']} s; the process has held {last['memory'] / 1e9:.2f} GB at most ([by "
                f"hundreds](data/planner.csv); {last['machine']}, {last['date']})."
            )
        )
    return "\n\n".join(parts)


def photographs(rows: list[dict]) -> list[list[str]]:
    """A data file: latency and memory by hundreds of photographs."""
    timed = ("observe", "scores", "next")
    heads = [f"{name}_{kind}" for name in timed for kind in ("median", "largest")]
    lines = [["data", "last", "gaussians", "kept", *heads, "computed", "changed_median", "memory_gb", "held_out_db"]]
    for name in dict.fromkeys(row["data"] for row in rows):
        frames = [row for row in rows if row["data"] == name and row["what"] == "photograph"]
        for begin in range(0, len(frames), WINDOW):
            own = frames[begin : begin + WINDOW]
            cells = [f"{of([x[key] for x in own]):.2f}" for key in timed for of in (np.median, max)]
            cells += [f"{np.mean([x['computed'] for x in own]):.1f}", f"{np.median([x['changed'] for x in own]):.2f}"]
            quality = [f"{x['psnr']:.1f}" for x in own if "psnr" in x]
            cells += [f"{own[-1]['memory'] / 1e9:.2f}", quality[-1] if quality else ""]
            lines.append([name, str(begin + len(own)), str(own[-1]["gaussians"]), str(own[-1]["known"]), *cells])
    return lines


def bounds_sheet(rows: list[dict]) -> list[list[str]]:
    """A data file: bounds against what is computed and how right it is, as means over models."""
    lines = [["data", "bound", "models", "computed", "seconds", "tau", "worst_tau", "short_percent"]]
    compared = [row for row in rows if row["what"] == "bound"]
    for name, bound in sorted({(row["data"], row["bound"]) for row in compared}):
        own = [row for row in compared if (row["data"], row["bound"]) == (name, bound)]
        asked, seconds, tau, short = (np.mean([x[k] for x in own]) for k in ("computed", "seconds", "tau", "short"))
        cells = [f"{bound:g}", str(len(own)), f"{asked:.1f}", f"{seconds:.2f}", f"{tau:.3f}"]
        lines.append([name, *cells, f"{min(x['tau'] for x in own):.2f}", f"{100 * short:.1f}"])
    return lines


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--bounds", action="store_true", help="compare bounds")
    parser.add_argument("--page", action="store_true", help="write what is there to the page and its data files")
    args = parser.parse_args()
    if args.data is not None:
        measure(args.data, args.frames, args.bounds)
    rows = read_rows(ROWS)
    text = summary(rows)
    print(text)
    if args.page:
        fill_between(PAGE, "planner", text)
        write_csv(PAGE_DATA / "planner.csv", photographs(rows))
        write_csv(PAGE_DATA / "planner-bounds.csv", bounds_sheet(rows))


if __name__ == "__main__":
    main()
