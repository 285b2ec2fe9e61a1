"""What exact order costs on scenes that people have: `exact` against `fast`, on fits, a splat and the cube.

    python benchmarks/exact.py [--fits FOLDER] [--turns 7]      a part of docs/benchmarks.md, benchmarks/exact.json
    python benchmarks/exact.py --parts memory torch             these parts again, the others as they are
    python benchmarks/exact.py --page                           that part, of the results that there are

Fits are made once, in FOLDER (default runs/exact), of the captures `office` and `banana` in DRGS_DATA and of a still
life made here; the splat is `wolf` there. What is not there is left out, and the page says so. Presets take turns in
one process for each scene and number of threads; figures are medians. The same frames are timed against Mitsuba's
`volprim_rf_basic` (shapes `ellipsoids` and `ellipsoidsmesh`); a smaller cube against gsplat's own torch code, by
examples/gsplat_torch.py.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cubes  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from clocks import interleaved  # noqa: E402
from pages import fill_between  # noqa: E402
from render import PAGE, Preset, backward, forward, volprim  # noqa: E402
from where import DATA, ran  # noqa: E402

import drgs  # noqa: E402
from drgs import data, fisher  # noqa: E402
from drgs.cameras.sizes import at_most  # noqa: E402
from drgs.runtime.machine import peak_memory  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402
from drgs.train import FitConfig, fit  # noqa: E402

PIXELS = 76_800  # of a view: 320x240
FITTED = ("office", "banana", "still life")
SCENES = ("office", "banana", "still life", "wolf", "cube")
KINDS = ("forward", "forward + backward", "Fisher diagonal")
MESH = {"type": "ellipsoidsmesh", "extent_adaptive_clamping": True}
TORCH = 10_000, 128  # Gaussians, and pixels along a side: what torch code can do
TORCH_ROWS = ("gsplat's torch code", "preset gsplat")


def fitted(name: str, folder: Path) -> tuple[drgs.Gaussians, drgs.Camera] | None:
    """The Gaussians and a view of a fit, made where it is not there yet; None without its photographs."""
    if name == "still life":
        from drgs.scenes import still_life

        print("still life: 48 views are rendered where they are not there yet", file=sys.stderr, flush=True)
        source = still_life.generate(folder / "still-life-data", views=48, width=320, height=240, seed=1)
    else:
        source = DATA / name
        if not source.is_dir():
            return None
    dataset = data.load(source)
    run = folder / name.replace(" ", "-")
    if not (run / "point_cloud.ply").exists():
        fit(
            dataset,
            run,
            FitConfig().replace(
                renderers=("fast",), max_pixels=10_800, max_gaussians=20_000, max_steps=1000, semantics="ignore"
            ),
        )
    view = dataset.views[len(dataset.views) // 2]
    return drgs.load_ply(run / "point_cloud.ply"), at_most(view.camera.undistorted(), PIXELS)


def scene(name: str, folder: Path) -> tuple[drgs.Gaussians, drgs.Camera] | None:
    """Gaussians and a view."""
    if name in FITTED:
        return fitted(name, folder)
    if name == "cube":
        return cubes.cube(), cubes.camera()
    path = DATA / "splats" / "wolf" / "wolf.ply"
    if not path.exists():
        return None
    g = drgs.load_ply(path)
    center = g.means.median(0).values
    reach = float((g.means - center).norm(dim=1).quantile(0.9))
    middle = center.numpy()
    w2c = drgs.cameras.look_at(middle + np.array([1.2, 0.8, 1.5]) * reach, middle, (0, 1, 0))
    return g, drgs.Camera(K=np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), w2c=w2c, width=320, height=240)


def task_scene(name: str, folder: Path, turns: int) -> dict | None:
    """Seconds of each preset and kind, hits a pixel, and the peak of memory."""
    found = scene(name, folder)
    if found is None:
        return None
    g, cam = found
    runs = {}
    for preset in ("fast", "exact"):
        s = Preset(preset)
        runs[preset, KINDS[0]] = forward(g, cam, s)
        runs[preset, KINDS[1]] = backward(g, cam, s)
        runs[preset, KINDS[2]] = lambda s=s: fisher.diagonal(g, cam, s)
    seconds = interleaved(runs, turns)
    hits, few = (drgs.render(g, cam, Preset(x), outputs="count").count.float().mean() for x in ("exact", "fast"))
    return {
        "gaussians": len(g),
        "size": [cam.width, cam.height],
        "hits": float(hits),
        "hits of fast": float(few),
        "seconds": {f"{preset}, {kind}": t for (preset, kind), t in seconds.items()},
        "peak GB": (peak_memory() or 0) / 1e9,
    }


def task_memory(name: str, folder: Path, turns: int) -> dict:
    """Peak memory of a frame forward and backward, and of a Fisher diagonal: 1,000,000 Gaussians at 1024 x 1024."""
    g, cam = cubes.cube(1_000_000), cubes.camera(1024)
    backward(g, cam, Preset("exact"))()
    frame = (peak_memory() or 0) / 1e9
    fisher.diagonal(g, cam, Preset("exact"))
    return {"frame": frame, "with the diagonal": (peak_memory() or 0) / 1e9}


def task_peers(name: str, folder: Path, turns: int) -> dict:
    """The cube against Mitsuba's integrator on both of its shapes."""
    g, cam = cubes.cube(), cubes.camera()
    runs = {
        "volprim, ellipsoids": volprim(g, cam, False),
        "volprim, ellipsoidsmesh": volprim(g, cam, False, **MESH),
        "fast": forward(g, cam, Preset("fast")),
        "exact": forward(g, cam, Preset("exact")),
    }
    return {"rest": interleaved(runs, turns, warm=True)}


