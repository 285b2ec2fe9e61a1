"""What scripts write into pages: text between two markers, the report of a study, and the plot of its curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drgs.io.outputs import atomic_write, replacing
from drgs.studies.cells import Metric, Study
from drgs.studies.protocols import PROTOCOLS
from drgs.studies.statistics import FEWEST_UNITS, Unit, at_views, unit_of, values_of, view_counts
from drgs.studies.tables import (
    comparison_table,
    difference_text,
    estimates_of,
    explained,
    labels_of,
    markdown_table,
    paragraph,
    range_text,
    title_of,
    verdict_of,
)

__all__ = ["draw_curves", "fill_between", "study_report"]

StudyRows = Sequence[Mapping[str, Any]]


def study_report(study: Study, rows: StudyRows, level: int = 3) -> str:
    """Everything that a page says about a study's numbers.

    Args:
        study: What was studied.
        rows: Its rows (`drgs.studies.rows.read_study`); others are left out.
        level: Level of the headings.
    """
    rows = [row for row in rows if row["study"] == study.name and row["policy"] in study.policies]
    if not rows:
        return "No cell is finished."
    parts = [paragraph(_size(rows))]
    protocols = [name for name in PROTOCOLS if any(row["protocol"] == name for row in rows)]
    for protocol in protocols:
        mine = [row for row in rows if row["protocol"] == protocol]
        if len(protocols) > 1:
            parts.append(f"{'#' * level} Protocol `{protocol}`: {PROTOCOLS[protocol].description}")
        below = "#" * (level + (len(protocols) > 1))
        for scene in dict.fromkeys(row["scene"] for row in mine):
            parts += [f"{below} {scene}", _means(study, [row for row in mine if row["scene"] == scene])]
        if study.reference in study.policies and len({row["policy"] for row in mine}) > 1:
            others = [(label, study.reference) for label in study.policies if label != study.reference]
            parts += [
                f"{below} Against `{study.reference}`",
                paragraph(explained(study, mine, others)),
                comparison_table(study, mine, others),
            ]
            if verdicts := _verdicts(study, mine, others):
                parts.append(verdicts)
        if any(estimates_of(study, mine, *pair)[study.metrics[0].key] for pair in study.comparisons):
            table = comparison_table(study, mine, study.comparisons, named=True)
            if verdicts := _verdicts(study, mine, study.comparisons):
                table += "\n\n" + verdicts
            parts += [f"{below} Other pairs", table]
        parts += [f"{below} Every unit", _points(study, mine)]
    if len(protocols) > 1:
        parts += [f"{'#' * level} `paper` against `blind`", _leaked(study, rows)]
    return "\n\n".join(parts)


def fill_between(page: Path, name: str, text: str) -> None:
    """Replace what stands between `<!-- NAME: begin -->` and `<!-- NAME: end -->` of a page.

    Raises:
        ValueError: If the page does not have both, in this order.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, found, rest = page.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise ValueError(f"{page}: must have {begin} and {end}, in this order; add them")
    with atomic_write(page) as file:
        file.write(f"{before}{begin}\n\n{text}\n\n{end}{after}".encode())


def _size(rows: StudyRows) -> str:
    """How much there is, and what it ran on."""
    commits = dict.fromkeys((row.get("commit") or "unknown")[:7] for row in rows)
    units: dict[str, set] = {}
    views: dict[str, set] = {}
    for row in rows:
        units.setdefault(row["scene"], set()).add(unit_of(row))
        if row.get("views"):
            views.setdefault(row["scene"], set()).add(row["views"])
    each = [
        f"{scene} {len(found)}" + (f" ({range_text(views[scene])} test views)" if scene in views else "")
        for scene, found in units.items()
    ]
    fits = f"{len(rows)} fit{'s' if len(rows) > 1 else ''}, on commits {', '.join(commits)}"
    return (
        f"{fits}. {_kind(rows)}: {', '.join(each)}. "
        "Fits of one unit that differ by the seed alone are averaged. Tables of a scene have means over its units, of "
        f"the mean over test views and, in brackets, of the median over them.{_mixed(rows)}"
    )


