"""Measuring a run that has been fitted: all metrics of its views, with pictures, as `drgs fit` leaves them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from drgs.cameras.sizes import reduced_size
from drgs.display.pictures import file_names
from drgs.fitting.components.base import RunViews
from drgs.fitting.components.table import COMPONENTS
from drgs.fitting.frames import Frame, frames_for, load_dataset, measurable
from drgs.fitting.metrics import VIEW_PICTURES, Lpips, evaluate, through_renderers, write_metrics
from drgs.fitting.near_planes import warn_of_near_planes
from drgs.fitting.records import FitRecord, LoadedRun, fit_record, fitted_views, load_run
from drgs.fitting.renderers import renderers_to_measure
from drgs.fitting.stages import moving_labels

if TYPE_CHECKING:
    from drgs.data import Dataset, View
    from drgs.fitting.segments import Segmentation
    from drgs.io.outputs import LockedFolder
    from drgs.io.run import Run


def evaluate_run(
    run: Run,
    output: LockedFolder,
    split: str = "test",
    lpips: Lpips | None = None,
    strict: bool = False,
    renderer: str | None = None,
    scale: float = 1.0,
) -> dict[str, Any]:
    """Measure a run and write its metrics.json and the pictures of its views.

    Args:
        run: What to measure.
        output: Its folder, as `drgs.fitting.resume.lock_run` returns it.
        split: `test`, `train` (of an active fit the views that it saw) or `all`.
        lpips: LPIPS for `drgs.fitting.metrics.evaluate`.
        strict: Refuse a data set some of whose images are missing.
        renderer: Preset to measure with beside the run's own settings, or `all`; None: those that it was fitted for,
            and what viewers draw with.
        scale: Width and height of what is measured, in those of the fit's images; up to the photographs' own.
    Returns:
        What metrics.json holds.
    Raises:
        ValueError: If there is no such view, a photograph is not as large as `scale` asks for, or the run or its data
            set is damaged.
    """
    recorded, loaded = fit_record(run), load_run(run)
    scene, config = loaded.scene, recorded.config
    dataset = _dataset_of(recorded, strict)
    stated = {view.name: view.camera for view in dataset.split()[0]}
    train, test = recorded.with_refined_poses(dataset).split()
    more: dict[str, Any] = {} if scale == 1 else {"scale": scale}
    names = fitted_views(run, recorded)
    if recorded.is_active:  # the rest of the training split was never seen
        more |= {"fitted": names, "pool_leak": run.config().get("pool_leak")}
        train = [view for view in train if view.name in names]
    views = {"test": test, "train": train, "all": train + test}[split]
    if not views:
        raise ValueError(f"eval: split {split} must hold a view, holds none ({dataset.split_rule()}); use --split")
    frames = measurable(frames_for(views, config.data, _most_pixels(views, config.data.max_pixels, scale)), "eval")
    if not frames:
        raise ValueError(
            f"eval: split {split} must hold a view whose mask keeps a pixel, the {len(views)} masks keep none; mend "
            "them, or use --split"
        )
    _check_pictures(output, recorded, split, frames)
    known = RunViews(
        scene,
        config.settings,
        refined=bool(recorded.refined),
        stated=[stated[view.name] for view in train],
        cameras=[view.camera for view in train],
        held_out=frames if split == "test" and scale == 1 else [],
        names=names,
        photographs=lambda: frames_for(train, config.data),
        networks=loaded.networks,
    )
    options: dict[str, Any] = {}
    for component in COMPONENTS.values():
        options |= component.run_evaluation(known)
        more |= component.run_metrics(known)
    result = evaluate(
        scene,
        frames,
        config.settings,
        lpips=lpips,
        pictures=run.renders / split,
        segmentation=_segmentation(loaded, dataset, frames),
        moving=moving_labels(dataset) if recorded.times else frozenset(),
        **options,
    )
    wanted = renderers_to_measure(config.renderers, config.settings, renderer, config.data.undistort == "off")
    seen = scene.at(frames[0].camera.time)
    means = seen.means.detach().double().cpu().numpy() + seen.origin
    warn_of_near_planes(wanted, [frame.camera for frame in frames], means)
    return write_metrics(
        run,
        split,
        frames,
        result,
        split_rule=dataset.split_rule(),
        gaussians=len(loaded.gaussians),
        **{name: getattr(loaded, name) for name in ("step", "seconds", "bad_steps")},
        renderers=through_renderers(scene, frames, wanted, split, as_photograph=options.get("as_photograph")),
        **more,
    )


def _check_pictures(output: LockedFolder, recorded: FitRecord, split: str, frames: list[Frame]) -> None:
    """Refuse a folder where pictures that drgs did not draw are in the way."""
    kinds = VIEW_PICTURES if recorded.semantics else VIEW_PICTURES[:1]
    names = file_names([frame.name for frame in frames])
    output.check(f"renders/{split}/{name}.{kind}" for name in names for kind in kinds)


def _dataset_of(recorded: FitRecord, strict: bool) -> Dataset:
    """The data set of a run, where it is; `strict` as of `evaluate_run`."""
    return load_dataset(
        recorded.data,
        recorded.config,
        lazy=recorded.is_active,  # images may be missing that were never picked
        points=False,
        strict=strict,
        semantics=recorded.semantics is not None or bool(recorded.times),  # labels say what moves
    )


def _most_pixels(views: list[View], max_pixels: int, scale: float) -> int:
    """Pixels of a photograph, at most, where each is measured at `scale` times the width and height of the fit's.

    Raises:
        ValueError: If `scale` is below 1, or a photograph has fewer.
    """
    if not 1 <= scale < math.inf:
        raise ValueError(f"eval: scale must be at least 1, got {scale}; say 2 for twice the width and height")
    for view in views if scale > 1 else ():
        camera = view.checked().camera
        width, height = reduced_size(camera, max_pixels)
        if scale * width > camera.width or scale * height > camera.height:
            most = math.floor(100 * min(camera.width / width, camera.height / height)) / 100  # never more than it has
            raise ValueError(
                f"eval: scale must be at most {most:g}, since photograph {view.name} has {camera.width}x"
                f"{camera.height} pixels, got {scale:g}; lower it, or fit with fewer --max-pixels"
            )
    return round(max_pixels * scale**2)


def _segmentation(loaded: LoadedRun, dataset: Dataset, frames: list[Frame]) -> Segmentation | str | None:
    """How the run's labels are measured.

    Raises:
        ValueError: If numbers in the data set's labels mean other classes than they did when the run was fitted.
    """
    record, known = loaded.record.semantics, dataset.semantics
    if record is None:
        return None
    from drgs.fitting.segments import segmentation_of

    now = known.classes if known is not None and (known.class_file or known.embedding_file) else None
    if now is not None and record.classes is not None and now.names != record.classes:
        raise ValueError(
            f"{dataset.path}: must have the classes that the run was fitted with ({', '.join(record.classes[:5])}, "
            f"...), has {', '.join(now.names[:5])}, ...; restore its class names"
        )
    return segmentation_of(loaded.gaussians, loaded.decoder, loaded.classes, record.labels, record.teacher, frames)
