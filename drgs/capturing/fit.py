"""The step `fit` of a capture: Gaussians, within a budget, and again when further photographs have joined."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.capturing import diagnosis
from drgs.capturing.budget import FitPlan, Pacer, plan_fit
from drgs.capturing.capture import Capture, config_of
from drgs.capturing.expected_errors import of_expected_error
from drgs.fitting.config import FitConfig
from drgs.fitting.records import fit_record, is_run
from drgs.fitting.resume import last_checkpoint, lock_run, run_files
from drgs.io.checkpoint import save_state
from drgs.io.outputs import lock_folder
from drgs.pages.report.write import FILE as REPORT
from drgs.pages.sharing.scene import FILE as PAGE
from drgs.train import FitResult, fit
from drgs.viewing.placed_views import NEXT

if TYPE_CHECKING:
    from drgs.capturing.poses import Outcome
    from drgs.sfm.findings import Finding

NEW_FIT_SHARE = 0.5
"""Of the photographs before, as many that join: beyond, the fit begins anew, since what was fitted to too few
photographs is in the wrong places. Of six that joined ten and two that joined fourteen, benchmarks/batches.py measures
both ways."""

_JOINED_STEPS = 0.5  # of the steps of the fit before, that further photographs get without a budget
_BEFORE = "before.safetensors"  # checkpoint that a fit to further photographs begins with
_REPORT_SHARE = 0.1  # of the time left, for held-out views and pages, where no plan says


def fit_photographs(capture: Capture) -> Outcome:
    """Fit Gaussians: new ones or, when photographs were added, those of the run and more.

    Raises:
        ValueError: If there is nothing that the fit could begin with.
    """
    before = begin = None
    config = capture.config
    if capture.is_added:
        before = _put_checkpoint_aside(capture)
        config, continues = _config_with_more_photographs(capture)
        begin = before if continues else None
    resume = is_run(capture.options.output)
    if resume:
        config = config_of(capture.run)
    pace = None
    if capture.clock.end is not None and not capture.dataset.is_dynamic:
        config, pace = _within_budget(capture, config, capture.clock.end, resume, begin is not None)
    result = fit(
        capture.dataset,
        capture.options.output,
        config,
        resume=resume,
        progress=capture.options.progress,
        pace=pace,
        begin=begin,
    )
    quality = _quality(capture, result, config.data.max_pixels)
    if before is not None:
        with lock_folder(capture.folder, "capture") as held:
            held.remove(before)
    steps, planned = result.metrics["step"], capture.batch.plan.get("fit", {}).get("max_steps")
    instead = "" if planned in (None, steps) else f" ({planned} were planned, the budget allowed {steps})"
    line = f"{len(result.gaussians)} Gaussians after {steps} steps{instead}{quality}"
    findings = diagnosis.of_held_out(capture.dataset, fit_record(result.run).train, result.metrics)
    return line, findings + _of_expected_error(capture)


def _of_expected_error(capture: Capture) -> list[Finding]:
    """Where the fit is expected to be wrong; a line says so where the photographs are not there to say it."""
    try:
        return of_expected_error(capture.run, capture.refined_dataset())
    except (OSError, ValueError) as error:
        capture.say(f"fit: it cannot be said where it is wrong, {error}")
        return []


def _within_budget(
    capture: Capture, config: FitConfig, end: float, resume: bool, begins: bool
) -> tuple[FitConfig, Pacer]:
    """The configuration with sizes that the time allows, and the pacer that ends the fit in time."""
    clock, plan = capture.clock, None
    if not resume:
        plan = plan_fit(capture.dataset, config, clock.left, config.density.max_gaussians if begins else 1)
        config = plan.config(config)
        capture.plan("fit", plan)
        capture.say(plan.line(clock.left, clock.used))
    elif "fit" in capture.batch.plan:
        plan = FitPlan(**capture.batch.plan["fit"])
    after = plan.after if plan else _REPORT_SHARE * clock.left
    return config, Pacer(end - after, config.max_steps)


def _quality(capture: Capture, result: FitResult, max_pixels: int) -> str:
    """PSNR of the held-out views, beside that of the fit before where it was measured at the same size; recorded."""
    mean = result.metrics["mean"].get("psnr")
    psnr = mean if result.metrics["views"] and mean else None
    capture.batch.result = {"psnr": psnr, "max_pixels": max_pixels}
    if psnr is None:
        return ""
    earlier: dict[str, Any] = capture.record.batches[-2].result if capture.is_added else {}
    is_comparable = earlier.get("psnr") is not None and earlier.get("max_pixels") == max_pixels
    return f", held-out PSNR {psnr:.2f} dB" + (f", {earlier['psnr']:.2f} dB before" if is_comparable else "")


def _put_checkpoint_aside(capture: Capture) -> Path:
    """Move the checkpoint out of the run's files, which the next fit replaces; returns its path."""
    kept, batch, run = capture.folder / _BEFORE, capture.batch, capture.run
    if not batch.handover:
        tensors, header = last_checkpoint(run)
        if tensors is None or header is None:
            raise ValueError(f"{run.path}: must hold a checkpoint to go on from, found none; capture anew")
        save_state(kept, tensors, header)
        record = fit_record(run)
        batch.plan["before"] = {"config": record.config.to_json(), "views": len(record.train)}
        batch.handover = "kept"
        capture.record.write()
    if batch.handover == "kept":
        with lock_run(run, "capture") as held:
            for name in (*run_files(), "renders", NEXT, REPORT, PAGE):
                held.remove(run.path / name)
        batch.handover = "cleared"
        capture.record.write()
    return kept


def _config_with_more_photographs(capture: Capture) -> tuple[FitConfig, bool]:
    """The configuration of the last fit, with more Gaussians for more photographs; and whether the fit begins with
    what there is.
    """
    recorded = capture.batch.plan["before"]
    before, views = FitConfig.from_json(recorded["config"]), recorded["views"]
    train, _ = capture.dataset.split(before.data.test_every, before.data.test_offset, before.data.test_cameras)
    joined = len(train) - views
    continues = joined <= NEW_FIT_SHARE * views
    if not continues:
        capture.say(f"fit: from the beginning, {joined} photographs to fit to have joined {views}")
    most = round(before.density.max_gaussians * max(1.0, len(train) / views))
    config = before.replace(
        max_steps=max(1, round(_JOINED_STEPS * before.max_steps)) if continues else before.max_steps,
        seed=capture.options.seed,
        density=dataclasses.replace(before.density, max_gaussians=most),
    )
    return config, continues
