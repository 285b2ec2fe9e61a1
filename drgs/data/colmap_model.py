"""COLMAP models, binary and text, read with `pycolmap.Reconstruction` after their sizes have been checked."""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drgs.cameras import Camera, intrinsics
from drgs.data.checks import said_of
from drgs.io.atomic import temporary_folder
from drgs.io.foreign import refuse_foreign

MODEL_FILES = ("cameras", "rigs", "frames", "images", "points3D")
MODEL_SUFFIXES = (".bin", ".txt")
# COLMAP's model numbers and parameter counts, for the camera models that drgs renders.
_MODELS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
    "FULL_OPENCV": (6, 12),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
    "SIMPLE_FISHEYE": (14, 3),
    "FISHEYE": (15, 4),
    "EQUIRECTANGULAR": (17, 2),
}
_BOM = b"\xef\xbb\xbf"  # byte order mark of UTF-8, which editors of Windows write
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE")
_log = logging.getLogger(__name__)


def model_camera(reconstruction: Any, image: Any, where: str) -> Camera:
    """The `Camera` of a registered image; a lens whose coefficients are all 0 is a pinhole."""
    w2c = np.eye(4)
    camera = reconstruction.cameras[image.camera_id]
    w2c[:3] = image.cam_from_world().matrix()
    if not np.isfinite(w2c).all():
        raise ValueError(f"{where}: the pose must be finite, got NaN or Inf; remove this image from the model")
    p = [float(v) for v in camera.params]
    kind = camera.model_name
    if kind == "EQUIRECTANGULAR":  # its parameters are the size
        K = intrinsics(camera.width / (2 * np.pi), camera.height / np.pi, camera.width / 2, camera.height / 2)
        rest = []
    elif kind in _ONE_FOCAL:
        K = intrinsics(p[0], p[0], p[1], p[2])
        rest = p[3:]
    else:
        K = intrinsics(*p[:4])
        rest = p[4:]
    model = "pinhole"
    distortion = ()
    if kind == "EQUIRECTANGULAR":
        model = "equirectangular"
    elif kind.endswith("FISHEYE"):
        model = "opencv_fisheye"
        distortion = (*rest, *([0.0] * (4 - len(rest))))
    elif any(rest):
        model = "opencv"
        distortion = (*rest, *([0.0] * (4 - len(rest))))
    with said_of(where):
        return Camera(K, w2c, camera.width, camera.height, model, distortion, image.name)


