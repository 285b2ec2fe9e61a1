"""The page of a run: an HTML file that loads nothing from outside, reads well on a phone, and can be printed.

Whatever a file said is text on it: Jinja escapes it, pictures are encoded anew, and the page's own policy
(Content-Security-Policy) lets a browser run nothing but the one script that is written here.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.display.progress import duration
from drgs.fitting.components.table import COMPONENTS
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.fitting.metrics import MOVING, OBJECT, renderers_table
from drgs.pages.report.pictures import Picture

if TYPE_CHECKING:
    from drgs.pages.report.account import Account

GENERATOR = "drgs report"
"""What the page says of itself: a file that does is one that may be replaced."""

_HERE = Path(__file__).parent
_DIGITS = dict.fromkeys(("psnr", "cc_psnr", *OBJECT, *MOVING), 2)
_NO_CHARTS = "Charts are left out: they need matplotlib, pip install 'drgs[report]'."


@dataclasses.dataclass(frozen=True)
class Drawings:
    """Charts and pictures of a page.

    Attributes:
        charts: Name (`progress`, `scores`, `cameras`) -> SVG, or None.
        previews: Pictures of how the fit went.
        views: Names of the views that are shown.
        photos: Name of a view -> photograph and rendering.
        semantics: Name of a view -> picture of its labels.
        maps: Name of a view -> its maps.
        stills: One camera at several times.
        stills_of: Name of that camera.
        notes: Sentences that say what is left out, and why.
    """

    charts: Mapping[str, str | None] = dataclasses.field(default_factory=dict)
    previews: Sequence[Picture] = ()
    views: Sequence[str] = ()
    photos: Mapping[str, Picture] = dataclasses.field(default_factory=dict)
    semantics: Mapping[str, Picture] = dataclasses.field(default_factory=dict)
    maps: Mapping[str, Sequence[Picture]] = dataclasses.field(default_factory=dict)
    stills: Sequence[Picture] = ()
    stills_of: str = ""
    notes: Sequence[str] = ()


def page_html(account: Account, drawings: Drawings, command: str, command_text: str) -> str:
    """The page.

    Args:
        account: Account of how the fit went.
        drawings: Charts and pictures.
        command: Command that repeats the fit.
        command_text: What the command does not repeat, if anything.
    """
    from jinja2 import Environment
    from markupsafe import Markup

    script = (_HERE / "page.js").read_text()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    metrics = account.metrics or {}
    context: dict[str, Any] = {
        "generator": GENERATOR,
        "script": Markup(script),  # ours, as the charts are: matplotlib has escaped their texts
        "script_hash": f"sha256-{digest}",
        "title": account.run.path.resolve().name or "run",
        "subtitle": _subtitle(account),
        "tiles": _tiles(account),
        "notes": [*drawings.notes, *([] if any(drawings.charts.values()) else [_NO_CHARTS])],
        "charts": {name: Markup(svg) for name, svg in drawings.charts.items() if svg},
        "previews": drawings.previews,
        "previewed": "Photograph and rendering of the first held-out view, as it came along."
        if account.record.test
        else "Photograph and rendering of the first view, as it came along.",
        "split": {"test": "Held-out", "train": "Fitted"}.get(metrics.get("split", ""), "Measured"),
        **_views(metrics, drawings),
        "renderers": renderers_table(metrics),
        "segmentation": _segmentation(metrics),
        "stills": drawings.stills,
        "stills_text": f"Camera {drawings.stills_of}, stopped where it is, at times of the sequence.",
        **_picks(account),
        "findings": [f"{finding['text']}; {finding['advice']}" for finding in account.findings],
        "places": [place["text"] for place in account.places],
        "components": [row for x in COMPONENTS.values() for row in x.report(account.config, metrics)],
        "timings": _timings(account),
        "memory": _memory(account),
        "command": command,
        "command_text": command_text,
        "configuration": _configuration(account),
        "environment": _environment(account),
    }
    context["sections"] = _sections(context)
    environment = Environment(autoescape=True, trim_blocks=True)
    return environment.from_string((_HERE / "page.html").read_text()).render(**context) + "\n"


def _sections(context: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Anchors of the sections of the page."""
    there = {
        "fit": ("How it went", context["charts"].get("progress") or context["previews"]),
        "views": ("Views", context["views"]),
        "renderers": ("Renderers", context["renderers"][2]),
        "labels": ("Labels", context["segmentation"]),
        "time": ("Over time", context["stills"]),
        "findings": ("At the next shoot", context["findings"]),
        "cameras": ("Cameras", context["charts"].get("cameras") or context["picks"] or context["places"]),
        "components": ("Besides the Gaussians", context["components"]),
        "time-spent": ("Time and memory", True),
        "repeat": ("Again", True),
    }
    return [(key, name) for key, (name, is_there) in there.items() if is_there]


