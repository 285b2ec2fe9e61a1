"""Farthest point sampling on positions and viewing directions, among free poses, where `farthest` goes to walls.

    python benchmarks/farthest_poses.py OUT DATA ... [--moving] [--seeds 2]

Cells as of `drgs reproduce captures --protocol blind`, or, with --moving, as of `dynamic` with the configuration that
benchmarks/captures.py states; finished ones are kept. Its starts are those of rooms, still lifes, halls and kitchens
there, named before any fit ran. Rows are in OUT/rows.jsonl; benchmarks/captures.py makes the page of those that are
copied to benchmarks/free_poses.jsonl. Half a turn counts as much as the largest distance between two cameras, and as
the time between the first view and the last one: no constant was chosen.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")

import numpy as np

from drgs.cameras import places_in_time
from drgs.selection.pool import Pool, Selection
from drgs.studies.cells import run_cells
from drgs.studies.plan import plan_of

LABEL = "farthest, directions"
MOVING = {"max_steps": 1500, "semantics": "ignore"}
"""Fields of fits where things move."""


def farthest_poses(pool: Pool) -> Selection:
    """The candidate that is farthest from its nearest view by (center, time, direction); ties to the first."""
    cameras = [*pool.train, *pool.candidates]
    forward = np.stack([np.asarray(camera.c2w)[:3, 2] for camera in cameras])
    points = np.c_[places_in_time(cameras), forward / 2]  # opposite ones differ by 1
    known, new = points[: len(pool.train)], points[len(pool.train) :]
    distance = np.linalg.norm(new[:, None] - known[None], axis=2).min(1, initial=np.inf)
    scores = distance.tolist()
    picks = []
    for _ in range(pool.k):
        best = int(np.argmax(distance))
        picks.append(pool.pick(best, distance[best]))
        distance = np.minimum(distance, np.linalg.norm(new - new[best], axis=1))
        distance[best] = -np.inf
    return Selection(picks, scores, evaluations=pool.k * len(new))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--moving", action="store_true")
    parser.add_argument("--seeds", type=int, default=2)
    args = parser.parse_args()
    where = args.out / "scenes", args.data, args.seeds, "blind", ["farthest"]
    plan = plan_of("dynamic", "small", *where, fields=MOVING) if args.moving else plan_of("captures", "small", *where)
    study = dataclasses.replace(plan.study, policies={LABEL: {"policy": "farthest_poses:farthest_poses"}})
    cells = [dataclasses.replace(cell, policy=LABEL) for cell in plan.cells]
    _, failed = run_cells(study, cells, args.out / "runs", args.out / "rows.jsonl")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
