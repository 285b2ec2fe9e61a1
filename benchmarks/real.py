"""Fits of captures at the sizes that others print, beside their figures.

    python benchmarks/real.py NAME ... [--runs runs/real]
    python benchmarks/real.py --page

Fits with the defaults of `drgs fit` but for what FITS says, appends one row a fit to benchmarks/real.jsonl as it ends,
then writes the table of docs/real-data.md, docs/data/real.csv and small pictures. A fit that was stopped goes on from
its last checkpoint. Where captures are, and with how many threads: DRGS_DATA and DRGS_THREADS.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cv2  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, table_lines, write_csv  # noqa: E402
from where import DATA, add_row, ran, read_rows  # noqa: E402

from drgs.data import load  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.studies.tables import markdown_table  # noqa: E402
from drgs.train import fit  # noqa: E402

ROWS = ROOT / "benchmarks" / "real.jsonl"
PAGE = ROOT / "docs" / "real-data.md"
PICTURES = ROOT / "docs" / "pictures"
BONSAI = {"max_pixels": 426_400, "max_gaussians": 60_000, "max_steps": 1_600, "num_downscales": 2}
LEGO = {"max_pixels": 160_000, "max_steps": 1_600, "num_downscales": 1}
RATES_OF_3DGS = {"scale_rate": 5e-3, "means_rate": (1.6e-4, 1.6e-6), "rest_rate": 1.25e-4}  # those of before
# Name -> (capture, what is not a default)
FITS: dict[str, tuple[str, dict]] = {
    "banana": ("banana", {}),
    "banana-sfm": ("banana", {}),
    "office": ("office", {}),
    "head": ("head", {}),
    "bonsai": ("bonsai", BONSAI),
    "bonsai, rates of 3DGS": ("bonsai", {**BONSAI, **RATES_OF_3DGS}),
    "bonsai, 9,000 steps": ("bonsai", {**BONSAI, "max_gaussians": 120_000, "max_steps": 9_000}),
    "bonsai, 27,000 steps": (
        "bonsai",
        {**BONSAI, "max_gaussians": 200_000, "max_steps": 27_000, "num_downscales": 2, "renderers": ("fast",)},
    ),
    "lego": ("lego", LEGO),
    "lego, for fast": ("lego", {**LEGO, "renderers": ("fast",)}),
    "lego, rates of 3DGS": ("lego", {**LEGO, **RATES_OF_3DGS}),
}


def measured(name: str, runs: Path) -> dict:
    """A fit, or what is left of it, and its figures."""
    capture, options = FITS[name]
    source = DATA / capture
    if name.endswith("-sfm"):  # its photographs alone
        source = runs.parent / name
        if not source.exists():
            command = ["sfm", str(DATA / capture / "images"), "-o", str(source)]
            subprocess.run([sys.executable, "-m", "drgs", *command], check=True, cwd=ROOT)
    folder = runs / name
    metrics, processor_seconds = _fitted(source, folder, FitConfig().replace(**options))
    events = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    config = json.loads((folder / "config.json").read_text())
    if name == capture:
        PICTURES.mkdir(exist_ok=True)
        _picture(sorted((folder / "renders" / "test").glob("*.png"))[0], PICTURES / f"{name}.jpg")
    return {
        "name": name,
        "renderers": ",".join(config["fit"]["renderers"]),
        "views": [len(config["train"]), metrics["count"]],
        "size": config["size"][0],
        "points": config["points"],
        "steps": config["fit"]["max_steps"],
        "gaussians": metrics["gaussians"],
        "seconds": metrics["seconds"],
        "processor_seconds": processor_seconds,
        **{key: metrics["mean"][key] for key in ("psnr", "ssim", "flip")},
        "previews": [[event["step"], event["test_psnr"]] for event in events if event["event"] == "preview"],
        **ran(),
    }


def _fitted(source: Path, folder: Path, config: FitConfig) -> tuple[dict, float]:
    """Metrics of a fit, and what processors took for it, whenever it was stopped and went on."""
    clock = folder.parent / f"{folder.name}.seconds"
    before = float(clock.read_text()) if clock.exists() else 0.0
    began = time.process_time()
    try:
        metrics = fit(load(source), folder, config, resume=folder.exists()).metrics
    finally:
        total = before + time.process_time() - began
        clock.write_text(f"{total:.1f}")
    return metrics, total


def _picture(source: Path, target: Path, width: int = 640) -> None:
    """A small JPEG of a PNG."""
    image = cv2.imread(str(source))
    size = width, round(image.shape[0] * width / image.shape[1])
    cv2.imwrite(str(target), cv2.resize(image, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, 85])


def table(rows: list[dict]) -> str:
    """One line a fit."""
    lines = [
        "| fit | for | views | pixels | initial points | steps | minutes (processor) | Gaussians | PSNR | SSIM | FLIP |"
    ]
    lines += ["|---|---|---|---|---|---|---|---|---|---|---|"]
    for row in rows:
        cells = [row["name"], row["renderers"], " + ".join(map(str, row["views"])), "x".join(map(str, row["size"]))]
        minutes = f"{row['seconds'] / 60:.1f}"
        if row.get("processor_seconds"):
            minutes += f" ({row['processor_seconds'] / 60:.1f})"
        cells += [row["points"], f"{row['steps']:,}", minutes, f"{row['gaussians']:,}"]
        cells += [f"{row['psnr']:.2f}", f"{row['ssim']:.3f}", f"{row['flip']:.3f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def short_table(rows: list[dict]) -> str:
    """What the page has of `table`: fits of stated poses, with the rates that are the default."""
    heads = ["fit", "for", "pixels", "steps", "Gaussians", "minutes", "PSNR"]
    lines = []
    for row in rows:
        if row["name"].endswith(("-sfm", "rates of 3DGS")):
            continue
        took = row.get("processor_seconds")
        minutes = f"{took / 60:.1f}" if took else f"{row['seconds'] / 60:.1f} (clock)"
        cells = [row["name"], row["renderers"], "x".join(map(str, row["size"]))]
        lines.append([*cells, f"{row['steps']:,}", f"{row['gaussians']:,}", minutes, f"{row['psnr']:.2f}"])
    return markdown_table(heads, lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *FITS], help="fits to make")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "real")
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    for name in [] if args.page else args.names:
        add_row(ROWS, measured(name, args.runs))
    rows = read_rows(ROWS)
    print(text := short_table(rows))
    fill_between(PAGE, "real", text)
    write_csv(PAGE_DATA / "real.csv", table_lines(table(rows)))


if __name__ == "__main__":
    main()
