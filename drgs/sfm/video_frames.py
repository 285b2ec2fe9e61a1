"""Frames of a video that structure from motion can use: sharp ones, with parallax between them.

A video is sampled about ten times a second, reduced; each sample is the sharpest of the frames around it. Corners are
tracked from sample to sample (Lucas-Kanade), the motion that a turn of the camera would cause is fitted to the tracks
and subtracted, and what is left is parallax: the part of the motion that depends on distance. Frames are spread
evenly over what is new, which is parallax, or motion where that is large; so a walk gives many frames and a camera at
rest one. A turn on the spot gives as many as keep what comes before it connected to what comes after, and none where
nothing does. Of each stretch the sharpest frame is taken, compared with those next to it alone: how sharp a frame is
depends on what it shows, too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from drgs.data.videos import VideoFile, VideoFrame, read_video
from drgs.display.pictures import shrunk
from drgs.sfm.findings import Finding

# Thresholds without a source are chosen by hand and were not varied in a study; tests/test_video_frames.py holds what
# they do on walks, turns, stills and blur. Lengths are shares of the longer side of the picture.
_SAMPLE_RATE = 10.0  # samples a second: at 30 frames a second each is the sharpest of 3
_MAX_SAMPLES = 6_000  # ten minutes at that rate; samples of longer videos are further apart
_FRAMES_PER_SAMPLE = 3  # frames decoded a sample, at most, of which the sharpest is kept
_SHARPNESS_SIDE = 960  # pixels of the longer side at which sharpness is measured: blur of a pixel or two still shows
_TRACKING_SIDE = 480  # pixels of the longer side at which corners are tracked
_MAX_CORNERS = 400  # corners tracked from sample to sample, at most
# focal length, of the longer side: phones have 0.7 to 1.1; a wrong one leaves a turn's motion of second order alone
_ASSUMED_FOCAL = 0.9
_PARALLAX_STEP = 0.01  # parallax between two picked frames
# motion between two picked frames where there is little parallax: seven eighths of the picture overlap
_MOTION_STEP = 0.12
_TURN_STEP = 0.25  # motion between two picked frames within a turn, which is only to be bridged: three quarters overlap
_FEWEST_TRACKS = 20  # with fewer tracked corners motion and parallax are unknown
_BLANK_WEIGHT = 0.05  # frames a sample where there are no corners to be tracked
_BLURRED_BELOW = 0.45  # share of the median sharpness near by, below which a frame is blurred
_SHARPNESS_WINDOW = 1.5  # seconds before and after, over which that median is taken
_REPLACEMENT_WINDOW = 0.35  # seconds that a sharp frame may be away from a blurred one that it replaces
_TURN_PARALLAX = 0.08  # share of parallax in the motion, below which the camera only turns
_TURN_MOTION = 0.15  # motion in a second: a slower turn is not reported
_TURN_LENGTH = 1.0  # seconds: a shorter turn is the sway of a step
_FEWEST_BESIDE_TURNS = 3  # frames that a video must yield beside its turns, for the turns to be left out
_FAST_MOTION = 0.12  # motion from one sample to the next (0.1 s or less) that is reported as too fast
_LONGEST_STEP = 0.3  # motion between two picked frames beyond which they may not match: 0.7 of the picture overlap
_SHORTEST_STRETCH = 0.4  # seconds: a shorter stretch is not reported
# a still camera yields at most so many frames, or frames a second; it rests for so many seconds at least
_STILL = (2, 0.2, 1.0)
# relative sharpness that a frame at the edge of its stretch must have above one in the middle
_CENTER_PREFERENCE = 0.25


@dataclasses.dataclass(frozen=True)
class PickedFrame:
    """A frame that was taken.

    Attributes:
        frame: The frame, which decodes itself.
        seconds: Time at which it is shown, from the start of the video.
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
    """Frames picked from a video.

    Attributes:
        frames: The frames, in order; at least one.
        findings: What is wrong with the video, and what to do about it at the next shoot.
        samples: Number of frames that were compared with the one before.
        useful_frames: Number of frames that parallax and motion call for; more than `frames` where these were bounded.
        frame_seconds: Time from one frame of the video to the next, on average; 0 of a single one.
    """

    frames: tuple[PickedFrame, ...]
    findings: tuple[Finding, ...]
    samples: int
    useful_frames: int
    frame_seconds: float


