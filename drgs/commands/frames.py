"""The frame of a splat that another program trained, and the frame of the data set's cameras.

Trainers turn, move and scale a world before they fit, and few of their files say how. Each row of `_FRAMES` knows what
one of them may have done; which of these it was, and whether the splat shows what the photographs do at all, is found
out by rendering it where some of them were taken.

    stated       `dataparser_transforms.json` of nerfstudio, beside the file that `ns-export` wrote or in the run:
                     x_splat = scale (transform @ x)     x in the frame before nerfstudio's `applied_transform`
                 (poses in a `transforms.json` with an `applied_transform` have that one behind them, and keep it here)
    cameras      cameras.json of INRIA's model folder, whose poses are compared with the data set's of the same names
    normalized   simple_trainer of gsplat (`normalize_world_space`, its default) states nothing: its rule is applied to
                 the data set's cameras and points (examples/datasets/normalize.py and colmap.py of gsplat)
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs import data as data_sets
from drgs.codecs.folders import nerfstudio_run
from drgs.codecs.values import recentered
from drgs.data import Dataset
from drgs.data.camera_lists import load_cameras_json
from drgs.data.camera_path import quaternion_of
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians
from drgs.fitting.frames import Frame, load_frames
from drgs.integrator import render
from drgs.io.json_files import check_json, read_json
from drgs.settings import RenderSettings

DATAPARSER_TRANSFORMS = "dataparser_transforms.json"
"""File of a nerfstudio run, to be put beside the splat that was exported of it."""
_ROTATION_ERROR = 1e-3  # largest error of R R^T that float32 and text explain: more is no rotation
_SH_DIRECTIONS = 64  # directions by which SH are rotated, a least-squares fit: four for each of 16 coefficients
_PHOTOGRAPHS = 4  # at most so many are compared, evenly spaced: a wrong frame fails at each of them
_PIXELS = 10_000  # of one of them, at most: one rendering takes about 0.1 s on one thread
_BETTER = 1.0  # dB by which another frame must be better than the file's own: a wrong one is off by 5 and more
_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Similarity:
    """x -> scale rotation x + translation, from the frame of a splat to that of a data set.

    Attributes:
        source: What says so, in words.
        rotation: (3, 3).
        translation: (3,) in units of the data set.
        scale: > 0.
    """

    source: str
    rotation: np.ndarray
    translation: np.ndarray
    scale: float

    @classmethod
    def inverse_of(cls, source: str, matrix: np.ndarray) -> Similarity:
        """Of the (4, 4) matrix that takes the data set's frame to the splat's."""
        linear = np.linalg.inv(matrix[:3, :3])
        scale = float(np.cbrt(np.linalg.det(linear)))
        return cls(source, linear / scale, -linear @ matrix[:3, 3], scale)

    def of(self, g: Gaussians) -> Gaussians:
        """Gaussians of which each point is moved; with rotations, scales and SH."""
        return _moved(g, self.rotation, self.translation, self.scale)


def in_frame_of_data(gaussians: Gaussians, scene: Path, data: Path) -> Gaussians:
    """Gaussians in the frame of a data set's cameras, if photographs or a file show that they are in another.

    The log says how well they show some of the photographs, and which frame they were in. Nothing is compared where the
    data set has no photographs: what is stated holds then.

    Args:
        gaussians: Gaussians of the file.
        scene: The file, or the folder that it was found in.
        data: The data set, a folder or its file.
    Returns:
        Moved, turned and scaled ones; the same ones if no frame shows the photographs better.
    Raises:
        ValueError: If a file beside them states no rotation and translation.
    """
    stated = _stated(scene, data)
    with Bar(f"{scene.name} in the frame of {data}"):
        dataset = _data_set(data)
        photographs = [] if dataset is None else _photographs(dataset)
        if not photographs:
            return gaussians if stated is None else _said(stated, scene, data).of(gaussians)
        candidates = [stated, *(x for rule in _FRAMES for x in rule(scene, dataset))]
        own = _psnr(gaussians, photographs)
        best, found, similarity = own, gaussians, None
        for candidate in filter(None, candidates):
            moved = candidate.of(gaussians)
            if (psnr := _psnr(moved, photographs)) > max(best, own + _BETTER):
                best, found, similarity = psnr, moved, candidate
    flat = _psnr_of_mean(photographs)
    if best > flat:
        if similarity is not None:
            _said(similarity, scene, data)
        _log.info("%s: %.1f dB at %d photographs of %s", scene, best, len(photographs), data)
    else:
        _log.warning(
            "%s: %.1f dB at %d photographs of %s, whose mean color has %.1f: it is of another data set, or in an "
            "unknown frame, and results below mean nothing; name the data set that it was fitted to%s",
            scene,
            best,
            len(photographs),
            data,
            flat,
            "" if stated is not None else f" (of nerfstudio: put {DATAPARSER_TRANSFORMS} of its run beside it)",
        )
    return found


def _said(similarity: Similarity, scene: Path, data: Path) -> Similarity:
    """The same, after a line in the log."""
    _log.info("%s: is in another frame, brought to that of %s by %s", scene, data, similarity.source)
    return similarity


def _data_set(data: Path) -> Dataset | None:
    """The data set with its points; None of what is none, which whoever needs it will say."""
    try:
        return data_sets.load(data, lazy=True, semantics=False)
    except (OSError, ValueError):
        return None


def _photographs(dataset: Dataset) -> list[Frame]:
    """Some photographs, evenly spaced; none where one of them cannot be read."""
    try:
        return load_frames(dataset.views[:: -(-len(dataset.views) // _PHOTOGRAPHS) or 1], _PIXELS)
    except (OSError, ValueError):
        return []


def _psnr(g: Gaussians, photographs: list[Frame]) -> float:
    """PSNR of the splat over the pixels of all photographs, in dB, rendered by preset `fast`."""
    settings = RenderSettings.preset("fast")
    with torch.no_grad():
        images = [render(g.replace(features=None), frame.camera, settings, outputs=()).rgb for frame in photographs]
    return _decibels(photographs, [image.cpu().clamp(0, 1) for image in images])


def _psnr_of_mean(photographs: list[Frame]) -> float:
    """PSNR of an image of their mean color."""
    colors = torch.cat([frame.target().reshape(-1, 3) for frame in photographs])
    return _decibels(photographs, [colors.mean(0).expand(frame.target().shape) for frame in photographs])


def _decibels(photographs: list[Frame], images: list[torch.Tensor]) -> float:
    squared, weights = 0.0, 0.0
    for frame, image in zip(photographs, images, strict=True):
        mask = torch.ones(image.shape[:2]) if frame.mask is None else frame.mask
        squared += float(((image - frame.target()).square().mean(2) * mask).sum())
        weights += float(mask.sum())
    return -10 * float(np.log10(max(squared / max(weights, 1.0), 1e-10)))


# ------------------------------------------------------------------------------------------------------ the frames


def _stated(scene: Path, data: Path) -> Similarity | None:
    """What `dataparser_transforms.json` says, of nerfstudio's."""
    places = [scene, scene.parent] if scene.is_dir() else [scene.parent, nerfstudio_run(scene) or scene.parent]
    file = next((x for place in places if (x := place / DATAPARSER_TRANSFORMS).is_file()), None)
    if file is None:
        return None
    stated = read_json(file)
    check_json(str(file), stated, {"scale": float}, "copy it again")
    transform, scale = _rigid(f"{file}: transform", stated.get("transform")), stated["scale"]
    poses = data if data.is_file() else data / "transforms.json"
    if poses.suffix == ".json" and poses.is_file() and isinstance(meta := read_json(poses), dict):
        applied = {"applied_scale": meta.get("applied_scale", 1.0)}
        check_json(str(poses), applied, {"applied_scale": float}, "correct it")
        scale /= applied["applied_scale"] or 1.0
        if "applied_transform" in meta:
            applied_transform = _rigid(f"{poses}: applied_transform", meta["applied_transform"])
            transform = transform @ np.linalg.inv(applied_transform)
    if not 0 < scale < np.inf:
        raise ValueError(f"{file}: scale must be above 0, got {scale:g}; copy it again")
    to_data = np.linalg.inv(transform)
    return Similarity(str(file), to_data[:3, :3], to_data[:3, 3], 1 / scale)


