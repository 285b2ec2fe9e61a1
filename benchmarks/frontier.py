"""What one model can be in two renderers at once: fits with `fast` and `gsplat` in turn, in shares from all to nothing.

    python benchmarks/frontier.py [--scenes lego watch] [--steps 1600]
    python benchmarks/frontier.py --page

Appends one row a fit to benchmarks/frontier.jsonl as it ends, leaves out what is there, then writes
docs/data/frontier.csv. Size and views are those of benchmarks/one_model.py. One thread.
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
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "frontier.jsonl"
PAIR = ("fast", "gsplat")
EIGHTHS = (0, 1, 2, 4, 6, 7, 8)  # of the steps that are rendered with `gsplat`
SIZE = {"max_pixels": 12_000, "max_gaussians": 8_000}


def measured(scene: str, eighths: int, steps: int) -> dict:
    """One fit, and its held-out views in both renderers."""
    renderers = {name: RenderSettings.preset(name) for name in PAIR}
    # Spread evenly: of 8 steps in a row, those at which the multiples of the share pass a whole number.
    turns = [(k + 1) * eighths // 8 > k * eighths // 8 for k in range(8)]
    config = FitConfig().replace(settings=renderers["fast"], renderers=("fast",), max_steps=steps, **SIZE)
    fit = fitted(scene, config, cycle=[renderers[PAIR[turn]] for turn in turns])
    psnr = psnr_by_renderer(fit.gaussians, frames_for(fit.test, config.data), renderers)
    return {"scene": Path(scene).name, "eighths": eighths, "max_steps": steps, **SIZE, "psnr": psnr, **ran()}


def table(found: list[dict]) -> str:
    """Mean held-out PSNR by share, and how far each is behind the fit for that renderer alone."""
    lines = [
        "| capture | steps with `gsplat` | seen with `fast` | behind there | seen with `gsplat` | behind in `gsplat` |"
    ]
    lines += ["|---|---|---|---|---|---|"]
    means = {
        (row["scene"], row["eighths"]): {name: statistics.mean(row["psnr"][name]) for name in PAIR} for row in found
    }
    for (scene, eighths), psnr in sorted(means.items()):
        alone = {"fast": means.get((scene, 0)), "gsplat": means.get((scene, 8))}
        cells = [scene, f"{eighths} of 8"]
        for name in PAIR:
            best = alone[name]
            cells += [f"{psnr[name]:.2f}", f"{best[name] - psnr[name]:.2f}" if best else "-"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["lego", "watch"], help="names of captures, or folders")
    parser.add_argument("--steps", type=int, default=1600)
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    done = {(row["scene"], row["eighths"], row["max_steps"]) for row in read_rows(ROWS)}
    for scene in [] if args.page else args.scenes:
        for eighths in EIGHTHS:
            if (Path(scene).name, eighths, args.steps) not in done:
                row = measured(scene, eighths, args.steps)
                add_row(ROWS, row)
                print(
                    scene, eighths, {name: round(statistics.mean(x), 2) for name, x in row["psnr"].items()}, flush=True
                )
    text = table(read_rows(ROWS))
    print(text)
    write_csv(PAGE_DATA / "frontier.csv", table_lines(text))


if __name__ == "__main__":
    main()
