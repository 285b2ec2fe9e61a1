"""Error against time of the rows of `drgs tradeoff`, as a picture."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.io.outputs import replacing
from drgs.lab.tradeoff_rows import Measured, TradeoffRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Point = tuple[float, float, TradeoffRow]
"""Ratio of times, error, and whose they are."""

_PANELS = (
    ("image", "forward", "image error (larger of RMS and 99.9 %)"),
    ("gradient", "forward_backward", "gradient error (worst group)"),
    ("information", "fisher", "information error (worst group)"),
)
_COLORS = {"approximation": "#1f77b4", "model": "#d62728", "resolution": "#2ca02c", "precision": "#7f7f7f"}


def plot(measured: Measured, budgets: Sequence[float], title: str, path: Path) -> bool:
    """Write error against time for each use, one panel below the other.

    Args:
        measured: Times and errors of all rows; those of samples are left out.
        budgets: Errors that are drawn as lines.
        title: Text above the plot.
        path: File to write, a .png.
    Returns:
        False where there is no matplotlib.
    """
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(3, 1, figsize=(10, 15), dpi=90)
    for axis, (kind, clock, label) in zip(panels, _PANELS, strict=True):
        rows = [row for row in measured.rows if row.skipped is None and row.by == "view"]
        points = [(row.ratio[clock], getattr(row.errors, kind), row) for row in rows]
        points = [(x, y, row) for x, y, row in points if x and y]
        for name, color in _COLORS.items():
            part = [(x, y) for x, y, row in points if row.kind == name]
            axis.plot(*zip(*part, strict=True), "o", ms=5, color=color, label=name) if part else None
        points.sort(key=lambda p: p[:2])
        front = [p for i, p in enumerate(points) if all(p[1] < q[1] for q in points[:i])]
        axis.plot([p[0] for p in front], [p[1] for p in front], "-", lw=1, color="black", label="front", zorder=0)
        curve = sorted(p[:2] for p in points if p[2] is measured.truth or p[2].name.startswith("tolerance="))
        axis.plot(*zip(*curve, strict=True), "--", lw=1, color="black", label="tolerance") if curve else None
        axis.set(xscale="log", yscale="log", ylabel=label, xlabel=f"time, {clock.replace('_', ' + ')} / exact")
        axis.margins(x=0.25, y=0.12)
        for budget in budgets:
            axis.axhline(budget, lw=0.6, ls=":", color="gray", zorder=0)
        axis.legend(fontsize=7, loc="upper right")
        # The front first: what finds no free place is left without a label.
        rest = [p for p in points if p not in front]
        _labels(figure, axis, [*front, *rest], points)
    figure.suptitle(title, fontsize=10, parse_math=False)  # paths may have dollar signs
    figure.tight_layout(rect=(0, 0, 1, 0.985))
    with replacing(path, path.suffix) as name:
        figure.savefig(name)
    plt.close(figure)
    return True


def _labels(figure: Figure, axis: Axes, points: list[Point], dots: list[Point]) -> None:
    """Names beside points, without overlaps; a point whose surroundings are full goes without."""
    from matplotlib.transforms import Bbox

    figure.tight_layout(rect=(0, 0, 1, 0.985))  # places do not move any more
    renderer = figure.canvas.get_renderer()
    inside = axis.get_window_extent()
    places = [axis.transData.transform(p[:2]) for p in dots]
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in places]
    taken.append(axis.get_legend().get_window_extent(renderer))
    for x, y, row in points:
        for reach, angle in itertools.product((6, 16, 30, 46), (0, 180, 90, 270, 45, 315, 135, 225)):
            dx = reach * math.cos(math.radians(angle))
            dy = reach * math.sin(math.radians(angle))
            text = axis.annotate(
                row.name,
                (x, y),
                xytext=(dx, dy),
                textcoords="offset points",
                fontsize=7.5,
                color=_COLORS[row.kind],
                ha="left" if dx > 1 else "right" if dx < -1 else "center",
                va="bottom" if dy > 1 else "top" if dy < -1 else "center",
                arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "gray"} if reach > 6 else None,
            )
            box = text.get_window_extent(renderer)
            corners = (box.x0, box.y0), (box.x1, box.y1)
            if all(inside.contains(*corner) for corner in corners) and not box.count_overlaps(taken):
                taken.append(box)
                break
            text.remove()
