"""Frames of a video that structure from motion can use: sharp ones, with parallax between them.

A video is looked at about ten times a second, reduced. Corners are tracked from look to look (Lucas-Kanade), the motion
that a turn of the camera would make is fitted to the tracks and taken out, and what is left is parallax: the part of
the motion that tells how far away things are. Frames are spread evenly over the sum of both, parallax counting most, so
that a walk gives many frames, a camera at rest one, and a turn on the spot as many as keep its ends connected. Of each
stretch the sharpest frame is taken, compared with those next to it alone: how sharp a frame is depends on what it
shows, too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from drgs.data.shooting import Finding
from drgs.data.videos import VideoFile, VideoFrame, read_video

__all__ = ["PickedFrame", "Picked", "pick_frames"]

Progress = Callable[[int, int], None]

_LOOKS = 10.0  # a second
_MOST_LOOKS = 6_000  # ten minutes; of longer videos they are further apart
_WIDTH = 480  # pixels of the longer side that is looked at
_CORNERS = 400
_FOCAL = 0.9  # of the longer side: phones have 0.7 to 1.1; a wrong one leaves a turn's motion of second order alone
_PARALLAX = 0.02  # of the longer side, between two frames that are taken
_MOTION = 0.12  # the same of all motion, where there is no parallax: such frames connect
_FEWEST_TRACKS = 20
_BLURRED = 0.45  # of the sharpness that is usual near by
_NEAR = 1.5  # seconds that are near by
_TURN = 0.08  # share of parallax in the motion, below which the camera only turns
_TURN_MOTION = 0.15  # of the longer side: least motion of a turn that is worth a sentence
_FAST = 0.12  # of the longer side from one look to the next, a tenth of a second or less
_LONGEST_STEP = 0.3  # of the longer side: motion between two frames that leaves enough in both
_SHORTEST = 0.4  # seconds: a stretch that is shorter is not worth a sentence


@dataclasses.dataclass(frozen=True)
class PickedFrame:
    """A frame that was taken.

    Attributes:
        frame: The frame, which decodes itself.
        seconds: When it is shown, from the start of the video.
        sharpness: Variance of the Laplacian, over what is usual within a second and a half; 1 is as sharp as its
            neighbors.
        motion: Median motion of what is seen since the frame taken before, over the longer side of the picture.
        parallax: The part of it that no turn of the camera explains.
    """

    frame: VideoFrame
    seconds: float
    sharpness: float
    motion: float
    parallax: float


@dataclasses.dataclass(frozen=True)
class Picked:
    """What was taken of a video.

    Attributes:
        frames: The frames, in order; at least one.
        findings: What is wrong with the video, and what to do about it at the next shoot.
        looks: Number of frames that were looked at.
        wanted: Number of frames that parallax and motion ask for; more than `frames` where these were bounded.
    """

    frames: tuple[PickedFrame, ...]
    findings: tuple[Finding, ...]
    looks: int
    wanted: int


@dataclasses.dataclass(frozen=True)
class _Look:
    """A frame that was looked at: its number, and what moved since the look before (shares of the longer side); nan
    where too few of the `corners` of the one before were found again.
    """

    index: int
    seconds: float
    sharpness: float
    motion: float
    parallax: float
    corners: int


def pick_frames(path: Path, most: int = 150, progress: Progress | None = None) -> Picked:
    """Frames of a video for structure from motion.

    Args:
        path: The video: mp4, webm, mkv or avi.
        most: Largest number of frames.
        progress: Called with (frames looked at, all of these).
    Raises:
        FileNotFoundError, ValueError: No video, or one that cannot be decoded.
    Reference:
        Lucas and Kanade, "An iterative image registration technique", IJCAI 1981 (tracks); the motion field of a
        rotation, to first order in the angle: Longuet-Higgins and Prazdny 1980, eq. 2.13.
    """
    if most < 1:
        raise ValueError(f"frames: must be at least 1, got {most}; ask for some")
    video = read_video(Path(path))
    looks = _looks(video, progress or (lambda done, total: None))
    usual = _usual_sharpness(looks)
    relative = np.array([look.sharpness for look in looks]) / usual
    wanted = _novelty(looks)
    asked = max(1, math.ceil(float(wanted[-1])))
    chosen = _spread(wanted, relative, min(most, asked))
    frames = [_picked(video, looks, relative, before, at) for before, at in zip([None, *chosen], chosen, strict=False)]
    return Picked(tuple(frames), tuple(_findings(video.path, looks, relative, frames, asked)), len(looks), asked)


def _looks(video: VideoFile, progress: Progress) -> list[_Look]:
    """All looks at a video, one after the other: one frame is held at a time."""
    times = np.array(video.stamps) / 1000.0 if video.stamps else np.arange(video.count) / 30.0
    times = times - times[0]
    rate = (video.count - 1) / times[-1] if times[-1] > 0 else _LOOKS
    stride = max(1, int(rate / _LOOKS), math.ceil(video.count / _MOST_LOOKS))
    indices = range(0, video.count, stride)
    looks = []
    before: np.ndarray | None = None
    for done, index in enumerate(indices):
        progress(done, len(indices))
        gray = _reduced(VideoFrame(video.path, index).read())
        motion, parallax, corners = (0.0, 0.0, _CORNERS) if before is None else _moved(before, gray)
        sharpness = float(cv2.Laplacian(gray, cv2.CV_32F).var())
        looks.append(_Look(index, float(times[index]), sharpness, motion, parallax, corners))
        before = gray
    progress(len(indices), len(indices))
    return looks


def _reduced(image: np.ndarray) -> np.ndarray:
    """(h, w) uint8 of (H, W, 3) RGB, at most `_WIDTH` pixels along the longer side."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = _WIDTH / max(gray.shape)
    if scale >= 1:
        return gray
    return cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _moved(before: np.ndarray, after: np.ndarray) -> tuple[float, float, int]:
    """Motion and parallax between two pictures over their longer side, nan where too few corners of the first are found
    in the second; and the number of its corners.
    """
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 6)
    if corners is None or len(corners) < _FEWEST_TRACKS:
        return math.nan, math.nan, 0 if corners is None else len(corners)
    found, is_found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, winSize=(21, 21), maxLevel=4)
    back, is_back, _ = cv2.calcOpticalFlowPyrLK(after, before, found, None, winSize=(21, 21), maxLevel=4)
    kept = (is_found.ravel() == 1) & (is_back.ravel() == 1) & (np.abs(back - corners).max(axis=(1, 2)) < 1.0)
    if kept.sum() < _FEWEST_TRACKS:
        return math.nan, math.nan, len(corners)
    longer = max(before.shape)
    start = corners[kept, 0] - np.array(before.shape[::-1]) / 2
    flow = found[kept, 0] - corners[kept, 0]
    left = _without_turn(start / longer, flow / longer)
    # The median of the motion, but more than the median of the parallax: what is near may be the smaller part.
    return (
        float(np.median(np.linalg.norm(flow, axis=1))) / longer,
        float(np.percentile(np.linalg.norm(left, axis=1), 70)),
        len(corners),
    )


