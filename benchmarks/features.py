"""What feature channels cost: forward + backward of 0 to 512 channels beside the colors.

    python benchmarks/features.py [--quick] [--clock cpu]     prints, writes benchmarks/features.json, docs/semantic.md
    python benchmarks/features.py --page                      the page alone, of what has been measured

100,000 Gaussians, 320x240. Peers take turns in one process; what counts are the ratios to the colors alone. Three ways:
products with the weights of a tile (drgs/tracing/weights.py), coupled to the geometry and not, and the traversals of 32
channels each that they replace, which `bvh` still takes.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import cubes  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from clocks import in_turns  # noqa: E402
from pages import fill_between  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402
from drgs.tracing import weights  # noqa: E402
from drgs.tracing.tiles import TileTraversal  # noqa: E402

Preset = drgs.RenderSettings.preset
WIDTHS = (3, 16, 32, 64, 128, 512)
PAGE = ROOT / "docs" / "semantic.md"
RESULTS = ROOT / "benchmarks" / "features.json"


@contextlib.contextmanager
def traversals():
    """Feature channels come out of traversals, 32 each, on tiles as on `bvh`."""
    held = TileTraversal.weighed
    TileTraversal.weighed = lambda view, share, size: view.parts(1)
    try:
        yield
    finally:
        TileTraversal.weighed = held


def frame(gaussians: drgs.Gaussians, settings: drgs.RenderSettings, couple: bool, products: bool = True):
    """A frame and the gradients of the sum of its images with respect to every parameter."""
    leaves = {k: v.clone().requires_grad_() for k, v in gaussians.parameters().items()}
    moving = gaussians.replace(**leaves)
    cam = cubes.camera(320, 240)

    def run():
        with contextlib.nullcontext() if products else traversals():
            out = drgs.render(moving, cam, settings, outputs=(), couple_features=couple)
            loss = out.rgb.sum() if out.features is None else out.rgb.sum() + out.features.square().sum()
            loss.backward()
        for leaf in leaves.values():
            leaf.grad = None

    return run


def with_features(count: int, width: int) -> drgs.Gaussians:
    """The cube scene; of width 0 without features."""
    g = cubes.cube(count)
    features = torch.randn(len(g), width, generator=torch.Generator().manual_seed(0))
    return g.replace(features=features) if width else g


def against_colors(count: int, preset: str, width: int, ways: dict, turns: int, clock) -> dict:
    """Median seconds of the colors alone and of each way, and medians of the ratios within a turn."""
    settings = Preset(preset)
    runs = {"colors": frame(with_features(count, 0), settings, True)}
    runs |= {name: frame(with_features(count, width), settings, *way) for name, way in ways.items()}
    seconds = in_turns(runs, turns, clock)
    ratios = {
        name: statistics.median(a / b for a, b in zip(seconds[name], seconds["colors"], strict=True)) for name in ways
    }
    row = {"preset": preset, "width": width, "seconds": {k: statistics.median(s) for k, s in seconds.items()}}
    print(json.dumps(row | {"ratios": ratios}), flush=True)
    return row | {"ratios": ratios}


def held(count: int, preset: str, width: int) -> dict:
    """Bytes of the largest buffer of weights of a frame and its gradients, and how full it is."""
    zeros = weights.Weights.zeros
    survey = weights.Weights.survey
    sizes = []
    shares = []

    def noted(self):
        sizes.append(4 * (self.rows + 1) * weights.PIXELS)
        return zeros(self)

    @functools.wraps(survey)
    def looked(self, buffer):
        shares.append((int((buffer.torch() != 0).sum()), buffer.torch().numel()))
        survey(self, buffer)

    weights.Weights.zeros = noted
    weights.Weights.survey = looked
    try:
        frame(with_features(count, width), Preset(preset), True)()
    finally:
        weights.Weights.zeros = zeros
        weights.Weights.survey = survey
    return {"bytes": max(sizes), "blocks": len(shares), "share": sum(a for a, _ in shares) / sum(b for _, b in shares)}


def grown(count: int, width: int) -> int:
    """Bytes that a coupled `fast` frame and its gradients add to a process that has the Gaussians and the kernels."""
    code = (
        "import features\n"
        "from drgs.runtime.machine import forget_peak_memory, peak_memory\n"
        f"small, large = (features.frame(features.with_features(n, {width}), features.Preset('fast'), True)"
        f" for n in (100, {count}))\n"
        "small(); forget_peak_memory()\n"  # the peak is what there is now
        "before = peak_memory(); large(); print(peak_memory() - before)"
    )
    told = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "benchmarks", capture_output=True, check=True)
    return int(told.stdout.split()[-1])


def growth(rows: list[dict], way: str) -> dict:
    """A straight line through the ratios over the widths: at no channels, and per 100 channels; its largest error."""
    x = np.array([row["width"] for row in rows], float)
    y = np.array([row["ratios"][way] for row in rows])
    slope, base = np.polyfit(x, y, 1, w=1 / y)
    return {"at 0": base, "per 100": 100 * slope, "error": float(np.abs((base + slope * x) / y - 1).max())}


def report(result: dict) -> str:
    """What docs/semantic.md says."""
    times = {}
    for preset in ("fast", "exact"):
        ratios = next(x["ratios"] for x in result["rows"] if (x["preset"], x["width"]) == (preset, 128))
        times[preset] = f"{ratios['not coupled']:.1f} times ({ratios['coupled']:.1f} coupled)"
    return paragraph(
        f"A frame with 128 channels and its gradients takes {times['fast']} as long as with colors alone by `fast`, "
        f"{times['exact']} by `exact` ([other widths, and memory](../benchmarks/features.json); `python "
        f"benchmarks/features.py`, {result['machine']}, {result['date']})."
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="small and few: checks that the script runs")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: where others compute as well")
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--page", action="store_true", help="measure nothing, write what is in features.json")
    args = parser.parse_args()
    if args.page:
        fill_between(PAGE, "features", report(json.loads(RESULTS.read_text())))
        return
    clock = {"wall": time.perf_counter, "cpu": time.process_time}[args.clock]
    count, turns = (2000, 2) if args.quick else (100_000, args.turns)
    both = {"not coupled": (False,), "coupled": (True,)}
    old = {"traversals": (True, False)}
    rows = [
        against_colors(count, "fast", width, both | (old if width <= 128 else {}), turns, clock)
        for width in (WIDTHS[:2] if args.quick else WIDTHS)
    ]
    fits = {way: growth(rows, way) for way in both}
    rows += [
        against_colors(count, "exact", width, both, min(turns, 3), clock) for width in ((3,) if args.quick else (128,))
    ]
    result = {
        **ran(),
        "gaussians": count,
        "turns": turns,
        "clock": args.clock,
        "rows": rows,
        "growth": fits,
        "held": {preset: held(count, preset, 16) for preset in ("fast", "exact")},
        "grown": {width: grown(count, width) for width in (0, 16, 128)},
    }
    text = report(result)
    print(text)
    if not args.quick:
        fill_between(PAGE, "features", text)
        RESULTS.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
