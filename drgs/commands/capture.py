"""`drgs capture`: from photographs or videos to a run, its report and one file to send, in steps that can be resumed.

    photos   links to the photographs and frames of the videos, in one folder
    poses    cameras and points, by structure from motion
    fit      Gaussians
    report   what came out, and what to do at the next shoot
    share    one file to send

Each step is recorded in RUN/capture/capture.json once it is done; --resume begins with the first that is not.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import shlex
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from drgs import data
from drgs.capturing import diagnosis
from drgs.capturing.pace import Pacer
from drgs.capturing.plan import FitPlan, duration, plan_fit, plan_frames, plan_poses, planned_poses, seconds_of_budget
from drgs.capturing.record import FOLDER, Batch, CaptureRecord, DoneStep, inputs_of
from drgs.commands import share
from drgs.commands.next_views import rank_next
from drgs.commands.options import Share
from drgs.commands.report import report_of
from drgs.data.checks import list_images
from drgs.data.gathering import gather, named_files, usable_files
from drgs.data.held_out import HELD_OUT, write_held_out
from drgs.data.registering import register
from drgs.data.sfm import run_sfm
from drgs.display.progress import Bar
from drgs.files import Run, save_state, state_header
from drgs.fitting.config import FitConfig, recorded_config
from drgs.fitting.frames import load_dataset
from drgs.fitting.records import fit_record, is_run
from drgs.fitting.resume import FILES, claim_run, last_checkpoint
from drgs.guards import interrupts
from drgs.guards.outputs import claim
from drgs.guards.writing import is_full
from drgs.report.write import FILE
from drgs.train import fit
from drgs.viewing.placed_views import NEXT

if TYPE_CHECKING:
    from drgs.commands.making_options import Capture
    from drgs.data import Dataset
    from drgs.data.shooting import Finding

    Outcome: TypeAlias = tuple[str, list[Finding]]  # of a step: its line, and what is wrong with the capture

__all__ = ["capture_photographs", "run"]

_PHOTOS, _SCENE = "photos", "scene"
_BEFORE = "before.safetensors"  # checkpoint that a fit to further photographs goes on from
_SHARE_OF_STEPS = 0.5  # of those of the fit before, that further photographs get without a budget
_ANEW = 0.5  # of the photographs before: where more join, the fit begins anew (benchmarks/batches.py)
_FEWEST = 3  # photographs that a scene needs; two may have poses, but nothing is left to be held out


def run(args: Capture) -> None:
    """`drgs capture PATH... -o RUN`, with `--add` further photographs, and `drgs capture --more -o RUN`."""
    if args.more:
        _tell_next(args)
    else:
        capture_photographs(args, FitConfig.of(exposure="auto"))


def capture_photographs(args: Capture, config: FitConfig) -> None:
    """All steps of a capture that are not done yet.

    Args:
        args: Options.
        config: What the fit of the first photographs does where no budget says so; the seed is that of the options.
    Raises:
        FileNotFoundError, ValueError: On bad options, photographs or videos, and a folder that is not to be written.
        KeyboardInterrupt: On Ctrl-C; the steps that are done are kept.
    """
    before = CaptureRecord.read(args.output / FOLDER)
    if not args.paths and args.resume and before is not None:
        named = tuple(Path(row[0]) for row in before.batch.inputs)
        args = dataclasses.replace(args, paths=named, add=len(before.batches) > 1)
    if not args.paths:
        raise ValueError(
            "there must be photographs, videos or a data set, got none; name them, e.g. drgs capture photos -o RUN"
        )
    budget = None if args.budget is None else seconds_of_budget(args.budget)
    given = _dataset_of(args.paths)
    photographs, videos = ([], []) if given else named_files(args.paths)
    if not given and not videos and not args.add and len(photographs) < _FEWEST:
        raise ValueError(
            f"{args.paths[0]}: must be at least {_FEWEST} photographs, got {len(photographs)}; take thirty to eighty, "
            "each overlapping the one before by two thirds"
        )
    clock = _Clock(budget)
    # Not the files: links to them in the folder of the capture may be made anew.
    folders = {path if path.is_dir() else path.parent for path in args.paths}
    with (
        claim_run(Run(args.output), "capture", True, folders),
        claim(args.output / FOLDER, "capture", inputs=folders),
        _kept(args),
    ):
        if args.add and given:
            raise ValueError(f"{given.path}: --add must have photographs or videos, got a data set; name its pictures")
        if args.add and before is not None:
            photographs, videos = _new_files(args, before, photographs, videos)
        inputs = inputs_of([*photographs, *videos] or [given.path for given in [given] if given])
        record = _record(args, inputs, given is not None)
        _Capture(args, clock, record, given, config.replace(seed=args.seed)).run(photographs, videos)


def _tell_next(args: Capture) -> None:
    """Which photographs to take next."""
    if args.paths:
        raise ValueError(f"--more must have no photographs, got {args.paths[0]}; drop one or the other")
    if args.k < 1:
        raise ValueError(f"-k must be at least 1, got {args.k}; ask for some")
    picks = rank_next(args.output, args.k, args.length, not args.quiet)
    if args.quiet:
        return
    if args.length is None:
        print("lengths are shares of the way from a photograph to what it shows; with --length they are in meters")
    for pick in picks:
        worth = "" if pick["gain"] is None else f" (tells {_times(pick['gain'])})"
        print(f"{pick['rank']}. {pick['text']}{worth}")
    print(f"arrows on the map: drgs report {shlex.quote(str(args.output))}; in the browser: drgs view")


def _times(gain: float) -> str:
    """What a photograph would tell, over what one of those there are adds to all others: these share most of it, so
    that it may be more times that than there are photographs.
    """
    return f"{'as much as' if gain < 1.5 else f'{gain:.0f} times what'} one of your photographs adds to the others"


def _dataset_of(paths: tuple[Path, ...]) -> Dataset | None:
    """The data set, with poses, that a single path names; None where it names photographs or videos."""
    if len(paths) != 1 or not (paths[0].is_dir() or (paths[0].is_file() and paths[0].suffix in (".json", ".npy"))):
        return None
    try:
        return data.load(paths[0], lazy=True, points=False, semantics=False)
    except FileNotFoundError:
        return None


def _new_files(
    args: Capture, before: CaptureRecord, photographs: list[Path], videos: list[Path]
) -> tuple[list[Path], list[Path]]:
    """Files that are not in a capture yet: a phone's folder has the old ones, too."""
    others = before.batches[:-1] if args.resume and len(before.batches) > 1 else before.batches
    others = others[:-1] if _is_droppable(before) and not args.resume else others
    known = [row for batch in others for row in batch.inputs]
    new = [[path for path in paths if inputs_of([path])[0] not in known] for paths in (photographs, videos)]
    if not any(new):
        raise ValueError(f"{args.paths[0]}: --add must have photographs that are not in the capture yet, got none")
    if not args.quiet and (old := len(photographs) + len(videos) - sum(map(len, new))):
        print(f"{old} of the files are in the capture already", flush=True)
    return new[0], new[1]


