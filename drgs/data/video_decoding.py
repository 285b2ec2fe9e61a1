"""Videos with OpenCV (FFmpeg), in a process of its own (reader_process.py): FFmpeg is large, files come from elsewhere.

What a header says about the number of frames is not believed: the packets of the file are walked, undecoded, which also
tells when each frame is shown. If the first and the last frame, decoded, are not shown when the packets say (a list of
edits, AVI with frames that refer to later ones), all frames are decoded once instead. Afterwards the time stamp of a
frame says whether a seek has arrived where it should; where it has not, frames are decoded one after the other from the
start.
"""

from __future__ import annotations

import importlib.util
import logging
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drgs.data.hdr import HDR, HdrReader, hdr_transfer
from drgs.data.images import native_stderr
from drgs.data.reader_process import serve
from drgs.display.pictures import shrunk
from drgs.runtime import memory

_MAX_PIXELS = 2**31  # of a frame: what an int of OpenCV holds
_MAX_FRAMES = 10**7  # four days at 30 a second; a time stamp of each is held
_MISSING = (0.02, 8)  # share or number of frames that a header may claim too many, where it states a duration alone
_NEAR = 16  # frames ahead that are decoded rather than sought
_SAME = 0.01  # milliseconds between time stamps of one frame
_MAX_OPEN = 4  # videos that are held open; chosen
_MAX_KNOWN = 1024  # videos whose size, frame count and time stamps are remembered; chosen
_REPORT_EVERY = 50  # frames between two reports
_COPY = "it is truncated or damaged, copy it again"

_log = logging.getLogger(__name__)


def walk(path: Path, version: Sequence[int], is_mp4: bool, report: Callable[[int], None]) -> dict[str, Any]:
    """What is in a video: `width`, `height`, `count` of frames that are shown, and the milliseconds at which they are,
    `stamps`, empty where the file does not say.

    Args:
        path: The file.
        version: Size and time of change; what was found is kept until these change.
        is_mp4: It lists its frames.
        report: Gets the number of frames that were decoded, where all are.
    Raises:
        ValueError: One that OpenCV cannot open, or that ends before its header says.
    """
    key = (path, *version)
    if key not in _walked:
        while len(_walked) >= _MAX_KNOWN:
            _walked.popitem(last=False)
        _walked[key] = _walk(path, is_mp4, report)
    return _walked[key]


def frame(path: Path, version: Sequence[int], is_mp4: bool, index: int, report: Callable[[int], None]) -> np.ndarray:
    """(H, W, 3) uint8, sRGB, of a frame, also of an HDR video.

    Args:
        path, version, is_mp4, report: The arguments of `walk`.
        index: Number of the frame as it is shown, from 0.
    Raises:
        ValueError: It cannot be decoded.
    """
    return _reader(path, version, is_mp4, report).frame(index)


def _reader(path: Path, version: Sequence[int], is_mp4: bool, report: Callable[[int], None]) -> _Reader:
    """An open video; of those read last, some stay open."""
    key = (path, *version)
    if key not in _readers:
        while len(_readers) >= _MAX_OPEN:
            _readers.popitem(last=False)
        video = walk(path, version, is_mp4, report)
        _readers[key] = _Reader(path, video["stamps"], video["count"], is_mp4)
    _readers.move_to_end(key)
    return _readers[key]


def gray(
    path: Path, version: Sequence[int], is_mp4: bool, index: int, longest: int, report: Callable[[int], None]
) -> np.ndarray:
    """(h, w) uint8 of a frame, reduced; of an HDR video its coded luma, which is as sharp.

    Args:
        path, version, is_mp4, index, report: The arguments of `frame`.
        longest: Pixels that the longer side has at most.
    Raises:
        ValueError: It cannot be decoded.
    """
    return shrunk(_reader(path, version, is_mp4, report).frame(index, is_gray=True), longest)


def _walk(path: Path, is_mp4: bool, report: Callable[[int], None]) -> dict[str, Any]:
    """`walk`, of a file that is not known."""
    # packets, undecoded; frames
    raw = _opened(path, [cv2.CAP_PROP_FORMAT, -1])
    shown = _opened(path, [])
    # Of frames as they are shown: phones turn them by a matrix in the header.
    width = int(shown.get(cv2.CAP_PROP_FRAME_WIDTH))
    height = int(shown.get(cv2.CAP_PROP_FRAME_HEIGHT))
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
        stamps = _decoded(path, len(stamps), report)
    if not stamps:
        raise ValueError(f"{path}: must hold at least one frame, none can be read; {_COPY}")
    shown_at = stamps if _is_ascending(stamps) else []
    return {"width": width, "height": height, "count": len(stamps), "stamps": shown_at}


