"""Folders and archives that other programs leave behind, and which file in them holds the Gaussians.

INRIA's 3DGS   point_cloud/iteration_*/point_cloud.ply, of the highest iteration; cameras.json, where it is there.
               cfg_args, a line of Python, is neither run nor read.
SOG            meta.json beside its images
gsplat         ckpts/ckpt_*_rank0.pt of simple_trainer's results, of the last step
Nerfstudio     nerfstudio_models/step-*.ckpt beside config.yml, which is not read
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

_ITERATION = re.compile(r"iteration_(\d{1,18})")
_GSPLAT_STEP = re.compile(r"ckpt_(\d{1,18})(?:_rank0)?\.pt")
_NERFSTUDIO_STEP = re.compile(r"step-(\d{1,18})\.ckpt")
_MODELS = "nerfstudio_models"


def file_of_folder(folder: Path) -> Path | None:
    """The file that stands for a folder, of a SOG scene its meta.json; None if it is of no kind that is known.

    Raises:
        FileNotFoundError: If a model folder of INRIA's holds no point_cloud.ply.
        ValueError: If it is a streamed SOG scene.
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
        for iteration in _by_step(clouds, _ITERATION):
            if (iteration / "point_cloud.ply").is_file():
                return iteration / "point_cloud.ply"
        raise FileNotFoundError(
            f"{clouds}: must hold iteration_*/point_cloud.ply, holds none; train the model, or name a PLY"
        )
    for place, step in (
        (folder, _GSPLAT_STEP),
        (folder / "ckpts", _GSPLAT_STEP),
        (folder, _NERFSTUDIO_STEP),
        (folder / _MODELS, _NERFSTUDIO_STEP),
    ):
        if place.is_dir() and (found := _by_step(place, step)):
            return found[0]
    return None


def _by_step(folder: Path, pattern: re.Pattern[str]) -> list[Path]:
    """What is named by a step in a folder, the last step first."""
    found = [(int(match[1]), x) for x in folder.iterdir() if (match := pattern.fullmatch(x.name))]
    return [x for _, x in sorted(found, reverse=True)]


def nerfstudio_run(path: Path) -> Path | None:
    """The run folder of Nerfstudio that a checkpoint is of; None if it is of none."""
    if path.parent.name == _MODELS:
        return path.parent.parent
    return path.parent if _NERFSTUDIO_STEP.fullmatch(path.name) else None


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
    return path.suffix.lower() in (".ckpt", ".pt", ".pth") and not head.startswith(b"version https://git-lfs")


def cameras_of_model(folder: Path) -> Path | None:
    """cameras.json of a model folder of INRIA's; None if it is none, or has none."""
    cameras = folder / "cameras.json"
    return cameras if (folder / "point_cloud").is_dir() and cameras.is_file() else None