def _without_turn(places: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """(P, 2) flow without the part that a small turn of a pinhole camera makes, fitted robustly.

    Args:
        places: (P, 2) from the middle of the picture, over its longer side.
        flow: (P, 2) motion over the longer side.
    """
    x, y = places.T / _FOCAL
    zero = np.zeros_like(x)
    across = np.stack([x * y, -(1 + x * x), y], axis=1)
    down = np.stack([1 + y * y, -x * y, -x], axis=1)
    rows = _FOCAL * np.stack([across, down], axis=1)  # (P, 2, 3)
    weights = np.ones_like(zero)
    left = flow
    for _ in range(8):  # iteratively reweighted: L1
        scaled = rows * weights[:, None, None]
        turn, *_ = np.linalg.lstsq(scaled.reshape(-1, 3), (flow * weights[:, None]).ravel(), rcond=None)
        left = flow - rows @ turn
        weights = 1 / np.sqrt(np.maximum(np.linalg.norm(left, axis=1), 1e-4))
    return left


def _usual_sharpness(looks: Sequence[_Look]) -> np.ndarray:
    """Median sharpness within `_NEAR` seconds of each look."""
    times = np.array([look.seconds for look in looks])
    values = np.array([look.sharpness for look in looks])
    starts = np.searchsorted(times, times - _NEAR)
    ends = np.searchsorted(times, times + _NEAR, side="right")
    usual = np.array([np.median(values[a:b]) for a, b in zip(starts, ends, strict=True)])
    return np.maximum(usual, 1e-6)


def _novelty(looks: Sequence[_Look]) -> np.ndarray:
    """How many frames should be taken up to each look."""
    steps = [
        1.0 if math.isnan(look.motion) else max(look.parallax / _PARALLAX, look.motion / _MOTION) for look in looks
    ]
    steps[0] = 1.0  # the first frame
    return np.cumsum(np.minimum(steps, 2.0))


def _spread(wanted: np.ndarray, sharpness: np.ndarray, count: int) -> list[int]:
    """Indices of looks: the sharpest of each of `count` stretches in which equally much is new."""
    stretch = np.minimum((wanted - wanted[0]) / max(wanted[-1] - wanted[0], 1e-12) * count, count - 1e-9).astype(int)
    chosen = []
    for number in range(count):
        there = np.flatnonzero(stretch == number)
        if len(there):
            chosen.append(int(there[np.argmax(sharpness[there])]))
    return chosen


def _picked(
    video: VideoFile, looks: Sequence[_Look], sharpness: np.ndarray, before: int | None, at: int
) -> PickedFrame:
    """The frame at a look, with what moved since the one before."""
    between = looks[at : at + 1] if before is None else looks[before + 1 : at + 1]
    motion = float(np.nansum([look.motion for look in between])) if before is not None else 0.0
    parallax = float(np.nansum([look.parallax for look in between])) if before is not None else 0.0
    look = looks[at]
    return PickedFrame(VideoFrame(video.path, look.index), look.seconds, float(sharpness[at]), motion, parallax)


def _findings(
    path: Path, looks: Sequence[_Look], sharpness: np.ndarray, frames: Sequence[PickedFrame], asked: int
) -> list[Finding]:
    """What is wrong with a video, the longest stretches first."""
    times = np.array([look.seconds for look in looks])
    motion = np.array([look.motion for look in looks])
    parallax = np.array([look.parallax for look in looks])
    found = list[tuple[float, Finding]]()

    def add(is_so: np.ndarray, kind: str, text: str, advice: str, least: float = _SHORTEST) -> None:
        for start, end in _stretches(is_so):
            length = times[end] - times[start]
            if length >= least:
                where = f"{path.name}, {times[start]:.1f} to {times[end]:.1f} s"
                found.append((length, Finding(kind, f"{where}: {text}", advice)))

    # Over a second: single looks are noisy.
    window = max(1, round(1.0 / max(float(np.median(np.diff(times))) if len(times) > 1 else 1.0, 1e-3)))
    sums = [np.convolve(np.nan_to_num(x), np.ones(window), mode="same") for x in (motion, parallax)]
    turns = (sums[0] > _TURN_MOTION) & (sums[1] < _TURN * sums[0])
    add(
        turns,
        "turn",
        "the camera only turns, which shows no depth",
        "step sideways while you turn, or walk around what you film",
        least=1.0,
    )
    is_blank = np.array([look.corners < 2 * _FEWEST_TRACKS for look in looks])
    is_fast = (np.nan_to_num(motion, nan=1.0) > _FAST) & ~is_blank
    add(
        is_fast,
        "fast",
        "the camera moves too fast, pictures that follow each other share little",
        "film more slowly there",
    )
    add(sharpness < _BLURRED, "blur", "blurred", "hold still or get more light there")
    add(
        is_blank,
        "blank",
        "hardly anything to hold on to (sky, a blank wall, darkness)",
        "keep something with texture in view",
    )
    far = [frame for frame in frames[1:] if frame.motion > _LONGEST_STEP]
    if len(far) > 0.1 * len(frames):
        text = f"{path.name}: {len(far)} of {len(frames)} frames share little with the one before"
        found.append(
            (times[-1], Finding("overlap", text, f"ask for more frames (--frames {asked}), or film more slowly"))
        )
    return [finding for _, finding in sorted(found, key=lambda pair: -pair[0])]


def _stretches(is_so: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each stretch where something is so."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_so, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
