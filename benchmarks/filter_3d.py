"""Pictures larger than those of a fit: with the 3D filter and without, by renderer and size.

    python benchmarks/filter_3d.py [--scenes head ...] [--trained any gsplat] [--seeds 1] [--page]

Appends one row a fit to benchmarks/filter_3d.jsonl as it ends, leaves out what is there, then writes
docs/data/filter-3d.csv. The same held-out photographs are rendered at one, two and four times the width and height at
which the others were fitted. Scenes are captures by name. One thread.
"""

from __future__ import annotations

import argparse
import os
import statistics
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
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "filter_3d.jsonl"
SCENES = ("banana", "fern", "statue", "head", "lego")
PIXELS = {"lego": 10_000}  # whose photographs have 400x400; of others 12,000
SIZE = {"max_steps": 400, "max_gaussians": 8_000}
SCALES = (1, 2, 4)
SEEN = ("exact", "fast", "gsplat", "3dgut")
MOST = 6  # held-out views, evenly spaced
KEY = ("scene", "trained", "filter", "seed", "max_pixels")


def measured(scene: str, trained: str, filter_3d: str, seed: int) -> dict:
    """One fit, and its held-out views in each renderer at each size."""
    pixels = PIXELS.get(scene, 12_000)
    config = FitConfig().replace(
        settings=RenderSettings.preset(own_preset((trained,))),
        renderers=(trained,),
        filter_3d=filter_3d,
        skybox="off",
        seed=seed,
        max_pixels=pixels,
        **SIZE,
    )
    fit = fitted(scene, config)
    renderers = {name: RenderSettings.preset(name) for name in SEEN}
    psnr = {
        scale: psnr_by_renderer(fit.gaussians, frames_for(fit.test, config.data, pixels * scale**2), renderers, MOST)
        for scale in SCALES
    }
    return {
        **dict(zip(KEY, (scene, trained, filter_3d, seed, pixels), strict=True)),
        "psnr": psnr,
        "seconds": fit.seconds,
        **ran(),
    }


def table(found: list[dict]) -> str:
    """Held-out PSNR without the filter and what the filter adds, on average, least and most."""
    lines = ["| fitted for | size | seen with | PSNR without | filter adds | least | most |", "|---" * 7 + "|"]
    for trained in dict.fromkeys(row["trained"] for row in found):
        mine = {row["scene"]: {} for row in found if row["trained"] == trained}
        for row in found:
            if row["trained"] == trained:
                mine[row["scene"]].setdefault(row["filter"], []).append(row["psnr"])
        pairs = [uses for uses in mine.values() if len(uses) == 2]
        for scale in SCALES if pairs else ():
            for name in SEEN:
                off, on = (
                    [statistics.mean(statistics.mean(psnr[str(scale)][name]) for psnr in uses[use]) for uses in pairs]
                    for use in ("off", "on")
                )
                added = [y - x for x, y in zip(off, on, strict=True)]
                cells = [f"{statistics.mean(off):.2f}"]
                cells += [f"{x:+.2f}" for x in (statistics.mean(added), min(added), max(added))]
                lines.append(f"| {trained} | {scale}x | {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures")
    parser.add_argument("--trained", nargs="+", default=["any", "gsplat"], help="as `drgs fit --for` takes them")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    for scene in [] if args.page else args.scenes:
        for trained in args.trained:
            for seed in range(args.seeds):
                for use in ("off", "on"):
                    if (scene, trained, use, seed, PIXELS.get(scene, 12_000)) not in done:
                        row = measured(scene, trained, use, seed)
                        add_row(ROWS, row)
                        print(scene, trained, use, seed, f"{row['seconds']:.0f} s", flush=True)
    text = table(read_rows(ROWS))
    print(text)
    write_csv(PAGE_DATA / "filter-3d.csv", table_lines(text))


if __name__ == "__main__":
    main()
