"""How much of the difference between INRIA's or gsplat's rasterizer and exact ray tracing each approximation explains.

    python benchmarks/ladder.py [--scenes wolf office] [--run runs/ladder-office] [--fovs 20 45 70 95 120] [--page]

`wolf` is a published capture of an object, seen from an orbit whose distance shrinks as the field of view grows, so
that the object fills every picture; `office` is a fit (made where there is none), seen by its photographs' cameras with
another focal length. Results go to docs/ladder.md (a table), docs/data/ladder.csv (every step), docs/pictures/
ladder.png and benchmarks/ladder.json; what is in the JSON is not measured again. The wolf is also drawn with more
pixels, without crops.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import studies
from pages import fill_between
from studies import ROOT

import drgs
from drgs.cameras import intrinsics_from_fov
from drgs.cameras.sizes import at_most
from drgs.commands.orbits import OrbitShape, scene_orbit
from drgs.commands.viewpoints import evenly
from drgs.data import load
from drgs.files import Run, atomic_write
from drgs.fitting.records import fit_record
from drgs.lab.ladder import Pictures, ladder
from drgs.lab.parameters import PARAMETERS
from drgs.settings import RenderSettings
from drgs.studies.tables import markdown_table, paragraph

FOVS = (20, 45, 70, 95, 120)
STARTS = ("inria", "gsplat")
PIXELS = 19_200  # 160 x 120
VIEWS = 3
CROP = {"wolf": 16, "office": 24}
SHOWN = "inria"  # in the figure
FULL = 70  # degrees: the field of view at which wolf gets more pixels
WIDTHS = (160, 320, 640, 1280)
TABLED = (70, 120)  # degrees, of the table on the page
ROWS = {
    "dilation": ("dilation",),
    "EWA linearization": ("EWA",),
    "one depth a Gaussian (key and order)": ("depth key", "order"),
    "near plane": ("near plane",),
    "cut-offs, early stop, culling": ("alpha cut-offs", "early stop", "culling"),
}
"""Steps of the table, some of them taken together: shares add up."""
COLORS = {
    "near plane": "#7f7f7f",
    "culling": "#bcbd22",
    "alpha cut-offs": "#17becf",
    "early stop": "#8c564b",
    "dilation": "#1f77b4",
    "EWA": "#d62728",
    "depth key": "#ff7f0e",
    "order": "#2ca02c",
}
LABELS = {
    "near plane": "near plane",
    "EWA": "EWA linearization",
    "order": "order by center, not by ray",
    "depth key": "depth key z, not distance",
}
BEYOND = (
    ("far", "response", "beyond exact, crops: response peak to integral", "--"),
    ("far", "volume", "beyond exact, crops: sorted to true volume", ":"),
    ("crops", "float32", "float32 to float64, crops", "-."),
)


def wolf(fov: float, width: int = 160) -> tuple:
    """(Gaussians, cameras, background)."""
    g = drgs.load_ply(studies.DATA / "splats" / "wolf" / "wolf.ply")
    size = {"width": width, "height": width * 3 // 4}
    return g, scene_orbit(g, VIEWS, fixed=OrbitShape(fov=fov), **size), (0.0, 0.0, 0.0)


def office(fov: float, path: Path) -> tuple:
    """(Gaussians, cameras, background)."""
    if not (path / "point_cloud.ply").is_file():
        command = [sys.executable, "-m", "drgs", "fit", studies.DATA / "office", "-o", path, "--max-steps", "600"]
        command += ["--max-pixels", "20000", "--max-gaussians", "15000"]
        subprocess.run(list(map(str, command)), cwd=ROOT, check=True)
    run = Run(path)
    views = load(Path(run.config()["data"]), lazy=True, points=False).views
    cameras = [at_most(view.camera.undistorted(), PIXELS) for view in evenly(views, VIEWS)]
    cameras = [dataclasses.replace(c, K=intrinsics_from_fov(fov, c.width, c.height)) for c in cameras]
    return drgs.load_ply(path / "point_cloud.ply"), cameras, fit_record(run).config.settings.background


def measure(scene: tuple, crop: int) -> dict:
    """A report a start."""
    g, cameras, background = scene
    pictures = Pictures(g, cameras, crop)
    found = {}
    for name in STARTS:
        start = RenderSettings.preset(name, background=background)
        found[name] = rounded(ladder(g, cameras, start, pictures=pictures))
    return {**found, "sigma": sigma(g, cameras[0])}


def sigma(g, camera) -> float:
    """Median of the largest standard deviation of a Gaussian, in pixels at its depth; those in the picture."""
    pixels, z = camera.project(g.means.double().numpy() + g.origin)
    seen = (z > 0) & (pixels >= 0).all(1) & (pixels <= (camera.width, camera.height)).all(1)
    return float(np.median(g.scales.amax(1).double().numpy()[seen] * camera.K[0, 0] / z[seen]))


def rounded(x):
    """Five digits are enough for a page."""
    if isinstance(x, dict):
        return {k: rounded(v) for k, v in x.items()}
    if isinstance(x, list):
        return [rounded(v) for v in x]
    return float(f"{x:.5g}") if isinstance(x, float) and math.isfinite(x) else x


def write(path: Path, result: dict) -> None:
    """JSON, atomically, a line a report: the whole of it is long."""
    text = json.dumps(result, separators=(",", ":"))
    for name in STARTS:
        text = text.replace(f'"{name}":', f'\n"{name}":')
    with atomic_write(path) as file:
        file.write(text.encode() + b"\n")


def plot(result: dict, path: Path) -> None:
    """A row a scene: size of every step, shares of the image's difference, of two groups' gradients."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    rows = [(f"{scene}", "horizontal field of view, degrees", result[scene]) for scene in result["order"]]
    rows += [(f"wolf, {FULL} degrees", "width of the image, pixels", result["widths"])] if result["widths"] else []
    height = 4.1 * len(rows) + 1.1
    figure, axes = plt.subplots(len(rows), 4, figsize=(15.5, height), squeeze=False)
    titles = (
        "size of each step (RMS of the image)",
        "share of the difference of the image",
        "... of the gradient, means",
        "... of the gradient, log-scales",
    )
    reads = (
        lambda row: row["share"],
        lambda row: row["gradient"]["means"]["share"],
        lambda row: row["gradient"]["log_scales"]["share"],
    )
    for row, (name, across, found) in zip(axes, rows, strict=True):
        places = sorted(map(int, found))
        reports = [found[str(place)][SHOWN] for place in places]
        lines(row[0], places, reports)
        for axis, read in zip(row[1:], reads, strict=True):
            bars(axis, places, reports, read)
        for axis, title in zip(row, titles, strict=True):
            axis.set_xlabel(across)
            if name == rows[0][0]:
                axis.set_title(title, fontsize=12)
        row[0].set_ylabel(f"{name}: {SHOWN} to exact", fontsize=13)
    handles = [Patch(color=color, label=LABELS.get(name, name)) for name, color in COLORS.items()]
    handles += [
        Line2D([], [], color="black", alpha=0.25, lw=6, label="all of it"),
        *(Line2D([], [], color="black", lw=1.2, ls=style, label=label) for _, _, label, style in BEYOND),
    ]
    note = "Bars: left in the stated order, right in the reverse. Lines: the order in which the step is larger."
    figure.text(0.5, 0.985, note, ha="center", va="top", fontsize=10)
    figure.legend(handles=handles, ncol=4, loc="lower center", fontsize=10, frameon=False)
    figure.tight_layout(rect=(0, 0.95 / height, 1, 0.98))
    figure.savefig(path, dpi=90)


