"""Register further photographs in a COLMAP model of `run_sfm`: the poses that it has stay fixed.

Features are found in the new photographs alone, matched against those of the database, and COLMAP's incremental mapping
goes on from the model with its frames and its lenses held. What has been fitted to the model stays valid.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drgs.data.colmap_model import read_model
from drgs.data.images import IMAGE_SUFFIXES, image_size
from drgs.io.atomic import temporary_folder
from drgs.io.outputs import LockedFolder, lock_folder
from drgs.sfm.image_folder import FRAMES, joined_frames, recorded_frames, write_frames
from drgs.sfm.mapping import MappingProgress, PhotoGroups, map_photos, posed_names, write_model
from drgs.sfm.matching import FeatureOptions, Progress
from drgs.sfm.pairing import choose_new_pairs
from drgs.sfm.photo_files import link_or_copy, photo_fault, readable_photos
from drgs.sfm.reconstruction import SfmOptions, SfmSummary, StageTimes

_MODEL = ("cameras.bin", "images.bin", "points3D.bin")
_SAME_LENS = 0.1  # relative difference of focal lengths, in EXIF and in the model, of one lens


@dataclass(frozen=True)
class Registration:
    """Result of registering further photographs.

    Attributes:
        summary: What became of all photographs of the data set, old and new; `missing` may name old ones, too.
        added: Names in the data set of the new photographs, in the order in which they were given.
        posed: Those of them that have a pose.
        moved: Largest distance that a camera which was there moved, over the largest distance of such a camera to
            their middle: rounding.
    """

    summary: SfmSummary
    added: tuple[str, ...]
    posed: tuple[str, ...]
    moved: float


def register(
    scene: str | os.PathLike,
    photographs: Sequence[str | os.PathLike],
    options: SfmOptions | None = None,
    progress: Progress | None = None,
    status: Callable[[str], None] | None = None,
) -> Registration:
    """Compute the poses of further photographs in the world of a data set that `run_sfm` made.

    The data set has the new photographs afterwards (as links where links work), their poses, and points that they
    show; poses and lenses that were there do not change. `images` becomes a folder of links to the photographs where it
    was one link. A frames.json beside the new photographs is joined with that of the data set.

    Args:
        scene: Folder of the data set.
        photographs: Files. Those of one size, in a data set with one camera of that size and about the focal length
            that their EXIF states, share it. One with a name that is taken gets a number behind its own.
        options: `max_image_size`, best as for the data set, and `seed`; the others are those of the data set.
        progress: Called with (stage, done, total) as by `run_sfm`; also from another thread.
        status: Called with what mapping is doing, in words; from another thread, too.
    Raises:
        FileNotFoundError: No such data set or photograph.
        ValueError: A data set that `run_sfm` did not make or that has masks, a file that is no photograph or is in the
            data set already, or none of the photographs connects to those that are there; then nothing has changed.
    """
    options = options or SfmOptions()
    report, status = progress or (lambda stage, done, total: None), status or (lambda text: None)
    scene, files = Path(scene), [Path(path) for path in photographs]
    _check(scene, files, options.max_image_size)
    with lock_folder(scene, "sfm", inputs=files) as output:
        output.check(["sparse", "database.db"])
        new = dict(zip(_new_names(output.path / "images", files), files, strict=True))
        with temporary_folder("register", output.path) as partial:
            registration = _registered(output.path, new, partial, options, report, status)
            _install(output, partial, new)
    return registration


def _check(scene: Path, files: list[Path], max_image_size: int) -> None:
    """Refuse what is no data set of ours, and files that are no photographs, before any work."""
    missing = [
        name for name in ("database.db", *(f"sparse/0/{name}" for name in _MODEL)) if not (scene / name).is_file()
    ]
    if missing:
        raise FileNotFoundError(
            f"{scene}: must be a data set that `drgs sfm` made, has no {missing[0]}; run it on all photographs"
        )
    if (scene / "masks").exists():
        raise ValueError(
            f"{scene}: must be a data set without masks to join photographs to it; run `drgs sfm` on all photographs "
            "with all masks"
        )
    if not files:
        raise ValueError(f"{scene}: there must be photographs to join to it, got none; name some")
    images = (scene / "images").resolve()
    there = {path.resolve() for path in images.iterdir()} if images.is_dir() else set()
    seen = set[Path]()
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(f"{file}: must be a photograph, found none; check the path")
        if file.suffix.lower() not in IMAGE_SUFFIXES:
            raise ValueError(f"{file}: must be a photograph ({', '.join(IMAGE_SUFFIXES)}); convert it, or leave it out")
        if file.resolve() in there or file.resolve() in seen:
            raise ValueError(f"{file}: must be a new photograph, is in {scene} already or named twice; leave it out")
        seen.add(file.resolve())
        if fault := photo_fault(file, max_image_size):
            raise ValueError(fault)


def _new_names(images: Path, files: list[Path]) -> list[str]:
    """Names for new photographs, as theirs as far as these are free."""
    taken = {path.name for path in images.iterdir()} if images.is_dir() else set()
    names = []
    for file in files:
        number, name = 2, file.name
        while name in taken:
            name = f"{file.stem}_{number}{file.suffix}"
            number += 1
        taken.add(name)
        names.append(name)
    return names


def _registered(
    scene: Path,
    new: dict[str, Path],
    partial: Path,
    options: SfmOptions,
    report: Progress,
    status: Callable[[str], None],
) -> Registration:
    """Features, matching and mapping of new photographs.

    Leaves `database.db`, `sparse/0` and the `photos` under their new names in `partial`.

    Args:
        scene: The data set.
        new: Name in the data set -> photograph.
        partial: Empty folder.
        options, report, status: The arguments of `register`.
    """
    from drgs.data.colmap_bindings import opened_database
    from drgs.sfm.matching import extract, match, quiet

    _link_photographs(scene, new, partial)
    database = partial / "database.db"
    shutil.copyfile(scene / "database.db", database)
    before: Any = read_model(scene / "sparse/0")
    cameras = list(before.cameras.values())
    with opened_database(database) as handle:
        old = [image.name for image in handle.read_all_images()]
    names = [*old, *new]
    times = StageTimes()
    with quiet():
        readable = readable_photos(partial / "photos", names, partial / "readable", report)
        features = FeatureOptions(
            cameras[0].model_name,
            is_shared=len({image_size(file) for file in new.values()}) == 1,
            max_image_size=options.max_image_size,
            camera=_shared_camera(cameras, [readable / name for name in new]),
        )
        extract(database, readable, list(new), features, report)
        times.end("features")
        pairing = choose_new_pairs(database, old, list(new), options.seed)
        match(database, pairing.pairs, seed=options.seed, progress=report)
        times.end("matching")
        pipeline = _options_with_fixed_poses(options.seed, cameras)
        mapping = MappingProgress(len(names), report, status, before.num_reg_images())
        models = map_photos(database, readable, partial / "models", pipeline, mapping, base=scene / "sparse/0")
        times.end("mapping")
    model = max(models.values(), key=lambda model: model.num_reg_images(), default=before)
    kept = posed_names(model)
    lines = PhotoGroups.of(database, names, kept, []).lines(names, is_masked=False, is_partial=False)
    posed = tuple(name for name in new if name in kept)
    if not posed:
        raise ValueError(
            f"{next(iter(new.values())).parent}: photographs that are joined to {scene} must show what those there "
            f"show, none of {len(new)} could be connected; {lines[-1] if lines else 'take some in between'}"
        )
    moved = _moved(before, model)
    summary = dataclasses.replace(SfmSummary.of(model, names, pairing, times), explanation=tuple(lines))
    write_model(model, partial / "sparse/0")
    report("mapping", len(kept), len(names))
    return Registration(summary, tuple(new), posed, moved)


def _link_photographs(scene: Path, new: dict[str, Path], partial: Path) -> None:
    """Make the folders of `_registered`: `photos`, with all photographs under their names in the data set, and empty
    ones for models.
    """
    for folder in ("photos", "models", "sparse/0"):
        (partial / folder).mkdir(parents=True)
    for path in _photographs(scene / "images"):
        link_or_copy(path, partial / "photos" / path.name)
    for name, file in new.items():
        link_or_copy(file, partial / "photos" / name)


def _options_with_fixed_poses(seed: int, cameras: list[Any]) -> Any:
    """pycolmap's options of mapping that holds the poses that are there, and these lenses."""
    from drgs.data.colmap_bindings import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.random_seed = seed
    pipeline.multiple_models = False
    pipeline.fix_existing_frames = True
    pipeline.constant_cameras = {camera.camera_id for camera in cameras}
    return pipeline


