"""The table, the picture and the data files of docs/next-views.md, of rows that are there.

    python benchmarks/policies.py        runs nothing

Rows are benchmarks/active.jsonl, fits of the eight scenes of the page, and active-choice.jsonl, those of the six scenes
that constants were chosen on; none of these is in both. The script that ran the fits is in the history: benchmarks/
active.py at commit 00b3bc6. In `drgs fit`, `v_opt` is `--criterion v_opt --blocks geometry --prior 1e-2`; `eig`,
`logdet` and `block_logdet` are with `--blocks geometry --prior 1e-6`, `eig, with backdrop` with `--blocks
geometry,backdrop`; `fisherrf, from scratch` is `--policy fisherrf --restart always`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import studies
from pages import draw_curves, fill_between
from studies import ROOT, lead

from drgs.fitting.config import FitConfig
from drgs.studies.cells import Metric, Study
from drgs.studies.rows import read_study
from drgs.studies.statistics import at_views, differences, unit_of, values_of, view_counts
from drgs.studies.tables import markdown_table

Rows = Sequence[dict[str, Any]]

PAGE = ROOT / "docs" / "next-views.md"
DATA = ROOT / "docs" / "data"
CURVES = ROOT / "docs" / "pictures" / "active-curves.png"
ROWS = ROOT / "benchmarks" / "active.jsonl"
CHOSEN = ROOT / "benchmarks" / "active-choice.jsonl"

DEFAULT = "v_opt, with backdrop"
SIMPLE = ("random", "uniform", "farthest", "fisherrf")
"""With the default, those that have all five units of every scene."""
OTHERS = (
    *SIMPLE,
    "eig, with backdrop",
    "v_opt",
    "eig",
    "block_logdet",
    "logdet",
    "coverage",
    "moments",
    "fisherrf, from scratch",
)
METRICS = (
    Metric("psnr", "PSNR", 2),
    Metric("ssim", "SSIM"),
    Metric("flip", "FLIP", larger=False),
    Metric("uncovered", "uncovered", larger=False),
)
GROUPS = {
    "all": ("office", "statue", "room", "still"),
    "rooms": ("room",),
    "still lifes": ("still",),
    "captures": ("office", "statue"),
    "office": ("office",),
    "statue": ("statue",),
}
SHOWN = (4, 6, 12)  # views, of the page's table

CHOICE = ("head", "banana", "room-3", "room-4", "still-5", "still-6")
TRIED = {
    "random": "",
    "uniform": "",
    "farthest": "",
    "poses": "k-medoids of camera centers and directions",
    "fisherrf": "",
    "eig": "",
    "v_opt": "Gaussians alone, lambda 1e-6",
    "facility": "places that the pool will show, each seen by a chosen view from near its ray",
    "field": "expected error about where such places are, parallax included",
    "switch": "`farthest` while more than 5 % of the candidates' pixels are empty, then `eig`",
    "diverse": "`eig` times what a pose does not share with known ones",
    "eig, with backdrop": "cells are directions, lambda 1e-6",
    "eig, with backdrop, sphere": "cells are on the sphere, lambda 1e-6",
    "v_opt, backdrop": "without Gaussians; directions, lambda 1e-6",
    "v_opt, with backdrop": "directions, lambda 1e-6",
    "v_opt, with backdrop, lambda 1e-2": "directions",
    "v_opt, with backdrop, lambda 1e-2, sphere": "the default",
}
"""What the choosing scenes were run with; policies that `drgs fit` does not have are in the history, at 9a40b12."""


def of_group(rows: Rows, group: str) -> Rows:
    """The rows of a kind of scenes."""
    return [row for row in rows if row["scene"].startswith(GROUPS[group])]


# ------------------------------------------------------------------------------------------------------------ the page


def table(rows: Rows) -> str:
    """PSNR of the default less that of the policies with all units at numbers of views, protocol `blind`."""
    blind = [row for row in rows if row["protocol"] == "blind"]
    heads = ["against", "units (scenes)", *(f"{count} views" for count in SHOWN)]
    lines = []
    for other in SIMPLE:
        found = [differences(at_views(blind, count), "psnr", DEFAULT, other) for count in SHOWN]
        scenes = {unit[0] for unit in found[-1]}
        cells = [lead(one, 2) for one in found]
        lines.append([f"`{other}`", f"{len(found[-1])} ({len(scenes)})", *cells])
    return markdown_table(heads, lines)


def draw(rows: Rows) -> None:
    """The picture: the policies that have all units, at each number of views."""
    labels = (*SIMPLE, DEFAULT)
    study = Study(
        name="active-small",
        folder=lambda scene, split: Path(scene),
        policies={label: {} for label in labels},
        fit=FitConfig(),
        metrics=METRICS,
        reference="random",
        comparisons=((DEFAULT, "random"),),
    )
    mine = [row for row in rows if row["protocol"] == "blind" and row["policy"] in labels]
    if not draw_curves(study, mine, METRICS[0], CURVES):
        raise SystemExit("benchmarks/policies.py: needs matplotlib; pip install matplotlib")


# ----------------------------------------------------------------------------------------------------- the data files


def scene_lines(rows: Rows) -> Iterator[list[str]]:
    """Means of a policy over the units of a scene; medians over test views, at the end, and seconds of a pick."""
    numbers = [metric.key for metric in METRICS]
    medians = [f"{key}_median" for key in numbers]
    yield ["protocol", "scene", "policy", "units", "views", *numbers, *medians, "seconds_a_pick"]
    counts = view_counts(rows)
    for (protocol, scene, policy), mine in grouped(rows, "protocol", "scene", "policy"):
        middle = [{**row, "metrics": row["medians"]} for row in mine]
        for count in counts:
            last = count == counts[-1]
            units = len({unit_of(row) for row in mine})
            means = [mean(metric, at_views(mine, count), policy) for metric in METRICS]
            more = [mean(metric, middle, policy) for metric in METRICS] if last else [""] * len(METRICS)
            seconds = f"{np.median([row['pick_seconds'] for row in mine]):.2f}" if last else ""
            yield [protocol, scene, policy, str(units), str(count), *means, *more, seconds]


def mean(metric: Metric, rows: Rows, policy: str) -> str:
    """Over units."""
    return f"{np.mean(list(values_of(rows, metric.key, policy).values())):.{metric.digits}f}"


def grouped(rows: Rows, *keys: str) -> Iterator[tuple[tuple[str, ...], Rows]]:
    """Rows by the values of some keys, policies in the order of the page."""
    order = (DEFAULT, *OTHERS)
    found: dict[tuple[str, ...], list[dict]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    yield from sorted(found.items(), key=lambda one: [order.index(x) if x in order else x for x in one[0]])


def unit_lines(rows: Rows) -> Iterator[list[str]]:
    """Every fit, with twelve views."""
    numbers = [metric.key for metric in METRICS]
    yield ["protocol", "scene", "held_out_every", "from_index", "initial_views", "policy", "commit", *numbers]
    for (protocol, scene, policy), mine in grouped(rows, "protocol", "scene", "policy"):
        for row in sorted(mine, key=unit_of):
            every, offset = row["split"]
            values = [f"{row['metrics'][metric.key]:.{metric.digits}f}" for metric in METRICS]
            start = " ".join(sorted(row["initial"]))
            yield [protocol, scene, str(every), str(offset), start, policy, row["commit"], *values]


def difference_lines(rows: Rows, metrics: Sequence[Metric] = METRICS) -> Iterator[list[str]]:
    """Differences within units, at every number of views; last, those of one policy by the two protocols."""
    yield [*("protocol", "policy", "against", "of", "metric", "views"), *studies.DIFFERENCE]
    counts = view_counts(rows)
    pairs = [(DEFAULT, other) for other in OTHERS] + [(other, "random") for other in OTHERS if other != "random"]
    pairs.append(("fisherrf, from scratch", "fisherrf"))
    for protocol in ("blind", "paper"):
        for policy, other in pairs:
            for group in GROUPS if policy == DEFAULT and other in SIMPLE else ("all",):
                mine = [row for row in of_group(rows, group) if row["protocol"] == protocol]
                for metric in metrics:
                    for count in counts:
                        named = [protocol, policy, other, group, metric.key, str(count)]
                        yield from studies.difference(named, metric, at_views(mine, count), policy, other)
    for policy in (DEFAULT, *OTHERS):
        both = [{**row, "policy": row["protocol"]} for row in rows if row["policy"] == policy]
        for metric in metrics:
            named = ["paper against blind", policy, policy, "all", metric.key, str(counts[-1])]
            yield from studies.difference(named, metric, both, "paper", "blind")


def choosing_lines(rows: Rows) -> Iterator[list[str]]:
    """PSNR on the choosing scenes, one unit each, and its mean over them at smaller numbers of views."""
    yield ["policy", "what it is", *CHOICE, "mean, 12 views", "8 views", "6 views"]
    for label, what in TRIED.items():
        mine = [row for row in rows if row["policy"] == label]
        at = [values_of(at_views(mine, count), "psnr", label) for count in (12, 8, 6)]
        by_scene = {unit[0]: value for unit, value in at[0].items()}
        numbers = [*(by_scene[scene] for scene in CHOICE), *(float(np.mean(list(values.values()))) for values in at)]
        yield [label, what, *(f"{x:.2f}" for x in numbers)]


def main() -> int:
    rows = read_study(ROWS)
    studies.write_csv(DATA / "policies-scenes.csv", scene_lines(rows))
    studies.write_csv(DATA / "policies-units.csv", unit_lines(rows))
    studies.write_csv(DATA / "policies-differences.csv", difference_lines(rows))
    studies.write_csv(DATA / "policies-choosing.csv", choosing_lines(read_study(CHOSEN)))
    draw(rows)
    fill_between(PAGE, "policies", table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
