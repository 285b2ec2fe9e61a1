"""Charts of a fit as SVG texts for a page: its progress, the picks with their scores, and a map of the cameras.

matplotlib draws them, without its global state; without the package there is none, and the page says how to get it.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.cameras.origins import origin_near, origin_text
from drgs.data.camera_layout import scene_extent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from drgs.cameras import Camera
    from drgs.pages.report.account import Account

_WIDTH = 5.2  # inches: about a phone's width, where text keeps its size; wider screens enlarge it
_STYLE: Any = {"svg.fonttype": "none", "font.size": 8.5, "font.family": "sans-serif", "axes.spines.top": False}
_STYLE |= {"axes.spines.right": False, "axes.grid": True, "grid.color": "#e4e4e4", "grid.linewidth": 0.6}
_BLUE, _RED, _GREEN, _GRAY = "#1f6fb4", "#c43c39", "#2b8a4b", "#9a9a9a"
_MOST_BARS = 40  # latest picks that are drawn: more bars are too thin to read


def is_available() -> bool:
    """Whether matplotlib is installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return False
    return True


def progress(account: Account) -> str | None:
    """PSNR, loss and the number of Gaussians against the step; lines where views were added. None without steps."""
    train, previews = account.of("train"), account.of("preview")
    if not train:
        return None
    figure, panels = _figure("progress", 3, 5.2, sharex=True, height_ratios=(3, 2, 2))
    steps = [row["step"] for row in train]
    panels[0].plot(steps, [_number(row["psnr"]) for row in train], color=_BLUE, lw=1, label="photographs of the steps")
    if held := [(row["step"], row["test_psnr"]) for row in previews if row["test_psnr"] is not None]:
        panels[0].plot(*zip(*held, strict=True), "o-", color=_RED, ms=4, lw=1.2, label="held-out views")
    panels[0].set_ylabel("PSNR, dB")
    panels[1].plot(steps, [_number(row["loss"]) for row in train], color=_BLUE, lw=1)
    panels[1].set(ylabel="loss", ylim=(0, None))
    panels[2].plot(steps, [row["gaussians"] for row in train], color=_BLUE, lw=1, label="all")
    if moving := [(row["step"], row["moving"] * row["gaussians"]) for row in train if _is_number(row.get("moving"))]:
        panels[2].plot(*zip(*moving, strict=True), color=_GREEN, lw=1, label="moving")
        panels[2].legend(frameon=False)
    panels[2].set(ylabel="Gaussians", xlabel="step", ylim=(0, None))
    panels[2].yaxis.set_major_formatter("{x:,.0f}")
    picks = [] if account.selection is None else account.selection["picks"]
    for panel in panels:
        for number, step in enumerate(sorted({pick["step"] for pick in picks})):
            panel.axvline(step, color=_GRAY, lw=0.7, ls=":", label="a view is added" if number == 0 else None)
    panels[0].legend(frameon=False)
    return _svg(figure, "progress")


def score_bars(picks: Sequence[Mapping[str, Any]]) -> str | None:
    """One row a pick: the share of each parameter group in its score, and the candidates' scores relative to the best.

    Args:
        picks: Picks of selection.json; those without a score are left out.
    Returns:
        None where no pick has a score.
    """
    shown = [pick for pick in picks if pick["score"] is not None][-_MOST_BARS:]
    if not shown:
        return None
    names = list(dict.fromkeys(name for pick in shown for name in pick["parts"]))
    columns = 2 if names else 1
    figure, panels = _figure("scores", 1, 1.1 + 0.26 * len(shown), columns, sharey=True)
    rows = np.arange(len(shown))
    if names:
        _part_bars(panels[0], shown, names)
    axis = panels[-1]
    for row, pick in zip(rows, shown, strict=True):
        values = np.array([c["score"] for c in pick["candidates"] if c["score"] is not None], float)
        scale = max(abs(pick["score"]), 1e-300)  # a score of 0 is drawn at 0
        axis.plot(values / scale, np.full(len(values), row), "|", color=_GRAY, ms=9)
        axis.plot(pick["score"] / scale, row, "o", color=_RED, ms=4)
    axis.set(xlabel="scores / the picked one's (red)", ylim=(len(shown) - 0.5, -0.5))
    panels[0].set_yticks(rows, [f"{pick['number']}  {_plain(pick['name'])}" for pick in shown])
    return _svg(figure, "scores")


