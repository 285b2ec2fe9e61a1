"""Frames whose steps are recorded (drgs/tracing/recordings.py) beside the same ones traced anew, in turns.

    python benchmarks/recordings.py [--turns 40] [--sizes 200:32x24 ...] [--presets fast ...]
    python benchmarks/recordings.py --fit banana [--steps 200]      steps of two fits, in turns
    python benchmarks/recordings.py --page                          the part of docs/benchmarks.md

Appends a row for each size, preset and kind of frame to recordings.jsonl: medians of wall and processor time and of
what kernels take, in milliseconds, and how far images and gradients of both are apart. On a card gsplat's kernels take
their turn, if they can be imported.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE), str(HERE / "cuda")]

import cubes  # noqa: E402
import drjit as dr  # noqa: E402
import torch  # noqa: E402
from fits import split_of  # noqa: E402
from pages import fill_between  # noqa: E402
from where import DATA, add_row, ran, read_rows  # noqa: E402

import drgs  # noqa: E402
from drgs.data import load  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import frames_for  # noqa: E402
from drgs.fitting.start import start_plain  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402
from drgs.tracing.recordings import without_recordings  # noqa: E402

ROWS = HERE / "recordings.jsonl"
SIZES = ("200:32x24",)
CARD_SIZES = ("100000:512x512", "1000000:1920x1080", "200:32x24")
PRESETS = ("fast", "gsplat", "exact")
SHOWN = ("fast",)  # on the page
KINDS = ("forward", "step", "diagonal")


def frames(g: drgs.Gaussians, camera: drgs.Camera, preset: str) -> dict[str, Callable[[], list[torch.Tensor]]]:
    """A frame without and with its gradients, which are read back, and the diagonal of its Fisher information."""
    settings = drgs.RenderSettings.preset(preset)

    def forward() -> list[torch.Tensor]:
        with torch.no_grad():
            rgb = drgs.render(g, camera, settings, outputs=()).rgb
        rgb.sum().item()
        return [rgb]

    def step() -> list[torch.Tensor]:
        own = drgs.Gaussians(**{k: x.detach().requires_grad_() for k, x in g.parameters().items()})
        rgb = drgs.render(own, camera, settings, outputs=()).rgb
        rgb.square().mean().backward()
        own.means.grad.sum().item()
        return [rgb.detach(), *[x.grad for x in own.parameters().values()]]

    def diagonal() -> list[torch.Tensor]:
        return list(drgs.fisher.diagonal(g, camera, settings).values())

    return {"forward": forward, "step": step, "diagonal": diagonal}


def traced(frame: Callable[[], list[torch.Tensor]]) -> Callable[[], list[torch.Tensor]]:
    """The same frame, traced anew."""

    def anew() -> list[torch.Tensor]:
        with without_recordings():
            return frame()

    return anew


def kernel_ms(frame: Callable[[], object]) -> float:
    """What Dr.Jit's kernels of a frame take, in milliseconds: the median of five."""
    sums = []
    for _ in range(5):
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            frame()
            dr.sync_thread()
            sums.append(sum(k.get("execution_time", 0.0) for k in dr.kernel_history()))
    return statistics.median(sums)


def apart(xs: list[torch.Tensor], ys: list[torch.Tensor]) -> list[float]:
    """Largest difference of each pair, over the largest number of it."""
    return [float((x - y).abs().max() / y.abs().max().clamp_min(1e-30)) for x, y in zip(xs, ys, strict=True)]


def measured(runs: dict[str, Callable], turns: int) -> dict[str, dict[str, float]]:
    """Medians of wall and processor time of each run in milliseconds, in turns after three that compile and record."""
    wall: dict[str, list[float]] = {name: [] for name in runs}
    processor: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(turns + 3):
        for name, run in runs.items():
            began, busy = time.perf_counter(), time.process_time()
            run()
            if turn >= 3:
                wall[name].append(1e3 * (time.perf_counter() - began))
                processor[name].append(1e3 * (time.process_time() - busy))
    return {
        name: {
            "wall_ms": statistics.median(wall[name]),
            "least_wall_ms": min(wall[name]),
            "processor_ms": statistics.median(processor[name]),
            "least_processor_ms": min(processor[name]),
        }
        for name in runs
    }


def changed(home: str, presets: list[str]) -> float:
    """How far recorded frames are from traced ones at most, where each has another scene, size and settings than the
    one before, and a former one comes again.
    """
    worst = 0.0
    for seed in range(2):
        for count, size in ((200, (32, 24)), (300, (32, 24)), (200, (40, 24)), (230, (17, 9)), (200, (32, 24))):
            for preset in presets:
                g = cubes.cube(count, seed=seed, sh_degree=seed).to(home)
                frame = frames(g, cubes.camera(*size, distance=4.0 - seed), preset)["step"]
                worst = max(worst, *apart(frame(), traced(frame)()))
    return worst