def lines(axis, places: list, reports: list) -> None:
    """RMS of every step, of the order in which it is larger."""
    x = range(len(places))
    for name, color in COLORS.items():
        rows = [[r for o in ("forward", "reverse") for r in y["image"][o] if r["rung"] == name] for y in reports]
        axis.plot(x, [max((r["rms"] for r in y), default=0) or np.nan for y in rows], "-o", color=color, ms=3.5, lw=1.6)
    axis.plot(x, [y["image"]["total"]["rms"] for y in reports], color="black", alpha=0.25, lw=6, zorder=1)
    for part, name, _, style in BEYOND:
        if all(part in y for y in reports):
            axis.plot(x, [rms(y[part], "forward", name) for y in reports], color="black", lw=1.2, ls=style)
    axis.set(yscale="log", ylim=(1e-8, 0.5))
    axis.set_xticks(x, places)
    axis.grid(axis="y", lw=0.3)


def bars(axis, fovs: list, reports: list, read) -> None:
    """Stacked shares, both orders side by side; what is negative hangs below 0."""
    for i, order in enumerate(("forward", "reverse")):
        place = [k + (i - 0.5) * 0.42 for k in range(len(fovs))]
        top, bottom = [0.0] * len(fovs), [0.0] * len(fovs)
        for name, color in COLORS.items():
            found = [{r["rung"]: read(r) for r in x["image"][order]}.get(name) or 0.0 for x in reports]
            base = [t if x >= 0 else b for x, t, b in zip(found, top, bottom, strict=True)]
            axis.bar(place, found, 0.38, bottom=base, color=color, lw=0)
            top = [t + max(x, 0) for x, t in zip(found, top, strict=True)]
            bottom = [b + min(x, 0) for x, b in zip(found, bottom, strict=True)]
    axis.axhline(0, color="black", lw=0.8)
    axis.axhline(1, color="black", lw=0.5, ls=":")
    axis.set_xticks(range(len(fovs)), fovs)
    axis.yaxis.set_major_formatter(lambda x, _: f"{100 * x:.0f} %")


