"""What a deformation field costs: the share of a training step, with and without gates, and seconds a pick.

    python benchmarks/dynamic.py [--quick]             prints, writes benchmarks/dynamic.json and the data file
    python benchmarks/dynamic.py --run RUN             the same of a fit to what moves, dynamic-run.json; no picks
    python benchmarks/dynamic.py --page                measures nothing, writes the data file

The data file is docs/data/moving-steps.csv.

50,000 Gaussians, 320x240, 40 times; those of a run are split until there are as many. A step is the trainer's own
(loss, backward pass, optimizer, gates that are ajar in every tenth); steps with a field and without take turns in one
process, ten at a time. Times are CPU time of the process, which other programs on the machine change little; run it
with DRGS_THREADS=1.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import cubes  # noqa: E402
import torch  # noqa: E402
from clocks import interleaved  # noqa: E402
from studies import write_csv  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs.cameras import Camera, orbit  # noqa: E402
from drgs.data import load  # noqa: E402
from drgs.deform import DynamicGaussians  # noqa: E402
from drgs.ellipsoids import Gaussians, semi_axes  # noqa: E402
from drgs.files import Run  # noqa: E402
from drgs.fitting.components.motion import MotionComponent, Smoothness  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import Frame  # noqa: E402
from drgs.fitting.records import load_run  # noqa: E402
from drgs.fitting.rows import GaussianRows  # noqa: E402
from drgs.fitting.trainer import Trainer  # noqa: E402
from drgs.select import Scoring, select  # noqa: E402

TIMES = 40
CAMERAS = 15
STEPS = 10  # of a turn: gates are ajar in one of them
SHARES = (0.1, 0.25, 1.0)
RESULTS = (ROOT / "benchmarks" / "dynamic.json", ROOT / "benchmarks" / "dynamic-run.json")


def frames(size: tuple[int, int], cameras: list[Camera]) -> list[Frame]:
    """Random photographs of all cameras at all times: what a step costs does not depend on what they show."""
    image = torch.rand(size[1], size[0], 3, generator=torch.Generator().manual_seed(0))
    times = [k / (TIMES - 1) for k in range(TIMES)]
    return [
        Frame(f"cam{i:02}/{k:04}", dataclasses.replace(camera, time=at), image)
        for k, at in enumerate(times)
        for i, camera in enumerate(cameras)
    ]


def enlarged(g: Gaussians, motion: torch.Tensor, count: int) -> tuple[Gaussians, torch.Tensor]:
    """Each Gaussian as several that share its volume and its gate."""
    times = -(-count // len(g))
    index = torch.arange(len(g)).repeat_interleave(times)[:count]
    many = g.take(index)
    noise = torch.randn(count, 3, 1, generator=torch.Generator().manual_seed(0))
    means = many.means + (semi_axes(many.quats, many.scales) @ noise)[..., 0]
    return many.replace(means=means, log_scales=many.log_scales - math.log(times) / 3), motion[index]


def of_run(path: Path, size: tuple[int, int], count: int) -> tuple[Gaussians, torch.Tensor, list[Frame]]:
    """Gaussians and gates of a run, and its data set's cameras."""
    held = load_run(Run(path))
    g, motion = enlarged(held.moving.gaussians, held.moving.motion, count)
    views = {view.camera_name: view.camera for view in load(held.record.data, lazy=True, points=False).views}
    return g.detach(), motion.detach(), frames(size, [camera.resized(*size) for camera in views.values()])


def trainer(g: Gaussians, shown: list[Frame], gates: torch.Tensor | None) -> Trainer:
    """A fit at the first step of its dynamic stage; of what stands still where there are no gates."""
    config = FitConfig().replace(
        renderers=("fast",), max_steps=10**6, static_share=0.0
    )  # so long that neither rates nor density control begin
    tensors = g.parameters()
    rows = GaussianRows(
        {**{k: v for k, v in tensors.items() if k != "sh"}, "sh_dc": g.sh[:, :1], "sh_rest": g.sh[:, 1:]}
    )
    motion = [] if gates is None else [MotionComponent([k / (TIMES - 1) for k in range(TIMES)])]
    made = Trainer(config, shown, rows, 1.0, motion)
    made.step()
    if gates is not None:
        with torch.no_grad():
            made.rows.tensors["motion"].copy_(gates)
    return made


def steps(made: dict[str, Trainer], turns: int) -> dict[str, float]:
    """CPU seconds a step by name, medians of turns of ten."""

    def ten(fit: Trainer) -> None:
        for _ in range(STEPS):
            fit.step()

    spent = interleaved({name: lambda fit=fit: ten(fit) for name, fit in made.items()}, turns, time.process_time)
    return {name: seconds / STEPS for name, seconds in spent.items()}


