"""Fits of real captures, and the page about them.

    python benchmarks/real.py [--data ../shared/data] [--runs runs/real] [--only NAME]

Makes what is missing in the runs folder with the defaults of `drgs fit`, then writes docs/real-data.md and small
pictures beside it. `wolf` is rendered, not fitted; the `model-*` runs compare training with `exact` and with `inria`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs.data import load  # noqa: E402
from drgs.metrics import psnr  # noqa: E402
from drgs.train import FitConfig, fit  # noqa: E402

Preset = drgs.RenderSettings.preset
SMALL = {"max_pixels": 30_000, "max_gaussians": 8_000, "max_steps": 1_000}
FITS = {
    "banana": ("banana", {}),
    "office": ("office", {}),
    "head": ("head", {}),
    "banana-sfm": ("banana", {}),
    "model-exact": ("banana", {**SMALL, "settings": Preset("exact")}),
    "model-inria": ("banana", {**SMALL, "settings": Preset("inria")}),
    "model-fast": ("banana", {**SMALL, "settings": Preset("fast")}),
}
# OpenSplat's CPU build on the same data and machine type: (at most so many of our steps, its dB, what it did).
PEERS = {
    "banana": [(1000, 24.8, "1,000 iterations"), (2000, 27.8, "2,000 of a 3,000-iteration schedule")],
    "head": [(3000, 22.8, "3,000 iterations")],
}


def run(name: str, data: Path, runs: Path) -> dict:
    """metrics.json of a fit, made now if it is not there, with the previews of its log."""
    folder = runs / name
    scene, options = FITS[name]
    if not (folder / "metrics.json").exists():
        source = data / scene
        if name.endswith("-sfm"):  # its photographs alone
            source = runs.parent / name
            if not source.exists():
                command = ["sfm", str(data / scene / "images"), "-o", str(source)]
                subprocess.run([sys.executable, "-m", "drgs", *command], check=True, cwd=ROOT)
        alone = (options.get("settings", Preset("fast")).nearest_preset()[0],)  # what the table says of its fits
        fit(load(source), folder, FitConfig.of(renderers=alone, **options), resume=folder.exists())
    metrics = json.loads((folder / "metrics.json").read_text())
    events = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    config = json.loads((folder / "config.json").read_text())
    start = next(e for e in events if e["event"] == "start")
    return {
        **metrics,
        "previews": [(e["step"], e["test_psnr"]) for e in events if e["event"] == "preview"],
        "points": config["points"],
        "size": config["size"],
        "train": len(config["train"]),
        "start": start["gaussians"],
        "steps": config["fit"]["max_steps"],
    }


def cross(runs: Path, data: Path, models: list[str]) -> list[tuple[str, list[float]]]:
    """Held-out PSNR of the small runs, each seen through every model."""
    from drgs.fitting.frames import load_frames

    _, test = load(data / "banana").split(8)
    frames = load_frames(test, SMALL["max_pixels"], "auto")
    rows = []
    for trained in models:
        g = drgs.load_ply(runs / f"model-{trained}" / "point_cloud.ply")
        row = []
        for shown in ("exact", "inria", "fast"):
            values = []
            for frame in frames:
                with torch.no_grad():
                    image = drgs.render(g, frame.camera, Preset(shown), outputs=()).rgb.clamp(0, 1)
                values.append(psnr(image, frame.image(), frame.mask))
            row.append(float(np.mean(values)))
        rows.append((trained, row))
    return rows


def picture(path: Path, target: Path, width: int = 640):
    """A small JPEG of a PNG."""
    image = cv2.imread(str(path))
    size = width, round(image.shape[0] * width / image.shape[1])
    cv2.imwrite(str(target), cv2.resize(image, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, 85])


def report(results: dict, crossed: list, machine: str) -> str:
    """The markdown page."""
    rows = []
    for name, r in results.items():
        if name.startswith("model-"):
            continue
        mean = r["mean"]
        width, height = r["size"][0]
        rows.append(
            f"| {name} | {r['train']} + {r['count']} | {width}x{height} | {r['points']} | {r['steps']:,} "
            f"| {r['seconds'] / 60:.1f} | {r['gaussians']:,} | {mean['psnr']:.2f} | {mean['ssim']:.3f} "
            f"| {mean['flip']:.3f} |"
        )
    lines = [
        "# Fits of real captures",
        "",
        f"Made by `python benchmarks/real.py` on {machine}.",
        "Defaults of `drgs fit` (preset `fast`); every 8th view by name is held out and is what the table is about.",
        "`head` is judged inside its masks. `banana-sfm` has its poses from `drgs sfm` on the photographs alone.",
        "",
        "| scene | train + test views | pixels | initial points | steps | minutes | Gaussians | PSNR | SSIM | FLIP |",
        "|---|---|---|---|---|---|---|---|---|---|",
        *rows,
        "",
        "## Against OpenSplat's CPU build",
        "",
        "Its figures were measured on the same data, views held out and image sizes, on a machine of the same type.",
        "Ours are those of the last preview (every tenth of a fit) that took no more steps.",
        "",
        "| scene | OpenSplat | dB | ours after | dB |",
        "|---|---|---|---|---|",
    ]
    for name, peers in PEERS.items():
        for limit, theirs, what in peers if name in results else []:
            step, ours = [p for p in results[name]["previews"] if p[0] <= limit][-1]
            lines.append(f"| {name} | {what} | {theirs} | {step:,} of {results[name]['steps']:,} | {ours:.2f} |")
    if crossed:
        times = {k: results[f"model-{k}"]["seconds"] for k, _ in crossed}
        lines += [
            "",
            "## Does the model matter for training?",
            "",
            "`banana` at 30,000 pixels, 1,000 steps, 8,000 Gaussians, one seed; held-out PSNR in dB of each fit (row)",
            "seen through each model (column).",
            "",
            "| trained with | seen with `exact` | `inria` | `fast` | seconds |",
            "|---|---|---|---|---|",
            *(f"| `{k}` | " + " | ".join(f"{v:.2f}" for v in row) + f" | {times[k]:.0f} |" for k, row in crossed),
        ]
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("DRGS_DATA", ROOT.parent / "shared" / "data")))
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "real")
    parser.add_argument("--only", help="make one run and no page")
    parser.add_argument("--page", action="store_true", help="make no runs: the page of those that are there")
    args = parser.parse_args()
    if args.only:
        print(json.dumps(run(args.only, args.data, args.runs)["mean"]))
        return
    names = [n for n in FITS if not args.page or (args.runs / n / "metrics.json").exists()]
    results = {name: run(name, args.data, args.runs) for name in names}
    small = [n.removeprefix("model-") for n in names if n.startswith("model-")]
    crossed = cross(args.runs, args.data, small)
    at = ran()
    page = report(results, crossed, f"{at['machine']}, {at['date']}, commit {at['commit']}")
    pictures = ROOT / "docs" / "pictures"
    pictures.mkdir(exist_ok=True)
    lines = ["", "", "Held-out views, photograph left, rendering right, by `python benchmarks/real.py`:", ""]
    for name in (n for n in ("banana", "office", "head") if n in results):
        source = sorted((args.runs / name / "renders" / "test").glob("*.png"))[0]
        picture(source, pictures / f"{name}.jpg")
        lines.append(f"![{name}](pictures/{name}.jpg)")
    target = ROOT / "docs" / "real-data.md"
    notes = target.read_text().split("\n## Notes")[1] if target.exists() and "\n## Notes" in target.read_text() else ""
    target.write_text(page + "\n".join(lines) + "\n" + (f"\n## Notes{notes}" if notes else ""))
    print(page)


if __name__ == "__main__":
    main()
