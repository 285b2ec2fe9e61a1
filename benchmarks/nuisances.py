"""What it costs to eliminate a view's own unknowns from its information, and which views are picked then.

    python benchmarks/nuisances.py [--run RUN ...] [--turns 5]     tables, benchmarks/nuisances.json
    python benchmarks/nuisances.py --page                          measures nothing

Both write docs/data/eliminated-cost.csv and eliminated-picks.csv, data files of docs/information.md.

The cost is of one view of the cube scene, 20,000 Gaussians at 320x240. Picks are of the cube scene and of fitted runs:
three of the cameras are known, the others are ranked by the default score.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cubes  # noqa: E402
from clocks import interleaved  # noqa: E402
from fisher import fitted  # noqa: E402
from studies import rank_correlation, write_csv  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs import fisher  # noqa: E402
from drgs.cameras import Camera, orbit  # noqa: E402
from drgs.cameras.sizes import at_most  # noqa: E402
from drgs.display import tables  # noqa: E402
from drgs.fisher import Nuisances  # noqa: E402
from drgs.select import select  # noqa: E402

KINDS = {
    "none": Nuisances(),
    "exposure": Nuisances(eliminate=("exposure",)),
    "pose": Nuisances(eliminate=("pose",)),
    "exposure, pose": Nuisances(eliminate=("exposure", "pose")),
}
RESULTS = ROOT / "benchmarks" / "nuisances.json"
DATA = ROOT / "docs" / "data"
_PIXELS = 5_000
_KNOWN = 3


def cost(turns: int) -> list[dict]:
    """Milliseconds of the diagonal of one view, and of its blocks."""
    g, camera = cubes.cube(20_000), cubes.camera(320, 240)
    rows = []
    for preset, what in (("fast", "diagonal"), ("exact", "diagonal"), ("fast", "blocks")):
        settings, ask = drgs.RenderSettings.preset(preset), getattr(fisher, what)
        runs = {
            name: lambda x=x, ask=ask, s=settings: ask(g, camera, s, nuisances=x)  # type: ignore[misc]
            for name, x in KINDS.items()
        }
        seconds = interleaved(runs, turns)
        rows.append({"preset": preset, "what": what} | {name: 1e3 * x for name, x in seconds.items()})
        print(rows[-1], flush=True)
    return rows


def picks(name: str, g: drgs.Gaussians, cameras: list[Camera]) -> list[dict]:
    """Ranks of candidates with unknowns eliminated against those without, and the share of information that is lost."""
    views = [at_most(camera.undistorted(), _PIXELS) for camera in cameras]
    step = len(views) // _KNOWN
    known = views[::step][:_KNOWN]
    candidates = [view for i, view in enumerate(views) if i % step or i // step >= _KNOWN]
    settings = drgs.RenderSettings.preset("fast")
    found = {
        kind: select(g, candidates, known, settings=settings, nuisances=x, halving=False) for kind, x in KINDS.items()
    }
    told = {kind: fisher.diagonal(g, known, settings, nuisances=x) for kind, x in KINDS.items()}
    plain = found["none"].scores
    rows = []
    for kind in list(KINDS)[1:]:
        scores = found[kind].scores
        order = sorted(range(len(plain)), key=lambda i: -plain[i])
        first = max(range(len(scores)), key=lambda i: scores[i])
        rows.append(
            {
                "scene": name,
                "candidates": len(candidates),
                "eliminated": kind,
                "spearman": rank_correlation(plain, scores),
                "same first pick": first == order[0],
                "rank of the pick": order.index(first) + 1,
                "lost": {g: 1 - float(x.sum()) / float(told["none"][g].sum()) for g, x in told[kind].items()},
            }
        )
        print(rows[-1], flush=True)
    return rows


def write(found: dict) -> None:
    """The data files of what was measured."""
    lines = [[row["what"], row["preset"], *(f"{row[kind]:.0f}" for kind in KINDS)] for row in found["cost"]]
    write_csv(DATA / "eliminated-cost.csv", [["what", "preset", *(f"{kind}_ms" for kind in KINDS)], *lines])
    groups = list(found["picks"][0]["lost"])
    heads = ["scene", "eliminated", "candidates", "spearman", "rank_of_pick", *(f"{group}_lost" for group in groups)]
    lines = [
        [
            row["scene"],
            row["eliminated"],
            str(row["candidates"]),
            f"{row['spearman']:.3f}",
            str(row["rank of the pick"]),
            *(f"{row['lost'][group]:.4f}" for group in groups),
        ]
        for row in found["picks"]
    ]
    write_csv(DATA / "eliminated-picks.csv", [heads, *lines])


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, nargs="*", default=[])
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--page", action="store_true", help="measure nothing, write the data files of what there is")
    args = parser.parse_args()
    if args.page:
        write(json.loads(RESULTS.read_text()))
        return
    times = cost(args.turns)
    ring = orbit((0, 0, 0), 4.0, 16, width=320, height=240, elevation=20.0)
    rows = picks("cube", cubes.cube(6_000), ring)
    for run in args.run:
        rows += picks(run.name, *fitted(run))
    found = {"cost": times, "picks": rows, "where": ran()}
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    write(found)
    tables.show(
        "ms of one view, 20,000 Gaussians, 320x240",
        ("preset", "what", *KINDS),
        [(x["preset"], x["what"], *(f"{x[k]:.0f} ({x[k] / x['none']:.2f})" for k in KINDS)) for x in times],
    )
    groups = list(rows[0]["lost"])
    tables.show(
        "picks against those without",
        ("scene", "eliminated", "Spearman", "rank of pick", *(f"{g} lost" for g in groups)),
        [
            (
                x["scene"],
                x["eliminated"],
                f"{x['spearman']:.3f}",
                f"{x['rank of the pick']} of {x['candidates']}",
                *(f"{100 * x['lost'][g]:.1f} %" for g in groups),
            )
            for x in rows
        ],
    )


if __name__ == "__main__":
    main()
