"""Data sets: `drgs.data.load(path)` finds out which format a folder has, and returns a `Dataset`."""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
from pathlib import Path
from typing import Any

from drgs.cameras.origins import origin_text
from drgs.checks.registry import Registry
from drgs.data.camera_layout import scene_extent, scene_origin
from drgs.data.colmap import find_model
from drgs.data.dataset import Dataset, apply_held_out
from drgs.data.formats import Format
from drgs.data.images import list_images
from drgs.data.llff import POSES_BOUNDS
from drgs.data.multicamera import frame_folders
from drgs.data.replica import POSES
from drgs.data.semantics import Semantics
from drgs.data.sidecars import attach
from drgs.data.videos import list_videos
from drgs.data.view_checks import check_times, drop_duplicates, mark_partial_masks
from drgs.data.views import View
from drgs.io.foreign import refuse_foreign

__all__ = [
    "LOADERS",
    "Dataset",
    "Format",
    "Semantics",
    "View",
    "load",
    "scene_extent",
]

_DEPTH = 3  # folders below the one that is named, down to which a data set is looked for
_MOST_FOLDERS = 1000  # folders of each depth that are listed; chosen
_SHOWN = 3  # data sets that a message names
_log = logging.getLogger(__name__)

LOADERS: Registry[Format] = Registry(
    "data set format",
    "drgs.loaders",
    {
        "transforms": "drgs.data.transforms:TRANSFORMS",
        "neu3d": "drgs.data.neu3d:NEU3D",
        "train_meta": "drgs.data.train_meta:TRAIN_META",
        "cameras": "drgs.data.multicamera:CAMERA_FOLDERS",
        "neu3d_frames": "drgs.data.neu3d:NEU3D_FRAMES",
        "colmap": "drgs.data.colmap:COLMAP",
        "llff": "drgs.data.llff:LLFF",
        "replica": "drgs.data.replica:REPLICA",
    },
    Format,
)
"""Formats of data sets, in the order in which they are tried; those of other packages and
scripts come after these, so that no folder changes its meaning when something is installed.
"""


