"""Fly a simulated camera through a data set: at every place the planner says where to go next.

    drgs scene room --views 84 --size 160x120 -o room
    python examples/plan_views.py room --photographs 20 --seconds 1
    python examples/plan_views.py room --save flight.safetensors               a file before every photograph
    python examples/plan_views.py room --save flight.safetensors --resume      goes on from it, also after a crash

A robot stands at one of the data set's cameras. It may go to any other, at a cost of one for each meter, and to read
the photograph of a place is to take it there. After each one the model is fitted for a while, and what it shows of the
views that are held out is measured. `--policy random` flies without a plan, `--policy order` along the data set's own
trajectory, one frame of a sequence at a time. Nothing here is about ROS: a node would call `observe` where images come
in, from one thread, and `next` where the robot asks, from another.
"""

from __future__ import annotations

import argparse
import dataclasses
import random
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

import drgs
from drgs.cameras.sizes import at_most

CANDIDATES = 30  # places, at most, that are compared at a time


def distance(here: drgs.Camera, there: drgs.Camera) -> float:
    """What it costs to go from one place to another, world units."""
    return float(np.linalg.norm(there.center - here.center))


def depth_of(dataset: drgs.Dataset, view: drgs.View) -> np.ndarray | None:
    """(H, W) z-depth of a view, where there is one: a made room keeps it beside, in tenths of a millimeter."""
    if view.depth_path is not None:
        return view.depth()
    path = Path(dataset.path) / "depth" / f"depth_{view.stem.rpartition('_')[2]}.png"
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1e4 if path.is_file() else None


def psnr(scene: drgs.Gaussians, views: Sequence[drgs.View], pixels: int) -> float:
    """PSNR of views that are held out, dB, on average."""
    found = []
    for view in views:
        camera = at_most(view.camera.undistorted(), pixels)
        shown = drgs.render(scene, camera, drgs.RenderSettings.preset("fast")).rgb.clamp(0, 1).numpy()
        error = ((shown - view.image(camera.width, camera.height)) ** 2).mean()
        found.append(-10 * np.log10(error))
    return float(np.mean(found))


def fly(
    dataset: drgs.Dataset,
    policy: str,
    photographs: int,
    seconds: float | None,
    steps: int,
    seed: int,
    file: Path | None = None,
    resume: bool = False,
) -> list[float]:
    """PSNR of the held-out views after each photograph, dB."""
    draw = random.Random(seed)
    train, held_out = dataset.split()
    views = {view.name: view for view in train}
    places = {view.name: dataclasses.replace(view.camera.undistorted(), name=view.name) for view in train}
    print(f"{len(train)} places; the first photograph takes some seconds, for kernels are compiled", flush=True)
    if resume:
        assert file is not None, "--resume needs --save"
        planner = drgs.Planner.load(file)
        before = planner.notes  # what this program knows beside the planner
        version, numbers, gauss = before["draw"]
        draw.setstate((version, tuple(numbers), gauss))
        curve, left, here = before["curve"], [places[name] for name in before["left"]], places[before["here"]]
        begin = before["number"]
    else:
        planner = drgs.Planner()
        curve, left, begin = [], list(places.values()), 0
        here = left[0 if policy == "order" else draw.randrange(len(left))]
    for number in range(begin, photographs):
        if file is not None and number > begin:
            names = [camera.name for camera in left]
            planner.save(
                file, {"number": number, "here": here.name, "left": names, "curve": curve, "draw": draw.getstate()}
            )
        left = [camera for camera in left if camera.name != here.name]
        view = views[here.name]
        planner.observe(view.image(), here, depth_of(dataset, view))
        planner.fit(steps=steps)
        if planner.scene is None:  # two photographs are needed where none has depth
            here = left[0]
            continue
        curve.append(psnr(planner.scene, held_out[:12], 12_000))
        told = ""
        if policy == "plan":
            near = sorted(draw.sample(left, min(CANDIDATES, len(left))), key=lambda camera: camera.name)
            planner.scores(near, cost=distance, seconds=seconds)
            plan = planner.next(seconds=0)  # by what `scores` has just asked
            chosen = near[plan.picks[0].index]
            told = f", {plan.seconds:.1f} s, {distance(here, chosen):.1f} away, changed {plan.changed:.2f}"
        else:
            chosen = left[0] if policy == "order" else draw.choice(left)
        count = len(planner.scene)
        print(f"{number + 1}: {here.name}, {count} Gaussians, {curve[-1]:.2f} dB; next {chosen.name}{told}", flush=True)
        here = chosen
    return curve


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description="Fly a simulated camera through a data set.")
    parser.add_argument("data", help="a data set, with depth or without")
    parser.add_argument("--policy", choices=("plan", "random", "order"), default="plan")
    parser.add_argument("--photographs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=1.0, help="for an answer")
    parser.add_argument("--steps", type=int, default=40, help="of the fit, after each photograph")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", type=Path, help="a file that is written before each photograph but the first")
    parser.add_argument("--resume", action="store_true", help="go on from that file; repeat the other options")
    args = parser.parse_args()
    if args.resume and (args.save is None or not args.save.is_file()):
        parser.error("--resume must have the file of --save to go on from, there is none; leave --resume out")
    how = args.policy, args.photographs, args.seconds, args.steps, args.seed
    fly(drgs.load_data(args.data), *how, args.save, args.resume)


if __name__ == "__main__":
    main()
