"""Gaussians from photographs with known cameras, and what a teacher says or what moves in them.

The loop around `drgs.fitting.trainer`: run folder, checkpoints, progress, previews, and metrics of held-out views at
the end.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs import metrics, runtime
from drgs.codecs.ply import save_ply
from drgs.data.camera_lists import save_cameras_json
from drgs.data.view_checks import check_cameras, check_parallax
from drgs.display.pictures import file_names, write_png
from drgs.display.progress import Bar
from drgs.ellipsoids import colors_only
from drgs.fitting.active import ActiveViews
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
from drgs.fitting.exposure import NETWORK as EXPOSURE
from drgs.fitting.frames import Frame, frames_for, warn_of_late_cameras
from drgs.fitting.lenses import lens_choice
from drgs.fitting.parts import parts_of, with_exposure, with_poses
from drgs.fitting.photographs import check_photographs, estimated_of, join, photographs_record
from drgs.fitting.poses import CAMERAS, POSE_NETWORK
from drgs.fitting.records import config_record, pick_seconds, seconds_of
from drgs.fitting.renderers import renderers_to_measure
from drgs.fitting.resume import keep_previous, last_checkpoint, lock_run
from drgs.fitting.semantic_record import SemanticRecord, check_same_teacher
from drgs.fitting.skybox import visible_share
from drgs.fitting.stages import moving_labels
from drgs.fitting.start import motion_of, start
from drgs.fitting.telling import told
from drgs.fitting.threads import fewer_torch_threads, one_thread
from drgs.fitting.trainer import StepResult, Trainer
from drgs.guards.memory import is_out_of_memory
from drgs.integrator import render
from drgs.io import interrupts
from drgs.io.checkpoint import save_state
from drgs.io.outputs import lock_folder
from drgs.io.run import Run
from drgs.runtime.machine import peak_memory

if TYPE_CHECKING:
    from drgs.data import Dataset
    from drgs.ellipsoids import Gaussians
    from drgs.fitting.parts import Parts
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

_log = logging.getLogger(__name__)

Pace = Callable[[int, int], int]
"""Steps done, steps of the whole fit -> steps that the whole fit is to have."""

_PREVIEWS = 10
_LOG_EVERY = 20  # steps whose loss and PSNR are averaged in one event


@dataclasses.dataclass(frozen=True)
class FitResult:
    """What `fit` leaves behind.

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
    parts: Parts | None = None,
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
        parts: Terms of the loss, rates, networks and what is rendered; default those of `config`. Every fit must have
            its own: they hold networks and their optimizers.
        resume: Continue from the last checkpoint, or from the start if there is none yet.
        progress: Show it on stderr: a bar on a terminal, lines elsewhere.
        workers: Processes that compute what candidates of an active fit tell, as `drgs.select` takes them.
        pace: Called after every step with the steps done and those of the whole fit; returns how many the whole fit is
            to have. Where that is another number, schedules go on from the share that is then done, and config.json
            says so. Only where nothing moves and all views are fitted to.
        begin: Checkpoint of another fit (`state.safetensors`), in the same world, whose Gaussians this one begins with
            instead of points; points of the data set that new photographs show are added, as far as there is room.
            Only where nothing moves, all views are fitted to, and there are no features.
    Raises:
        ValueError: On a bad config, data set or run folder, when another process writes there, and when losses stay
            not finite.
        MemoryError: When there is none left; the last checkpoint stays.
        KeyboardInterrupt: On Ctrl-C, SIGTERM and SIGHUP, after a checkpoint and the PLY have been written.
    """
    config = config or FitConfig()
    runtime.backend()  # sets torch's threads too, at first use
    threads = one_thread() if config.deterministic else contextlib.nullcontext()
    with lock_run(Run(out_dir), "fit", resume, [dataset.path]), threads, Bar("fit", show=progress):
        try:
            return _fit(dataset, out_dir, config, parts, resume, workers, pace, None if begin is None else Path(begin))
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            raise MemoryError(
                f"{out_dir}: there must be more memory, none was left; what the last checkpoint holds is kept, free "
                "some and go on with --resume, or fit again with fewer --max-pixels or --max-gaussians"
            ) from error


def _fit(
    dataset: Dataset,
    out_dir: str | Path,
    config: FitConfig,
    parts: Parts | None,
    resume: bool,
    workers: Workers | None,
    pace: Pace | None = None,
    begin: Path | None = None,
) -> FitResult:
    """`fit` in a run folder that is claimed: what there is to fit or to go on from, all steps, and the metrics."""
    train, test = dataset.split(config.data.test_every, config.data.test_offset, config.data.test_cameras)
    if train:
        check_parallax(train)
        check_cameras(train)
    lenses = None
    if config.data.undistort == "auto":
        with Bar("lenses") as bar:
            lenses = lens_choice(config, train)
            if lenses.words():
                bar.note(lenses.words())
        config = config.replace(data=dataclasses.replace(config.data, undistort=lenses.undistort))
    run = Run(out_dir)
    motion = motion_of(config, train, test) if parts is None else None
    selection = config.selection
    if pace is not None and (selection or motion is not None):
        raise ValueError("fit: pace must be None where views are chosen on the way or things move; leave it out")
    if begin is not None and (selection or motion is not None or parts is not None):
        raise ValueError(
            "fit: begin must be None where views are chosen on the way, things move or parts are a caller's own; "
            "leave it out"
        )
    check_photographs(config, motion is not None)
    plan = ActiveViews(train, config, motion is not None, workers) if selection else None
    if selection and selection.measure and not test:
        raise ValueError("active: --measure must have held-out views, got none; hold some out (--test-every)")
    # Parts of a caller's own say themselves what is fitted to what.
    begun = [plan.views[i] for i in plan.chosen] if plan else train
    taught = SemanticRecord.of(dataset, config, begun) if parts is None else None
    if plan and parts is None:
        plan.check_blocks({"semantic": taught is not None, "deformation": motion is not None})
    tensors, header = _checkpoint(run, plan, taught) if resume else (None, None)
    frames = plan.frames() if plan else frames_for(train, config.data)
    held_out = frames_for(test, config.data)
    if plan is None and tensors is None:
        warn_of_late_cameras(dataset, [*frames, *held_out])
    if begin is not None and taught is not None:
        raise ValueError("fit: begin must be None where features are fitted, too; ignore semantics, or fit anew")
    if taught and taught.embeddings:
        from drgs.fitting.segments import check_references

        check_references(held_out)
    if tensors is not None and header is not None:
        made = parts or parts_of(config, header["extent"], taught.channels if taught else None)
        if parts is None and EXPOSURE in header.get("networks", ()):
            made = with_exposure(made, frames, config)
        if parts is None and POSE_NETWORK in header.get("networks", ()):
            made = with_poses(made, frames, config, header["extent"])
        trainer = Trainer.from_state(config, frames, tensors, header, str(run.path), made, motion)
        seconds = seconds_of(run, header) or 0.0
        exposure = evidence = choice = None
        source = header["point_source"]
        config = trainer.config  # with the renderers that it began with
    else:
        views, room = (plan.start_views(), plan.reserved) if plan else (train, 0)
        looks = plan is not None and parts is None and config.data.exposure != "off"
        compared = plan.compared_points(dataset.points) if plan and looks else None
        trainer, source, exposure, evidence, choice = start(
            dataset, views, frames, config, parts, taught, plan is not None, room, motion, compared, begin
        )
        if plan and exposure is not None:
            plan.exposure = exposure.to_json(plan.names)
        seconds = 0.0
    recorded = config_record(dataset, config, plan, taught, frames, held_out, source, motion.times if motion else ())
    recorded |= photographs_record(run, trainer, exposure, evidence, choice)
    earlier = run.config() if resume and (run.path / "config.json").is_file() else {}
    began = earlier.get("begin", None if begin is None else str(begin))
    recorded |= {} if began is None else {"begin": began}
    recorded |= {"exposure": plan.exposure} if plan and plan.exposure else {}
    recorded |= {"lenses": lenses.to_json()} if lenses and lenses.lost else {}
    poses = trainer.parts.poses
    _check_pictures(out_dir, config.max_steps, held_out, taught is not None)
    run.start(recorded, resume=resume)
    if taught:
        taught.write_embeddings(run.path, dataset.semantics)
    if plan:
        plan.write(run)  # forgets picks that no checkpoint knows of
    run.log("resume" if trainer.step_index else "start", step=trainer.step_index, gaussians=len(trainer.rows))
    moving = moving_labels(dataset) if motion else frozenset()

    def measured(pictures: Path | None = None) -> dict:
        shown = _segmentation(trainer, taught, run, held_out)
        return metrics.evaluate(
            trainer.scene(), held_out, config.settings, pictures=pictures, segmentation=shown, moving=moving
        )

    joins = _Joins(dataset.points, recorded, parts is None) if plan else None
    loop = _Loop(run, trainer, held_out, source, seconds, plan, taught, measured, joins)
    if pace is not None:
        loop.keep_pace(pace, recorded)
    if begin is not None and trainer.step_index == 0:
        loop.save()  # the run shows from now on what it begins with
    with fewer_torch_threads(), Bar("fit", config.max_steps, done=trainer.step_index) as bar:
        if len(named := [settings.nearest_preset()[0] for settings in trainer.renderers.all_settings]) > 1:
            bar.note(f"every step has one of the renderers {', '.join(named)}; --for fast fits for one alone")
        loop.run(bar)
    g, scene = trainer.gaussians(), trainer.scene()
    moved = None
    if motion is not None:
        with Bar("timing the deformation") as bar:
            moved = motion.report(trainer.rows, bar.update)
    refined: dict[str, Any] = {}
    if poses is not None:
        with Bar("poses") as bar:
            bar.note(poses.words())
        refined = {"poses": {**poses.displacement(), **metrics.refined_scores(scene, held_out, config.settings)}}
    result = measured(run.renders / "test")
    written = metrics.write_metrics(
        run,
        "test",
        held_out,
        result,
        split_rule=recorded["split_rule"],
        gaussians=len(g),
        step=trainer.step_index,
        seconds=loop.seconds,
        bad_steps=trainer.bad_steps,
        renderers=metrics.through_renderers(
            scene,
            held_out or trainer.photographs(),
            renderers_to_measure(config.renderers, config.settings, lenses=config.data.undistort == "off"),
            "test" if held_out else "train",
            None if held_out else metrics.TRAIN_VIEWS,
        ),
        **({"fitted": plan.names, "pool_leak": plan.pool_leak} if plan else {}),
        **({"motion": moved} if moved else {}),
        **refined,
        **_skybox_summary(trainer),
        **({"transients": trainer.transients.summary(trainer.frames)} if trainer.transients.found else {}),
    )
    done: dict[str, Any] = {"peak_memory": peak_memory(), **({"motion": moved} if moved else {})}
    run.log("done", step=trainer.step_index, seconds=loop.seconds, mean=written["mean"], **done)
    return FitResult(g, written, run, loop.seconds)


def _skybox_summary(trainer: Trainer) -> dict[str, Any]:
    """What metrics.json is to say of a skybox: how many Gaussians it has, and how much of it photographs show."""
    count = trainer.rows.skybox
    if not count:
        return {}
    frames = trainer.photographs()
    frames = frames[:: -(-len(frames) // metrics.TRAIN_VIEWS)]
    share = visible_share(trainer.gaussians(), count, frames, trainer.config.settings)
    return {"skybox": {"gaussians": count, "visible": share}}


def _checkpoint(
    run: Run, plan: ActiveViews | None, taught: SemanticRecord | None
) -> tuple[dict[str, torch.Tensor], dict] | tuple[None, None]:
    """The last checkpoint of the same fit, if there is one; the plan goes on from the views that it has."""
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
    check_same_teacher(taught, SemanticRecord.from_json(header.get("semantics"), str(run.state)), str(run.path))
    return tensors, header


def _segmentation(trainer: Trainer, taught: SemanticRecord | None, run: Run, frames: list[Frame]) -> Any:
    """What `metrics.evaluate` takes to measure the labels of a fit; None without features."""
    if taught is None:
        return None
    from drgs.fitting.segments import segmentation_of

    decoder: Any = trainer.network("decoder")
    return segmentation_of(trainer.gaussians(), decoder, taught.read_classes(run.path), taught, frames)


def _check_pictures(out_dir: str | Path, max_steps: int, held_out: list[Frame], semantics: bool) -> None:
    """Refuse, before the first step, a folder where pictures that drgs did not draw are in the way."""
    every = _preview_every(max_steps)
    names = [_preview_name(step) for step in range(every, max_steps + 1, every)]
    kinds = metrics.VIEW_PICTURES if semantics else metrics.VIEW_PICTURES[:1]
    names += [f"test/{name}.{kind}" for name in file_names([frame.name for frame in held_out]) for kind in kinds]
    with lock_folder(out_dir, "fit", [f"renders/{name}" for name in names]):
        pass


def _preview_every(max_steps: int) -> int:
    return max(1, max_steps // _PREVIEWS)


def _preview_name(step: int) -> str:
    return f"preview_{step:06d}.png"


@dataclasses.dataclass(frozen=True)
class _Joins:
    """What photographs that join an active fit have to do with.

    Attributes:
        points: (P, 3) points of the data set; None where they are not read.
        recorded: Contents of config.json, which changes where more is known of exposure.
        looks: Whether photographs have unknowns that the config asks for: the parts are not the caller's own.
    """

    points: np.ndarray | None
    recorded: dict[str, Any]
    looks: bool


class _Loop:
    """Steps, and the files that are due at them."""

    def __init__(
        self,
        run: Run,
        trainer: Trainer,
        held_out: list[Frame],
        source: str,
        seconds: float,
        plan: ActiveViews | None,
        taught: SemanticRecord | None,
        measured: Callable[[], dict],
        joins: _Joins | None = None,
    ) -> None:
        self.run_folder = run
        self.trainer = trainer
        self.held_out = held_out
        self.source = source
        self.seconds = seconds
        self.plan = plan
        self.taught = taught
        self._measured = measured
        self._joins = joins
        self._pace: Pace | None = None
        self._recorded: dict[str, Any] = {}
        self._recent: list[StepResult] = []
        self._psnr: float | None = None  # of the last steps
        self._saved: tuple[int, int] | None = None  # steps and views of the last checkpoint
        self._saved_at = time.monotonic()

    def keep_pace(self, pace: Pace, recorded: dict[str, Any]) -> None:
        """Ask after every step how many the fit is to have; `recorded`, contents of config.json, change with them."""
        self._pace = pace
        self._recorded = recorded

    def _follow_pace(self, pace: Pace, bar: Bar) -> None:
        """Have as many steps as asked for, and record it."""
        trainer = self.trainer
        done, before = trainer.step_index, trainer.config.max_steps
        wanted = max(done, pace(done, before))
        if wanted == before or done >= before:
            return
        if wanted == done:
            wanted = done + 1  # schedules have an end that is not behind them
        trainer.reschedule(wanted)
        self._recorded["fit"] = trainer.config.to_json()
        self.run_folder.record(self._recorded)
        self.run_folder.log("rescheduled", step=done, before=before, max_steps=wanted)
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
                            "not saved, the last step was not finite; --resume goes on at the last checkpoint"
                        )
                    self.save()
                    raise interrupts.interruption(f"saved at step {trainer.step_index}, --resume goes on")
                while self.plan and self.plan.is_due(trainer.step_index):
                    self.save()  # measuring and choosing may take minutes, and can be interrupted anywhere
                    with interrupts.at_once():
                        if self.plan.is_to_be_measured:
                            self.plan.add_measured(trainer.step_index, self._measured())
                        self._pick(self.plan, bar)
                began = time.perf_counter()
                step = trainer.step()
                self.seconds += time.perf_counter() - began
                done = trainer.step_index
                for line in told(step.events):
                    bar.note(f"step {done - 1}: {line}")
                self._log(step)
                if step.psnr is not None:
                    self._psnr = 0.98 * (self._psnr or step.psnr) + 0.02 * step.psnr
                shown = "" if self._psnr is None else f"{self._psnr:.2f} dB, "
                bar.update(done, text=f"{shown}{len(trainer.rows)} Gaussians")
                if self._pace is not None:
                    self._follow_pace(self._pace, bar)
                # What a step has spoiled shows in the next one: good checkpoints stay until losses are finite again.
                late = time.monotonic() - self._saved_at > 60 * config.saving.save_minutes
                is_due = late or done % config.saving.save_every == 0
                if done >= trainer.config.max_steps or is_due and trainer.is_sound:
                    self.save()
                if done % preview_every == 0:
                    self._preview(bar, is_interrupted)
            self.save()  # of a fit that went on from its last step

    def save(self) -> None:
        """The checkpoint, then what is made of it, for which there may be no room: cameras and the PLY, which knows no
        time and holds what moves at rest. Nothing where all of it is there.
        """
        now = self.trainer.step_index, len(self.trainer.frames)
        if now == self._saved:
            return
        tensors, header = self.trainer.state()
        header |= {"point_source": self.source}
        header |= {"semantics": self.taught.to_json()} if self.taught else {}
        if self.plan:
            more_tensors, more_header = self.plan.state()
            tensors, header = tensors | more_tensors, header | more_header
        keep_previous(self.run_folder)
        save_state(self.run_folder.state, tensors, header)
        self.run_folder.log("checkpoint", step=self.trainer.step_index, seconds=self.seconds)
        if self.trainer.parts.poses is not None:
            save_cameras_json(self.run_folder.path / CAMERAS, self.trainer.parts.poses.cameras())
        save_ply(self.trainer.gaussians(), self.run_folder.point_cloud)
        self._saved = now
        self._saved_at = time.monotonic()

    def _pick(self, plan: ActiveViews, bar: Bar) -> None:
        """Choose one more view, and add its photograph and points to the fit."""
        trainer = self.trainer
        decoder: Any = trainer.network("decoder")
        seen, estimated = trainer.photographs(), estimated_of(trainer)
        frame, record = plan.pick(trainer.scene(), seen, trainer.step_index, decoder, estimated)
        self._join(plan, frame)
        if start := plan.new_start():
            trainer.restart(*start)
            record["points"] = len(start[0])
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

    def _join(self, plan: ActiveViews, frame: Frame) -> None:
        """Begin with what is unknown of a photograph that was picked, and record what was found."""
        trainer, joins = self.trainer, self._joins
        if joins is None or not joins.looks:
            trainer.add_unknowns(frame)
            return
        found = join(trainer, plan, frame, joins.points)
        if found is None:
            return
        used = trainer.parts.exposure is not None
        told = {key: x for key, x in found.to_json(plan.names).items() if key != "gains"}
        self.run_folder.log("exposure", step=trainer.step_index, **told, used=used)
        joins.recorded["exposure"] = plan.exposure
        joins.recorded.pop("estimated", None)
        if estimated := estimated_of(trainer):
            joins.recorded["estimated"] = estimated
        self.run_folder.record(joins.recorded)

    def _log(self, step: StepResult) -> None:
        """The events of a step, and every so often the averages of the last ones."""
        done = self.trainer.step_index
        for event in step.events:
            self.run_folder.log(event.pop("event"), step=done - 1, **event)
        self._recent.append(step)
        if done % _LOG_EVERY == 0 or done == self.trainer.config.max_steps:
            psnr = [x.psnr for x in self._recent if x.psnr is not None]
            loss = [x.loss for x in self._recent if math.isfinite(x.loss)]
            features = [value for x in self._recent if math.isfinite(value := x.terms.get("features", math.nan))]
            self.run_folder.log(
                "train",
                step=done,
                loss=float(np.mean(loss)) if loss else None,
                psnr=float(np.mean(psnr)) if psnr else None,
                **({"features": float(np.mean(features))} if features else {}),
                gaussians=len(self.trainer.rows),
                **({} if (moving := self._moving()) is None else {"moving": moving}),
                seconds=self.seconds,
            )
            self._recent = []

    def _moving(self) -> float | None:
        """Part of the Gaussians that move, in the dynamic stage of a fit that has one."""
        trainer = self.trainer
        return None if trainer.motion is None else trainer.motion.share(trainer.rows)

    def _preview(self, bar: Bar, is_interrupted: Callable[[], bool]) -> None:
        """One picture, and the PSNR of all held-out views, unless the fit is interrupted."""
        trainer, done = self.trainer, self.trainer.step_index
        frames = self.held_out or trainer.photographs()[:1]
        values = []
        for i, frame in enumerate(frames):
            if is_interrupted():
                return
            with torch.no_grad():  # a picture
                seen = colors_only(trainer.scene(), frame.camera.time)
                image = render(seen, frame.camera, trainer.config.settings).rgb.cpu().clamp(0, 1)
            values.append(metrics.psnr(image, frame.image(), frame.mask))
            if i == 0:
                pair = torch.cat([frame.image(), image], dim=1)
                write_png(self.run_folder.renders / _preview_name(done), pair.numpy())
        psnr = float(np.mean(values)) if self.held_out else None
        self.run_folder.log("preview", step=done, test_psnr=psnr, gaussians=len(trainer.rows), seconds=self.seconds)
        shown = "" if psnr is None else f", held-out PSNR {psnr:.2f} dB"
        total = trainer.config.max_steps
        bar.note(f"step {done} of {total}: {len(trainer.rows)} Gaussians{shown}, {self.seconds:.0f} s")