@dataclasses.dataclass(frozen=True)
class _Sample:
    """A sampled frame: its number, time, sharpness, and how far the image moved since the sample before (shares of the
    longer side); nan where too few of the `corners` of the sample before could be tracked.
    """

    index: int
    seconds: float
    sharpness: float
    motion: float
    parallax: float
    corners: int


class ExaminedVideo:
    """A video whose motion was measured, from which frames can be picked.

    Attributes:
        useful_frames: Number of frames that parallax and motion call for.
    """

    def __init__(self, video: VideoFile, samples: Sequence[_Sample], frame_seconds: float) -> None:
        self._video = video
        self._samples = samples
        self._frame_seconds = frame_seconds
        self._times = np.array([sample.seconds for sample in samples])
        values = np.array([sample.sharpness for sample in samples])
        self._sharpness = values / _usual_sharpness(self._times, values)
        self._turns = _turns(self._times, samples)
        self._novelty, self._is_open = _novelty(samples, self._turns)
        self.useful_frames = max(1, math.ceil(float(self._novelty[-1]) - 1e-9))

    def pick(self, most: int) -> Picked:
        """At most so many frames, at least one."""
        chosen = _spread(self._novelty, self._sharpness, self._is_open, min(most, self.useful_frames))
        chosen = _sharp_instead(chosen, self._times, self._sharpness, self._is_open)
        frames = [self._taken(before, at) for before, at in zip([None, *chosen], chosen, strict=False)]
        findings = self._findings(frames)
        return Picked(tuple(frames), tuple(findings), len(self._samples), self.useful_frames, self._frame_seconds)

    def _taken(self, before: int | None, at: int) -> PickedFrame:
        """The frame of a sample, with the motion since the frame before."""
        between = [] if before is None else self._samples[before + 1 : at + 1]
        motion = float(np.nansum([sample.motion for sample in between]))
        parallax = float(np.nansum([sample.parallax for sample in between]))
        sample = self._samples[at]
        frame = VideoFrame(self._video.path, sample.index)
        return PickedFrame(frame, sample.seconds, float(self._sharpness[at]), motion, parallax)

    def _findings(self, frames: Sequence[PickedFrame]) -> list[Finding]:
        """Faults of the video (turns, blur, speed, blank stretches), the longest first."""
        name, times = self._video.path.name, self._times
        motion = np.array([sample.motion for sample in self._samples])
        findings = list[tuple[float, Finding]]()

        def add(stretches: Sequence[tuple[int, int]], kind: str, text: str, advice: str) -> None:
            for start, end in stretches:
                if times[end] - times[start] >= _SHORTEST_STRETCH:
                    where = f"{name}, {times[start]:.1f} to {times[end]:.1f} s"
                    findings.append((times[end] - times[start], Finding(kind, f"{where}: {text}", advice)))

        aside = "step sideways while you turn, or walk around what you film"
        add(self._turns, "turn", "the camera only turns, which shows no depth", aside)
        is_blank = np.array([sample.corners < 2 * _FEWEST_TRACKS for sample in self._samples])
        is_fast = (np.nan_to_num(motion, nan=1.0) > _FAST_MOTION) & ~is_blank
        share = "the camera moves too fast, pictures that follow each other share little"
        add(_stretches(is_fast), "fast", share, "film more slowly there")
        add(_stretches(self._sharpness < _BLURRED_BELOW), "blur", "blurred", "hold still or get more light there")
        blank = "hardly anything to hold on to (sky, a blank wall, darkness)"
        add(_stretches(is_blank), "blank", blank, "keep something with texture in view")
        length = float(times[-1])
        most, rate, shortest = _STILL
        is_still = not self._turns and self.useful_frames <= max(most, rate * length) and not is_blank.all()
        if is_still and length >= shortest:
            text = f"{name}: the camera hardly moves in {length:.1f} s"
            findings.append((length, Finding("still", text, "walk around what you film")))
        far = [frame for frame in frames[1:] if frame.motion > _LONGEST_STEP]
        if len(far) > 0.1 * len(frames):
            text = f"{name}: {len(far)} of {len(frames)} frames share little with the one before"
            most = min(self.useful_frames, self._video.count)
            more = f"ask for more frames (--frames {most}), or " if most > len(frames) else ""
            findings.append((length, Finding("overlap", text, f"{more}film more slowly")))
        return [finding for _, finding in sorted(findings, key=lambda pair: -pair[0])]