def _is_droppable(record: CaptureRecord) -> bool:
    """Whether the last batch was to be added, and has changed nothing yet."""
    return len(record.batches) > 1 and record.batch.step("poses") is None


def _is_unposed(record: CaptureRecord) -> bool:
    """Whether a capture ended before its first photographs had poses: the same command begins it anew."""
    return len(record.batches) == 1 and record.batch.step("poses") is None


def _record(args: Capture, inputs: list, is_dataset: bool) -> CaptureRecord:
    """The record to go on with, whose last batch is the one to work at.

    Raises:
        ValueError: If there is one and neither --resume nor --add is given, its files or options were others, or it
            cannot be added to.
    """
    folder = args.output / FOLDER
    options = {"frames": args.frames, "masks": args.masks, "seed": args.seed}
    before = CaptureRecord.read(folder)
    if before is None or (_is_unposed(before) and not args.add and not args.resume):
        if args.add:
            raise ValueError(f"{args.output}: --add must have a capture to add to, found none; leave --add out")
        if is_run(args.output):
            raise ValueError(
                f"{args.output}: must be a new folder, or that of a capture, holds a run of `drgs fit`; choose another"
            )
        record = CaptureRecord(folder, [Batch(inputs, options)])
        record.write()
        return record
    if args.add and not args.resume:
        return _with_batch(args, before, Batch(inputs, options))
    if not args.resume:
        raise ValueError(
            f"{args.output}: must be a new folder, holds a capture already; add --resume or --add, or choose another"
        )
    if args.add != (len(before.batches) > 1):
        now, advice = ("first", "leave --add out") if args.add else ("added", "say --add, too, or name no photographs")
        raise ValueError(f"{args.output}: --resume must continue the last photographs, the {now} ones; {advice}")
    was = before.batch.options
    if other := next((name for name, value in options.items() if was.get(name) != value), None):
        raise ValueError(
            f"{args.output}: --resume must continue the same capture, --{other} was {was.get(other)!r} and is "
            f"{options[other]!r}; repeat the options or choose another folder"
        )
    if before.batch.inputs != inputs:
        rows = [*before.batch.inputs, *inputs]
        changed = next((row[0] for row in rows if row not in before.batch.inputs or row not in inputs), "their order")
        kind = "the data set" if is_dataset else "the photographs"
        raise ValueError(
            f"{args.output}: --resume must continue the same capture, {kind} changed: {changed}; name the same files "
            "or choose another folder"
        )
    return before


