"""What the photographs of a run say about the errors of its scene, and the file of the run folder that keeps it.

A fit writes the record beside its checkpoint, of photographs that it has decoded anyway, so that maps of the expected
error need none of them. It belongs to one scene: the file has a hash of every parameter, and one of other Gaussians,
settings or fewer photographs than are asked for is not taken, but made anew.
"""

from __future__ import annotations

import hashlib
import logging
from typing import TYPE_CHECKING

import numpy as np

from drgs.display.progress import Bar
from drgs.fitting.components.table import held_components
from drgs.fitting.frames import Frame, frames_for
from drgs.fitting.records import fitted_views, load_run
from drgs.fitting.resume import lock_run
from drgs.information.expected_error import ErrorRecord, error_record
from drgs.io.checkpoint import load_state, save_state
from drgs.io.json_files import check_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drgs.data import Dataset, View
    from drgs.ellipsoids import Scene
    from drgs.fitting.components.base import Component
    from drgs.fitting.config import DataConfig
    from drgs.fitting.trainer import Trainer
    from drgs.io.run import Run
    from drgs.settings import RenderSettings

_HEADER = {"scene": str, "photographs": int, "pixels": int, "views": int, "settings": dict, "length": float}
_STEPS_A_PHOTOGRAPH = 100  # steps of a fit for which a record looks at one photograph more: it takes a few steps' time
_FEWEST = 8  # photographs of any record, or all there are
_log = logging.getLogger(__name__)


def run_error_record(
    run: Run,
    settings: RenderSettings,
    max_pixels: int | None = None,
    most: int | None = None,
    dataset: Dataset | None = None,
) -> ErrorRecord:
    """The record of a run's scene and of the photographs that it was fitted to, at the poses that the fit has found.

    It is read from the run folder. Where there is none of this scene with these settings it is made of the photographs.
    With the settings and at the size of the fit it is kept then, unless another process writes into the folder.

    Where the fit has estimated exposure, photographs are as all of them would be with the mean exposure, in which the
    scene is shown.

    Args:
        run: The run folder.
        settings: Settings of the renderer.
        max_pixels: Pixels of a photograph at most; None: those of the fit.
        most: Photographs that are looked at, at most, evenly spaced, which stand for all; None: all of them.
        dataset: The run's data set, where it has been loaded already.
    Raises:
        FileNotFoundError, ValueError: If photographs are gone or cannot be read.
    """
    loaded = load_run(run)
    config = loaded.record.config
    pixels = max_pixels or config.data.max_pixels
    names = fitted_views(run, loaded.record)
    rows = _evenly(len(names), most)
    if (saved := saved_error_record(run, loaded.scene, settings, pixels, len(rows))) is not None:
        return saved
    known = loaded.record
    dataset = known.dataset() if dataset is None else known.with_refined_poses(dataset)
    views = {view.name: view for view in dataset.views}
    if missing := [name for name in names if name not in views]:
        raise ValueError(f"{loaded.record.data}: must still hold photograph {missing[0]!r}, it is gone; restore it")
    frames = frames_for([views[names[row]] for row in rows], config.data, pixels)
    held = held_components(names, loaded.networks, config.settings)
    record = _record_of(loaded.scene, frames, len(names), settings, held)
    if settings == config.settings and pixels == config.data.max_pixels:
        try:
            with lock_run(run, "errors"):
                _save(run, loaded.scene, record, len(rows), pixels)
        except (OSError, ValueError) as error:
            _log.info("%s; the record of the errors is not kept", str(error).partition(";")[0])
    return record


def saved_error_record(
    run: Run, scene: Scene, settings: RenderSettings, max_pixels: int, photographs: int
) -> ErrorRecord | None:
    """The record that a run folder holds, if it is of this scene; None where there is none.

    Args:
        run: The run folder.
        scene: The scene that it must be of.
        settings, max_pixels: Settings of the renderer, and pixels of a photograph at most, that it must be of.
        photographs: How many it must be of at least.
    """
    try:
        tensors, header = load_state(run.errors)
        check_json(str(run.errors), header, _HEADER, "it is made anew")
        if header["photographs"] < photographs or header["pixels"] != max_pixels or header["scene"] != _digest(scene):
            return None
        record = ErrorRecord.from_state(tensors, header)
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        _log.warning("%s: must be a record of errors, is damaged (%s); it is made anew", run.errors, error)
        return None
    return record if record.settings == settings else None


