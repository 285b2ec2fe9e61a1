"""The tables of a study as Markdown (means, differences with intervals, the points of every unit), and its plot."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drgs.io.outputs import atomic_write, replacing
from drgs.studies.cells import Metric, Study
from drgs.studies.protocols import PROTOCOLS
from drgs.studies.statistics import (
    FEWEST_UNITS,
    Effect,
    Unit,
    at_views,
    coverage,
    differences,
    estimate,
    unit_of,
    values_of,
    view_counts,
)

__all__ = [
    "comparison_table",
    "curves",
    "draw_curves",
    "explained",
    "fill_between",
    "markdown_table",
    "paragraph",
    "study_report",
    "unlike_units",
]

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
        if any(_estimates(study, mine, *pair)[study.metrics[0].key] for pair in study.comparisons):
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


def paragraph(text: str) -> str:
    """A paragraph in lines of 120 characters."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


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
        f"{scene} {len(found)}" + (f" ({_range(views[scene])} test views)" if scene in views else "")
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


def _range(numbers: set[int]) -> str:
    return str(min(numbers)) if len(numbers) == 1 else f"{min(numbers)} to {max(numbers)}"


def _labels(study: Study, rows: StudyRows) -> list[str]:
    """The policies that have rows, in the study's order."""
    return [label for label in study.policies if any(row["policy"] == label for row in rows)]


def markdown_table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table of Markdown."""
    rule = "|" + "---|" * len(heads)
    return "\n".join(["| " + " | ".join(heads) + " |", rule, *("| " + " | ".join(line) + " |" for line in lines)])


def _means(study: Study, rows: StudyRows) -> str:
    """Policies against metrics: means over the units, of means over test views and, in brackets, of medians."""
    lines = []
    for label in _labels(study, rows):
        cells = []
        for metric in study.metrics:
            values = values_of(rows, metric.key, label)
            middle = values_of(_by_median(rows), metric.key, label)
            mean = f"{np.mean(list(values.values())):.{metric.digits}f}" if values else "none"
            cells.append(f"{mean} ({np.mean(list(middle.values())):.{metric.digits}f})" if middle else mean)
        seconds = [x for row in rows if row["policy"] == label and (x := row["pick_seconds"]) is not None]
        count = len({unit_of(row) for row in rows if row["policy"] == label})
        lines.append([label, *cells, f"{np.median(seconds):.2f}" if seconds else "none", str(count)])
    heads = ["policy", *(_title(metric) for metric in study.metrics), "seconds a pick (median)", "units"]
    return markdown_table(heads, lines)


def _by_median(rows: StudyRows) -> list[dict[str, Any]]:
    """The rows that say so with medians over test views for metrics."""
    return [{**row, "metrics": row["medians"]} for row in rows if row.get("medians")]


def _title(metric: Metric) -> str:
    return metric.title if metric.larger else f"{metric.title} (lower is better)"


def explained(study: Study, rows: StudyRows, pairs: Sequence[tuple[str, str]]) -> str:
    """How to read the table of the differences of pairs (`comparison_table`), by what it has."""
    all_differences = [differences(rows, metric.key, *pair) for pair in pairs for metric in study.metrics]
    intervals = [values for values in all_differences if len(values) > 1]
    scenes = len({unit[0] for values in intervals for unit in values})
    units = len({unit for values in intervals for unit in values})
    if not intervals:
        return "Differences within a unit; of a single one there is no interval, and no verdict."
    judged = sum(len(values) >= FEWEST_UNITS for values in intervals)
    held = coverage(scenes, units)
    sentence = (
        f"**Gain** and **loss**: the interval excludes 0. Were all policies equal, about {judged * (1 - held):.1f} of "
        f"the {judged} intervals would exclude it as well."
        if judged
        else f"No verdicts: {units} units cannot tell a difference from chance, even if all of them agree."
    )
    kind = "scenes" if scenes > 1 else "units"
    count = scenes if scenes > 1 else units
    alike = " that differ as much as their units do," if 1 < scenes < 8 and units >= 2 * scenes else ""
    drawn = f"{scenes} scenes first and the units of each then" if scenes > 1 else f"the {units} units of one scene"
    return (
        f"Differences within a unit: their mean{' (every scene counts alike)' if scenes > 1 else ''}, its 95 % "
        f"interval from a bootstrap over {drawn}, and in how many units the policy was better. Of {count} "
        f"{kind}{alike} the interval holds the true mean in about {held * 100:.0f} % of studies. {sentence} The "
        f"last row, *detectable*, is the true difference that a t test of {count} {kind} ({count - 1} degree"
        f"{'s' if count > 2 else ''} of freedom, 5 % of false alarms) would find in 80 % of studies that spread as "
        "this one does (the median of the rows)."
    )


def comparison_table(
    study: Study, rows: StudyRows, pairs: Sequence[tuple[str, str]], named: bool = False, names: Mapping[str, str] = {}
) -> str:
    """Pairs of policies against metrics as a table; below them the smallest difference that is detectable.

    Args:
        study, rows: What is compared.
        pairs: (policy, reference) each.
        named: Name the reference in every line.
        names: Label -> what is printed in its place.
    """
    lines: list[list[str]] = []
    sizes: dict[str, list[float]] = {metric.key: [] for metric in study.metrics}
    for policy, reference in pairs:
        estimates = _estimates(study, rows, policy, reference)
        if not any(estimates.values()):
            continue
        cells = []
        for metric in study.metrics:
            one = estimates[metric.key]
            cells.append(_difference(metric, one) if one else "none")
            if one and one.detectable is not None:
                sizes[metric.key].append(one.detectable)
        label = names.get(policy, policy)
        lines.append([f"{label} against {names.get(reference, reference)}" if named else label, *cells])
    if not lines:
        return "No pair of policies has a unit in common yet."
    last = [f"{np.median(sizes[m.key]):.{m.digits}f}" if sizes[m.key] else "none" for m in study.metrics]
    return markdown_table(["policy", *(_title(metric) for metric in study.metrics)], [*lines, ["detectable", *last]])


def unlike_units(rows: StudyRows) -> str:
    """A sentence for below a table of means, if its policies have run on different units; else nothing."""
    units: dict[str, set[Unit]] = {}
    for row in rows:
        units.setdefault(row["policy"], set()).add(unit_of(row))
    if len({frozenset(found) for found in units.values()}) < 2:
        return ""
    return "Means of rows with different units do not compare; the differences within units do."


def curves(study: Study, rows: StudyRows, counts: Sequence[int]) -> str:
    """Of each metric: policies against numbers of views, on average over scenes; below, what is left of differences."""
    sentence = (
        "Measured with so many views, on the way just before the next one is picked, with the last number at the end; "
        "every scene counts alike."
    )
    heads = ["policy", *(f"{count} views" for count in counts)]
    labels = _labels(study, rows)
    measured = [at_views(rows, count) for count in counts]
    units = {x: {len({unit_of(row) for row in at if row["policy"] == x}) for at in measured} for x in labels}
    unlike = next((remark for at in measured if (remark := unlike_units(at))), "")
    parts = [paragraph(f"{sentence} {unlike}".strip())]
    for metric in study.metrics:
        means = []
        for label in labels:
            values = [values_of(at, metric.key, label) for at in measured]
            averages = [estimate(found).mean if found else None for found in values]
            numbers = ("none" if x is None else f"{x:.{metric.digits}f}" for x in averages)
            means.append([label, *numbers, _range(units[label])])
        parts += [f"{_title(metric)}:", markdown_table([*heads, "units"], means)]
        lines = []
        for label in labels:
            values = [differences(at, metric.key, label, study.reference) for at in measured]
            if label != study.reference and any(values):
                lines.append([label, *(_difference(metric, estimate(x)) if x else "none" for x in values)])
        if lines:
            parts += [f"The same, less that of `{study.reference}`:", markdown_table(heads, lines)]
    return "\n\n".join(parts)


def _leaked(study: Study, rows: StudyRows) -> str:
    """What the points of views that are not picked are worth to each policy, on the units that have both protocols."""
    lines = []
    for label in _labels(study, rows):
        both = [{**row, "policy": row["protocol"]} for row in rows if row["policy"] == label]
        estimates = _estimates(study, both, "paper", "blind")
        if any(estimates.values()):
            cells = [_difference(metric, one) if (one := estimates[metric.key]) else "none" for metric in study.metrics]
            lines.append([label, *cells])
    if not lines:
        return "No policy has a unit in common yet."
    sentence = "The same policy on the same unit; how to read the numbers is said above."
    return sentence + "\n\n" + markdown_table(["policy", *(_title(metric) for metric in study.metrics)], lines)


def _estimates(study: Study, rows: StudyRows, policy: str, reference: str) -> dict[str, Effect | None]:
    """Metric -> what the pair's differences say; None where they have no unit in common."""
    by_metric = {metric.key: differences(rows, metric.key, policy, reference) for metric in study.metrics}
    return {key: estimate(values) if values else None for key, values in by_metric.items()}


