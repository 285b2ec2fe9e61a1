"""Decibels by meter: a robot that plans its flight, against flights that look at poses alone.

    python benchmarks/flights.py DATA ...     rows as they come, kept: benchmarks/flights.jsonl
    python benchmarks/flights.py --page       the table of docs/next-views.md, of rows that are there

DATA has depth; a robot may go to every training view, in a straight line. A flight costs its length and `LOOK` for each
photograph; what is fitted, `drgs.Planner`'s model, gets `STEPS` steps for each meter of cost, so that flights of one
cost have been fitted alike, however many photographs they took. PSNR of all held-out views is measured at `BUDGETS`.

Named before any flight: `drgs scene room --free --views 225 --size 160x120 --spp 16 --seed 31 --test-every 9` (and
seeds 32 and 33) and `office`, two starts each. The policies:

- planner: `Planner.next`, the largest score / (LOOK + distance) of all places;
- nearest: the nearest place that no photograph was taken at;
- farthest: the place farthest from all photographs, whatever it costs;
- farthest by meter: the largest distance from all photographs / (LOOK + distance), the planner's trade without a model.

Six starts in rooms can tell about 1 dB, by how much starts have differed there.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import random
import statistics
import sys
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "examples")]

from pages import fill_between  # noqa: E402
from plan_views import depth_of, distance, psnr  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

import drgs  # noqa: E402
from drgs.studies.tables import markdown_table, paragraph  # noqa: E402

PAGE = ROOT / "docs" / "next-views.md"
ROWS = ROOT / "benchmarks" / "flights.jsonl"
POLICIES = ("planner", "nearest", "farthest", "farthest by meter")
SHOWN = ("planner", "nearest", "farthest by meter")  # on the page: `farthest` is last everywhere
STARTS = (0, 1)
LOOK = 0.5  # meters that a photograph costs: to stop, turn and look; without it to turn on the spot would be free
BUDGETS = (5, 10, 20, 40)  # meters
STEPS = 20  # of the fit for each meter: 800 of the 1,000 that the planner's schedule has
PIXELS = 12_000  # of a held-out view
LEAD_AT = 20  # meters at which the page compares flight by flight


def chosen(policy: str, planner: drgs.Planner, left: list[drgs.Camera], taken: list[drgs.Camera]) -> drgs.Camera:
    """Where a policy goes next, from where the last photograph was taken."""
    here = taken[-1]
    if policy == "planner" and planner.scene is not None:
        planner.scores(left, cost=distance)
        return left[planner.next().picks[0].index]
    if policy == "farthest by meter":
        return max(left, key=lambda place: _novelty(place, taken) / (LOOK + distance(here, place)))
    if policy == "farthest":
        return max(left, key=lambda place: _novelty(place, taken))
    return min(left, key=lambda place: distance(here, place))


def _novelty(place: drgs.Camera, taken: list[drgs.Camera]) -> float:
    """Distance of a place from the nearest photograph."""
    return min(distance(place, one) for one in taken)


def fly(dataset: drgs.Dataset, policy: str, seed: int) -> dict:
    """PSNR of held-out views, and photographs taken, at each of the budgets."""
    train, held_out = dataset.split()
    views = {view.name: view for view in train}
    left = [dataclasses.replace(view.camera.undistorted(), name=view.name) for view in train]
    there = left.pop(random.Random(seed).randrange(len(left)))
    planner = drgs.Planner(look=LOOK)
    taken: list[drgs.Camera] = []
    cost, steps, seconds = LOOK, 0, 0.0
    curve: dict[str, float] = {}
    counts: dict[str, int] = {}
    for budget in BUDGETS:
        while cost <= budget:
            view = views[there.name]
            planner.observe(view.image(), there, depth_of(dataset, view))
            taken.append(there)
            steps += planner.fit(steps=max(0, round(STEPS * cost) - steps))
            if not left:
                cost = math.inf
                break
            began = time.process_time()
            there = chosen(policy, planner, left, taken)
            seconds += time.process_time() - began
            left = [place for place in left if place is not there]
            cost += distance(taken[-1], there) + LOOK  # where this is beyond the budget it is taken within the next
        steps += planner.fit(steps=STEPS * budget - steps)
        assert planner.scene is not None
        curve[str(budget)] = psnr(planner.scene, held_out, PIXELS)
        counts[str(budget)] = len(taken)
    return {"psnr": curve, "photographs": counts, "choosing": seconds}


def section(rows: list[dict]) -> str:
    """PSNR and photographs of the policies at each budget, where all of them have flown."""
    flights = {(row["scene"], row["seed"], row["policy"]): row for row in rows}
    starts = sorted({key[:2] for key in flights if all((*key[:2], policy) in flights for policy in POLICIES)})
    lines = []
    for name, is_office in (("rooms", False), ("`office`", True)):
        own = [start for start in starts if (start[0] == "office") == is_office]
        for policy in SHOWN if own else ():
            flown = [flights[*start, policy] for start in own]
            line = [name, policy]
            for budget in map(str, BUDGETS):
                psnr, photographs = (
                    statistics.mean(row[key][budget] for row in flown) for key in ("psnr", "photographs")
                )
                line.append(f"{psnr:.1f} ({photographs:.0f})")
            lead = [planned_lead(flights, start, policy) for start in own]
            is_planner = policy == POLICIES[0]
            line.append("" if is_planner else f"{statistics.mean(lead):+.1f} [{min(lead):+.1f}, {max(lead):+.1f}]")
            lines.append(line)
    counts = {scene: sum(start[0] == scene for start in starts) for scene, _ in starts}
    machines, days, commits = (
        ", ".join(dict.fromkeys(row[key] for row in rows)) for key in ("machine", "date", "commit")
    )
    text = paragraph(
        "PSNR of held-out views, and photographs taken, after flights of so many meters; last what the planner gains "
        f"at {LEAD_AT} m, in brackets the least and the most of the starts. Starts: "
        + ", ".join(f"`{scene}` {count}" for scene, count in counts.items())
        + f"; {machines}, {days}, commit {commits} ([rows](../benchmarks/flights.jsonl))."
    )
    heads = ["scenes", "policy", *(f"{budget} m" for budget in BUDGETS), "planner less it"]
    return text + "\n\n" + markdown_table(heads, lines)


def planned_lead(flights: dict[tuple, dict], start: tuple, policy: str) -> float:
    """What the planner is ahead of another policy at `LEAD_AT` meters from the same start, dB."""
    planned, other = (flights[*start, name]["psnr"][str(LEAD_AT)] for name in (POLICIES[0], policy))
    return planned - other


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="*", type=Path)
    parser.add_argument("--page", action="store_true", help="write the table of what is there")
    args = parser.parse_args()
    if args.page:
        fill_between(PAGE, "flights", section(read_rows(ROWS)))
        return
    there = {(row["scene"], row["seed"], row["policy"]) for row in read_rows(ROWS)}
    for path in args.data:
        dataset = drgs.load_data(path)
        for seed in STARTS:
            for policy in POLICIES:
                key = {"scene": path.resolve().name, "seed": seed, "policy": policy}
                if tuple(key.values()) not in there:
                    row = key | fly(dataset, policy, seed) | ran()
                    add_row(ROWS, row)
                    print(row, flush=True)


if __name__ == "__main__":
    main()