def _of_cameras(scene: Path, dataset: Dataset) -> Iterator[Similarity]:
    """What takes the poses of INRIA's cameras.json to the data set's of the same names."""
    folders = [scene, *scene.parents[:3]]  # MODEL/point_cloud/iteration_30000/point_cloud.ply
    file = next((x for folder in folders if (x := folder / "cameras.json").is_file()), None)
    if file is None:
        return
    try:
        theirs = {Path(camera.name).stem: camera for camera in load_cameras_json(file)}
    except ValueError as error:
        _log.warning("%s; its poses are not compared with the data set's", error)
        return
    pairs = [(theirs[stem], view.camera) for view in dataset.views if (stem := Path(view.name).stem) in theirs]
    if len(pairs) < 3:
        return
    # Rotations say how the frames are turned without a fit to places, which may lie on a line.
    u, _, v = np.linalg.svd(sum(ours.c2w[:3, :3] @ other.c2w[:3, :3].T for other, ours in pairs))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    source, target = (np.array([pair[i].center for pair in pairs]) for i in (0, 1))
    spreads = [np.linalg.norm(x - x.mean(0), axis=1).mean() for x in (source, target)]
    if min(spreads) > 0:
        scale = float(spreads[1] / spreads[0])
        yield Similarity(str(file), rotation, target.mean(0) - scale * rotation @ source.mean(0), scale)


