"""`drgs eval`: how well a run shows views, those that it was not fitted to above all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drgs import data
from drgs.display import tables
from drgs.display.pictures import file_names
from drgs.files import Run
from drgs.fitting.frames import load_frames
from drgs.fitting.records import fit_record, fitted_views, load_run
from drgs.fitting.resume import claim_run
from drgs.metrics import METRICS, Lpips, evaluate, through_viewers, write_metrics

if TYPE_CHECKING:
    from drgs.commands.options import Eval

__all__ = ["print_table", "run", "viewers_line"]

_NOISE = 0.1  # dB; two fits differ by that much


def run(args: Eval) -> None:
    """`drgs eval RUN`."""
    run = Run(args.run)
    recorded = fit_record(run)
    output = claim_run(run, "eval")
    g = load_run(run).gaussians
    config = recorded.config
    lpips = Lpips(args.lpips_weights) if args.lpips_weights else None
    # Of an active run, images may be missing that were never picked.
    dataset = data.load(
        recorded.data,
        test_every=config.test_every,
        test_offset=config.test_offset,
        background=config.settings.background,
        lazy=recorded.is_active,
        points=False,
        strict=args.strict,
    )
    train, test = dataset.split()
    if recorded.is_active:  # the rest of the training split was never seen
        fitted = fitted_views(run)
        train = [view for view in train if view.name in fitted]
    views = {"test": test, "train": train, "all": train + test}[args.split]
    if not views:
        raise ValueError(f"eval: split {args.split} must hold a view, holds none ({dataset.split_rule()}); use --split")
    frames = load_frames(views, config.max_pixels, config.mask)
    names = file_names([frame.name for frame in frames])
    output.check(f"renders/{args.split}/{name}.png" for name in names)
    result = evaluate(g, frames, config.settings, lpips=lpips, pictures=run.renders / args.split)
    viewers = through_viewers(g, frames, config.settings, args.split)
    written = write_metrics(
        run, args.split, frames, result, split_rule=dataset.split_rule(), gaussians=len(g), viewers=viewers
    )
    if not args.quiet:
        print_table(written)


def print_table(metrics: dict) -> None:
    """The metrics of `write_metrics` as a table on stdout, reasons of missing ones below, and what viewers show."""
    digits = {"psnr": ".2f"}
    names = [name for name in METRICS if metrics["mean"][name] is not None]
    rows = [*metrics["views"], {"name": "mean", **metrics["mean"]}]
    tables.show(
        f"{metrics['count']} {metrics['split']} views",
        ("view", *names),
        [(row["name"], *(f"{row[name]:{digits.get(name, '.4f')}}" for name in names)) for row in rows],
    )
    for name, reason in metrics["reasons"].items():
        print(f"{name}: none ({reason})")
    if metrics["viewers"]:
        print(viewers_line(metrics["viewers"]))


def viewers_line(viewers: dict) -> str:
    """What `through_viewers` found, and what to do about it."""
    line = (
        f"In a viewer of PLY files (preset {viewers['preset']}, {viewers['width']}x{viewers['height']}): PSNR "
        f"{viewers['psnr']:.2f} dB instead of {viewers['own_psnr']:.2f} dB, mean of {len(viewers['views'])} "
        f"{viewers['split']} views"
    )
    if viewers["own_psnr"] - viewers["psnr"] <= _NOISE:
        return line
    return f"{line}; to train for viewers, fit with --preset {viewers['preset']}"