def _subtitle(account: Account) -> str:
    env = account.env
    when = account.events[-1]["time"][:16].replace("T", " ") + " UTC" if account.events else "before its first step"
    by = f"drgs {env['drgs']}" + (f", commit {env['commit']}" if env.get("commit") else "") if "drgs" in env else ""
    kinds = ["active fit"] if account.record.is_active else ["fit"]
    kinds += ["with semantics"] * (account.record.semantics is not None) + ["of what moves"] * bool(
        account.record.times
    )
    return "; ".join(part for part in (f"{' '.join(kinds)} of {account.record.data}", account.state, when, by) if part)


def _tiles(account: Account) -> list[tuple[str, str]]:
    """The few numbers that a reader looks for first."""
    metrics = account.metrics
    tiles = []
    if metrics is not None:
        names = {
            "psnr_object": "PSNR of the object",
            "psnr_frame": "PSNR of the frame",
            "psnr": "PSNR",
            "cc_psnr": "color-corrected PSNR",
            "ssim": "SSIM",
            "flip": "FLIP",
            "lpips": "LPIPS",
            "psnr_moving": "PSNR of what moves",
        }
        if metrics["mean"].get("psnr_object") is not None:
            del names["psnr"]  # one of these two, by what says where the object is
        for name, text in names.items():
            if (value := metrics["mean"].get(name)) is not None:
                what = f"{text}, {metrics['count']} {metrics['split']} views"
                tiles.append((_formatted(name, value) + " dB" * (name in _DIGITS), what))
        labels = (metrics.get("segmentation") or {}).get("run") or {}
        if isinstance(labels.get("miou"), float):
            tiles.append((f"{labels['miou']:.3f}", "mIoU"))
    count = next((row["gaussians"] for row in reversed(account.of("train"))), None)
    if count is not None:
        tiles.append((f"{count:,}", "Gaussians"))
    if account.selection is not None:
        chosen = account.selection
        views = len(chosen["start"]) + len(chosen["picks"])
        tiles.append((f"{views} of {len(chosen['pool'])}", "views, the last ones picked"))
    else:
        tiles.append((str(len(account.record.train)), "views fitted to"))
    return [*tiles, (duration(_seconds(account)), "of steps")]


def _seconds(account: Account) -> float:
    return max((row["seconds"] for row in account.events if row["event"] in ("train", "done")), default=0.0)


def _formatted(name: str, value: float | None) -> str:
    return "-" if value is None else f"{value:.{_DIGITS.get(name, 3)}f}"


def _views(metrics: Mapping[str, Any], drawings: Drawings) -> dict[str, Any]:
    """Views with their pictures, and the table of all."""
    rows = {row["name"]: row for row in metrics.get("views", ())}
    views = []
    for name in drawings.views:
        psnr = rows[name].get("psnr") if name in rows else None
        text = "" if psnr is None else f"{psnr:.2f} dB"
        pictures = {"photo": drawings.photos.get(name), "semantics": drawings.semantics.get(name)}
        views.append({"name": name, "text": text, "maps": drawings.maps.get(name), **pictures})
    names = [name for name, value in metrics.get("mean", {}).items() if value is not None]
    table = [(name, *(_formatted(key, row.get(key)) for key in names)) for name, row in rows.items()]
    if rows:
        table.append(("mean", *(_formatted(key, metrics["mean"][key]) for key in names)))
    several = len(views) > 1
    text = "From the worst to the best by PSNR." if several else ""
    if drawings.maps:
        unused = "; this view's photograph is not used" if metrics["split"] == "test" else ""  # others were fitted to
        text += (
            " Expected error: how far from a photograph each pixel's color is expected to be, in units of color, by "
            "what the fit gets wrong in its own photographs, directions that none of them has, and what they leave "
            f"open{unused}. Not covered: white where no Gaussian is."
        )
    definitions = metrics.get("variants")
    listed = [(str(key), str(x)) for key, x in definitions.items()] if isinstance(definitions, dict) else []
    return {
        "views": views,
        "views_text": text,
        "metrics_head": ("view", *names),
        "metrics_rows": table,
        "definitions": listed,
    }


def _segmentation(metrics: Mapping[str, Any]) -> dict[str, Any] | None:
    """How well labels agree with their reference."""
    found = metrics.get("segmentation")
    if not isinstance(found, dict):
        return None
    names = {"pixel_accuracy": "pixel accuracy", "class_accuracy": "class accuracy", "miou": "mIoU"}
    names["miou_top7"] = "mIoU of the seven most frequent"
    rows = []
    for who in ("run", "teacher"):
        values = found.get(who)
        if isinstance(values, dict):
            numbers = [values.get(key) for key in names]
            rows.append((who, *(f"{x:.3f}" if isinstance(x, int | float) else "-" for x in numbers)))
    reference = {"labels": "the data set's labels", "teacher": "the teacher's labels, which are not the truth"}
    text = f"Compared with {reference.get(str(found.get('reference')), 'a reference')} ({found.get('folder')})."
    return {"text": text, "head": ("", *names.values()), "rows": rows} if rows else None


