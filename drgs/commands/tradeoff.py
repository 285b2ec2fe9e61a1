"""`drgs tradeoff`: what every accuracy/speed setting costs and gives, on a user's own scene and views.

Truth is preset `exact`, with the user's --set and background; its own error is measured against the float64 oracle on a
sample of pixels and added to every other one before a budget is compared with it. Errors of a setting:

    image        absolute, of all values of all views: RMS, 99.9th percentile, largest; PSNR for peak 1
    gradient     of <u, image>, u = +-1 at random (then the expected squared error of J^T u is that of the Jacobian in
                 the Frobenius norm): relative L2 over all views, by parameter group and of all together
    information  diagonal of J^T J: relative L1 over all views, and the median of the relative errors of the entries
                 above 1e-6 of the largest, by group

A budget binds, of the image, the larger of RMS and 99.9th percentile (not the largest: where two Gaussians tie, either
order is right, and single pixels jump); of gradient and information, the worst group (all together is the group with
the largest unit); of information, the larger of L1 and median.

Times are medians over rounds in which all settings take turns on one view, everything included; ratios are to `exact`
in the same round. Errors, and a first look at all times, are of reduced views; the leading settings are timed again on
views as large as they are drawn (tradeoff_full.py), and advice follows from these (tradeoff_advice.py). With one thread
it is the processor's time, else the clock's. What would take minutes (Mitsuba's
traversal without cut-offs, the oracle) is measured on a sample of rays, once, and its time scaled to the image.
"""

from __future__ import annotations

import datetime
import math
from pathlib import Path
from typing import TYPE_CHECKING

from drgs import runtime
from drgs.commands.given import Given
from drgs.commands.viewpoints import check_counts, seen_views
from drgs.data.camera_lists import described
from drgs.data.sizes import at_most
from drgs.display import tables
from drgs.display.progress import Bar
from drgs.files import SCHEMA, atomic_write, write_json
from drgs.guards.outputs import claim, replacing
from drgs.lab.tradeoff import measure
from drgs.lab.tradeoff_advice import USES, recommend
from drgs.lab.tradeoff_full import measure_full
from drgs.lab.tradeoff_rows import VARIANTS

if TYPE_CHECKING:
    from drgs.commands.options import Tradeoff

__all__ = ["run"]


def run(args: Tradeoff) -> None:
    """`drgs tradeoff SCENE`."""
    if args.preset != "exact":
        raise ValueError(f"--preset must be exact, which the others are compared with, got {args.preset}; drop it")
    if not args.max_error or not all(0 < x < math.inf for x in args.max_error):
        got = " ".join(f"{x:g}" for x in args.max_error) or "none"
        raise ValueError(f"--max-error must be finite numbers > 0, got {got}; correct it")
    if not 1 <= args.seconds <= 1e6:
        raise ValueError(f"--seconds must be in [1, 1000000], got {args.seconds:g}; correct it")
    if not 1 <= args.repeats <= 1000:
        raise ValueError(f"--repeats must be in [1, 1000], got {args.repeats}; correct it")
    check_counts(args)
    names = ["tradeoff.json", "tradeoff.md", "tradeoff.png"]
    claim(args.output, "tradeoff", names, inputs=[args.scene, args.cameras or ""])
    given = Given.of(args)
    gaussians, fields = given.gaussians, given.fields
    if not len(gaussians):
        raise ValueError(f"{args.scene}: must hold at least one Gaussian, holds none; give another scene")
    cameras, source = seen_views(args, given)
    reduced = [at_most(camera, args.max_pixels) for camera in cameras]
    turns = (args.repeats + 1) * (1 + sum(x.by == "view" for x in VARIANTS))
    with Bar("tradeoff", turns, not args.quiet) as bar:
        measured = measure(gaussians, reduced, VARIANTS, fields, args.repeats, args.seed, bar.advance)
    with Bar("tradeoff", show=not args.quiet) as bar:
        say = lambda label: bar.update(0, label=f"tradeoff, {label}")  # noqa: E731
        budget = args.repeats, args.seconds, args.seed
        full = measure_full(measured, gaussians, cameras, args.max_error, *budget, say)
    for row, variant in zip(measured["rows"], VARIANTS, strict=True):
        row["flags"] = None if variant.by == "oracle" else variant.flags(args.overrides)
    report = {
        "schema": SCHEMA,
        "command": "tradeoff",
        "scene": str(args.scene),
        "gaussians": len(gaussians),
        "source": source,
        "views": [described(camera) for camera in reduced],
        "full": full,
        "fields": fields,
        "seed": args.seed,
        "budgets": list(args.max_error),
        **measured,
        "recommended": [pick for use in USES for pick in recommend(measured, use, args.max_error)],
        "date": datetime.date.today().isoformat(),
        "env": runtime.info(),
    }
    drawn = _plot(report, args.output / "tradeoff.png")
    with atomic_write(args.output / "tradeoff.md") as file:
        file.write(_page(report, drawn).encode())
    write_json(args.output / "tradeoff.json", report)
    if not args.quiet:
        _print(report)
        files = "tradeoff.json, tradeoff.md" + (", tradeoff.png" if drawn else "")
        print(f"{files}: {args.output}", flush=True)
        if not drawn:
            print("no plot: matplotlib is not installed; pip install 'drgs[report]'")


