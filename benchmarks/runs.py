"""How runs show views that they were not fitted to: the table of real runs in docs/semantic.md.

    python benchmarks/runs.py RUN [RUN ...] [--print]

Reads what `drgs fit` and `drgs eval` have written into the run folders; nothing is computed here. The page has the
columns `SHOWN`, docs/data/semantic-runs.csv all that one of the runs has something in.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402

from drgs.files import Run, load_state  # noqa: E402
from drgs.studies.tables import markdown_table  # noqa: E402

IMAGE = {"psnr": "PSNR, dB", "psnr_moving": "of moving pixels, dB", "ssim": "SSIM", "flip": "FLIP"}
LABELS = {
    "pixel_accuracy": "pixel accuracy",
    "class_accuracy": "class accuracy",
    "miou": "mIoU",
    "miou_top7": "mIoU, top 7",
}
TEACHER = "its teacher"
SHOWN = ("run", "steps", "Gaussians", "test views", "PSNR, dB", "pixel accuracy", "mIoU")


def rows(folder: Path) -> list[dict[str, str]]:
    """The lines of a run: its own figures and, where the test views have maps, those of the teacher."""
    metrics = json.loads((folder / "metrics.json").read_text())
    if metrics["split"] != "test":
        sys.exit(f"{folder}: must be measured on its test views; run `drgs eval {folder}`")
    header = load_state(Run(folder).state)[1]
    env = json.loads((folder / "env.json").read_text())
    row = {
        "run": folder.name,
        "steps": f"{header['step']:,} of {header['config']['max_steps']:,}",
        "Gaussians": f"{metrics['gaussians']:,}",
        "test views": str(metrics["count"]),
        "commit": (env["commit"] or "none")[:7],
    }
    if metrics.get("motion"):
        row["Gaussians that move"] = f"{metrics['motion']['moving']:,} ({100 * metrics['motion']['share']:.1f} %)"
    for key, title in IMAGE.items():
        if metrics["mean"].get(key) is not None:
            row[title] = f"{metrics['mean'][key]:.{2 if key.startswith('psnr') else 3}f}"
    found = metrics.get("segmentation") or {}
    lines = [row | {title: f"{found['run'][key]:.3f}" for key, title in LABELS.items() if found}]
    if found.get("teacher"):
        told = {title: f"{found['teacher'][key]:.3f}" for key, title in LABELS.items()}
        lines.append({"run": TEACHER} | told)
    return lines


def joined(found: list[dict[str, str]]) -> list[dict[str, str]]:
    """Runs in their order; a teacher once, behind the last of the runs in a row that have it, whose names it gets."""
    lines: list[dict[str, str]] = []
    for i, row in enumerate(found):
        if row["run"] != TEACHER:
            lines.append(row)
            continue
        pupils = [found[i - 1]["run"]]
        if len(lines) > 1 and lines[-2] == {**row, "run": lines[-2]["run"]}:
            before = lines.pop(-2)["run"].removeprefix("the teacher of ").removesuffix(", same views")
            pupils.insert(0, before)
        lines.append({**row, "run": f"the teacher of {', '.join(pupils)}, same views"})
    return lines


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--print", action="store_true", help="do not touch the page")
    args = parser.parse_args()
    found = joined([row for folder in args.runs for row in rows(folder)])
    order = ["run", "steps", "Gaussians", "Gaussians that move", "test views", "commit", *IMAGE.values()]
    names = [name for name in (*order, *LABELS.values()) if any(name in row for row in found)]
    text = markdown_table(list(SHOWN), [[row.get(name, "") for name in SHOWN] for row in found])
    print(text)
    if not args.print:
        fill_between(ROOT / "docs" / "semantic.md", "runs", text)
        write_csv(PAGE_DATA / "semantic-runs.csv", [names, *([row.get(name, "") for name in names] for row in found)])


if __name__ == "__main__":
    main()
