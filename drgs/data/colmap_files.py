"""Where the parts of a COLMAP data set lie: the model, its photographs, and a PLY in place of its points."""

from __future__ import annotations

import logging
from pathlib import Path

from drgs.data.images import IMAGE_SUFFIXES
from drgs.io.foreign import is_file

__all__ = ["MODEL_FILES", "MODEL_FOLDERS", "find_model", "image_folder", "model_suffix", "point_ply"]

MODEL_FOLDERS = (
    *("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap/0", "colmap"),
    *("colmap_sparse/0", "colmap_sparse", "colmap_text"),
)
MODEL_FILES = ("cameras", "rigs", "frames", "images", "points3D")
_SUFFIXES = (".bin", ".txt")
_log = logging.getLogger(__name__)


def find_model(path: Path, whole: bool = True) -> Path | None:
    """The folder of a COLMAP model at or below `path`, or None.

    Args:
        path: The data set.
        whole: Whether it must have cameras and images; if not, cameras are enough.
    """
    for folder in (path, *(path / name for name in MODEL_FOLDERS)):
        for suffix in _SUFFIXES:
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


def model_suffix(model: Path) -> str:
    """`.bin` or `.txt`: the kind of file of which a model has all that are needed, binary ones first.

    Raises:
        FileNotFoundError: It has all of neither kind.
    """
    whole = [s for s in _SUFFIXES if all((model / f"{name}{s}").is_file() for name in ("cameras", "images"))]
    for suffix in whole:
        if (model / f"points3D{suffix}").is_file():
            return suffix
    if whole:
        return whole[0]
    there = [f"{name}{s}" for name in MODEL_FILES for s in _SUFFIXES if (model / f"{name}{s}").is_file()]
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    lacks = next(name for name in ("cameras", "images") if not (model / f"{name}{suffix}").is_file())
    raise FileNotFoundError(
        f"{model}: must hold {lacks}{suffix}, found none (only {', '.join(there)}); copy the whole model"
    )


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
