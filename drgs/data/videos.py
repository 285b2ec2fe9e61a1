"""Videos of synchronous cameras, read a frame at a time with OpenCV (FFmpeg).

What a header says about the number of frames is not believed: the packets of the file are walked, undecoded, which also
tells when each frame is shown. If the first and the last frame, decoded, are not shown when the packets say (a list of
edits, AVI with frames that refer to later ones), all frames are decoded once instead. Afterwards the time stamp of a
frame says whether a seek has arrived where it should; where it has not, frames are decoded one after the other from the
start.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from drgs.data.checks import native_stderr
from drgs.display.progress import Bar
from drgs.guards import memory
from drgs.guards.foreign import refuse_foreign

__all__ = ["VIDEO_SUFFIXES", "VideoFile", "VideoFrame", "list_videos", "read_video"]

VIDEO_SUFFIXES = (".mp4", ".webm", ".mkv", ".avi")
_MAX_PIXELS = 2**31
_MAX_FRAMES = 10**7  # four days at 30 a second; a time stamp of each is held
_MISSING = (0.02, 8)  # share or number of frames that a header may claim too many, where it states a duration alone
_NEAR = 16  # frames ahead that are decoded rather than sought
_SAME = 0.01  # milliseconds between time stamps of one frame
_OPEN = 4  # videos held open at once
_COPY = "it is truncated or damaged, copy it again"

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class VideoFrame:
    """One frame of a video, decoded when it is asked for.

    Attributes:
        path: The video.
        index: Of the frame as it is shown, from 0.
    """

    path: Path
    index: int

    def read(self) -> np.ndarray:
        """(H, W, 3) uint8, RGB.

        Raises:
            FileNotFoundError, ValueError: No video, too short, or one whose frame cannot be decoded.
        """
        video = read_video(self.path)
        if not 0 <= self.index < video.count:
            raise ValueError(
                f"{self.path}: frame {self.index} must be there, the video has {video.count}; load the data set again"
            )
        with _lock:
            return _reader(video).frame(self.index)


@dataclasses.dataclass(frozen=True)
class VideoFile:
    """What is in a video file.

    Attributes:
        path: The file.
        width, height: In pixels.
        stamps: Milliseconds at which each frame is shown, ascending; empty where the file does not say.
        count: Frames that are shown.
        version: Size and time of change of the file.
    """

    path: Path
    width: int
    height: int
    stamps: tuple[float, ...] = dataclasses.field(repr=False)
    count: int
    version: tuple[int, int]


def list_videos(folder: Path) -> list[Path]:
    """Videos directly in a folder, by name; hidden files are left out."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES and not p.name.startswith("."))


