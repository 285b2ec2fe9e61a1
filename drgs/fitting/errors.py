"""What the photographs of a run say about the errors of its scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.display.progress import Bar
from drgs.fitting.components.exposure import NETWORK
from drgs.fitting.frames import frames_for, load_dataset
from drgs.fitting.records import fitted_views, load_run
from drgs.information.expected_error import error_record

if TYPE_CHECKING:
    from drgs.data import Dataset
    from drgs.fitting.frames import Frame
    from drgs.information.expected_error import ErrorRecord
    from drgs.io.run import Run
    from drgs.settings import RenderSettings

__all__ = ["run_error_record"]


def run_error_record(
    run: Run,
    settings: RenderSettings,
    max_pixels: int | None = None,
    most: int | None = None,
    dataset: Dataset | None = None,
) -> ErrorRecord:
    """The record of a run's scene and of the photographs that it was fitted to, at the poses that the fit has found.

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
    if dataset is None:
        dataset = load_dataset(loaded.record.data, config, lazy=True, points=False, semantics=False)
    views = {view.name: view for view in loaded.record.with_refined_poses(dataset).views}
    names = fitted_views(run, loaded.record)
    if missing := [name for name in names if name not in views]:
        raise ValueError(f"{loaded.record.data}: must still hold photograph {missing[0]!r}, it is gone; restore it")
    count = len(names) if most is None else min(most, len(names))
    rows = np.linspace(0, len(names) - 1, count).round().astype(int).tolist()
    frames = frames_for([views[names[row]] for row in rows], config.data, max_pixels)
    gains = loaded.networks.get(NETWORK, {}).get("log_gains")
    images = [_as_shown(frame, None if gains is None else gains[row]) for row, frame in zip(rows, frames, strict=True)]
    masks = [frame.mask for frame in frames]
    cameras = [frame.camera for frame in frames]
    with Bar("residuals", len(frames)) as bar:
        record = error_record(loaded.scene, cameras, images, settings, masks=masks, advance=bar.advance)
    return record if count == len(names) else record.times(len(names) / count)


def _as_shown(frame: Frame, log_gain: torch.Tensor | None) -> torch.Tensor:
    """(H, W, 3) a photograph without a log gain (3,) of its own; a background that was put behind it later has none."""
    image = frame.image()
    if log_gain is None:
        return image
    corrected = (image / log_gain.detach().cpu().exp()).clamp(0, 1)
    empty = frame.empty()
    return corrected if empty is None else torch.lerp(corrected, image, empty[..., None])
