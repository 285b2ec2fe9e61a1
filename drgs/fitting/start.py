"""What a fit begins with: a trainer at its first step, from points of the data set or of its training views."""

from __future__ import annotations

import dataclasses
import logging
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.data import scene_extent
from drgs.display.progress import Bar
from drgs.ellipsoids import Y_00
from drgs.fitting.frames import frames_for
from drgs.fitting.going_on import begin_with
from drgs.fitting.losses import psnr_of
from drgs.fitting.parts import parts_of, with_exposure, with_poses
from drgs.fitting.rows import GaussianRows
from drgs.fitting.skybox import RADIUS, SHARE, Skybox, SkyboxChoice, far_evidence, why_not
from drgs.fitting.stages import first_time, times_of
from drgs.fitting.trainer import Trainer
from drgs.integrator import render
from drgs.sfm.guided import Matches
from drgs.sfm.points import initial_points, shared_points

if TYPE_CHECKING:
    from pathlib import Path

    from drgs.data import Dataset, View
    from drgs.fitting.config import FitConfig
    from drgs.fitting.dynamics import Motion
    from drgs.fitting.exposure import ExposureEstimate
    from drgs.fitting.frames import Frame
    from drgs.fitting.parts import Parts
    from drgs.fitting.poses import PoseEvidence
    from drgs.fitting.semantic_record import SemanticRecord

__all__ = ["motion_of", "start"]

_log = logging.getLogger("drgs.train")

_TRIAL = {"max_steps": 200, "max_gaussians": 8_000, "num_downscales": 0}
_TRIAL_PIXELS = 12_000  # of a photograph; two fits of 200 steps take 10 to 20 s on one core
_TRIAL_EVERY = 5  # photographs of which one is held out


def motion_of(config: FitConfig, train: list[View], test: list[View]) -> Motion | None:
    """The stages of a fit to views; None if nothing can move in them, or is to: then nothing of it is loaded.

    Args:
        config: Configuration of the fit.
        train: Training views; two times among them make a fit dynamic.
        test: Held-out views, whose times the field covers, too.
    Raises:
        ValueError: If some views have a time and others do not.
        NotImplementedError: With a 3D filter, whose rates are those of what stands still.
    """
    if config.motion.dynamics == "ignore" or not times_of(train):
        return None
    if config.filter_3d == "on":
        raise NotImplementedError(
            "fit: filter_3d must be off where things move, got on; leave --filter-3d out, or fit to what stands still "
            "(--dynamics ignore)"
        )
    from drgs.fitting.dynamics import Motion

    return Motion(config, times_of([*train, *test]))


def _choose_skybox(
    frames: list[Frame], config: FitConfig, has_own_parts: bool, picks: bool, moves: bool
) -> SkyboxChoice:
    """Whether Gaussians are to begin far away, by what is fitted, by what data say is behind everything, and by what
    photographs show.

    Args:
        frames: Training photographs.
        config: Configuration of the fit.
        has_own_parts: Whether what is fitted to what is a caller's own.
        picks: Whether views are chosen on the way.
        moves: Whether things move.
    Raises:
        ValueError: If a skybox is asked for where data say what is behind everything.
    """
    against = {
        "skybox is off": config.data.skybox == "off",
        "the parts of the fit are a caller's own": has_own_parts,
        "views are chosen on the way": picks,
        "things move": moves,
    }
    if reasons := [reason for reason, holds in against.items() if holds]:
        return SkyboxChoice(reasons[0])
    with Bar("skybox") as bar:
        reason = why_not(frames, config.settings.background)
        if reason is not None and config.data.skybox == "on":
            raise ValueError(f"fit: skybox must be off or auto here, got on: {reason}; leave --skybox out")
        if reason is not None:
            bar.note(f"skybox: none, {reason}")
            return SkyboxChoice(reason)
        found = far_evidence(frames, scene_extent([frame.camera for frame in frames]), config.seed)
        is_on = config.data.skybox == "on" or found.is_clear
        bar.note(f"skybox: {found.words()}; {'there is one' if is_on else 'there is none'}")
        return SkyboxChoice(None if is_on else "photographs do not clearly agree on what is far away", found)


