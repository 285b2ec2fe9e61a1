"""Neural 3D Video (Li et al., CVPR 2022): a video a camera, ``cam00.mp4``, ..., and LLFF's ``poses_bounds.npy`` with a
row for each, in the order of their names. ``cam00`` is the test view of that data set.
"""

from __future__ import annotations

import logging
from pathlib import Path

from drgs.data.llff import pose_rows, row_camera
from drgs.data.multicamera import add_model_points
from drgs.data.synchronous import Recording, evenly_spaced, synchronous
from drgs.data.videos import VIDEO_SUFFIXES, list_videos, read_video
from drgs.data.views import Dataset
from drgs.display.progress import Bar

__all__ = ["POSES_BOUNDS", "find_videos", "load_neu3d"]

POSES_BOUNDS = "poses_bounds.npy"

_log = logging.getLogger(__name__)


def find_videos(path: Path) -> list[Path]:
    """The videos of a folder that has poses for them, by name; empty if it has none."""
    if not (path / POSES_BOUNDS).is_file():
        return []
    return [video for video in list_videos(path) if video.stem.startswith("cam")]


def load_neu3d(
    path: Path,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    times: int = 40,
    test_cameras: tuple[str, ...] | None = None,
    lazy: bool = False,
    points: bool = True,
    strict: bool = False,
    **_,
) -> Dataset:
    """Load the videos of synchronous cameras; no frame is decoded.

    The focal length belongs to the size that the poses state, and is scaled to that of the videos. Of videos of
    different length, as many frames are used as the shortest one has. Points are those of a COLMAP model of the first
    frame, if there is one (`add_model_points`).

    Args:
        path: the folder.
        background, times, test_cameras, lazy, points, strict: see `drgs.data.load`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a damaged video, poses for another number of them or of another shape, a pose that is none, or with
            `strict` videos of different length.
    """
    files, rows = find_videos(path), pose_rows(path / POSES_BOUNDS)
    if len(files) != len(rows):
        raise ValueError(
            f"{path / POSES_BOUNDS}: must have one row a video, in the order of their names, got {len(rows)} rows and "
            f"{len(files)} videos (cam*{', cam*'.join(VIDEO_SUFFIXES)}); restore the missing ones, or drop their rows"
        )
    stems = [file.stem for file in files]
    if twice := [stem for stem in stems if stems.count(stem) > 1]:
        raise ValueError(f"{path}: must hold one video a camera, {twice[0]} is there twice; remove one")
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
    numbers = evenly_spaced(range(shortest.count), times)
    recordings = []
    for index, (row, video) in enumerate(zip(rows, videos, strict=True)):
        where = f"{path / POSES_BOUNDS}: row {index}"
        camera = row_camera(f"{where} ({video.path.name})", row, video.path.stem)
        recordings.append(Recording(video.path.stem, dict.fromkeys(numbers, camera), video, where))
    dataset = Dataset(path, "neu3d", [], test_cameras=tuple(stems[:1]) if len(stems) > 1 else None)
    synchronous(dataset, recordings, numbers, where=path, background=background, lazy=lazy, strict=strict)
    if points:
        seen = {recording.name: recording.cameras[0] for recording in recordings}
        add_model_points(dataset, seen, dataset.test_cameras if test_cameras is None else test_cameras)
    return dataset
