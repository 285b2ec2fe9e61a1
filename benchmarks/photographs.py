"""What is modeled beside the scene, on and off: exposure, poses, transients, a skybox, in paired fits of captures.

    python benchmarks/photographs.py [--scenes head office ...] [--terms exposure=points ...] [--seeds 3] [--page]

Every fit has the defaults of `drgs fit` but for its size, the one term that its row names, and no skybox if that is not
its term; what is said of a term is a difference to the fit without, of the same scene, split and seed. Appends one row
a fit to benchmarks/photographs.jsonl as it ends, leaves out what is there, then writes the table of docs/real-data.md,
docs/data/photographs.csv and skyboxes.csv, which has every renderer. Scenes are captures by name, or folders, as `drgs
sfm` makes one of `watch` and `drgs scene capture` the made one. Each seed holds out other views, but of data sets that
have a split of their own. One thread.
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, table_lines, write_csv  # noqa: E402
from where import DATA, UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.data import load  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.studies.statistics import estimate  # noqa: E402
from drgs.train import fit  # noqa: E402

ROWS = ROOT / "benchmarks" / "photographs.jsonl"
PAGE = ROOT / "docs" / "real-data.md"
SCENES = ("office", "head", "banana", "fern", "statue")
TERMS = ("", "exposure=points", "exposure=learned", "poses=refined", "transients=mask")
SIZE = {"max_steps": 400, "max_pixels": 12_000, "max_gaussians": 8_000}
MADE = "capture"
RENDERERS = ("exact", "fast", "gsplat")
KEY = ("scene", "term", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")


def measured(scene: str, term: str, seed: int, offset: int, size: dict) -> dict:
    """One fit: its held-out views, and what it found of its photographs."""
    name, _, value = term.partition("=")
    options = {"skybox": "off"} | ({name: value} if term else {})
    config = FitConfig().replace(seed=seed, test_offset=offset, **size, **options)
    with tempfile.TemporaryDirectory() as folder:
        result = fit(load(DATA / scene), Path(folder) / "run", config, progress=False)
        recorded = result.run.config()
    metrics = result.metrics
    found = {key: recorded["exposure"][key] for key in ("spread", "noise")} if "exposure" in recorded else {}
    found |= {key: metrics["poses"][key] for key in ("degrees", "moved", "psnr_refined")} if "poses" in metrics else {}
    found |= {"reprojection": recorded["poses"]["reprojection"]} if "poses" in recorded else {}
    found |= metrics.get("transients", {})
    if "share" in recorded.get("skybox", {}):  # photographs were asked
        found["skybox"] = {**recorded["skybox"], "visible": metrics.get("skybox", {}).get("visible", 0.0)}
    return {
        **dict(zip(KEY, (Path(scene).name, term, seed, offset, *size.values()), strict=True)),
        "psnr": [view["psnr"] for view in metrics["views"]],
        "cc_psnr": [view["cc_psnr"] for view in metrics["views"]],
        "renderers": {
            row["name"]: {"mean": row["mean"]["psnr"], "worst": row["worst"]["psnr"]}
            for row in metrics["renderers"]["rows"]
        },
        "found": found,
        "seconds": metrics["seconds"],
        **ran(),
    }


def table(found: list[dict]) -> str:
    """What each term found of a capture, and what it changes of its held-out views, on average over seeds."""
    lines = ["| capture (held out) | term | seeds | what was found | PSNR, mean / worst | color-corrected | seconds |"]
    lines += ["|---|---|---|---|---|---|---|"]
    compared = {_unit(row) for row in found if row["term"]}
    found = [row for row in found if _unit(row) in compared]
    by_unit = {(*_unit(row), row["term"]): row for row in found}
    scenes = list(dict.fromkeys(row["scene"] for row in found))
    terms = list(dict.fromkeys(row["term"] for row in found))
    for scene, term in itertools.product(scenes, terms):
        mine = [row for row in found if (row["scene"], row["term"]) == (scene, term)]
        pairs = [(row, by_unit[*_unit(row), ""]) for row in mine if (*_unit(row), "") in by_unit]
        if not pairs:
            continue
        plain = term == ""
        mean, corrected = (
            statistics.mean(
                statistics.mean(row[name]) - (0 if plain else statistics.mean(other[name])) for row, other in pairs
            )
            for name in ("psnr", "cc_psnr")
        )
        worst = statistics.mean(min(row["psnr"]) - (0 if plain else min(other["psnr"])) for row, other in pairs)
        seconds = statistics.mean(row["seconds"] for row, _ in pairs)
        sign = "" if plain else "+"
        cells = [
            f"{scene} ({'+'.join(str(len(row['psnr'])) for row, _ in pairs)})" if plain else "",
            term or "none",
            f"{len(pairs)}",
            _words(pairs[0][0]["found"]),
            f"{mean:{sign}.2f} / {worst:{sign}.2f}",
            f"{corrected:{sign}.2f}",
            f"{seconds:.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def summary(found: list[dict]) -> str:
    """What each term changes on average over the captures that people took."""
    lines = ["| term | captures | PSNR (95 %) | worst view (95 %) | color-corrected (95 %) |", "|---|---|---|---|---|"]
    by_unit = {(*_unit(row), row["term"]): row for row in found if row["scene"] != MADE}
    for term in dict.fromkeys(row["term"] for row in found if row["term"]):
        pairs = {key[:3]: (row, by_unit[*key[:3], ""]) for key, row in by_unit.items() if key[3] == term}
        cells = []
        for measure in (
            lambda row: statistics.mean(row["psnr"]),
            lambda row: min(row["psnr"]),
            lambda row: statistics.mean(row["cc_psnr"]),
        ):
            effect = estimate({(k[0], k[1:], ()): measure(row) - measure(other) for k, (row, other) in pairs.items()})
            cells.append(f"{effect.mean:+.2f} ({effect.low:+.2f} to {effect.high:+.2f})")
        lines.append(f"| {term} | {effect.scenes} ({effect.units} fits) | {' | '.join(cells)} |")
    return "\n".join(lines)


def skyboxes(found: list[dict]) -> str:
    """What a skybox changes of held-out views in each of three renderers, against the fit without of the same unit."""
    heads = ["capture, seed", "term", "directions that agree on what is far", "pixels that show it"]
    heads += [*(f"`{name}`" for name in RENDERERS), "seconds"]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    plain = {_unit(row): row for row in found if not row["term"] and "renderers" in row}
    with_sky = [row for row in found if "skybox" in row["found"] and _unit(row) in plain]
    for unit in sorted({_unit(row) for row in with_sky}):
        base = plain[unit]
        cells = [f"{base['renderers'][x]['mean']:.2f} / {base['renderers'][x]['worst']:.2f}" for x in RENDERERS]
        lines.append(f"| {unit[0]}, {unit[1]} | none | | | {' | '.join(cells)} | {base['seconds']:.0f} |")
        for row in (row for row in with_sky if _unit(row) == unit):
            cells = [
                " / ".join(f"{row['renderers'][x][key] - base['renderers'][x][key]:+.2f}" for key in ("mean", "worst"))
                for x in RENDERERS
            ]
            sky = row["found"]["skybox"]
            shown = f"{100 * sky['visible']:.0f} %" if sky["gaussians"] else "none"
            seen = f"{100 * sky['share']:.0f} % | {shown}"
            lines.append(f"|  | {row['term']} | {seen} | {' | '.join(cells)} | {row['seconds']:.0f} |")
    return "\n".join(lines)


def _unit(row: dict) -> tuple[str, int, int]:
    """What fits must have in common to be compared."""
    return row["scene"], row["seed"], row["offset"]


def _words(found: dict) -> str:
    """What a fit found of its photographs."""
    said = []
    if "spread" in found:
        said.append("log2 gains differ by " + " ".join(f"{x:.2f}" for x in found["spread"]))
    if found.get("reprojection") is not None:
        said.append(f"points are {found['reprojection']:.2f} px off")
    if "degrees" in found:
        said.append(f"turned by {found['degrees']:.2g} degrees, held-out views refined: {found['psnr_refined']:.2f} dB")
    if "masked" in found:
        said.append(f"{100 * found['share']:.1f} % of the pixels, in {found['masked']} photographs")
    return "; ".join(said) or "-"


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures, or folders")
    parser.add_argument("--terms", nargs="+", default=list(TERMS[1:]), help="options of a fit, as NAME=VALUE")
    parser.add_argument("--seeds", type=int, default=len(UNITS), choices=range(1, len(UNITS) + 1))
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    for seed, offset in UNITS[: args.seeds]:
        for scene in [] if args.page else args.scenes:
            for term in ("", *args.terms):
                if (Path(scene).name, term, seed, offset, *SIZE.values()) not in done:
                    row = measured(scene, term, seed, offset, SIZE)
                    add_row(ROWS, row)
                    means = {name: round(statistics.mean(row[name]), 2) for name in ("psnr", "cc_psnr")}
                    print(scene, term or "none", means, row["found"], f"{row['seconds']:.0f} s", flush=True)
    found = read_rows(ROWS)
    others = [row for row in found if not row["term"].startswith("skybox")]
    fill_between(PAGE, "terms", summary(others))
    for name, text in (("photographs", table(others)), ("skyboxes", skyboxes(found))):
        print(text)
        write_csv(PAGE_DATA / f"{name}.csv", table_lines(text))


if __name__ == "__main__":
    main()
