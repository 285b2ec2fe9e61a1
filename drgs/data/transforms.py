"""Nerfstudio, instant-ngp and Blender data sets: `transforms.json` or
`transforms_{train,val,test}.json`.
"""

from __future__ import annotations

import functools
import logging
import math
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from drgs.cameras import Camera, c2w_from_opengl, intrinsics
from drgs.cameras.checks import check_handedness
from drgs.data.checks import check_last_row, file_inside, inverse_pose, local_names, repaired_pose, said_of
from drgs.data.dataset import Dataset
from drgs.data.formats import Format
from drgs.data.images import IMAGE_SUFFIXES, image_size, is_damaged
from drgs.data.point_ply import read_point_ply
from drgs.data.resampling import fit_to_image
from drgs.data.synchronous import CAMERA_NAME
from drgs.data.view_checks import make_names_unique, report_missing_images
from drgs.data.views import View
from drgs.io.foreign import is_file
from drgs.io.json_files import check_json, read_json

_SPLITS = ("train", "val", "test")
_LENSES = {
    "PINHOLE": "pinhole",
    "SIMPLE_PINHOLE": "pinhole",
    "SIMPLE_RADIAL": "opencv",
    "RADIAL": "opencv",
    "OPENCV": "opencv",
    "OPENCV_FISHEYE": "opencv_fisheye",
    "EQUIRECTANGULAR": "equirectangular",
}
_DEPTHS = ("depth_file_path", "depth_path")  # nerfstudio's key, and NeRFCapture's, SplaTAM's and instant-ngp's
_RELATIVE_DEPTHS = ("mono_depth_path",)  # SDFStudio's key
_CONFIDENCES = ("confidence_file_path", "confidence_path")  # of converters of ARKit's captures
_FILE_KEYS = ("file_path", "mask_path", *_DEPTHS, *_RELATIVE_DEPTHS, *_CONFIDENCES)
_DEPTH_SCALES = ("depth_unit_scale_factor", "integer_depth_scale")
_SHOWN = 40  # characters of a key in a message
_MILLIMETER = 1e-3  # meters: the unit of depth images where a file states none, as in nerfstudio
_DEPTH_SCALE_MAX = 1e9  # scene units: a larger one is a mistake
_log = logging.getLogger(__name__)


def _files(path: Path) -> list[Path]:
    """The transforms files of a data set: one, or one a split; empty if there are none."""
    if path.is_file():
        return [path]
    if (path / "transforms.json").is_file():
        return [path / "transforms.json"]
    return [file for split in _SPLITS if (file := path / f"transforms_{split}.json").is_file()]


def load_transforms(
    path: Path,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    test_every: int = 8,
    test_offset: int = 0,
    lazy: bool = False,
    points: bool = True,
    strict: bool = False,
    test_cameras: tuple[str, ...] | None = None,
) -> Dataset:
    """Load a `transforms.json` data set (OpenGL camera axes).

    Intrinsics come from each frame or from the file: fl_x, fl_y, cx, cy, w, h, or camera_angle_x; lens from
    camera_model and k1, k2, k3, k4, p1, p2. Frames may state their `time`, and name `mask_path` and
    `depth_file_path`, or `depth_path` (z-depth; unit from `depth_unit_scale_factor`, else, for images,
    `integer_depth_scale`, else millimeters for images and scene units for `.npy`), with `confidence_file_path`, or
    `confidence_path` (0: unknown), and `mono_depth_path` (depth up to scale and shift).

    Args:
        path: The folder, or one JSON file.
        background: Color that images with alpha are composited on.
        test_every, test_offset, lazy, points, strict, test_cameras: See `drgs.data.load`.
    Raises:
        FileNotFoundError: No such file, too few of the images that it names, or a mask or depth map is missing.
        ValueError: Broken JSON, a frame without what it needs, a pose that is not one, mixed sizes.
    """
    files = _files(path)
    if not files:
        raise FileNotFoundError(
            f"{path}: must hold transforms.json or transforms_train.json, found none; check the path"
        )
    read = {file: _frames(file) for file in files}
    dataset = Dataset(path, "transforms", [])
    rows = _listed(read, dataset, lazy)
    report_missing_images(path, [view.image_path for view in dataset.absent], len(dataset.views), strict)
    _name_cameras(dataset, [frame.get("time") for data in read.values() for frame in data["frames"]])
    first = _FirstImage(dataset, test_every, test_offset, test_cameras) if lazy else None
    for file, data in read.items():
        shared: dict[int, View] = {}  # number of the frame -> view, of those whose intrinsics are the file's
        for index, (frame, view) in enumerate(zip(data["frames"], rows[file], strict=True)):
            if view is not None:
                view.background = background
                if not _fill(view, file.parent, f"{file}: frame {index}", data, frame, first):
                    shared[index] = view
        _check_one_size(file, shared)
        if points and dataset.points is None and isinstance(data.get("ply_file_path"), str):
            ply = file_inside(file.parent, data["ply_file_path"], f"{file}: ply_file_path")
            dataset.points, dataset.colors = read_point_ply(ply)
            dataset.point_source = f"{ply.name}, {len(dataset.points)} points"
    return dataset


