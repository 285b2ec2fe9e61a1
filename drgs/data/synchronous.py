"""Synchronous cameras: the same frames of all of them, a view each, whatever they are kept as."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.data.checks import image_size
from drgs.data.dataset import Dataset
from drgs.data.resizing import fit_to_image, resized_to
from drgs.data.videos import VideoFile, VideoFrame
from drgs.data.view_checks import go_on_without
from drgs.data.views import View
from drgs.io.foreign import is_file

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from drgs.cameras import Camera

__all__ = ["CAMERA_NAME", "Recording", "evenly_spaced", "synchronous"]

# What folders of synchronous cameras are called.
CAMERA_NAME = re.compile(r"cam[a-z_-]*\d{1,9}", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class Recording:
    """What one of several synchronous cameras has taken.

    Attributes:
        name: Name of the camera.
        cameras: Calibrated camera of every frame, by its number; those of a moving camera differ.
        source: A video, or the image of each of these frames by its number; some may not exist.
        where: What states the calibration, for messages.
        split: What the data set's own files say that it is for; else empty.
    """

    name: str
    cameras: Mapping[int, Camera]
    source: VideoFile | Mapping[int, Path]
    where: str
    split: str = ""


def evenly_spaced(numbers: Sequence[int], times: int) -> tuple[int, ...]:
    """At most `times` of the numbers, evenly over all of them, the first and the last included."""
    if len(numbers) <= times:
        return tuple(numbers)
    return tuple(numbers[round(i)] for i in np.linspace(0, len(numbers) - 1, times))


def synchronous(
    dataset: Dataset,
    recordings: Sequence[Recording],
    numbers: Sequence[int],
    *,
    where: Path,
    background: tuple[float, float, float],
    lazy: bool,
    strict: bool,
) -> Dataset:
    """Fill a data set with a view for every camera and frame; the first camera is held out, if there are several and
    their files do not say what they are for.

    Its time goes by the number of the frame, from 0 at the first to 1 at the last of `numbers`: what moves evenly in
    the video does so in the data set, though frames that are spread over it need not be equally far apart.

    Args:
        dataset: Data set that has no views yet.
        recordings: One recording a camera, sorted by name.
        numbers: Numbers of the frames, ascending.
        where: What lists the frames, for messages.
        background, lazy, strict: Options of `drgs.data.load`.
    Raises:
        FileNotFoundError: Too few of the images are there.
        ValueError: Images of another shape than their camera's, or of several sizes in one camera.
    """
    digits = max(4, len(str(numbers[-1])))
    first = numbers[0]
    length = max(numbers[-1] - numbers[0], 1)
    for recording in recordings:
        size = None
        for number in numbers:
            if number not in recording.cameras:
                continue
            view = View(
                None,
                f"{recording.name}/{number:0{digits}d}",
                background=background,
                split=recording.split,
                is_checked=not lazy,
                camera_name=recording.name,
            )
            there = _found(view, recording, number, lazy)
            (dataset.views if there else dataset.absent).append(view)
            if not there:
                continue
            view.camera = dataclasses.replace(view.camera, name=view.name, time=(number - first) / length)
            if view.image_path is None or lazy:
                continue
            found = image_size(view.image_path)
            if found != (size := size or found):
                raise ValueError(
                    f"{view.image_path}: must be {size[0]}x{size[1]} pixels as the other frames of camera "
                    f"{recording.name}, got {found[0]}x{found[1]}; export the frames again"
                )
    go_on_without(where, [view.image_path for view in dataset.absent], len(dataset.views), strict)
    dataset.frames = tuple(numbers)
    if len(recordings) > 1 and not any(recording.split for recording in recordings):
        dataset.test_cameras = (recordings[0].name,)
    return dataset


def _found(view: View, recording: Recording, number: int, lazy: bool) -> bool:
    """Give a view its camera and its image, or say that there is none."""
    where = f"{recording.where}: camera {recording.name}"
    camera, source = recording.cameras[number], recording.source
    if isinstance(source, VideoFile):
        view.frame = VideoFrame(source.path, number)
        view.is_checked = True
        view.camera = resized_to(camera, (source.width, source.height), source.path, where)
        return True
    view.image_path = source[number]
    if not is_file(view.image_path):
        return False
    view.camera = fit_to_image(camera, view.image_path, where, lazy)
    return True
