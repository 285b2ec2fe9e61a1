"""From photographs or videos to a run, its report and one file to send, in steps that can be resumed.

    photos   links to the photographs and frames of the videos, in one folder
    poses    cameras and points, by structure from motion
    fit      Gaussians
    report   what came out, and what to do at the next shoot
    share    one file to send

Each step is recorded in RUN/capture/capture.json once it is done; a capture is resumed at the first that is not.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from drgs.capturing import diagnosis
from drgs.capturing.budget import plan_frames
from drgs.capturing.capture import Capture, CaptureOptions, Clock, Photographs, config_of
from drgs.capturing.fit import fit_photographs
from drgs.capturing.opening import new_files, open_record
from drgs.capturing.poses import Outcome, add_poses, find_poses, given_poses
from drgs.capturing.record import FOLDER, CaptureRecord, DoneStep, inputs_of
from drgs.data import Dataset
from drgs.data.images import check_readers, list_images
from drgs.display.progress import Bar, duration
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import load_dataset
from drgs.fitting.records import is_run
from drgs.fitting.resume import lock_run
from drgs.io import interrupts
from drgs.io.atomic import is_full
from drgs.io.outputs import lock_folder
from drgs.io.run import Run
from drgs.pages.report.write import FILE as REPORT
from drgs.pages.sharing.scene import FILE as PAGE
from drgs.pages.sharing.scene import scene_of_run
from drgs.pages.sharing.write import write_page
from drgs.sfm.image_folder import make_image_folder, named_files, usable_files
from drgs.viewing.installation import view_command

Report = Callable[[Run, Path, "Dataset"], None]
"""Writes the report of a run to a file; the data set has the cameras as fitted."""

_FEWEST = 3  # photographs that a scene needs; two may have poses, but nothing is left to be held out


def run_capture(options: CaptureOptions, config: FitConfig, say: Callable[[str], None], report: Report) -> None:
    """All steps of a capture that are not done yet.

    Args:
        options: Options of the capture.
        config: What the fit of the first photographs does where no budget says so; the seed is that of the options.
        say: Prints a line for the user.
        report: Writes the report; which command repeats a fit is known to commands alone.
    Raises:
        FileNotFoundError, ValueError: On bad options, photographs or videos, and a folder that is not to be written.
        KeyboardInterrupt: On Ctrl-C; the steps that are done are kept.
    """
    clock = Clock(options.budget)
    before = CaptureRecord.read(options.output / FOLDER)
    if not options.paths and options.resume and before is not None:
        named = tuple(Path(row[0]) for row in before.batch.inputs)
        options = dataclasses.replace(options, paths=named, add=len(before.batches) > 1)
    if not options.paths and before is not None:
        raise ValueError(
            f"{options.output}: there must be photographs or --resume, got none, and it holds a capture; add --resume "
            "to go on with it"
        )
    if not options.paths and options.resume:
        raise ValueError(f"{options.output}: --resume must have a capture to go on with, found none; check -o")
    if not options.paths:
        raise ValueError(
            "there must be photographs, videos or a data set, got none; name them, e.g. drgs capture photos -o RUN"
        )
    run = next((path for path in options.paths if is_run(path)), None)
    if run is not None:
        raise ValueError(
            f"{run}: must be photographs, videos or a data set, is a run; "
            f"add photographs to it by drgs capture PHOTOS -o {shlex.quote(str(run))} --add"
        )
    config = config.replace(seed=options.seed)
    with Bar("capture", show=options.progress, lines_only=True):
        given = _dataset_of(options, config)
        photographs, videos = ([], []) if given else named_files(options.paths)
        if not given and not videos and not options.add and len(photographs) < _FEWEST:
            raise ValueError(
                f"{options.paths[0]}: must be at least {_FEWEST} photographs, got {len(photographs)}; take thirty to "
                "eighty, each overlapping the one before by two thirds"
            )
        if not options.resume:
            check_readers(photographs)  # before anything is made
        # Not the files: links to them in the folder of the capture may be made anew.
        folders = {path if path.is_dir() else path.parent for path in options.paths}
        with (
            lock_run(Run(options.output), "capture", True, folders),
            lock_folder(options.output / FOLDER, "capture", inputs=folders),
            _resumable(),
        ):
            if options.add and given:
                raise ValueError(
                    f"{given.path}: --add must have photographs or videos, got a data set; name its pictures"
                )
            if options.add and before is not None:
                photographs, videos = new_files(options, before, photographs, videos, say)
            inputs = inputs_of([given.path] if given else [*photographs, *videos])
            record = open_record(options, inputs, given is not None)
            capture = Capture(options, clock, record, Photographs(), config, say, given)
            _run_steps(capture, _steps(capture, photographs, videos, report))


def _dataset_of(options: CaptureOptions, config: FitConfig) -> Dataset | None:
    """The data set, with poses, that a single path names; None where it names photographs or videos."""
    path = options.paths[0]
    if len(options.paths) > 1 or not (path.is_dir() or (path.is_file() and path.suffix in (".json", ".npy"))):
        return None
    try:
        return load_dataset(path, config_of(Run(options.output)) if is_run(options.output) else config)
    except FileNotFoundError:
        return None


@contextlib.contextmanager
def _resumable() -> Iterator[None]:
    """Add to an interruption's text how to resume."""
    try:
        yield
    except KeyboardInterrupt as error:
        text = f"{error}; " if str(error) else ""
        raise interrupts.interruption(f"{text}the steps that are done are kept, --resume continues") from None


