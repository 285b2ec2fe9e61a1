"""What scripts write into pages: text between two markers, and the plot of a study's curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drgs.io.outputs import atomic_write, replacing
from drgs.studies.cells import Metric, Study
from drgs.studies.statistics import at_views, values_of, view_counts

__all__ = ["draw_curves", "fill_between"]


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
