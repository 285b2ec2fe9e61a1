"""`drgs capture`: from photographs or videos to a run, its report and one file to send; which photographs to take next.

The work is done by `drgs.capturing`: `steps` has the steps, `next_views` the places of the next photographs.
"""

from __future__ import annotations

import shlex

from drgs.capturing.capture import CaptureOptions
from drgs.capturing.next_views import rank_next
from drgs.capturing.record import FOLDER, CaptureRecord
from drgs.capturing.steps import run_capture
from drgs.commands.options import Capture
from drgs.commands.report import report_of
from drgs.commands.values import seconds_of_budget
from drgs.fitting.config import FitConfig
from drgs.fitting.records import is_run
from drgs.viewing.installation import view_command


def run(args: Capture) -> None:
    """`drgs capture PATH... -o RUN`, with `--add` further photographs, and `drgs capture --more -o RUN`."""
    if args.more:
        _print_next(args)
    elif args.region is not None:
        raise ValueError(f"--region must have --more, whose photographs it is for, got {args.region}; drop it")
    elif args.length is not None:
        raise ValueError(f"--length must have --more, which it is for, got {args.length!r}; drop it")
    else:
        capture_photographs(args, FitConfig().replace(exposure="auto"))


def capture_photographs(args: Capture, config: FitConfig) -> None:
    """All steps of a capture that are not done yet (`drgs.capturing.steps.run_capture`).

    Args:
        args: Options.
        config: What the fit of the first photographs does where no budget says so.
    Raises:
        FileNotFoundError, ValueError, KeyboardInterrupt: As `run_capture`.
    """
    options = CaptureOptions(
        paths=args.paths,
        output=args.output,
        budget=None if args.budget is None else seconds_of_budget(args.budget),
        frames=args.frames,
        masks=args.masks,
        seed=args.seed,
        resume=args.resume,
        add=args.add,
        progress=not args.quiet,
    )
    run_capture(options, config, args.say, report_of)


def _print_next(args: Capture) -> None:
    """Which photographs to take next, below what the capture itself has advised."""
    if not is_run(args.output):
        raise ValueError(
            f"{args.output}: -o must be a run with --more, found none; make it first by drgs capture PHOTOS "
            f"-o {shlex.quote(str(args.output))}"
        )
    if args.paths:
        raise ValueError(f"--more must have no photographs, got {args.paths[0]}; drop one or the other")
    picks = rank_next(args.output, args.k, args.length, not args.quiet, args.region)
    if args.quiet:
        return
    record = CaptureRecord.read(args.output / FOLDER)
    for line in record.batch.advice() if record is not None and args.region is None else ():
        print(line)
    if args.length is None:
        print("lengths are shares of the way from a photograph to what it shows; with --length they are in meters")
    for pick in picks:
        worth = "" if pick["gain"] is None else f" (adds {_times(pick['gain'])})"
        print(f"{pick['rank']}. {pick['text']}{worth}")
    run = shlex.quote(str(args.output))
    print(f"arrows on the map: drgs report {run}; in the browser: {view_command(args.output)}")


def _times(gain: float) -> str:
    """What a photograph would tell, over what one of those there are adds to all others: these share most of it, so
    that it may be more times that than there are photographs.
    """
    return f"{'as much as' if gain < 1.5 else f'{gain:.0f} times what'} one of your photographs adds to the others"
