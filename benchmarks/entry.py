"""Preset `mitsuba`: how right its order of entries is, and what it costs to sort by them.

    python benchmarks/entry.py [--quick]     a table, and benchmarks/entry.json, of which docs/numerics.md tells
    python benchmarks/entry.py --page        the table of what benchmarks/entry.json has

Errors are against the float64 oracle, in a window of `wolf` (../shared/data, or DRGS_DATA) and inside of three huge
Gaussians; times are CPU time of the process beside the same settings in the order of centers, which sorts nothing along
rays, peers taking turns, medians; run it with DRGS_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import torch  # noqa: E402
from clocks import interleaved  # noqa: E402
from where import DATA, ran  # noqa: E402

import drgs  # noqa: E402
from drgs.cameras import Camera, orbit  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.studies.tables import markdown_table, paragraph  # noqa: E402

MITSUBA = drgs.RenderSettings.preset("mitsuba")
OFF = 1e-3
RESULTS = ROOT / "benchmarks" / "entry.json"


def huge() -> Gaussians:
    """Three about the camera, of scales 5e5, 1000 and 36."""
    rng = torch.Generator().manual_seed(0)
    scales = torch.tensor([5e5, 1e3, 36.0])[:, None].expand(3, 3)
    colors = torch.rand(3, 1, 3, generator=rng)
    means = torch.randn(3, 3, generator=rng) * scales[:, :1] * 0.3
    return Gaussians.from_arrays(means, torch.randn(3, 4, generator=rng), scales, torch.full((3,), 0.5), colors)


def errors(g: Gaussians, camera: Camera, window: tuple[int, int, int, int]) -> dict:
    """Errors of the pixels of a window: shares that are ambiguous, and off among all and among the others."""
    x, y, width, height = window
    seen = drgs.render(g, camera, MITSUBA).rgb[y : y + height, x : x + width]
    truth = drgs.reference.render(g, camera, MITSUBA, window=window, tolerance=3e-4)
    error = (seen - truth.rgb).abs().amax(-1)
    clear = ~truth.ambiguous
    off = error > OFF
    return {
        "pixels": width * height,
        "ambiguous": float((~clear).double().mean()),
        "off": float(off.double().mean()),
        "clear_off": float(off[clear].double().mean()) if clear.any() else 0.0,
        "clear_max": float(error[clear].max()) if clear.any() else 0.0,
    }


def costs(g: Gaussians, camera: Camera, turns: int) -> dict[str, float]:
    """Time of an image, and of one with its gradients, over that in the order of centers."""
    leaves = {name: x.clone().requires_grad_() for name, x in g.parameters().items()}
    free = Gaussians(**leaves, origin=g.origin)
    runs = {}
    for name, settings in (("entry", MITSUBA), ("center", MITSUBA.replace(order="center"))):
        runs[f"{name} image"] = lambda s=settings: drgs.render(g, camera, s, outputs=()).rgb.sum().item()
        runs[f"{name} gradients"] = lambda s=settings: drgs.render(free, camera, s, outputs=()).rgb.mean().backward()
    seconds = interleaved(runs, turns, time.process_time)
    return {kind: seconds[f"entry {kind}"] / seconds[f"center {kind}"] for kind in ("image", "gradients")}


def report(r: dict) -> str:
    """The table."""
    told = (
        f"`python benchmarks/entry.py`, {r['machine']}, {r['date']}, commit {r['commit']}; windows of "
        f"{max(row['pixels'] for row in r['rows'].values()):,} pixels. Off: by more than {OFF:g}. Cost: over the order "
        "of centers, of an image / with gradients."
    )
    lines = []
    for name, row in r["rows"].items():
        cost = row.get("cost")
        times = f"{cost['image']:.2f}x / {cost['gradients']:.2f}x" if cost else "-"
        off = f"{row['off']:.2%} ({row['clear_off']:.2%})"
        lines.append([name, f"{row['ambiguous']:.0%}", off, f"{row['clear_max']:.0e}", times])
    heads = ["scene", "ambiguous", "off (of the others)", "largest error of the others", "cost"]
    return f"{paragraph(told)}\n\n{markdown_table(heads, lines)}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="without wolf: checks that the script runs")
    parser.add_argument("--page", action="store_true", help="measure nothing, print what there is")
    args = parser.parse_args()
    if args.page:
        print(report(json.loads(RESULTS.read_text())))
        return
    inside = orbit((0, 0, 0), 3.0, 1, width=40, height=40)[0]
    result: dict = {
        **ran(),
        "rows": {"inside of three Gaussians of 5e5, 1,000 and 36": errors(huge(), inside, (0, 0, 40, 40))},
    }
    made, (view,) = drgs.testing.random_scene(0, aspect=1)
    row = errors(made.detach(), view, (0, 0, min(40, view.width), min(40, view.height)))
    result["rows"]["`drgs.testing.random_scene(0, aspect=1)`"] = row | {"cost": costs(made.detach(), view, 5)}
    if not args.quick:
        wolf = drgs.load_gaussians(DATA / "splats/wolf/wolf.ply")
        middle = tuple(wolf.means.median(0).values.tolist())
        camera = orbit(middle, float(wolf.means.std(0).norm()) * 3, 8, width=160, height=160)[1]
        row = errors(wolf, camera, (60, 60, 40, 40))
        result["rows"][f"a window of wolf ({len(wolf):,} thin Gaussians)"] = row | {"cost": costs(wolf, camera, 5)}
    print(report(result))
    if not args.quick:
        RESULTS.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
