"""Files beside the photographs of a data set, found by their names: a teacher's maps and label images."""

from __future__ import annotations

import logging
import re
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drgs.data.views import Dataset, View

__all__ = ["LABEL_FOLDERS", "bases", "explain", "label_images", "maps", "matched"]

LABEL_FOLDERS = ("semantic_class", "semantic", "labels")
_LOSSLESS = (".png", ".tif", ".tiff", ".bmp")
_IMAGE_FOLDERS = ("images", "rgb")
_NEAR = 3  # folders above an image among which one may be named so
_NUMBERED = re.compile(r"rgb_(\d+)")
_FRAME = re.compile(r"(?P<prefix>.*?)(?P<number>\d{1,20})")

_log = logging.getLogger(__name__)


def bases(dataset: Dataset) -> list[Path]:
    """Where the folders may be: in the data set, and beside its folder of images."""
    path = dataset.path
    bases = [path if path.is_dir() else path.parent]
    image = next((view.image_path for view in dataset.views if view.image_path), None)
    if image is not None:
        near = list(image.parents)[:_NEAR]
        bases += [folder.parent for folder in near if folder.name in _IMAGE_FOLDERS][:1]
    return list(dict.fromkeys(bases))


def maps(folder: Path) -> dict[str, Path]:
    """Stem of the image, with its subfolder -> map."""
    from drgs.features.teacher import map_name

    return {
        str(PurePosixPath(path.parent.relative_to(folder)) / name): path
        for path in sorted(folder.rglob("*.pt"))
        if (name := map_name(path))
    }


def label_images(folder: Path) -> dict[str, Path]:
    """Stem, with its subfolder -> label image."""
    return {
        str(PurePosixPath(path.relative_to(folder)).with_suffix("")): path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in _LOSSLESS and not path.name.startswith(".")
    }


def matched(views: list[View], folder: Path, files: dict[str, Path]) -> list[tuple[View, Path]]:
    """The views that have a file, and which; ValueError if two have the same."""
    found: list[tuple[View, Path]] = []
    owners: dict[Path, View] = {}
    cameras = {view.camera_name for view in views} - {""}
    frames = _by_camera(files, cameras, folder.name) if cameras else {}
    for view in views:
        if view.camera_name:
            path = files.get(str(PurePosixPath(view.camera_name) / view.stem))
            if path is None and (number := _FRAME.fullmatch(view.name)):
                path = frames.get((view.camera_name, int(number["number"])))
            if path is not None:
                found.append((view, path))
            continue
        if view.image_path is None:
            continue
        stems = list(dict.fromkeys((view.image_path.stem, view.image_path.name.split(".")[0])))
        if number := _NUMBERED.fullmatch(stems[0]):
            stems += [f"{name}_{number[1]}" for name in dict.fromkeys((folder.name, LABEL_FOLDERS[0]))]
        below = PurePosixPath(view.name).parent
        path = next((files[key] for key in (*(str(below / stem) for stem in stems), *stems) if key in files), None)
        if path is None:
            continue
        if path in owners:
            raise ValueError(
                f"{path}: must belong to one image, {owners[path].image_path} and {view.image_path} are both named so; "
                "put them into subfolders as the images"
            )
        owners[path] = view
        found.append((view, path))
    return found


def _by_camera(files: dict[str, Path], cameras: set[str], folder: str) -> dict[tuple[str, int], Path]:
    """(camera, number of the frame) -> file, of those in the camera's folder or with its name in front.

    Before the number there may be the folder's name, as ``semantic_class_0007``, ``frame_`` or ``rgb_``; others, as
    ``vis_sem_class_0007``, are no labels.

    Raises:
        ValueError: Two files of one frame.
    """
    prefixes = {"", "frame_", "rgb_", f"{folder}_", f"{LABEL_FOLDERS[0]}_"}
    found: dict[tuple[str, int], Path] = {}
    for key, path in files.items():
        name = PurePosixPath(key)
        owners = [name.parent.name] if name.parent.name else cameras
        for camera in owners:
            rest = name.name.removeprefix(f"{camera}_")
            if camera not in cameras or (not name.parent.name and rest == name.name):
                continue
            frame = _FRAME.fullmatch(rest)
            if frame is None or frame["prefix"] not in prefixes:
                continue
            owner = camera, int(frame["number"])
            if owner in found:
                raise ValueError(f"{path}: must be the only one of its frame, {found[owner]} is too; remove one")
            found[owner] = path
    return found


def explain(kind: str, folder: Path, files: dict[str, Path], views: list[View]) -> None:
    """Say that a folder has no file for any view; maps of other images are refused."""
    image = next((view.name if view.camera_name else view.stem for view in views if view.has_image), "NAME")
    if kind == "teacher" and files:
        raise ValueError(
            f"{folder}: must hold maps of this data set's images (as {image}_fmap_CxHxW.pt), found {len(files)} of "
            f"others ({next(iter(files.values())).name}, ...); make them from these images, or move the folder away"
        )
    wanted = f"{image}_fmap_CxHxW.pt" if kind == "teacher" else f"{image}.png"
    _log.warning("%s: has no file for any image (as %s); going on without", folder, wanted)
