"""Files beside the photographs of a data set: a teacher's maps, label images, and what their numbers mean.

Found by their names beside the folder of the images, in this order:

- Teacher: `rgb_feature_langseg/` (LSeg), `sam_embeddings/` (SAM), as Feature 3DGS reads them.
  `NAME_fmap_CxHxW.pt` belongs to the image of that name without its suffix, or up to the first dot of its name.
- Labels: `semantic_class/`, `semantic/`, `labels/`. `NAME.png` belongs to the image NAME, and as in Replica
  `semantic_class_7.png` to the image `rgb_7.png`. One channel of 8 or 16 bits, without loss (PNG, TIFF, BMP).
- Numbers in the labels: `classes.json`, `classes.txt` or `info_semantic.json` (`drgs.data.semantics`). 0 and
  the largest number, 255 or 65535, are no label unless they are named there.
- Classes in the teacher's space: `text_embeddings.npy`, a row a class in the order of that file.
- Classes of things that move: `moving_classes.json`, a list of names.

Images in subfolders have their maps and labels in subfolders alike, or all in one folder if their names differ. Those
of frame 7 of the synchronous camera cam03, be it a file or part of a video, are `cam03/semantic_class_0007.png`,
`cam03/0007.png` or `cam03_0007.png`, and maps alike. Dynamic 3D Gaussians' `seg/` are
labels whose only class, 1, is what moves.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path, PurePosixPath

from drgs.data.dataset import Dataset
from drgs.data.semantics import CLASS_FILES, SEGMENTS, Semantics
from drgs.data.views import View

TEACHER_FOLDERS = ("rgb_feature_langseg", "sam_embeddings")
LABEL_FOLDERS = ("semantic_class", "semantic", "labels")
EMBEDDINGS = "text_embeddings.npy"
_MOVING = "moving_classes.json"
_LOSSLESS = (".png", ".tif", ".tiff", ".bmp")
_IMAGE_FOLDERS = ("images", "rgb")
_SHOWN = 5  # names that a message repeats
_NEAR = 3  # folders above an image among which one may be named so
_NUMBERED = re.compile(r"rgb_(\d+)")
_FRAME = re.compile(r"(?P<prefix>.*?)(?P<number>\d{1,20})")

_log = logging.getLogger(__name__)


def attach(dataset: Dataset, lazy: bool) -> None:
    """Find the maps and labels of a data set's views and note them in `Dataset.semantics` and the views.

    Args:
        dataset: Loaded; without maps or labels it stays as it is.
        lazy: Open none of the files; else headers of maps and the files of classes are read.
    Raises:
        FileNotFoundError, ValueError: Maps of other images, one file for two images, or as `Semantics.checked`.
    """
    folder_of: dict[str, Path] = {}
    bases = _search_folders(dataset)
    labels = (*LABEL_FOLDERS, SEGMENTS) if dataset.format == "train_meta" else LABEL_FOLDERS
    for kind, names in (("teacher", TEACHER_FOLDERS), ("labels", labels)):
        folders = [base / name for name in names for base in bases if (base / name).is_dir()]
        for folder in folders:
            files = _feature_maps(folder) if kind == "teacher" else _label_images(folder)
            matched = _match_views(dataset.views, folder, files)
            if matched:
                folder_of[kind] = folder
                for view, path in matched:
                    setattr(view, f"{kind.removesuffix('s')}_path", path)
                break
            _report_unmatched(kind, folder, files, dataset.views)
    if not folder_of:
        return
    class_file, embedding_file, moving_file = (
        next((base / name for name in names for base in bases if (base / name).is_file()), None)
        for names in (CLASS_FILES, [EMBEDDINGS], [_MOVING])
    )
    semantics = Semantics(
        teacher=folder_of["teacher"].name if "teacher" in folder_of else "",
        labels=folder_of["labels"].name if "labels" in folder_of else "",
        maps=tuple(view.teacher_path for view in dataset.views if view.teacher_path),
        label_images=tuple(view.label_path for view in dataset.views if view.label_path),
        class_file=class_file,
        embedding_file=embedding_file,
        moving_file=moving_file,
    )
    if "teacher" in folder_of:
        _warn_of_views_without_maps(folder_of["teacher"], dataset.split()[0])
    for view in dataset.views:
        view.semantics = semantics
    dataset.semantics = (
        semantics
        if lazy
        else semantics.checked((view.teacher_path, view.camera) for view in dataset.views if view.teacher_path)
    )


def _warn_of_views_without_maps(folder: Path, train: list[View]) -> None:
    without = [view.name for view in train if view.teacher_path is None]
    if without:
        _log.warning(
            "%s: %d of the %d training views have no map (%s); of these, only colors can be fitted",
            folder,
            len(without),
            len(train),
            ", ".join(without[:_SHOWN]) + (", ..." if len(without) > _SHOWN else ""),
        )


def _search_folders(dataset: Dataset) -> list[Path]:
    """Where the folders may be: in the data set, and beside its folder of images."""
    path = dataset.path
    folders = [path if path.is_dir() else path.parent]
    image = next((view.image_path for view in dataset.views if view.image_path), None)
    if image is not None:
        near = list(image.parents)[:_NEAR]
        folders += [folder.parent for folder in near if folder.name in _IMAGE_FOLDERS][:1]
    return list(dict.fromkeys(folders))


def _feature_maps(folder: Path) -> dict[str, Path]:
    """Stem of the image, with its subfolder -> map."""
    from drgs.features.teacher import map_name

    return {
        str(PurePosixPath(path.parent.relative_to(folder)) / name): path
        for path in sorted(folder.rglob("*.pt"))
        if (name := map_name(path))
    }


def _label_images(folder: Path) -> dict[str, Path]:
    """Stem, with its subfolder -> label image."""
    return {
        str(PurePosixPath(path.relative_to(folder)).with_suffix("")): path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in _LOSSLESS and not path.name.startswith(".")
    }


def _match_views(views: list[View], folder: Path, files: dict[str, Path]) -> list[tuple[View, Path]]:
    """The views that have a file, and which; ValueError if two photographs have the same."""
    cameras = {view.camera_name for view in views} - {""}
    frames = _by_camera(files, cameras, folder.name) if cameras else {}
    matched: list[tuple[View, Path]] = []
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
        matched.append((view, path))
    return matched


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

    Before the number there may be the folder's name, as `semantic_class_0007`, `frame_` or `rgb_`; others, as
    `vis_sem_class_0007`, are no labels.

    Raises:
        ValueError: Two files of one frame.
    """
    prefixes = {"", "frame_", "rgb_", f"{folder}_", f"{LABEL_FOLDERS[0]}_"}
    file_of: dict[tuple[str, int], Path] = {}
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
            if owner in file_of:
                raise ValueError(f"{path}: must be the only one of its frame, {file_of[owner]} is too; remove one")
            file_of[owner] = path
    return file_of


def _report_unmatched(kind: str, folder: Path, files: dict[str, Path], views: list[View]) -> None:
    """Say that a folder has no file for any view; maps of other images are refused."""
    image = next((view.name if view.camera_name else view.stem for view in views if view.has_image), "NAME")
    if kind == "teacher" and files:
        raise ValueError(
            f"{folder}: must hold maps of this data set's images (as {image}_fmap_CxHxW.pt), found {len(files)} of "
            f"others ({next(iter(files.values())).name}, ...); make them from these images, or move the folder away"
        )
    wanted = f"{image}_fmap_CxHxW.pt" if kind == "teacher" else f"{image}.png"
    _log.warning("%s: has no file for any image (as %s); going on without", folder, wanted)