def _difference(metric: Metric, effect: Effect) -> str:
    """Mean, interval, verdict, and in how many units it is better; of a single unit the difference alone."""
    numbers = f"{effect.mean:+.{metric.digits}f}"
    if effect.units == 1:
        return f"{numbers}, 1 unit"
    numbers += f" [{effect.low:+.{metric.digits}f}, {effect.high:+.{metric.digits}f}]"
    better = effect.positive if metric.larger else effect.negative
    word = _verdict(metric, effect)
    return f"{numbers}{f' **{word}**' if word else ''}, {better} of {effect.units}"


def _verdict(metric: Metric, effect: Effect) -> str:
    """`gain`, `loss`, or nothing where the interval holds 0 or is of too few units."""
    if effect.units < FEWEST_UNITS or effect.low <= 0 <= effect.high:
        return ""
    return "gain" if (effect.mean > 0) == metric.larger else "loss"


def _verdicts(study: Study, rows: StudyRows, pairs: Sequence[tuple[str, str]]) -> str:
    """Gains and losses in words; a pair without either is named as well."""
    lines = []
    verbs = {"gain": "gains in", "loss": "loses in"}
    for policy, reference in pairs:
        estimates = _estimates(study, rows, policy, reference)
        words: dict[str, list[str]] = {word: [] for word in verbs}
        for metric in study.metrics:
            one = estimates[metric.key]
            if one and (word := _verdict(metric, one)):
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
        for label in _labels(study, rows):
            by_unit: dict[Unit, list[str]] = {unit: [] for unit in units}
            for row in sorted((row for row in rows if row["policy"] == label), key=lambda row: row["seed"]):
                value = row["metrics"].get(metric.key)
                by_unit[unit_of(row)].append("none" if value is None else f"{value:.{metric.digits}f}")
            lines.append([label, *(" ".join(numbers) for numbers in by_unit.values())])
        title = f"<details><summary>{_title(metric)}</summary>"
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