def percent(x: float) -> str:
    """Whole percents, one digit below 10."""
    x = 0.0 if abs(x) < 5e-4 else x
    return f"{100 * x:.{0 if abs(x) >= 0.0995 or not x else 1}f}"


def page(result: dict, made: str) -> str:
    """The generated part of docs/ladder.md: the largest steps of some reports."""
    shown = [(scene, str(fov), "°", result[scene]) for scene in result["order"] for fov in TABLED]
    shown += [(f"wolf {FULL}°,", str(width), " px", result["widths"]) for width in WIDTHS[-1:]]
    shown = [one for one in shown if one[1] in one[3]]
    reports = [found[place][SHOWN] for _, place, _, found in shown]
    heads = ["share of the image difference, %", *(f"{name} {place}{unit}" for name, place, unit, _ in shown)]
    lines = [[name, *(shares(report, steps) for report in reports)] for name, steps in ROWS.items()]
    totals = [report["image"]["total"] for report in reports]
    lines.append(["**RMS of the difference**", *(f"{total['rms']:.1e}" for total in totals)])
    for group in ("means", "log_scales"):
        cells = [percent(total["gradient"][group]["of_exact"]) for total in totals]
        lines.append([f"gradient of `{group}`: difference / `exact`, %", *cells])
    return f"{paragraph(f'{made} {apart(result)}')}\n\n{markdown_table(heads, lines)}"


def shares(report: dict, steps: tuple[str, ...]) -> str:
    """The share of some steps together, in the stated order / in the reverse."""
    found = [
        sum(row["share"] for row in report["image"][order] if row["rung"] in steps) for order in ("forward", "reverse")
    ]
    return "/".join(dict.fromkeys(map(percent, found)))