def profile(fit: Trainer, turns: int) -> dict[str, float]:
    """CPU seconds of the parts that a field adds, each by itself."""
    scene = fit.scene()
    fitted = [x for x in scene.parameters().values() if x.requires_grad]
    smooth = next(term for x in fit.components for term in x.terms if isinstance(term, Smoothness))

    def there_and_back():
        seen = scene.at(0.3)
        total = seen.means.sum() + seen.quats.sum() + seen.log_scales.sum()
        torch.autograd.grad(total, fitted, allow_unused=True)

    def alone(run: Callable[[], object]) -> float:
        return interleaved({"": run}, turns, time.process_time)[""]

    return {
        "field, forward": alone(lambda: scene.at(0.3)),
        "field, forward and backward": alone(there_and_back),
        "regularizers": alone(lambda: smooth(None, None, None).backward()),
        "optimizer": sum(alone(network.optimizer.step) for network in fit.networks),
    }


def pick(scene: DynamicGaussians, shown: list[Frame]) -> dict[str, float]:
    """CPU seconds of choosing one of all cameras at a later time, all at the first one being known."""
    known = [frame.camera for frame in shown[:CAMERAS]]
    later = [frame.camera for frame in shown[CAMERAS : 2 * CAMERAS]]
    held = DynamicGaussians(scene.gaussians.detach(), scene.field, scene.motion.detach())
    spent = {}
    for blocks in (("geometry",), ("geometry", "deformation")):
        began = time.process_time()
        scoring = Scoring("eig", settings=drgs.RenderSettings.preset("fast"), blocks=blocks)
        select(held, later, known, 1, "fisher", scoring=scoring)
        spent["+".join(blocks)] = time.process_time() - began
    return spent


def csv_lines(results: list[dict]) -> Iterator[list[str]]:
    """Milliseconds of steps, of their parts by themselves, and of picks, with where and when."""
    yield ["scene", "Gaussians that move", "what", "milliseconds", "machine", "date", "commit", "load"]
    for r in results:
        ran_at = [r["machine"], r["date"], r["commit"], f"{r['load']:.0f} programs on {r['cores']} cores"]
        first = next(iter(r["profile"]))
        spent = [(name, "a step", seconds) for name, seconds in r["steps"].items()]
        spent += [(name, part, seconds) for name, parts in r["profile"].items() for part, seconds in parts.items()]
        spent += [(first, f"a pick by {name}", seconds) for name, seconds in r.get("pick", {}).items()]
        for name, what, seconds in spent:
            moving = "none, no field" if name == "still" else name
            yield [r["scene"], moving, what, f"{1e3 * seconds:.0f}", *ran_at]


def write_page() -> None:
    """The data file, of the results that are there."""
    results = [json.loads(path.read_text()) for path in RESULTS if path.exists()]
    write_csv(ROOT / "docs" / "data" / "moving-steps.csv", csv_lines(results))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="small and few: checks that the script runs")
    parser.add_argument("--run", type=Path, help="take the Gaussians and the gates of a fit to what moves")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--page", action="store_true", help="measure nothing, write the data file of what is there")
    args = parser.parse_args()
    if args.page:
        write_page()
        return
    count, size, turns = (500, (32, 24), 1) if args.quick else (50_000, (320, 240), args.turns)
    if args.run is not None:
        g, motion, shown = of_run(args.run, size, count)
        shares = {f"{100 * float((motion >= 0).float().mean()):.0f} %": motion}
    else:
        g = cubes.cube(count, sh_degree=1)
        shown = frames(size, orbit((0, 0, 0), 4.0, CAMERAS, width=size[0], height=size[1]))
        draw = torch.rand(count, generator=torch.Generator().manual_seed(1))
        shares = {
            "all" if share == 1 else f"{100 * share:.0f} %": torch.where(draw < share, 2.0, -2.0) for share in SHARES
        }
    made = {"still": trainer(g, shown, None)} | {name: trainer(g, shown, gates) for name, gates in shares.items()}
    result = {
        **ran(),
        "load": os.getloadavg()[0],
        "cores": os.cpu_count(),
        "scene": "a fitted run, split" if args.run else "a random cube",
        "gaussians": len(g),
        "size": size,
        "turns": turns,
        "steps": steps(made, turns),
        "profile": {name: profile(made[name], turns) for name in shares},
    }
    first = made[next(iter(shares))]
    if args.run is None:
        result["pick"] = pick(first.scene(), shown)
    print(json.dumps(result))
    if not args.quick:
        RESULTS[args.run is not None].write_text(json.dumps(result, indent=1) + "\n")
        write_page()


if __name__ == "__main__":
    main()
