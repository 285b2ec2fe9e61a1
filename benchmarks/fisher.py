"""What Fisher information costs, against rendering with gradients.

    python benchmarks/fisher.py [--quick] [--run RUN]     tables, docs/benchmarks-fisher.md, benchmarks/fisher.json

RUN is a fitted run folder whose views are scored (default runs/real/office, else out/demo/run). Peers take turns in one
process, every figure is the median of at least five turns after a warm-up.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cubes  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from render import backward, forward, interleaved  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs import fisher  # noqa: E402
from drgs.gain import information_gain  # noqa: E402
from drgs.select import select  # noqa: E402

Preset = drgs.RenderSettings.preset
GEOMETRY = ("means", "rotations", "log_scales", "logit_opacities")


def headline(turns: int) -> list[dict]:
    """One view of the cube scene, SH 0 and 3, `fast` and `exact`."""
    rows = []
    for preset, degree in (("fast", 0), ("fast", 3), ("exact", 0)):
        g, cam, s = cubes.cube(sh_degree=degree), cubes.camera(), Preset(preset)
        runs = {
            "forward": forward(g, cam, s),
            "forward+backward": backward(g, cam, s),
            "exact diagonal": lambda g=g, cam=cam, s=s: fisher.diagonal(g, cam, s),
            "without SH": lambda g=g, cam=cam, s=s: fisher.diagonal(g, cam, s, groups=GEOMETRY),
            "fisherrf": lambda g=g, cam=cam, s=s: fisher.diagonal(g, cam, s, "fisherrf"),
            "probes, K = 1": lambda g=g, cam=cam, s=s: fisher.diagonal(g, cam, s, "probes", probes=1),
            "coverage": lambda g=g, cam=cam, s=s: fisher.coverage(g, cam, s),
            "blocks 13x13": lambda g=g, cam=cam, s=s: fisher.blocks(g, cam, s),
        }
        rows.append({"preset": preset, "sh": degree, **interleaved(runs, turns)})
    return rows


def tangents(turns: int) -> dict:
    """K columns carried through one traversal, against as many traversals."""
    g, cam, s = cubes.cube(), cubes.camera(), Preset("fast")
    columns = torch.randn(16, len(g), 3, generator=torch.Generator().manual_seed(0))
    run = lambda x: lambda: drgs.render_jvp(g, cam, {"means": x}, s, outputs=())  # noqa: E731
    pose = torch.eye(6, dtype=torch.float64)
    return interleaved(
        {
            "1": run(columns[0]),
            "4": run(columns[:4]),
            "16": run(columns),
            "pose": lambda: drgs.render_jvp(g, cam, {"camera": pose}, s, outputs=()),
        },
        turns,
    )


def candidates(g, cameras: list, count: int, turns: int) -> dict:
    """Seconds of one pick among `count` poses at 320x240, H of the training views included and apart."""
    rng, poses = np.random.default_rng(0), []
    for k in range(count):
        camera = cameras[k % len(cameras)]
        c2w = camera.c2w.copy()
        c2w[:3, 3] += 0.05 * rng.normal(size=3) * (k >= len(cameras))
        moved = dataclasses.replace(camera.undistorted(), w2c=np.linalg.inv(c2w), name=f"pose {k}")
        poses.append(moved.resized(320, 240))
    train = [camera.undistorted().resized(320, 240) for camera in cameras[:12]]
    result = {"gaussians": len(g), "sh": g.sh_degree, "poses": count, "train": len(train)}
    for policy, preset in (("fisher", "fast"), ("fisher", "exact"), ("fisherrf", "inria"), ("coverage", "fast")):
        s, seconds = Preset(preset), []
        H = None if policy == "coverage" else fisher.diagonal(g, train, s)
        for turn in range(turns if preset != "exact" else 1):
            start = time.perf_counter()
            select(g, poses, train, 1, policy, settings=s)
            seconds.append(time.perf_counter() - start)
            print(policy, preset, turn, f"{seconds[-1]:.2f}", flush=True)
        result[f"{policy}, {preset}"] = float(np.median(seconds))
        if H is not None and preset == "fast":
            one = fisher.diagonal(g, poses[0], s)
            start = time.perf_counter()
            information_gain(one, H)
            result["gain of one"] = time.perf_counter() - start
    return result


def memory(run: Path) -> list[dict]:
    """Peak memory of a process that scores so many candidates, each in a process of its own."""
    rows = []
    for count in (5, 20, 80):
        command = [sys.executable, __file__, "--run", str(run), "--task", str(count)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        rows.append({"candidates": count, "GB": float(done.stdout.split()[-1])})
    return rows


def score(run: Path, count: int) -> float:
    """Peak memory in GB after one pick."""
    g, cameras = fitted(run)
    poses = [cameras[k % len(cameras)].undistorted().resized(320, 240) for k in range(count)]
    select(g, poses, poses[:3], 1, settings=Preset("fast"))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def fitted(run: Path) -> tuple:
    """Gaussians of a run and the cameras of its data set."""
    from drgs.data import load
    from drgs.files import Run

    views = load(Run(run).config()["data"], points=False).views
    return drgs.load_ply(run / "point_cloud.ply"), [view.camera for view in views]


def growth(turns: int, quick: bool) -> list[dict]:
    """Time of the exact diagonal over Gaussians, pixels and views."""
    rows = []
    shapes = [(n, 512, 1) for n in ((1000,) if quick else (1000, 10_000, 100_000, 1_000_000))]
    shapes += [(100_000, size, 1) for size in (() if quick else (64, 128, 256, 1024))]
    shapes += [(10_000, 128, views) for views in ((1, 4) if quick else (1, 10, 100))]
    for count, size, views in shapes:
        g, cam, s = cubes.cube(count), cubes.camera(size), Preset("fast")
        run = interleaved({"diagonal": lambda g=g, c=[cam] * views, s=s: fisher.diagonal(g, c, s)}, turns)
        rows.append({"gaussians": count, "pixels": size, "views": views, **run})
        print(rows[-1], flush=True)
    return rows


def report(r: dict) -> str:
    """The markdown page."""
    lines = [
        "# What Fisher information costs",
        "",
        f"Made by `python benchmarks/fisher.py` on {r['machine']}, {r['date']}, commit {r['commit']}. Milliseconds,",
        "one view of 100,000 Gaussians in a cube, 512x512, everything included (projection, lists, sorting, torch),",
        "median, peers taking turns; in brackets the ratio to forward + backward.",
        "",
        "| | " + " | ".join(f"`{row['preset']}`, SH {row['sh']}" for row in r["headline"]) + " |",
        "|---|" + "---|" * len(r["headline"]),
    ]
    for name in [k for k in r["headline"][0] if k not in ("preset", "sh")]:
        cells = [f"{1e3 * row[name]:.0f} ({row[name] / row['forward+backward']:.2f})" for row in r["headline"]]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    t = r["tangents"]
    lines += [
        "",
        "`exact diagonal` is every group: means, rotations, log-scales, logit-opacities and SH.",
        "",
        "## Tangents",
        "",
        f"Forward mode, `fast`: one tangent {1e3 * t['1']:.0f} ms, 4 in one traversal {1e3 * t['4']:.0f} ms, 16",
        f"{1e3 * t['16']:.0f} ms: {t['16'] / 16 / t['1']:.2f} of 16 single ones. The 6 of the pose:"
        f" {1e3 * t['pose']:.0f} ms.",
    ]
    if "candidates" in r:
        c = r["candidates"]
        lines += [
            "",
            "## One pick",
            "",
            f"{c['poses']} candidate poses at 320x240 and {c['train']} training views, {c['gaussians']:,} Gaussians",
            f"with SH {c['sh']} ({r['run']}), nothing cached. The paper states about 7 s on an L40 GPU.",
            "",
            "| policy, preset | seconds a pick | ms a view |",
            "|---|---|---|",
            *(
                f"| {name} | {c[name]:.2f} | {1e3 * c[name] / (c['poses'] + c['train']):.0f} |"
                for name in c
                if "," in name
            ),
            "",
            f"The gain of one candidate, once its information is there: {1e3 * c['gain of one']:.0f} ms.",
            "",
            "Peak memory of the process, one pick among",
            ", ".join(f"{row['candidates']} candidates: {row['GB']:.2f} GB" for row in r["memory"]) + ".",
        ]
    lines += [
        "",
        "## Growth",
        "",
        "Exact diagonal, `fast`, SH 0.",
        "",
        "| Gaussians | pixels | views | ms |",
        "|---|---|---|---|",
        *(f"| {x['gaussians']:,} | {x['pixels']}^2 | {x['views']} | {1e3 * x['diagonal']:.1f} |" for x in r["growth"]),
        "",
    ]
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="small and few: checks that the script runs")
    parser.add_argument("--run", type=Path, help="a fitted run whose cameras are scored")
    parser.add_argument("--task", type=int, help="only the peak memory of scoring so many candidates")
    args = parser.parse_args()
    if args.task:
        print(score(args.run, args.task))
        return
    turns = 2 if args.quick else 5
    result = {
        **ran(),
        "headline": headline(turns),
        "tangents": tangents(turns),
    }
    run = args.run or next((p for p in (ROOT / "runs/real/office", ROOT / "out/demo/run") if p.is_dir()), None)
    if run:
        g, cameras = fitted(run)
        result["run"] = run.name
        result["candidates"] = candidates(g, cameras, 10 if args.quick else 80, turns)
        result["memory"] = memory(run)
    result["growth"] = growth(turns, args.quick)
    text = report(result)
    print(text)
    if not args.quick:
        (ROOT / "docs" / "benchmarks-fisher.md").write_text(text)
        (ROOT / "benchmarks" / "fisher.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