def start(
    dataset: Dataset,
    views: list[View],
    frames: list[Frame],
    config: FitConfig,
    parts: Parts | None,
    taught: SemanticRecord | None,
    strict: bool,
    reserved: int,
    motion: Motion | None = None,
    compared: tuple[np.ndarray, np.ndarray | None] | None = None,
    begin: Path | None = None,
) -> tuple[Trainer, str, ExposureEstimate | None, PoseEvidence | None, SkyboxChoice]:
    """A trainer at step 0, where its points come from, what is known of exposure and poses, where asked for, and
    whether Gaussians begin far away.

    Points come, by default, if `strict`, only from `views`; then nothing is known of observations, either, and exposure
    is looked at again with every photograph that joins. `compared` are the points by which it is, as of
    `ActiveViews.compared_points`; default the initial points. `begin` is a checkpoint whose Gaussians the fit begins
    with, instead of points.
    """
    if not frames:
        raise ValueError("fit: there must be at least one training view, got none; add photographs")
    if begin is not None:
        with Bar("Gaussians of the earlier fit") as bar:
            beginning = begin_with(begin, frames, dataset.points, dataset.colors, config)
            bar.note(f"begins with {beginning.source}")
        model = beginning.rows
        points = model.tensors["means"].detach()[model.skybox :].numpy()  # places that are compared, no gradient
        extent = scene_extent([frame.camera for frame in frames], points)
        choice = SkyboxChoice("the fit goes on from Gaussians of another one")
        compared = _compared(dataset, views, config, None)
        made = parts_of(config, extent, None)
        made, found, evidence = _unknowns(dataset, frames, config, made, extent, points, compared)
        return Trainer(config, frames, model, extent, made), beginning.source, found, evidence, choice
    choice = _choose_skybox(frames, config, parts is not None, strict, motion is not None)
    room = max(1, round(SHARE * config.density.max_gaussians)) if choice.reason is None else 0
    # Points that a data set brings along may have seen all its views; ours are made from the training views alone.
    given = config.data.init_points in (("all",) if strict else ("auto", "all")) and dataset.points is not None
    matches = Matches()
    with Bar("initial points") as bar:
        seen = views if motion is None else first_time(views)
        points, colors, source = initial_points(
            dataset if given else seen,
            config.seed,
            config.density.max_gaussians - reserved - room,
            bar.stage,
            matches,
            None if strict else seen,
        )
        bar.note(f"initial points: {source}")
    extent = scene_extent([frame.camera for frame in frames], points)
    dense = not given and any(view.depth_path is not None for view in views)
    width, channels = (taught.width, taught.channels) if taught else (0, None)
    model = GaussianRows.from_points(
        torch.from_numpy(points), torch.from_numpy(colors), *config.density.start_of(dense), features=width
    )
    _log.info("%d initial points: %s", len(points), source)
    partial = {view.name for view in dataset.views if not view.empty_outside}
    masked = sum(frame.name in partial and (frame.mask is not None or frame.alpha is not None) for frame in frames)
    if masked and config.data.mask in ("auto", "object"):
        is_object = config.data.mask == "object"
        _log.warning(
            "%d of %d training photographs have a mask or an alpha channel, and the others show what is outside: %s",
            masked,
            len(frames),
            "--mask object says nevertheless that nothing is there; leave it out, or mask all of them"
            if is_object
            else "it is taken as unknown (--mask valid); mask all of them, or say --mask ignore to use all pixels",
        )
    if empty := [x for x in (frame.empty() for frame in frames) if x is not None]:
        share = float(sum(x.sum() for x in empty)) / sum(frame.pixels[..., 0].numel() for frame in frames)
        color = " ".join(f"{x:g}" for x in config.settings.background)
        transparent = any(frame.alpha is not None for frame in frames)
        _log.info(
            "%.0f %% of the training pixels show nothing, by masks or alpha: %s is behind them%s%s",
            100 * share,
            color,
            " (--background; readers of D-NeRF's and Blender's data sets take 1 1 1)"
            if transparent and not any(config.settings.background)
            else "",
            "; until the end PSNR counts them, too" if transparent else "",
        )
    made = parts or parts_of(config, extent, channels)
    if room:
        with Bar("colors of the skybox"):
            skybox = Skybox.around(frames, extent, room, config.seed)
        model.add_skybox(skybox.rows(width))
        _log.info("skybox: %d Gaussians, %.4g and more away", len(skybox), RADIUS * extent)
    found = evidence = None
    if parts is None:
        if motion is None and not strict:
            compared = _compared(dataset, views, config, None if given else matches)
        trial = None if compared is None or strict else (views, model)
        made, found, evidence = _unknowns(dataset, frames, config, made, extent, points, compared, strict, trial)
    return Trainer(config, frames, model, extent, made, motion), source, found, evidence, choice