def _normalized(scene: Path, dataset: Dataset) -> Iterator[Similarity]:
    """gsplat's normalization, with each sign that the principal axes may have: that hangs on the linear algebra."""
    cameras = [view.camera for view in dataset.views]
    if len(cameras) < 3 or dataset.points is None or len(dataset.points) < 4:
        return
    c2w = np.array([camera.c2w for camera in cameras])
    upright = _upright(c2w[:, :3, :3], c2w[:, :3, 3])
    points = dataset.points @ upright[:3, :3].T + upright[:3, 3]
    middle = np.median(points, axis=0)
    axes = np.linalg.eigh(np.cov(points - middle, rowvar=False))[1][:, ::-1].T  # largest variance first
    axes[0] *= np.linalg.det(axes)
    for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        turned = np.diag(signs) @ axes
        principal = np.eye(4)
        principal[:3] = np.c_[turned, -turned @ middle]
        yield Similarity.inverse_of("gsplat's normalization of its cameras and points", principal @ upright)


def _upright(rotations: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """(4, 4) of gsplat's first step: the mean up of the cameras becomes -y, the median of the points on their axes that
    are nearest to 0 becomes 0, and the median distance of the cameras from it 1.
    """
    up = -rotations[:, :, 1].mean(0)
    up /= np.linalg.norm(up)
    down = np.array([0.0, -1.0, 0.0])
    cosine = float(down @ up)
    x, y, z = np.cross(up, down)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + skew + skew @ skew / (1 + cosine) if cosine > -1 else np.diag([-1.0, 1, 1])
    axes, places = (turn @ rotations)[:, :, 2], centers @ turn.T
    nearest = places - (axes * places).sum(1, keepdims=True) * axes
    shift = -np.median(nearest, axis=0)
    transform = np.eye(4)
    transform[:3] = np.c_[turn, shift] / np.median(np.linalg.norm(places + shift, axis=1))
    return transform


_FRAMES: tuple[Callable[[Path, Dataset], Iterator[Similarity]], ...] = (_of_cameras, _normalized)


def _rigid(where: str, matrix: Any) -> np.ndarray:
    """(4, 4) of the rotation and translation that a file states in 3 or 4 rows."""
    try:
        found = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape not in ((3, 4), (4, 4)) or not np.isfinite(found).all():
        raise ValueError(f"{where} must be 3x4 finite numbers, got shape {found.shape}; copy it again")
    R = found[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_ERROR or np.linalg.det(R) < 0:
        raise ValueError(f"{where} must hold a rotation, got another matrix; copy it again")
    return np.concatenate([found[:3], [[0.0, 0.0, 0.0, 1.0]]])


def _moved(g: Gaussians, rotation: np.ndarray, translation: np.ndarray, scale: float) -> Gaussians:
    """Gaussians of which each point x is at `rotation @ (scale x) + translation`; with rotations, scales and SH."""
    from drgs.reference import sh_basis

    R = torch.from_numpy(rotation)
    w, *v = (float(x) for x in quaternion_of(rotation))
    a, b = torch.tensor(v, dtype=torch.float64).expand(len(g), 3), g.quats[:, 1:].double()
    s = g.quats[:, :1].double()
    quats = torch.cat([w * s - (a * b).sum(1, keepdim=True), w * b + s * a + torch.linalg.cross(a, b)], dim=1)
    # SH up to a degree stay such SH when they are turned: what is seen from a direction is seen from the turned one.
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(
        torch.randn(_SH_DIRECTIONS, 3, dtype=torch.float64, generator=generator), dim=1
    )
    count = g.sh.shape[1]
    turn = torch.linalg.lstsq(sh_basis(directions @ R.T, count), sh_basis(directions, count)).solution
    places = g.means.double() + torch.from_numpy(g.origin)
    moved = g.replace(
        means=(scale * places) @ R.T + torch.from_numpy(translation),
        origin=np.zeros(3),
        quats=quats.to(g.quats.dtype),
        log_scales=g.log_scales + float(np.log(scale)),
        sh=torch.einsum("kj,njc->nkc", turn, g.sh.double()).to(g.sh.dtype).contiguous(),
    )
    return recentered(moved)  # the data set may stand far from 0
