"""Pictures and videos from float arrays: PNG, JPEG, OpenEXR, WebM, color-mapped depth, captions.

Images are NumPy (H, W, 3), RGB. Colors of Gaussians are display-referred: they are fitted to the
8-bit values of photographs. They are therefore written as they are, clamped to [0, 1], without a
transfer function. Every file appears under its name only once it is complete.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from drgs.io import outputs
from drgs.io.outputs import write_whole

_INK = (235, 235, 235)  # RGB of text on pictures; chosen by eye
_NO_DEPTH_GRAY = 0.25  # gray of depth where nothing is
_ZERO_GRAY = 64  # gray of pixels whose value is 0
_MAX_DECADES = 3.0  # decades that the color scale spans, at most; chosen by eye
_WEBM_SEGMENT = bytes.fromhex("18538067")  # id of what holds all of a WebM file
_WEBM_HEAD = 1024  # bytes of the file within which that begins
_MAX_NAME_BYTES = 100  # bytes of a view's name in the name of a file
_JPEG_QUALITY = 95  # of 100
_XMP = b"http://ns.adobe.com/xap/1.0/\0"
_PANORAMA = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    'GPano:UsePanoramaViewer="True" GPano:ProjectionType="equirectangular" '
    'GPano:CroppedAreaLeftPixels="0" GPano:CroppedAreaTopPixels="0" '
    'GPano:CroppedAreaImageWidthPixels="{width}" GPano:CroppedAreaImageHeightPixels="{height}" '
    'GPano:FullPanoWidthPixels="{width}" GPano:FullPanoHeightPixels="{height}" '
    'GPano:PosePitchDegrees="0" GPano:PoseRollDegrees="0"/></rdf:RDF></x:xmpmeta>'
)
_OPAQUE_ALPHA = 0.5  # depth is shown where at least this much of the light stops


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Float image in [0, 1] as uint8, clamped and rounded to nearest; NaN becomes 0."""
    clamped = np.clip(np.nan_to_num(np.asarray(image, np.float32)), 0.0, 1.0)
    return np.rint(clamped * 255).astype(np.uint8)


