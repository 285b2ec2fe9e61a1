"""`drgs fit`: Gaussians from photographs with known cameras, and how well they show the held-out ones."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from drgs.commands.clustered import workers_of
from drgs.commands.eval import print_table
from drgs.commands.report import report_of
from drgs.display.progress import Bar
from drgs.files import Run
from drgs.fitting.frames import load_dataset
from drgs.fitting.resume import claim_run
from drgs.metrics import VIEWERS, settings_of_viewers
from drgs.report.write import FILE
from drgs.train import FitConfig, fit

if TYPE_CHECKING:
    from drgs.commands.options import Fit
    from drgs.settings import RenderSettings

__all__ = ["run", "viewers_hint"]


def run(args: Fit) -> None:
    """`drgs fit DATA -o RUN`."""
    settings = args.settings()
    names = {field.name for field in dataclasses.fields(FitConfig)} - {"settings"}
    config = FitConfig(settings=settings, **{n: getattr(args, n) for n in names if hasattr(args, n)})
    active = args.active()
    # Before minutes of reading images and triangulating points.
    claim_run(Run(args.output), "fit", args.resume, [args.data])
    with Bar("fit", show=not args.quiet) as bar:
        if hint := viewers_hint(args, settings):
            bar.note(hint)
    dataset = load_dataset(
        args.data,
        config,
        lazy=active is not None,
        points=active is None or config.init_points == "all",
        strict=args.strict,
        semantics=config.semantics != "ignore",
    )
    with workers_of(args) as workers:
        result = fit(
            dataset, args.output, config, active=active, resume=args.resume, progress=not args.quiet, workers=workers
        )
    page = result.run.path / FILE
    if args.report:
        report_of(result.run, page, dataset)
    if args.quiet:
        return
    print_table(result.metrics)
    print(f"{len(result.gaussians)} Gaussians in {result.seconds:.0f} s: {result.run.point_cloud}")
    if args.report:
        print(f"report: {page}")


def viewers_hint(args: Fit, settings: RenderSettings) -> str:
    """What a fit trains for, if viewers of PLY files will show another picture, and how to train for them; else ""."""
    if settings_of_viewers(settings) is None:
        return ""
    changed = f" with --set {' '.join(args.overrides)}" if args.overrides else ""
    wanted = f"--preset {VIEWERS}" if args.preset != VIEWERS else f"--preset {VIEWERS} alone"
    return (
        f"this fit trains for preset {args.preset}{changed}; viewers of PLY files draw with preset {VIEWERS}, whose "
        f"picture of it will differ, most where Gaussians are smaller than a pixel; {wanted} trains for viewers"
    )