def _is_ascending(stamps: list[float]) -> bool:
    return len(stamps) == 1 or bool(stamps and min(np.diff(stamps)) >= _SAME)


def _ends_agree(capture: Any, stamps: list[float]) -> bool:
    """Whether the first and the last frame are decoded with their time stamps, and nothing comes after them."""
    with native_stderr():
        for index in sorted({0, len(stamps) - 1}):
            if index and not capture.set(cv2.CAP_PROP_POS_FRAMES, index):
                return False
            if not capture.grab() or abs(capture.get(cv2.CAP_PROP_POS_MSEC) - stamps[index]) >= _SAME:
                return False
        return not capture.grab()


def _opened(path: Path, options: list[int]) -> Any:
    """An open `cv2.VideoCapture`."""
    with native_stderr():
        # An absolute path is no protocol of FFmpeg's, and this backend knows no patterns of names.
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG, options)
    if not capture.isOpened():
        raise ValueError(f"{path}: must be a video, could not be opened; {_COPY}, or convert it with ffmpeg")
    return capture


def _decoded(path: Path, packets: int, report: Callable[[int], None]) -> list[float]:
    """Time stamps of all frames, as they are decoded; some decoders do not know those of the last ones.

    Raises:
        ValueError: A frame cannot be decoded. Where fewer are shown than there are packets, as a list of edits may say,
            the log tells.
    """
    capture = _opened(path, [])
    stamps = []
    with native_stderr() as complaints:
        while len(stamps) <= _MAX_FRAMES and capture.grab():
            stamps.append(capture.get(cv2.CAP_PROP_POS_MSEC))
            if len(stamps) % _REPORT_EVERY == 0:
                report(len(stamps))
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

    def __init__(self, path: Path, stamps: list[float], count: int, is_mp4: bool) -> None:
        self._path = path
        self._stamps = stamps
        self._count = count
        self._next = 0
        self._has_warned = False
        self._sought = False
        self._capture = _opened(path, [])
        self._hdr: HdrReader | None = None
        transfer = hdr_transfer(path, is_mp4)
        if transfer and importlib.util.find_spec("av") is not None:
            self._hdr = HdrReader(path, transfer, stamps)
        elif transfer:
            _log.warning(
                "%s: is HDR video (%s), whose colors come out wrong without the package av; pip install 'drgs[video]', "
                "or convert it to SDR",
                path,
                HDR[transfer],
            )

    def frame(self, index: int, is_gray: bool = False) -> np.ndarray:
        """(H, W, 3) uint8, RGB, or (H, W), of the frame that is shown as number `index`; ValueError if it cannot be
        decoded.
        """
        if self._hdr is not None:
            found = self._hdr.frame(index, is_gray)
            if found is None:
                raise self._undecoded(index)
            return found
        with native_stderr() as complaints:
            data = self._at(index)
        if data is None:
            raise self._undecoded(index)
        # After a seek, decoders complain about frames before it that others refer to, and leave these out.
        if complaints and not self._has_warned and not self._sought:
            self._has_warned = True
            text = complaints[0].strip()
            _log.warning("%s: is damaged, frames may be wrong (%s); copy it again", self._path, text)
        return cv2.cvtColor(data, cv2.COLOR_BGR2GRAY if is_gray else cv2.COLOR_BGR2RGB)

    def _undecoded(self, index: int) -> ValueError:
        return ValueError(f"{self._path}: frame {index} of {self._count} must be decoded, could not be; {_COPY}")

    def _at(self, index: int) -> np.ndarray | None:
        """The pixels of a frame (BGR), or None: going on from where the video is, by seeking, or from the start."""
        if 0 <= index - self._next <= _NEAR:
            if self._forward(index):
                return self._pixels()
        elif self._stamps and self._capture.set(cv2.CAP_PROP_POS_FRAMES, index):
            self._next = index
            self._sought = True
            if self._forward(index):
                return self._pixels()
        self._capture.release()
        self._capture = _opened(self._path, [])
        self._next = 0
        self._sought = False
        return self._pixels() if self._forward(index) else None

    def _forward(self, index: int) -> bool:
        """Decode up to a frame; whether it is the one that its time stamp says."""
        while self._next <= index:
            if not self._capture.grab():
                return False
            self._next += 1
        stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        return not self._stamps or abs(stamp - self._stamps[index]) < _SAME

    def _pixels(self) -> np.ndarray | None:
        read, data = self._capture.retrieve()
        return data if read and data is not None and data.ndim == 3 and data.shape[2] == 3 else None


_walked: OrderedDict[tuple, dict[str, Any]] = OrderedDict()
_readers: OrderedDict[tuple, _Reader] = OrderedDict()


if __name__ == "__main__":
    serve({"walk": walk, "frame": frame, "gray": gray})
