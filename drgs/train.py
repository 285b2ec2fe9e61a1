"""Gaussians from photographs with known cameras, and what a teacher says or what moves in them.

The loop around `drgs.fitting.trainer`: run folder, checkpoints, progress, previews, and metrics of held-out views at
the end.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs import runtime
from drgs.codecs.ply import save_ply
from drgs.data.view_checks import check_cameras, check_parallax
from drgs.display.pictures import file_names, write_png
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians, colors_only
from drgs.fitting import metrics
from drgs.fitting.active import ActiveViews
from drgs.fitting.components.base import Component, Setup, check_conflicts
from drgs.fitting.components.table import components_of
from drgs.fitting.config import (
    DataConfig,
    DensityConfig,
    FeatureConfig,
    FitConfig,
    LossConfig,
    MotionConfig,
    RateConfig,
    SavingConfig,
    SelectionConfig,
)
from drgs.fitting.errors import fit_errors, is_cheap
from drgs.fitting.frames import Frame, frames_for, measurable, warn_of_late_cameras
from drgs.fitting.records import config_record, pick_seconds, seconds_of
from drgs.fitting.renderers import renderers_to_measure
from drgs.fitting.resolution import updates_of
from drgs.fitting.resume import keep_previous, last_checkpoint, lock_run
from drgs.fitting.stages import fitted_times
from drgs.fitting.start import start
from drgs.fitting.trainer import StepResult, Trainer
from drgs.integrator import render
from drgs.io import interrupts
from drgs.io.checkpoint import save_state
from drgs.io.outputs import lock_folder
from drgs.io.run import Run
from drgs.runtime.machine import peak_memory
from drgs.runtime.memory import is_out_of_memory
from drgs.runtime.threads import fewer_torch_threads, one_thread

if TYPE_CHECKING:
    from drgs.data import Dataset
    from drgs.selection.pool import Workers

__all__ = [
    "DataConfig",
    "DensityConfig",
    "FeatureConfig",
    "FitConfig",
    "FitResult",
    "LossConfig",
    "MotionConfig",
    "Pace",
    "RateConfig",
    "SavingConfig",
    "SelectionConfig",
    "Trainer",
    "fit",
]

Pace = Callable[[int, int], int]
"""Steps done, steps of the whole fit -> steps that the whole fit is to have."""

_PREVIEWS = 10  # pictures of a held-out view in the course of a fit; chosen: a picture takes as long as some steps
_LOG_EVERY = 20  # steps whose loss and PSNR are averaged in one event of the log; chosen: a curve of 50 points in 1,000


@dataclasses.dataclass(frozen=True)
class FitResult:
    """Result of `fit`.

    Attributes:
        gaussians: The Gaussians, also in `run.point_cloud`; those of a scene that moves are at rest.
        metrics: Contents of metrics.json.
        run: The run folder.
        seconds: Wall time of all steps, of resumed runs together.
    """

    gaussians: Gaussians
    metrics: dict
    run: Run
    seconds: float


def fit(
    dataset: Dataset,
    out_dir: str | Path,
    config: FitConfig | None = None,
    *,
    components: Sequence[Callable[[], Component]] | None = None,
    resume: bool = False,
    progress: bool = True,
    workers: Workers | None = None,
    pace: Pace | None = None,
    begin: str | Path | None = None,
) -> FitResult:
    """Fit Gaussians to a data set and write a run folder.

        result = drgs.fit(drgs.load_data("scene"), "runs/scene", drgs.FitConfig(max_steps=3000))
        result.metrics["mean"]["psnr"]  # of the held-out views

    Args:
        dataset: Result of `drgs.data.load`.
        out_dir: The run folder: new, or with `resume` one that a fit of the same config has begun.
        config: What to do; the defaults if left out. With a `selection` the fit begins with a few views and chooses
            more on the way; the data set is best loaded with `lazy=True` and without points, so that nothing of views
            that are not chosen is read.
        components: Classes, or other makers, of what the fit has besides photographs and Gaussians
            (docs/extending.md); default all of `drgs.fitting.components.table.COMPONENTS`.
        resume: Continue from the last checkpoint, or from the start if there is none yet.
        progress: Show it on stderr: a bar on a terminal, lines elsewhere.
        workers: Processes that score the candidates of an active fit, as `drgs.select` takes them.
        pace: Called after every step with the steps done and those of the whole fit; returns how many the whole fit is
            to have. Where that is another number, schedules go on from the share that is then done, and config.json
            says so. Only where nothing moves and all views are fitted to.
        begin: Checkpoint of another fit (`state.safetensors`), in the same world, whose Gaussians this one begins with
            instead of points; points of the data set that new photographs show are added, as far as there is room.
            Only where nothing moves, all views are fitted to, and there are no features.
    Raises:
        ValueError: On a bad config, data set or run folder, when another process writes there, and when losses stay
            not finite.
        NotImplementedError: If components cannot stand beside each other.
        MemoryError: When there is none left; the last checkpoint stays.
        KeyboardInterrupt: On Ctrl-C, SIGTERM and SIGHUP, after a checkpoint and the PLY have been written.
    """
    config = config or FitConfig()
    runtime.backend()  # sets torch's threads too, at first use
    threads = one_thread() if config.deterministic else contextlib.nullcontext()
    run, first = Run(out_dir), None if begin is None else Path(begin)
    with lock_run(run, "fit", resume, [dataset.path]), threads, Bar("fit", show=progress):
        try:
            setup, plan = _setup_of(dataset, config, components, workers, pace, first)
            return _fit(run, setup, plan, resume, pace, first)
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            raise MemoryError(
                f"{out_dir}: there must be more memory, none was left; what the last checkpoint holds is kept, free "
                "some and go on with --resume, or fit again with fewer --max-pixels or --max-gaussians"
            ) from error


def _setup_of(
    dataset: Dataset,
    config: FitConfig,
    components: Sequence[Callable[[], Component]] | None,
    workers: Workers | None,
    pace: Pace | None,
    begin: Path | None,
) -> tuple[Setup, ActiveViews | None]:
    """The setup of a fit before photographs are decoded, and the plan of an active fit; raises where options contradict
    each other.
    """
    train, test = dataset.split(config.data.test_every, config.data.test_offset, config.data.test_cameras)
    if train:
        check_parallax(train)
        check_cameras(train)
    selection = config.selection
    given = {"selection": selection, "begin": begin, "pace": pace}
    if selection and (other := next((name for name in ("begin", "pace") if given[name] is not None), None)):
        raise ValueError(f"fit: {other} must be None where views are chosen on the way; leave it out")
    times = fitted_times(config, train, test)
    modes = frozenset(name for name, value in given.items() if value is not None)
    setup = Setup(dataset, config, train, test, train, times, components_of(components), modes)
    check_conflicts(setup)
    plan = ActiveViews(train, config, bool(times), workers) if selection else None
    if selection and selection.measure and not test:
        raise ValueError("active: --measure must have held-out views, got none; hold some out (--test-every)")
    if plan:
        setup.views = [plan.views[i] for i in plan.chosen]
    for component in setup.components:
        component.prepare(setup)
    check_conflicts(setup)  # again, as what `auto` means is known now
    if plan:
        plan.check_blocks(dict(x.block for x in setup.components if x.block and x.setting(setup) is None))
        plan.check_region(None if config.features.semantics == "ignore" else dataset.semantics)
        setup.picked_points, setup.reserved = plan.compared_points, plan.reserved
    return setup, plan


def _fit(
    run: Run, setup: Setup, plan: ActiveViews | None, resume: bool, pace: Pace | None, begin: Path | None
) -> FitResult:
    """`fit` in a run folder that is claimed: from the first Gaussians, or a checkpoint, to the metrics."""
    tensors, header = _checkpoint(run, plan) if resume else (None, None)
    setup.frames = plan.frames() if plan else frames_for(setup.train, setup.config.data)
    setup.held_out = measurable(frames_for(setup.test, setup.config.data), "fit")
    if not setup.frames:
        raise ValueError("fit: there must be at least one training view, got none; add photographs")
    if plan is None and tensors is None:
        warn_of_late_cameras(setup.dataset, [*setup.frames, *setup.held_out])
    for component in setup.components:
        component.begin(setup, tensors is not None)
    if tensors is not None and header is not None:
        components = list(setup.components)
        trainer = Trainer.from_state(setup.config, setup.frames, tensors, header, str(run.path), components)
        source, seconds = header["point_source"], seconds_of(run, header) or 0.0
    else:
        setup.config = setup.config.replace(updates_per_step=updates_of(setup))
        setup.views = plan.start_views() if plan else setup.train
        trainer, source = start(setup, begin)
        seconds = 0.0
    before = run.config() if resume and (run.path / "config.json").is_file() else {}
    recorded = config_record(setup, trainer, source, plan, before, begin)
    _check_pictures(run, setup, trainer)
    run.start(recorded, resume=resume)
    for component in trainer.components:
        component.write_files(run.path)
    if plan:
        plan.write(run)  # forgets picks that no checkpoint knows of
    run.log("resume" if trainer.step_index else "start", step=trainer.step_index, gaussians=len(trainer.rows))
    loop = _Loop(run, trainer, setup, plan, source, seconds, recorded, pace)
    if begin is not None and trainer.step_index == 0:
        loop.save()  # the run shows from now on what it begins with
    with fewer_torch_threads(), Bar("fit", trainer.config.max_steps, done=trainer.step_index) as bar:
        if len(named := [settings.nearest_preset()[0] for settings in trainer.renderers.all_settings]) > 1:
            bar.note(f"every step has one of the renderers {', '.join(named)}; --for fast fits for one alone")
        loop.run(bar)
    return _result_of(loop)


def _result_of(loop: _Loop) -> FitResult:
    """Measure what was fitted, and write metrics.json."""
    run, trainer, setup, plan = loop.run_folder, loop.trainer, loop.setup, loop.plan
    gaussians, config, held_out = trainer.gaussians(), trainer.config, setup.held_out
    chosen: dict[str, Any] = {"fitted": plan.names, "pool_leak": plan.pool_leak} if plan else {}
    reported: dict[str, Any] = {}
    for component in trainer.components:
        reported |= component.metrics(trainer, held_out)
    options = loop.evaluation()
    result = loop.measured(run.renders / "test", options)
    written = metrics.write_metrics(
        run,
        "test",
        held_out,
        result,
        split_rule=loop.recorded["split_rule"],
        gaussians=len(gaussians),
        step=trainer.step_index,
        seconds=loop.seconds,
        bad_steps=trainer.bad_steps,
        renderers=metrics.through_renderers(
            trainer.scene(),
            held_out or measurable(trainer.photographs(), "fit"),
            renderers_to_measure(config.renderers, config.settings, lenses=config.data.undistort == "off"),
            "test" if held_out else "train",
            metrics.most_views(config.max_steps) if held_out else metrics.TRAIN_VIEWS,
            options.get("as_photograph"),
        ),
        **chosen,
        **reported,
    )
    loop.record_errors(trainer.step_index)
    # `drgs eval` writes other metrics.json, without what only the fit can say.
    memory = peak_memory()
    run.log("done", step=trainer.step_index, seconds=loop.seconds, mean=written["mean"], peak_memory=memory, **reported)
    return FitResult(gaussians, written, run, loop.seconds)


def _checkpoint(run: Run, plan: ActiveViews | None) -> tuple[dict[str, torch.Tensor], dict] | tuple[None, None]:
    """The last checkpoint of the same fit, if there is one; the plan continues with its views."""
    tensors, header = last_checkpoint(run)
    if tensors is None or header is None:
        return None, None
    was, now = ("active" if x else "all" for x in (header.get("active"), plan))
    if was != now:
        raise ValueError(
            f"{run.path}: --resume must continue the same fit, --views was {was!r} and is {now!r}; "
            "repeat the options or choose another run folder"
        )
    if plan:
        plan.restore(tensors, header, str(run.path))
        plan.picks = pick_seconds(run, plan.picks)
    return tensors, header


def _check_pictures(run: Run, setup: Setup, trainer: Trainer) -> None:
    """Raise ValueError, before the first step, if pictures would replace files that drgs did not write."""
    steps = trainer.config.max_steps
    every = _preview_every(steps)
    names = [_preview_name(step) for step in range(every, steps + 1, every)]
    kinds = [metrics.VIEW_PICTURES[0], *(kind for component in trainer.components for kind in component.pictures)]
    names += [f"test/{name}.{kind}" for name in file_names([frame.name for frame in setup.held_out]) for kind in kinds]
    with lock_folder(run.path, "fit", [f"renders/{name}" for name in names]):
        pass


def _preview_every(max_steps: int) -> int:
    return max(1, max_steps // _PREVIEWS)


def _preview_name(step: int) -> str:
    return f"preview_{step:06d}.png"


class _Loop:
    """Steps, and the files that are due at them."""

    def __init__(
        self,
        run: Run,
        trainer: Trainer,
        setup: Setup,
        plan: ActiveViews | None,
        source: str,
        seconds: float,
        recorded: dict[str, Any],
        pace: Pace | None = None,
    ) -> None:
        """
        Args:
            run: The run folder.
            trainer, setup, plan: The fit, what it began with, and its views if they are chosen on the way.
            source: Where the first Gaussians came from, in words.
            seconds: Wall time of the steps so far.
            recorded: Contents of config.json, which changes with the pace and with photographs that join.
            pace: As of `fit`.
        """
        self.run_folder = run
        self.trainer = trainer
        self.setup = setup
        self.held_out = setup.held_out
        self.plan = plan
        self.source = source
        self.seconds = seconds
        self.recorded = recorded
        self._pace = pace
        self._is_rescheduled = False
        self._recent: list[StepResult] = []
        self._psnr: float | None = None  # of the last steps
        self._saved: tuple[int, int] | None = None  # steps and views of the last checkpoint
        self._saved_at = time.monotonic()
        self._recorded = trainer.step_index  # steps at the last record of errors

    def evaluation(self) -> dict[str, Any]:
        """Arguments of `drgs.fitting.metrics.evaluate` as things are now."""
        options: dict[str, Any] = {}
        for component in self.trainer.components:
            options |= component.evaluation(self.trainer, self.held_out)
        return options

    def measured(self, pictures: Path | None = None, options: Mapping[str, Any] | None = None) -> dict:
        """Metrics of the held-out views as things are now; `pictures` and `options` as of `evaluate`."""
        trainer, options = self.trainer, self.evaluation() if options is None else options
        return metrics.evaluate(trainer.scene(), self.held_out, trainer.config.settings, pictures=pictures, **options)

    def _follow_pace(self, pace: Pace, bar: Bar) -> None:
        """Have as many steps as `pace` says, and record it."""
        trainer = self.trainer
        done, before = trainer.step_index, trainer.config.max_steps
        wanted = max(done, pace(done, before))
        if wanted == before or done >= before:
            return
        if wanted == done:
            wanted = done + 1  # schedules have an end that is not behind them
        trainer.reschedule(wanted)
        self.recorded["fit"] = trainer.config.to_json()
        self.run_folder.record(self.recorded)
        self.run_folder.log("rescheduled", step=done, before=before, max_steps=wanted)
        if not self._is_rescheduled:  # it may change many times more
            bar.note(f"step {done}: {wanted} steps in place of {before}, as the time left allows; it may change again")
            self._is_rescheduled = True
        bar.update(done, wanted)

    def run(self, bar: Bar) -> None:
        """All steps that are left, or as many as there are until the fit is interrupted."""
        trainer, config = self.trainer, self.trainer.config
        preview_every = _preview_every(config.max_steps)
        if self.plan:
            trainer.reserved = self.plan.reserved
        # In the middle of a step the Gaussians may be half-way through density control: not a state to save.
        with interrupts.between_steps() as is_interrupted:
            while trainer.step_index < trainer.config.max_steps:
                if is_interrupted():
                    self.run_folder.log("interrupted", step=trainer.step_index)
                    if not trainer.is_sound:
                        raise interrupts.interruption(
                            "not saved, the last step was not finite; --resume continues at the last checkpoint"
                        )
                    self.save()
                    raise interrupts.interruption(f"saved at step {trainer.step_index}, --resume continues")
                while self.plan and self.plan.is_due(trainer.step_index):
                    self.save()  # measuring and choosing may take minutes, and can be interrupted anywhere
                    with interrupts.at_once():
                        if self.plan.is_to_be_measured:
                            self.plan.add_measured(trainer.step_index, self.measured())
                        self._pick(self.plan, bar)
                began = time.perf_counter()
                step = trainer.step()
                self.seconds += time.perf_counter() - began
                done = trainer.step_index
                for line in (line for event in step.events for line in trainer.describe(event)):
                    bar.note(f"step {done - 1}: {line}")
                self._log(step)
                if step.psnr is not None:
                    self._psnr = 0.98 * (self._psnr or step.psnr) + 0.02 * step.psnr
                shown = "" if self._psnr is None else f"training PSNR {self._psnr:.2f} dB, "
                bar.update(done, text=f"{shown}{len(trainer.rows)} Gaussians")
                if self._pace is not None:
                    self._follow_pace(self._pace, bar)
                # What a step has spoiled shows in the next one: good checkpoints stay until losses are finite again.
                late = time.monotonic() - self._saved_at > 60 * config.saving.save_minutes
                is_due = late or done % config.saving.save_every == 0
                if done >= trainer.config.max_steps or is_due and trainer.is_sound:
                    self.save()
                    if done < trainer.config.max_steps and is_cheap(trainer, done - self._recorded):
                        with interrupts.at_once():
                            self.record_errors(done - self._recorded)
                if done % preview_every == 0:
                    self._preview(bar, is_interrupted)
            self.save()  # of a fit that went on from its last step

    def save(self) -> None:
        """The checkpoint, then what is made of it, for which there may be no room: files of components, and the PLY,
        which knows no time and holds what moves at rest. Nothing where all of it is there.
        """
        now = self.trainer.step_index, len(self.trainer.frames)
        if now == self._saved:
            return
        tensors, header = self.trainer.state()
        header |= {"point_source": self.source}
        if self.plan:
            more_tensors, more_header = self.plan.state()
            tensors, header = tensors | more_tensors, header | more_header
        keep_previous(self.run_folder)
        save_state(self.run_folder.state, tensors, header)
        self.run_folder.log("checkpoint", step=self.trainer.step_index, seconds=self.seconds)
        for component in self.trainer.components:
            component.write_files(self.run_folder.path)
        save_ply(self.trainer.gaussians(), self.run_folder.point_cloud)
        self._saved = now
        self._saved_at = time.monotonic()

    def record_errors(self, steps: int) -> None:
        """What photographs say about the errors of the scene as it is now, for those who look at the run; `steps` as
        of `fit_errors`.
        """
        began = time.perf_counter()
        found = fit_errors(self.run_folder, self.trainer, steps)
        self._recorded = self.trainer.step_index
        self.run_folder.log("errors", step=self._recorded, **found, seconds=time.perf_counter() - began)

    def _pick(self, plan: ActiveViews, bar: Bar) -> None:
        """Choose one more view, and add its photograph and points to the fit."""
        trainer = self.trainer
        scoring = plan.scoring
        for component in trainer.components:
            scoring = component.scoring(scoring)
        scoring = scoring.over(trainer.nuisances)
        labels = next((x for component in trainer.components if (x := component.labels())[0]), (None, None))
        frame, record = plan.pick(trainer.scene(), trainer.photographs(), trainer.step_index, scoring, labels)
        self._join(frame)
        if again := plan.new_start():
            trainer.restart(*again)
            record["points"] = len(again[0])
        else:
            points, colors, dense = plan.points(frame, trainer.scene())
            if len(points):
                trainer.add_points(points, colors, *trainer.config.density.start_of(dense))
            record["points"] = len(points)
        trainer.reserved = plan.reserved
        trainer.add_frame(frame)
        shown = ("step", "number", "index", "name", "score", "parts", "margin", "seconds", "points")
        self.run_folder.log("pick", **{key: record[key] for key in shown}, candidates=len(record["candidates"]))
        self.save()
        plan.write(self.run_folder)
        bar.note(
            f"step {trainer.step_index}: added view {frame.name} ({record['number']} of {plan.timetable.add}, chosen "
            f"by {plan.active.policy} among {len(record['candidates'])} in {record['seconds']:.1f} s)"
        )
        for note in record["notes"] if plan.active.region is not None else ():
            bar.note(f"step {trainer.step_index}: {note}")

    def _join(self, frame: Frame) -> None:
        """Let components begin with a photograph that was picked, and record what they found."""
        trainer = self.trainer
        events = [x for component in trainer.components for x in component.join(trainer, frame, self.setup)]
        for event in events:
            self.run_folder.log(event.pop("event"), step=trainer.step_index, **event)
        if events:
            self.recorded.pop("estimated", None)
            self.recorded |= {"estimated": trainer.nuisances} if trainer.nuisances else {}
            for component in trainer.components:
                self.recorded |= component.record(trainer, self.recorded)
            self.run_folder.record(self.recorded)

    def _log(self, step: StepResult) -> None:
        """The events of a step, and every so often the averages of the last ones."""
        done = self.trainer.step_index
        for event in step.events:
            self.run_folder.log(event.pop("event"), step=done - 1, **event)
        self._recent.append(step)
        if done % _LOG_EVERY == 0 or done == self.trainer.config.max_steps:
            psnr = [x.psnr for x in self._recent if x.psnr is not None]
            loss = [x.loss for x in self._recent if math.isfinite(x.loss)]
            fields: dict[str, Any] = {}
            for component in self.trainer.components:
                fields |= component.log_fields(self.trainer, [x.terms for x in self._recent])
            self.run_folder.log(
                "train",
                step=done,
                loss=float(np.mean(loss)) if loss else None,
                psnr=float(np.mean(psnr)) if psnr else None,
                gaussians=len(self.trainer.rows),
                **fields,
                seconds=self.seconds,
            )
            self._recent = []

    def _preview(self, bar: Bar, is_interrupted: Callable[[], bool]) -> None:
        """One picture, and the PSNR of all held-out views, unless the fit is interrupted."""
        trainer, done = self.trainer, self.trainer.step_index
        frames = self.held_out or [frame for frame in trainer.photographs() if frame.is_measurable][:1]
        as_photograph = self.evaluation().get("as_photograph")
        values = []
        for i, frame in enumerate(frames):
            if is_interrupted():
                return
            with torch.no_grad():  # a picture
                seen = colors_only(trainer.scene(), frame.camera.time)
                out = render(seen, frame.camera, trainer.config.settings)
                out = out if as_photograph is None else as_photograph(out, frame)
            image = out.rgb.cpu().clamp(0, 1)
            values.append(metrics.psnr(image, frame.image(), frame.mask))
            if i == 0:
                pair = torch.cat([frame.image(), image], dim=1)
                write_png(self.run_folder.renders / _preview_name(done), pair.numpy())
        psnr = float(np.mean(values)) if self.held_out else None
        self.run_folder.log("preview", step=done, test_psnr=psnr, gaussians=len(trainer.rows), seconds=self.seconds)
        shown = "" if psnr is None else f", held-out PSNR {psnr:.2f} dB"
        total = trainer.config.max_steps
        bar.note(f"step {done} of {total}: {len(trainer.rows)} Gaussians{shown}, {self.seconds:.0f} s")
