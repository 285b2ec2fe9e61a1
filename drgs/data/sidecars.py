"""Files beside the photographs of a data set, found by their names: a teacher's maps and label images."""

from __future__ import annotations

import logging
import re
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drgs.data.views import Dataset, View

__all__ = ["LABEL_FOLDERS", "feature_maps", "label_images", "match_views", "report_unmatched", "search_folders"]

LABEL_FOLDERS = ("semantic_class", "semantic", "labels")
_LOSSLESS = (".png", ".tif", ".tiff", ".bmp")
_IMAGE_FOLDERS = ("images", "rgb")
_NEAR = 3  # folders above an image among which one may be named so
_NUMBERED = re.compile(r"rgb_(\d+)")
_FRAME = re.compile(r"(?P<prefix>.*?)(?P<number>\d{1,20})")

_log = logging.getLogger(__name__)


def search_folders(dataset: Dataset) -> list[Path]:
    """Where the folders may be: in the data set, and beside its folder of images."""
    path = dataset.path
    folders = [path if path.is_dir() else path.parent]
    image = next((view.image_path for view in dataset.views if view.image_path), None)
    if image is not None:
        near = list(image.parents)[:_NEAR]
        folders += [folder.parent for folder in near if folder.name in _IMAGE_FOLDERS][:1]
    return list(dict.fromkeys(folders))


def feature_maps(folder: Path) -> dict[str, Path]:
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


def match_views(views: list[View], folder: Path, files: dict[str, Path]) -> list[tuple[View, Path]]:
    """The views that have a file, and which; ValueError if two photographs have the same."""
    cameras = {view.camera_name for view in views} - {""}
    frames = _by_camera(files, cameras, folder.name) if cameras else {}
    found: list[tuple[View, Path]] = []
    owners: dict[Path, View] = {}
    for view in views:
        path = _of_frame(view, files, frames) if view.camera_name else _of_photograph(view, folder, files)
        if path is None:
            continue
        if path in owners and not view.camera_name:
            raise ValueError(
                f"{path}: must belong to one image, {owners[path].image_path} and {view.image_path} are both named so; "
                "put them into subfolders as the images"
            )
        owners[path] = view
        found.append((view, path))
    return found


def _of_frame(view: View, files: dict[str, Path], frames: dict[tuple[str, int], Path]) -> Path | None:
    """The file of a synchronous camera's frame: by the name of its image, else by its number."""
    number = _FRAME.fullmatch(view.name)
    by_name = files.get(str(PurePosixPath(view.camera_name) / view.stem))
    return by_name or (frames.get((view.camera_name, int(number["number"]))) if number else None)


def _of_photograph(view: View, folder: Path, files: dict[str, Path]) -> Path | None:
    """The file of a photograph: by its name, in a subfolder as it is, or in `folder` itself."""
    if view.image_path is None:
        return None
    stems = list(dict.fromkeys((view.image_path.stem, view.image_path.name.split(".")[0])))
    if number := _NUMBERED.fullmatch(stems[0]):
        stems += [f"{name}_{number[1]}" for name in dict.fromkeys((folder.name, LABEL_FOLDERS[0]))]
    below = PurePosixPath(view.name).parent
    return next((files[key] for key in (*(str(below / stem) for stem in stems), *stems) if key in files), None)


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


def report_unmatched(kind: str, folder: Path, files: dict[str, Path], views: list[View]) -> None:
    """Say that a folder has no file for any view; maps of other images are refused."""
    image = next((view.name if view.camera_name else view.stem for view in views if view.has_image), "NAME")
    if kind == "teacher" and files:
        raise ValueError(
            f"{folder}: must hold maps of this data set's images (as {image}_fmap_CxHxW.pt), found {len(files)} of "
            f"others ({next(iter(files.values())).name}, ...); make them from these images, or move the folder away"
        )
    wanted = f"{image}_fmap_CxHxW.pt" if kind == "teacher" else f"{image}.png"
    _log.warning("%s: has no file for any image (as %s); going on without", folder, wanted)