def _check_one_size(file: Path, views: dict[int, View]) -> None:
    """Raise ValueError unless views of the same intrinsics have images of one size."""
    sizes: dict[tuple[int, int], int] = {}
    for index, view in views.items():
        sizes.setdefault((view.camera.width, view.camera.height), index)
    if len(sizes) > 1:
        (first, i), (second, j) = list(sizes.items())[:2]
        raise ValueError(
            f"{file}: images must have one size unless every frame has its own intrinsics, got "
            f"{first[0]}x{first[1]} at frame {i} and {second[0]}x{second[1]} at frame {j}; "
            "write fl_x, w, h a frame"
        )


TRANSFORMS = Format(
    lambda path: path.is_dir() and bool(_files(path)),
    load_transforms,
    ("transforms.json", "transforms_{train,val,test}.json"),
    suffix=".json",
)


def _name_cameras(dataset: Dataset, times: list[Any]) -> None:
    """Where frames have times and lie in folders named as cameras, note whose they are, and hold out the first camera
    unless the files state a split.
    """
    folders = {view.name: PurePosixPath(view.name).parent.name for view in (*dataset.views, *dataset.absent)}
    names = sorted(set(folders.values()))
    is_dynamic = len({str(time) for time in times} - {"None"}) >= 2
    if not is_dynamic or len(names) < 2 or not all(CAMERA_NAME.fullmatch(name) for name in names):
        return
    for view in (*dataset.views, *dataset.absent):
        view.camera_name = folders[view.name]
    if not any(view.split for view in (*dataset.views, *dataset.absent)):
        dataset.test_cameras = (names[0],)


def _listed(read: dict[Path, dict], dataset: Dataset, lazy: bool) -> dict[Path, list[View | None]]:
    """Name, split and image of every frame, put into `dataset.views`, or into `absent` where there is no image or a
    damaged one, for which none is opened if `lazy`.

    Returns:
        The view of every frame of every file, None where it is absent.
    """
    rows = {}
    listed = []
    for file, data in read.items():
        rows[file] = []
        for index, (frame, split) in enumerate(zip(data["frames"], _splits(file, data), strict=True)):
            name = frame["file_path"]
            path = file_inside(file.parent, name, f"{file}: frame {index}: file_path")
            image = _image_file(path)
            view = View(None, _view_name(name), image_path=image or path, split=split)
            listed.append(view)
            is_there = image is not None and (lazy or not is_damaged(image))
            (dataset.views if is_there else dataset.absent).append(view)
            rows[file].append(view if is_there else None)
    make_names_unique(listed)
    return rows


def _frames(file: Path) -> dict:
    """A transforms file, known to have frames with file paths."""
    data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{file}: must be an object with a list `frames` of at least one frame; check the file")
    for index, frame in enumerate(frames):
        check_json(f"{file}: frame {index}", frame, {"file_path": str}, "correct it")
    keys = {key for frame in frames for key in frame if "depth" in key or "mask" in key}
    if unread := sorted(keys - {*_FILE_KEYS, *_DEPTH_SCALES}):
        shown = ", ".join(repr(key)[:_SHOWN] for key in unread[:3])
        _log.warning("%s: the keys %s of frames are not read; see docs/datasets.md, transforms.json", file, shown)
    return _with_names_of_here(file, data)