def model_points(reconstruction: Any, model: Path, seen_by: set[int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Points (P,3) float64 and colors (P,3) float32 in [0,1]; given `seen_by`, those that two of these images show."""
    entries = [reconstruction.points3D[key] for key in sorted(reconstruction.point3D_ids())]
    if seen_by is not None:
        entries = [x for x in entries if len({e.image_id for e in x.track.elements} & seen_by) >= 2]
    points = np.array([entry.xyz for entry in entries], dtype=np.float64).reshape(-1, 3)
    colors = np.array([entry.color for entry in entries], dtype=np.float32).reshape(-1, 3) / np.float32(255)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise ValueError(
            f"{model}: points must be finite, got {points[bad[0]]} at index {bad[0]}; run `drgs sfm` again"
        )
    return points, colors


def model_suffix(model: Path) -> str:
    """`.bin` or `.txt`: the kind of file of which a model has all that are needed, binary ones first.

    Raises:
        FileNotFoundError: It has all of neither kind.
    """
    whole = [s for s in MODEL_SUFFIXES if all((model / f"{name}{s}").is_file() for name in ("cameras", "images"))]
    for suffix in whole:
        if (model / f"points3D{suffix}").is_file():
            return suffix
    if whole:
        return whole[0]
    there = [f"{name}{s}" for name in MODEL_FILES for s in MODEL_SUFFIXES if (model / f"{name}{s}").is_file()]
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    lacks = next(name for name in ("cameras", "images") if not (model / f"{name}{suffix}").is_file())
    raise FileNotFoundError(
        f"{model}: must hold {lacks}{suffix}, found none (only {', '.join(there)}); copy the whole model"
    )


def read_model(model: Path, points: bool = True) -> object:
    """The reconstruction; every file is walked first, so that pycolmap meets no size that the file does not hold.

    Args:
        model: Folder of the model.
        points: False: points3D is not opened, and observations of images are skipped.
    Raises:
        FileNotFoundError: If a file of the model is missing.
        ValueError: If one is damaged, or has a camera model that drgs does not render.
    """
    suffix = model_suffix(model)
    if points and not (model / f"points3D{suffix}").is_file():
        raise FileNotFoundError(f"{model}: must hold points3D{suffix}, found none; copy the whole model")
    read = [name for name in MODEL_FILES if (model / f"{name}{suffix}").is_file() and (points or name != "points3D")]
    if ("rigs" in read) != ("frames" in read):
        _log.warning("%s: has one of rigs%s and frames%s alone, which is left out", model, suffix, suffix)
        read = [name for name in read if name not in ("rigs", "frames")]
    check = _check_binary if suffix == ".bin" else _check_text
    for name in read:
        refuse_foreign(model / f"{name}{suffix}", "part of a COLMAP model")
        check(model / f"{name}{suffix}", name)
    for tracks in (True, False) if points else (False,):
        with temporary_folder("model") as folder:
            for name in read:
                _write_plain(folder, model / f"{name}{suffix}", name, tracks)
            reconstruction = _read(folder, read, suffix)
            if reconstruction is None and not tracks:
                raise ValueError(_refusal(folder, model, read, suffix))
        if reconstruction is not None:
            break
    if points and not tracks:
        _log.warning(
            "%s: the observations of images%s and the tracks of points3D%s contradict each other; poses and points are "
            "read without them",
            model,
            suffix,
            suffix,
        )
    if suffix == ".txt":
        given = _names(model / "images.txt")
        for image_id, image in reconstruction.images.items():
            image.name = given[image_id]  # pycolmap ends a name at its first space
    return reconstruction


def _write_plain(folder: Path, file: Path, name: str, tracks: bool) -> None:
    """Put a checked file of a model into a folder as COLMAP writes it, with observations and tracks or without."""
    if file.suffix == ".txt" and name == "cameras":
        data = _plain_cameras(file)
    elif file.suffix == ".txt" and name == "images":
        data = _plain_images(file, tracks)
    elif name == "images" and not tracks:
        data = _without_observations(file)
    elif name == "points3D" and not tracks:
        data = _without_tracks(file)
    elif file.suffix == ".txt" and (data := file.read_bytes()).startswith(_BOM):
        data = data.removeprefix(_BOM)  # which COLMAP takes for part of the first line
    else:
        (folder / file.name).symlink_to(file.resolve())
        return
    (folder / file.name).write_bytes(data)


def _read(folder: Path, names: list[str], suffix: str) -> Any:
    """What pycolmap reads of these files, the others being empty; None where it refuses them, with words of its own."""
    from drgs.data.colmap_bindings import pycolmap

    reconstruction = pycolmap.Reconstruction()
    read = reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        with temporary_folder("model") as whole:
            for name in names:
                (whole / f"{name}{suffix}").symlink_to((folder / f"{name}{suffix}").resolve())
            for name in {"cameras", "images", "points3D"} - set(names):
                (whole / f"{name}{suffix}").write_bytes(_COUNT.pack(0) if suffix == ".bin" else b"")
            read(str(whole))
            for image_id in reconstruction.reg_image_ids():  # which refuses images that only frames have
                reconstruction.images[image_id].cam_from_world()
    except MemoryError:
        raise
    except Exception as error:  # of the library: checks of its own code, and whatever its containers throw
        _log.debug("pycolmap: %s", error)
        return None
    finally:
        pycolmap.logging.minloglevel = level
    return reconstruction


def _refusal(folder: Path, model: Path, names: list[str], suffix: str) -> str:
    """Which file of a model pycolmap refuses: the first that does not fit to those before it."""
    for *others, name in (("cameras",), ("cameras", "images"), ("cameras", "images", "points3D")):
        if name in names and _read(folder, [*others, name], suffix) is None:
            beside = f" and fit to {' and '.join(f'{x}{suffix}' for x in others)}" if others else ""
            return (
                f"{model / f'{name}{suffix}'}: must be as COLMAP writes it{beside}, each ID once and no ID that is not "
                "there, COLMAP's reader refuses it; export the model again"
            )
    return (
        f"{model}: rigs{suffix} and frames{suffix} must be of one model with images{suffix}, COLMAP's reader refuses "
        f"them; export the model again, or remove both to use the poses of images{suffix}"
    )


class _Walk:
    """A cursor over a binary file that never passes its end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.at = 0

    def need(self, size: int, what: str) -> None:
        if self.at + size > len(self.data):
            raise ValueError(
                f"{self.path}: must hold {what} ({size} bytes from byte {self.at}), the file ends at byte "
                f"{len(self.data)}; it is truncated or damaged, copy it again"
            )

    def take(self, layout: struct.Struct, what: str) -> tuple:
        self.need(layout.size, what)
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def skip(self, size: int, what: str) -> None:
        self.need(size, what)
        self.at += size

    def name(self, what: str) -> str:
        end = self.data.find(b"\0", self.at)
        self.need(end + 1 - self.at if end >= 0 else len(self.data), what)
        raw = self.data[self.at : end]
        self.at = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError(
                f"{self.path}: {what} must be UTF-8, got {raw[:40]!r}; it is damaged, copy it again"
            ) from None


_AGAIN = "it is truncated or damaged, export it again"
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_PAIR = struct.Struct("<II")
_RIG_SENSOR = struct.Struct("<iIB")
_FRAME = struct.Struct("<II7dI")
# The least that one record of a file can take, to refuse a claimed count at once.
_LEAST = {"cameras": 40, "images": 73, "points3D": _POINT.size, "rigs": 8, "frames": _FRAME.size}


def _check_binary(path: Path, kind: str) -> None:
    """Refuse a binary file of one `kind` that is shorter than its counts claim, before COLMAP reads it."""
    walk = _Walk(path)
    (count,) = walk.take(_COUNT, "a count")
    walk.need(count * _LEAST[kind], f"the {count} {kind} that it claims")
    for index in range(count):
        what = f"{kind} record {index} of {count}"
        if kind == "cameras":
            _, number, _, _ = walk.take(_CAMERA, what)
            for value in walk.take(struct.Struct(f"<{_parameter_count(path, number)}d"), what):
                if not math.isfinite(value):
                    raise ValueError(f"{path}: {what} must have finite parameters, got {value}; {_AGAIN}")
        elif kind == "images":
            walk.take(_IMAGE, what)
            walk.name(f"the name of {what}")
            (observations,) = walk.take(_COUNT, what)
            walk.skip(24 * observations, f"the {observations} observations of {what}")
        elif kind == "points3D":
            length = walk.take(_POINT, what)[-1]
            walk.skip(8 * length, f"the {length} track elements of {what}")
        elif kind == "rigs":
            _, sensors = walk.take(_PAIR, what)
            walk.skip(8 if sensors else 0, what)
            for _ in range(sensors - 1):
                has_pose = walk.take(_RIG_SENSOR, what)[-1]
                walk.skip(56 if has_pose else 0, what)
        else:
            entries = walk.take(_FRAME, what)[-1]
            walk.skip(16 * entries, f"the {entries} entries of {what}")


def _without_observations(path: Path) -> bytes:
    """images.bin, already checked, with no observation in any image."""
    walk = _Walk(path)
    (count,) = walk.take(_COUNT, "a count")
    kept = [_COUNT.pack(count)]
    for _ in range(count):
        start = walk.at
        walk.take(_IMAGE, "an image")
        walk.name("a name")
        kept += [walk.data[start : walk.at], _COUNT.pack(0)]
        (observations,) = walk.take(_COUNT, "a count")
        walk.skip(24 * observations, "observations")
    return b"".join(kept)


def _without_tracks(path: Path) -> bytes:
    """points3D.bin or points3D.txt, already checked, with no image in any track."""
    if path.suffix == ".txt":
        return "\n".join([*(" ".join(line.split()[:8]) for _, line in _text_lines(path)), ""]).encode()
    walk = _Walk(path)
    (count,) = walk.take(_COUNT, "a count")
    kept = [_COUNT.pack(count)]
    for _ in range(count):
        *point, length = walk.take(_POINT, "a point")
        walk.skip(8 * length, "a track")
        kept.append(_POINT.pack(*point, 0))
    return b"".join(kept)


def _plain_images(path: Path, observations: bool) -> bytes:
    """images.txt, already checked, as COLMAP writes it: two lines an image, of which the second may be empty."""
    rows = []
    for _, words, observed in _image_lines(_text_lines(path)):
        rows += [" ".join(words), observed[1] if observations and observed else ""]
    return "\n".join([*rows, ""]).encode()


def _plain_cameras(path: Path) -> bytes:
    """cameras.txt, already checked, with sizes without a fraction."""
    rows = []
    for _, line in _text_lines(path):
        if words := line.split():
            rows.append(" ".join([*words[:2], *(f"{float(word):.0f}" for word in words[2:4]), *words[4:]]))
    return "\n".join([*rows, ""]).encode()


def _parameter_count(path: Path, number: int) -> int:
    """How many parameters a camera model has by its number in binary files; ValueError for one that is not ours."""
    for model_number, parameters in _MODELS.values():
        if model_number == number:
            return parameters
    from drgs.data.colmap_bindings import pycolmap

    try:
        name = pycolmap.CameraModelId(number).name
    except ValueError:
        name = f"number {number}"
    raise _unsupported(path, name)


def _unsupported(path: Path, name: str) -> ValueError:
    return ValueError(
        f"{path}: the camera model must be one of {', '.join(_MODELS)}, got {name}; undistort the images with "
        "`colmap image_undistorter`, or run `drgs sfm` again"
    )


def _check_text(path: Path, kind: str) -> None:
    """Every data line must have the numbers that its kind takes."""
    lines = _text_lines(path)
    if kind == "images":
        _check_image_lines(path, lines)
        return
    for number, line in lines:
        words = line.split()
        if not words:
            continue
        if kind == "cameras":
            name = words[1] if len(words) > 1 else ""
            if name not in _MODELS:
                raise _unsupported(path, name or "none")
            values = _numbers(path, number, [words[0], *words[2:]], 3 + _MODELS[name][1], exact=True)
            if not np.isfinite(values).all():
                raise _bad_line(path, number, "finite numbers", words[2:][int(np.isfinite(values[1:]).argmin())][:40])
            if (values[1:3] % 1).any():
                raise _bad_line(path, number, "a width and height in whole pixels", f"{words[2]} x {words[3]}"[:80])
        elif kind == "points3D":
            _numbers(path, number, words, 8)
            if len(words) % 2:
                raise _bad_line(path, number, "a track of pairs IMAGE_ID, POINT2D_IDX", f"{len(words) - 8} numbers")
        # Rigs and frames mix words and numbers; they are small, and pycolmap reports what it cannot parse.


def _check_image_lines(path: Path, lines: list[tuple[int, str]]) -> None:
    """Pairs of lines: pose and name, then observations (which may be empty)."""
    for number, words, observed in _image_lines(lines):
        if len(words) < 10:
            raise _bad_line(path, number, "ID, pose (7), CAMERA_ID and NAME", f"{len(words)} words")
        if not words[0].isdecimal():
            raise _bad_line(path, number, "a whole number as its ID", words[0][:40])
        pose = _numbers(path, number, words[:9], 9)
        if not np.isfinite(pose).all() or not pose[1:5].any():
            raise _bad_line(path, number, "a finite pose, a quaternion and a position", " ".join(words[1:8])[:80])
        if observed:
            observations = observed[1].split()
            if len(observations) % 3:
                raise _bad_line(path, observed[0], "triples X, Y, POINT3D_ID", f"{len(observations)} numbers")
            _numbers(path, observed[0], observations, 0)


def _image_lines(lines: list[tuple[int, str]]) -> Iterator[tuple[int, list[str], tuple[int, str] | None]]:
    """The number of the first line of each image of images.txt, the 10 words of this line, of which the last is the
    name, and its line of observations; None where there is none: at the end of the file, or before another image.

    Args:
        lines: Numbers and texts of the file's lines, without comments.
    """
    index = 0
    while index < len(lines):
        number, line = lines[index]
        words = line.rstrip().split(maxsplit=9)
        if not words:
            index += 1
            continue
        following = lines[index + 1] if index + 1 < len(lines) else None
        # Some programs write no lines of observations at all.
        has_observations = following is not None and not _is_pose(following[1])
        yield number, words, following if has_observations else None
        index += 1 + has_observations


def _is_pose(line: str) -> bool:
    """Whether a line of images.txt is of an image: nine numbers, and a name that is none."""
    words = line.split()
    return len(words) >= 10 and all(map(_is_number, words[:9])) and not all(map(_is_number, words[9:]))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _names(path: Path) -> dict[int, str]:
    """ID -> name of the images of images.txt, already checked."""
    return {int(words[0]): words[9] for _, words, _ in _image_lines(_text_lines(path))}


def _text_lines(path: Path) -> list[tuple[int, str]]:
    """Numbers and texts of the lines of a file, without comments, which may be in any encoding."""
    lines = path.read_bytes().removeprefix(_BOM).splitlines()
    try:
        return [(number, line.decode()) for number, line in enumerate(lines, 1) if not line.lstrip().startswith(b"#")]
    except UnicodeDecodeError:
        raise ValueError(f"{path}: must be a text file, got binary data; export the model again") from None


def _numbers(path: Path, line: int, words: list[str], least: int, exact: bool = False) -> np.ndarray:
    """The words of a line as (N,) float64."""
    if len(words) < least or (exact and len(words) != least):
        raise _bad_line(path, line, f"{least} numbers", f"{len(words)}")
    try:
        return np.array(words, dtype=np.float64)
    except ValueError:
        raise _bad_line(path, line, "numbers", "other words") from None


def _bad_line(path: Path, line: int, needs: str, got: str) -> ValueError:
    return ValueError(f"{path}: line {line} must hold {needs}, got {got}; {_AGAIN}")