def load(
    path: str | os.PathLike,
    *,
    test_every: int = 8,
    test_offset: int = 0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    lazy: bool = False,
    points: bool = True,
    strict: bool = False,
    semantics: bool = True,
    times: int = 40,
    test_cameras: tuple[str, ...] | None = None,
) -> Dataset:
    """Load a data set; its format is found out from its files. No image is decoded, but the first and the last frame of
    each video, to check its time stamps.

        dataset = drgs.load_data("scene")
        train, test = dataset.split()
        photograph = test[0].image()  # (H, W, 3) float32 in [0, 1], of test[0].camera.undistorted()

    Looked for, in this order: `transforms.json` or `transforms_{train,val,test}.json` (D-NeRF's too); videos
    `cam*.mp4` beside `poses_bounds.npy` (Neural 3D Video); `train_meta.json` (Dynamic 3D Gaussians); folders of
    frames `cam00`, `cam01`, ... beside a COLMAP model, also in `sparse_`, or beside `poses_bounds.npy`; a
    COLMAP model in `.`, `sparse/0`, `sparse`, `colmap/sparse/0` and other folders of the kind; `poses_bounds.npy`;
    `traj_w_c.txt` (Replica, as Semantic-NeRF renders it). A JSON or npy file may be named itself. If there is none of
    these, the only data set in a folder below is taken, with a line. A photograph that is listed twice counts once.

    Where the training views have two times or more, the data set is one of a scene that moves (`Dataset.is_dynamic`).
    Views of synchronous cameras, which the second to the fourth of these formats have, are named by camera and frame
    (`cam03/0007`), and their times are 0 at the first frame that is used, 1 at the last, and between them by the
    frame's number. A frame of a video is decoded when its image is read. The first camera is held out at all
    times, unless `test_meta.json` says which are. A `held_out.json` beside a data set that states no split of its own
    names the views that are held out (`drgs capture --add` writes it).

    Args:
        path: Folder or file.
        test_every: Every how many views `Dataset.split` holds one out; 0 for none.
        test_offset: index, by name, of the first view that is held out, below `test_every`.
        background: Color in [0,1] that images with an alpha channel are composited on.
        lazy: Open no image, mask or depth file at all, but photographs of nearly one pose, which may be one: cameras
            have the size that the camera file states, until `View.checked` compares it with the image. Where intrinsics
            are angles and no size is stated (Blender), all views get the size of the first training image, the only one
            opened.
        points: False reads no points and no observations of images: those of a COLMAP model, or of a named PLY, come
            from all its images; of a model of synchronous cameras, those are read that two cameras show which are not
            held out.
        strict: Refuse a data set that lists images which are not there or damaged. By default at least 3 must be left;
            those are named in the log and held in `Dataset.absent`.
        semantics: Look for a teacher's maps and for labels (`drgs.data.sidecars`); False leaves them alone.
        times: How many frames of synchronous cameras are used: of every camera the same, evenly over the sequence, all
            if there are no more; `Dataset.frames` says which. D-NeRF's photographs are all used.
        test_cameras: Names of synchronous cameras that `Dataset.split` holds out at all times, which wins over
            `test_every`; None: those that the format holds out; empty: none.
    Raises:
        FileNotFoundError: Nothing there, photos without poses, or too few of the photos.
        ValueError: a file that is damaged or says something that cannot be.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: must be a data set, found no such file or folder; check the path")
    if isinstance(times, bool) or not isinstance(times, int) or times < 1:
        raise ValueError(f"load: times must be a whole number >= 1, got {times!r}; correct it")
    if isinstance(test_cameras, str):
        raise ValueError(
            f"load: test_cameras must be a tuple of names, got {test_cameras!r}; write ({test_cameras!r},)"
        )
    options = {
        "background": background,
        "lazy": lazy,
        "points": points,
        "strict": strict,
        "test_every": test_every,
        "test_offset": test_offset,
        "times": times,
        "test_cameras": test_cameras,
    }
    dataset = _read(*_located(path), options)
    dataset.test_every = test_every
    dataset.test_offset = test_offset
    if test_cameras is not None:
        dataset.test_cameras = tuple(test_cameras)
    apply_held_out(dataset)
    drop_duplicates(dataset)
    dataset.split()  # refuses numbers that cannot be
    check_times(dataset)
    mark_partial_masks(dataset.views, lazy)
    _place(dataset)
    if semantics:
        attach(dataset, lazy)
    return dataset


def _place(dataset: Dataset) -> None:
    """Set the origin of a data set by its cameras; the log says where it is."""
    if dataset.views:
        dataset.origin = scene_origin(str(dataset.path), [view.camera for view in dataset.views], dataset.points)
    if dataset.origin.any():
        _log.info(
            "%s: stands far from 0: Gaussians are kept relative to an origin at %s, cameras stay in the world",
            dataset.path,
            origin_text(dataset.origin),
        )


def _read(name: str, path: Path, options: dict[str, Any]) -> Dataset:
    """The data set, by the format of this name; what is wrong with it says which other format could be read there."""
    try:
        return LOADERS[name].read(name, path, options)
    except (FileNotFoundError, ValueError) as error:
        if not (beside := _beside(name, path, options)):
            raise
        kind = FileNotFoundError if isinstance(error, FileNotFoundError) else ValueError
        raise kind(f"{error}; {beside}") from error


def _located(path: Path) -> tuple[str, Path]:
    """Name of the first format that recognizes a folder or file, and what it is to read: the path, or the only folder
    below it that any format recognizes.

    Raises:
        FileNotFoundError: If none does, for a folder, or several data sets are in it.
        ValueError: If none does, for a file.
    """
    lacking = find_model(path, whole=False)
    if name := _format_of(path):
        if lacking and name == "llff":
            _log.warning("%s: is no whole COLMAP model, the poses are those of %s", lacking, path / POSES_BOUNDS)
        return name, path
    if path.is_file():
        for name, form in LOADERS.items():
            if form.suffix and form.suffix == path.suffix:
                return name, path
        is_splat = path.suffix in (".ply", ".spz", ".splat", ".sog")
        if not is_splat:  # which another file of Gaussians would be no more
            refuse_foreign(path, "a data set")
        advice = "drgs view, fisher, select and prune take a fitted scene" if is_splat else "name one of these"
        raise ValueError(f"{path}: must be a folder, a transforms .json or an LLFF .npy; {advice}")
    if lacking:
        return "colmap", path  # whose loader says what is missing
    below = [] if any(path.glob(f"*/{POSES}")) else _data_sets_below(path)
    if not below:
        raise _no_data_set_error(path)
    if len(below) > 1:
        raise FileNotFoundError(
            f"{path}: must be one data set, found several in it ({', '.join(str(x) for _, x in below[:_SHOWN])}"
            f"{', ...' if len(below) > _SHOWN else ''}); name one of them"
        )
    _log.warning("%s: the data set in it is %s", path, below[0][1])
    return below[0]


def _format_of(path: Path) -> str | None:
    return next((name for name, form in LOADERS.items() if form.recognizes(path)), None)


def _data_sets_below(path: Path) -> list[tuple[str, Path]]:
    """Formats and folders of the data sets nearest below a folder, where archives and other programs put them."""
    folders = [path]
    for _ in range(_DEPTH):
        folders = sorted(x for folder in folders for x in _folders_in(folder))[:_MOST_FOLDERS]
        if found := [(name, x) for x in folders if (name := _format_of(x))]:
            return found
    return []


def _folders_in(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return [Path(entry) for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
    except PermissionError:
        return []


def _beside(name: str, path: Path, options: dict[str, Any]) -> str:
    """What to say about a data set of another format in the same folder, if it can be read where the first cannot."""
    for other, form in LOADERS.items():
        named = {"colmap": find_model(path), "llff": path / POSES_BOUNDS, "transforms": path / "transforms.json"}
        file = named.get(other)
        if other == name or file is None or not file.exists():
            continue
        with contextlib.suppress(FileNotFoundError, ValueError):
            count = len(form.read(other, file, options | {"lazy": True, "points": False}).views)
            command = f"drgs fit {shlex.quote(str(file))} -o RUN"
            return f"{file} ({other}) can be read and has {count} photographs: name it, as in `{command}`"
    return ""


def _no_data_set_error(path: Path) -> FileNotFoundError:
    """The error for a folder that holds no data set: it has photographs without poses, or nothing where one looks."""
    if videos := list_videos(path):
        return FileNotFoundError(
            f"{path}: must hold camera poses, found {len(videos)} videos without; write {POSES_BOUNDS} with a row for "
            "each (LLFF), or run COLMAP on one frame of each"
        )
    for folder in (path, path / "images"):
        if folder.is_dir() and list_images(folder):
            return FileNotFoundError(
                f"{path}: must hold camera poses, found {len(list_images(folder))} photos without; "
                f"run `drgs sfm {shlex.quote(str(folder))} -o OUT` and load OUT"
            )
    if folders := frame_folders(path):
        return FileNotFoundError(
            f"{path}: must hold camera poses, found frames of {len(folders)} cameras ({folders[0].name}, ...) without; "
            f"run COLMAP on one frame of each, named {folders[0].name}.png, ..., and put its model into sparse/0"
        )
    for sequence in sorted(path.glob(f"*/{POSES}"))[:1]:
        return FileNotFoundError(f"{path}: must be one sequence of Replica, found several; name {sequence.parent}")
    looked = [*(name for form in LOADERS.values() for name in form.looks_for), "images"]
    return FileNotFoundError(f"{path}: must be a data set, found none (looked for {', '.join(looked)}); check the path")
