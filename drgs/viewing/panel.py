"""HTML of the browser's panel: whatever came from a file is escaped here.

viser puts HTML into its page as it is, and Markdown may hold HTML: nothing else of this room makes either.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from drgs.display.pictures import inferno
from drgs.viewing.placed_views import PlacedView, Sight, scale_colors, score_colors

if TYPE_CHECKING:
    from drgs.viewing.layers import ColorScale
    from drgs.viewing.subject import Subject

_STYLE = "font-size:0.8em;line-height:1.5;padding:0.2em 0.9em;overflow-wrap:anywhere"
_STEPS = 9  # colors of a scale


def header(subject: Subject) -> str:
    """HTML of the subject's name and size."""
    rows = [f"<b>{escape(subject.name)}</b>", f"{subject.count:,} Gaussians"]
    rows += [escape(subject.state)] if subject.state else []
    rows += [f"<i>{escape(note)}</i>" for note in subject.notes]
    return _block("drgs-header", rows)


def status(text: str, scale: ColorScale | None = None) -> str:
    """HTML of the current job or picture, with its color scale."""
    rows = [escape(text) or "&nbsp;"]
    if scale is not None:
        shares = np.linspace(0, 1, _STEPS)
        rows.append(f"{scale.dark:.3g} {_gradient(inferno(shares[None])[0])} {scale.bright:.3g} {escape(scale.of)}")
    return _block("drgs-status", rows)


def legend(placed_views: Sequence[PlacedView], title: str) -> str:
    """HTML of the meaning of cameras' colors."""
    colors, ends = score_colors(placed_views)
    kinds = {placed.kind: color for placed, color in zip(placed_views, colors, strict=True)}
    rows = [f"{_swatch(kinds['training'])} fitted to"] if "training" in kinds else []
    rows += [f"{_swatch(kinds['held out'])} not fitted to, no score"] if "held out" in kinds else []
    if ends is not None:
        bar = _gradient(scale_colors(_STEPS))
        rows.append(f"candidates by score ({escape(title)})<br>{ends[0]:.4g} {bar} {ends[1]:.4g}")
    return _block("drgs-legend", rows or ["no cameras"])


def photograph(placed: PlacedView, sight: Sight) -> str:
    """HTML of a place: its name, what it was used for, its score and the parts of that."""
    camera = sight.camera
    rows = [f"<b>{escape(camera.name)}</b>"]
    used = {"training": "fitted to", "held out": "not fitted to", "candidate": "candidate"}[placed.kind]
    size = f"{camera.width}x{camera.height}"
    rows.append(f"{used}, {size}" + ("" if camera.time is None else f", time {camera.time:g}"))
    if sight.way is not None:
        rows.append(escape(sight.way.text))
    if sight.pick is not None:
        rows.append(f"pick {sight.pick}")
    if sight.score is None:
        rows.append("no score")
    else:
        score = sight.score
        rows.append(f"score {score.total:.4g}, rank {score.rank} of {score.of}")
        largest = max((abs(x) for x in score.parts.values()), default=0.0) or 1.0
        for name, part in sorted(score.parts.items(), key=lambda item: -item[1]):
            wide = 7 * abs(part) / largest
            bar = f'<span style="display:inline-block;height:0.7em;width:{wide:.2f}em;background:#4287f5"></span>'
            rows.append(f"{escape(name)} {part:.3g} {bar}")
    if sight.photograph is None:
        rows.append("no photograph")
    return _block("drgs-photograph", rows)


def _block(name: str, rows: list[str]) -> str:
    return f'<div id="{name}" style="{_STYLE}">' + "<br>".join(rows) + "</div>"


def _gradient(colors: Sequence[Sequence[int]] | np.ndarray) -> str:
    shown = ", ".join(_css(color) for color in colors)
    size = "display:inline-block;width:7em;height:0.8em"
    return f'<span style="{size};background:linear-gradient(to right, {shown})"></span>'


def _css(color: Sequence[int] | np.ndarray) -> str:
    return f"rgb({color[0]},{color[1]},{color[2]})"


def _swatch(color: Sequence[int]) -> str:
    return f'<span style="display:inline-block;width:0.9em;height:0.9em;background:{_css(color)}"></span>'