def _steps(
    capture: Capture, photographs: list[Path], videos: list[Path], report: Report
) -> dict[str, Callable[[], Outcome]]:
    """The steps, in their order."""
    steps: dict[str, Callable[[], Outcome]] = {}
    if capture.has_poses:
        steps["poses"] = lambda: given_poses(capture)
    else:
        steps["photos"] = lambda: _gather(capture, photographs, videos)
        steps["poses"] = lambda: add_poses(capture) if capture.is_added else find_poses(capture)
    steps["fit"] = lambda: fit_photographs(capture)
    steps["report"] = lambda: _page(capture, REPORT, lambda path: report(capture.run, path, capture.refined_dataset()))
    steps["share"] = lambda: _page(
        capture, PAGE, lambda path: write_page(scene_of_run(capture.run, capture.refined_dataset()), path)
    )
    return steps


def _run_steps(capture: Capture, steps: dict[str, Callable[[], Outcome]]) -> None:
    """Run the steps that are not done yet, and print the findings for the next shoot."""
    path = capture.options.output
    run = shlex.quote(str(path))
    for name, work in steps.items():
        try:
            _run_step(capture, name, work)
        except OSError as error:  # the viewer's code is out of reach: all else is done
            if name != "share" or is_full(error):
                raise
            capture.say(f"share: not written, {error}; then drgs share {run}")
        if name == "report":  # which looks at what the fit gets wrong in them
            capture.photographs.forget()
    for line in capture.batch.advice():
        capture.say(line)
    budget = capture.clock.budget
    capture.say(f"done in {duration(capture.clock.used)}" + ("" if budget is None else f" of {duration(budget)}"))
    capture.say(f"next: {view_command(path)}; which photographs to take next: drgs capture --more -o {run}")


def _run_step(capture: Capture, name: str, work: Callable[[], Outcome]) -> None:
    """Run a step, unless it is done; print and record its result."""
    before = capture.batch.step(name)
    if before is not None:
        capture.say(f"{name}: {before.line} (done before)")
        return
    began = time.monotonic()
    line, findings = work()
    seconds = time.monotonic() - began
    capture.record.done(DoneStep(name, line, seconds), findings)
    capture.say(f"{name}: {line} ({duration(seconds)})")


def _gather(capture: Capture, photographs: list[Path], videos: list[Path]) -> Outcome:
    """The step `photos`: all pictures in one folder, and which of them are blurred or dark."""
    options, budget, decode = capture.options, capture.clock.budget, capture.photographs.decode
    with Bar("photos"):
        fewest = 1 if capture.is_added else _FEWEST
        photographs, videos = usable_files(photographs, videos, options.paths[0], fewest, decode=decode)
    frames = options.frames
    if videos and budget is not None:
        frames = plan_frames(videos[0], len(photographs), frames, budget)
        if frames < options.frames:
            capture.say(f"plan for {duration(budget)}: at most {frames} frames of videos, for their poses")
    with lock_folder(capture.folder, "capture") as held, Bar("photos") as bar:
        held.remove(capture.photos)  # of a command that ended before it could say so
        gathered = make_image_folder(photographs, videos, held, capture.photos.name, frames, bar.stage)
    names = [path.name for path in list_images(gathered.folder)]
    if len(names) < _FEWEST and not capture.is_added:
        raise ValueError(
            f"{options.paths[0]}: there must be at least {_FEWEST} pictures, got {len(names)}; film or photograph "
            "more, and move while you do"
        )
    return gathered.line(), [*gathered.findings, *diagnosis.of_photographs(gathered.folder, names, decode)]


def _page(capture: Capture, file: str, write: Callable[[Path], object]) -> Outcome:
    """A page of the run."""
    with lock_run(capture.run, "capture") as held:
        held.check([file])
        write(capture.run.path / file)
    return str(capture.run.path / file), []
