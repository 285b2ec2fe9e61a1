"""Errors of the renderer against the float64 oracle at the extremes: a table, a picture and a file of docs/numerics.md.

    python benchmarks/numerics.py            measures the rows of `drgs stress`: benchmarks/numerics.json
    python benchmarks/numerics.py --page     measures nothing

Both write docs/data/extremes.csv, which has every row, docs/pictures/extremes.png and the table of the page.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Sequence
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import studies
from pages import fill_between
from studies import ROOT
from where import ran

from drgs.commands.stress import COLUMNS, markdown
from drgs.lab.extremes import CASES, REFUSALS
from drgs.lab.stress import BOUNDS, rows
from drgs.studies.tables import markdown_table, paragraph

RESULTS = ROOT / "benchmarks" / "numerics.json"
PAGE = ROOT / "docs" / "numerics.md"
PICTURE = ROOT / "docs" / "pictures" / "extremes.png"
DATA = ROOT / "docs" / "data" / "extremes.csv"
SHOWN = [key for key in COLUMNS if key != "duality"]
"""Columns of the page."""
SETTINGS = ("exact", "center", "integral", "ewa", "inria", "gsplat")
"""How the names of cases end, in backticks; those of `exact` have no such end, `center` is its order alone."""

Rows = Sequence[dict[str, Any]]


def measure() -> dict[str, Any]:
    """Every case, with where and when."""
    found = []
    for case in (*CASES, *REFUSALS):
        for row in rows(case):
            found.append(row)
            print(markdown([row])[-1], flush=True)
    return {**ran(), "rows": [dataclasses.asdict(row) for row in found]}


def case_of(row: dict[str, Any]) -> tuple[str, str]:
    """The scene of a row, and the settings that it is rendered with."""
    scene, _, last = row["case"].rpartition(", ")
    name = last.strip("`")
    return (scene, "exact" if name == "center" else name) if name in SETTINGS else (row["case"], "exact")


def table(found: Rows) -> str:
    """Traversals against the largest errors; what rounds or warns on `bvh` has a line for each scene."""
    lines = []
    for traversal in ("tiles", "bvh"):
        mine = [row for row in found if row["traversal"] == traversal]
        plain = [row for row in mine if row["verdict"] != "warns" and "rounding of `bvh`" not in row["remark"]]
        names = ", ".join(f"`{name}`" for name in dict.fromkeys(case_of(row)[1] for row in plain))
        lines.append(_line(f"`{traversal}`: {names}", plain))
        for scene in dict.fromkeys(case_of(row)[0] for row in mine if row not in plain):
            some = [row for row in mine if case_of(row)[0] == scene]
            warns = " (warns)" if any(row["verdict"] == "warns" for row in some) else ""
            lines.append(_line(f"`{traversal}`, {scene}{warns}", some))
    return markdown_table(["settings or scene", *(COLUMNS[key] for key in SHOWN)], lines)


def _line(name: str, some: Rows) -> list[str]:
    """The largest errors of some rows."""
    errors = [max(row[key] for row in some if row[key] is not None) for key in SHOWN]
    return [name, *(f"{error:.0e}" for error in errors)]


def text(result: dict[str, Any]) -> str:
    """What the page says."""
    found = result["rows"]
    measured = [row for row in found if row["traversal"] != "all"]
    held, warned, failed = (
        sum(row["verdict"] == verdict for row in measured) for verdict in ("holds", "warns", "FAILS")
    )
    refused = sum(row["verdict"] == "warns" for row in found if row not in measured)
    scenes = len({case_of(row)[0] for row in measured})
    told = (
        f"`python benchmarks/numerics.py`, {result['machine']}, {result['date']}, commit {result['commit']}: of "
        f"{len(measured)} rows of {scenes} scenes, settings and traversals {held} hold, {warned} warn, {failed} fail; "
        f"all is finite in {sum(bool(row['finite']) for row in measured)}. Of {len(found) - len(measured)} kinds of "
        f"bad input {refused} are refused or warned about."
    )
    return f"{paragraph(told)}\n\n{table(found)}"


def lines(found: Rows) -> list[list[str]]:
    """The data file: every row."""
    heads = ["case", "traversal", "image", "gradient", "group", "forward", "duality", "fisher", "finite", "verdict"]

    def cell(value: Any) -> str:
        return "" if value is None else f"{value:.1e}" if isinstance(value, float) else str(value)

    return [[*heads, "remark"], *([cell(row[key]) for key in (*heads, "remark")] for row in found)]


def draw(found: Rows) -> None:
    """The largest error of derivatives of each scene, over settings and kinds of derivatives, beside that of images."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    measured = [row for row in found if row["traversal"] != "all" and row["image"]]  # without Gaussians: errors of 0
    scenes = list(dict.fromkeys(case_of(row)[0] for row in measured))
    figure, axes = plt.subplots(1, 2, figsize=(10, 0.17 * len(scenes) + 1), dpi=90, sharey=True)
    for axis, keys, bound in (
        (axes[0], ("image",), BOUNDS["image"]),
        (axes[1], ("gradient", "forward", "fisher"), BOUNDS["gradient"]),
    ):
        for traversal, mark in (("tiles", "o"), ("bvh", "x")):
            worst: dict[int, float] = {}
            for row in measured:
                if row["traversal"] == traversal:
                    place = scenes.index(case_of(row)[0])
                    worst[place] = max(worst.get(place, 0.0), *(row[key] or 0.0 for key in keys))
            axis.plot(list(worst.values()), list(worst), mark, label=traversal, ms=4)
        axis.axvline(bound, color="gray", ls="--", lw=1, label="bound")
        axis.set_xscale("log")
        axis.grid(axis="y", lw=0.3)
    axes[0].set_yticks(range(len(scenes)), scenes, fontsize=7)
    axes[0].set_ylim(len(scenes) - 0.5, -0.5)
    axes[0].set_title("image", fontsize=9)
    axes[1].set_title("derivatives and Fisher diagonal", fontsize=9)
    axes[1].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(PICTURE)
    plt.close(figure)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help="measure nothing, write what there is")
    args = parser.parse_args()
    if not args.page:
        studies.write_rows(RESULTS, measure())
    result = studies.read_rows(RESULTS, None)
    studies.write_csv(DATA, lines(result["rows"]))
    draw(result["rows"])
    fill_between(PAGE, "table", text(result))
    return int(any(row["verdict"] == "FAILS" for row in result["rows"]))


if __name__ == "__main__":
    sys.exit(main())