def _part_bars(axis: Axes, picks: Sequence[Mapping[str, Any]], names: Sequence[str]) -> None:
    """Stacked shares of the parts of each score; negative ones, of z-scores, to the left."""
    import matplotlib

    table = np.array([[pick["parts"].get(name) or 0.0 for name in names] for pick in picks], float)
    table /= np.maximum(np.abs(table).sum(1, keepdims=True), 1e-300)  # a score without parts has bars of length 0
    ends = {True: np.zeros(len(picks)), False: np.zeros(len(picks))}
    colors = matplotlib.colormaps["tab10"].colors  # type: ignore[attr-defined]  # the stubs have the base class only
    for number, (name, share) in enumerate(zip(names, table.T, strict=True)):
        left = np.where(share >= 0, ends[True], ends[False])
        axis.barh(
            np.arange(len(picks)), share, left=left, color=colors[number % len(colors)], label=_plain(name), height=0.72
        )
        ends[True] += np.maximum(share, 0)
        ends[False] += np.minimum(share, 0)
    axis.set_xlabel("share of the score")
    axis.legend(frameon=False, fontsize=7, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def camera_map(
    groups: Mapping[str, Sequence[Camera]],
    picked: Sequence[tuple[Camera, str]],
    ways: Sequence[tuple[Camera, np.ndarray, str]] = (),
) -> str | None:
    """A map of where cameras stand and where they look, seen from above.

    Args:
        groups: Name -> cameras: `start` or `fitted`, `not picked`, `held out`; drawn in this order.
        picked: Cameras that were chosen on the way, with the text beside each.
        ways: Cameras of next photographs, each with where to go to it from (3,), and the text beside it.
    Returns:
        None without cameras.
    """
    cameras = [camera for group in groups.values() for camera in group] + [camera for camera, _ in picked]
    cameras += [camera for camera, *_ in ways]
    if not cameras:
        return None
    centers = np.array([camera.center for camera in cameras], float)
    origin = origin_near(centers.mean(0), scene_extent(cameras))
    centers -= origin
    groups = {name: [camera.relative_to(origin) for camera in group] for name, group in groups.items()}
    picked = [(camera.relative_to(origin), text) for camera, text in picked]
    ways = [(camera.relative_to(origin), start - origin, text) for camera, start, text in ways]
    up = -np.mean([camera.c2w[:3, 1] for camera in cameras], axis=0)
    axes = _ground_axes(up, centers)
    reach = max(float(np.ptp(centers @ axes.T, axis=0).max()), 1e-9) * 0.06  # of one camera, too, there is a length
    figure, (axis,) = _figure("cameras", 1, 4.6)
    styles = {
        "start": ("s", _BLUE, 1.0),
        "fitted": ("o", _BLUE, 1.0),
        "not picked": ("o", _GRAY, 0.6),
        "held out": ("D", _GREEN, 1.0),
    }
    for name, group in groups.items():
        _mark_cameras(axis, group, axes, reach, styles[name], f"{name} ({len(group)})")
    _mark_cameras(axis, [x for x, _ in picked], axes, reach, ("o", _RED, 1.0), f"picked, in order ({len(picked)})")
    _mark_cameras(axis, [x for x, *_ in ways], axes, reach, ("^", _RED, 1.0), f"to be taken next ({len(ways)})")
    for camera, start, text in ways:
        place = axes @ camera.center
        arrow = {"arrowstyle": "->", "color": _RED, "lw": 1.2, "shrinkA": 3, "shrinkB": 3}
        axis.annotate("", tuple(place), xytext=tuple(axes @ start), arrowprops=arrow)
        axis.annotate(text, tuple(place), xytext=(5, 5), textcoords="offset points", color=_RED, fontsize=8)
    texts: dict[tuple[float, float], list[str]] = {}  # a camera may be picked at several times
    for camera, text in picked:
        x, y = np.round(axes @ camera.center / reach, 6) * reach
        texts.setdefault((float(x), float(y)), []).append(text)
    for place, found in texts.items():
        text = _plain(", ".join(found))
        axis.annotate(text, place, xytext=(4, 4), textcoords="offset points", color=_RED, fontsize=8)
    axis.set_aspect("equal", "datalim")
    zero = f", around {origin_text(origin)}" if origin.any() else ""
    axis.set(xlabel=f"from above{zero}; ticks are lengths of the data set")
    axis.margins(0.12)
    axis.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, 1.16), ncols=2)
    return _svg(figure, "cameras")


def _mark_cameras(
    axis: Axes, cameras: Sequence[Camera], axes: np.ndarray, reach: float, style: tuple[str, str, float], name: str
) -> None:
    """Marks of cameras, each with a line the way it looks; the style is marker, color and opacity."""
    if not cameras:
        return
    marker, color, opacity = style
    places = np.array([axes @ camera.center for camera in cameras])
    ways = np.array([axes @ camera.c2w[:3, 2] for camera in cameras]) * reach
    for (x, y), (dx, dy) in zip(places, ways, strict=True):
        axis.plot([x, x + dx], [y, y + dy], color=color, lw=1, alpha=opacity, zorder=1)
    axis.plot(*places.T, marker, color=color, ms=5, alpha=opacity, label=name, zorder=2)


def _ground_axes(up: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """(2, 3) axes of the plane across `up`; of the one that cameras stand in, where they agree on no up."""
    length = float(np.linalg.norm(up))
    if length > 0.3:
        up = up / length
    else:
        up = np.linalg.svd(centers - centers.mean(0), full_matrices=True)[2][2]
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)])


def _figure(name: str, rows: int, height: float, columns: int = 1, **options: Any) -> tuple[Figure, list[Axes]]:
    import matplotlib
    from matplotlib.figure import Figure

    ratios = options.pop("height_ratios", None)
    # Ids in the SVG are hashes of this and of what they name: two charts of one page must not share them.
    with matplotlib.rc_context(_STYLE | {"svg.hashsalt": name}):
        figure = Figure(figsize=(_WIDTH, height), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False, gridspec_kw={"height_ratios": ratios}, **options)
    return figure, list(panels.ravel())


def _svg(figure: Figure, name: str) -> str:
    """The drawing without what stands before its root, for the middle of a page."""
    import matplotlib

    file = io.StringIO()
    with matplotlib.rc_context(_STYLE | {"svg.hashsalt": name}):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    return text[text.index("<svg") :]


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _plain(text: str) -> str:
    """A name with its dollar signs escaped, between which matplotlib reads formulas."""
    return (text if len(text) <= 18 else "..." + text[-15:]).replace("$", r"\$")
