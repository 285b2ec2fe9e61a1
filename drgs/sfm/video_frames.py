"""Frames of a video that structure from motion can use: sharp ones, with parallax between them.

A video is looked at about ten times a second, reduced; each look is the sharpest of the frames around it. Corners are
tracked from look to look (Lucas-Kanade), the motion that a turn of the camera would make is fitted to the tracks and
taken out, and what is left is parallax: the part of the motion that tells how far away things are. Frames are spread
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

__all__ = ["ExaminedVideo", "Picked", "PickedFrame", "examine", "pick_frames"]

_LOOKS = 10.0  # a second
_MOST_LOOKS = 6_000  # ten minutes; of longer videos they are further apart
_CANDIDATES = 3  # frames of a look, at most, of which the sharpest is kept
_SHARP_AT = 960  # pixels of the longer side at which sharpness is measured
_WIDTH = 480  # the same of motion
_CORNERS = 400  # at most, that are tracked from look to look
_FOCAL = 0.9  # of the longer side: phones have 0.7 to 1.1; a wrong one leaves a turn's motion of second order alone
_PARALLAX = 0.01  # of the longer side, between two frames that are taken
_MOTION = 0.12  # the same of all motion, where there is little parallax: such frames connect
_TURN_STEP = 0.25  # the same within a turn, which is only to be bridged: three quarters are in both
_FEWEST_TRACKS = 20  # with fewer, motion and parallax are unknown
_BLANK = 0.05  # frames a look where there is nothing to be tracked
_BLURRED = 0.45  # of the sharpness that is usual near by
_NEAR = 1.5  # seconds that are near by
_INSTEAD = 0.35  # seconds that a sharp frame may be away from a blurred one whose place it takes
_TURN = 0.08  # share of parallax in the motion, below which the camera only turns
_TURN_MOTION = 0.15  # of the longer side, in a second: least motion of a turn that is worth a sentence
_TURN_LENGTH = 1.0  # seconds: a shorter one is a step's
_FEW = 3  # frames that a video must be worth beside its turns, for these to be left out
_FAST = 0.12  # of the longer side from one look to the next, a tenth of a second or less
_LONGEST_STEP = 0.3  # of the longer side: motion between two frames that leaves enough in both
_SHORTEST = 0.4  # seconds: a stretch that is shorter is not worth a sentence
_STILL = (2, 0.2, 1.0)  # frames and frames a second that a camera at rest asks for at most; seconds of it at least
_ASIDE = 0.25  # of relative sharpness: what a frame at the edge of its stretch must be sharper than one in the middle


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
    """What was taken of a video.

    Attributes:
        frames: The frames, in order; at least one.
        findings: What is wrong with the video, and what to do about it at the next shoot.
        looks: Number of frames that were compared with the one before.
        wanted: Number of frames that parallax and motion ask for; more than `frames` where these were bounded.
        frame_seconds: Time from one frame of the video to the next, on average; 0 of a single one.
    """

    frames: tuple[PickedFrame, ...]
    findings: tuple[Finding, ...]
    looks: int
    wanted: int
    frame_seconds: float


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


class ExaminedVideo:
    """A video that was looked at, from which frames can be picked.

    Attributes:
        wanted: Number of frames that parallax and motion ask for.
    """

    def __init__(self, video: VideoFile, looks: Sequence[_Look], frame_seconds: float) -> None:
        self._video = video
        self._looks = looks
        self._frame_seconds = frame_seconds
        self._times = np.array([look.seconds for look in looks])
        values = np.array([look.sharpness for look in looks])
        self._sharpness = values / _usual_sharpness(self._times, values)
        self._turns = _turns(self._times, looks)
        self._novelty, self._is_open = _novelty(looks, self._turns)
        self.wanted = max(1, math.ceil(float(self._novelty[-1]) - 1e-9))

    def pick(self, most: int) -> Picked:
        """At most so many frames, at least one."""
        chosen = _spread(self._novelty, self._sharpness, self._is_open, min(most, self.wanted))
        chosen = _sharp_instead(chosen, self._times, self._sharpness, self._is_open)
        frames = [self._taken(before, at) for before, at in zip([None, *chosen], chosen, strict=False)]
        findings = self._findings(frames)
        return Picked(tuple(frames), tuple(findings), len(self._looks), self.wanted, self._frame_seconds)

    def _taken(self, before: int | None, at: int) -> PickedFrame:
        """The frame at a look, with what moved since the one before."""
        between = [] if before is None else self._looks[before + 1 : at + 1]
        motion = float(np.nansum([look.motion for look in between]))
        parallax = float(np.nansum([look.parallax for look in between]))
        look = self._looks[at]
        frame = VideoFrame(self._video.path, look.index)
        return PickedFrame(frame, look.seconds, float(self._sharpness[at]), motion, parallax)

    def _findings(self, frames: Sequence[PickedFrame]) -> list[Finding]:
        """What is wrong with the video, the longest stretches first."""
        name, times = self._video.path.name, self._times
        motion = np.array([look.motion for look in self._looks])
        findings = list[tuple[float, Finding]]()

        def add(stretches: Sequence[tuple[int, int]], kind: str, text: str, advice: str) -> None:
            for start, end in stretches:
                if times[end] - times[start] >= _SHORTEST:
                    where = f"{name}, {times[start]:.1f} to {times[end]:.1f} s"
                    findings.append((times[end] - times[start], Finding(kind, f"{where}: {text}", advice)))

        aside = "step sideways while you turn, or walk around what you film"
        add(self._turns, "turn", "the camera only turns, which shows no depth", aside)
        is_blank = np.array([look.corners < 2 * _FEWEST_TRACKS for look in self._looks])
        is_fast = (np.nan_to_num(motion, nan=1.0) > _FAST) & ~is_blank
        share = "the camera moves too fast, pictures that follow each other share little"
        add(_stretches(is_fast), "fast", share, "film more slowly there")
        add(_stretches(self._sharpness < _BLURRED), "blur", "blurred", "hold still or get more light there")
        blank = "hardly anything to hold on to (sky, a blank wall, darkness)"
        add(_stretches(is_blank), "blank", blank, "keep something with texture in view")
        length = float(times[-1])
        most, rate, shortest = _STILL
        is_still = not self._turns and self.wanted <= max(most, rate * length) and not is_blank.all()
        if is_still and length >= shortest:
            text = f"{name}: the camera hardly moves in {length:.1f} s"
            findings.append((length, Finding("still", text, "walk around what you film")))
        far = [frame for frame in frames[1:] if frame.motion > _LONGEST_STEP]
        if len(far) > 0.1 * len(frames):
            text = f"{name}: {len(far)} of {len(frames)} frames share little with the one before"
            most = min(self.wanted, self._video.count)
            more = f"ask for more frames (--frames {most}), or " if most > len(frames) else ""
            findings.append((length, Finding("overlap", text, f"{more}film more slowly")))
        return [finding for _, finding in sorted(findings, key=lambda pair: -pair[0])]


def pick_frames(path: Path, most: int = 150, progress: Callable[[int, int], None] | None = None) -> Picked:
    """Frames of a video for structure from motion.

    Args:
        path: The video: mp4, mov, webm, mkv or avi.
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
    return examine(path, progress).pick(most)


