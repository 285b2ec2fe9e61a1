"""Synchronous cameras as folders of frames, `cam00/frame_00000.png`, and a COLMAP model that has one image of each.

That image is named by its camera: `cam00.png`, `cam00/frame_00000.png`, or as 4DGaussians makes them, with the
camera's number, `image0.jpg` (its `multipleview` layout, with the model in `sparse_`).
"""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.origins import rounding
from drgs.data.colmap import find_model
from drgs.data.colmap_model import model_camera, model_points, read_model
from drgs.data.dataset import Dataset
from drgs.data.formats import Format
from drgs.data.images import list_images
from drgs.data.synchronous import CAMERA_NAME, Recording, evenly_spaced, synchronous

_NUMBER = re.compile(r"(?<!\d)(\d{1,20})$")  # at the end of a name
_MODEL = "sparse_"  # where 4DGaussians has it
_SAME_POSE = 1e-2  # of the cameras' extent, and between the axes
_ROUNDING = 1e-6  # of coordinates in text, scene units; one camera alone has no extent

_log = logging.getLogger(__name__)


def _find_camera_folders(path: Path) -> list[Path]:
    """The folders of two cameras or more that have frames; empty where there are none, or no COLMAP model with them."""
    return [] if _model(path) is None else frame_folders(path)


def frame_folders(path: Path) -> list[Path]:
    """The folders of two cameras or more that have frames; empty where there are none."""
    folders = [folder for folder in sorted(path.iterdir()) if CAMERA_NAME.fullmatch(folder.name) and folder.is_dir()]
    folders = [folder for folder in folders if list_images(_frame_folder(folder))]
    return folders if len(folders) >= 2 else []


def load_cameras(
    path: Path,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    times: int = 40,
    test_cameras: tuple[str, ...] | None = None,
    lazy: bool = False,
    points: bool = True,
    strict: bool = False,
) -> Dataset:
    """Load folders of frames. A frame's number is at the end of its file's name; frames of one number are of one time.

    Points are those of the model that images of at least two cameras show which are not held out.

    Args:
        path: The folder.
        background, times, test_cameras, lazy, points, strict: See `drgs.data.load`.
    Raises:
        FileNotFoundError: Too few of the frames are there, or with `strict` a camera without a pose.
        ValueError: a damaged model, none of whose images is named by a camera, cameras that move, or two frames of one
            number.
    """
    model, folders = _model(path), _find_camera_folders(path)
    reconstruction = read_model(model, points)
    images = _images_of(reconstruction, model, [folder.name for folder in folders])
    posed = {name: found[0] for name, found in images.items()}
    _check_still(model, reconstruction, images)
    if not posed:
        raise ValueError(
            f"{model}: must have images named by their cameras, as {folders[0].name}.png or {folders[0].name}/..., has "
            "none; run COLMAP on one frame of each camera, named so"
        )
    if without := [folder.name for folder in folders if folder.name not in posed]:
        problem = f"{model}: has no image of {len(without)} of the {len(folders)} cameras ({', '.join(without[:5])})"
        if strict or len(posed) < 2:
            raise FileNotFoundError(f"{problem}; name its images by their cameras, as cam00.png, or run COLMAP again")
        _log.warning("%s; going on without them", problem)
    numbers, frames = frames_of([folder for folder in folders if folder.name in posed], times)
    recordings = []
    for name, files in frames.items():
        image_id, camera = posed[name]
        where = f"{model}: image {reconstruction.images[image_id].name}"
        recordings.append(Recording(name, dict.fromkeys(numbers, camera), files, where))
    dataset = Dataset(path, "cameras", [])
    synchronous(dataset, recordings, numbers, where=path, background=background, lazy=lazy, strict=strict)
    if points:
        _add_points(dataset, reconstruction, model, posed, test_cameras)
    return dataset


CAMERA_FOLDERS = Format(
    lambda path: path.is_dir() and bool(_find_camera_folders(path)), load_cameras, ("cam*/ beside a COLMAP model",)
)


def frames_of(folders: Sequence[Path], times: int) -> tuple[tuple[int, ...], dict[str, dict[int, Path]]]:
    """The numbers of the frames that are used, and the file of each by the name of the camera; some may not exist."""
    found = {folder: _numbered(_frame_folder(folder)) for folder in folders}
    numbers = evenly_spaced(sorted(set().union(*found.values())), times)
    if not numbers:
        raise ValueError(
            f"{folders[0]}: must hold frames whose names end in their number, as frame_00000.png, has none; rename them"
        )
    # A frame that one camera lacks would be named there as it is in the camera that has it.
    names = {n: next(frames[n].name for frames in found.values() if n in frames) for n in numbers}
    return numbers, {
        folder.name: {n: frames.get(n, _frame_folder(folder) / names[n]) for n in numbers}
        for folder, frames in found.items()
    }


