"""What else a second of a fit could be spent on: held-out PSNR, and time, of fits whose steps see something else.

    python benchmarks/schedules.py [--scenes banana ...] [--changes none "exact to 0.01" ...] [--trained any]
        [--steps 300] [--max-pixels 12000] [--max-gaussians 8000] [--units 1] [--made FOLDER]
    python benchmarks/schedules.py --times FITS [--scenes banana ...] [--max-pixels 130000]
    python benchmarks/schedules.py --page   the tables of docs/one-model.md, docs/data/schedule*.csv

Appends one row a fit to benchmarks/schedules.jsonl as it ends and leaves out what is there. A change is made to the
trainer before the first step; "a + b" makes both. Seconds are those that the process computed in its steps, whatever
ran beside it. One thread. Made scenes are folders of `--made` (docs/real-data.md has their commands).

`--times` fits nothing: it takes `FITS/SCENE`, a run folder, and times rendering, loss and derivatives of two of its
photographs in turns, by renderer and at a half and a quarter of the width and height; rows: schedule_times.jsonl.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import torch  # noqa: E402
from fits import folder_of, psnr_by_renderer, split_of  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.codecs.ply import load_ply  # noqa: E402
from drgs.data import load  # noqa: E402
from drgs.data.resampling import resize_area  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import frames_for  # noqa: E402
from drgs.fitting.losses import padded_ssim  # noqa: E402
from drgs.fitting.renderers import RendererSchedule  # noqa: E402
from drgs.fitting.resolution import Resolution  # noqa: E402
from drgs.fitting.start import start_plain  # noqa: E402
from drgs.fitting.trainer import Trainer  # noqa: E402
from drgs.integrator import render  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.statistics import estimate  # noqa: E402
from drgs.studies.tables import markdown_table, paragraph  # noqa: E402

ROWS = ROOT / "benchmarks" / "schedules.jsonl"
PAGE = ROOT / "docs" / "one-model.md"
TIMES = ROOT / "benchmarks" / "schedule_times.jsonl"
SCENES = ("banana", "fern", "office", "still0", "room21")
SEEN = ("exact", "fast", "gsplat", "3dgut")
KEY = ("scene", "change", "trained", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")

Change = Callable[[Trainer], None]


def exact_to(tolerance: float | None) -> Change:
    """Steps with `exact` among other renderers have a tolerance, or none."""

    def change(trainer: Trainer) -> None:
        cycle = trainer.renderers.cycle
        cycle = tuple(x.replace(tolerance=tolerance) if x.order == "ray" else x for x in cycle)
        trainer.renderers = RendererSchedule(cycle)

    return change


def updates(count: int, num_downscales: int = 1) -> Change:
    """Steps of several updates, of small photographs at first, then of quarters."""

    def change(trainer: Trainer) -> None:
        trainer.resolution = Resolution(num_downscales, trainer.config.max_steps, count)

    return change


CHANGES: dict[str, Change] = {
    "none": lambda trainer: None,
    "exact to 0": exact_to(None),
    "exact to 0.01": exact_to(0.01),
    "exact to 0.1": exact_to(0.1),
    "2 updates": updates(2),
    "3 updates": updates(3),
    "4 updates": updates(4),
    "3 updates, never small": updates(3, 0),
    "3 updates, a quarter at first": updates(3, 2),
}
"""Name -> what it changes of a trainer. Rows of other changes are of code that lost and was not kept."""


def fit(key: tuple, made: Path) -> dict:
    """The row of one fit; `made` is the folder of the made scenes."""
    named = dict(zip(KEY, key, strict=True))
    scene = named["scene"]
    dataset = load(folder_of(scene, made))
    config = FitConfig().replace(
        renderers=(named["trained"],),
        seed=named["seed"],
        test_offset=named["offset"],
        skybox="off",
        semantics="ignore",
        **{name: named[name] for name in KEY[5:]},
    )
    train, test = split_of(dataset, config)
    frames = frames_for(train, config.data)
    trainer = start_plain(dataset, train, frames, config)
    for name in named["change"].split(" + "):
        CHANGES[name](trainer)
    took: dict[str, float] = {}
    while trainer.step_index < config.max_steps:
        preset = trainer.renderers.settings_at(trainer.step_index).nearest_preset()[0]
        began = time.process_time()
        trainer.step()
        took[preset] = took.get(preset, 0.0) + time.process_time() - began
    renderers = {name: RenderSettings.preset(name) for name in SEEN}
    psnr = psnr_by_renderer(trainer.gaussians(), frames_for(test, config.data), renderers)
    size = [frames[0].camera.width, frames[0].camera.height]
    return {**named, "size": size, "psnr": psnr, "seconds": sum(took.values()), "seconds_by": took, **ran()}


def times(scene: str, run: Path, made: Path, max_pixels: int) -> dict:
    """Medians over two photographs of the seconds of a step's rendering, loss and derivatives."""
    gaussians = load_ply(run / "point_cloud.ply")
    views = list(load(folder_of(scene, made)).views)[:16:8]
    frames = frames_for(views, FitConfig().replace(max_pixels=max_pixels).data)
    settings = {name: RenderSettings.preset(name) for name in SEEN}
    settings |= {f"exact, {x:g}": RenderSettings.preset("exact", tolerance=x) for x in (0.01, 0.1)}
    took: dict[str, dict[int, list[float]]] = {name: {times: [] for times in range(3)} for name in settings}
    for is_warm, frame in [(False, frames[0]), *((True, frame) for frame in frames)]:
        for name, how in settings.items():
            for halvings in range(3):
                width, height = frame.camera.width >> halvings, frame.camera.height >> halvings
                camera = frame.camera.resized(width, height)
                target = torch.from_numpy(resize_area(frame.image().numpy(), width, height))
                began = time.process_time()
                leaves = {key: x.clone().requires_grad_() for key, x in gaussians.parameters().items()}
                rgb = render(gaussians.replace(**leaves), camera, how, outputs=()).rgb
                (0.8 * (rgb - target).abs().mean() - 0.2 * padded_ssim(rgb, target)).backward()
                if is_warm:
                    took[name][halvings].append(time.process_time() - began)
    seconds = {name: [statistics.median(each) for each in sizes.values()] for name, sizes in took.items()}
    size = [frames[0].camera.width, frames[0].camera.height]
    return {"scene": scene, "size": size, "gaussians": len(gaussians), "seconds": seconds, **ran()}