def examine(path: Path, progress: Callable[[int, int], None] | None = None) -> ExaminedVideo:
    """Sharpness and motion throughout a video, one frame after the other.

    Args:
        path: The video: mp4, mov, webm, mkv or avi.
        progress: Called with (samples measured, all samples).
    Raises:
        FileNotFoundError, ValueError: No video, or one that cannot be decoded.
    Reference:
        Lucas and Kanade, "An iterative image registration technique", IJCAI 1981 (tracks); the motion field of a
        rotation, to first order in the angle: Longuet-Higgins and Prazdny 1980, eq. 2.13.
    """
    report = progress or (lambda done, total: None)
    video = read_video(Path(path))
    times = np.array(video.stamps) / 1000.0 if video.stamps else np.arange(video.count) / 30.0
    times = times - times[0]
    rate = (video.count - 1) / times[-1] if times[-1] > 0 else _SAMPLE_RATE
    stride = max(1, int(rate / _SAMPLE_RATE), math.ceil(video.count / _MAX_SAMPLES))
    samples = list[_Sample]()
    before: np.ndarray | None = None
    for start in range(0, video.count, stride):
        report(start, video.count)
        candidates = range(start, min(start + stride, video.count), math.ceil(stride / _FRAMES_PER_SAMPLE))
        sharpness, index, gray = _sharpest(video.path, candidates)
        motion, parallax, corners = (0.0, 0.0, _MAX_CORNERS) if before is None else _moved(before, gray)
        samples.append(_Sample(index, float(times[index]), sharpness, motion, parallax, corners))
        before = gray
    report(video.count, video.count)
    return ExaminedVideo(video, samples, 1.0 / rate if video.count > 1 else 0.0)


def _sharpest(path: Path, indices: Sequence[int]) -> tuple[float, int, np.ndarray]:
    """Sharpness and number of the sharpest of some frames, and (h, w) uint8 of it, small."""
    candidates = []
    for index in indices:
        gray = VideoFrame(path, index).read_gray(_SHARPNESS_SIDE)
        # Noise is no sharpness: of single pixels it is a large part of the Laplacian's variance.
        sharpness = float(cv2.Laplacian(cv2.GaussianBlur(gray, (0, 0), 0.8), cv2.CV_32F).var())
        candidates.append((sharpness, index, gray))
    sharpness, index, gray = max(candidates, key=lambda one: one[0])
    return sharpness, index, shrunk(gray, _TRACKING_SIDE)


def _moved(before: np.ndarray, after: np.ndarray) -> tuple[float, float, int]:
    """Motion and parallax between two pictures over their longer side, nan where too few corners of the first are found
    in the second; and the number of its corners.
    """
    corners = cv2.goodFeaturesToTrack(before, _MAX_CORNERS, 0.01, 6)
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
    x, y = places.T / _ASSUMED_FOCAL
    zero = np.zeros_like(x)
    across = np.stack([x * y, -(1 + x * x), y], axis=1)
    down = np.stack([1 + y * y, -x * y, -x], axis=1)
    rows = _ASSUMED_FOCAL * np.stack([across, down], axis=1)  # (P, 2, 3)
    weights = np.ones_like(zero)
    left = flow
    for _ in range(8):  # iteratively reweighted: L1
        scaled = rows * weights[:, None, None]
        turn, *_ = np.linalg.lstsq(scaled.reshape(-1, 3), (flow * weights[:, None]).ravel(), rcond=None)
        left = flow - rows @ turn
        weights = 1 / np.sqrt(np.maximum(np.linalg.norm(left, axis=1), 1e-4))
    return left


