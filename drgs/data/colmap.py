"""COLMAP data sets: where the model, its photographs and a PLY in place of its points lie, and the data set of them."""

from __future__ import annotations

import logging
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from drgs.data.checks import file_inside, local_names
from drgs.data.colmap_model import MODEL_SUFFIXES, model_camera, model_points, model_suffix, read_model
from drgs.data.dataset import Dataset
from drgs.data.formats import Format
from drgs.data.images import IMAGE_SUFFIXES, is_damaged
from drgs.data.masks import mask_file
from drgs.data.point_ply import read_point_ply
from drgs.data.resampling import fit_to_image
from drgs.data.view_checks import make_names_unique, report_missing_images
from drgs.data.views import View
from drgs.io.foreign import is_file

MODEL_FOLDERS = (
    *("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap/0", "colmap"),
    *("colmap_sparse/0", "colmap_sparse", "colmap_text"),
)
_MOST_TRACKS = 20_000  # points whose tracks are kept: enough to compare photographs, read in a tenth of a second
_log = logging.getLogger(__name__)


def load_colmap(
    path: Path,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    lazy: bool = False,
    points: bool = True,
    strict: bool = False,
) -> Dataset:
    """Load a COLMAP data set: a model, and `images` beside it (`masks` too, if there is such a
    folder).

    Args:
        path: The data set, or the model's own folder.
        background: Color that images with alpha are composited on.
        lazy, points, strict: Open no image, read no points and observations, need every image, see `drgs.data.load`.
    Raises:
        FileNotFoundError: No model, no `images` folder, or too few of the images that the model lists.
        ValueError: a damaged or lying file, an unsupported camera model, a pose that is not one.
    """
    model = find_model(path) or find_model(path, whole=False)
    if model is None:
        raise FileNotFoundError(
            f"{path}: must hold a COLMAP model, found no cameras.bin or cameras.txt in . or "
            f"{', '.join(MODEL_FOLDERS)}; run `drgs sfm`"
        )
    ply = None if not points or (model / f"points3D{model_suffix(model)}").is_file() else point_ply(model)
    reconstruction = read_model(model, points and ply is None)
    dataset = Dataset(path, "colmap", [])
    by_id = _add_views(dataset, reconstruction, model, lazy)
    for view in dataset.views:
        view.background = background
    report_missing_images(model, [view.image_path for view in dataset.absent], len(dataset.views), strict)
    xyz, colors = read_point_ply(ply) if ply else model_points(reconstruction, model)
    if len(xyz):
        dataset.points, dataset.colors = xyz, colors
        dataset.point_source = f"{ply.name if ply else f'COLMAP model {model.name}'}, {len(xyz)} points"
    dataset.reprojection = _reprojection(reconstruction)
    dataset.tracks = _tracks(reconstruction, by_id)
    return dataset


def _add_views(dataset: Dataset, reconstruction: Any, model: Path, lazy: bool) -> dict[int, View]:
    """Put a view of every registered image into a data set, into `absent` where the image is not there or damaged.

    Returns:
        Number of the image in the model -> view.
    """
    # By name: COLMAP numbers images in the order in which its threads finish them.
    registered = sorted(reconstruction.reg_image_ids(), key=lambda image_id: reconstruction.images[image_id].name)
    if not registered:
        raise ValueError(f"{model}: must hold at least one registered image, got none; run `drgs sfm` again")
    names = [reconstruction.images[image_id].name for image_id in registered]
    path, folder = dataset.path, image_folder(dataset.path, model, names)
    localize = local_names(str(model), folder, names)
    by_id = {}
    for index, image_id in enumerate(registered):
        image = reconstruction.images[image_id]
        name = localize(image.name) if localize else image.name
        file = file_inside(folder, name, f"{model}: image {index}")
        name = os.path.relpath(file, folder)  # without ..
        where = f"{model}: image {index} ({name})"
        view = by_id[image_id] = View(None, str(Path(name).with_suffix("")), image_path=file, is_checked=not lazy)
        if not is_file(file) or (not lazy and is_damaged(file)):
            dataset.absent.append(view)
            continue
        view.camera = fit_to_image(model_camera(reconstruction, image, where), file, where, lazy)
        view.mask_path = mask_file((path if folder == path else folder.parent) / "masks", name)
        dataset.views.append(view)
    make_names_unique(list(by_id.values()))
    return by_id


