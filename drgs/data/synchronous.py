"""Synchronous cameras: a view for every camera and frame, and whether what moves, moves in all of them at one time."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from drgs.cameras import Camera
from drgs.data.dataset import Dataset
from drgs.data.images import image_size, is_damaged
from drgs.data.resampling import fit_to_image, resized_to
from drgs.data.videos import VideoFile, VideoFrame
from drgs.data.view_checks import report_missing_images
from drgs.data.views import View
from drgs.io.foreign import is_file

# What folders of synchronous cameras are called.
CAMERA_NAME = re.compile(r"cam[a-z_-]*\d{1,9}", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class Recording:
    """Frames and pose of one of several synchronous cameras.

    Attributes:
        name: Name of the camera.
        cameras: Calibrated camera of every frame, by its number; those of a moving camera differ.
        source: A video, or the image of each of these frames by its number; some may not exist, or be damaged.
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
            there = _attach_image(view, recording, number, lazy)
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
    report_missing_images(where, [view.image_path for view in dataset.absent], len(dataset.views), strict)
    dataset.frames = tuple(numbers)
    if len(recordings) > 1 and not any(recording.split for recording in recordings):
        dataset.test_cameras = (recordings[0].name,)
    return dataset


def _attach_image(view: View, recording: Recording, number: int, lazy: bool) -> bool:
    """Set a view's camera and image; False if the image is not there or damaged, for which none is opened if `lazy`."""
    where = f"{recording.where}: camera {recording.name}"
    camera, source = recording.cameras[number], recording.source
    if isinstance(source, VideoFile):
        view.frame = VideoFrame(source.path, number)
        view.is_checked = True
        view.camera = resized_to(camera, (source.width, source.height), source.path, where)
        return True
    view.image_path = source[number]
    if not is_file(view.image_path) or (not lazy and is_damaged(view.image_path)):
        return False
    view.camera = fit_to_image(camera, view.image_path, where, lazy)
    return True


# Correlations are of how much two cameras' pictures change over time; chosen by hand, checked in
# tests/test_dynamic_data.py.
_FEWEST_CAMERAS = 3  # of two cameras that disagree, either may be the late one
_FEWEST_SHARED = 10  # changes (frames) that two curves must share to be compared
_MIN_CORRELATION = 0.7  # correlation at the best shift from which on the shift is believed
_MIN_OTHERS_CORRELATION = 0.5  # median correlation of pairs of the other cameras, below which no camera is called late
# correlation that the shift must gain: curves that vary slowly correlate at neighboring shifts, too
_MIN_CORRELATION_GAIN = 0.25


@dataclasses.dataclass(frozen=True)
class LateCamera:
    """A camera whose frames are late or early against those of the others.

    Attributes:
        name: The camera's.
        shift: How many pictures later the others show what it shows, as of a camera that started late; negative:
            earlier.
        agreement, without: Correlation of its motion energy with that of the others, with and without this shift.
    """

    name: str
    shift: float
    agreement: float
    without: float

    def words(self, spacing: float = 1.0) -> str:
        """The finding and its remedy, in one line.

        Args:
            spacing: Frames of the video from one picture to the next.
        """
        count = max(1, round(abs(self.shift) * spacing))
        noun = "frame" if count == 1 else "frames"
        kind, where = ("late", "of the other cameras") if self.shift > 0 else ("early", "of this one")
        return (
            f"camera {self.name} seems to start {count} {noun} {kind}: how much moves over time agrees with the other "
            f"cameras by {self.agreement:.2f} with this shift, by {self.without:.2f} without (1 is equal); cut the "
            f"first {count} {noun} {where}, or leave this camera out"
        )


def late_cameras(pictures: Mapping[str, np.ndarray]) -> list[LateCamera]:
    """The cameras that are out of step with the others, by how much pictures change from one to the next.

    That is compared as a curve over time, of each camera with the median of the others, at every shift that leaves two
    thirds of it. Cameras stand still; one that moves, or that does not see what moves, agrees with the others nowhere,
    and nothing is said of it.

    Args:
        pictures: Camera -> (T, H, W) gray pictures at the same numbers of frames, of any size.
    """
    curves = {name: _energy(x) for name, x in pictures.items()}
    count = min((len(x) for x in curves.values()), default=0)
    most = min(count // 3, count - _FEWEST_SHARED)
    if len(curves) < _FEWEST_CAMERAS or most < 1:
        return []
    table = np.array(list(curves.values()))
    pairs = np.array([[_correlation(a, b) for b in table] for a in table])
    late = []
    for index, (name, curve) in enumerate(curves.items()):
        rest = np.delete(np.arange(len(table)), index)
        among = pairs[np.ix_(rest, rest)][np.triu_indices(len(rest), 1)]
        if np.median(among) < _MIN_OTHERS_CORRELATION:
            continue
        others = np.median(table[rest], axis=0)
        shifts = range(-most, most + 1)
        agreement = {s: _correlation(curve[max(-s, 0) : count - max(s, 0)], others[max(s, 0) :]) for s in shifts}
        best = max(shifts, key=lambda s: (agreement[s], -abs(s)))
        if best and agreement[best] >= _MIN_CORRELATION and agreement[best] - agreement[0] >= _MIN_CORRELATION_GAIN:
            shift = best + _peak(*(agreement.get(best + step, -1.0) for step in (-1, 0, 1)))
            late.append(LateCamera(name, shift, agreement[best], agreement[0]))
    return late


def _energy(pictures: np.ndarray) -> np.ndarray:
    """(T - 1,) mean change from each picture to the next, of mean 0 and standard deviation 1."""
    change = np.abs(np.diff(pictures.astype(np.float64), axis=0)).mean(axis=(1, 2))
    return (change - change.mean()) / max(change.std(), 1e-12)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Of two curves, as far as both go; 0 of one that is constant."""
    a, b = a[: len(b)], b[: len(a)]
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12))


def _peak(before: float, here: float, after: float) -> float:
    """Where a parabola through three values, the middle one the largest, is largest: within half a step."""
    bend = before - 2 * here + after
    return float(np.clip((before - after) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
