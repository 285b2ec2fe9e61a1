"""Photographs and frames of videos in one folder, for structure from motion."""

from __future__ import annotations

import dataclasses
import itertools
import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drgs.data.images import IMAGE_SUFFIXES, list_images, read_image
from drgs.data.videos import VIDEO_SUFFIXES, list_videos, read_video
from drgs.io.atomic import temporary_folder
from drgs.io.foreign import refuse_foreign
from drgs.io.journal import SCHEMA
from drgs.io.json_files import check_json, read_json
from drgs.io.outputs import LockedFolder
from drgs.sfm.findings import Finding
from drgs.sfm.photo_files import entry_fault, leave_out, link_or_copy, usable_photos
from drgs.sfm.video_frames import Picked, examine

FRAMES = "frames.json"
"""Beside the pictures: which of them are of which video, and of which moment."""
_QUALITY = 97  # of JPEG: what a video's own compression has left is kept
_SUFFIXES = (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES)

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class ImageFolder:
    """Result of filling a folder with photographs and frames.

    Attributes:
        folder: The folder.
        photographs: Number of photographs.
        frames: Number of frames of videos.
        findings: What is wrong with the videos.
    """

    folder: Path
    photographs: int
    frames: int
    findings: tuple[Finding, ...]

    def line(self) -> str:
        """In one line."""
        parts = [f"{self.photographs} photographs"] if self.photographs else []
        parts += [f"{self.frames} frames of videos"] if self.frames else []
        return " and ".join(parts)


