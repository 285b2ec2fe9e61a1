"""Dynamic 3D Gaussians' data sets (Luiten et al., 3DV 2024): `train_meta.json` and images in `ims`.

Lists by time and camera: `fn` (an image below `ims`), `k` (3x3), `w2c` (4x4, world to camera, OpenCV's axes)
and `cam_id`; `w` and `h` of all. Where there is a `test_meta.json`, its cameras are for testing;
`init_pt_cld.npz` has points (x, y, z, r, g, b, whether they move).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.checks import check_distance
from drgs.data.camera_layout import Focus, scene_origin
from drgs.data.checks import file_inside, read_npz, repaired_pose, said_of
from drgs.data.dataset import Dataset
from drgs.data.formats import Format
from drgs.data.synchronous import Recording, evenly_spaced, synchronous
from drgs.io.json_files import check_json, read_json

_META = "train_meta.json"
_TEST = "test_meta.json"
_POINTS = "init_pt_cld.npz"
_IMAGES = "ims"
_KIND = {"w": int, "h": int, "k": [list], "w2c": [list], "fn": [[str]], "cam_id": [[int]]}
_ADVICE = "write w, h, and a list by time of lists by camera of each of k, w2c, fn and cam_id"
_CLEARLY = 0.25  # of what is seen, more with matrices read the other way round


def load_train_meta(
    path: Path,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    times: int = 40,
    lazy: bool = False,
    points: bool = True,
    strict: bool = False,
) -> Dataset:
    """Load a data set of synchronous cameras. A camera is named by its `cam_id`; frame k is the k-th of the lists.

    Args:
        path: The folder, or the JSON file.
        background, times, lazy, points, strict: See `drgs.data.load`.
    Raises:
        FileNotFoundError: No such file, or too few of the images.
        ValueError: Broken JSON, lists of different lengths, a pose that is not one, or camera-to-world matrices.
    """
    file = path if path.is_file() else path / _META
    folder = file.parent
    taken, count = _cameras(file)
    stated = {}
    if (folder / _TEST).is_file() and file.name == _META:
        stated, tested = _cameras(folder / _TEST)
        if tested != count:
            raise ValueError(f"{folder / _TEST}: must have the {count} times of {_META}, has {tested}; cut one")
        if twice := sorted(set(taken) & set(stated)):
            raise ValueError(
                f"{folder / _TEST}: must have other cameras than {_META}, {twice[0]} is in both; remove it"
            )
    xyz = colors = None
    if (folder / _POINTS).is_file() and points:
        xyz, colors = _points(folder / _POINTS)
    _check_direction(file, [frames[min(frames)].camera for frames in taken.values()], xyz)
    numbers = evenly_spaced(range(count), times)
    recordings = []
    for cameras, meta, split in ((taken, file, "train" if stated else ""), (stated, folder / _TEST, "test")):
        for name, frames in cameras.items():
            used = {n: frames[n] for n in numbers if n in frames}
            images = {n: folder / _IMAGES / shot.image for n, shot in used.items()}
            recordings.append(Recording(str(name), {n: s.camera for n, s in used.items()}, images, f"{meta}", split))
    source = "" if xyz is None else f"{_POINTS}, {len(xyz)} points"
    dataset = Dataset(path, "train_meta", [], xyz, colors, source)
    return synchronous(dataset, recordings, numbers, where=file, background=background, lazy=lazy, strict=strict)


TRAIN_META = Format(
    lambda path: path.name == _META if path.is_file() else (path / _META).is_file(), load_train_meta, (_META,)
)


@dataclasses.dataclass(frozen=True)
class _Shot:
    """What the lists say of one camera at one time: its calibration, and its image below `ims`."""

    camera: Camera
    image: str


def _cameras(file: Path) -> tuple[dict[int, dict[int, _Shot]], int]:
    """Number of a camera, ascending -> index of a time -> what it has taken; and the number of times."""
    data = read_json(file)
    check_json(str(file), data, _KIND, _ADVICE)
    count = len(data["fn"])
    if not count or {len(data[key]) for key in ("k", "w2c", "cam_id")} != {count}:
        lengths = ", ".join(f"{key} {len(data[key])}" for key in ("k", "w2c", "fn", "cam_id"))
        raise ValueError(f"{file}: k, w2c, fn and cam_id must be lists of one length by time, got {lengths}; {_ADVICE}")
    shots: dict[int, dict[int, _Shot]] = {}
    for time in range(count):
        rows = [data[key][time] for key in ("k", "w2c", "fn", "cam_id")]
        if len({len(row) for row in rows}) > 1:
            raise ValueError(f"{file}: time {time}: k, w2c, fn and cam_id must name the same cameras; {_ADVICE}")
        for k, w2c, name, camera in zip(*rows, strict=True):
            where = f"{file}: time {time}, camera {camera}"
            if time in shots.setdefault(camera, {}):
                raise ValueError(f"{where}: must be there once, is there twice; remove one")
            parts = PurePosixPath(name).parts
            if name.startswith("/") or ".." in parts or not parts:
                raise ValueError(f"{where}: fn must name an image inside {_IMAGES}, got {name[:80]!r}; rename it")
            file_inside(file.parent / _IMAGES, name, f"{where}: fn")
            shots[camera][time] = _Shot(_camera(where, data, k, w2c), name)
    if not shots:
        raise ValueError(f"{file}: must list at least one camera, lists none; {_ADVICE}")
    return dict(sorted(shots.items())), count


def _camera(where: str, data: dict, k: Any, w2c: Any) -> Camera:
    """A calibrated camera; ValueError if a matrix is none."""
    matrices = []
    for key, value, side in (("k", k, 3), ("w2c", w2c, 4)):
        try:
            matrix = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            matrix = np.empty(0)
        if matrix.shape != (side, side) or not np.isfinite(matrix).all():
            raise ValueError(f"{where}: {key} must be {side}x{side} finite numbers, is not; correct it")
        matrices.append(matrix)
    check_distance(where, matrices[1])
    with said_of(where):
        return Camera(matrices[0], repaired_pose(matrices[1]), data["w"], data["h"])


def _points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3) float64 and colors (P, 3) float32."""
    rows = read_npz(file, "data")
    if rows.ndim != 2 or rows.shape[1] < 6 or rows.dtype.kind != "f":
        raise ValueError(
            f"{file}: data must be rows of x, y, z, r, g, b, got shape {rows.shape} of {rows.dtype}; remove the file"
        )
    rows = rows[np.isfinite(rows[:, :6]).all(axis=1)]
    if not len(rows):
        raise ValueError(f"{file}: data must have a row of finite numbers, has none; remove the file")
    # Colors of converted point clouds may leave [0, 1] by rounding.
    return rows[:, :3].astype(np.float64), np.clip(rows[:, 3:6], 0, 1).astype(np.float32)