# ----------------------------------------------------------------------------------------- outputs


def _print(report: dict) -> None:
    """Tables for a terminal."""
    title = f"time and error relative to exact: {report['gaussians']} Gaussians, {len(report['views'])} views"
    rows = []
    for row in report["rows"]:
        if row["skipped"] is None:
            errors = row["errors"] if row["by"] != "oracle" else {**row["errors"], **report["own"]}
            times = (_time(row, key) for key in ("forward", "forward_backward", "fisher"))
            numbers = (_number(errors[key], ".0e") for key in ("image", "gradient", "information"))
            rows.append((row["name"], row["kind"].replace("approximation", "approx."), *times, *numbers))
    times = ("forward", "+backward", "Fisher")
    errors = ("image", "gradient", "Fisher")
    columns = ("setting", "kind", *(f"time\n{x}" for x in times), *(f"error\n{x}" for x in errors))
    tables.show(f"{title} ({report['source']})", columns, rows, texts=("kind",))
    for line in _notes(report):
        print(line)
    for line in _full_lines(report):
        print(line)
    print("\nFastest within a budget:")
    for pick in report["recommended"]:
        print("  " + _advice(pick))


def _page(report: dict, drawn: bool) -> str:
    """tradeoff.md."""
    env, cameras = report["env"], report["views"]
    threads = env["threads"]["drjit"]
    lines = [
        f"{report['gaussians']:,} Gaussians, {len(cameras)} views of {cameras[0]['width']}x{cameras[0]['height']} "
        f"({report['source']}); {env['cpu']}, {threads} threads, {env['backend']['variant']}, {report['date']}, "
        f"commit {env['commit']}; times are relative to exact ({report['clock']} time, {report['rounds']} rounds).",
        "Rows of kind `model` compute something else than exact does: theirs are differences, not errors.",
        "",
        "| setting | kind | forward | + backward | Fisher | first call s | image RMS | 99.9 % | max | PSNR dB "
        "| gradient, all | worst group | Fisher L1 | median | worst group |",
        "|---|---|" + "---:|" * 9 + "---|---:|---:|---|",
    ]
    for row in report["rows"]:
        if row["skipped"] is not None:
            continue
        image, slope, information = (row[key] or {} for key in ("image", "gradient", "information"))
        cells = [
            *(_time(row, key) for key in ("forward", "forward_backward", "fisher")),
            _number(row["first_call"], ".1f"),
            *(_number(image.get(key), ".1e") for key in ("rms", "p999", "max")),
            _number(image.get("psnr"), ".1f"),
            _number(slope.get("all"), ".1e"),
            f"{_number(slope.get('worst'), '.1e')} {slope.get('group') or ''}".strip(),
            *(_number(information.get(key), ".1e") for key in ("l1", "median")),
            information.get("group") or "-",
        ]
        lines.append(f"| {row['name']} | {row['kind']} | " + " | ".join(cells) + " |")
    lines += ["", *(f"- {line}" for line in _notes(report)), ""]
    lines += [*_full_table(report), ""]
    lines += ["| use | budget | fastest setting within it | time | error |", "|---|---|---|---|---|"]
    for pick in report["recommended"]:
        found = f"{pick['reason']} | | "
        if pick["name"]:
            why = f" ({pick['reason']})" if pick["reason"] else ""
            found = f"`{pick['flags']}`{why} | {_span(pick)} | {pick['error']:.1e}"
        lines.append(f"| {pick['use']} | {pick['budget']:g} | {found} |")
    if drawn:
        lines += ["", "![error against time](tradeoff.png)"]
    return "\n".join(lines) + "\n"


