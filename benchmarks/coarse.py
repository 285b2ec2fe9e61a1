"""Photographs that begin small: held-out PSNR against the time of a processor, by how often they are halved.

    python benchmarks/coarse.py [--scenes fern statue] [--steps 150] [--trained fast] [--same] [--page]

Appends one row a fit to benchmarks/coarse.jsonl as it ends, leaves out what is there, then writes docs/data/coarse.csv.
Fits of a scene have the same number of steps, with 0, 1 and 2 downscales or those that are named; then those with more
than 0 are made once more, with as many steps as take the time of the fit without, but not with `--same`. Photographs
have their full size, of at most 200,000 pixels unless `--max-pixels` says less. Seconds are those that the process
computed in its steps, whatever ran beside it. One thread.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from fits import fitted, psnr_by_renderer  # noqa: E402
from studies import PAGE_DATA, table_lines, write_csv  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import frames_for  # noqa: E402
from drgs.fitting.renderers import own_preset  # noqa: E402
from drgs.fitting.resolution import FULL  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "coarse.jsonl"
SCENES = ("fern", "statue")
SIZE = {"max_pixels": 200_000, "max_gaussians": 20_000}
DOWNSCALES = (0, 1, 2)
SEED = 0
KEY = ("scene", "trained", "num_downscales", "full", "steps", "max_pixels", "max_gaussians", "seed")


def key_of(scene: str, trained: str, num_downscales: int, steps: int, size: dict[str, int]) -> tuple:
    """What tells a row from others."""
    return scene, trained, num_downscales, FULL, steps, *size.values(), SEED


def measured(scene: str, trained: str, num_downscales: int, steps: int, size: dict[str, int]) -> dict:
    """One fit, and its held-out views at the full size, in the renderer that stands for those it was fitted with."""
    own = own_preset((trained,))
    config = FitConfig().replace(
        settings=RenderSettings.preset(own),
        renderers=(trained,),
        num_downscales=num_downscales,
        skybox="off",
        max_steps=steps,
        seed=SEED,
        **size,
    )
    fit = fitted(scene, config)
    held_out = frames_for(fit.test, config.data)
    psnr = psnr_by_renderer(fit.gaussians, held_out, {own: RenderSettings.preset(own)})
    first = fit.frames[0].camera
    return {
        **dict(zip(KEY, key_of(scene, trained, num_downscales, steps, size), strict=True)),
        "size": [first.width, first.height],
        "psnr": psnr[own],
        "process_seconds": fit.process_seconds,
        **ran(),
    }


def base_of(row: dict, rows: list[dict]) -> dict | None:
    """The fit at the full size that another one is compared with: of as many steps or, where that has more in the time
    saved, of the most that are fewer; None where there is none.
    """
    unit = ("scene", "trained", "max_pixels", "max_gaussians", "seed")
    same = [x for x in rows if not x["num_downscales"] and all(x[name] == row[name] for name in unit)]
    return max((x for x in same if x["steps"] <= row["steps"]), key=lambda x: x["steps"], default=None)


def table(rows: list[dict]) -> str:
    """A row a fit: steps, seconds, and PSNR, mean and worst view, beside that of the fit at the full size."""
    lines = [
        "| capture (held out) | size | fitted for | `--num-downscales` | steps | seconds | PSNR, mean / worst |",
        "|---|---|---|---|---|---|---|",
    ]
    order = sorted(rows, key=lambda row: (row["scene"], row["trained"], row["steps"], row["num_downscales"]))
    for base in (row for row in order if not row["num_downscales"]):
        mean = sum(base["psnr"]) / len(base["psnr"])
        for row in (row for row in order if base_of(row, order) is base):
            now = sum(row["psnr"]) / len(row["psnr"])
            width, height = row["size"]
            shown = f"{now:.2f} / {min(row['psnr']):.2f}"
            if row is not base:
                shown = f"{now - mean:+.2f} / {min(row['psnr']) - min(base['psnr']):+.2f}"
            part = row["process_seconds"] / base["process_seconds"]
            seconds = f"{row['process_seconds']:.0f}" + ("" if row is base else f" ({part:.2f})")
            cells = (f"{row['scene']} ({len(row['psnr'])})", f"{width}x{height}", row["trained"], row["num_downscales"])
            lines.append("| " + " | ".join(map(str, (*cells, row["steps"], seconds, shown))) + " |")
    return "\n".join(lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures")
    parser.add_argument("--trained", default="fast", help="as `drgs fit --for` takes it")
    parser.add_argument("--steps", type=int, default=150)
    for name, value in SIZE.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=value)
    parser.add_argument("--num-downscales", nargs="+", type=int, default=list(DOWNSCALES), help="beside 0")
    parser.add_argument("--same", action="store_true", help="only fits of as many steps")
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    size = {name: getattr(args, name) for name in SIZE}
    took = {tuple(row[name] for name in KEY): row["process_seconds"] for row in read_rows(ROWS)}

    def seconds_of(scene: str, num_downscales: int, steps: int) -> float:
        """Process seconds of a fit that there is, or is made."""
        key = key_of(scene, args.trained, num_downscales, steps, size)
        if key not in took:
            row = measured(scene, args.trained, num_downscales, steps, size)
            add_row(ROWS, row)
            took[key] = row["process_seconds"]
            print(
                scene,
                num_downscales,
                steps,
                f"{took[key]:.0f} s, {sum(row['psnr']) / len(row['psnr']):.2f} dB",
                flush=True,
            )
        return took[key]

    scenes = [] if args.page else args.scenes
    downscales = sorted({0, *args.num_downscales})
    same = {scene: {n: seconds_of(scene, n, args.steps) for n in downscales} for scene in scenes}
    for n in [] if args.same else downscales[1:]:
        for scene in scenes:
            seconds_of(scene, n, round(args.steps * same[scene][0] / same[scene][n]))
    text = table(read_rows(ROWS))
    print(text)
    write_csv(PAGE_DATA / "coarse.csv", table_lines(text))


if __name__ == "__main__":
    main()
