"""Neural 3D Video (Li et al., CVPR 2022): a video a camera, `cam00.mp4`, ..., and LLFF's `poses_bounds.npy` with a
row for each, in the order of their names. `cam00` is the test view of that data set.

In place of videos there may be folders of their frames, `cam00/images/0000.png`, ..., as 4DGaussians takes them out.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

from drgs.data.dataset import Dataset
from drgs.data.formats import Format
from drgs.data.llff import POSES_BOUNDS, pose_rows, row_camera
from drgs.data.multicamera import add_model_points, frame_folders, frames_of
from drgs.data.synchronous import Recording, evenly_spaced, synchronous
from drgs.data.videos import VIDEO_SUFFIXES, VideoFile, list_videos, read_video
from drgs.display.progress import Bar

_log = logging.getLogger(__name__)


def _folder(path: Path) -> Path:
    """The data set of which either the folder or the file of poses was named."""
    return path.parent if path.name == POSES_BOUNDS else path


def _find_videos(path: Path) -> list[Path]:
    """The videos of a folder that has poses for them, by name; empty if it has none."""
    if not (path / POSES_BOUNDS).is_file():
        return []
    return [video for video in list_videos(path) if video.stem.lower().startswith("cam")]


def _find_posed_frames(path: Path) -> list[Path]:
    """The folders of frames of cameras, in a folder that has poses for them, by name; empty if it has none."""
    return frame_folders(path) if (path / POSES_BOUNDS).is_file() else []


def load_neu3d(
    path: Path,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    times: int = 40,
    test_cameras: tuple[str, ...] | None = None,
    lazy: bool = False,
    points: bool = True,
    strict: bool = False,
) -> Dataset:
    """Load the videos of synchronous cameras, or folders of their frames. No image is decoded.

    The focal length belongs to the size that the poses state, and is scaled to that of the videos. Of videos of
    different length, as many frames are used as the shortest one has. Points are those of a COLMAP model of the first
    frame, if there is one (`add_model_points`).

    Args:
        path: The folder, or its `poses_bounds.npy`.
        background, times, test_cameras, lazy, points, strict: See `drgs.data.load`.
    Raises:
        FileNotFoundError: No such file.
        ValueError: a damaged video, poses for another number of them or of another shape, a pose that is none, or with
            `strict` videos of different length.
    """
    path = _folder(path)
    videos = _find_videos(path)
    rows = pose_rows(path / POSES_BOUNDS)
    files = videos or _find_posed_frames(path)
    _check_rows(path / POSES_BOUNDS, len(rows), files, bool(videos))
    numbers, sources = _videos(path, videos, times, strict) if videos else frames_of(files, times)
    recordings = []
    for index, (row, file) in enumerate(zip(rows, files, strict=True)):
        where = f"{path / POSES_BOUNDS}: row {index}"
        camera = row_camera(f"{where} ({file.name})", row, file.stem)
        recordings.append(Recording(file.stem, dict.fromkeys(numbers, camera), sources[file.stem], where))
    dataset = Dataset(path, "neu3d", [])
    synchronous(dataset, recordings, numbers, where=path, background=background, lazy=lazy, strict=strict)
    if points:
        seen = {recording.name: recording.cameras[numbers[0]] for recording in recordings}
        add_model_points(dataset, seen, test_cameras)
    return dataset


# Two rows: folders of frames that have a COLMAP model, too, are read with that, videos are not.
NEU3D = Format(lambda path: bool(_find_videos(_folder(path))), load_neu3d, (f"cam*.mp4 beside {POSES_BOUNDS}",))
NEU3D_FRAMES = Format(
    lambda path: bool(_find_posed_frames(_folder(path))), load_neu3d, (f"cam*/ beside {POSES_BOUNDS}",)
)


def _check_rows(poses: Path, rows: int, files: list[Path], are_videos: bool) -> None:
    """Raise ValueError unless every camera has a row, and one file; warn where names sort otherwise than numbers."""
    if len(files) != rows:
        found = f"videos (cam*{', cam*'.join(VIDEO_SUFFIXES)})" if are_videos else "folders of frames (cam00, ...)"
        raise ValueError(
            f"{poses}: must have one row a camera, in the order of their names, got {rows} rows and {len(files)} "
            f"{found}; restore the missing ones, or drop their rows"
        )
    stems = [file.stem for file in files]
    if stems != (ordered := sorted(stems, key=lambda stem: [int(x) for x in re.findall(r"\d{1,9}", stem)])):
        _log.warning(
            "%s: rows are those of %s, ..., in the order of the letters of their names; if they should be those of %s, "
            "..., rename them with as many digits each",
            poses,
            ", ".join(stems[:3]),
            ", ".join(ordered[:3]),
        )
    if twice := [stem for stem in stems if stems.count(stem) > 1]:
        raise ValueError(f"{poses.parent}: must hold one video a camera, {twice[0]} is there twice; remove one")


def _videos(path: Path, files: list[Path], times: int, strict: bool) -> tuple[tuple[int, ...], dict[str, VideoFile]]:
    """The numbers of the frames that are used, and the videos by their names.

    Raises:
        ValueError: A damaged video, or with `strict` videos of different length.
    """
    videos = []
    with Bar("videos", len(files)) as bar:
        for file in files:
            videos.append(read_video(file))
            bar.advance()
    shortest, longest = (choose(videos, key=lambda video: video.count) for choose in (min, max))
    if shortest.count < longest.count:
        text = f"{shortest.path.name} has {shortest.count} frames, {longest.path.name} {longest.count}"
        if strict:
            raise ValueError(f"{path}: videos must be of one length, {text}; cut them, or drop --strict (strict=True)")
        _log.warning(
            "%s: videos are of different length (%s); frames from %d on are left out", path, text, shortest.count
        )
    # Synchronous frames of one number are shown at one time, but for the moment at which a camera was started.
    lengths = {v.path.name: v.stamps[shortest.count - 1] - v.stamps[0] for v in videos if v.stamps}
    fast, slow = (choose(lengths, key=lengths.get, default="") for choose in (min, max))
    if lengths and (lengths[slow] - lengths[fast]) * (shortest.count - 1) > lengths[slow]:
        _log.warning(
            "%s: videos must have one frame rate, %d frames take %.0f ms in %s and %.0f ms in %s; frames of one number "
            "are taken to be of one time",
            path,
            shortest.count,
            lengths[fast],
            fast,
            lengths[slow],
            slow,
        )
    return evenly_spaced(range(shortest.count), times), {video.path.stem: video for video in videos}
