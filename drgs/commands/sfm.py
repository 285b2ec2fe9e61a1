"""`drgs sfm`: photographs and videos to a data set that `drgs fit` reads."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

from drgs.display.progress import Bar
from drgs.sfm.reconstruction import SfmOptions, run_sfm

if TYPE_CHECKING:
    from drgs.commands.options import Sfm


def run(args: Sfm) -> None:
    """`drgs sfm PATH... -o OUT`."""
    with Bar("features", show=not args.quiet) as bar:
        summary = run_sfm(
            args.paths,
            args.output,
            SfmOptions(args.camera_model, matching=args.matcher, seed=args.seed, masks=args.masks, frames=args.frames),
            bar.stage,
            lambda text: bar.update(bar.done, text=text),
        )
    if args.quiet:
        return
    if summary.frames:
        print(f"{summary.frames} of the photos are frames of videos; images/frames.json has their times")
    stages = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in summary.seconds.items())
    print(
        f"{summary.registered} of {summary.total} photos have a pose, {summary.points} points, "
        f"mean reprojection error {summary.reprojection_error:.2f} px ({stages})"
    )
    for line in (*([summary.left_out] if summary.left_out else []), *summary.explanation):
        print(line)
    for finding in summary.findings:
        print(f"at the next shoot: {finding.line()}")
    print(f"next: drgs fit {shlex.quote(str(args.output))} -o RUN")
