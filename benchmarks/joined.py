"""Exposure and poses of photographs that join an active fit: on and off, by policies that look and that do not.

    python benchmarks/joined.py [--scenes banana FOLDER ...] [--seeds 2] [--page]

Each fit begins with three photographs and adds eight, one every 40 of 400 steps, for `fast` alone. Appends one row a
fit to benchmarks/joined.jsonl as it ends, leaves out what is there, then writes docs/data/joined.csv. Scenes are
captures by name, or folders; `capture` is made by `drgs scene capture`, whose true gains are compared with those that
were found. One thread.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
from studies import PAGE_DATA, table_lines, write_csv  # noqa: E402
from where import DATA, UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.data import load  # noqa: E402
from drgs.fitting.config import FitConfig, SelectionConfig  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.train import fit  # noqa: E402

ROWS = ROOT / "benchmarks" / "joined.jsonl"
SCENES = ("banana",)
SIZE = {"max_steps": 400, "max_pixels": 12_000, "max_gaussians": 8_000}
# Name -> options of a fit.
TERMS = {
    "none": {},
    "exposure=points": {"exposure": "points"},
    "poses=refined": {"poses": "refined"},
    "both": {"exposure": "points", "poses": "refined"},
}
POLICIES = ("farthest", "fisher")
KEY = ("scene", "policy", "term", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")


def gain_errors(folder: Path, gains: dict[str, list[float]]) -> dict[str, float]:
    """Root mean squares of the error of log gains of photographs, and of the true ones; none where truth is unknown."""
    path = folder / "truth.json"
    if not path.is_file():
        return {}
    truth = json.loads(path.read_text())["log_gains"]
    true = np.array([truth.get(name, truth.get(f"{name}.png")) for name in gains])
    true -= true.mean(axis=0)
    found = np.log(np.array(list(gains.values())))
    found -= found.mean(axis=0)
    return {"error": float(np.sqrt(np.square(found - true).mean())), "true": float(np.sqrt(np.square(true).mean()))}


def measured(scene: str, policy: str, term: str, seed: int, offset: int) -> dict:
    """One active fit: its held-out views, what it picked, and what it found of its photographs."""
    selection = SelectionConfig(policy=policy, initial=3, add=8, every=40, start="seed")
    config = FitConfig().replace(
        settings=RenderSettings.preset("fast"),
        renderers=("fast",),
        selection=selection,
        seed=seed,
        test_offset=offset,
        **SIZE,
        **TERMS[term],
    )
    with tempfile.TemporaryDirectory() as folder:
        result = fit(load(DATA / scene), Path(folder) / "run", config, progress=False)
        recorded = result.run.config()
        picks = json.loads((result.run.path / "selection.json").read_text())["picks"]
    metrics = result.metrics
    found = {key: metrics["poses"][key] for key in ("degrees", "moved")} if "poses" in metrics else {}
    if "exposure" in recorded:
        found |= gain_errors(DATA / scene, recorded["exposure"]["gains"])
    return {
        **dict(zip(KEY, (Path(scene).name, policy, term, seed, offset, *SIZE.values()), strict=True)),
        "psnr": [view["psnr"] for view in metrics["views"]],
        "cc_psnr": [view["cc_psnr"] for view in metrics["views"]],
        "picks": [pick["name"] for pick in picks],
        "pick_seconds": sum(pick["seconds"] for pick in picks),
        "found": found,
        "seconds": metrics["seconds"],
        **ran(),
    }


def table(found: list[dict]) -> str:
    """What each term changes of an active fit, on average over seeds."""
    lines = ["| capture (held out) | policy | term | picks as without | found | PSNR, mean / worst | color-corrected |"]
    lines += ["|---|---|---|---|---|---|---|"]
    by_fit = {tuple(row[name] for name in KEY[:5]): row for row in found}
    groups = dict.fromkeys((row["scene"], row["policy"], row["term"]) for row in found)
    for scene, policy, term in sorted(groups, key=lambda group: (group[0], group[1], list(TERMS).index(group[2]))):
        mine = [row for row in found if (row["scene"], row["policy"], row["term"]) == (scene, policy, term)]
        pairs = [(row, by_fit[scene, policy, "none", row["seed"], row["offset"]]) for row in mine]
        plain = term == "none"
        sign = "" if plain else "+"
        mean, worst, corrected = (
            statistics.mean(of(row) - (0 if plain else of(other)) for row, other in pairs)
            for of in (
                lambda row: statistics.mean(row["psnr"]),
                lambda row: min(row["psnr"]),
                lambda row: statistics.mean(row["cc_psnr"]),
            )
        )
        same = statistics.mean(len({*row["picks"]} & {*other["picks"]}) for row, other in pairs)
        cells = [
            f"{scene} ({'+'.join(str(len(row['psnr'])) for row in mine)})" if plain else "",
            f"`{policy}`",
            term,
            "-" if plain else f"{same:.1f} of {len(mine[0]['picks'])}",
            _words([row["found"] for row in mine]),
            f"{mean:{sign}.2f} / {worst:{sign}.2f}",
            f"{corrected:{sign}.2f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _words(found: list[dict]) -> str:
    """What fits found of their photographs, on average over seeds."""
    texts = []
    if all("error" in x for x in found):
        error, true = (statistics.mean(x[key] for x in found) for key in ("error", "true"))
        texts.append(f"log gains are {error:.3f} off, of {true:.3f}")
    if all("degrees" in x for x in found):
        texts.append(f"turned by {statistics.mean(x['degrees'] for x in found):.2f} degrees")
    return ", ".join(texts) or "-"


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures, or folders")
    parser.add_argument("--policies", nargs="+", default=list(POLICIES))
    parser.add_argument("--terms", nargs="+", choices=TERMS, default=list(TERMS))
    parser.add_argument("--seeds", type=int, default=2, choices=range(1, len(UNITS) + 1))
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    for seed, offset in [] if args.page else UNITS[: args.seeds]:
        for scene in args.scenes:
            for policy in args.policies:
                for term in args.terms:
                    if (Path(scene).name, policy, term, seed, offset, *SIZE.values()) in done:
                        continue
                    row = measured(scene, policy, term, seed, offset)
                    add_row(ROWS, row)
                    means = {name: round(statistics.mean(row[name]), 2) for name in ("psnr", "cc_psnr")}
                    print(scene, policy, term, seed, means, row["found"], f"{row['seconds']:.0f} s", flush=True)
    text = table(read_rows(ROWS))
    print(text)
    write_csv(PAGE_DATA / "joined.csv", table_lines(text))


if __name__ == "__main__":
    main()