def shrunk(picture: np.ndarray, longest: int) -> np.ndarray:
    """A picture (H, W) or (H, W, C) with at most so many pixels along its longer side, averaged over areas; as it is if
    it has no more.
    """
    import cv2

    height, width = picture.shape[:2]
    scale = longest / max(height, width)
    if scale >= 1:
        return picture
    # By the scale and not by the size: sides need not be whole multiples. Of a line of pixels one is left.
    size = None if scale * min(height, width) >= 1 else (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(np.ascontiguousarray(picture), size, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def file_names(names: list[str]) -> list[str]:
    """One file name for each view's name, which may hold folders, be empty or repeat: of at most 100 bytes, where file
    systems allow 255, and numbers of those that are alike.
    """
    result: list[str] = []
    for index, name in enumerate(names):
        clean = "".join(c if c.isalnum() or c in "-_." else "_" for c in name).strip(".")
        clean = clean.encode()[:_MAX_NAME_BYTES].decode(errors="ignore")
        clean = clean or f"view_{index:04d}"
        while clean in result:
            clean += f"_{index:04d}"
        result.append(clean)
    return result


def write_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write an (H, W, 3) RGB image, uint8 or float in [0, 1], as 8-bit PNG."""
    write_whole(path, png_bytes(image))


def png_bytes(image: np.ndarray) -> bytes:
    """The bytes that `write_png` writes."""
    import cv2

    pixels = image if image.dtype == np.uint8 else to_bytes(image)
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))  # as BGR, which OpenCV writes
    return encoded.tobytes()


def write_jpg(path: str | os.PathLike, image: np.ndarray, is_panorama: bool = False) -> None:
    """Write an (H, W, 3) RGB image, uint8 or float in [0, 1], as JPEG.

    Args:
        path: File to write.
        image: The picture.
        is_panorama: Whether it is equirectangular, 360 by 180 degrees: then XMP of Google's Photo Sphere says so, by
            which viewers know one.
    """
    import cv2

    pixels = image if image.dtype == np.uint8 else to_bytes(image)
    how = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, encoded = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), how)
    data = encoded.tobytes()
    if is_panorama:
        height, width = pixels.shape[:2]
        xmp = _XMP + _PANORAMA.format(width=width, height=height).encode()
        # A segment APP1 behind the mark that begins the file; its length counts itself.
        data = data[:2] + b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp + data[2:]
    write_whole(path, data)


def write_exr(path: str | os.PathLike, rgb: np.ndarray, **channels: np.ndarray) -> None:
    """Write a float32 OpenEXR file, values untouched.

    Args:
        rgb: (H, W, 3) colors.
        channels: (H, W) channels by their names in the file: `A` for alpha, `Z` for depth.
    """
    from drgs import runtime

    mi = runtime.mitsuba()
    import drjit as dr

    planes = [np.asarray(rgb, np.float32), *(np.asarray(x, np.float32)[..., None] for x in channels.values())]
    data = np.ascontiguousarray(np.concatenate(planes, axis=2))
    bitmap = mi.Bitmap(data, mi.Bitmap.PixelFormat.MultiChannel, ["R", "G", "B", *channels])
    threads = dr.thread_count()
    with _temporary(Path(path)) as name:
        try:
            # The encoder hands its work to the thread pool and waits: with a pool of one, for ever.
            dr.set_thread_count(max(2, threads))
            bitmap.write(name, mi.Bitmap.FileFormat.OpenEXR)
        except RuntimeError as error:
            reason = " ".join(str(error).split()).rpartition(": ")[2]
            raise OSError(f"{path}: must be written, got: {reason}; free some space or choose another folder") from None
        finally:
            dr.set_thread_count(threads)


def depth_picture(depth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """(H, W + bar, 3) uint8: near is bright, gray where alpha < 0.5, a labeled color bar at the right.

    The scale goes from the 1st to the 99th percentile of the depths shown, in scene units.
    """
    picture, (low, high) = depth_colors(depth, alpha)
    return _with_bar(picture, ((1.0, low), (0.5, (low + high) / 2), (0.0, high)), ".4g")


def depth_colors(depth: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """(H, W, 3) uint8 of `depth_picture` without its bar, and the nearest and the farthest depth of its scale."""
    known = (alpha >= _OPAQUE_ALPHA) & np.isfinite(depth)
    low, high = np.percentile(depth[known], (1, 99)) if known.any() else (0.0, 1.0)
    # Of one depth, too, the scale has a length to divide by: a millionth of it, which no label shows.
    high = max(high, low + 1e-12 + 1e-6 * abs(low))
    picture = inferno((high - np.where(known, depth, high)) / (high - low))
    picture[~known] = round(255 * _NO_DEPTH_GRAY)
    return picture, (float(low), float(high))


def map_picture(values: np.ndarray) -> np.ndarray:
    """(H, W + bar, 3) uint8: bright is large, on a logarithmic scale, with a labeled color bar; gray where it is 0.

    The scale ends at the largest value and covers what lies between it and the 1st percentile, at most three decades.

    Args:
        values: (H, W) values, finite and >= 0.
    """
    picture, (low, top) = map_colors(values)
    return _with_bar(picture, ((1.0, top), (0.5, math.sqrt(low * top)), (0.0, low)), ".2g")


def map_colors(values: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """(H, W, 3) uint8 of `map_picture` without its bar, and the least and the largest value of its scale."""
    known = values > 0
    top = np.log10(values[known].max()) if known.any() else 0.0
    low = np.log10(np.percentile(values[known], 1)) if known.any() else -1.0
    low = min(max(low, top - _MAX_DECADES), top - 1e-3)  # of one value, too, the scale has a length to divide by
    picture = inferno((np.log10(np.where(known, values, 10.0**low)) - low) / (top - low))
    picture[~known] = _ZERO_GRAY
    return picture, (float(10.0**low), float(10.0**top))


def inferno(shares: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 colors of shares in [0, 1], dark to bright; what is beyond is clamped."""
    import cv2

    # OpenCV's colors are BGR; contiguous, as it takes no arrays that are read backwards.
    return np.ascontiguousarray(cv2.applyColorMap(to_bytes(shares), cv2.COLORMAP_INFERNO)[..., ::-1])


def _with_bar(picture: np.ndarray, labels: tuple[tuple[float, float], ...], digits: str) -> np.ndarray:
    """The picture with a color bar at its right, bright above.

    Args:
        picture: (H, W, 3) uint8 picture.
        labels: Share of the scale, and the value there, of its upper end, its middle and its lower end.
        digits: Format in which values are printed.
    """
    import cv2

    height = len(picture)
    bar = np.zeros((height, 76, 3), np.uint8)
    bar[:, 4:16] = inferno(np.linspace(1.0, 0.0, height)[:, None].repeat(12, 1))
    font = cv2.FONT_HERSHEY_SIMPLEX
    inset = min(12, max(height - 2, 0))
    for row, (share, value) in zip((inset, height // 2 + 4, height - 4), labels, strict=True):
        if share in (0.0, 1.0) or height >= 48:
            cv2.putText(bar, f"{value:{digits}}", (20, row), font, 0.4, _INK, 1, cv2.LINE_AA)
    return np.concatenate([picture, bar], axis=1)


def caption(image: np.ndarray, text: str, times: int = 1) -> np.ndarray:
    """The picture as uint8 with a line of text above it, `times` as large as usual, shrunk to fit the width."""
    import cv2

    strip = np.zeros((20 * times, image.shape[1], 3), np.uint8)
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.42 * times
    (width, _), _ = cv2.getTextSize(text, font, scale, times)
    scale *= min(1.0, (image.shape[1] - 8 * times) / max(width, 1))
    cv2.putText(strip, text, (4 * times, 14 * times), font, scale, _INK, times, cv2.LINE_AA)
    pixels = image if image.dtype == np.uint8 else to_bytes(image)
    return np.concatenate([strip, pixels], axis=0)


class Video:
    """A WebM file (VP9), a frame at a time; it appears when the `with` block ends without an error.

    Args:
        path: File to write.
        fps: Frames a second.
    """

    def __init__(self, path: str | os.PathLike, fps: float = 24.0) -> None:
        self.path = Path(path)
        self.fps = fps
        self._writer: Any = None
        self._size: tuple[int, int] | None = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Video:
        self._name = self._stack.enter_context(_temporary(self.path))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if self._writer is not None:
            self._writer.release()
            if kind is None and (problem := self._problem()):
                self._stack.__exit__(OSError, problem, None)
                raise problem
        return bool(self._stack.__exit__(kind, error, trace))

    def _problem(self) -> OSError | None:
        """The encoder says nothing where the disk is full: whether the file is as long as it says itself."""
        with open(self._name, "rb") as file:
            head = file.read(_WEBM_HEAD)
        start = head.find(_WEBM_SEGMENT) + len(_WEBM_SEGMENT) + 8
        stated = int.from_bytes(head[start - 7 : start], "big")  # after the byte that says that 7 follow
        if os.path.getsize(self._name) == start + stated:
            return None
        return OSError(
            f"{self.path}: must be written, the file is not whole; is the disk full? free some space or choose another "
            "folder"
        )

    def write(self, image: np.ndarray) -> None:
        """Append an (H, W, 3) image, uint8 or float in [0, 1]; all frames must have one size.

        Raises:
            ValueError: If the size differs from the first frame's.
            OSError: If this build of OpenCV cannot encode VP9.
        """
        pixels = image if image.dtype == np.uint8 else to_bytes(image)
        # The encoder halves the chroma: it would silently crop an odd row or column.
        odd = [(0, side % 2) for side in pixels.shape[:2]]
        pixels = np.ascontiguousarray(np.pad(pixels, (*odd, (0, 0)), mode="edge")[..., ::-1])
        if self._writer is None:
            self._open(pixels.shape[1::-1])
        if pixels.shape[1::-1] != self._size:
            raise ValueError(
                f"{self.path}: all frames of a video must have one size, got {self._size} and "
                f"{pixels.shape[1::-1]}; give --width and --height, or leave webm out"
            )
        self._writer.write(pixels)

    def _open(self, size: tuple[int, int]) -> None:
        import cv2

        with _no_native_stderr():  # OpenCV prints that it prefers another tag, and goes on
            tag = cv2.VideoWriter_fourcc(*"VP90")  # type: ignore[attr-defined]  # OpenCV's stubs leave it out
            self._writer = cv2.VideoWriter(self._name, tag, self.fps, size)
        if not self._writer.isOpened():
            raise OSError(f"{self.path}: OpenCV must be able to encode VP9, this build cannot; use --format png")
        self._size = size


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[str]:
    """A name beside `path`, with its suffix, for a library that opens files itself; moved there at the end."""
    with outputs.replacing(path, path.suffix) as name:
        yield name
        if not os.path.getsize(name):
            raise OSError(f"{path}: must be written, but the file stayed empty; is the disk full?")


@contextlib.contextmanager
def _no_native_stderr() -> Iterator[None]:
    """Close the terminal to what C libraries print."""
    saved = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)