def error_record_of_views(
    scene: Scene, views: list[View], settings: RenderSettings, data: DataConfig, max_pixels: int
) -> ErrorRecord:
    """The record of a scene that anybody may have fitted, and of the photographs of these views.

    Args:
        scene: The scene, in the frame of the views.
        views: Views of a data set.
        settings: Settings of the renderer.
        data: What of photographs is used, and how.
        max_pixels: Pixels of a photograph at most.
    Raises:
        FileNotFoundError, ValueError: If a photograph cannot be read.
    """
    frames = frames_for(views, data, max_pixels)
    return _record_of(scene, frames, len(frames), settings)


def fit_errors(run: Run, trainer: Trainer, steps: int) -> dict[str, float]:
    """Write the record of a fit's scene as it is now; what the log says of it.

    Args:
        run: The run folder, which the fit has locked.
        trainer: The fit.
        steps: How many steps it is the record of: the more, the more photographs are looked at.
    """
    frames, scene, config = trainer.photographs(), trainer.scene(), trainer.config
    rows = _evenly(len(frames), max(_FEWEST, steps // _STEPS_A_PHOTOGRAPH))
    record = _record_of(scene, [frames[row] for row in rows], len(frames), config.settings, trainer.components)
    _save(run, scene, record, len(rows), config.data.max_pixels)
    return {"photographs": len(rows), "misfit": record.mean_misfit**0.5}


def is_cheap(trainer: Trainer, steps: int) -> bool:
    """Whether a record on the way, so many steps after the last one, takes little time beside these."""
    return steps >= _STEPS_A_PHOTOGRAPH * min(_FEWEST, len(trainer.frames))


def _evenly(count: int, most: int | None) -> list[int]:
    """Numbers of at most so many of `count` photographs, evenly spaced."""
    return np.linspace(0, count - 1, count if most is None else min(most, count)).round().astype(int).tolist()


def _record_of(
    scene: Scene,
    frames: Sequence[Frame],
    count: int,
    settings: RenderSettings,
    components: Sequence[Component] = (),
) -> ErrorRecord:
    """The record of some photographs of a fit, which stand for all.

    Args:
        scene: The scene.
        frames: The photographs.
        count: How many there are in all.
        settings: Settings of the renderer.
        components: Those of the fit, which say what photographs are without an exposure of their own.
    """
    images = [frame.image() for frame in frames]
    for component in components:
        images = [component.as_shown(image, frame) for image, frame in zip(images, frames, strict=True)]
    masks, cameras = [frame.mask for frame in frames], [frame.camera for frame in frames]
    with Bar("residuals", len(frames)) as bar:
        record = error_record(scene, cameras, images, settings, masks=masks, advance=bar.advance)
    return record if count == len(frames) else record.scaled(count / len(frames))


def _save(run: Run, scene: Scene, record: ErrorRecord, photographs: int, max_pixels: int) -> None:
    """Write a record into its run folder; information in float32, as it was computed of each view."""
    tensors, header = record.to_state()
    tensors = {name: x.float() if name.startswith("information.") else x for name, x in tensors.items()}
    header |= {"scene": _digest(scene), "photographs": photographs, "pixels": max_pixels}
    save_state(run.errors, tensors, header)


def _digest(scene: Scene) -> str:
    """A hash of all parameters of a scene."""
    digest = hashlib.blake2b(digest_size=16)
    for name, x in sorted(scene.parameters().items()):
        values = x.detach().cpu().contiguous().numpy()
        digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
        digest.update(values.data if values.size else b"")
    return digest.hexdigest()
