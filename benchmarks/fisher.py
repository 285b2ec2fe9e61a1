"""What Fisher information costs, against rendering with gradients.

    python benchmarks/fisher.py [--quick] [--run RUN]     a part of docs/benchmarks.md, benchmarks/fisher.json
    python benchmarks/fisher.py --parts picks --run RUN   this part again, the others as they are
    python benchmarks/fisher.py --page                    that part, of the results that there are

RUN is a fitted run folder whose views are scored (default runs/real/office, else out/demo/run). Peers take turns in one
process, every figure is the median of at least five turns after a warm-up; picks on `exact` are timed once.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cubes  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from clocks import interleaved  # noqa: E402
from pages import fill_between  # noqa: E402
from render import PAGE, backward, forward  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs import fisher  # noqa: E402
from drgs.gain import information_gain  # noqa: E402
from drgs.runtime.machine import peak_memory  # noqa: E402
from drgs.select import select  # noqa: E402
from drgs.studies.tables import markdown_table, paragraph  # noqa: E402

Preset = drgs.RenderSettings.preset
GEOMETRY = ("means", "rotations", "log_scales", "logit_opacities")
PARTS = ("headline", "tangents", "picks", "growth")

# Policy, criterion and blocks, preset: those of one pick. What `drgs select` does unless told otherwise, without the
# backdrop, the paper's criterion on our diagonal, and the paper's own formula. The last two know no blocks.
PICKS = (
    ("fisher", "v_opt", ("geometry", "backdrop"), "fast"),
    ("fisher", "v_opt", ("geometry",), "fast"),
    ("fisher", "eig", ("geometry",), "fast"),
    ("fisher", "v_opt", ("geometry", "backdrop"), "exact"),
    ("fisherrf", "eig", (), "inria"),
    ("coverage", "eig", (), "fast"),
)


def headline(turns: int) -> list[dict]:
    """One view of the cube scene, SH 0 to 3 of `fast`, and `exact`."""
    rows = []
    for preset, degree in (*(("fast", degree) for degree in range(4)), ("exact", 0)):
        g = cubes.cube(sh_degree=degree)
        cam = cubes.camera()
        s = Preset(preset)
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
    g = cubes.cube()
    cam = cubes.camera()
    s = Preset("fast")
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
    """Seconds of one pick among `count` poses at 320x240, H of the training views included, and of scores alone."""
    rng = np.random.default_rng(0)
    poses = []
    for k in range(count):
        camera = cameras[k % len(cameras)]
        c2w = camera.c2w.copy()
        c2w[:3, 3] += 0.05 * rng.normal(size=3) * (k >= len(cameras))
        moved = dataclasses.replace(camera.undistorted(), w2c=np.linalg.inv(c2w), name=f"pose {k}")
        poses.append(moved.resized(320, 240))
    train = [camera.undistorted().resized(320, 240) for camera in cameras[:12]]
    rows = []
    for policy, criterion, blocks, preset in PICKS:
        s = Preset(preset)
        seconds = []
        # Policies of their own criterion say nothing about it, nor about blocks.
        own = {"criterion": criterion, "blocks": blocks} if blocks else {}
        select(g, poses[:2], train[:2], 1, policy, settings=s, **own)  # kernels
        for turn in range(turns if preset != "exact" else 1):
            start = time.perf_counter()
            select(g, poses, train, 1, policy, settings=s, **own)
            seconds.append(time.perf_counter() - start)
            print(policy, criterion, *blocks, preset, turn, f"{seconds[-1]:.2f}", flush=True)
        row = {"policy": policy, "criterion": criterion, "blocks": list(blocks), "preset": preset}
        rows.append({**row, "seconds": float(np.median(seconds))})
    H, one = (fisher.diagonal(g, views, Preset("fast")) for views in (train, poses[0]))
    pool = {name: x + one[name] for name, x in H.items()}
    gains = {
        "eig": lambda: information_gain(one, H, "eig"),
        "v_opt": lambda: information_gain(one, H, "v_opt", pool=pool),
    }
    return {
        "gaussians": len(g),
        "sh": g.sh_degree,
        "poses": count,
        "train": len(train),
        "rows": rows,
        "gain of one": interleaved(gains, turns),
    }


def memory(run: Path, counts: tuple[int, ...]) -> list[dict]:
    """Peak memory of a process that scores so many candidates, each in a process of its own."""
    rows = []
    for count in counts:
        command = [sys.executable, __file__, "--run", str(run), "--task", str(count)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        rows.append({"candidates": count, "GB": float(done.stdout.split()[-1])})
    return rows


def score(run: Path, count: int) -> float:
    """Peak memory in GB after one pick."""
    g, cameras = fitted(run)
    poses = [cameras[k % len(cameras)].undistorted().resized(320, 240) for k in range(count)]
    select(g, poses, poses[:3], 1, settings=Preset("fast"))
    return (peak_memory() or 0) / 1e9


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
        g = cubes.cube(count)
        cam = cubes.camera(size)
        s = Preset("fast")
        run = interleaved({"diagonal": lambda g=g, c=[cam] * views, s=s: fisher.diagonal(g, c, s)}, turns)
        rows.append({"gaussians": count, "pixels": size, "views": views, **run})
        print(rows[-1], flush=True)
    return rows


def report(r: dict) -> str:
    """The part of the page."""
    fast, t = r["headline"][0], r["tangents"]
    ratios = [row["exact diagonal"] / row["forward+backward"] for row in r["headline"]]
    names = [
        name for name in fast if name not in ("preset", "sh", "forward", "without SH", "coverage")
    ]  # those are in fisher.json
    cells = [
        [name, *(f"{1e3 * row[name]:.0f} ({row[name] / row['forward+backward']:.2f})" for row in r["headline"])]
        for name in names
    ]
    parts = [
        f"The exact diagonal of a view takes {min(ratios):.2f} to {max(ratios):.2f} times as long as an image with "
        "gradients. "
        f"`python benchmarks/fisher.py`, {r['machine']}, {r['date']}, commit {r['commit']}"
        + (f" ({r['again']})" if "again" in r else "")
        + ": milliseconds, one view of 100,000 Gaussians in a cube, 512x512, in brackets the ratio to forward + "
        "backward. " + " ".join(r.get("note", [])),
        markdown_table(["", *(f"`{row['preset']}`, SH {row['sh']}" for row in r["headline"])], cells),
        f"**Tangents**, forward mode, `fast`: one takes {1e3 * t['1']:.0f} ms, the 6 of the pose "
        f"{1e3 * t['pose']:.0f} ([how the diagonal grows](../benchmarks/fisher.json)).",
        *([picks_line(r["picks"])] if "picks" in r else []),
    ]
    return "\n\n".join(part if part.startswith("|") else paragraph(part) for part in parts)


def picks_line(c: dict) -> str:
    """The paragraph of one pick."""
    rows = {(row["policy"], row["criterion"], tuple(row["blocks"]), row["preset"]): row["seconds"] for row in c["rows"]}
    timed = [(*key, rows[key]) for key in PICKS if key in rows]
    each = "; ".join(
        f"`{policy}` by `{criterion}`" + (f" ({', '.join(blocks)})" if blocks else "") + f" on `{preset}` {seconds:.2f}"
        for policy, criterion, blocks, preset, seconds in timed
    )
    peak = c["memory"][-1] if "memory" in c else None
    memory = f", which takes {peak['GB']:.2f} GB with {peak['candidates']} candidates" if peak else ""
    return (
        f"**One pick** among {c['poses']} candidate poses at 320x240, {c['train']} training views, {c['gaussians']:,} "
        f"Gaussians with SH {c['sh']} ({c['run']}), nothing cached, in s: {each}. The first is the default of `drgs "
        f"select`{memory}. The paper states about 7 s on an L40 GPU, for a formula that compares with `fisher` by "
        "`eig`."
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="small and few: checks that the script runs")
    parser.add_argument("--run", type=Path, help="a fitted run whose cameras are scored")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--page", action="store_true", help="the page of the results that there are")
    parser.add_argument("--task", type=int, help="only the peak memory of scoring so many candidates")
    args = parser.parse_args()
    store = ROOT / "benchmarks" / "fisher.json"
    if args.page:
        fill_between(PAGE, "fisher", report(json.loads(store.read_text())))
        return
    if args.task:
        print(score(args.run, args.task))
        return
    turns = 2 if args.quick else 5
    parts = [part for part in PARTS if part in args.parts]
    run = args.run or next((p for p in (ROOT / "runs/real/office", ROOT / "out/demo/run") if p.is_dir()), None)
    if parts == ["picks"] and run is None:
        parser.error("--parts picks needs a fitted run; name one by --run")
    result = ran() if len(parts) == len(PARTS) else json.loads(store.read_text())
    if "headline" in parts:
        result["headline"] = headline(turns)
    if "tangents" in parts:
        result["tangents"] = tangents(turns)
    if "picks" in parts and run:
        g, cameras = fitted(run)
        found = candidates(g, cameras, 10 if args.quick else 80, turns)
        result["picks"] = {"run": run.name, **found, "memory": memory(run, (2, 5) if args.quick else (5, 20, 80))}
    if "growth" in parts:
        result["growth"] = growth(turns, args.quick)
    if len(parts) < len(PARTS):
        made = ran()
        result["again"] = f"{', '.join(parts)}: {made['date']}, commit {made['commit']}"
    text = report(result)
    print(text)
    if not args.quick:
        fill_between(PAGE, "fisher", text)
        store.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