def _kind(rows: StudyRows) -> str:
    """What a unit is here."""
    return f"Units (scene, {'camera held out' if rows[0].get('camera') else 'split, initial views'})"


def _mixed(rows: StudyRows) -> str:
    """A sentence about units whose fits were not all made by the same code."""
    commits: dict[tuple[str, Unit], set] = {}
    for row in rows:
        commits.setdefault((row["protocol"], unit_of(row)), set()).add(row.get("commit"))
    mixed = sum(len(found) > 1 for found in commits.values())
    sentence = f" In {mixed} of {len(commits)} units fits are of more than one commit: there the code may matter, too."
    return sentence if mixed else ""


def _means(study: Study, rows: StudyRows) -> str:
    """Policies against metrics: means over the units, of means over test views and, in brackets, of medians."""
    lines = []
    for label in labels_of(study, rows):
        cells = []
        for metric in study.metrics:
            values = values_of(rows, metric.key, label)
            middle = values_of(_by_median(rows), metric.key, label)
            mean = f"{np.mean(list(values.values())):.{metric.digits}f}" if values else "none"
            cells.append(f"{mean} ({np.mean(list(middle.values())):.{metric.digits}f})" if middle else mean)
        seconds = [x for row in rows if row["policy"] == label and (x := row["pick_seconds"]) is not None]
        count = len({unit_of(row) for row in rows if row["policy"] == label})
        lines.append([label, *cells, f"{np.median(seconds):.2f}" if seconds else "none", str(count)])
    heads = ["policy", *(title_of(metric) for metric in study.metrics), "seconds a pick (median)", "units"]
    return markdown_table(heads, lines)


def _by_median(rows: StudyRows) -> list[dict[str, Any]]:
    """The rows that say so with medians over test views for metrics."""
    return [{**row, "metrics": row["medians"]} for row in rows if row.get("medians")]


def _leaked(study: Study, rows: StudyRows) -> str:
    """What the points of views that are not picked are worth to each policy, on the units that have both protocols."""
    lines = []
    for label in labels_of(study, rows):
        both = [{**row, "policy": row["protocol"]} for row in rows if row["policy"] == label]
        estimates = estimates_of(study, both, "paper", "blind")
        if any(estimates.values()):
            cells = [
                difference_text(metric, one) if (one := estimates[metric.key]) else "none" for metric in study.metrics
            ]
            lines.append([label, *cells])
    if not lines:
        return "No policy has a unit in common yet."
    sentence = "The same policy on the same unit; how to read the numbers is said above."
    return sentence + "\n\n" + markdown_table(["policy", *(title_of(metric) for metric in study.metrics)], lines)


def _verdicts(study: Study, rows: StudyRows, pairs: Sequence[tuple[str, str]]) -> str:
    """Gains and losses in words; a pair without either is named as well."""
    lines = []
    verbs = {"gain": "gains in", "loss": "loses in"}
    for policy, reference in pairs:
        estimates = estimates_of(study, rows, policy, reference)
        words: dict[str, list[str]] = {word: [] for word in verbs}
        for metric in study.metrics:
            one = estimates[metric.key]
            if one and (word := verdict_of(metric, one)):
                words[word].append(metric.title)
        if not any(one and one.units >= FEWEST_UNITS for one in estimates.values()):
            continue
        sentence = [f"{verbs[word]} {', '.join(names)}" for word, names in words.items() if names]
        lines.append(
            f"- `{policy}` against `{reference}`: {' and '.join(sentence) or 'no difference that this study can see'}."
        )
    return "\n".join(lines)


