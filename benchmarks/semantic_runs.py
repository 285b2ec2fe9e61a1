"""How runs with features show views that they were not fitted to: the table of docs/semantic.md, "Real runs".

    python benchmarks/semantic_runs.py RUN [RUN ...] [--print]

Reads what `drgs fit` and `drgs eval` have written into the run folders; nothing is computed here.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from drgs.files import Run, load_state  # noqa: E402
from drgs.lab.study_report import fill_between  # noqa: E402

IMAGE = {"psnr": "PSNR, dB", "ssim": "SSIM", "flip": "FLIP"}
LABELS = {
    "pixel_accuracy": "pixel accuracy",
    "class_accuracy": "class accuracy",
    "miou": "mIoU",
    "miou_top7": "mIoU, top 7",
}


def rows(folder: Path) -> list[str]:
    """The lines of a run: its own figures and, where the test views have maps, those of the teacher."""
    metrics = json.loads((folder / "metrics.json").read_text())
    if metrics["split"] != "test" or "segmentation" not in metrics:
        sys.exit(f"{folder}: must be measured on its test views, with labels; run `drgs eval {folder}`")
    header = load_state(Run(folder).state)[1]
    env = json.loads((folder / "env.json").read_text())
    steps = f"{header['step']:,} of {header['config']['max_steps']:,}"
    said = [folder.name, steps, f"{metrics['gaussians']:,}", str(metrics["count"]), (env["commit"] or "none")[:7]]
    digits = {"psnr": 2}
    said += [f"{metrics['mean'][key]:.{digits.get(key, 3)}f}" for key in IMAGE]
    found = metrics["segmentation"]
    said += [f"{found['run'][key]:.3f}" for key in LABELS]
    lines = ["| " + " | ".join(said) + " |"]
    if found.get("teacher"):
        empty = [""] * (4 + len(IMAGE))
        told = [f"{found['teacher'][key]:.3f}" for key in LABELS]
        lines.append("| " + " | ".join(["its teacher, same views", *empty, *told]) + " |")
    return lines


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--print", action="store_true", help="do not touch docs/semantic.md")
    args = parser.parse_args()
    names = ["run", "steps", "Gaussians", "test views", "commit", *IMAGE.values(), *LABELS.values()]
    lines = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    for folder in args.runs:
        lines += rows(folder)
    text = "\n".join(
        ["Made by `python benchmarks/semantic_runs.py RUN ...` from metrics.json of each run.", "", *lines]
    )
    print(text)
    if not args.print:
        fill_between(ROOT / "docs" / "semantic.md", "runs", text)


if __name__ == "__main__":
    main()
