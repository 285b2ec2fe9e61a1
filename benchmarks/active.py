"""From 2 to 12 views by every policy: held-out quality, paired over scenes and seeds.

    python benchmarks/active.py [--scale small] [--seeds 3] [--scenes ...] [--policies ...] [--shard 0/2] [--page]

The paper's static loop (2 views, one more every 200 steps at `paper` scale). Rows of benchmarks/active.json and runs
that are there are kept and killed ones resumed, so that shards may work side by side; `--again` drops the rows. Results
go to docs/active-static.md and benchmarks/active.json, each row with the commit that it ran on.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import studies
from studies import ROOT, SCALES

from drgs.train import ActiveConfig, FitConfig, fit

BEGIN, END = "<!-- active: begin -->", "<!-- active: end -->"
POLICIES = {
    "fisher, logdet": {"policy": "fisher", "criterion": "logdet"},
    "fisher, eig": {"policy": "fisher", "criterion": "eig"},
    "fisher, logdet, relative 1e-3": {
        "policy": "fisher",
        "criterion": "logdet",
        "prior": 1e-3,
        "relative_prior": True,
    },
    "fisherrf": {"policy": "fisherrf"},
    "coverage": {"policy": "coverage"},
    "farthest": {"policy": "farthest"},
    "uniform": {"policy": "uniform"},
    "random": {"policy": "random"},
}
METRICS = {"psnr": "PSNR", "ssim": "SSIM", "flip": "FLIP"}
REFERENCE = "random"
RESULTS = ROOT / "benchmarks" / "active.json"


def key_of(row: dict) -> tuple:
    """What tells a run from the others."""
    return row["scene"], row["policy"], row["seed"]


def path_of(runs: Path, scale: str, name: str, label: str, seed: int) -> Path:
    """Folder of a run."""
    words = label.replace(",", "").replace(" ", "-")
    return runs / "active" / f"{scale}-{name}-{words}-{seed}"


def run(runs: Path, scale: str, name: str, label: str, seed: int) -> None:
    """One fit, unless it is finished."""
    folder = path_of(runs, scale, name, label, seed)
    if (folder / "metrics.json").exists():
        return
    print(folder.name, flush=True)
    size = dict(SCALES[scale])
    every = size.pop("every")
    data = studies.dataset(name, runs, lazy=True, points=False)
    active = ActiveConfig(initial=2, add=10, every=every, **POLICIES[label])
    fit(data, folder, FitConfig(seed=seed, **size), active=active, resume=folder.exists(), progress=False)


def row_of(folder: Path, name: str, label: str, seed: int) -> dict:
    """What a finished run found."""
    metrics = json.loads((folder / "metrics.json").read_text())
    picks = json.loads((folder / "selection.json").read_text())["picks"]
    return {
        "scene": name,
        "policy": label,
        "seed": seed,
        **{key: metrics["mean"][key] for key in METRICS},
        "seconds": metrics["seconds"],
        "pick seconds": float(np.mean([pick["seconds"] for pick in picks])),
        "picks": [pick["index"] for pick in picks],
        "commit": json.loads((folder / "env.json").read_text())["commit"][:7],
    }


def report(rows: list[dict], scale: str, made: str) -> str:
    """The part of docs/active-static.md."""
    size = SCALES[scale]
    commits = dict.fromkeys(r["commit"] for r in rows)
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    labels = [label for label in POLICIES if any(r["policy"] == label for r in rows)]
    seeds = 1 + max(r["seed"] for r in rows)
    ran = [sum(r["scene"] == s and r["policy"] == label for r in rows) for s in scenes for label in labels]
    number = f"{min(ran)} to {max(ran)} seeds" if min(ran) < max(ran) else f"{seeds} seeds"
    lines = [
        f"Made by {made} Rows ran on commits {', '.join(commits)} (benchmarks/active.json says which).",
        "",
        f"`--scale {scale}`: {size['max_gaussians']:,} Gaussians, at most {size['max_pixels']:,} pixels, "
        f"{size['max_steps']:,} steps, 2 views and one more every {size['every']} steps until 12; {number}.",
        "Every 8th view is held out. Nothing of a view is read before it is picked. Mean over the seeds, and every",
        "seed's PSNR:",
    ]
    for name in scenes:
        lines += [
            "",
            f"### {name}",
            "",
            "| policy | PSNR | each seed | SSIM | FLIP | seconds a pick |",
            "|---|---|---|---|---|---|",
        ]
        for label in labels:
            part = [r for r in rows if r["scene"] == name and r["policy"] == label]
            if part:
                mean = {k: np.mean([r[k] for r in part]) for k in (*METRICS, "pick seconds")}
                each = " ".join(f"{r['psnr']:.2f}" for r in part)
                lines.append(
                    f"| {label} | {mean['psnr']:.2f} | {each} | {mean['ssim']:.3f} | {mean['flip']:.3f} "
                    f"| {mean['pick seconds']:.2f} |"
                )
    lines += [
        "",
        "### Against picking at random",
        "",
        f"Differences to `{REFERENCE}` on the same scene and seed; mean over all scene and seed pairs with its 95 %",
        "bootstrap interval, and in how many pairs the policy was better.",
        "",
        "| policy | PSNR, dB | SSIM | FLIP (lower is better) | better PSNR |",
        "|---|---|---|---|---|",
    ]
    at = {key_of(r): r for r in rows}
    for label in labels:
        pairs = [
            (at[s, label, k], at[s, REFERENCE, k])
            for s in scenes
            for k in range(seeds)
            if (s, label, k) in at and (s, REFERENCE, k) in at
        ]
        if label == REFERENCE or not pairs:
            continue
        cells = []
        for key in METRICS:
            mean, low, high = studies.interval([a[key] - b[key] for a, b in pairs])
            digits = 2 if key == "psnr" else 3
            cells.append(f"{mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]")
        wins = sum(a["psnr"] > b["psnr"] for a, b in pairs)
        lines.append(f"| {label} | " + " | ".join(cells) + f" | {wins} of {len(pairs)} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scale", choices=list(SCALES), default="small")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--scenes", nargs="+", default=list(studies.SCENES))
    parser.add_argument("--policies", nargs="+", default=list(POLICIES), choices=list(POLICIES))
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "studies")
    parser.add_argument("--again", action="store_true", help="run everything anew")
    parser.add_argument("--shard", default="0/1", help="K/N: every N-th run from the K-th on, and no page if N > 1")
    parser.add_argument("--page", action="store_true", help="the page of the runs that there are")
    args = parser.parse_args()
    shard, shards = map(int, args.shard.split("/"))
    kept = studies.read_rows(RESULTS, {}) if not args.again else {}
    known = {key_of(r): r for r in kept.get("rows", []) if kept["scale"] == args.scale}
    # Seeds outermost: what there is at any time is a complete study of fewer seeds.
    jobs = [(s, label, k) for k in range(args.seeds) for s in args.scenes for label in args.policies]
    for name, label, seed in [] if args.page else jobs[shard::shards]:
        if (name, label, seed) not in known:
            run(args.runs, args.scale, name, label, seed)
    if shards > 1 and not args.page:
        return
    for job in jobs:
        folder = path_of(args.runs, args.scale, *job)
        if job not in known and (folder / "metrics.json").exists():
            known[job] = row_of(folder, *job)
    order = [(s, label) for s in studies.SCENES for label in POLICIES]
    rows = sorted(known.values(), key=lambda r: (order.index((r["scene"], r["policy"])), r["seed"]))
    made = studies.stamp("active")
    text = report(rows, args.scale, made)
    print(text)
    studies.write_rows(RESULTS, {"made": made, "scale": args.scale, "rows": rows})
    page = ROOT / "docs" / "active-static.md"
    before, _, rest = page.read_text().partition(BEGIN)
    page.write_text(before + BEGIN + "\n\n" + text + "\n\n" + END + rest.partition(END)[2])


if __name__ == "__main__":
    main()