def find_model(path: Path, whole: bool = True) -> Path | None:
    """The folder of a COLMAP model at or below `path`, or None.

    Args:
        path: The data set.
        whole: Whether it must have cameras and images; if not, cameras are enough.
    """
    for folder in (path, *(path / name for name in MODEL_FOLDERS)):
        for suffix in MODEL_SUFFIXES:
            if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images")[: 1 + whole]):
                return folder
    return None


def image_folder(path: Path, model: Path, names: list[str]) -> Path:
    """The folder that a model's images are in: `images` beside the model or above it, else the only other one there.

    Args:
        path: The data set.
        model: The model's folder.
        names: What the model calls its images.
    Raises:
        FileNotFoundError: No such folder, or several.
    """
    bases = list(dict.fromkeys((path, model, *model.parents[:3])))
    usual = next((base / "images" for base in bases if (base / "images").is_dir()), None)
    if usual and _holds(usual, names):
        return usual
    # Not above the data set, where others are, whose photographs may have the same names.
    above = [model.parents[len(Path(name).parts) - 1] for name in MODEL_FOLDERS if model.match(name)]
    near = list(dict.fromkeys((path, model, *above)))
    folders = dict.fromkeys(x for base in near for x in (base, *sorted(base.iterdir())) if x.is_dir())
    found = [folder for folder in folders if _holds(folder, names)]
    if len(found) == 1:
        _log.warning("%s: its photographs are those in %s, there are none of their names in images", model, found[0])
        return found[0]
    if usual and not found:
        return usual
    if found:
        raise FileNotFoundError(
            f"{path}: the photos must lie in a folder named images, found them in {', '.join(map(str, found))}; rename "
            "the one to use to images"
        )
    photos = [x for x in folders if any(file.suffix.lower() in IMAGE_SUFFIXES for file in x.iterdir())]
    there = f", images of other names than {names[0][:80]!r} are in {photos[0]}" if photos else ""
    raise FileNotFoundError(
        f"{path}: the photos must lie in a folder named images, found none (looked at "
        f"{', '.join(str(base / 'images') for base in bases)}){there}; move or link them there"
    )


def _holds(folder: Path, names: list[str]) -> bool:
    return any(is_file(folder / name) for name in names)


def point_ply(model: Path) -> Path:
    """The PLY that a model has in place of points3D, as 3DGS's code writes it.

    Raises:
        FileNotFoundError: There is none, or several of other names.
    """
    if (model / "points3D.ply").is_file():
        return model / "points3D.ply"
    found = sorted(model.glob("*.ply"))
    if len(found) == 1:
        _log.warning("%s: has no points3D%s, its points are those of %s", model, model_suffix(model), found[0].name)
        return found[0]
    there = f", of PLY files {', '.join(x.name for x in found[:3])}: rename the one of its points to points3D.ply"
    advice = there if found else "; copy the whole model, or put its points there as points3D.ply"
    raise FileNotFoundError(f"{model}: must hold points3D{model_suffix(model)}, found none{advice}")


def _tracks(reconstruction: Any, by_id: dict[int, View]) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
    """Points, and view name -> indices of those that it shows; None where no point has a track."""
    keys = sorted(reconstruction.point3D_ids())
    points = [reconstruction.points3D[key] for key in keys[:: -(-len(keys) // _MOST_TRACKS) or 1]]
    seen: dict[str, list[int]] = {view.name: [] for view in by_id.values()}
    for index, point in enumerate(points):
        for image_id in {element.image_id for element in point.track.elements} & by_id.keys():
            seen[by_id[image_id].name].append(index)
    if not any(seen.values()):
        return None
    return np.array([point.xyz for point in points]), {name: np.array(x, np.int64) for name, x in seen.items()}


def _reprojection(reconstruction: Any) -> float | None:
    """Median over the points of their mean reprojection error, as an angle at the middle of an image."""
    errors = [point.error for point in reconstruction.points3D.values() if math.isfinite(point.error)]
    errors = [error for error in errors if error > 0]  # of points that were never adjusted it is -1 or 0
    if not errors:
        return None
    cameras = reconstruction.cameras.values()
    # At the middle of a panorama: pixels a radian.
    focal = [c.width / (2 * math.pi) if c.model_name == "EQUIRECTANGULAR" else c.mean_focal_length() for c in cameras]
    return float(np.median(errors) / np.median(focal))


COLMAP = Format(lambda path: find_model(path) is not None, load_colmap, MODEL_FOLDERS)
