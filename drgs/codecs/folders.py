"""Folders and archives that other programs leave behind, and which file in them holds the Gaussians.

INRIA's 3DGS   point_cloud/iteration_*/point_cloud.ply, of the highest iteration; cameras.json, where it is there.
               cfg_args, a line of Python, is neither run nor read.
SOG            meta.json beside its images
Nerfstudio     config.yml and checkpoints: pickles, which are not read; `ns-export` writes a PLY of them
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

__all__ = ["cameras_of_model", "file_of_folder", "is_checkpoint", "names_in_archive", "refuse_checkpoint"]

_ITERATION = re.compile(r"iteration_(\d{1,18})")


def file_of_folder(folder: Path) -> Path | None:
    """The file that stands for a folder, of a SOG scene its meta.json; None if it is of no kind that is known.

    Raises:
        FileNotFoundError: If a model folder of INRIA's holds no point_cloud.ply.
        ValueError: If it is a run of Nerfstudio, or a streamed SOG scene.
    """
    if (folder / "meta.json").is_file():
        return folder / "meta.json"
    if (folder / "lod-meta.json").is_file():
        raise ValueError(
            f"{folder}: must be one SOG scene, is a streamed one of several levels; name a folder in it, e.g. "
            f"{folder / '0_0'}"
        )
    clouds = folder / "point_cloud"
    if clouds.is_dir():
        found = [(int(match[1]), x) for x in clouds.iterdir() if (match := _ITERATION.fullmatch(x.name))]
        for _, iteration in sorted(found, reverse=True):
            if (iteration / "point_cloud.ply").is_file():
                return iteration / "point_cloud.ply"
        raise FileNotFoundError(
            f"{clouds}: must hold iteration_*/point_cloud.ply, holds none; train the model, or name a PLY"
        )
    models = "nerfstudio_models"
    if folder.name == models or (folder / models).is_dir() or any(folder.glob("step-*.ckpt")):
        refuse_checkpoint(folder)
    return None


def names_in_archive(path: Path) -> set[str]:
    """Names, without their folders, of the files in a zip archive; none of one that is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.rpartition("/")[2] for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return set()


def is_checkpoint(path: Path, head: bytes) -> bool:
    """Whether a file is a checkpoint of PyTorch: an archive with a pickle, or called so.

    Args:
        path: The file.
        head: Its first bytes.
    """
    if head.startswith(b"PK\x03\x04") and "data.pkl" in names_in_archive(path):
        return True
    return path.suffix.lower() == ".ckpt" and not head.startswith(b"version https://git-lfs")


def refuse_checkpoint(path: Path) -> None:
    """Raise ValueError: a run of Nerfstudio, or a checkpoint of it, says nothing without being run."""
    folder = path if path.is_dir() else path.parent
    run = folder.parent if folder.name == "nerfstudio_models" or path.suffix == ".ckpt" else folder
    raise ValueError(
        f"{path}: must be a file of Gaussians, is a checkpoint of Nerfstudio, a pickle that is not read; run "
        f"`ns-export gaussian-splat --load-config {run / 'config.yml'} --output-dir {run / 'export'}` and name its PLY"
    )


def cameras_of_model(folder: Path) -> Path | None:
    """cameras.json of a model folder of INRIA's; None if it is none, or has none."""
    cameras = folder / "cameras.json"
    return cameras if (folder / "point_cloud").is_dir() and cameras.is_file() else None