def _check_direction(file: Path, cameras: list[Camera], points: np.ndarray | None) -> None:
    """Raise ValueError if the matrices are clearly from camera to world: read so, cameras see much more of the points,
    or without points, many more of them look at one place.
    """
    turned = [dataclasses.replace(camera, w2c=camera.c2w) for camera in cameras]
    as_stated, inverted = (_visible_share(views, points) for views in (cameras, turned))
    if inverted > as_stated + _CLEARLY:
        what = "of the points are seen" if points is not None else "of the cameras look at one place"
        raise ValueError(
            f"{file}: w2c must be world to camera: so, {as_stated:.0%} {what}, the other way round {inverted:.0%}; "
            "invert the matrices"
        )


def _visible_share(cameras: list[Camera], points: np.ndarray | None) -> float:
    """Mean share of points that cameras show; without points, of cameras that have one common point in front of
    them.
    """
    if points is not None and len(points):
        shares = []
        for camera in cameras:
            shares.append(camera.contains(camera.project(points)[0]).mean())
        return float(np.mean(shares))
    focus = Focus.of(cameras)
    if focus is None:
        return 0.0
    # Matrices read the wrong way round may put all cameras into the place that they look at.
    distances = np.linalg.norm(focus.eyes - focus.center, axis=1)
    size = np.abs(focus.center - scene_origin("train_meta", cameras)).max()
    return float((distances > 1e-3 * size).sum() / len(cameras))