def _shared_camera(cameras: list[Any], files: list[Path]) -> int | None:
    """Number of the one camera of a model, if photographs are of its size and, as far as EXIF says, of its lens."""
    from drgs.data.colmap_bindings import pycolmap

    if len(cameras) != 1:
        return None
    camera = cameras[0]
    for file in files:
        if image_size(file) != (camera.width, camera.height):
            return None
        stated = pycolmap.infer_camera_from_image(file)
        focal = camera.mean_focal_length()
        if stated.has_prior_focal_length and abs(stated.mean_focal_length() - focal) > _SAME_LENS * focal:
            return None
    return camera.camera_id


def _photographs(folder: Path) -> list[Path]:
    """Photographs in a folder, hidden ones, too, if there is one."""
    return sorted(path for path in folder.iterdir() if path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES)


def _moved(before: Any, after: Any) -> float:
    """How far cameras that two models share are apart at most, over the spread of those of the first."""
    names = {after.images[i].name: i for i in after.reg_image_ids()}
    shared = [(i, names[before.images[i].name]) for i in before.reg_image_ids() if before.images[i].name in names]
    old = np.array([before.images[i].projection_center() for i, _ in shared])
    new = np.array([after.images[j].projection_center() for _, j in shared])
    spread = np.linalg.norm(old - old.mean(axis=0), axis=1).max()
    return float(np.linalg.norm(new - old, axis=1).max() / max(spread, 1e-12))