def _with_batch(args: Capture, record: CaptureRecord, batch: Batch) -> CaptureRecord:
    """A record whose last batch is a new one; one without poses is dropped, it has changed nothing."""
    if _is_droppable(record):
        record.batches.pop()
    if not (record.path / _SCENE).is_dir():
        raise ValueError(
            f"{args.output}: --add must have a capture of photographs, this one was of a data set with poses; fit anew "
            "to all of it"
        )
    if any(record.batch.step(name) is None for name in ("fit", "report")):
        raise ValueError(
            f"{args.output}: --add must follow a capture that is done, this one is not; go on with --resume first"
        )
    if args.masks is not None or record.batches[0].options.get("masks") is not None:
        raise ValueError(f"{args.output}: --add must have photographs without masks; capture all of them anew")
    record.batches.append(batch)
    record.write()
    return record


@contextlib.contextmanager
def _kept(args: Capture) -> Iterator[None]:
    """An interruption says how to go on."""
    try:
        yield
    except KeyboardInterrupt as error:
        text = f"{error}; " if str(error) else ""
        raise interrupts.interruption(f"{text}the steps that are done are kept, --resume goes on") from None


class _Clock:
    """Time of a capture.

    Attributes:
        began: Time of its beginning, as `time.monotonic` counts.
        end: Time at which it is to be done; None without a budget.
    """

    def __init__(self, budget: float | None) -> None:
        self.began = time.monotonic()
        self.budget = budget
        self.end = None if budget is None else self.began + budget

    @property
    def left(self) -> float:
        """Seconds that are left; infinite without a budget."""
        return float("inf") if self.end is None else self.end - time.monotonic()