def _usual_sharpness(times: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    """Median sharpness within `_SHARPNESS_WINDOW` seconds of each sample."""
    starts = np.searchsorted(times, times - _SHARPNESS_WINDOW)
    ends = np.searchsorted(times, times + _SHARPNESS_WINDOW, side="right")
    usual = np.array([np.median(sharpness[a:b]) for a, b in zip(starts, ends, strict=True)])
    return np.maximum(usual, 1e-6)


def _turns(times: np.ndarray, samples: Sequence[_Sample]) -> list[tuple[int, int]]:
    """First and last sample of each stretch in which the camera only turns."""
    if len(samples) < 2:
        return []
    # Over a second: single samples are noisy.
    window = max(1, round(1.0 / max(float(np.median(np.diff(times))), 1e-3)))
    motion, parallax = (
        np.convolve(np.nan_to_num([getattr(sample, name) for sample in samples]), np.ones(window), mode="same")
        for name in ("motion", "parallax")
    )
    found = _stretches((motion > _TURN_MOTION) & (parallax < _TURN_PARALLAX * motion))
    return [(start, end) for start, end in found if times[end] - times[start] >= _TURN_LENGTH]


def _novelty(samples: Sequence[_Sample], turns: Sequence[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """How many frames should be taken up to each sample, and whether it may be taken itself.

    Turns at either end, after or before which nothing comes, are left out, unless there is little else.
    """
    steps = np.array([_step(sample, is_turn=False) for sample in samples])
    for start, end in turns:
        steps[start : end + 1] = [_step(sample, is_turn=True) for sample in samples[start : end + 1]]
    steps[0] = 1.0  # the first frame
    steps = np.minimum(steps, 2.0)
    is_open = np.ones(len(samples), bool)
    for start, end in turns:
        if start <= 1 or end >= len(samples) - 2:
            is_open[start : end + 1] = False
    if steps[is_open].sum() < _FEWEST_BESIDE_TURNS:
        is_open[:] = True
    return np.cumsum(np.where(is_open, steps, 0.0)), is_open


def _step(sample: _Sample, is_turn: bool) -> float:
    """How many frames should be taken on the way to a sample from the one before."""
    if math.isnan(sample.motion):  # nothing was found again: all is new, or there was nothing
        return 1.0 if sample.corners >= 2 * _FEWEST_TRACKS else _BLANK_WEIGHT
    return (
        sample.motion / _TURN_STEP if is_turn else max(sample.parallax / _PARALLAX_STEP, sample.motion / _MOTION_STEP)
    )


def _spread(useful_frames: np.ndarray, sharpness: np.ndarray, is_open: np.ndarray, count: int) -> list[int]:
    """Numbers of samples: a sharp one, rather in the middle, of each of `count` stretches with equally much in each."""
    first = float(useful_frames[is_open][0])
    span = max(float(useful_frames[-1]) - first, 1e-12)
    place = np.clip((useful_frames - first) / span * count, 0, count - 1e-9)
    stretch = place.astype(int)
    score = sharpness - _CENTER_PREFERENCE * np.abs(2 * (place - stretch) - 1)
    chosen = []
    for number in range(count):
        there = np.flatnonzero((stretch == number) & is_open)
        if len(there):
            chosen.append(int(there[np.argmax(score[there])]))
    return chosen


def _sharp_instead(chosen: Sequence[int], times: np.ndarray, sharpness: np.ndarray, is_open: np.ndarray) -> list[int]:
    """The same samples, each blurred one replaced by a sharp one near by, if there is one."""
    taken = set[int]()
    for at in chosen:
        if sharpness[at] < _BLURRED_BELOW:
            near = np.flatnonzero(
                (np.abs(times - times[at]) <= _REPLACEMENT_WINDOW) & is_open & (sharpness >= _BLURRED_BELOW)
            )
            if len(near):
                at = int(near[np.argmin(np.abs(times[near] - times[at]))])
        taken.add(at)
    return sorted(taken)


def _stretches(is_so: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each stretch where something is so."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_so, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
