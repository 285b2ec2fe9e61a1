"""MP4 files (H.264), which browsers and phones play; OpenCV's wheels cannot encode it, PyAV's can."""

from __future__ import annotations

import contextlib
import fractions
import importlib.util
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from drgs.display.pictures import to_bytes
from drgs.io import outputs

_QUALITY = "18"  # x264's constant rate factor: differences that are hardly seen


def need_mp4(where: str) -> None:
    """Raise ValueError without PyAV.

    Args:
        where: What needs it, for the message.
    """
    if importlib.util.find_spec("av") is None:
        raise ValueError(
            f"{where}: mp4 must have the package av (PyAV), which is missing; pip install 'drgs[video]', or use webm"
        )


class Mp4:
    """An MP4 file (H.264, 4:2:0, BT.709), a frame at a time; it appears when the `with` block ends without an error.

    Its index stands at its begin, so that a browser plays it while it is loaded.

    Args:
        path: File to write.
        fps: Frames a second.
    Raises:
        ValueError: Without PyAV.
    """

    def __init__(self, path: str | os.PathLike, fps: float = 24.0) -> None:
        self.path = Path(path)
        self.fps = fps
        need_mp4(str(self.path))
        self._container: Any = None
        self._stream: Any = None
        self._size: tuple[int, int] | None = None
        self._count = 0
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Mp4:
        self._name = self._stack.enter_context(outputs.replacing(self.path, self.path.suffix))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if self._container is not None:
            try:
                if kind is None:
                    self._container.mux(self._stream.encode())
                self._container.close()
            except Exception as problem:  # PyAV's errors are of many classes
                if kind is None:
                    failure = self._failure(problem)
                    self._stack.__exit__(OSError, failure, None)
                    raise failure from None
        return bool(self._stack.__exit__(kind, error, trace))

    def write(self, image: np.ndarray) -> None:
        """Append an (H, W, 3) image, uint8 or float in [0, 1]; all frames must have one size.

        Raises:
            ValueError: If the size differs from the first frame's.
            OSError: If it cannot be encoded or written.
        """
        import av

        pixels = image if image.dtype == np.uint8 else to_bytes(image)
        odd = [(0, side % 2) for side in pixels.shape[:2]]  # chroma is halved, as in webm
        pixels = np.ascontiguousarray(np.pad(pixels, (*odd, (0, 0)), mode="edge"))
        size = pixels.shape[1], pixels.shape[0]
        if self._size is None:
            self._size = size
        if size != self._size:
            raise ValueError(
                f"{self.path}: all frames of a video must have one size, got {self._size} and {size}; "
                "give --width and --height, or leave mp4 out"
            )
        try:
            if self._container is None:
                self._open(size)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
            frame.pts = self._count
            frame.time_base = self._stream.codec_context.time_base
            self._count += 1
            self._container.mux(self._stream.encode(frame))
        except Exception as problem:
            raise self._failure(problem) from None

    def _open(self, size: tuple[int, int]) -> None:
        """Begin the file."""
        import av

        rate = fractions.Fraction(self.fps).limit_denominator(10_000)
        self._container = av.open(self._name, "w", format="mp4", options={"movflags": "+faststart"})
        self._stream = self._container.add_stream("libx264", rate=rate, options={"crf": _QUALITY, "preset": "medium"})
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.time_base = 1 / rate
        context.colorspace, context.color_range = 1, 1  # BT.709, of 16 to 235
        context.color_primaries, context.color_trc = 1, 1
        context.thread_count = 1

    def _failure(self, problem: Exception) -> OSError:
        """The error of the path, in a line."""
        text = " ".join(str(problem).split()) or type(problem).__name__
        return OSError(
            f"{self.path}: must be written, got: {text}; free some space, choose another folder, or use webm"
        )
