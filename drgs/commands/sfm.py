"""`drgs sfm`: photographs to a data set that `drgs fit` reads."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

from drgs.data.sfm import run_sfm
from drgs.display.progress import Bar

if TYPE_CHECKING:
    from drgs.commands.making_options import Sfm

__all__ = ["run"]


def run(args: Sfm) -> None:
    """`drgs sfm IMAGES -o OUT`."""
    with Bar("features", show=not args.quiet) as bar:
        summary = run_sfm(
            args.images,
            args.output,
            bar.stage,
            camera_model=args.camera_model,
            matching=args.matcher,
            seed=args.seed,
            masks=args.masks,
            doing=lambda text: bar.update(bar.done, text=text),
        )
    if args.quiet:
        return
    stages = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in summary.seconds.items())
    print(
        f"{summary.registered} of {summary.total} photos have a pose, {summary.points} points, "
        f"mean reprojection error {summary.reprojection_error:.2f} px ({stages})"
    )
    for line in summary.explanation:
        print(line)
    print(f"next: drgs fit {shlex.quote(str(args.output))} -o RUN")
