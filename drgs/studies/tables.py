"""The tables of a study as Markdown: means, differences with intervals, and both by numbers of views."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drgs.studies.cells import Metric, Study
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
)

StudyRows = Sequence[Mapping[str, Any]]


def paragraph(text: str) -> str:
    """A paragraph in lines of 120 characters."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def range_text(numbers: set[int]) -> str:
    """The numbers as `3`, or as `3 to 5`."""
    return str(min(numbers)) if len(numbers) == 1 else f"{min(numbers)} to {max(numbers)}"


def labels_of(study: Study, rows: StudyRows) -> list[str]:
    """The policies that have rows, in the study's order."""
    return [label for label in study.policies if any(row["policy"] == label for row in rows)]


def markdown_table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table of Markdown."""
    rule = "|" + "---|" * len(heads)
    return "\n".join(["| " + " | ".join(heads) + " |", rule, *("| " + " | ".join(line) + " |" for line in lines)])


def title_of(metric: Metric) -> str:
    """The head of a metric's column."""
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
    study: Study, rows: StudyRows, pairs: Sequence[tuple[str, str]], names: Mapping[str, str] = {}
) -> str:
    """Pairs of policies against metrics as a table; below them the smallest difference that is detectable.

    Args:
        study, rows: What is compared.
        pairs: (policy, reference) each.
        names: Label -> what is printed in its place.
    """
    lines: list[list[str]] = []
    sizes: dict[str, list[float]] = {metric.key: [] for metric in study.metrics}
    for policy, reference in pairs:
        estimates = estimates_of(study, rows, policy, reference)
        if not any(estimates.values()):
            continue
        cells = []
        for metric in study.metrics:
            one = estimates[metric.key]
            cells.append(difference_text(metric, one) if one else "none")
            if one and one.detectable is not None:
                sizes[metric.key].append(one.detectable)
        lines.append([names.get(policy, policy), *cells])
    if not lines:
        return "No pair of policies has a unit in common yet."
    last = [f"{np.median(sizes[m.key]):.{m.digits}f}" if sizes[m.key] else "none" for m in study.metrics]
    return markdown_table(["policy", *(title_of(metric) for metric in study.metrics)], [*lines, ["detectable", *last]])


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
    labels = labels_of(study, rows)
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
            means.append([label, *numbers, range_text(units[label])])
        parts += [f"{title_of(metric)}:", markdown_table([*heads, "units"], means)]
        lines = []
        for label in labels:
            values = [differences(at, metric.key, label, study.reference) for at in measured]
            if label != study.reference and any(values):
                lines.append([label, *(difference_text(metric, estimate(x)) if x else "none" for x in values)])
        if lines:
            parts += [f"The same, less that of `{study.reference}`:", markdown_table(heads, lines)]
    return "\n\n".join(parts)


def estimates_of(study: Study, rows: StudyRows, policy: str, reference: str) -> dict[str, Effect | None]:
    """Metric -> what the pair's differences say; None where they have no unit in common."""
    by_metric = {metric.key: differences(rows, metric.key, policy, reference) for metric in study.metrics}
    return {key: estimate(values) if values else None for key, values in by_metric.items()}


def difference_text(metric: Metric, effect: Effect) -> str:
    """Mean, interval, verdict, and in how many units it is better; of a single unit the difference alone."""
    numbers = f"{effect.mean:+.{metric.digits}f}"
    if effect.units == 1:
        return f"{numbers}, 1 unit"
    numbers += f" [{effect.low:+.{metric.digits}f}, {effect.high:+.{metric.digits}f}]"
    better = effect.positive if metric.larger else effect.negative
    word = verdict_of(metric, effect)
    return f"{numbers}{f' **{word}**' if word else ''}, {better} of {effect.units}"


def verdict_of(metric: Metric, effect: Effect) -> str:
    """`gain`, `loss`, or nothing where the interval holds 0 or is of too few units."""
    if effect.units < FEWEST_UNITS or effect.low <= 0 <= effect.high:
        return ""
    return "gain" if (effect.mean > 0) == metric.larger else "loss"