def examine(path: Path, progress: Callable[[int, int], None] | None = None) -> ExaminedVideo:
    """Sharpness and motion throughout a video, one frame after the other.

    Args:
        path, progress: The arguments of `pick_frames`.
    Raises:
        FileNotFoundError, ValueError: No video, or one that cannot be decoded.
    """
    report = progress or (lambda done, total: None)
    video = read_video(Path(path))
    times = np.array(video.stamps) / 1000.0 if video.stamps else np.arange(video.count) / 30.0
    times = times - times[0]
    rate = (video.count - 1) / times[-1] if times[-1] > 0 else _LOOKS
    stride = max(1, int(rate / _LOOKS), math.ceil(video.count / _MOST_LOOKS))
    looks = list[_Look]()
    before: np.ndarray | None = None
    for start in range(0, video.count, stride):
        report(start, video.count)
        candidates = range(start, min(start + stride, video.count), math.ceil(stride / _CANDIDATES))
        sharpness, index, gray = _sharpest(video.path, candidates)
        motion, parallax, corners = (0.0, 0.0, _CORNERS) if before is None else _moved(before, gray)
        looks.append(_Look(index, float(times[index]), sharpness, motion, parallax, corners))
        before = gray
    report(video.count, video.count)
    return ExaminedVideo(video, looks, 1.0 / rate if video.count > 1 else 0.0)


