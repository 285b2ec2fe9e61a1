"""A table of the paper as this machine has it: means, paired differences, who is best how often, what it cost."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drgs.studies.cells import Metric, Study, out_of_race
from drgs.studies.experiments import Experiment
from drgs.studies.protocols import PROTOCOLS
from drgs.studies.statistics import Unit, estimate, unit_of, values_of, view_counts
from drgs.studies.tables import comparison_table, curves, explained, markdown_table, paragraph, title_of, unlike_units

ResultRows = Sequence[Mapping[str, Any]]
_COSTS = {"minutes": "minutes (steps and picks)", "peak_memory": "peak memory, GB", "pick_seconds": "seconds a pick"}
_BEST_BY = "psnr"  # the metric by which a unit has a best policy
_UPPER = "all views"  # is given what the others choose from: it wins nothing


def results_page(study: Study, experiment: Experiment, rows: ResultRows, remarks: Sequence[str] = ()) -> str:
    """The section of one experiment as Markdown.

    Args:
        study: Study of the cells.
        experiment: The table.
        rows: ResultRows of the study; those of other policies are left out.
        remarks: More sentences, e.g. of what is not there and why.
    """
    labels = [label for label in experiment.policies if any(row["policy"] == label for row in rows)]
    rows = [row for row in rows if row["study"] == study.name and row["policy"] in experiment.policies]
    renamed = [f"`{label}` ({name})" for label, name in experiment.policies.items() if label != name]
    labels_of = [f"Labels, as `--policy` takes them: {', '.join(renamed)}."] if renamed else []
    parts = [f"## {experiment.title}", paragraph(" ".join([experiment.description, *remarks, *labels_of]))]
    if not rows:
        return "\n\n".join([*parts, "No cell is finished."])
    for protocol in (name for name in PROTOCOLS if any(row["protocol"] == name for row in rows)):
        mine = [row for row in rows if row["protocol"] == protocol]
        parts.append(paragraph(_size(protocol, mine)))
        parts.append(_table(study, experiment, labels, mine))
        if unlike := unlike_units(mine):
            parts.append(unlike)
        others = [label for label in labels if label not in (experiment.reference, _UPPER)]
        pairs = [(label, experiment.reference) for label in others]
        named = {label: experiment.policies[label] for label in labels}
        if experiment.reference in labels and pairs:
            parts.append(f"Against {named[experiment.reference]}, within units:")
            parts.append(comparison_table(study, mine, pairs, names=named))
            parts.append(paragraph(explained(study, mine, pairs)))
        if counts := view_counts(mine):
            first = [metric for metric in study.metrics if metric.key == _BEST_BY]
            parts.append(curves(dataclasses.replace(study, metrics=tuple(first)), mine, counts))
        parts += out_of_race(study, mine, protocol).values()
    if any(experiment.paper.get(label) for label in labels):
        parts.append(
            paragraph(
                f"The paper: {experiment.source}; another data set and other hardware, so that only the order of its "
                "numbers compares with ours. A dash: its text states none."
            )
        )
    return "\n\n".join(parts)


def results_rows(study: Study, experiment: Experiment, rows: ResultRows) -> list[dict[str, Any]]:
    """The same numbers for machines: one for each protocol and policy."""
    lines = []
    for protocol in PROTOCOLS:
        mine = [row for row in rows if row["protocol"] == protocol and row["policy"] in experiment.policies]
        wins, compared_units = best_of_units(mine)
        for label, name in experiment.policies.items():
            own = [row for row in mine if row["policy"] == label]
            if not own:
                continue
            line = {"protocol": protocol, "policy": label, "name": name, "fits": len(own)}
            line["units"] = len({unit_of(row) for row in own})
            for metric in study.metrics:
                values = values_of(own, metric.key, label)
                line[metric.key] = estimate(values).mean if values else None
            line["best"] = {"units": wins.get(label, 0), "of": compared_units}
            line |= {key: _cost(own, key) for key in _COSTS} | {"paper": dict(experiment.paper.get(label, {}))}
            lines.append(line)
    return lines


def best_of_units(rows: ResultRows) -> tuple[dict[str, int], int]:
    """In how many units each policy has the largest PSNR, and how many units have all; rows of one protocol."""
    labels = [label for label in dict.fromkeys(row["policy"] for row in rows) if label != _UPPER]
    values = {label: values_of(rows, _BEST_BY, label) for label in labels}
    units: set[Unit] = set.intersection(*(set(x) for x in values.values())) if values else set()
    wins = dict.fromkeys(labels, 0)
    for unit in units:
        best = max(x[unit] for x in values.values())
        for label in labels:
            wins[label] += values[label][unit] == best
    return wins, len(units)


def _size(protocol: str, rows: ResultRows) -> str:
    """How much there is of a protocol, and what it ran on."""
    commits = dict.fromkeys((row.get("commit") or "unknown")[:7] for row in rows)
    units: dict[str, set[Unit]] = {}
    for row in rows:
        units.setdefault(row["scene"], set()).add(unit_of(row))
    each = ", ".join(f"{scene} {len(found)}" for scene, found in units.items())
    leak = " **Pool leak: points of views that are never picked are known.**" if PROTOCOLS[protocol].leaks else ""
    return (
        f"Protocol `{protocol}`: {PROTOCOLS[protocol].description}.{leak} {len(rows)} fits on commits "
        f"{', '.join(commits)}; "
        f"units (scene, what is held out, initial views): {each}."
    )


def _table(study: Study, experiment: Experiment, labels: Sequence[str], rows: ResultRows) -> str:
    """Means of every policy, every scene counting alike, and what it cost."""
    wins, units = best_of_units(rows)
    papers = sorted({key for label in labels for key in experiment.paper.get(label, {})})
    titles = {metric.key: metric.title for metric in study.metrics}
    costs = {key: title for key, title in _COSTS.items() if _cost(rows, key) is not None}
    heads = [
        "policy",
        *map(title_of, study.metrics),
        "units",
        f"best PSNR (of {units})",
        *costs.values(),
        *(f"{titles[key]} in the paper" for key in papers),
    ]
    lines = []
    for label in labels:
        own = [row for row in rows if row["policy"] == label]
        if not own:
            continue
        cells = [_mean(metric, values_of(own, metric.key, label)) for metric in study.metrics]
        cells.append(str(len({unit_of(row) for row in own})))
        cells.append("–" if label == _UPPER else str(wins[label]))
        cells += ["none" if (x := _cost(own, key)) is None else f"{x:.2f}" for key in costs]
        cells += [f"{x:.2f}" if (x := experiment.paper.get(label, {}).get(key)) else "–" for key in papers]
        lines.append([experiment.policies[label], *cells])
    return markdown_table(heads, lines)


def _mean(metric: Metric, values: Mapping[Unit, float]) -> str:
    return f"{estimate(values).mean:.{metric.digits}f}" if values else "none"


def _cost(rows: ResultRows, key: str) -> float | None:
    """Mean over the fits that recorded it, in the unit of the table."""
    costs = [x for row in rows if (x := _one_cost(row, key)) is not None]
    return float(np.mean(costs)) if costs else None


def _one_cost(row: Mapping[str, Any], key: str) -> float | None:
    """Of one fit, in the unit of the table; `seconds` of a row are of its steps alone."""
    if key == "minutes":
        if row.get("seconds") is None:
            return None
        return (row["seconds"] + len(row.get("picks") or ()) * (row.get("pick_seconds") or 0.0)) / 60
    value = row.get(key)
    return value / 1e9 if key == "peak_memory" and value is not None else value