def _points(study: Study, rows: StudyRows) -> str:
    """One table a metric: policies against units, every fit's number; of one unit in the order of their seeds."""
    units = sorted({unit_of(row) for row in rows})
    names = _unit_names(units)
    key = [
        f"- {names[unit]}: one view in {unit[1][0]} held out, from index {unit[1][1]} on; initial views "
        f"{', '.join(unit[2])}"
        if unit[1][0]
        else f"- {names[unit]}: {', '.join(unit[2])} held out; all other cameras at the first time"
        for unit in units
    ]
    parts = ["\n".join(key)]
    for metric in study.metrics:
        lines = []
        for label in labels_of(study, rows):
            by_unit: dict[Unit, list[str]] = {unit: [] for unit in units}
            for row in sorted((row for row in rows if row["policy"] == label), key=lambda row: row["seed"]):
                value = row["metrics"].get(metric.key)
                by_unit[unit_of(row)].append("none" if value is None else f"{value:.{metric.digits}f}")
            lines.append([label, *(" ".join(numbers) for numbers in by_unit.values())])
        title = f"<details><summary>{title_of(metric)}</summary>"
        parts.append(f"{title}\n\n{markdown_table(['policy', *(names[u] for u in units)], lines)}\n\n</details>")
    return "\n\n".join(parts)


def _unit_names(units: Sequence[Unit]) -> dict[Unit, str]:
    """Scene and a number, counted within the scene."""
    names: dict[Unit, str] = {}
    counts: dict[str, int] = {}
    for unit in units:
        counts[unit[0]] = counts.get(unit[0], 0) + 1
        names[unit] = f"{unit[0]} {counts[unit[0]]}"
    return names


# ------------------------------------------------------------------------------------------------------------- the plot

_COLUMNS = 4  # panels side by side: as wide as a page
_PANEL_INCHES = 3.4  # inches of a side of a panel; chosen


def draw_curves(study: Study, rows: Sequence[Mapping[str, Any]], metric: Metric, path: Path) -> bool:
    """Plot what a study's fits had at each number of views, on average over the units of a scene.

    A panel for each scene, a line for each policy; black is what the study compares with others.

    Args:
        study: Study; its policies are drawn in their order.
        rows: Rows of one protocol.
        metric: Metric on the vertical axis.
        path: A .png or .svg.
    Returns:
        False where there is no matplotlib, or no row was measured on the way.
    """
    counts = view_counts(rows)
    try:
        import matplotlib
    except ImportError:
        return False
    if not counts:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    columns = min(_COLUMNS, len(scenes))
    lines = -(-len(scenes) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(_PANEL_INCHES * columns, _PANEL_INCHES * lines), dpi=100, squeeze=False
    )
    for axis in axes.flat[len(scenes) :]:
        axis.set_axis_off()
    colors = plt.get_cmap("tab10" if len(study.policies) <= 10 else "tab20")
    judged = {policy for policy, _ in study.comparisons}
    for axis, scene in zip(axes.flat, scenes, strict=False):
        mine = [row for row in rows if row["scene"] == scene]
        for number, label in enumerate(study.policies):
            means = [(count, values_of(at_views(mine, count), metric.key, label)) for count in counts]
            points = [(count, float(np.mean(list(values.values())))) for count, values in means if values]
            if points:
                style: dict[str, Any] = {
                    "ls": "--" if label == study.reference else "-",
                    "color": colors(number % colors.N),
                }
                if label in judged:
                    style |= {"color": "black", "lw": 2.2, "zorder": 3}
                axis.plot(*zip(*points, strict=True), **({"lw": 1.2} | style), ms=3, marker="o", label=label)
        axis.set(title=scene, xlabel="views", xticks=counts)
        axis.set_ylabel(metric.title if axis in axes[:, 0] else "")
        axis.grid(lw=0.3)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=min(5, len(labels)), fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.02 + 0.06 * -(-len(labels) // 5) / lines, 1, 1))
    with replacing(path, path.suffix) as name:
        figure.savefig(name)
    plt.close(figure)
    return True