def _with_names_of_here(file: Path, data: dict) -> dict:
    """The same with names of files of another machine or of Windows made relative to the file's folder."""
    listed = [frame["file_path"] for frame in data["frames"]]
    localize = local_names(str(file), file.parent, listed, lambda path: _image_file(path) is not None)
    if localize is None:
        return data

    def renamed(value: Any) -> Any:
        if isinstance(value, list):
            return [renamed(item) for item in value]
        return localize(value) if isinstance(value, str) else value

    frames = [frame | {key: renamed(frame[key]) for key in _FILE_KEYS if key in frame} for frame in data["frames"]]
    others = ("ply_file_path", *(f"{split}_filenames" for split in _SPLITS))
    return data | {key: renamed(data[key]) for key in others if key in data} | {"frames": frames}


def _splits(file: Path, data: dict) -> list[str]:
    """The split of every frame, empty where the files do not say."""
    named = _named_splits(data)
    default = file.stem.removeprefix("transforms").lstrip("_")
    splits = [named.get(frame["file_path"], default) for frame in data["frames"]]
    return [split if split in _SPLITS else "" for split in splits]


class _FirstImage:
    """Size of the first training image, read at first use."""

    def __init__(self, dataset: Dataset, *held_out: Any) -> None:
        """`held_out`: arguments of `Dataset.split`."""
        self.dataset = dataset
        self._held_out = held_out

    @functools.cached_property
    def size(self) -> tuple[int, int]:
        train = self.dataset.split(*self._held_out)[0]
        if not train:
            raise FileNotFoundError(f"{self.dataset.path}: the first training image must exist, found none; restore it")
        return image_size(train[0].image_path)