def _compared(
    dataset: Dataset, views: list[View], config: FitConfig, matches: Matches | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Points by which the exposure of photographs is compared, and which show them, as `shared_points` says.

    Args:
        dataset, views, config: Arguments of `start`.
        matches: The matches of these views; None where nothing was matched: it is done only if the fit asks for
            exposure.
    """
    if matches is None and config.data.exposure != "off":
        matches = Matches()
    with Bar("points that photographs share") as bar:
        return shared_points(dataset, views, config.seed, matches, bar.stage)


def _trial(views: list[View], model: GaussianRows, config: FitConfig, extent: float, found: ExposureEstimate) -> float:
    """By how many dB gains change photographs that two short fits, with them and without, did not see: the
    mean of what they change at gain 1, as held-out views are shown, and at the gain that suits each photograph best.
    Points say nothing of a white wall, which has none.

    Args:
        views: V views.
        model: Gaussians that the fit begins with.
        config, extent: Configuration of the fit, and extent of the scene.
        found: What points say of the gains of the V photographs.
    """
    frames = frames_for(views, config.data, min(_TRIAL_PIXELS, config.data.max_pixels))
    held_out = frames[_TRIAL_EVERY // 2 :: _TRIAL_EVERY]
    rest = [row for row in range(len(frames)) if row % _TRIAL_EVERY != _TRIAL_EVERY // 2]
    if not held_out:
        return 0.0
    short = config.replace(**_TRIAL, max_pixels=_TRIAL_PIXELS)
    start = model.gaussians().detach()  # where both begin
    kept = torch.randperm(len(start) - model.skybox, generator=torch.Generator().manual_seed(config.seed))
    kept = kept[: short.density.max_gaussians] + model.skybox
    colors = (0.5 + Y_00 * start.sh[kept, 0]).clamp(0, 1)
    errors = []
    with Bar("whether exposure is of use", 2 * short.max_steps) as bar:
        for use in (False, True):
            rows = GaussianRows.from_points(start.means[kept], colors, *short.density.start_of(False))
            parts = parts_of(short, extent)
            seen = [frames[row] for row in rest]
            if use:
                gains = found.log_gains[rest] - found.log_gains[rest].mean(axis=0)
                parts = with_exposure(parts, seen, short, dataclasses.replace(found, log_gains=gains))
            trainer = Trainer(short, seen, rows, extent, parts)
            for _ in range(short.max_steps):
                trainer.step()
                bar.advance()
            errors.append([_psnr(trainer, frame, short, suited) for frame in held_out for suited in (False, True)])
    return float(np.mean(errors[1]) - np.mean(errors[0]))


def _psnr(trainer: Trainer, frame: Frame, config: FitConfig, suited: bool) -> float:
    """Of a photograph that the trainer has not seen, in dB; `suited`: with gains of R, G and B that suit it best."""
    with torch.no_grad():  # a measure
        rgb = render(trainer.scene(), frame.camera, config.settings, outputs=()).rgb.cpu().clamp(0, 1)
    target = frame.image()
    weight = torch.ones_like(target) if frame.mask is None else frame.mask[..., None].expand_as(target)
    if suited:
        gain = (weight * rgb * target).sum(dim=(0, 1)) / (weight * rgb * rgb).sum(dim=(0, 1)).clamp(min=1e-12)
        rgb = (gain * rgb).clamp(max=1)
    error = (rgb - target).square()
    return psnr_of(float((weight * error).sum() / weight.sum().clamp(min=1e-12)))


def _unknowns(
    dataset: Dataset,
    frames: list[Frame],
    config: FitConfig,
    made: Parts,
    extent: float,
    points: np.ndarray,
    compared: tuple[np.ndarray, np.ndarray | None] | None = None,
    strict: bool = False,
    trial: tuple[list[View], GaussianRows] | None = None,
) -> tuple[Parts, ExposureEstimate | None, PoseEvidence | None]:
    """Parts with what is unknown of photographs, exposure and poses, where that is asked for or clear; and what is
    known of both.

    Args:
        dataset, frames, config, extent, strict: Arguments of `start`, and the extent of the scene.
        made: Parts without.
        points: Initial points (P, 3).
        compared: Points (P, 3) by which photographs are compared, and (V, P) bool, which photograph shows which; None
            for the initial points, each of which all may show.
        trial: Views and Gaussians for short fits that say whether gains are of use; None: there are none.
    """
    found = evidence = None
    if config.data.exposure == "off" and compared is not None:
        from drgs.fitting.exposure import estimate_exposure

        with Bar("exposure") as bar:
            if said := estimate_exposure(frames, compared[0], config.seed, compared[1]).warning():
                bar.note(said)
    if config.data.exposure != "off":
        from drgs.fitting.exposure import estimate_exposure

        with Bar("exposure") as bar:
            by, shown = compared or (points, None)
            found = estimate_exposure(frames, by, config.seed, shown)
            is_on = config.data.exposure != "auto" or (found.is_clear if trial is None else found.is_sound)
            if trial is not None and config.data.exposure == "auto" and is_on:
                found = found.confirmed()
                gained = _trial(*trial, config, extent, found)
                found, is_on = dataclasses.replace(found, gained=gained), gained > 0
            said = "each has its own" if is_on else "off, all have the same"
            now = " for now" if strict and config.data.exposure == "auto" else ""
            bar.note(f"exposure: {found.words()}; {said}{now}")
        if is_on:
            made = with_exposure(made, frames, config, found)
    if config.data.poses != "fixed":
        from drgs.fitting.poses import PoseEvidence

        with Bar("poses") as bar:
            all_seen = not strict or config.data.init_points == "all"
            evidence = PoseEvidence.of(dataset.reprojection if all_seen else None, frames)
            is_on = config.data.poses == "refined" or evidence.is_clear
            bar.note(f"poses: {evidence.words()}; {'refined with the scene' if is_on else 'fixed'}")
        if is_on:
            made = with_poses(made, frames, config, extent, evidence.reach)
    return made, found, evidence