def read_video(path: Path) -> VideoFile:
    """Size and number of frames of a video, from its packets and its first and last frame.

    Raises:
        FileNotFoundError: No such file.
        ValueError: No video, one that OpenCV cannot open, or one that ends before its header says.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a video, found none; check the path")
    status = path.stat()
    return _walked(path, (status.st_size, status.st_mtime_ns))


@functools.lru_cache(maxsize=1024)
def _walked(path: Path, version: tuple[int, int]) -> VideoFile:
    """`read_video` of a file that has not changed since."""
    import cv2

    is_mp4 = _check_kind(path)
    raw, shown = _opened(path, [cv2.CAP_PROP_FORMAT, -1]), _opened(path, [])  # packets, undecoded; frames
    # Of frames as they are shown: phones turn them by a matrix in the header.
    width, height = int(shown.get(cv2.CAP_PROP_FRAME_WIDTH)), int(shown.get(cv2.CAP_PROP_FRAME_HEIGHT))
    claimed = raw.get(cv2.CAP_PROP_FRAME_COUNT)
    if not 1 <= width * height <= _MAX_PIXELS:
        raise ValueError(f"{path}: a video must have 1 to 2^31 pixels, its header says {width}x{height}; {_COPY}")
    memory.require(f"{path}", 6 * width * height, f"a frame of {width}x{height}", "reduce the video")
    stamps = []
    with native_stderr():
        while raw.grab():
            stamps.append(raw.get(cv2.CAP_PROP_POS_MSEC))
            if len(stamps) > _MAX_FRAMES:
                raise ValueError(f"{path}: must have at most {_MAX_FRAMES} frames, has more; cut it")
    if len(stamps) < claimed - (0 if is_mp4 else max(_MISSING[0] * claimed, _MISSING[1])):
        raise ValueError(
            f"{path}: must hold the {claimed:.0f} frames that its header claims, holds {len(stamps)}; {_COPY}"
        )
    stamps.sort()  # packets come in the order of decoding
    if not _is_ascending(stamps) or not _ends_agree(shown, stamps):
        stamps = _decoded(path, len(stamps))
    if not stamps:
        raise ValueError(f"{path}: must hold at least one frame, none can be read; {_COPY}")
    return VideoFile(path, width, height, tuple(stamps) if _is_ascending(stamps) else (), len(stamps), version)


def _is_ascending(stamps: list[float]) -> bool:
    return len(stamps) == 1 or bool(stamps and min(np.diff(stamps)) >= _SAME)


def _ends_agree(capture: Any, stamps: list[float]) -> bool:
    """Whether the first and the last frame are decoded with their time stamps, and nothing comes after them."""
    import cv2

    with native_stderr():
        for index in sorted({0, len(stamps) - 1}):
            if index and not capture.set(cv2.CAP_PROP_POS_FRAMES, index):
                return False
            if not capture.grab() or abs(capture.get(cv2.CAP_PROP_POS_MSEC) - stamps[index]) >= _SAME:
                return False
        return not capture.grab()


def _check_kind(path: Path) -> bool:
    """Whether a file begins as an mp4, which lists its frames; ValueError unless it begins as a video.

    A playlist, which names other files, does not.
    """
    with path.open("rb") as file:
        head = file.read(16)
    if head[4:8] == b"ftyp":
        return True
    if head[:4] == b"\x1aE\xdf\xa3" or (head[:4] == b"RIFF" and head[8:12] == b"AVI "):
        return False
    refuse_foreign(path, "a video")
    raise ValueError(f"{path}: must be a video (mp4, webm, mkv, avi), begins as none of them; convert it with ffmpeg")


def _opened(path: Path, options: list[int]) -> Any:
    """An open `cv2.VideoCapture`."""
    import cv2

    with native_stderr():
        # An absolute path is no protocol of FFmpeg's, and this backend knows no patterns of names.
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG, options)
    if not capture.isOpened():
        raise ValueError(f"{path}: must be a video, could not be opened; {_COPY}, or convert it with ffmpeg")
    return capture


def _decoded(path: Path, packets: int) -> list[float]:
    """Time stamps of all frames, as they are decoded; some decoders do not know those of the last ones.

    Raises:
        ValueError: A frame cannot be decoded. Where fewer are shown than there are packets, as a list of edits may say,
            the log tells.
    """
    import cv2

    capture, stamps = _opened(path, []), []
    with native_stderr() as complaints, Bar(f"frames of {path.name}") as bar:
        while len(stamps) <= _MAX_FRAMES and capture.grab():
            stamps.append(capture.get(cv2.CAP_PROP_POS_MSEC))
            bar.update(len(stamps))
    if len(stamps) < packets and complaints:
        raise ValueError(
            f"{path}: frame {len(stamps)} of {packets} must be decoded, could not be ({complaints[0].strip()[:100]}); "
            f"{_COPY}"
        )
    if 0 < len(stamps) < packets:
        _log.warning("%s: shows %d of the %d frames that it holds; these are used", path, len(stamps), packets)
    return stamps


class _Reader:
    """An open video and the place where it is."""

    def __init__(self, video: VideoFile) -> None:
        self.video, self._next, self._told, self._sought = video, 0, False, False
        self._capture = _opened(video.path, [])

    def frame(self, index: int) -> np.ndarray:
        """(H, W, 3) uint8, RGB, of the frame that is shown as number `index`; ValueError if it cannot be decoded."""
        with native_stderr() as complaints:
            data = self._at(index)
        if data is None:
            raise ValueError(
                f"{self.video.path}: frame {index} of {self.video.count} must be decoded, could not be; {_COPY}"
            )
        # After a seek, decoders complain about frames before it that others refer to, and leave these out.
        if complaints and not self._told and not self._sought:
            self._told = True
            text = complaints[0].strip()
            _log.warning("%s: is damaged, frames may be wrong (%s); copy it again", self.video.path, text)
        return np.ascontiguousarray(data[..., ::-1])

    def _at(self, index: int) -> np.ndarray | None:
        """The pixels of a frame (BGR), or None: going on from where the video is, by seeking, or from the start."""
        import cv2

        if 0 <= index - self._next <= _NEAR:
            if self._forward(index):
                return self._pixels()
        elif self.video.stamps and self._capture.set(cv2.CAP_PROP_POS_FRAMES, index):
            self._next, self._sought = index, True
            if self._forward(index):
                return self._pixels()
        self._capture.release()
        self._capture, self._next, self._sought = _opened(self.video.path, []), 0, False
        return self._pixels() if self._forward(index) else None

    def _forward(self, index: int) -> bool:
        """Decode up to a frame; whether it is the one that its time stamp says."""
        import cv2

        while self._next <= index:
            if not self._capture.grab():
                return False
            self._next += 1
        stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        return not self.video.stamps or abs(stamp - self.video.stamps[index]) < _SAME

    def _pixels(self) -> np.ndarray | None:
        read, data = self._capture.retrieve()
        return data if read and data is not None and data.ndim == 3 and data.shape[2] == 3 else None


_lock = threading.Lock()
_readers: OrderedDict[tuple[Path, tuple[int, int]], _Reader] = OrderedDict()


def _reader(video: VideoFile) -> _Reader:
    """An open reader; of the videos read last, `_OPEN` stay open."""
    key = (video.path, video.version)
    if key not in _readers:
        while len(_readers) >= _OPEN:
            _readers.popitem(last=False)
        _readers[key] = _Reader(video)
    _readers.move_to_end(key)
    return _readers[key]