def _fill(
    view: View,
    folder: Path,
    where: str,
    data: dict,
    frame: dict,
    first: _FirstImage | None,
) -> bool:
    """Complete a view whose image is there; returns whether its frame carries its own intrinsics.

    `first` where no other image may be opened.
    """
    own = any(key in frame for key in ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y"))
    shared = {key: value for key, value in data.items() if key not in ("frames", "time")}
    merged = {**shared, **frame}
    camera = _camera(where, merged, _pose(where, frame.get("transform_matrix")), view.image_path, first)
    depth, relative, confidence = (
        next((path for key in keys if (path := _optional_file(folder, where, frame, key))), None)
        for keys in (_DEPTHS, _RELATIVE_DEPTHS, _CONFIDENCES)
    )
    view.camera = fit_to_image(camera, view.image_path, where, lazy=first is not None)
    view.mask_path = _optional_file(folder, where, frame, "mask_path")
    view.depth_path, view.relative_depth_path, view.confidence_path = depth, relative, confidence
    view.depth_scale = _depth_scale(where, merged, depth)
    view.is_checked = first is None
    return own


def _depth_scale(where: str, values: dict, depth: Path | None) -> float:
    """Scene units in one unit of a depth map: what nerfstudio's key states, else NeRFCapture's, which is of images."""
    is_image = depth is None or depth.suffix != ".npy"
    keys = _DEPTH_SCALES if is_image else _DEPTH_SCALES[:1]
    scales = {key: _number(where, values, key) for key in keys if key in values}
    for key, scale in scales.items():
        if not 0 < scale < _DEPTH_SCALE_MAX:
            raise ValueError(f"{where}: {key} must be in (0, {_DEPTH_SCALE_MAX:g}), got {scale:g}; correct it")
    if depth is not None and len(scales) == 2 and not math.isclose(*scales.values(), rel_tol=1e-3):
        stated = " and ".join(f"{key} {scale:g}" for key, scale in scales.items())
        raise ValueError(f"{where}: the unit of depth maps must be stated once, got {stated}; remove the wrong one")
    return next(iter(scales.values()), _MILLIMETER if is_image else 1.0)


def _view_name(file_path: str) -> str:
    name = Path(file_path)
    if name.suffix.lower() in IMAGE_SUFFIXES:
        name = name.with_suffix("")
    parts = [part for part in name.parts if part not in (".", "..", "/")]
    return "/".join(parts[1:] if len(parts) > 1 and parts[0] == "images" else parts)


def _camera(where: str, values: dict, w2c: np.ndarray, image: Path, first: _FirstImage | None) -> Camera:
    """The camera of a frame whose keys, over those of the file, are `values`; `first` where no image may be opened."""
    if "w" in values and "h" in values:
        width, height = _number(where, values, "w"), _number(where, values, "h")
    elif first is None:
        width, height = image_size(image)
    elif any(key in values for key in ("fl_x", "fl_y", "cx", "cy")):
        # Lengths in pixels say nothing without the size, and looking it up would open the image.
        raise ValueError(
            f"{where}: must state w and h beside intrinsics in pixels where no image may be opened, got none; add them"
        )
    else:
        width, height = first.size
    kind = values.get("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV")
    if not isinstance(kind, str) or kind not in _LENSES:
        raise ValueError(
            f"{where}: camera_model must be one of {', '.join(_LENSES)}, got {str(kind)[:40]!r}; undistort the images"
        )
    model = _LENSES[kind]
    if model == "equirectangular":
        return _panorama(where, values, w2c, width, height)
    if "fl_x" in values:
        fx = _number(where, values, "fl_x")
        fy = _number(where, values, "fl_y", fx)
    elif "camera_angle_x" in values:
        fx = _focal(where, values, "camera_angle_x", width)
        fy = _focal(where, values, "camera_angle_y", height) if "camera_angle_y" in values else fx
    else:
        raise ValueError(f"{where}: must have fl_x or camera_angle_x (in the frame or the file), got neither; add one")
    K = intrinsics(fx, fy, _number(where, values, "cx", width / 2), _number(where, values, "cy", height / 2))
    k1, k2, k3, k4, p1, p2 = (_number(where, values, key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    distortion = ()
    if model == "opencv_fisheye":
        distortion = (k1, k2, k3, k4)
    elif model == "opencv":
        if k4:
            raise ValueError(f"{where}: OPENCV takes k1, k2, k3, p1, p2, got k4 = {k4:g}; undistort the images")
        distortion = (k1, k2, p1, p2, k3)
        if not any(distortion):
            model = "pinhole"
            distortion = ()
    with said_of(where):
        return Camera(
            K=K, w2c=w2c, width=width, height=height, model=model, distortion=distortion, time=values.get("time")
        )


def _panorama(where: str, values: dict, w2c: np.ndarray, width: float, height: float) -> Camera:
    """The camera of a panorama of all directions, whatever focal lengths its file states."""
    K = intrinsics(width / (2 * np.pi), height / np.pi, width / 2, height / 2)
    with said_of(where):
        return Camera(K, w2c, width, height, "equirectangular", time=values.get("time"))


def _pose(where: str, matrix: Any) -> np.ndarray:
    """(4,4) OpenCV w2c from a frame's transform_matrix, (3,4) or (4,4)."""
    try:
        c2w = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        c2w = np.empty(0)
    if c2w.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"{where}: transform_matrix must be 4x4 or 3x4 numbers, got shape {c2w.shape}; correct it")
    if not np.isfinite(c2w).all():
        raise ValueError(f"{where}: transform_matrix must be finite, got NaN or Inf; drop this frame")
    check_last_row(f"{where}: transform_matrix", c2w)
    pose = np.eye(4)
    pose[:3] = c2w[:3]
    check_handedness(where, pose[:3, :3], "(+x right, +y up, looking along -z)", "3 of transform_matrix")
    pose = c2w_from_opengl(pose)
    return inverse_pose(where, repaired_pose(pose))


def _focal(where: str, values: dict, key: str, size: float) -> float:
    angle = _number(where, values, key)
    if not 0.0 < angle < math.pi:
        raise ValueError(f"{where}: {key} must lie between 0 and pi radians, got {angle:g}; correct it")
    return 0.5 * size / math.tan(0.5 * angle)


def _number(where: str, values: dict, key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    check_json(where, {key: value}, {key: float}, "correct it")
    return value


def _image_file(path: Path) -> Path | None:
    """The image that a file_path names; Blender leaves the suffix out."""
    if is_file(path):
        return path
    for suffix in (*IMAGE_SUFFIXES, *(s.upper() for s in IMAGE_SUFFIXES)):
        candidate = path.with_name(path.name + suffix)
        if is_file(candidate):
            return candidate
    return None


def _optional_file(folder: Path, where: str, frame: dict, key: str) -> Path | None:
    if frame.get(key) is None:
        return None
    check_json(where, frame, {key: str}, "correct it, or remove the key")
    path = file_inside(folder, frame[key], f"{where}: {key}")
    if not is_file(path):
        raise FileNotFoundError(f"{where}: {key} names {path}, found no such file; restore it or remove the key")
    return path


def _named_splits(data: dict) -> dict[str, str]:
    """file_path -> split, from Nerfstudio's train_filenames, val_filenames, test_filenames."""
    named = {}
    for split in _SPLITS:
        names = data.get(f"{split}_filenames")
        if isinstance(names, list):
            named.update({name: split for name in names if isinstance(name, str)})
    return named
