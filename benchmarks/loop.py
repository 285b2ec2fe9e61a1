"""What a cache saves a robot that picks a view at each stop.

    python benchmarks/loop.py [--quick] [--print]     a paragraph of docs/information.md, benchmarks/loop.json
    python benchmarks/loop.py --page                  the paragraph of what benchmarks/loop.json has

Ten picks around `wolf` (../shared/data, or DRGS_DATA): the view picked becomes known, and two new candidates come. The
loop is walked twice in turns, without a cache and with one, and must pick the same. Times are CPU time of the process;
run it with DRGS_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import numpy as np  # noqa: E402
from pages import fill_between  # noqa: E402
from where import DATA, ran  # noqa: E402

import drgs  # noqa: E402
from drgs.cameras import Camera, intrinsics_from_fov, look_at  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.select import Cache, select  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

KNOWN = 2
CANDIDATES = 24
NEW = 2
PAGE = ROOT / "docs" / "information.md"
RESULTS = ROOT / "benchmarks" / "loop.json"
PICKS = 10
PRESETS = ("fast", "exact")


def around(g: Gaussians, size: tuple[int, int], count: int) -> list[Camera]:
    """Cameras that look at the middle of the Gaussians from all sides, at about 2.5 times their radius."""
    rng = np.random.default_rng(0)
    middle = g.means.median(0).values
    radius = float((g.means - middle).norm(dim=1).quantile(0.9))
    K = intrinsics_from_fov(60.0, *size)
    cameras = []
    for i in range(count):
        way = rng.normal(size=3)
        eye = middle.numpy() + 2.5 * radius * rng.uniform(0.8, 1.2) * way / np.linalg.norm(way)
        cameras.append(Camera(K, look_at(eye, middle.numpy(), (0.1, 0.2, 1.0)), *size, name=f"view {i}"))
    return cameras


class Robot:
    """A loop of picks, one a call."""

    def __init__(self, g: Gaussians, cameras: list[Camera], preset: str, cache: Cache | None) -> None:
        self.g = g
        self.cache = cache
        self.settings = drgs.RenderSettings.preset(preset)
        self.known = cameras[:KNOWN]
        self.left = cameras[KNOWN : KNOWN + CANDIDATES]
        self.coming = cameras[KNOWN + CANDIDATES :]
        self.seconds: list[float] = []
        self.picks: list[str] = []

    def pick(self) -> None:
        """The next one."""
        began = time.process_time()
        found = select(self.g, self.left, self.known, 1, settings=self.settings, cache=self.cache)
        self.seconds.append(time.process_time() - began)
        self.picks.append(found.picks[0].name)
        self.known = [*self.known, self.left.pop(found.picks[0].index)]
        self.left += [self.coming.pop() for _ in range(NEW)]


def report(r: dict) -> str:
    """What docs/information.md says."""
    told = []
    for preset, row in r["rows"].items():
        without, cached = row["later"]
        told.append(f"{cached:.1f} s in place of {without:.1f} (`{preset}`)")
    return paragraph(
        f"On `wolf` ({r['gaussians']:,} Gaussians, {r['size']}, {CANDIDATES} candidates or more) a later pick takes "
        f"{', '.join(told)} of CPU time and is the same; {r['bytes'] / 1e6:.0f} MB are kept "
        f"(`python benchmarks/loop.py`, {r['machine']}, {r['date']})."
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="a few Gaussians of its own: checks that the script runs")
    parser.add_argument("--print", action="store_true", help="do not touch docs/information.md")
    parser.add_argument("--page", action="store_true", help="measure nothing, write what there is")
    args = parser.parse_args()
    if args.page:
        fill_between(PAGE, "loop", report(json.loads(RESULTS.read_text())))
        return
    if args.quick:
        g = drgs.testing.random_scene(0)[0].detach()
        size = (24, 16)
    else:
        g = drgs.load_gaussians(DATA / "splats/wolf/wolf.ply")
        size = (220, 147)
    cameras = around(g, size, KNOWN + CANDIDATES + NEW * PICKS)
    result: dict = {**ran(), "gaussians": len(g), "size": f"{size[0]}x{size[1]}", "rows": {}}
    for preset in PRESETS:
        cache = Cache()
        robots = [Robot(g, list(cameras), preset, None), Robot(g, list(cameras), preset, cache)]
        Robot(g, list(cameras), preset, None).pick()  # compiles
        for _ in range(PICKS):
            for robot in robots:
                robot.pick()
        if robots[0].picks != robots[1].picks:
            raise SystemExit(f"{preset}: picks differ: {robots[0].picks}, {robots[1].picks}")
        result["rows"][preset] = {
            "all": [sum(robot.seconds) for robot in robots],
            "later": [statistics.median(robot.seconds[1:]) for robot in robots],
        }
        result |= {"misses": cache.misses, "hits": cache.hits, "bytes": cache.bytes}
        print(preset, result["rows"][preset], cache, flush=True)
    text = report(result)
    print(text)
    if not args.quick:
        RESULTS.write_text(json.dumps(result, indent=1) + "\n")
    if not (args.print or args.quick):
        fill_between(PAGE, "loop", text)


if __name__ == "__main__":
    main()