class _Capture:
    """The steps of one capture."""

    def __init__(
        self, args: Capture, clock: _Clock, record: CaptureRecord, given: Dataset | None, config: FitConfig
    ) -> None:
        self.args = args
        self.clock = clock
        self.record = record
        self.given = given
        self.config = config
        self.run_folder = Run(args.output)
        self.folder = args.output / FOLDER
        self.batch = record.batch
        number = len(record.batches)
        self.is_added = number > 1
        self.photos = self.folder / (f"{_PHOTOS}_{number}" if self.is_added else _PHOTOS)

    def run(self, photographs: list[Path], videos: list[Path]) -> None:
        """All steps that are not done yet."""
        with Bar("capture", show=not self.args.quiet, lines_only=True):
            for name, work in self._steps(photographs, videos).items():
                try:
                    self._step(name, work)
                except OSError as error:  # the viewer's code is out of reach: all else is done
                    if name != "share" or is_full(error):
                        raise
                    run = shlex.quote(str(self.args.output))
                    self._say(f"share: not written, {error}; then drgs share {run}")
            self._finish()

    def _steps(self, photographs: list[Path], videos: list[Path]) -> dict[str, Callable[[], Outcome]]:
        """What each step is, in their order."""
        steps: dict[str, Callable[[], Outcome]] = {}
        if self.given is None:
            steps["photos"] = lambda: self._photos(photographs, videos)
            steps["poses"] = self._further_poses if self.is_added else self._poses
        else:
            steps["poses"] = self._given
        steps["fit"] = self._fit
        for name, (file, write) in _PAGES.items():
            steps[name] = functools.partial(self._page, file, write)
        return steps

    # ------------------------------------------------------------------------------------------ steps

    def _step(self, name: str, work: Callable[[], Outcome]) -> None:
        """One step, unless it is done; its outcome is told and recorded."""
        before = self.batch.step(name)
        if before is not None:
            self._say(f"{name}: {before.line} (done before)")
            return
        began = time.monotonic()
        line, findings = work()
        seconds = time.monotonic() - began
        self.record.done(DoneStep(name, line, seconds), findings)
        self._say(f"{name}: {line} ({duration(seconds)})")

    def _photos(self, photographs: list[Path], videos: list[Path]) -> Outcome:
        """All pictures in one folder."""
        frames = self.args.frames
        with Bar("photos"):
            fewest = 1 if self.is_added else _FEWEST
            photographs, videos = usable_files(photographs, videos, self.args.paths[0], fewest)
        if videos and self.clock.budget is not None:
            frames = plan_frames(videos[0], len(photographs), frames, self.clock.budget)
            if frames < self.args.frames:
                self._say(f"plan for {duration(self.clock.budget)}: at most {frames} frames of videos, for their poses")
        with claim(self.folder, "capture") as held, Bar("photos") as bar:
            held.remove(self.photos)  # of a command that ended before it could say so
            gathered = gather(photographs, videos, held, self.photos.name, frames, bar.stage)
        names = [path.name for path in list_images(gathered.folder)]
        if len(names) < _FEWEST and not self.is_added:
            raise ValueError(
                f"{self.args.paths[0]}: there must be at least {_FEWEST} pictures, got {len(names)}; film or "
                "photograph more, and move while you do"
            )
        return gathered.line(), [*gathered.findings, *diagnosis.of_photographs(gathered.folder, names)]

    def _poses(self) -> Outcome:
        """Structure from motion."""
        photos = self.photos
        names = [path.name for path in list_images(photos)]
        size: dict[str, Any] = {}
        if self.clock.budget is not None:
            plan = plan_poses(photos, names, self.clock.budget)
            self.batch.plan["poses"] = dataclasses.asdict(plan)
            self.record.write()
            size = {"max_image_size": plan.max_image_size}
            self._say(planned_poses(plan, len(names), self.clock.left, self.clock.budget))
        try:
            with Bar("poses") as bar:
                summary = run_sfm(
                    photos,
                    self.folder / _SCENE,
                    bar.stage,
                    seed=self.args.seed,
                    masks=self.args.masks,
                    doing=lambda text: bar.update(bar.done, text=text),
                    **size,
                )
        except ValueError as error:
            found = "".join(f"; {finding.line()}" for finding in self.batch.findings)
            raise ValueError(f"poses: {error}{found}") from None
        line = (
            f"{summary.registered} of {summary.total} photographs have a pose, {summary.points} points, "
            f"{summary.reprojection_error:.2f} px"
        )
        with Bar("what poses say"):
            dataset = data.load(self.folder / _SCENE, semantics=False)
            findings = diagnosis.of_poses(dataset, names, summary) + diagnosis.of_exposure(dataset, self.args.seed)
        return line, findings

    def _further_poses(self) -> Outcome:
        """Poses of photographs that join others, whose own stay."""
        scene = self.folder / _SCENE
        files = list_images(self.photos)
        if not (scene / HELD_OUT).is_file():
            write_held_out(scene, fit_record(self.run_folder).test, "capture")
        posed, summary = self._joined(scene, files), None
        if not posed:
            with claim(scene, "capture") as held:
                for link in _links_to(scene / "images", files):  # of a command that ended before it had poses
                    held.remove(link)
            size = self.record.batches[0].plan.get("poses", {})
            try:
                with Bar("poses") as bar:
                    summary = register(
                        scene,
                        files,
                        bar.stage,
                        seed=self.args.seed,
                        doing=lambda text: bar.update(bar.done, text=text),
                        **{key: size[key] for key in ("max_image_size",) if key in size},
                    ).summary
            except ValueError as error:
                found = "".join(f"; {finding.line()}" for finding in self.batch.findings)
                raise ValueError(f"poses: {error}{found}") from None
            posed = self._joined(scene, files)
        with Bar("what poses say"):
            dataset = data.load(scene, semantics=False)
            names = [path.name for path in list_images(scene / "images")]
            findings = diagnosis.of_poses(dataset, names, summary) + diagnosis.of_exposure(dataset, self.args.seed)
        line = f"{len(posed)} of {len(files)} further photographs have a pose, {len(dataset.views)} of all together"
        return line, findings

    def _joined(self, scene: Path, files: list[Path]) -> list[str]:
        """Names of the further photographs that have a pose in the data set."""
        named = {path.resolve() for path in files}
        views = data.load(scene, lazy=True, points=False, semantics=False).views
        return [view.name for view in views if view.image_path and view.image_path.resolve() in named]

    def _given(self) -> Outcome:
        """What is to be said of a data set that has poses."""
        assert self.given is not None
        dataset = self._dataset(FitConfig())
        views = len(dataset.views)
        findings = []
        if not dataset.is_dynamic:
            names = [view.name for view in dataset.views]
            findings = diagnosis.of_poses(dataset, names) + diagnosis.of_exposure(dataset, self.args.seed)
        return f"{views} photographs with their poses, as the data set has them", findings

    def _fit(self) -> Outcome:
        """Gaussians: new ones, or, of photographs that join others, those that there are and more."""
        config = self.config
        before = begin = None
        if self.is_added:
            before = self._make_room()
            config, goes_on = self._further_config()
            begin = before if goes_on else None
        resume = is_run(self.args.output)
        if resume:
            config = _config_of(self.run_folder)
        dataset = self._dataset(config)
        pace, plan = None, None
        if self.clock.end is not None and not dataset.is_dynamic:
            if not resume:
                plan = plan_fit(dataset, config, self.clock.left, config.density.max_gaussians if begin else 1)
                config = plan.config(config)
                self.batch.plan["fit"] = dataclasses.asdict(plan)
                self.record.write()
                self._say(plan.line(self.clock.left, time.monotonic() - self.clock.began))
            elif "fit" in self.batch.plan:
                plan = FitPlan(**self.batch.plan["fit"])
            rest = plan.after if plan else 0.1 * self.clock.left
            pace = Pacer(self.clock.end - rest, config.max_steps)
        result = fit(
            dataset, self.args.output, config, resume=resume, progress=not self.args.quiet, pace=pace, begin=begin
        )
        mean = result.metrics["mean"]
        quality = f", held-out PSNR {mean['psnr']:.2f} dB" if result.metrics["views"] and mean.get("psnr") else ""
        size = config.data.max_pixels
        self.batch.result = {"psnr": mean.get("psnr") if quality else None, "max_pixels": size}
        earlier = self.record.batches[-2].result if self.is_added else {}
        if quality and earlier.get("psnr") is not None and earlier.get("max_pixels") == size:
            quality += f", {earlier['psnr']:.2f} dB before"
        if before is not None:
            with claim(self.folder, "capture") as held:
                held.remove(before)
        steps = result.metrics["step"]
        line = f"{len(result.gaussians)} Gaussians after {steps} steps{quality}"
        record = fit_record(result.run)
        psnr = {row["name"]: row["psnr"] for row in result.metrics["views"] if row.get("psnr") is not None}
        return line, diagnosis.of_views(dataset, record.train, psnr if result.metrics["split"] == "test" else {})

    def _make_room(self) -> Path:
        """The checkpoint of the fit so far, beside the run, whose files give way to those of a fit that goes on."""
        kept = self.folder / _BEFORE
        if not self.batch.handover:
            tensors, header = last_checkpoint(self.run_folder)
            if tensors is None or header is None:
                raise ValueError(f"{self.args.output}: must hold a checkpoint to go on from, found none; capture anew")
            save_state(kept, tensors, header)
            record = fit_record(self.run_folder)
            self.batch.plan["before"] = {
                "config": record.config.to_json(),
                "views": len(record.train),
            }
            self._hand_over("kept")
        if self.batch.handover == "kept":
            with claim_run(self.run_folder, "capture") as held:
                for name in (*FILES, "renders", NEXT, *(file for file, _ in _PAGES.values())):
                    held.remove(self.run_folder.path / name)
            self._hand_over("cleared")
        return kept

    def _further_config(self) -> tuple[FitConfig, bool]:
        """That of the fit before, with more Gaussians where there are more photographs; and whether the fit goes on.

        Where many join, it begins anew: what was fitted to too few photographs is in the wrong places.
        """
        told = self.batch.plan["before"]
        before = recorded_config(told["config"])
        views = load_dataset(self.folder / _SCENE, before, lazy=True, points=False, semantics=False)
        train, _ = views.split(before.data.test_every, before.data.test_offset, before.data.test_cameras)
        most = round(before.density.max_gaussians * max(1.0, len(train) / told["views"]))
        joined = len(train) - told["views"]
        goes_on = joined <= _ANEW * told["views"]
        if not goes_on:
            self._say(f"fit: from the beginning, {joined} photographs to fit to have joined {told['views']}")
        config = before.replace(
            max_steps=max(1, round(_SHARE_OF_STEPS * before.max_steps)) if goes_on else before.max_steps,
            seed=self.args.seed,
            density=dataclasses.replace(before.density, max_gaussians=most),
        )
        return config, goes_on

    def _hand_over(self, state: str) -> None:
        self.batch.handover = state
        self.record.write()

    def _page(self, file: str, write: Callable[[Run], None]) -> Outcome:
        """A page of the run, at its end."""
        with claim_run(self.run_folder, "capture") as held:
            held.check([file])
            write(self.run_folder)
        return str(self.run_folder.path / file), []

    def _finish(self) -> None:
        """What to know at the next shoot, and what to do now."""
        self._say_findings(self.batch.findings)
        run = shlex.quote(str(self.args.output))
        used = time.monotonic() - self.clock.began
        of = "" if self.clock.budget is None else f" of {duration(self.clock.budget)}"
        self._say(f"done in {duration(used)}{of}")
        self._say(f"next: drgs view {run}; which photographs to take next: drgs capture --more -o {run}")

    # ---------------------------------------------------------------------------------------- helpers

    def _dataset(self, config: FitConfig) -> Dataset:
        """The data set to fit to."""
        place = self.folder / _SCENE if self.given is None else self.given.path
        return load_dataset(place, config)

    def _say(self, text: str) -> None:
        if not self.args.quiet:
            print(text, flush=True)

    def _say_findings(self, findings: list[Finding]) -> None:
        """What is wrong with the capture, one line each."""
        for finding in findings:
            self._say(f"at the next shoot: {finding.line()}")


def _write_report(run: Run) -> None:
    """The report of a run, as `drgs report` writes it."""
    record = fit_record(run)
    dataset = load_dataset(record.data, record.config, lazy=True, points=False, semantics=False)
    report_of(run, run.path / FILE, record.with_refined_poses(dataset))


def _write_scene(run: Run) -> None:
    """The page to send, as `drgs share` writes it."""
    share.run(Share(scene=run.path, quiet=True))


_PAGES: dict[str, tuple[str, Callable[[Run], None]]] = {
    "report": (FILE, _write_report),
    "share": (share.SHARED_FILE, _write_scene),
}
"""Steps at the end, in their order: the file in the run that each makes, and how."""


def _links_to(folder: Path, files: list[Path]) -> list[Path]:
    """What in a folder is a link to one of the files."""
    named = {path.resolve() for path in files}
    return [path for path in folder.iterdir() if path.is_symlink() and path.resolve() in named]


def _config_of(run: Run) -> FitConfig:
    """The configuration that a fit goes on with: the checkpoint's, which config.json and the files that are made of the
    checkpoint may differ from where there was no room for them.
    """
    if run.state.is_file():
        return recorded_config(state_header(run.state)["config"])
    return fit_record(run).config
