"""`drgs eval`: how well a run shows views, those that it was not fitted to above all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drgs.display import tables
from drgs.fitting.evaluation import evaluate_run
from drgs.fitting.metrics import DEPTH, METRICS, MOVING, OBJECT, Lpips, renderers_table
from drgs.fitting.records import fit_record
from drgs.fitting.resume import lock_run
from drgs.io.run import Run

if TYPE_CHECKING:
    from drgs.commands.options import Eval


def run(args: Eval) -> None:
    """`drgs eval RUN`."""
    run = Run(args.run)
    recorded = fit_record(run)
    recorded.check_data(run.path)
    lpips = Lpips(args.lpips_weights) if args.lpips_weights else None
    written = evaluate_run(run, lock_run(run, "eval"), args.split, lpips, args.strict, args.preset, args.scale)
    if not args.quiet:
        print_table(written, lpips=lpips is not None)


def print_table(metrics: dict, *, lpips: bool = False) -> None:
    """Print metrics as tables on stdout, reasons of missing ones below, and what each renderer shows.

    Args:
        metrics: Content of metrics.json.
        lpips: Whether to print LPIPS, and why it is null where it is.
    """
    digits = dict.fromkeys(("psnr", "cc_psnr", *OBJECT, *MOVING), ".2f")
    names = [name for name in (*OBJECT, *METRICS, *MOVING, *DEPTH) if metrics["mean"].get(name) is not None]
    if "psnr_object" in names:
        names.remove("psnr")  # one of these two, by what says where the object is
    scale = metrics.get("scale")
    rows = [*metrics["views"], {"name": "mean", **metrics["mean"]}]
    tables.show(
        f"{metrics['count']} {metrics['split']} views"
        + (f", {scale:g} times as wide and high as fitted" if scale else ""),
        ("view", *names),
        [(row["name"], *(_formatted(row[name], digits.get(name, ".4f")) for name in names)) for row in rows],
    )
    if found := metrics.get("segmentation"):
        _print_segmentation(metrics, found)
    for name, reason in metrics["reasons"].items():
        if name == "lpips" and not lpips:
            continue
        print(f"{name}: none ({reason})")
    title, head, rows = renderers_table(metrics)
    if rows:
        tables.show(title, head, rows, texts=("worst view",))
    if moved := metrics.get("motion"):
        print(_motion_line(moved, metrics["gaussians"]))


def _formatted(value: float | None, digits: str) -> str:
    return "-" if value is None else f"{value:{digits}}"


def _motion_line(moved: dict, count: int) -> str:
    """Who moves and, after a fit, what it saves that the others do not."""
    line = f"{moved['moving']:,} of {count:,} Gaussians move ({moved['share']:.1%})"
    if "living" in moved:
        line += f", {moved['living']:,} are there for a time"
    if "seconds" not in moved:
        return line
    some, everything = (1000 * moved[key] for key in ("seconds", "seconds_all"))
    return f"{line}: deforming them takes {some:.1f} ms of a step, deforming all would take {everything:.1f} ms"


def _print_segmentation(metrics: dict, found: dict) -> None:
    """Print how well labels agree with their reference, and the teacher's own where that is the data set's."""
    names = {"labels": "the data set's labels", "teacher": "the teacher's labels, not the truth"}
    shown = {
        "pixel_accuracy": "pixel\naccuracy",
        "class_accuracy": "class\naccuracy",
        "miou": "mIoU",
        "miou_top7": "top-7\nmIoU",
    }
    rows = [(name, found[name]) for name in ("run", "teacher") if found[name] is not None]
    if rows:
        tables.show(
            f"Segmentation of {metrics['count']} {metrics['split']} views, reference: {names[found['reference']]} "
            f"({found['folder']})",
            ("", *shown.values()),
            [(name, *(f"{values[key]:.4f}" for key in shown)) for name, values in rows],
        )