def apart(result: dict) -> str:
    """How far the other rasterizer's image shares and sizes are from those that are shown."""
    worst = off = 0.0
    places = [x for part in (*(result[scene] for scene in result["order"]), result["widths"]) for x in part.values()]
    for a, b in ([x[start]["image"] for start in STARTS] for x in places):
        off = max(off, abs(b["total"]["rms"] / a["total"]["rms"] - 1))
        for order in ("forward", "reverse"):
            rows = [{r["rung"]: r["share"] for r in x[order]} for x in (a, b)]
            worst = max(worst, *(abs(rows[0].get(n, 0.0) - rows[1].get(n, 0.0)) for n in {**rows[0], **rows[1]}))
    return f"From `{STARTS[1]}` every share is within {100 * worst:.1f} points, the RMS within {100 * off:.1f} %."


def data(result: dict) -> list[list[str]]:
    """The data file: every step of every report, its share, and its norm over that of `exact`; groups are gradients."""
    out = [["scene", "width", "fov", "start", "part", "order", "step", "rms", "max", "share", "of_exact"]]
    out[0] += [f"{group}_{what}" for group in PARAMETERS for what in ("share", "of_exact")]
    places = [(scene, 160, int(fov), x) for scene in result["order"] for fov, x in result[scene].items()]
    places += [("wolf, one view", int(width), FULL, x) for width, x in result["widths"].items()]
    for scene, width, fov, found in sorted(places, key=lambda place: place[:3]):
        for start in STARTS:
            report = found[start]
            steps = [("asides", "", row) for row in report["asides"]]
            for part in ("image", "crops", "far"):
                for order in ("forward", "reverse") if part in report else ():
                    steps += [(part, order, row) for row in report[part].get(order, [])]
                if part in report:
                    steps.append((part, "", {"rung": "total", **report[part]["total"]}))
            for part, order, row in steps:
                numbers = [row["rms"], row["max"], row.get("share"), row.get("of_exact")]
                for group in PARAMETERS:
                    numbers += [row["gradient"][group].get(key) for key in ("share", "of_exact")]
                cells = ["" if x is None else f"{x:.3g}" for x in numbers]
                out.append([scene, str(width), str(fov), start, part, order, row["rung"], *cells])
    return out


def rms(part: dict, order: str, name: str) -> float:
    """RMS of one rung."""
    return next(row["rms"] for row in part[order] if row["rung"] == name)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", nargs="+", default=["wolf", "office"])
    parser.add_argument("--fovs", nargs="+", type=int, default=list(FOVS))
    parser.add_argument("--run", type=Path, default=ROOT / "runs" / "ladder-office", help="a fit of the office")
    parser.add_argument("--page", action="store_true", help="the page of the results that there are")
    args = parser.parse_args()
    store = ROOT / "benchmarks" / "ladder.json"
    result = studies.read_rows(store, {"made": "", "scenes": {}, "widths": {}})
    plan = [(result["scenes"].setdefault(name, {}), name, fov, 160) for name in args.scenes for fov in args.fovs]
    if "wolf" in args.scenes:
        plan += [(result.setdefault("widths", {}), "wolf", FULL, width) for width in WIDTHS]
    for rows, name, fov, width in [] if args.page else plan:
        widths = rows is result["widths"]
        key = str(width if widths else fov)
        if key in rows:
            continue
        begin = time.perf_counter()
        scene = wolf(fov, width) if name == "wolf" else office(fov, args.run)
        if widths:
            scene = scene[0], scene[1][:1], scene[2]
        rows[key] = measure(scene, 0 if widths else CROP[name])
        result["made"] = studies.stamp("ladder")
        write(store, result)
        print(f"{name}, {fov} degrees, {width} pixels: {time.perf_counter() - begin:.0f} s", flush=True)
    found = {**result["scenes"], "widths": result["widths"], "order": [x for x in CROP if result["scenes"].get(x)]}
    studies.write_csv(ROOT / "docs" / "data" / "ladder.csv", data(found))
    plot(found, ROOT / "docs" / "pictures" / "ladder.png")
    fill_between(ROOT / "docs" / "ladder.md", "ladder", page(found, result["made"]))


if __name__ == "__main__":
    main()