def named_files(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Photographs and videos that paths name: files, or folders with some; each once. The log names those that are left
    out: pipes, folders, links to nothing, and names that COLMAP cannot hold.

    Raises:
        FileNotFoundError: Nothing there, or a folder without either.
        ValueError: A file that is neither.
    """
    photographs, videos = list[Path](), list[Path]()
    for path in paths:
        if path.is_dir():
            found = list_images(path), list_videos(path)
            if not any(found):
                raise FileNotFoundError(
                    f"{path}: must hold photographs or videos, holds none ({', '.join(_SUFFIXES)}); check the path"
                )
            photographs += found[0]
            videos += [video for video in found[1] if not _is_live_photo(video, found[0])]
        elif not path.exists() and not path.is_symlink():
            raise FileNotFoundError(f"{path}: must be photographs or a video, found none; check the path")
        elif path.suffix.lower() in IMAGE_SUFFIXES:
            photographs.append(path)
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            videos.append(path)
        else:
            refuse_foreign(path, "a photograph or a video")
            raise ValueError(
                f"{path}: must be a photograph or a video ({', '.join(_SUFFIXES)}), got {path.suffix or 'no suffix'}; "
                "convert it, or leave it out"
            )
    photographs, videos = (leave_out(files, entry_fault, paths[0]) for files in (photographs, videos))
    return _once(photographs), _once(videos)


def usable_files(
    photographs: Sequence[Path],
    videos: Sequence[Path],
    where: Path,
    fewest: int,
    max_image_size: int = 1600,
    decode: Callable[[Path], np.ndarray] = read_image,
) -> tuple[list[Path], list[Path]]:
    """Those photographs and videos that can be used; all photographs are decoded. The log names the others.

    Args:
        photographs, videos: Files, as `named_files` lists them.
        where: What was named, for the message.
        fewest: How many photographs there must be where there are no videos.
        max_image_size: Pixels on the longer side that features are found at; 0 for the photographs' own.
        decode: As `drgs.data.images.read_image`, which it may keep the pictures of.
    Raises:
        ValueError: Fewer are left; the message says what is wrong with the first of the others.
    """
    videos = leave_out(videos, _video_fault, where, 0 if photographs else 1, "videos")
    return usable_photos(photographs, where, 0 if videos else fewest, max_image_size, decode), videos


def _video_fault(path: Path) -> str:
    """Why a video cannot be read, a line that names it; empty where it can."""
    try:
        read_video(path)
    except ValueError as error:
        return str(error)
    return ""


def _once(files: Sequence[Path]) -> list[Path]:
    """Files without those that were named before."""
    first = dict[Path, Path]()
    for file in files:
        first.setdefault(file.resolve(), file)
    return list(first.values())


def _is_live_photo(video: Path, photographs: Sequence[Path]) -> bool:
    """Whether a video is the seconds around a photograph, which phones keep beside it under its name."""
    is_one = any(photograph.stem == video.stem for photograph in photographs)
    if is_one:
        _log.info("%s: left out, it is of the moment of a photograph of that name; name it to use it", video)
    return is_one


def make_image_folder(
    photographs: Sequence[Path],
    videos: Sequence[Path],
    output: LockedFolder,
    name: str = "photos",
    most: int = 150,
    progress: Callable[[str, int, int], None] | None = None,
) -> ImageFolder:
    """Links to photographs, and frames of videos as JPEG, in a folder that is complete or not there at all.

    Photographs keep their names; where two have the same one, the name of the folder comes before that of the second.
    Frames are named by video and number, so that they follow each other by name.

    Args:
        photographs, videos: Files, as `named_files` lists them.
        output: The folder in which the new one is made; it is held by the command.
        name: Name of the new folder; there must be none.
        most: Largest number of frames of all videos together, shared out by their lengths in frames that are wanted.
        progress: Called with (what is done, done, total).
    Raises:
        FileNotFoundError, ValueError: A video that cannot be decoded.
    """
    with temporary_folder("photos", output.path) as unfinished:
        made = unfinished / name
        images = fill_image_folder(made, photographs, videos, output.command, most, progress)
        output.put(made, name)
    return dataclasses.replace(images, folder=output.path / name)


def fill_image_folder(
    folder: Path,
    photographs: Sequence[Path],
    videos: Sequence[Path],
    command: str,
    most: int = 150,
    progress: Callable[[str, int, int], None] | None = None,
) -> ImageFolder:
    """Make the folder that `make_image_folder` puts in its place.

    Args:
        folder: The new folder; there must be none.
        photographs, videos, most, progress: The arguments of `make_image_folder`.
        command: Name of the command, for frames.json.
    """
    report = progress or (lambda stage, done, total: None)
    picked = _picked(videos, most, report) if videos else []
    folder.mkdir()
    names = list[str]()
    for path in photographs:
        names.append(_free_name(folder, path))
        link_or_copy(path, folder / names[-1])
    rows = list[dict[str, Any]]()
    total = sum(len(one.frames) for one in picked)
    for video, stem, one in zip(videos, _stems(videos), picked, strict=True):
        for frame in one.frames:
            report("frames", len(rows), total)
            file = _free_name(folder, Path(video.resolve().parent.name) / f"{stem}_{frame.frame.index:06d}.jpg")
            pixels = np.ascontiguousarray(frame.frame.read()[..., ::-1])
            data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
            (folder / file).write_bytes(data.tobytes())
            row = {"file": file, "video": str(video), "index": frame.frame.index, "seconds": frame.seconds}
            rows.append({**row, **{key: getattr(frame, key) for key in ("sharpness", "motion", "parallax")}})
    findings = tuple(finding for one in picked for finding in one.findings)
    listed = {
        "schema": SCHEMA,
        "command": command,
        "videos": [_video_row(video, one) for video, one in zip(videos, picked, strict=True)],
        "frames": rows,
        "findings": [dataclasses.asdict(finding) for finding in findings],
    }
    listed = joined_frames(listed if videos else None, photographs, names, command)
    if listed is not None:
        write_frames(folder / FRAMES, listed)
    return ImageFolder(folder, len(photographs), len(rows), findings)


def write_frames(path: Path, listed: dict[str, Any]) -> None:
    """A frames.json.

    Args:
        path: The file.
        listed: The content, as `recorded_frames` and `joined_frames` give it.
    """
    path.write_text(json.dumps(listed, indent=1) + "\n")


def recorded_frames(folder: Path) -> dict[str, Any] | None:
    """The content of the frames.json of a folder of pictures; None without one, or where it is not of ours.

    Raises:
        ValueError: One of ours that is damaged.
    """
    path = folder / FRAMES
    if not path.is_file():
        return None
    content = read_json(path, "a list of frames that drgs wrote", "gather the frames again")
    if not isinstance(content, dict) or not {"schema", "command", "frames"} <= content.keys():
        return None
    shape = {"videos": list, "frames": [{"file": str, "video": str}], "findings": list}
    check_json(f"{path}", content, shape, "gather the frames again")
    return content


def joined_frames(
    listed: dict[str, Any] | None, files: Sequence[Path], names: Sequence[str], command: str
) -> dict[str, Any] | None:
    """The content of a frames.json, and what those beside further pictures say of these.

    Args:
        listed: The content; None for none.
        files: Pictures, some of which may be frames of videos by the frames.json of their folder.
        names: What each of them is called here.
        command: Name of the command that joins them.
    Returns:
        None if there is nothing to say.
    Raises:
        ValueError: A frames.json of ours that is damaged.
    """
    for folder in dict.fromkeys(file.parent for file in files):
        more = recorded_frames(folder)
        if more is None:
            continue
        name_of = {file.name: name for file, name in zip(files, names, strict=True) if file.parent == folder}
        frames = [{**row, "file": name_of[row["file"]]} for row in more["frames"] if row["file"] in name_of]
        if not frames:
            continue
        listed = listed or {"schema": SCHEMA, "command": command, "videos": [], "frames": [], "findings": []}
        listed = {
            **listed,
            "videos": [*listed["videos"], *more["videos"]],
            "frames": [*listed["frames"], *frames],
            "findings": [*listed["findings"], *more["findings"]],
        }
    return listed


def _video_row(video: Path, picked: Picked) -> dict[str, Any]:
    """A video in frames.json. How long its sensor takes from the first line to the last one no file says."""
    row = {"video": str(video), "frame_seconds": picked.frame_seconds, "readout_seconds": None}
    return row | {"looks": picked.samples, "wanted": picked.useful_frames, "frames": len(picked.frames)}


def _picked(videos: Sequence[Path], most: int, report: Callable[[str, int, int], None]) -> list[Picked]:
    """Frames of each video; of several, as many of each as its share of those that are wanted."""
    if most < max(1, len(videos)):
        raise ValueError(f"frames: must be at least one of each video, {len(videos)}, got {most}; ask for more")
    examined = []
    for video in videos:
        examined.append(
            examine(video, lambda done, total, video=video: report(f"looking at {video.name}", done, total))
        )
    wanted = [min(one.useful_frames, most) for one in examined]
    shares = wanted
    if sum(wanted) > most:  # one of each, and the rest by what is wanted
        rest = most - len(wanted)
        shares = [1 + int(rest * (one - 1) / max(sum(wanted) - len(wanted), 1)) for one in wanted]
    return [one.pick(share) for one, share in zip(examined, shares, strict=True)]


def _stems(videos: Sequence[Path]) -> list[str]:
    """What the names of frames begin with, of each video another: frames of one follow each other by name."""
    stems = list[str]()
    for video in videos:
        numbered = (f"{video.stem}_{k}" for k in itertools.count(2))
        names = itertools.chain((video.stem, f"{video.resolve().parent.name}_{video.stem}"), numbered)
        stems.append(next(name for name in names if name not in stems))
    return stems


def _free_name(folder: Path, path: Path) -> str:
    """Name of a file that is not taken in a folder."""
    numbered = (f"{path.stem}_{k}{path.suffix}" for k in itertools.count(2))
    names = itertools.chain((path.name, f"{path.parent.name}_{path.name}"), numbered)
    return next(name for name in names if not (folder / name).is_symlink() and not (folder / name).exists())