def _sharpest(path: Path, indices: Sequence[int]) -> tuple[float, int, np.ndarray]:
    """Sharpness and number of the sharpest of some frames, and (h, w) uint8 of it, small."""
    candidates = []
    for index in indices:
        gray = VideoFrame(path, index).read_gray(_SHARP_AT)
        # Noise is no sharpness: of single pixels it is a large part of the Laplacian's variance.
        sharpness = float(cv2.Laplacian(cv2.GaussianBlur(gray, (0, 0), 0.8), cv2.CV_32F).var())
        candidates.append((sharpness, index, gray))
    sharpness, index, gray = max(candidates, key=lambda one: one[0])
    return sharpness, index, shrunk(gray, _WIDTH)


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


def _usual_sharpness(times: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    """Median sharpness within `_NEAR` seconds of each look."""
    starts = np.searchsorted(times, times - _NEAR)
    ends = np.searchsorted(times, times + _NEAR, side="right")
    usual = np.array([np.median(sharpness[a:b]) for a, b in zip(starts, ends, strict=True)])
    return np.maximum(usual, 1e-6)


def _turns(times: np.ndarray, looks: Sequence[_Look]) -> list[tuple[int, int]]:
    """First and last look of each stretch in which the camera only turns."""
    if len(looks) < 2:
        return []
    # Over a second: single looks are noisy.
    window = max(1, round(1.0 / max(float(np.median(np.diff(times))), 1e-3)))
    motion, parallax = (
        np.convolve(np.nan_to_num([getattr(look, name) for look in looks]), np.ones(window), mode="same")
        for name in ("motion", "parallax")
    )
    found = _stretches((motion > _TURN_MOTION) & (parallax < _TURN * motion))
    return [(start, end) for start, end in found if times[end] - times[start] >= _TURN_LENGTH]


def _novelty(looks: Sequence[_Look], turns: Sequence[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """How many frames should be taken up to each look, and whether it may be taken itself.

    Turns at either end, after or before which nothing comes, are left out, unless there is little else.
    """
    steps = np.array([_step(look, is_turn=False) for look in looks])
    for start, end in turns:
        steps[start : end + 1] = [_step(look, is_turn=True) for look in looks[start : end + 1]]
    steps[0] = 1.0  # the first frame
    steps = np.minimum(steps, 2.0)
    is_open = np.ones(len(looks), bool)
    for start, end in turns:
        if start <= 1 or end >= len(looks) - 2:
            is_open[start : end + 1] = False
    if steps[is_open].sum() < _FEW:
        is_open[:] = True
    return np.cumsum(np.where(is_open, steps, 0.0)), is_open


def _step(look: _Look, is_turn: bool) -> float:
    """How many frames should be taken on the way to a look from the one before."""
    if math.isnan(look.motion):  # nothing was found again: all is new, or there was nothing
        return 1.0 if look.corners >= 2 * _FEWEST_TRACKS else _BLANK
    return look.motion / _TURN_STEP if is_turn else max(look.parallax / _PARALLAX, look.motion / _MOTION)


def _spread(wanted: np.ndarray, sharpness: np.ndarray, is_open: np.ndarray, count: int) -> list[int]:
    """Numbers of looks: a sharp one, rather in the middle, of each of `count` stretches with equally much in each."""
    first = float(wanted[is_open][0])
    span = max(float(wanted[-1]) - first, 1e-12)
    place = np.clip((wanted - first) / span * count, 0, count - 1e-9)
    stretch = place.astype(int)
    score = sharpness - _ASIDE * np.abs(2 * (place - stretch) - 1)
    chosen = []
    for number in range(count):
        there = np.flatnonzero((stretch == number) & is_open)
        if len(there):
            chosen.append(int(there[np.argmax(score[there])]))
    return chosen


def _sharp_instead(chosen: Sequence[int], times: np.ndarray, sharpness: np.ndarray, is_open: np.ndarray) -> list[int]:
    """The same looks, but where one is blurred and another near by is not, that one."""
    taken = set[int]()
    for at in chosen:
        if sharpness[at] < _BLURRED:
            near = np.flatnonzero((np.abs(times - times[at]) <= _INSTEAD) & is_open & (sharpness >= _BLURRED))
            if len(near):
                at = int(near[np.argmin(np.abs(times[near] - times[at]))])
        taken.add(at)
    return sorted(taken)


def _stretches(is_so: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each stretch where something is so."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_so, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