def fit_steps(scene: str, trained: str, steps: int) -> dict:
    """Two fits of a capture, one of recorded frames and one of traced ones, that take their steps in turns: processor
    time of a step, the median of all but the first tenth, and how far the Gaussians are apart at the end.
    """
    dataset = load(DATA / scene)
    config = FitConfig().replace(
        renderers=(trained,), skybox="off", semantics="ignore", max_steps=steps, max_pixels=12_000, max_gaussians=8_000
    )
    train, _ = split_of(dataset, config)
    images = frames_for(train, config.data)
    trainers = {name: start_plain(dataset, train, images, config) for name in ("recorded", "traced")}
    seconds: dict[str, list[float]] = {name: [] for name in trainers}
    for _ in range(steps):
        for name, trainer in trainers.items():
            with contextlib.nullcontext() if name == "recorded" else without_recordings():
                began = time.process_time()
                trainer.step()
                seconds[name].append(time.process_time() - began)
    ended = [trainer.gaussians() for trainer in trainers.values()]
    same = len(ended[0]) == len(ended[1])
    off = apart([ended[0].means.detach()], [ended[1].means.detach()]) if same else None
    times = {name: {"processor_ms": 1e3 * statistics.median(x[steps // 10 :])} for name, x in seconds.items()}
    times = {name: x | {"mean_processor_ms": 1e3 * statistics.mean(seconds[name])} for name, x in times.items()}
    row = {"kind": "fit", "scene": scene, "preset": trained, "steps": steps, "gaussians": len(ended[0]), "apart": off}
    print(scene, trained, {name: round(x["mean_processor_ms"], 2) for name, x in times.items()}, "apart", off)
    return row | {"times": times, "ran": ran()}


def section() -> str:
    """The part of docs/benchmarks.md, from the rows of processors: the last one of each frame, and of each fit."""
    rows = {(r["kind"], r.get("gaussians"), r.get("preset")): r for r in read_rows(ROWS) if not r.get("card")}
    named = {"step": "with gradients", "diagonal": "its Fisher diagonal", "fit": "a step of a fit"}
    smallest = int(SIZES[0].partition(":")[0])  # of which the least is work
    shown = {
        key: r
        for key, r in rows.items()
        if key[0] in named and key[2] in SHOWN and (key[0] == "fit" or key[1] == smallest)
    }
    found = []
    for (kind, count, preset), r in shown.items():
        traced, recorded = (r["times"][name]["processor_ms"] for name in ("traced", "recorded"))
        what = r["scene"] if kind == "fit" else "x".join(map(str, r["size"]))
        told = f"`{preset}`, {count:,} Gaussians, {what}, {named[kind]}"
        found.append(f"{told}: {recorded:.1f} instead of {traced:.1f}")
    made = list(shown.values())[-1]["ran"]
    return paragraph(
        "Images of a pinhole on tiles, their gradients and their Fisher information replay kernels recorded at the "
        "first frame of the same sizes and settings (`drgs/tracing/recordings.py`), bit for bit on LLVM; all else is "
        f"traced anew each time. CPU milliseconds: {'; '.join(found)} (`python "
        f"benchmarks/recordings.py`, {made['machine']}, {made['date']}, commit {made['commit']})."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=40)
    parser.add_argument("--sizes", nargs="*", help="Gaussians:WIDTHxHEIGHT")
    parser.add_argument("--presets", nargs="*", default=list(PRESETS))
    parser.add_argument("--fit", help="a capture, of which a fit's steps are timed, and nothing else")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--page", action="store_true", help="write the part of docs/benchmarks.md, and nothing else")
    args = parser.parse_args()
    if args.page:
        fill_between(HERE.parent / "docs" / "benchmarks.md", "recordings", section())
        return
    if args.fit:
        for preset in args.presets:
            add_row(ROWS, fit_steps(args.fit, preset, args.steps))
        return
    is_card = drgs.runtime.backend().name == "cuda"
    home = "cuda" if is_card else "cpu"
    card = torch.cuda.get_device_name() if is_card else None
    for size in args.sizes or (CARD_SIZES if is_card else SIZES):
        count, _, image = size.partition(":")
        width, height = (int(x) for x in image.split("x"))
        g, camera = cubes.cube(int(count)).to(home), cubes.camera(width, height)
        theirs: dict = {}
        if is_card:
            try:
                from check import gsplat_frames

                theirs = gsplat_frames(g, camera)
            except ImportError as error:
                print(f"gsplat: {error}", flush=True)
        for preset in args.presets:
            ours = frames(g, camera, preset)
            for kind in KINDS:
                runs = {"recorded": ours[kind], "traced": traced(ours[kind])}
                own = {"gsplat's kernels": theirs[kind]} if kind in theirs else {}
                off = apart(runs["recorded"](), runs["traced"]())
                off = [max(pair) for pair in zip(off, apart(runs["recorded"](), runs["traced"]()), strict=True)]
                times = measured(runs | own, args.turns if int(count) < 500_000 else max(args.turns // 4, 5))
                for name, run in runs.items():
                    times[name]["kernels_ms"] = kernel_ms(run)
                row = {"gaussians": int(count), "size": [width, height], "preset": preset, "kind": kind, "apart": off}
                row |= {"times": times, "card": card, "ran": ran()}
                add_row(ROWS, row)
                told = {name: round(x["wall_ms"], 2) for name, x in times.items()}
                print(size, preset, kind, told, "apart", f"{max(off):.1e}", flush=True)
    try:
        worst: float | str = changed(home, args.presets)
    except RuntimeError as error:
        worst = str(error)
    print("scenes, sizes and settings that change: apart", worst, flush=True)
    add_row(ROWS, {"kind": "changes", "apart": worst, "card": card, "ran": ran()})


if __name__ == "__main__":
    main()
