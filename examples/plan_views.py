"""Fly a simulated camera through a data set: at every place the planner says where to go next.

    drgs scene room --views 84 --size 160x120 -o room
    python examples/plan_views.py room --photographs 20 --seconds 1
    python examples/plan_views.py room --save flight.safetensors               a file before every photograph
    python examples/plan_views.py room --save flight.safetensors --resume      goes on from it, also after a crash

A robot stands at one of the data set's cameras, and may go to any other: a meter costs one, and to read the photograph
of a place is to take it there. `--policy random` flies without a plan, `--policy order` along the data set's own
trajectory. Nothing here is about ROS: a node would call `observe` where images come in, from one thread, and `next`
where the robot asks, from another.
"""

from __future__ import annotations

import argparse
import dataclasses
import random
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

import drgs
from drgs.cameras.sizes import at_most
from drgs.fitting import losses

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
        shown = drgs.render(scene, camera, drgs.RenderSettings.preset("fast")).rgb.clamp(0, 1)
        found.append(losses.psnr(shown, torch.from_numpy(view.image(camera.width, camera.height))))
    return float(np.mean(found))


def fly(options: argparse.Namespace) -> None:
    """Take photographs, and say after each how well the model shows the views that are held out."""
    dataset = drgs.load_data(options.data)
    train, held_out = dataset.split()
    views = {view.name: view for view in train}
    places = {view.name: dataclasses.replace(view.camera.undistorted(), name=view.name) for view in train}
    print(f"{len(train)} places; the first photograph takes some seconds, for kernels are compiled", flush=True)
    planner, draw = drgs.Planner(), random.Random(options.seed)
    begin, left = 0, list(places)
    here = left[0 if options.policy == "order" else draw.randrange(len(left))]
    if options.resume:
        planner = drgs.Planner.load(options.save)
        begin, here, left, state = (planner.notes[name] for name in ("number", "here", "left", "draw"))
        draw.setstate((state[0], tuple(state[1]), state[2]))
    for number in range(begin, min(options.photographs, len(places) - 1)):  # from each there is a next one
        if options.save and number > begin:  # with what this program knows beside the planner
            planner.save(options.save, {"number": number, "here": here, "left": left, "draw": draw.getstate()})
        left.remove(here)
        planner.observe(views[here].image(), places[here], depth_of(dataset, views[here]))
        planner.fit(steps=options.steps)
        if planner.scene is None:  # two photographs are needed where none has depth
            here = left[0]
            continue
        quality, told = psnr(planner.scene, held_out[:12], 12_000), ""
        if options.policy == "plan":
            near = [places[name] for name in sorted(draw.sample(left, min(CANDIDATES, len(left))))]
            scored = planner.scores(near, cost=distance, seconds=options.seconds)
            plan = planner.next(seconds=0)  # by what `scores` has just asked
            pick = plan.picks[0]
            there = pick.camera.name
            told = f", {scored.seconds:.1f} s, {pick.cost:.1f} away, changed {plan.changed:.2f}"
        else:
            there = left[0] if options.policy == "order" else draw.choice(left)
        count = len(planner.scene)
        print(f"{number + 1}: {here}, {count} Gaussians, {quality:.2f} dB; next {there}{told}", flush=True)
        here = there


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Fly a simulated camera through a data set.")
    parser.add_argument("data", help="a data set, with depth or without")
    parser.add_argument("--policy", choices=("plan", "random", "order"), default="plan")
    parser.add_argument("--photographs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=1.0, help="for an answer")
    parser.add_argument("--steps", type=int, default=40, help="of the fit, after each photograph")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", type=Path, help="a file that is written before each photograph but the first")
    parser.add_argument("--resume", action="store_true", help="go on from that file; repeat the other options")
    options = parser.parse_args()
    if options.resume and (options.save is None or not options.save.is_file()):
        parser.error("--resume must have the file of --save to go on from, there is none; leave --resume out")
    fly(options)