def _install(output: LockedFolder, partial: Path, new_files: dict[str, Path]) -> None:
    """Add the photographs, then put the new database and the new model in the place of the old ones."""
    images = output.path / "images"
    frames = joined_frames(recorded_frames(images), list(new_files.values()), list(new_files), output.command)
    if images.is_symlink():  # to the folder of the first photographs, which is not ours to add to
        made = partial / "images"
        made.mkdir()
        for path in _photographs(images):
            link_or_copy(path, made / path.name)
    new = {f"images/{name}": partial / "photos" / name for name in new_files}
    if frames is not None:
        write_frames(partial / FRAMES, frames)
        new[f"images/{FRAMES}"] = partial / FRAMES
    new |= {file.name: file for file in partial.glob("database.db*")} | {"sparse": partial / "sparse"}
    for name, path in new.items():
        output.record_planned(path, name)
    if images.is_symlink():
        output.record_planned(partial / "images", "images")
        output.remove(images)
        output.put(partial / "images", "images")
    for name in new_files:
        output.put(partial / "photos" / name, f"images/{name}")
    if frames is not None:
        output.remove(images / FRAMES)
        output.put(partial / FRAMES, f"images/{FRAMES}")
    for stale in output.path.glob("database.db*"):
        output.remove(stale)
    for file in partial.glob("database.db*"):
        output.put(file, file.name)
    output.check(["sparse"])  # minutes later
    os.rename(output.path / "sparse", partial / "sparse_before")
    output.put(partial / "sparse", "sparse")