def gain(pairs: list[tuple[dict, dict]], seen: str) -> str:
    """What fits have over others in a renderer, dB: of the mean, and of the worst held-out view, with an interval."""
    units = [(row["scene"], (8, row["offset"]), (str(row["seed"]),)) for row, _ in pairs]
    effects = [
        estimate(
            {
                unit: of(row["psnr"][seen]) - of(other["psnr"][seen])
                for unit, (row, other) in zip(units, pairs, strict=True)
            }
        )
        for of in (statistics.mean, min)
    ]
    interval = f" [{effects[0].low:+.2f}, {effects[0].high:+.2f}]" if effects[0].scenes > 2 else ""
    return f"{effects[0].mean:+.2f} / {effects[1].mean:+.2f}{interval}"


def updates_table(rows: list[dict]) -> list[list[str]]:
    """Lines: what several updates a step add in as many steps, by kind of fit and by capture, and the time."""
    whole = {tuple(row[name] for name in KEY): row for row in rows if row["change"] == "none"}
    kinds: dict[tuple, list[tuple[dict, dict]]] = {}
    for row in rows:
        other = whole.get(tuple((row | {"change": "none"})[name] for name in KEY))
        if "updates" in row["change"] and other is not None:
            kinds.setdefault(tuple(row[name] for name in ("change", "max_pixels", "max_steps")), []).append(
                (row, other)
            )
    lines = []
    for (change, pixels, steps), pairs in sorted(kinds.items()):
        scenes = list(dict.fromkeys(row["scene"] for row, _ in pairs))
        for some in [*([scene] for scene in scenes), *([scenes] if len(scenes) > 1 else [])]:
            own = [pair for pair in pairs if pair[0]["scene"] in some]
            name = some[0] if len(some) == 1 else f"**{', '.join(some)}**"
            ratio = statistics.mean(row["seconds"] / other["seconds"] for row, other in own)
            cells = [gain(own, seen) for seen in SEEN]
            lines.append([change, f"{pixels:,}", f"{steps:,}", name, *cells, f"{ratio:.2f}"])
    return lines