def task_torch(name: str, folder: Path, turns: int) -> dict:
    """gsplat's torch code against our preset of its model, on a cube that its memory allows."""
    from examples.gsplat_torch import rasterization

    g = cubes.cube(TORCH[0])
    cam = cubes.camera(TORCH[1])
    s = Preset("gsplat")
    raw = {"means": g.means, "quats": g.quats, "log_scales": g.log_scales, "logits": g.logit_opacities, "sh": g.sh}
    leaves = {key: x.clone().requires_grad_() for key, x in raw.items()}
    view = torch.tensor(np.array(cam.w2c))[None].float()
    K = torch.tensor(cam.K)[None].float()

    def drawn(x: dict) -> torch.Tensor:
        shape = x["means"], x["quats"], x["log_scales"].exp(), x["logits"].sigmoid(), x["sh"]
        return rasterization(*shape, view, K, cam.width, cam.height, sh_degree=0)[0][0]

    def alone() -> torch.Tensor:
        with torch.no_grad():
            return drawn(raw)

    def differentiated() -> None:
        drawn(leaves).sum().backward()
        for leaf in leaves.values():
            leaf.grad = None

    runs = {"gsplat's torch code, forward": alone, "preset gsplat, forward": forward(g, cam, s)}
    runs |= {"gsplat's torch code, both": differentiated, "preset gsplat, both": backward(g, cam, s)}
    return {"seconds": interleaved(runs, turns)}


TASKS = {
    "scene": task_scene,
    "memory": task_memory,
    "peers": task_peers,
    "torch": task_torch,
}
PARTS = ("scenes", "memory", "peers", "torch")


def child(task: str, name: str, threads: int, args: argparse.Namespace) -> dict | None:
    """A task of this script in a process of its own."""
    command = [sys.executable, __file__, "--task", task, "--scene", name, "--fits", str(args.fits)]
    command += ["--turns", str(args.turns)]
    print(f"{task} {name}, {threads} threads ...", flush=True)
    env = {**os.environ, "DRGS_THREADS": str(threads)}
    out = subprocess.run(command, env=env, stdout=subprocess.PIPE, text=True, check=True)
    result = json.loads(out.stdout.strip().splitlines()[-1])
    print(task, name, threads, result, flush=True)
    return result


def ratios(found: dict, kind: str) -> list[float]:
    """Times of `exact` over those of `fast`, by scene."""
    every = [row["seconds"] for row in found.values() if row]
    return [t[f"exact, {kind}"] / t[f"fast, {kind}"] for t in every]