def _notes(report: dict) -> list[str]:
    """What the numbers do not say."""
    exact, own = report["rows"][0], report["own"]
    seconds = exact["seconds"]
    took = [_milliseconds(seconds[key]) for key in ("forward", "forward_backward", "fisher")]
    size = "{width}x{height}".format(**report["views"][0])
    lines = [
        f"at {size}, exact: {took[0]} forward, {took[1]} forward + backward, {took[2]} the Fisher diagonal of a view"
    ]
    if own["image"] is not None:
        oracle = next(row for row in report["rows"] if row["by"] == "oracle")
        lines.append(
            f"exact itself differs from float64 by up to {own['image']:.1e} (image), {_number(own['gradient'], '.1e')} "
            f"(gradient, {oracle['gradient']['group']}), outside of {oracle['notes']['ties']} pixels with ties, on "
            f"{oracle['notes']['sample']}"
        )
    else:
        lines.append("exact itself was not compared with float64; budgets hold relative to it")
    scatter = [f"{_title(clock)} {_span(found)}" for clock, found in report["scatter"].items() if found]
    if scatter:
        lines.append("exact against itself, the scatter of equal work: " + ", ".join(scatter))
    for row in report["rows"]:
        if row["skipped"] is not None:
            lines.append(f"skipped {row['name']}: {row['skipped']}")
        elif row["by"] == "view" and "information" in row["notes"]:
            lines.append(f"{row['name']}, no Fisher diagonal: {row['notes']['information']}")
        elif row["by"] == "rays":
            lines.append(f"~ {row['name']}: {row['notes']['sample']}")
    return lines


def _full_lines(report: dict) -> list[str]:
    """Times at full size, one line a clock."""
    lines = []
    for clock, found in report["full"].items():
        if not found["names"]:
            lines.append(
                f"{_title(clock)}: no time for larger views, what counts are those above; --seconds gives more"
            )
            continue
        rows = {row["name"]: row["full"].get(clock) for row in report["rows"]}
        exact = rows[found["names"][0]]
        others = [f"{name} {_span(rows[name])}" for name in found["names"][1:]]
        where = f"{_title(clock)} at {_size(found)}, {found['rounds']} rounds"
        lines.append(f"{where}: exact {_seconds(exact['seconds'])}; times it: {', '.join(others)}")
    return lines


def _full_table(report: dict) -> list[str]:
    """The same for the page."""
    lines = ["| at the size of the views as drawn | size | rounds | setting | seconds | times exact's |"]
    lines.append("|---|---|---:|---|---:|---:|")
    for clock, found in report["full"].items():
        for name in found["names"]:
            times = next(row for row in report["rows"] if row["name"] == name)["full"][clock]
            cells = _title(clock), _size(found), str(found["rounds"]), name, f"{times['seconds']:.3g}", _span(times)
            lines.append("| " + " | ".join(cells) + " |")
    return lines if len(lines) > 2 else []


def _title(clock: str) -> str:
    return {"forward": "forward", "forward_backward": "forward + backward", "fisher": "Fisher diagonal"}[clock]


def _size(found: dict) -> str:
    text = "{}x{}".format(*found["size"])
    return text if found["size"] == found["drawn"] else text + " (of {}x{}: --seconds)".format(*found["drawn"])


def _span(times: dict) -> str:
    """A ratio and its interval."""
    digits = 3 if times["ratio"] < 0.1 else 2
    if times["low"] == times["high"]:
        return f"{times['ratio']:.{digits}f}"
    return f"{times['ratio']:.{digits}f} [{times['low']:.{digits}f}, {times['high']:.{digits}f}]"


