"""What `drgs crossval` says of broken rasterizers and of outside code; writes the tables of docs/crossval.md.

    python benchmarks/crossval.py [--only broken|outside]

Outside code: Mitsuba's `volprim_rf_basic` and, where it is installed, gsplat's own torch code (examples/). Scenes:
random ones, and of the wolf (DRGS_DATA) the 2,000 Gaussians that weigh most in a view of 64x48 pixels (250 at 48x40 for
the broken ones, which are dense).
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import math
import time
from pathlib import Path

import studies
import torch
from studies import DATA, ROOT

import sys  # isort: skip

sys.path[:0] = [str(ROOT / "tests")]

import torch_rasterizer  # noqa: E402

import drgs  # noqa: E402
from drgs.crossval import crossval  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.files import load_ply  # noqa: E402
from drgs.orbits import Wish, scene_orbit  # noqa: E402
from drgs.rasterizers import GROUPS, function, load  # noqa: E402
from drgs.testing import random_scene  # noqa: E402

BACKGROUND = (0.3, 0.6, 0.2)
OUTSIDE = {
    "gsplat 1.5.3, its torch code": ("examples.gsplat_torch:rasterization", "gsplat"),
    "volprim_rf_basic, sRGB step off": ("examples.volprim_adapter:volprim_rf_basic_linear", "mitsuba"),
    "volprim_rf_basic, as shipped": ("examples.volprim_adapter:volprim_rf_basic", "mitsuba"),
}


def wolf(count: int, width: int, height: int) -> tuple | None:
    """The Gaussians of the wolf that weigh most in one view."""
    path = DATA / "splats" / "wolf" / "wolf.ply"
    if not path.exists():
        return None
    g = load_ply(path)
    camera = scene_orbit(g, 8, width=width, height=height, wish=Wish(fov=70, elevation=10.0))[0]
    weight = drgs.render(g, camera, outputs=("visibility",)).visibility
    index = torch.topk(weight, count).indices
    return Gaussians(**{name: getattr(g, name)[index] for name in GROUPS}), [camera]


def shrunk(scene: tuple, factor: float) -> tuple:
    """The same picture of a world in other units."""
    g, (camera,) = scene
    w2c = camera.w2c.copy()
    w2c[:3, 3] *= factor
    g = g.replace(means=g.means * factor, log_scales=g.log_scales + math.log(factor))
    return g, [dataclasses.replace(camera, w2c=w2c)]


def broken() -> list[str]:
    """One line a defect."""
    scenes = {f"random {seed}": random_scene(seed) for seed in range(3)}
    real = wolf(250, 48, 40)
    if real:
        scenes["wolf"] = real
    lines = [
        "| rasterizer | what is wrong | " + " | ".join(scenes) + " | named |",
        "|---|---|" + "---|" * len(scenes) + "---|",
    ]
    for name in ("correct", *torch_rasterizer.DEFECTS):
        call = torch_rasterizer.rasterization if name == "correct" else torch_rasterizer.DEFECTS[name].make()
        what = "nothing" if name == "correct" else torch_rasterizer.DEFECTS[name].what
        cells, named = [], {}
        for g, cameras in scenes.values():
            found = crossval(function(call, name), g, cameras, "gsplat", {"background": BACKGROUND})
            cells.append(found.verdict)
            for c in found.report["conventions"]:
                named[f"{c['name']}: {c['found']}"] = None
            for group, row in found.report["groups"].items():
                if row["verdict"] in ("gradient bug", "known deviation"):
                    named[group] = None
        lines.append(f"| `{name}` | {what} | " + " | ".join(cells) + f" | {', '.join(named)} |")
        print(lines[-1], flush=True)
    return lines


def outside() -> list[str]:
    """One line a rasterizer and scene."""
    lines = [
        "| rasterizer | scene | preset | conventions that differ | RMS of the image | pixels off by > 0.001 "
        "| mean of alpha | verdict | relative difference of gradients: means, quats, log_scales, logit_opacities, sh "
        "| seconds |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    scenes = {f"random {seed}": random_scene(seed, aspect=1.0) for seed in range(3)}
    scenes["random 0, 10 times smaller"] = shrunk(scenes["random 0"], 0.1)
    real = wolf(2000, 64, 48)
    if real:
        scenes["wolf"] = real
    for label, (name, preset) in OUTSIDE.items():
        if "gsplat" in name and importlib.util.find_spec("gsplat") is None:
            print("gsplat is not installed: left out")
            continue
        for place, (g, cameras) in scenes.items():
            start = time.perf_counter()
            found = crossval(load(name), g, cameras, preset, {"background": BACKGROUND})
            seconds = time.perf_counter() - start
            view = found.report["image"]["views"][0]
            odd = "; ".join(f"{c['name']}: {c['found']}" for c in found.report["conventions"]) or "-"
            groups = []
            for row in found.report["groups"].values():
                mark = {"gradient bug": "**", "agreement": ""}.get(row["verdict"], "")
                groups.append(f"{mark}{row['relative']:.0e}{mark}")
            lines.append(
                f"| {label} | {place} | {preset} | {odd} | {view['rms']:.0e} | {view['share']:.1%} "
                f"| {view['alpha']['bias']:+.0e} | {found.verdict} | "
                f"{', '.join(groups)} | {seconds:.0f} |"
            )
            print(lines[-1], flush=True)
    return lines


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", choices=["broken", "outside"])
    parser.add_argument("--print", action="store_true", help="do not touch docs/crossval.md")
    args = parser.parse_args()
    for part, make in (("broken", broken), ("outside", outside)):
        if args.only in (None, part):
            made = studies.stamp("crossval")
            lines = make()
            if not args.print:
                page = Path(ROOT) / "docs" / "crossval.md"
                begin, end = f"<!-- {part}: begin -->", f"<!-- {part}: end -->"
                before, _, rest = page.read_text().partition(begin)
                text = "\n".join(["", "", f"Made by {made}", "", *lines, "", ""])
                page.write_text(before + begin + text + end + rest.partition(end)[2])


if __name__ == "__main__":
    main()
