"""`drgs tradeoff`: error and time of every accuracy/speed setting, on a user's own scene and views.

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
views as large as they are drawn (`measure_full`), and advice follows from these (`recommend`). With one thread it is
the processor's time, else the clock's. What would take minutes (Mitsuba's traversal without cut-offs, the oracle) is
measured on a sample of rays, once, and its time scaled to the image.
"""

from __future__ import annotations

import dataclasses
import datetime
import logging
import math
from collections.abc import Sequence
from typing import Any

from drgs import runtime
from drgs.cameras import Camera
from drgs.cameras.sizes import at_most
from drgs.commands.options import Tradeoff
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import views_to_sample
from drgs.data.camera_lists import camera_to_json
from drgs.display import tables
from drgs.display.progress import Bar
from drgs.fitting.resume import lock_output
from drgs.io.journal import SCHEMA
from drgs.io.outputs import write_json, write_whole
from drgs.lab.tradeoff import FullSize, measure, measure_full
from drgs.lab.tradeoff_advice import USES, Advice, recommend
from drgs.lab.tradeoff_plot import plot
from drgs.lab.tradeoff_rows import CLOCKS, TRADEOFF_VARIANTS, Interval, Measured, TradeoffRow
from drgs.pages.report import charts

_log = logging.getLogger(__name__)