def _picks(account: Account) -> dict[str, Any]:
    """Table of the picks, with the held-out PSNR between them."""
    selection = account.selection
    rows = []
    if selection is None:
        return {"picks": [], "measured": []}
    for pick in selection["picks"]:
        best = max(pick["parts"].items(), key=lambda part: abs(part[1] or 0.0), default=("-", 0.0))[0]
        numbers = ["-" if x is None else f"{x:.4g}" for x in (pick["score"], pick["margin"])]
        where = f"{pick['number']}", pick["name"], best
        rows.append((*where, *numbers, f"{pick['step']:,}", len(pick["candidates"]), f"{pick['seconds']:.1f}"))
    policies = sorted({pick["policy"] for pick in selection["picks"]})
    criteria = sorted({str(pick["criterion"]) for pick in selection["picks"] if pick.get("criterion")})
    how = ", ".join([*policies, *criteria])
    leak = " Initial points are of the whole data set, views that were not picked included." * selection["pool_leak"]
    records = [x for x in selection.get("measured") or () if isinstance(x, dict) and isinstance(x.get("mean"), dict)]
    is_cut_out = any("psnr_object" in record["mean"] for record in records)
    names = (*(OBJECT if is_cut_out else ("psnr",)), "cc_psnr", "ssim", "flip")
    measured = []
    for record in records:
        values = [record["mean"].get(name) for name in names]
        measured.append((record.get("views"), *(f"{x:.3f}" if isinstance(x, int | float) else "-" for x in values)))
    head = ("", "view", "largest part", "score", "margin to the next", "step", "candidates", "seconds")
    return {
        "picks": rows,
        "picks_head": head,
        "picks_text": f"Picked by {how}.{leak}",
        "measured": measured,
        "measured_head": ("views", *names),
    }


def _timings(account: Account) -> list[tuple[str, str, str]]:
    """Name and seconds of each part of the wall time."""
    steps = _seconds(account)
    wall = account.wall
    picks = account.selection["picks"] if account.selection else []
    choosing = sum(pick["seconds"] for pick in picks)
    per_step = 1000 * steps / max(account.step, 1)
    rows = [(f"steps ({per_step:.0f} ms each)", steps)]
    if choosing:
        rows.append((f"scores of candidates ({choosing / len(picks):.1f} s a pick)", choosing))
    rows.append(("photographs, points, pictures, checkpoints, measuring", max(wall - steps - choosing, 0.0)))
    share = lambda x: f"{x / wall:.0%}" if wall > 0 else "-"  # noqa: E731
    return [(name, f"{x:.1f}", share(x)) for name, x in rows] + [("all", f"{wall:.1f}", share(wall))]


def _memory(account: Account) -> str:
    peaks = [row["peak_memory"] for row in account.of("done") if isinstance(row.get("peak_memory"), int)]
    threads = account.env.get("threads")
    text = f"Peak memory of the process: {max(peaks) / 1e9:.2f} GB. " if peaks else ""
    if isinstance(threads, dict) and isinstance(threads.get("drjit"), int):
        text += f"{threads['drjit']} threads of Dr.Jit on {account.env.get('cpu')}."
    return text


def _configuration(account: Account) -> list[tuple[str, str, bool]]:
    """Name, value and whether it is not the default, of every field."""
    config = account.record.config
    usual = FitConfig() if config.selection is None else FitConfig(selection=SelectionConfig())
    return _rows("", config.to_json(), usual.to_json())


def _rows(way: str, fields: dict, usual: dict) -> list[tuple[str, str, bool]]:
    """Rows of a nested record: its innermost fields by their paths."""
    rows = []
    for name, value in fields.items():
        if isinstance(value, dict) and isinstance(usual[name], dict) and usual[name]:
            rows += _rows(f"{way}{name}.", value, usual[name])
        elif name != "selection":
            rows.append((way + name, _text(value), value != usual[name]))
    return rows


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _environment(account: Account) -> list[tuple[str, str]]:
    """env.json, a line a field, without where else an LLVM was found."""
    rows = []
    for name, value in account.env.items():
        if isinstance(value, dict):
            inner = {key: x for key, x in value.items() if not isinstance(x, list | dict) and x is not None}
            rows.append((name, ", ".join(f"{key} {_plain(x)}" for key, x in inner.items())))
        elif value is not None and not isinstance(value, list):
            rows.append((name, _plain(value)))
    return rows


def _plain(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) and math.isfinite(value) else str(value)
