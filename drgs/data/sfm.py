"""Structure from motion: photos to a COLMAP data set, by pycolmap on the CPU."""

from __future__ import annotations

import itertools
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.data.checks import image_size, list_images
from drgs.data.readable import check_names, readable_photos
from drgs.guards.foreign import refuse_foreign
from drgs.guards.outputs import claim
from drgs.guards.unfinished import temporary_folder

if TYPE_CHECKING:
    from drgs.guards.outputs import Claim

__all__ = ["CAMERA_MODELS", "MATCHING", "SfmSummary", "run_sfm"]

CAMERA_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
)
MATCHING = ("auto", "exhaustive", "sequential")
_MAX_EXHAUSTIVE = 60
_WINDOW = 10


@dataclass(frozen=True)
class SfmSummary:
    """What structure from motion found.

    Attributes:
        registered, total: photos with a pose, and all.
        points: number of 3D points.
        reprojection_error: mean, in pixels.
        models: separate models found; the largest was kept.
        seconds: time by stage: features, matching, mapping.
        missing: names of the photos without a pose.
    """

    registered: int
    total: int
    points: int
    reprojection_error: float
    models: int
    seconds: dict[str, float]
    missing: tuple[str, ...]


def run_sfm(
    image_dir: str | os.PathLike,
    out_dir: str | os.PathLike,
    progress: Callable[[str, int, int], None] | None = None,
    camera_model: str = "SIMPLE_RADIAL",
    max_image_size: int = 1600,
    matching: str = "auto",
    seed: int = 0,
) -> SfmSummary:
    """Find camera poses and points from photos; afterwards ``drgs.data.load(out_dir)`` works.

    Writes ``out_dir/{database.db, sparse/0, images}``; ``images`` is a link to ``image_dir`` where
    links work, a copy elsewhere. An earlier result of this function is replaced, and only once the
    new one is complete; nothing else ever is.

    Args:
        image_dir: folder of photos.
        out_dir: made if absent.
        progress: called with (stage, done, total); stages are features, matching and mapping.
        camera_model: COLMAP's name of the lens. Photos of one size share one camera.
        max_image_size: pixels on the longer side that features are found at; 0 for the photos' own.
        matching: ``exhaustive``, ``sequential`` (photos in the order of a walk or video) or
            ``auto`` (exhaustive up to 60 photos).
        seed: of all random sampling.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: fewer than 2 photos, an unknown option, photos that do not connect, or an
            ``out_dir`` that holds a COLMAP project or photos that were not made here.
    """
    image_dir, out_dir = Path(image_dir), Path(out_dir)
    if image_dir.is_file():
        refuse_foreign(image_dir, "a folder of photos")
    if not image_dir.is_dir():
        raise FileNotFoundError(f"{image_dir}: must be a folder of photos, found none; check the path")
    names = [path.name for path in list_images(image_dir)]
    check_names(image_dir, names)
    if len(names) < 2:
        raise ValueError(f"{image_dir}: must hold at least 2 photos, got {len(names)}; add overlapping photos")
    if camera_model not in CAMERA_MODELS:
        raise ValueError(f"run_sfm: camera_model must be one of {', '.join(CAMERA_MODELS)}, got {camera_model!r}")
    if matching not in MATCHING:
        raise ValueError(f"run_sfm: matching must be auto, exhaustive or sequential, got {matching!r}; choose one")
    with claim(out_dir, "sfm", inputs=[image_dir]) as output:
        _check_output(output, image_dir)
        with temporary_folder("sfm", output.path) as partial:
            (partial / "models").mkdir()
            summary = _reconstruct(image_dir, names, partial, progress, camera_model, max_image_size, matching, seed)
            _install(partial, output, image_dir)
    return summary


def _check_output(output: Claim, image_dir: Path) -> None:
    """Find out that what is to be replaced is an earlier result, before minutes of work."""
    places = ["sparse", *(path.name for path in output.path.glob("database.db*"))]
    if (output.path / "images").resolve() != image_dir.resolve():
        places.append("images")
    try:
        output.check(places)
    except ValueError as error:
        raise ValueError(f"{str(error).partition(';')[0]}; choose another output (-o), a new folder is best") from None


def _reconstruct(
    image_dir: Path,
    names: list[str],
    partial: Path,
    progress: Callable[[str, int, int], None] | None,
    camera_model: str,
    max_image_size: int,
    matching: str,
    seed: int,
) -> SfmSummary:
    """Run the three stages; leaves ``database.db`` and ``sparse/0`` in ``partial``."""
    from drgs.data.matching import extract, match, quiet, sequential_pairs
    from drgs.data.native import pycolmap

    report = progress or (lambda stage, done, total: None)
    database = partial / "database.db"
    shared = len({image_size(image_dir / name) for name in names}) == 1
    marks = [time.perf_counter()]
    with quiet():
        readable = readable_photos(image_dir, names, partial / "readable", report)
        extract(
            database,
            readable,
            names,
            camera_model=camera_model,
            shared_camera=shared,
            max_image_size=max_image_size,
            wide_baseline=True,
            progress=report,
        )
        marks.append(time.perf_counter())
        if matching == "sequential" or (matching == "auto" and len(names) > _MAX_EXHAUSTIVE):
            pairs = sequential_pairs(names, _WINDOW)
        else:
            pairs = list(itertools.combinations(names, 2))
        match(database, pairs, seed=seed, progress=report)
        marks.append(time.perf_counter())
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = seed
        options.min_model_size = min(options.min_model_size, max(2, len(names) // 2))
        done = itertools.count(1)
        report("mapping", 0, len(names))
        models = pycolmap.incremental_mapping(
            database,
            readable,
            partial / "models",
            options=options,
            initial_image_pair_callback=lambda: report("mapping", min(2 * next(done), len(names)), len(names)),
            next_image_callback=lambda: report("mapping", min(1 + next(done), len(names)), len(names)),
        )
        marks.append(time.perf_counter())
    if not models:
        raise ValueError(
            f"{image_dir}: the photos must overlap and show texture, no two of {len(names)} could "
            "be connected; "
            "take more photos with smaller steps, or try --camera-model OPENCV"
        )
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    best.update_point_3d_errors()
    (partial / "sparse/0").mkdir(parents=True)
    best.write_binary(partial / "sparse/0")
    found = {best.images[index].name for index in best.reg_image_ids()}
    report("mapping", len(names), len(names))
    return SfmSummary(
        registered=len(found),
        total=len(names),
        points=best.num_points3D(),
        reprojection_error=float(best.compute_mean_reprojection_error()),
        models=len(models),
        seconds={stage: marks[i + 1] - marks[i] for i, stage in enumerate(("features", "matching", "mapping"))},
        missing=tuple(name for name in names if name not in found),
    )


def _install(partial: Path, output: Claim, image_dir: Path) -> None:
    """Move the finished result to its place; the model, which makes the folder a data set, comes
    last.
    """
    _check_output(output, image_dir)  # minutes later
    output.remove(output.path / "sparse")
    images = output.path / "images"
    if images.resolve() != image_dir.resolve():
        output.remove(images)
        made = partial / "images"
        try:
            made.symlink_to(image_dir.resolve(), target_is_directory=True)
        except OSError:
            shutil.copytree(image_dir, made)
        output.put(made, "images")
    # SQLite may have left side files; they belong to the database.
    for stale in output.path.glob("database.db*"):
        output.remove(stale)
    for file in partial.glob("database.db*"):
        output.put(file, file.name)
    output.put(partial / "sparse", "sparse")