def write_page() -> None:
    """The tables of the page, and the data files."""
    rows = read_rows(ROWS)
    heads = ["a step has", "pixels", "steps", "capture", *(f"`{seen}`" for seen in SEEN), "time"]
    lines = updates_table(rows)
    write_csv(PAGE_DATA / "schedules-updates.csv", [heads, *lines])
    told = [line for line in lines if line[0] == "3 updates" and line[3].startswith("**")]
    shown = [[line[k] for k in (1, 2, 3, 5, 6, 8)] for line in (heads, *told)]  # of the renderers fast and gsplat
    fill_between(PAGE, "updates", markdown_table(shown[0], shown[1:]))
    timed, shares = [], []
    for row in read_rows(TIMES):
        took, size = row["seconds"], "x".join(map(str, row["size"]))
        timed += [[row["scene"], size, name, *(f"{1000 * x:.0f}" for x in each)] for name, each in took.items()]
        others = [0.3 * sum(took[name][k] for name in ("fast", "gsplat", "3dgut")) for k in range(3)]
        whole, cut = (others[0] + 0.1 * took[name][0] for name in ("exact", "exact, 0.01"))
        half = others[1] + 0.1 * took["exact, 0.01"][1]
        share = f"{0.1 * took['exact'][0] / whole:.2f}"
        ratios = (whole / took["fast"][0], cut / took["fast"][0], half / cut)
        shares.append([share, *(f"{x:.2f}" for x in ratios)])
    write_csv(
        PAGE_DATA / "schedule-times.csv",
        [["capture", "size", "renderer, tolerance", "ms", "ms at half the size", "ms at a quarter"], *timed],
    )
    of, plain, cut, small = (f"{min(column)} to {max(column)}" for column in zip(*shares, strict=True))
    told = (
        f"At 130,000 pixels, over {len(shares)} captures, a step takes {cut} times as long as one of `fast`, and "
        f"{plain} times without the tolerance, {of} of that in `exact`; a step of half the width and height "
        f"takes {small} of the time of one of full size."
    )
    fill_between(PAGE, "step_times", paragraph(told))
    everything = [
        ["change", "fitted for", "capture", "seed", "pixels", "Gaussians", "steps", "seconds", *SEEN, "machine"]
    ]
    for row in rows:
        cells = [f"{statistics.mean(row['psnr'][seen]):.2f} / {min(row['psnr'][seen]):.2f}" for seen in SEEN]
        size = (row["seed"], row["max_pixels"], row["max_gaussians"], row["max_steps"])
        cells = [row["change"], row["trained"], row["scene"], *map(str, size), f"{row['seconds']:.0f}", *cells]
        everything.append([*cells, row["machine"]])
    write_csv(PAGE_DATA / "schedules.csv", everything)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures")
    parser.add_argument("--changes", nargs="+", default=["exact to 0", "exact to 0.01"], help=", ".join(CHANGES))
    parser.add_argument("--units", type=int, default=1, help="seeds, each with other views held out")
    parser.add_argument("--trained", default="any", help="as `drgs fit --for` takes it")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--max-pixels", type=int, default=12_000)
    parser.add_argument("--max-gaussians", type=int, default=8_000)
    parser.add_argument("--made", type=Path, default=ROOT / "runs" / "made", help="folder of the made scenes")
    parser.add_argument("--times", type=Path, help="folder of run folders, one a scene; fit nothing")
    parser.add_argument("--page", action="store_true", help="fit nothing, write the tables of the rows that there are")
    args = parser.parse_args()
    if args.page:
        write_page()
        return
    for scene in args.scenes if args.times else []:
        row = times(scene, args.times / scene, args.made, args.max_pixels)
        add_row(TIMES, row)
        print(row, flush=True)
    for seed, offset in [] if args.times else UNITS[: args.units]:
        for scene in args.scenes:
            for change in args.changes:
                key = (scene, change, args.trained, seed, offset, args.steps, args.max_pixels, args.max_gaussians)
                if key in {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}:
                    continue
                row = fit(key, args.made)
                add_row(ROWS, row)
                mean = {name: sum(views) / len(views) for name, views in row["psnr"].items()}
                print(scene, seed, change, *(f"{name} {x:.2f}" for name, x in mean.items()), flush=True)
                print("   ", f"{row['seconds']:.1f} s", row["seconds_by"], flush=True)


if __name__ == "__main__":
    main()
