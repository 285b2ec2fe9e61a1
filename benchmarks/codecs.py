"""What each format of Gaussians that is written loses, on images, and how large its files are.

    python benchmarks/codecs.py runs/scene [runs/other ...] [--views 3] [--pixels 250000]
    python benchmarks/codecs.py --page

Appends one row a run and format to benchmarks/codecs.jsonl, leaves out what is there, then writes the table of
docs/files.md and docs/data/codecs.csv. The PSNR is that of images of what was written and read again against images of
the run's own Gaussians, both by preset `gsplat`, at photographs of the run, evenly over them; seconds are those that
the process computed while it wrote. SOG's palette and weights were chosen on `bonsai`, which is therefore no row.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

from drgs.cameras.sizes import at_most  # noqa: E402
from drgs.codecs import load_gaussians, save_gaussians  # noqa: E402
from drgs.commands.options import Share  # noqa: E402
from drgs.commands.share import shared_of  # noqa: E402
from drgs.integrator import render  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.tables import markdown_table  # noqa: E402

ROWS = ROOT / "benchmarks" / "codecs.jsonl"
PAGE = ROOT / "docs" / "files.md"
FORMATS = (".ply", ".compressed.ply", ".spz", ".splat", ".sog")


def measure(run: Path, views: int, pixels: int) -> None:
    """All formats of one run that have no row yet."""
    known = {(row["run"], row["format"]) for row in read_rows(ROWS)}
    missing = [suffix for suffix in FORMATS if (run.name, suffix) not in known]
    if not missing:
        return
    shared = shared_of(Share(scene=run, uncertainty=False))
    own = shared.gaussians
    fitted = [camera for kind, camera in shared.cameras if kind == "fitted"]
    places = np.unique(np.linspace(0, len(fitted) - 1, views).round().astype(int))
    cameras = [at_most(fitted[k], pixels) for k in places]
    settings = RenderSettings.preset("gsplat", background=shared.background)

    def drawn(gaussians) -> list[torch.Tensor]:
        with torch.no_grad():  # pictures
            return [render(gaussians, camera, settings).rgb.clamp(0, 1) for camera in cameras]

    wanted = drawn(own)
    with tempfile.TemporaryDirectory() as folder:
        for suffix in missing:
            path = Path(folder) / f"scene{suffix}"
            began = time.process_time()
            save_gaussians(own, path)
            seconds = time.process_time() - began
            lost = [float((a - b).square().mean()) for a, b in zip(drawn(load_gaussians(path)), wanted, strict=True)]
            row = {
                "run": run.name,
                "gaussians": len(own),
                "sh_degree": own.sh_degree,
                "format": suffix,
                "bytes": path.stat().st_size,
                "seconds": seconds,
                "views": [camera.name for camera in cameras],
                "psnr": [None if x == 0 else -10 * float(np.log10(x)) for x in lost],
            }
            add_row(ROWS, row | ran())
            print(row, flush=True)


def table(rows: list[dict]) -> str:
    """A row a format: from the least to the most over fits and pictures."""
    lines = []
    for suffix in dict.fromkeys(row["format"] for row in rows):
        own = [row for row in rows if row["format"] == suffix]
        each = [row["bytes"] / row["gaussians"] for row in own]
        psnr = [x for row in own for x in row["psnr"] if x is not None]
        seconds = [row["seconds"] for row in own]
        lines.append(
            [
                f"`{suffix}`",
                f"{min(each):.1f}" if max(each) - min(each) < 0.1 else f"{min(each):.1f} to {max(each):.1f}",
                f"{min(psnr):.1f} to {max(psnr):.1f}" if psnr else "the same",
                f"{min(seconds):.2f} to {max(seconds):.2f}",
            ]
        )
    return markdown_table(["format", "bytes a Gaussian", "PSNR (dB)", "seconds to write"], lines)


def sheet(rows: list[dict]) -> list[list[str]]:
    """The data file: a line for each fit and format; no PSNR where images are the same."""
    views = max(len(row["psnr"]) for row in rows)
    lines = [["fit", "gaussians", "format", "bytes_a_gaussian", *(f"psnr_{k + 1}" for k in range(views)), "seconds"]]
    for row in rows:
        psnr = ["" if x is None else f"{x:.1f}" for x in row["psnr"]]
        each = f"{row['bytes'] / row['gaussians']:.1f}"
        lines.append([row["run"], str(row["gaussians"]), row["format"], each, *psnr, f"{row['seconds']:.2f}"])
    return lines


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--views", type=int, default=3, help="views of each, evenly over its photographs")
    parser.add_argument("--pixels", type=int, default=250_000, help="of a picture, at most")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the table of what is there")
    args = parser.parse_args()
    for run in [] if args.page else args.runs:
        measure(run, args.views, args.pixels)
    rows = read_rows(ROWS)
    text = table(rows)
    print(text)
    fill_between(PAGE, "codecs", text)
    write_csv(PAGE_DATA / "codecs.csv", sheet(rows))


if __name__ == "__main__":
    main()
