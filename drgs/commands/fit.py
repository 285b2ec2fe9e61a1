"""`drgs fit`: Gaussians from photographs with known cameras, and how well they show the held-out ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drgs.commands.clustered import workers_of
from drgs.commands.eval import print_table
from drgs.commands.report import report_of
from drgs.files import Run
from drgs.fitting.frames import load_dataset
from drgs.fitting.records import fit_record
from drgs.fitting.resume import claim_run
from drgs.report.write import FILE
from drgs.train import fit

if TYPE_CHECKING:
    from drgs.commands.options import Fit

__all__ = ["run"]


def run(args: Fit) -> None:
    """`drgs fit DATA -o RUN`."""
    config = args.fit_config()
    is_active = config.selection is not None
    # Before minutes of reading images and triangulating points.
    claim_run(Run(args.output), "fit", args.resume, [args.data])
    dataset = load_dataset(
        args.data,
        config,
        lazy=is_active,
        points=not is_active or config.data.init_points == "all",
        strict=args.strict,
        semantics=config.features.semantics != "ignore",
    )
    with workers_of(args) as workers:
        result = fit(dataset, args.output, config, resume=args.resume, progress=not args.quiet, workers=workers)
    page = result.run.path / FILE
    if args.report:
        report_of(result.run, page, fit_record(result.run).with_refined_poses(dataset))
    if args.quiet:
        return
    print_table(result.metrics)
    print(f"{len(result.gaussians)} Gaussians in {result.seconds:.0f} s: {result.run.point_cloud}")
    if args.report:
        print(f"report: {page}")
