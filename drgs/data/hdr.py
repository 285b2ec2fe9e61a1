"""HDR videos and photographs, as phones and cameras record them (HLG or PQ, BT.2020, 10 bits), in sRGB.

OpenCV takes no notice of the tags in some versions and compresses tones and saturation in others, so that frames are
decoded with PyAV. Reference white becomes white, and what is brighter is clipped: light below it keeps its proportions.
HLG is light of the scene (BT.2100, table 5), whose white is at 75 % of the signal, PQ that of a display (table 4),
whose white has 203 cd/m2 (both BT.2408, table 1). Colors that sRGB does not have are clipped.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drgs.display.srgb import srgb_from_linear

HDR = {16: "PQ", 18: "HLG"}
"""Names of the transfer characteristics that are converted, by their numbers in ITU-T H.273."""

_HLG_WHITE = 0.75  # of the signal
_PQ_WHITE = 203.0  # cd/m2
_PQ_PEAK = 10_000.0  # cd/m2
_LARGEST = 1 << 26  # bytes of a header that are read; that of an hour of video has some MiB
_MATROSKA = 1 << 20  # bytes in which Matroska and WebM describe their tracks
_NEAR = 16  # frames ahead that are decoded rather than sought
_SAME = 0.01  # milliseconds between time stamps of one frame
# Linear BT.2020 to linear sRGB: BT.2087, annex 1
_TO_SRGB = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)  # fmt: skip


def hdr_transfer(path: Path, is_mp4: bool) -> int:
    """Number in `HDR` of a video, as the decoder says, or, without PyAV, the header of the file; 0 for other videos.

    Args:
        path: An mp4, a Matroska, a WebM or an AVI file.
        is_mp4: It is an mp4.
    """
    if importlib.util.find_spec("av") is not None:
        import av

        with contextlib.suppress(av.error.FFmpegError), av.open(str(path.resolve())) as container:
            found = [stream.codec_context.color_trc for stream in container.streams.video[:1]]
            return found[0] if found and found[0] in HDR else 0
    with path.open("rb") as file:
        data = _movie_header(file) if is_mp4 else file.read(_MATROSKA)
    pattern = rb"colrncl[cx]..(..)" if is_mp4 else rb"\x55\xba\x81(.)"  # of the first track that says so
    found = re.search(pattern, data, re.DOTALL)
    transfer = int.from_bytes(found[1], "big") if found else 0
    return transfer if transfer in HDR else 0


def _movie_header(file: Any) -> bytes:
    """The box `moov` of an mp4, or its beginning."""
    while len(head := file.read(8)) == 8:
        size, behind = int.from_bytes(head[:4], "big"), 8
        if size == 1:
            size, behind = int.from_bytes(file.read(8), "big"), 16
        if head[4:] == b"moov":
            return file.read(min(size, _LARGEST))
        if size < behind:  # 0: up to the end of the file
            break
        file.seek(size - behind, 1)
    return b""


class HdrReader:
    """Frames of an HDR video in sRGB, decoded with PyAV.

    Args:
        path: The video.
        transfer: Number in `HDR`, as `hdr_transfer` says.
        stamps: Milliseconds at which each frame is shown; empty where the file does not say.
    Raises:
        OSError, ValueError: PyAV cannot open it.
    """

    def __init__(self, path: Path, transfer: int, stamps: Sequence[float]) -> None:
        import av

        self._transfer = transfer
        self._stamps = stamps
        self._container = av.open(str(path.resolve()))
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._frames: Iterator[Any] = iter(())
        self._next = -1  # number of the frame that is decoded next; -1: it has not begun

    def frame(self, index: int, is_gray: bool = False) -> np.ndarray | None:
        """(H, W, 3) uint8, sRGB, of the frame that is shown as number `index`; None where it cannot be decoded.

        Args:
            index: Number of the frame as it is shown, from 0.
            is_gray: Its coded luma (H, W) instead.
        """
        import av

        try:
            found = self._decoded(index)
        except av.error.FFmpegError:
            found = None
        if found is None:
            return None
        # FFmpeg 8 would convert tones, too, of a frame that says which it has; before, PyAV does not report it.
        with contextlib.suppress(AttributeError):
            found.color_trc = found.color_primaries = 1
        if is_gray:
            shown = found.to_ndarray(format="gray")
        else:
            shown = in_srgb(found.to_ndarray(format="rgb48le"), self._transfer)
        return np.ascontiguousarray(np.rot90(shown, round(found.rotation / 90)))

    def _decoded(self, index: int) -> Any:
        """The frame as it is decoded, or None: going on from where the video is, by seeking, or from the start."""
        if self._stamps and not 0 <= index - self._next <= _NEAR:
            found = self._sought(index)
            if found is not None:
                return found
        if not 0 <= self._next <= index:
            self._begin(0)
            self._next = 0
        for found in self._frames:
            self._next += 1
            if self._next > index:
                return found
        return None

    def _begin(self, offset: int) -> None:
        """Decode from the last key frame at or before a place, in units of the stream's clock after its start."""
        self._container.seek((self._stream.start_time or 0) + offset, stream=self._stream)
        self._frames = self._container.decode(self._stream)

    def _sought(self, index: int) -> Any:
        """The frame with the time stamp of number `index`; None where a seek does not lead to it."""
        clock = 1000 * float(self._stream.time_base)  # milliseconds
        self._begin(round(self._stamps[index] / clock))
        self._next = -1
        for found in self._frames:
            ahead = (found.pts - (self._stream.start_time or 0)) * clock - self._stamps[index]
            if ahead > -_SAME:
                if ahead < _SAME:
                    self._next = index + 1
                    return found
                break
        return None


def in_srgb(signal: np.ndarray, transfer: int) -> np.ndarray:
    """(H, W, 3) uint8 of an HLG or PQ picture of BT.2020.

    Args:
        signal: (H, W, 3) uint16, RGB as it is coded, of 65535.
        transfer: Number of its tones in `HDR`.
    """
    import cv2

    light = cv2.transform(_linear(transfer)[signal], _TO_SRGB).clip(0, 1)
    return _encoding()[(65535 * light + 0.5).astype(np.uint16)]


@functools.cache
def _linear(transfer: int) -> np.ndarray:
    """(65536,) float32: light of each number of 16 bits in a signal, 1 is reference white."""
    signal = np.linspace(0, 1, 1 << 16)
    if HDR[transfer] == "PQ":
        power = signal ** (1 / 78.84375)
        found = (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (1 / 0.1593017578125)
        return (_PQ_PEAK / _PQ_WHITE * found).astype(np.float32)
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    found = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    return (found / np.interp(_HLG_WHITE, signal, found)).astype(np.float32)


@functools.cache
def _encoding() -> np.ndarray:
    """(65536,) uint8: the sRGB number of each share of 65535 of white."""
    light = np.linspace(0, 1, 1 << 16)
    return np.round(255 * srgb_from_linear(light)).astype(np.uint8)