def add_model_points(dataset: Dataset, cameras: dict[str, Camera], test_cameras: tuple[str, ...] | None) -> None:
    """Take the points of a COLMAP model of the first frame, if there is one in `frame0` or in the data set's folder.

    Its images are named by the cameras, and it must have their poses: else its world is another one.

    Args:
        dataset: Data set that has no points yet.
        cameras: Name -> camera.
        test_cameras: Names of those that are held out; None: those of the data set.
    """
    path = dataset.path / "frame0"
    model = (_model(path) if path.is_dir() else None) or _model(dataset.path)
    if model is None:
        return
    reconstruction = read_model(model)
    posed = {name: found[0] for name, found in _images_of(reconstruction, model, list(cameras)).items()}
    if not posed:
        return
    extent = _extent(cameras.values())
    for name, (_, camera) in posed.items():
        if not _same_pose(camera, cameras[name], extent):
            _log.warning("%s: has another pose of %s than the data set; its points are left out", model, name)
            return
    _add_points(dataset, reconstruction, model, posed, test_cameras)


def _extent(cameras: Iterable[Camera]) -> float:
    """Extent of the cameras' places along the axis where it is largest, in scene units."""
    return float(np.ptp([camera.center for camera in cameras], axis=0).max())


def _same_pose(a: Camera, b: Camera, extent: float) -> bool:
    """Whether two cameras, of several that are spread over `extent`, have one pose, but for errors of its estimate."""
    moved = np.linalg.norm(a.center - b.center)
    text = max(_ROUNDING, rounding(a.center))
    return moved <= _SAME_POSE * extent + text and np.abs(a.c2w[:3, :3] - b.c2w[:3, :3]).max() <= _SAME_POSE


def _check_still(model: Path, reconstruction: Any, images: dict[str, list[tuple[int, Camera]]]) -> None:
    """Raise ValueError if a camera of which the model has several images has moved between them."""
    extent = _extent([camera for found in images.values() for _, camera in found]) if images else 0.0
    for name, ((first, camera), *others) in images.items():
        for other, again in others:
            if not _same_pose(camera, again, extent):
                raise ValueError(
                    f"{model}: cameras of folders of frames must stand still, {name} has other poses in "
                    f"{reconstruction.images[first].name} and {reconstruction.images[other].name}; move the folders "
                    "into images/ to have every image read with its own pose"
                )


def _add_points(
    dataset: Dataset,
    reconstruction: Any,
    model: Path,
    posed: dict[str, tuple[int, Camera]],
    test_cameras: tuple[str, ...] | None,
) -> None:
    """Give a data set the points of its model that two cameras show which are not held out."""
    held_out = dataset.test_cameras if test_cameras is None else test_cameras
    kept = {image_id for name, (image_id, _) in posed.items() if name not in (held_out or ())}
    xyz, colors = model_points(reconstruction, model, kept)
    if len(xyz):
        dataset.points = xyz
        dataset.colors = colors
        dataset.point_source = (
            f"COLMAP model {model.relative_to(dataset.path)}, {len(xyz)} points of {len(kept)} cameras"
        )


def _model(path: Path) -> Path | None:
    """The folder of the COLMAP model, or None."""
    if any((path / _MODEL / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
        return path / _MODEL
    return find_model(path)


def _frame_folder(camera: Path) -> Path:
    """Where the frames of a camera are: in its folder, or in `images` there."""
    return camera / "images" if (camera / "images").is_dir() else camera


def _images_of(reconstruction: Any, model: Path, names: Sequence[str]) -> dict[str, list[tuple[int, Camera]]]:
    """Name of a camera -> the images of it in the model, by name, and the camera of each; without those of none."""
    by_number, images_of = defaultdict(list), defaultdict(list)
    for name in names:
        if number := _NUMBER.search(name):
            by_number[int(number[1])].append(name)
    images = {image_id: reconstruction.images[image_id] for image_id in reconstruction.reg_image_ids()}
    # By name: COLMAP numbers images in the order in which its threads finish them.
    for image_id, image in sorted(images.items(), key=lambda item: item[1].name):
        parts = PurePosixPath(image.name).with_suffix("").parts
        owner = next((part for part in reversed(parts) if part in names), None)
        if owner is None and (number := _NUMBER.search(parts[-1])):
            same = by_number[int(number[1])]
            owner = same[0] if len(same) == 1 and len(parts) == 1 else None
        if owner:
            images_of[owner].append((image_id, model_camera(reconstruction, image, f"{model}: image {image.name}")))
    return {name: images_of[name] for name in names if name in images_of}


def _numbered(folder: Path) -> dict[int, Path]:
    """Number -> frame; ValueError if two have one number."""
    frames: dict[int, Path] = {}
    for file in list_images(folder):
        if not (found := _NUMBER.search(file.stem)):
            _log.warning("%s: is no frame, its name ends in no number; left out", file)
            continue
        number = int(found[1])
        if number in frames:
            raise ValueError(
                f"{file}: must be the only frame {number} of its camera, {frames[number].name} is too; remove one"
            )
        frames[number] = file
    return frames
