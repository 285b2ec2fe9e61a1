"""What a fit finds of its photographs besides the scene: where that is built, and what config.json says of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drgs.display.progress import Bar
from drgs.fitting.exposure import estimate_exposure

if TYPE_CHECKING:
    import numpy as np

    from drgs.fitting.active import ActiveViews
    from drgs.fitting.config import FitConfig
    from drgs.fitting.exposure import ExposureEstimate
    from drgs.fitting.frames import Frame
    from drgs.fitting.poses import PoseEvidence
    from drgs.fitting.skybox import SkyboxChoice
    from drgs.fitting.trainer import Trainer
    from drgs.information.nuisances import Nuisance
    from drgs.io.run import Run

__all__ = ["check_photographs", "estimated_of", "join", "photographs_record"]


def check_photographs(config: FitConfig, moves: bool) -> None:
    """Refuse what is modeled of single photographs where that is not built.

    Raises:
        NotImplementedError: With a skybox where views are chosen on the way or things move; where things move, with
            poses, because a field explains a camera's error as well and the photographs of one camera at many times
            have one pose, not many, and with transients, which are found by what neighbors show of the same surface at
            rest.
    """
    if config.data.poses != "fixed" and moves:
        raise NotImplementedError(
            f"fit: poses must be fixed where things move, got {config.data.poses}: what moves would explain their "
            "errors, too; leave --poses out, or refine them on photographs of what stands still (--dynamics ignore)"
        )
    if config.data.skybox == "on" and (config.selection or moves):
        raise NotImplementedError(
            "fit: skybox must be off or auto where views are chosen on the way or things move, got on; leave --skybox "
            "out"
        )
    if config.loss.transients != "keep" and moves:
        raise NotImplementedError(
            f"fit: transients must be keep where things move, got {config.loss.transients}; leave --transients out, or "
            "fit to what stands still (--dynamics ignore)"
        )


def estimated_of(trainer: Trainer) -> list[Nuisance]:
    """Unknowns of the photographs that a fit estimates beside the scene, as it is now."""
    parts = trainer.parts
    exposure: list[Nuisance] = ["exposure"] if parts.exposure is not None else []
    return exposure + (["pose"] if parts.poses is not None else [])


def join(trainer: Trainer, plan: ActiveViews, frame: Frame, given: np.ndarray | None) -> ExposureEstimate | None:
    """Begin with what is unknown of a photograph that has been picked, as far as the fit estimates it.

    Args:
        trainer: The fit, to which `add_frame` adds the photograph afterwards.
        plan: The views that are seen, this one last.
        frame: The photograph.
        given: (P, 3) points of the data set; None where they are not read.
    Returns:
        What points say of the exposure of all photographs, this one last; None where the fit does not look.
    """
    use = trainer.config.data.exposure
    if use == "off":
        trainer.add_unknowns(frame)
        return None
    frames = [*trainer.photographs(), frame]
    with Bar("exposure") as bar:
        points, shown = plan.compared_points(given)
        found = estimate_exposure(frames, points, trainer.config.seed, shown)
        # A few points of the first photographs may have said something else than all of them do.
        is_on = use != "auto" or found.is_clear
        if is_on != (trainer.parts.exposure is not None):
            now = "each has its own" if is_on else "off, all have the same"
            bar.note(f"exposure: {found.words()}; {now} from step {trainer.step_index} on")
    if not is_on:
        trainer.drop_exposure()
    trainer.add_unknowns(frame, found if is_on else None)
    plan.exposure = found.to_json([frame.name for frame in frames])
    return found


def photographs_record(
    run: Run,
    trainer: Trainer,
    exposure: ExposureEstimate | None,
    poses: PoseEvidence | None,
    skybox: SkyboxChoice | None,
) -> dict[str, Any]:
    """What config.json is to say of what a fit finds of its photographs.

    Args:
        run: The run folder; a fit that goes on keeps what was found at its start.
        trainer: The fit.
        exposure, poses: What was found just now; None where nobody looked.
        skybox: What was chosen just now; None of a fit that goes on.
    """
    recorded = _exposure_record(run, trainer, exposure) | _poses_record(run, trainer, poses)
    recorded |= _skybox_record(run, trainer, skybox)
    estimated = estimated_of(trainer)
    return recorded | ({"estimated": estimated} if estimated else {})


def _exposure_record(run: Run, trainer: Trainer, found: ExposureEstimate | None) -> dict[str, Any]:
    """What config.json is to say of exposure.

    Args:
        run: The run folder; a fit that goes on keeps what was found at its start.
        trainer: The fit.
        found: What points said of it just now; None if they were not asked.
    """
    recorded: dict[str, Any] = {}
    if found is not None:
        recorded["exposure"] = found.to_json([frame.name for frame in trainer.frames])
    elif trainer.config.data.exposure != "off" and (run.path / "config.json").is_file():
        recorded |= {name: x for name, x in run.config().items() if name == "exposure"}
    return recorded


def _poses_record(run: Run, trainer: Trainer, found: PoseEvidence | None) -> dict[str, Any]:
    """What config.json is to say of poses; arguments as of `_exposure_record`."""
    refined = trainer.parts.poses is not None
    if found is not None:
        return {"poses": found.to_json(refined)}
    if trainer.config.data.poses == "fixed":
        return {}
    # A fit that goes on, whose config.json may have been moved away.
    before = run.config() if (run.path / "config.json").is_file() else {}
    return {"poses": before.get("poses", {"reprojection": None, "refined": refined})}


def _skybox_record(run: Run, trainer: Trainer, choice: SkyboxChoice | None) -> dict[str, Any]:
    """What config.json is to say of a skybox: `choice` of a fit that begins, None of one that goes on."""
    if choice is not None:
        return {"skybox": choice.to_json(trainer.rows.skybox)}
    # Its config.json may have been moved away, and one of before says nothing of fits that did not look.
    before = run.config() if (run.path / "config.json").is_file() else {}
    here = {"skybox": {"gaussians": trainer.rows.skybox, "reason": None}} if trainer.rows.skybox else {}
    return {name: x for name, x in (here | before).items() if name == "skybox"}