def between(values: list[float]) -> str:
    """The least and the largest."""
    return f"{min(values):.1f} to {max(values):.1f}"


def hit_ratios(found: dict) -> list[float]:
    """Of each scene, hits a pixel of `exact` in multiples of those of `fast`."""
    return [row["hits"] / row["hits of fast"] for row in found.values() if row]


def hit_costs(found: dict) -> list[float]:
    """Of each scene, time of an image by `exact` in multiples of that by `fast`, for each hit."""
    more = hit_ratios(found)
    return [ratio / many for ratio, many in zip(ratios(found, KINDS[0]), more, strict=True)]


def report(result: dict) -> str:
    """The part of the page."""
    memory, peers = result["memory"], result["peers"]
    one, two = result["scenes"]["1"], result["scenes"]["2"]
    cost = [between(ratios(one, kind)) for kind in KINDS]
    rest = {name: peers["rest"]["volprim, ellipsoids"] / seconds for name, seconds in peers["rest"].items()}
    again = f" ({result['again']})" if "again" in result else ""
    slow = result["torch"]["seconds"]
    theirs, ours = ([slow[f"{name}, {kind}"] for kind in ("forward", "both")] for name in TORCH_ROWS)
    parts = [
        f"On one thread `exact` takes {cost[0]} times as long as `fast` for an image, {cost[1]} times with gradients "
        f"and {cost[2]} times for a Fisher diagonal; on two threads "
        f"{', '.join(between(ratios(two, kind)) for kind in KINDS)} times.",
        f"`python benchmarks/exact.py`, {result['machine']}, {result['date']}, commit {result['commit']}{again}: "
        f"views of {', '.join(one)}, without depth ([by scene](../benchmarks/exact.json)). Fits have 1,000 steps at "
        "10,800 pixels.",
        f"`exact` composites {between(hit_ratios(one))} times as many hits, and takes {between(hit_costs(one))} times "
        f"as long for each. 1,000,000 Gaussians at 1024x1024 take {memory['frame']:.2f} GB forward + backward, "
        f"{memory['with the diagonal']:.2f} GB with a Fisher diagonal after it.",
        f"**Peers**, two threads: on the cube `exact` is {rest['exact']:.1f} times as fast as `volprim_rf_basic`, "
        f"`fast` {rest['fast']:.1f} times. gsplat 1.5.3's own torch functions on the CPU "
        f"([which](../examples/gsplat_torch.py); {TORCH[0]:,} Gaussians, {TORCH[1]}x{TORCH[1]}) take "
        f"{1e3 * theirs[0]:.0f} ms forward and {1e3 * theirs[1]:.0f} ms forward + backward, our preset `gsplat` "
        f"{1e3 * ours[0]:.0f} and {1e3 * ours[1]:.0f} ms.",
    ]
    return "\n\n".join(part if part.startswith("|") else paragraph(part) for part in parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=Path, default=ROOT / "runs" / "exact")
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--task", choices=TASKS)
    parser.add_argument("--scene", default="")
    parser.add_argument("--page", action="store_true", help="the page of the results that there are")
    args = parser.parse_args()
    store = ROOT / "benchmarks" / "exact.json"
    if args.page:
        fill_between(PAGE, "exact", report(json.loads(store.read_text())))
        return
    if args.task:
        print(json.dumps(TASKS[args.task](args.scene, args.fits, args.turns)))
        return
    for name in FITTED:
        scene(name, args.fits)
    parts = args.parts
    result = ran() if set(parts) == set(PARTS) else json.loads(store.read_text())
    if "scenes" in parts:
        result["scenes"] = {
            str(threads): {name: child("scene", name, threads, args) for name in SCENES} for threads in (1, 2)
        }
    for task in ("memory", "peers", "torch"):
        if task in parts:
            result[task] = child(task, "", 2, args)
    if len(parts) < len(PARTS):
        made = ran()
        result["again"] = f"{', '.join(parts)}: {made['date']}, commit {made['commit']}"
    store.write_text(json.dumps(result, indent=1) + "\n")
    fill_between(PAGE, "exact", report(result))


if __name__ == "__main__":
    main()
