"""What `drgs.Planner` costs over many photographs, and what it loses by keeping what views told of an earlier model.

    python benchmarks/planner.py DATA --frames 500           rows as they come, kept: benchmarks/planner.jsonl
    python benchmarks/planner.py DATA --frames 200 --bounds
    python benchmarks/planner.py DATA --frames 200 --memory
    python benchmarks/planner.py --page                      the tables of docs/planner.md

DATA is a sequence with depth: `drgs scene room --views 560 --size 120x90 --test-every 10 -o DATA`, or a capture. Its
training views come in their order, 10 steps of the fit after each, and after each one 30 of the held-out views are
scored within a second and three are picked; of a third of the held-out views PSNR is measured.

With `--bounds` nothing else is measured but every tenth photograph: planners with other bounds are asked the same about
the same model, without a limit of time. What is right is the answer of bound 0, which asks every view anew.

With `--memory` the loop is the same, but rows hold no seconds: what the process holds after every tenth photograph, in
pages (`resident`), in memory that it asked the allocator for (`used`, where glibc tells), and in compiled kernels.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
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
from studies import rank_correlation  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

import drgs  # noqa: E402
from drgs.runtime.machine import peak_memory  # noqa: E402
from drgs.studies.tables import markdown_table, paragraph  # noqa: E402

ROWS = ROOT / "benchmarks" / "planner.jsonl"
PAGE = ROOT / "docs" / "planner.md"
BOUNDS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 1.0)
CANDIDATES = 30
STEPS = 10
SECONDS = 1.0
COMPARED_EVERY = 10
WINDOW = 100  # photographs of a line of the table


def measure(path: Path, frames: int, bounds: bool, memory: bool) -> None:
    """Rows of the photographs of a data set, of the bounds that are compared on the way, or of memory alone."""
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
        if memory:
            if number % COMPARED_EVERY == COMPARED_EVERY - 1:
                row = {
                    "what": "memory",
                    "number": number,
                    "known": len(planner.views),
                    "memory": peak_memory(),
                } | held()
                add_row(ROWS, row | where)
                print(row, flush=True)
            continue
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


class _Mallinfo(ctypes.Structure):
    """What glibc's mallinfo2 returns."""

    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
    )]  # fmt: skip


def held() -> dict[str, int]:
    """Bytes that this process holds now, on Linux with glibc: all its pages, what was allocated, and kernels' code."""
    pages = kernels = 0
    is_code = False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        words = line.split()
        if not words[0].endswith(":"):
            is_code = "x" in words[1] and (len(words) < 6 or "memfd" in words[5])
        elif words[0] == "Rss:":
            pages += 1024 * int(words[1])
            kernels += 1024 * int(words[1]) * is_code
    found = {"resident": pages, "kernels": kernels}
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallinfo2.restype = _Mallinfo
        told = library.mallinfo2()
        found |= {"used": told.uordblks + told.hblkhd, "free": told.fordblks}
    return found


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


def tables(rows: list[dict]) -> str:
    """Latency and memory by hundreds of photographs, and bounds against what is asked and how right it is."""
    parts = []
    for name in dict.fromkeys(row["data"] for row in rows):
        mine = [row for row in rows if row["data"] == name]
        frames = [row for row in mine if row["what"] == "photograph"]
        last = frames[-1]
        parts.append(
            paragraph(
                f"`{name}`: {len(frames)} photographs, {last['machine']}, {last['date']}, commit {last['commit'][:7]}. "
                "Seconds are medians, in brackets the largest; memory is the peak of the process so far."
            )
        )
        lines = []
        for begin in range(0, len(frames), WINDOW):
            own = frames[begin : begin + WINDOW]
            cells = [f"{np.median([x[k] for x in own]):.2f} ({max(x[k] for x in own):.1f})"
                     for k in ("observe", "scores", "next")]  # fmt: skip
            quality = [x["psnr"] for x in own if "psnr" in x]
            lines.append(
                [
                    f"{begin + 1} to {begin + len(own)}",
                    f"{own[-1]['gaussians']:,}",
                    str(own[-1]["known"]),
                    *cells,
                    f"{np.mean([x['computed'] for x in own]):.1f}",
                    f"{np.median([x['changed'] for x in own]):.2f}",
                    f"{own[-1]['memory'] / 1e9:.2f} GB",
                    f"{quality[-1]:.1f} dB" if quality else "",
                ]
            )
        heads = ["photographs", "Gaussians", "kept", "observe", "scores", "next, 3 picks", "views computed", "changed",
                 "memory", "held out"]  # fmt: skip
        parts.append(markdown_table(heads, lines))
        compared = [row for row in mine if row["what"] == "bound"]
        lines = []
        for bound in BOUNDS:
            own = [row for row in compared if row["bound"] == bound]
            if own:
                asked, seconds, tau, short = (
                    np.mean([x[k] for x in own]) for k in ("computed", "seconds", "tau", "short")
                )
                worst = min(x["tau"] for x in own)
                lines.append(
                    [f"{bound:g}", f"{asked:.1f}", f"{seconds:.2f}", f"{tau:.3f} ({worst:.2f})", f"{100 * short:.1f} %"]
                )
        if lines:
            count = len({row["number"] for row in compared})
            parts.append(paragraph(f"Bounds, {count} models, ten photographs apart; in brackets the worst:"))
            parts.append(
                markdown_table(
                    ["bound", "views computed", "seconds", "Kendall's tau", "best view falls short by"], lines
                )
            )
    return "\n\n".join(parts)


def memory_table(rows: list[dict]) -> list[str]:
    """What the process held, at every fiftieth photograph; nothing where that was not measured."""
    if not rows:
        return []
    lines = [
        [str(row["number"] + 1), *(f"{row[k] / 1e6:.0f}" for k in ("resident", "memory", "used", "free", "kernels"))]
        for row in rows
        if row["number"] % 50 == 49
    ]
    told = (
        f"Memory after a number of photographs, MB, one more run of the same, {rows[0]['date']}, commit "
        f"{rows[0]['commit'][:7]}: pages now and at most, allocated and free in them, code of kernels."
    )
    heads = ["photographs", "pages", "at most", "allocated", "free", "kernels"]
    return [paragraph(told), markdown_table(heads, lines)]


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--bounds", action="store_true", help="compare bounds")
    parser.add_argument("--memory", action="store_true", help="measure memory alone")
    parser.add_argument("--page", action="store_true", help="write the tables of what is there")
    args = parser.parse_args()
    if args.data is not None:
        measure(args.data, args.frames, args.bounds, args.memory)
    rows = read_rows(ROWS)
    text = tables(rows)
    print("\n\n".join([text, *memory_table([row for row in rows if row["what"] == "memory"])]))
    if args.page:
        fill_between(PAGE, "planner", text)


if __name__ == "__main__":
    main()
