"""What one number between `fast` and `exact` buys: error and time of `RenderSettings.tolerance` on scenes of exact.py.

    python benchmarks/tolerance.py [--fits FOLDER] [--turns 5]   docs/data/tolerance.csv, a table of docs/tradeoff.md
    python benchmarks/tolerance.py --page                        from the rows that there are

Settings take turns in one process, one thread; seconds are the processor's, ratios are medians over turns. Errors are
differences from `exact`: of a color the largest and the root of the mean square, and of the gradient of the image's
dot product with random signs the relative L2 error of the worst parameter group. Rows are in tolerance.jsonl.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import exact  # noqa: E402
import torch  # noqa: E402
from clocks import in_turns  # noqa: E402
from pages import fill_between  # noqa: E402
from render import Preset, backward, forward  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

import drgs  # noqa: E402
from drgs.cameras import Camera  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.tables import markdown_table, paragraph  # noqa: E402

ROWS = ROOT / "benchmarks" / "tolerance.jsonl"
PAGE = ROOT / "docs" / "tradeoff.md"
GROUPS = ("means", "quats", "log_scales", "logit_opacities", "sh")
SETTINGS = {
    "fast": Preset("fast"),
    # The least that an order along rays takes: what `fast` composites, sorted.
    "fast, order=ray": Preset("fast", order="ray"),
    **{f"{x:g}": Preset("exact", tolerance=x) for x in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)},
    "exact": Preset("exact"),
}
SHOWN = ("fast", "fast, order=ray", "0.1", "0.01", "0.001", "exact")  # on the page


def gradients(g: drgs.Gaussians, camera: Camera, settings: RenderSettings) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """The image, and the gradient of its dot product with signs that are random and always the same."""
    leaves = {name: getattr(g, name).detach().clone().requires_grad_() for name in GROUPS}
    image = drgs.render(g.replace(**leaves), camera, settings, outputs=()).rgb
    signs = torch.randint(0, 2, image.shape, generator=torch.Generator().manual_seed(0)) * 2.0 - 1
    return image.detach(), list(torch.autograd.grad((image * signs).sum(), list(leaves.values())))


def measured(name: str, folder: Path, turns: int) -> list[dict]:
    """Rows of a scene; none where it is not there."""
    found = exact.scene(name, folder)
    if found is None:
        return []
    g, camera = found
    runs = {key: forward(g, camera, s) for key, s in SETTINGS.items()}
    runs |= {f"{key}, backward": backward(g, camera, s) for key, s in SETTINGS.items()}
    seconds = in_turns(runs, turns, time.process_time)
    truth, slopes = gradients(g, camera, SETTINGS["exact"])
    rows = []
    for key, settings in SETTINGS.items():
        image, found_slopes = gradients(g, camera, settings)
        off = (image - truth).abs()
        worst = max(float((x - y).norm() / y.norm()) for x, y in zip(found_slopes, slopes, strict=True))
        hits = drgs.render(g, camera, settings, outputs="count").count.float().mean()
        row = {"scene": name, "setting": key, "largest": float(off.max()), "rms": float(off.square().mean().sqrt())}
        row |= {"gradient": worst, "hits": float(hits)}
        for clock, end in (("forward", ""), ("backward", ", backward")):
            of_fast = zip(seconds[key + end], seconds["fast" + end], strict=True)
            row[clock] = statistics.median(a / b for a, b in of_fast)
            row[f"{clock} ms"] = 1e3 * statistics.median(seconds[key + end])
        rows.append(row | ran())
    return rows


def lines_of(rows: list[dict]) -> list[list[str]]:
    """The data file: of each scene and setting errors, and times in multiples of `fast`."""
    heads = [
        "scene",
        "setting",
        "hits",
        "largest",
        "rms",
        "gradient",
        "forward",
        "backward",
        "forward ms",
        "backward ms",
    ]
    cells = [[str(row[name]) if name in heads[:2] else f"{row[name]:.3g}" for name in heads] for row in rows]
    return [heads, *cells]


def table(rows: list[dict]) -> str:
    """Of each setting, over the scenes, the largest errors and the range of times in multiples of `fast`."""
    lines = []
    for key in SHOWN:
        found = {row["scene"]: row for row in rows if row["setting"] == key}
        worst = (max(row[kind] for row in found.values()) for kind in ("largest", "gradient"))
        least, most = (f"{pick(row['backward'] for row in found.values()):.1f}" for pick in (min, max))
        time = least if least == most else f"{least} to {most}"
        lines.append([key, *("-" if key == "exact" else f"{x:.0e}" for x in worst), time])
    return markdown_table(["tolerance, or setting", "largest error", "gradient", "time"], lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=Path, default=ROOT / "runs" / "exact")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument(
        "--page", action="store_true", help="measure nothing, write the table of the rows that there are"
    )
    args = parser.parse_args()
    done = {row["scene"] for row in read_rows(ROWS)}
    for name in () if args.page else exact.SCENES:
        for row in [] if name in done else measured(name, args.fits, args.turns):
            add_row(ROWS, row)
            print(row, flush=True)
    rows = read_rows(ROWS)
    write_csv(PAGE_DATA / "tolerance.csv", lines_of(rows))
    made = rows[0]
    where = paragraph(
        f"`python benchmarks/tolerance.py`, {made['machine']} of a busy machine, {made['date']}, commit "
        f"{made['commit']}: `office`, `banana`, still life, wolf, a cube. Largest errors against `exact` of a color, "
        "and of the worst group of gradients in norm; time with gradients in multiples of `fast`."
    )
    fill_between(PAGE, "tolerance", f"{where}\n\n{table(rows)}")


if __name__ == "__main__":
    main()
