"""Videos, read a frame at a time by a process of its own (video_decoding.py)."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np

from drgs.data.reader_process import Child
from drgs.display.progress import Bar
from drgs.io.foreign import refuse_foreign

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi")

_decoder = Child("drgs.data.video_decoding", "a video that can be decoded", "convert it with ffmpeg, or leave it out")


@dataclasses.dataclass(frozen=True)
class VideoFrame:
    """One frame of a video, decoded at first use.

    Attributes:
        path: The video.
        index: Number of the frame as it is shown, from 0.
    """

    path: Path
    index: int

    def read(self) -> np.ndarray:
        """(H, W, 3) uint8, RGB.

        Raises:
            FileNotFoundError, ValueError: No video, too short, or one whose frame cannot be decoded.
        """
        video = self._video()
        return _decoder.call("frame", self.path, video.version, video.is_mp4, self.index)

    def read_gray(self, longest: int) -> np.ndarray:
        """(h, w) uint8, reduced to at most `longest` pixels along the longer side.

        Raises:
            FileNotFoundError, ValueError: As of `read`.
        """
        video = self._video()
        return _decoder.call("gray", self.path, video.version, video.is_mp4, self.index, longest)

    def _video(self) -> VideoFile:
        video = read_video(self.path)
        if not 0 <= self.index < video.count:
            raise ValueError(
                f"{self.path}: frame {self.index} must be there, the video has {video.count}; load the data set again"
            )
        return video


@dataclasses.dataclass(frozen=True)
class VideoFile:
    """What is in a video file.

    Attributes:
        path: The file.
        width, height: Size in pixels.
        stamps: Milliseconds at which each frame is shown, ascending; empty where the file does not say.
        count: Frames that are shown.
        version: Size and time of change of the file.
        is_mp4: It lists its frames.
    """

    path: Path
    width: int
    height: int
    stamps: tuple[float, ...] = dataclasses.field(repr=False)
    count: int
    version: tuple[int, int]
    is_mp4: bool


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
    is_mp4 = _check_kind(path)
    with Bar(f"frames of {path.name}") as bar:
        found = _decoder.call("walk", path, version, is_mp4, progress=bar.update)
    return VideoFile(path, found["width"], found["height"], tuple(found["stamps"]), found["count"], version, is_mp4)


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
    raise ValueError(
        f"{path}: must be a video (mp4, mov, webm, mkv, avi), begins as none of them; convert it with ffmpeg"
    )