def _seconds(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds >= 1 else _milliseconds(seconds)


def _advice(pick: dict) -> str:
    where = f"{pick['use']}, {pick['budget']:g}: "
    if pick["name"] is None:
        return where + pick["reason"]
    why = f" ({pick['reason']})" if pick["reason"] else f" {_span(pick)} times exact's time"
    return f"{where}{pick['flags']}{why}, error {pick['error']:.1e}"


def _time(row: dict, key: str) -> str:
    ratio = row["ratio"][key]
    if ratio is None:
        return "-"
    text = f"{ratio:.2f}" if ratio < 10 else f"{ratio:.0f}"
    return text if row["by"] == "view" else f"~{text}"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _milliseconds(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1e3 * seconds:.0f} ms"


_PANELS = (
    ("image", "forward", "image error (larger of RMS and 99.9 %)"),
    ("gradient", "forward_backward", "gradient error (worst group)"),
    ("information", "fisher", "information error (worst group)"),
)
_COLORS = {"approximation": "#1f77b4", "model": "#d62728", "resolution": "#2ca02c", "precision": "#7f7f7f"}


def _plot(report: dict, path: Path) -> bool:
    """Error against time for each use; False where there is no matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(3, 1, figsize=(10, 15), dpi=90)
    for axis, (kind, clock, label) in zip(panels, _PANELS, strict=True):
        rows = [r for r in report["rows"] if r["skipped"] is None and r["by"] == "view"]
        points = [(r["ratio"][clock], r["errors"][kind], r) for r in rows if r["ratio"][clock] and r["errors"][kind]]
        for name, color in _COLORS.items():
            part = [(x, y) for x, y, r in points if r["kind"] == name]
            axis.plot(*zip(*part, strict=True), "o", ms=5, color=color, label=name) if part else None
        points.sort(key=lambda p: p[:2])
        front = [p for i, p in enumerate(points) if all(p[1] < q[1] for q in points[:i])]
        axis.plot([p[0] for p in front], [p[1] for p in front], "-", lw=1, color="black", label="front", zorder=0)
        axis.set(xscale="log", yscale="log", ylabel=label, xlabel=f"time, {clock.replace('_', ' + ')} / exact")
        axis.margins(x=0.25, y=0.12)
        for budget in report["budgets"]:
            axis.axhline(budget, lw=0.6, ls=":", color="gray", zorder=0)
        axis.legend(fontsize=7, loc="upper right")
        # The front first: what finds no free place is left without a label.
        rest = [p for p in points if p not in front]
        _labels(figure, axis, [*front, *rest], points)
    figure.suptitle(f"{report['scene']}: {report['gaussians']:,} Gaussians", fontsize=10)
    figure.tight_layout(rect=(0, 0, 1, 0.985))
    with replacing(path, path.suffix) as name:
        figure.savefig(name)
    plt.close(figure)
    return True


def _labels(figure, axis, points: list, dots: list) -> None:
    """Names beside points, without overlaps; a point whose surroundings are full goes without."""
    from matplotlib.transforms import Bbox

    figure.tight_layout(rect=(0, 0, 1, 0.985))  # places do not move any more
    renderer, inside = figure.canvas.get_renderer(), axis.get_window_extent()
    places = [axis.transData.transform(p[:2]) for p in dots]
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in places]
    taken.append(axis.get_legend().get_window_extent(renderer))
    for x, y, row in points:
        for reach in (6, 16, 30, 46):
            for angle in (0, 180, 90, 270, 45, 315, 135, 225):
                dx, dy = reach * math.cos(math.radians(angle)), reach * math.sin(math.radians(angle))
                text = axis.annotate(
                    row["name"],
                    (x, y),
                    xytext=(dx, dy),
                    textcoords="offset points",
                    fontsize=7.5,
                    color=_COLORS[row["kind"]],
                    ha="left" if dx > 1 else "right" if dx < -1 else "center",
                    va="bottom" if dy > 1 else "top" if dy < -1 else "center",
                    arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "gray"} if reach > 6 else None,
                )
                box = text.get_window_extent(renderer)
                if (
                    inside.contains(box.x0, box.y0)
                    and inside.contains(box.x1, box.y1)
                    and not box.count_overlaps(taken)
                ):
                    taken.append(box)
                    break
                text.remove()
            else:
                continue
            break
