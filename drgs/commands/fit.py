"""`drgs fit`: Gaussians from photographs with known cameras, and how well they show the held-out ones."""

from __future__ import annotations

import logging
import shlex

from drgs.capturing.diagnosis import of_held_out
from drgs.commands.eval import print_table
from drgs.commands.options import Fit
from drgs.commands.report import report_of
from drgs.data import Dataset
from drgs.data.view_checks import default_background
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import load_dataset
from drgs.fitting.records import fit_record, fitted_views, is_run
from drgs.fitting.resume import lock_run
from drgs.io.run import Run
from drgs.pages.report.write import FILE
from drgs.train import fit
from drgs.viewing.installation import view_command

_log = logging.getLogger(__name__)


def run(args: Fit) -> None:
    """`drgs fit DATA -o RUN`."""
    config = args.fit
    is_active = config.selection is not None
    # Before minutes of reading images and triangulating points.
    lock_run(Run(args.output), "fit", args.resume, [args.data])
    dataset = load_dataset(
        args.data,
        config,
        lazy=is_active,
        points=not is_active or config.data.init_points == "all",
        strict=args.strict,
        semantics=config.features.semantics != "ignore",
    )
    if args.background is None:
        config = _on_background(dataset, config, args, is_active)
    with args.cluster() as workers:
        result = fit(dataset, args.output, config, resume=args.resume, progress=not args.quiet, workers=workers)
    page = result.run.path / FILE
    if args.report:
        report_of(result.run, page, fit_record(result.run).with_refined_poses(dataset))
    if args.quiet:
        return
    print_table(result.metrics)
    print(f"{len(result.gaussians)} Gaussians in {result.seconds:.0f} s: {result.run.point_cloud}")
    for finding in of_held_out(dataset, fitted_views(result.run), result.metrics):
        print(f"note: {finding.line()}")
    if args.report:
        print(f"report: {page}")
    run = shlex.quote(str(result.run.path))
    print(f"next: {view_command(result.run.path)}; as a page to send: drgs share {run} -o scene.html")


def _on_background(dataset: Dataset, config: FitConfig, args: Fit, lazy: bool) -> FitConfig:
    """The configuration with the background that the photographs are put on where --background does not say: that of
    the run that is resumed, else `default_background`, which is said.
    """
    run = Run(args.output)
    if args.resume and is_run(run.path):
        color, reason = fit_record(run).config.settings.background, ""
    else:
        color, reason = default_background(dataset, lazy)
    if reason:
        _log.info("background of photographs with an alpha channel: %s (--background says another one)", reason)
    for view in (*dataset.views, *dataset.absent):
        view.background = color
    return config.replace(settings=config.settings.replace(background=color))
