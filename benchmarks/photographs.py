"""What is modeled of single photographs, on and off: exposure, poses, transients, in paired fits of captures.

    python benchmarks/photographs.py [--scenes head office ...] [--terms exposure=points ...] [--offsets 0]
        [--seeds 0] [--page]

Every fit has the defaults of `drgs fit` but for its size and the one term that its row names; what is said of a term
is a difference to the fit without, of the same scene, split and seed. Appends one row a fit to
benchmarks/photographs.jsonl as it ends, leaves out what is there, then writes the table of docs/one-model.md, and that
of skyboxes in each renderer. Scenes are captures by name, or folders, as `drgs sfm` makes one of `watch` and
`drgs scene capture` the made one. One thread.
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

from where import DATA, add_row, ran, read_rows  # noqa: E402

from drgs.data import load  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.studies.tables import fill_between  # noqa: E402
from drgs.train import fit  # noqa: E402

ROWS = ROOT / "benchmarks" / "photographs.jsonl"
PAGE = ROOT / "docs" / "one-model.md"
SCENES = ("office", "head", "banana", "fern", "statue")
TERMS = ("", "exposure=points", "exposure=learned", "poses=refined", "transients=mask")
SIZE = {"max_steps": 400, "max_pixels": 12_000, "max_gaussians": 8_000}
RENDERERS = ("exact", "fast", "gsplat")
KEY = ("scene", "term", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")


def measured(scene: str, term: str, offset: int, seed: int, size: dict) -> dict:
    """One fit: its held-out views, and what it found of its photographs."""
    name, _, value = term.partition("=")
    config = FitConfig.of(test_offset=offset, seed=seed, **size, **({name: value} if term else {}))
    with tempfile.TemporaryDirectory() as folder:
        result = fit(load(DATA / scene), Path(folder) / "run", config, progress=False)
        recorded = result.run.config()
    metrics = result.metrics
    found = {key: recorded["exposure"][key] for key in ("spread", "noise")} if "exposure" in recorded else {}
    found |= {key: metrics["poses"][key] for key in ("degrees", "moved", "psnr_refined")} if "poses" in metrics else {}
    found |= {"reprojection": recorded["poses"]["reprojection"]} if "poses" in recorded else {}
    found |= metrics.get("transients", {})
    if "skybox" in recorded:
        found["skybox"] = {**recorded["skybox"], "visible": metrics.get("skybox", {}).get("visible", 0.0)}
    return {
        **dict(zip(KEY, (Path(scene).name, term, config.seed, offset, *size.values()), strict=True)),
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
    """What each term found of a capture, and what it changes of its held-out views."""
    lines = ["| capture (held out) | term | what was found | PSNR, mean / worst | color-corrected | seconds |"]
    lines += ["|---|---|---|---|---|---|"]
    for scene in dict.fromkeys(row["scene"] for row in found):
        units = [tuple(row[name] for name in KEY if name != "term") for row in found if row["scene"] == scene]
        for unit in dict.fromkeys(units):
            mine = [row for row in found if tuple(row[name] for name in KEY if name != "term") == unit]
            plain = next((row for row in mine if not row["term"]), None)
            if plain is None:
                continue
            for row in mine:
                cells = [_means(row["psnr"]), f"{statistics.mean(row['cc_psnr']):.2f}", f"{row['seconds']:.0f}"]
                if row is not plain:
                    change = statistics.mean(row["psnr"]) - statistics.mean(plain["psnr"])
                    worst = min(row["psnr"]) - min(plain["psnr"])
                    corrected = statistics.mean(row["cc_psnr"]) - statistics.mean(plain["cc_psnr"])
                    cells[:2] = [f"{change:+.2f} / {worst:+.2f}", f"{corrected:+.2f}"]
                where = f"{scene} ({len(row['psnr'])})" if row is plain else ""
                lines.append(f"| {where} | {row['term'] or 'none'} | {_words(row['found'])} | {' | '.join(cells)} |")
    return "\n".join(lines)


def skyboxes(found: list[dict]) -> str:
    """What a skybox changes of held-out views in each of three renderers, against the fit without of the same seed."""
    lines = ["| capture, seed | term | agree on what is far / show it | `exact` | `fast` | `gsplat` | seconds |"]
    lines += ["|---|---|---|---|---|---|---|"]
    rest = [name for name in KEY if name != "term"]
    plain = {tuple(row[name] for name in rest): row for row in found if not row["term"] and "renderers" in row}
    with_sky = [row for row in found if row["term"].startswith("skybox")]
    units = sorted(
        {tuple(row[name] for name in rest) for row in with_sky if tuple(row[name] for name in rest) in plain}
    )
    for unit in units:
        base = plain[unit]
        cells = [f"{base['renderers'][x]['mean']:.2f} / {base['renderers'][x]['worst']:.2f}" for x in RENDERERS]
        lines.append(f"| {unit[0]}, {unit[1]} | none | - | {' | '.join(cells)} | {base['seconds']:.0f} |")
        for row in with_sky:
            if tuple(row[name] for name in rest) != unit:
                continue
            cells = [
                " / ".join(f"{row['renderers'][x][key] - base['renderers'][x][key]:+.2f}" for key in ("mean", "worst"))
                for x in RENDERERS
            ]
            sky = row["found"]["skybox"]
            shown = f"{100 * sky['visible']:.0f} % of the pixels" if sky["gaussians"] else "none"
            seen = f"{100 * sky['share']:.0f} % of directions / {shown}"
            lines.append(f"|  | {row['term']} | {seen} | {' | '.join(cells)} | {row['seconds']:.0f} |")
    return "\n".join(lines)


def _means(values: list[float]) -> str:
    return f"{statistics.mean(values):.2f} / {min(values):.2f}"


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
    parser.add_argument("--offsets", nargs="+", type=int, default=[0], help="of the held-out views")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of the fits")
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    for offset, seed in itertools.product(args.offsets, args.seeds):
        for scene in [] if args.page else args.scenes:
            for term in ("", *args.terms):
                if (Path(scene).name, term, seed, offset, *SIZE.values()) not in done:
                    row = measured(scene, term, offset, seed, SIZE)
                    add_row(ROWS, row)
                    means = {name: round(statistics.mean(row[name]), 2) for name in ("psnr", "cc_psnr")}
                    print(scene, term or "none", means, row["found"], f"{row['seconds']:.0f} s", flush=True)
    rows = read_rows(ROWS)
    # Rows of skyboxes have a table of their own, by renderer.
    text = table([row for row in rows if row["seed"] == 0 and not row["term"].startswith("skybox")])
    print(text)
    fill_between(PAGE, "photographs", text)
    text = skyboxes(rows)
    print(text)
    fill_between(PAGE, "skyboxes", text)


if __name__ == "__main__":
    main()
