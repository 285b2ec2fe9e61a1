"""Errors of the renderer against the float64 oracle at the extremes; writes the table of docs/numerics.md.

python benchmarks/numerics.py [--print]
"""

from __future__ import annotations

import argparse
import datetime
import subprocess
import sys
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import numpy as np  # noqa: E402
from scenes_extreme import CASES  # noqa: E402
from scenes_random import FIELDS, Oracle, compare  # noqa: E402

from drgs import runtime  # noqa: E402

BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"


def row(case, traversal: str) -> str:
    """One line of the table."""
    rng = np.random.default_rng(3)
    g, cam = case.build(rng)
    names = [name for name in FIELDS if case.depth or name != "depth"]
    oracle = Oracle(g, cam, case.settings, rng, 1e-6, names)
    errors = compare(g, cam, case.settings.replace(traversal=traversal), oracle)
    worst = lambda table: f"{max(table.values(), default=0.0):.0e}"  # noqa: E731
    marked = 100 * float((~oracle.good).double().mean())
    told = "beyond float32: warned about" if traversal == "bvh" and case.bvh == "warns" else ""
    ties = f"{marked:.1f} % of pixels near a tie, left out" if marked else ""
    remark = "; ".join(x for x in (case.remark, told, ties) if x)
    finite = "yes" if errors.finite else "**no**"
    return (
        f"| {case.name} | {traversal} | {worst(errors.image)} | {worst(errors.gradient)} | {errors.joint:.0e} "
        f"| {errors.duality:.0e} | {finite} | {remark} |"
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--print", action="store_true", help="do not touch docs/numerics.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    lines = [
        "| case | traversal | image | gradient | forward mode | adjoint against forward | finite | remark |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for case in CASES:
        for traversal in ("tiles", "bvh"):
            if traversal == "bvh" and (case.bvh == "skip" or case.settings.response == "ewa"):
                continue
            lines.append(row(case, traversal))
            print(lines[-1], flush=True)
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    made = (
        f"`python benchmarks/numerics.py`, {runtime.info().get('cpu', 'CPU')}, {runtime.backend().variant}, "
        f"{datetime.date.today().isoformat()}, commit {commit.stdout.strip()}."
    )
    if not args.print:
        page = ROOT / "docs" / "numerics.md"
        text = page.read_text()
        head, tail = text.split(BEGIN)[0], text.split(END)[1]
        page.write_text("\n".join([head + BEGIN, "", made, "", *lines, "", END]) + tail)


if __name__ == "__main__":
    main()