def run(args: Tradeoff) -> None:
    """`drgs tradeoff SCENE`."""
    if args.preset != "exact":
        raise ValueError(f"--preset must be exact, which the others are compared with, got {args.preset}; drop it")
    if args.tolerance is not None:
        raise ValueError("--tolerance: must not be given, several are among the settings that are compared; drop it")
    if not args.max_error or not all(0 < x < math.inf for x in args.max_error):
        got = " ".join(f"{x:g}" for x in args.max_error) or "none"
        raise ValueError(f"--max-error must be finite numbers > 0, got {got}; correct it")
    if not charts.is_available():
        _log.warning("no plot will be drawn: matplotlib is not installed; pip install 'drgs[report]'")
    names = ["tradeoff.json", "tradeoff.md", "tradeoff.png"]
    lock_output(args.output, "tradeoff", names, [args.scene, args.cameras or ""])
    given = SceneInput.of(args)
    gaussians, fields = given.colors, given.fields
    if not len(gaussians):
        raise ValueError(f"{args.scene}: must hold at least one Gaussian, holds none; give another scene")
    cameras, source = views_to_sample(args, given)
    reduced = [at_most(camera, args.max_pixels) for camera in cameras]
    turns = (args.repeats + 1) * (1 + sum(x.by == "view" for x in TRADEOFF_VARIANTS))
    with Bar("tradeoff", turns, not args.quiet) as bar:
        measured = measure(gaussians, reduced, TRADEOFF_VARIANTS, fields, args.repeats, args.seed, bar.advance)
    with Bar("tradeoff", show=not args.quiet) as bar:
        say = lambda label: bar.update(0, label=f"tradeoff, {label}")  # noqa: E731
        budget = args.repeats, args.seconds, args.seed
        full = measure_full(measured, gaussians, cameras, args.max_error, *budget, say)
    for row, variant in zip(measured.rows, TRADEOFF_VARIANTS, strict=True):
        row.flags = None if variant.by == "oracle" else variant.flags(args.overrides)
    report = _Report(
        scene=str(args.scene),
        gaussians=len(gaussians),
        source=source,
        views=reduced,
        full=full,
        fields=fields,
        seed=args.seed,
        budgets=args.max_error,
        measured=measured,
        recommended=[pick for use in USES for pick in recommend(measured, use, args.max_error)],
        date=datetime.date.today().isoformat(),
        env=runtime.info(),
    )
    title = f"{args.scene}: {len(gaussians):,} Gaussians"
    # First: whatever becomes of the plot, what was measured is there.
    write_json(args.output / "tradeoff.json", report.to_json())
    write_whole(args.output / "tradeoff.md", _page(report, False).encode())
    drawn = plot(measured, args.max_error, title, args.output / "tradeoff.png")
    if drawn:
        write_whole(args.output / "tradeoff.md", _page(report, drawn).encode())
    if not args.quiet:
        _print(report)
        files = "tradeoff.json, tradeoff.md" + (", tradeoff.png" if drawn else "")
        print(f"{files}: {args.output}", flush=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Report:
    """Contents of the tables and of the page.

    Attributes:
        scene: Path of the scene.
        gaussians: Number of its Gaussians.
        source: Source of the views, in words.
        views: Views as errors were measured on them.
        full: Clock -> what was timed at full size.
        fields: Settings that hold in every row.
        seed: Seed of the measurement.
        budgets: Largest errors that are allowed.
        measured: The rows, and how they were measured.
        recommended: Advice for every use and budget.
        date: Date of the measurement.
        env: Machine and versions that it was measured with.
    """

    scene: str
    gaussians: int
    source: str
    views: list[Camera]
    full: dict[str, FullSize]
    fields: dict[str, Any]
    seed: int
    budgets: Sequence[float]
    measured: Measured
    recommended: list[Advice]
    date: str
    env: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """The report as tradeoff.json holds it."""
        return {
            "schema": SCHEMA,
            "command": "tradeoff",
            "scene": self.scene,
            "gaussians": self.gaussians,
            "source": self.source,
            "views": [camera_to_json(camera) for camera in self.views],
            "full": {clock: dataclasses.asdict(found) for clock, found in self.full.items()},
            "fields": self.fields,
            "seed": self.seed,
            "budgets": list(self.budgets),
            **self.measured.to_json(),
            "recommended": [pick.to_json() for pick in self.recommended],
            "date": self.date,
            "env": self.env,
        }


# ----------------------------------------------------------------------------------------- outputs


def _print(report: _Report) -> None:
    """Print the report as tables for a terminal."""
    measured = report.measured
    title = f"time and error relative to exact: {report.gaussians} Gaussians, {len(report.views)} views"
    rows = []
    for row in measured.rows:
        if row.skipped is None:
            errors = row.errors if row.by != "oracle" else measured.own
            times = (_time(row, clock) for clock in CLOCKS)
            numbers = (_number(x, ".0e") for x in (errors.image, errors.gradient, errors.information))
            rows.append((row.name, row.kind.replace("approximation", "approx."), *times, *numbers))
    times = ("forward", "+backward", "Fisher")
    errors = ("image", "gradient", "Fisher")
    columns = ("setting", "kind", *(f"time\n{x}" for x in times), *(f"error\n{x}" for x in errors))
    tables.show(f"{title} ({report.source})", columns, rows, texts=("kind",))
    for line in _notes(report):
        print(line)
    for line in _full_lines(report):
        print(line)
    print("\nFastest within a budget:")
    for pick in report.recommended:
        print("  " + _advice(pick))


def _page(report: _Report, drawn: bool) -> str:
    """tradeoff.md."""
    env = report.env
    camera = report.views[0]
    measured = report.measured
    threads = env["threads"]["drjit"]
    lines = [
        f"{report.gaussians:,} Gaussians, {len(report.views)} views of {camera.width}x{camera.height} "
        f"({report.source}); {env['cpu']}, {threads} threads, {env['backend']['variant']}, {report.date}, "
        f"commit {env['commit']}; times are relative to exact ({measured.clock} time, {measured.rounds} rounds).",
        "Rows of kind `model` compute something else than exact does: theirs are differences, not errors.",
        "",
        "| setting | kind | forward | + backward | Fisher | first call s | image RMS | 99.9 % | max | PSNR dB "
        "| gradient, all | worst group | Fisher L1 | median | worst group |",
        "|---|---|" + "---:|" * 9 + "---|---:|---:|---|",
    ]
    lines += [f"| {row.name} | {row.kind} | {' | '.join(_cells(row))} |" for row in measured.rows if not row.skipped]
    lines += ["", *(f"- {line}" for line in _notes(report)), ""]
    lines += [*_full_table(report), ""]
    lines += ["| use | budget | fastest setting within it | time | error |", "|---|---|---|---|---|"]
    for pick in report.recommended:
        found = f"{pick.reason} | | "
        if pick.name:
            why = f" ({pick.reason})" if pick.reason else ""
            found = f"`{pick.flags}`{why} | {_span(pick)} | {pick.error:.1e}"
        lines.append(f"| {pick.use} | {pick.budget:g} | {found} |")
    if drawn:
        lines += ["", "![error against time](tradeoff.png)"]
    return "\n".join(lines) + "\n"


def _cells(row: TradeoffRow) -> list[str]:
    """A row of the page behind name and kind."""
    image, slope, information = row.image, row.gradient, row.information
    return [
        *(_time(row, clock) for clock in CLOCKS),
        _number(row.first_call, ".1f"),
        *(_number(image and x, ".1e") for x in ((image.rms, image.p999, image.max) if image else (None,) * 3)),
        _number(image and image.psnr, ".1f"),
        _number(slope and slope.all, ".1e"),
        f"{_number(slope and slope.worst, '.1e')} {(slope and slope.group) or ''}".strip(),
        _number(information and information.l1, ".1e"),
        _number(information and information.median, ".1e"),
        (information and information.group) or "-",
    ]


def _notes(report: _Report) -> list[str]:
    """Notes below the tables."""
    measured, camera = report.measured, report.views[0]
    own = measured.own
    took = [_milliseconds(measured.truth.seconds[clock]) for clock in CLOCKS]
    lines = [
        f"at {camera.width}x{camera.height}, exact: {took[0]} forward, {took[1]} forward + backward, {took[2]} the "
        "Fisher diagonal of a view"
    ]
    if own.image is not None:
        oracle = next(row for row in measured.rows if row.by == "oracle")
        lines.append(
            f"exact itself differs from float64 by up to {own.image:.1e} (image), {_number(own.gradient, '.1e')} "
            f"(gradient, {oracle.gradient.group}), outside of {oracle.notes['ties']} pixels with ties, on "
            f"{oracle.notes['sample']}"
        )
    else:
        lines.append("exact itself was not compared with float64; budgets hold relative to it")
    scatter = [f"{_TITLES[clock]} {_span(found)}" for clock, found in measured.scatter.items() if found]
    if scatter:
        lines.append("exact against itself, the scatter of equal work: " + ", ".join(scatter))
    for row in measured.rows:
        if row.skipped is not None:
            lines.append(f"skipped {row.name}: {row.skipped}")
        elif row.by == "view" and "information" in row.notes:
            lines.append(f"{row.name}, no Fisher diagonal: {row.notes['information']}")
        elif row.by == "rays":
            lines.append(f"~ {row.name}: {row.notes['sample']}")
    return lines


def _full_lines(report: _Report) -> list[str]:
    """Times at full size, one line a clock."""
    lines = []
    rows = {row.name: row for row in report.measured.rows}
    for clock, found in report.full.items():
        if not found.names:
            lines.append(
                f"{_TITLES[clock]}: no time for larger views, what counts are those above; --seconds gives more"
            )
            continue
        exact, *others = ((name, rows[name].full[clock]) for name in found.names)
        where = f"{_TITLES[clock]} at {_size(found)}, {found.rounds} rounds"
        spans = ", ".join(f"{name} {_span(times)}" for name, times in others)
        lines.append(f"{where}: exact {_seconds(exact[1].seconds)}; times it: {spans}")
    return lines


def _full_table(report: _Report) -> list[str]:
    """Times at full size as a table of the page."""
    lines = []
    rows = {row.name: row for row in report.measured.rows}
    lines.append("| at the size of the views as drawn | size | rounds | setting | seconds | times exact's |")
    lines.append("|---|---|---:|---|---:|---:|")
    for clock, found in report.full.items():
        for name in found.names:
            times = rows[name].full[clock]
            cells = _TITLES[clock], _size(found), str(found.rounds), name, f"{times.seconds:.3g}", _span(times)
            lines.append("| " + " | ".join(cells) + " |")
    return lines if len(lines) > 2 else []


def _size(found: FullSize) -> str:
    text = "{}x{}".format(*found.size)
    return text if found.size == found.drawn else text + " (of {}x{}: --seconds)".format(*found.drawn)


def _span(times: Interval | Advice) -> str:
    """A ratio and its interval."""
    digits = 3 if times.ratio < 0.1 else 2
    if times.low == times.high:
        return f"{times.ratio:.{digits}f}"
    return f"{times.ratio:.{digits}f} [{times.low:.{digits}f}, {times.high:.{digits}f}]"


def _seconds(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds >= 1 else _milliseconds(seconds)


def _advice(pick: Advice) -> str:
    where = f"{pick.use}, {pick.budget:g}: "
    if pick.name is None:
        return where + pick.reason
    why = f" ({pick.reason})" if pick.reason else f" {_span(pick)} times exact's time"
    return f"{where}{pick.flags}{why}, error {pick.error:.1e}"


def _time(row: TradeoffRow, clock: str) -> str:
    ratio = row.ratio[clock]
    if ratio is None:
        return "-"
    text = f"{ratio:.2f}" if ratio < 10 else f"{ratio:.0f}"
    return text if row.by == "view" else f"~{text}"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _milliseconds(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1e3 * seconds:.0f} ms"


_TITLES = dict(zip(CLOCKS, ("forward", "forward + backward", "Fisher diagonal"), strict=True))
