"""Structure from motion: photos and videos to a COLMAP data set, by pycolmap on the CPU."""

from __future__ import annotations

import dataclasses
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drgs.data.images import image_size, list_images
from drgs.data.videos import list_videos
from drgs.io.atomic import temporary_folder
from drgs.io.outputs import LockedFolder, lock_folder
from drgs.sfm.feature_masks import ALPHA_MASKS, find_masks, write_masked_photos
from drgs.sfm.findings import Finding
from drgs.sfm.image_folder import fill_image_folder, named_files, recorded_frames, usable_files
from drgs.sfm.mapping import MappingProgress, PhotoGroups, map_photos, posed_names, write_model
from drgs.sfm.matching import FeatureOptions, Progress
from drgs.sfm.pairing import Pairing, choose_pairs
from drgs.sfm.photo_files import check_names, readable_photos, usable_photos

CAMERA_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
)
MATCHING = ("auto", "exhaustive", "sequential", "retrieval")
# Matches that a pose needs where masks leave an object alone, which has few: half of COLMAP's own numbers.
_MASKED_INLIERS_FIRST = 50
_MASKED_INLIERS = 15


@dataclass(frozen=True)
class SfmSummary:
    """What became of photographs in structure from motion.

    Attributes:
        registered, total: Photos with a pose, and all.
        points: Number of 3D points.
        reprojection_error: mean, in pixels.
        models: Number of separate models; the largest was kept.
        explanation: Sentences about the photos without a pose: which models they are in, and what would help.
        seconds: Time by stage: features, matching, mapping; videos, too, where there are some.
        missing: Names of the photos without a pose.
        matched, pairs: Pairs of photos that were compared, and all.
        left_out: A sentence about the pairs that were not compared; empty where all were.
        frames: Photos that are frames of videos.
        findings: What is wrong with the videos, and what to do at the next shoot.
    """

    registered: int
    total: int
    points: int
    reprojection_error: float
    models: int
    seconds: dict[str, float]
    missing: tuple[str, ...]
    explanation: tuple[str, ...] = ()
    matched: int = 0
    pairs: int = 0
    left_out: str = ""
    frames: int = 0
    findings: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, model: Any, names: Sequence[str], pairing: Pairing, times: StageTimes) -> SfmSummary:
        """The summary of the model that was kept, as far as it says itself; its points get their errors.

        Args:
            model: pycolmap's.
            names: Names of all photos.
            pairing: Pairs that were compared.
            times: Time of each stage.
        """
        model.update_point_3d_errors()
        kept = posed_names(model)
        return cls(
            registered=len(kept),
            total=len(names),
            points=model.num_points3D(),
            reprojection_error=float(model.compute_mean_reprojection_error()),
            models=1,
            seconds=times.seconds,
            missing=tuple(name for name in names if name not in kept),
            matched=len(pairing.pairs),
            pairs=pairing.total,
            left_out=pairing.left_out,
        )


class StageTimes:
    """Seconds that each stage of a piece of work has taken, from when this was made.

    Attributes:
        seconds: Name of a stage -> seconds, of those that have ended.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._began = time.perf_counter()

    def end(self, stage: str) -> None:
        """A stage has ended, and the next one begins."""
        now = time.perf_counter()
        self.seconds[stage] = now - self._began
        self._began = now


@dataclass(frozen=True)
class SfmOptions:
    """How structure from motion is run.

    Attributes:
        camera_model: COLMAP's name of the lens, of `CAMERA_MODELS`. Photos of one size and focal length (EXIF) share
            one camera, and so do frames of one video.
        max_image_size: Pixels on the longer side that features are detected at; 0 for the photos' own.
        matching: `exhaustive`, `sequential` (photos in the order of a walk or video), `retrieval` (those and the
            nearest by appearance) or `auto` (exhaustive up to 60 photos, 150 with masks, then retrieval).
        seed: Seed of all random sampling.
        masks: Where features are detected, if an object was turned or moved between photos: a folder with a mask of
            every photo, `NAME.EXT.png` or `NAME.png`, white where the object is, of the photo's shape; or `"alpha"`,
            the photos' own alpha channel. Weights below a half count as black.
        frames: Largest number of frames of all videos together (`drgs.sfm.video_frames`).
    Raises:
        ValueError: An unknown camera model or way of matching.
    """

    camera_model: str = "SIMPLE_RADIAL"
    max_image_size: int = 1600
    matching: str = "auto"
    seed: int = 0
    masks: str | os.PathLike | None = None
    frames: int = 150

    def __post_init__(self) -> None:
        if self.camera_model not in CAMERA_MODELS:
            raise ValueError(
                f"run_sfm: camera_model must be one of {', '.join(CAMERA_MODELS)}, got {self.camera_model!r}"
            )
        if self.matching not in MATCHING:
            raise ValueError(
                f"run_sfm: matching must be auto, exhaustive, sequential or retrieval, got {self.matching!r}"
            )


def run_sfm(
    photos: str | os.PathLike | Sequence[str | os.PathLike],
    out_dir: str | os.PathLike,
    options: SfmOptions | None = None,
    progress: Progress | None = None,
    status: Callable[[str], None] | None = None,
) -> SfmSummary:
    """Compute camera poses and points from photos or videos; afterwards `drgs.data.load(out_dir)` works.

    Writes `out_dir/{database.db, sparse/0, images}`, and `masks` if there are any, where a fit finds them. Of one
    folder of photos, `images` is a link to it where links work, a copy elsewhere, and so is `masks`; of several, or of
    videos, it is a folder of links, of the frames that were picked, and of frames.json, which says when each was taken.
    An earlier result of this function is replaced, and only once the new one is complete; nothing else ever is.

    Args:
        photos: Folder of photos; or a photo, a video, a folder with some of both, or several of all these.
        out_dir: Folder of the data set; made if absent.
        options: Lens, matching, masks and so on; None: the defaults.
        progress: Called with (stage, done, total); stages are frames of each video, masks, features, matching and
            mapping. Of mapping, which may begin anew, `done` is the number of photos with a pose so far; it is called
            from another thread, too.
        status: Called with what mapping is doing, in words; from another thread, too.
    Raises:
        FileNotFoundError: No such folder or file, or no mask of a photo.
        ValueError: Fewer than 2 photos that can be used (the log names those that are left out), a video that cannot be
            decoded, photos that do not connect, or an `out_dir` that holds a COLMAP project or photos that were not
            made here; a mask of another shape, one that keeps nothing, or a photo without alpha.
    """
    options = options or SfmOptions()
    report, status = progress or (lambda stage, done, total: None), status or (lambda text: None)
    paths = [Path(photos)] if isinstance(photos, str | os.PathLike) else [Path(path) for path in photos]
    image_dir = _one_folder(paths)
    photographs, videos = ([], []) if image_dir else named_files(paths)
    if not image_dir and not videos and len(photographs) < 2:
        raise ValueError(f"{paths[0]}: must be at least 2 photos, got {len(photographs)}; add overlapping photos")
    folders = _Folders.of(image_dir, options.masks)
    with lock_folder(out_dir, "sfm", inputs=[*paths, *folders.linked.values()]) as output:
        _check_output(output, folders)
        with temporary_folder("sfm", output.path) as partial:
            if image_dir is not None:
                summary = _reconstruct(image_dir, partial, options, report, status)
            else:
                times = StageTimes()
                photographs, videos = usable_files(photographs, videos, paths[0], 2, options.max_image_size)
                filled = fill_image_folder(partial / "images", photographs, videos, "sfm", options.frames, report)
                times.end("videos")
                try:
                    summary = _reconstruct(filled.folder, partial, options, report, status)
                except ValueError as error:
                    text = str(error).replace(str(filled.folder), str(paths[0]))
                    raise ValueError("; ".join([text, *(finding.line() for finding in filled.findings)])) from None
                seconds = (times.seconds if videos else {}) | summary.seconds
                summary = dataclasses.replace(summary, seconds=seconds, frames=filled.frames, findings=filled.findings)
            _install(partial, output, folders)
    return summary


@dataclass(frozen=True)
class _Folders:
    """The folders of photographs and masks of a data set that structure from motion makes.

    Attributes:
        linked: Name in the data set -> the user's folder, to which it becomes a link.
        made: Names of those that are made for it.
    """

    linked: dict[str, Path]
    made: list[str]

    @classmethod
    def of(cls, image_dir: Path | None, masks: str | os.PathLike | None) -> _Folders:
        linked = {} if image_dir is None else {"images": image_dir}
        linked |= {} if masks in (None, ALPHA_MASKS) else {"masks": Path(masks)}
        made = [name for name, is_made in (("images", not image_dir), ("masks", masks == ALPHA_MASKS)) if is_made]
        return cls(linked, made)


def _one_folder(paths: list[Path]) -> Path | None:
    """The folder of photos that is all there is to read, if it is that."""
    if len(paths) != 1 or paths[0].is_file():
        return None
    folder = paths[0]
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: must be a folder of photos, or photos or a video, found none; check the path"
        )
    return None if list_videos(folder) else folder


def _checked(folder: Path, masks: str | os.PathLike | None, max_image_size: int) -> tuple[list[str], list[Path] | None]:
    """Names of the photos in a folder that can be used, which must be enough, and their masks."""
    photos = usable_photos(list_images(folder), folder, 2, max_image_size)
    names = [path.name for path in photos]
    check_names(folder, names, masked=masks is not None)
    if len(names) < 2:
        raise ValueError(f"{folder}: must hold at least 2 photos, got {len(names)}; add overlapping photos")
    return names, None if masks is None else find_masks(photos, masks)


def _check_output(output: LockedFolder, folders: _Folders) -> None:
    """Raise ValueError, before minutes of work, unless what is to be replaced is an earlier result."""
    places = ["sparse", *(path.name for path in output.path.glob("database.db*"))]
    places += [name for name, folder in folders.linked.items() if (output.path / name).resolve() != folder.resolve()]
    places += folders.made
    try:
        output.check(places)
    except ValueError as error:
        raise ValueError(f"{str(error).partition(';')[0]}; choose another output (-o), a new folder is best") from None


def _reconstruct(
    image_dir: Path, partial: Path, options: SfmOptions, report: Progress, status: Callable[[str], None]
) -> SfmSummary:
    """Features, matching and mapping of the photographs in a folder.

    Leaves `database.db`, `sparse/0` and, of alpha masks, `masks` in `partial`.
    """
    from drgs.data.colmap_bindings import pycolmap
    from drgs.sfm.matching import match, quiet, restore_focal_lengths

    names, masks = _checked(image_dir, options.masks, options.max_image_size)
    is_masked = masks is not None
    if masks is not None:
        write_masked_photos(image_dir, names, masks, partial, report)
    database = partial / "database.db"
    times = StageTimes()
    with quiet():
        readable = readable_photos(image_dir, names, partial / "readable", report)
        lenses = _lenses(image_dir, readable, names, report)
    features = FeatureOptions(
        options.camera_model, max_image_size=options.max_image_size, masks=partial / "masks" if is_masked else None
    )
    _extract(database, partial / "photos" if is_masked else readable, lenses, features, report, image_dir)
    with quiet():
        if is_masked:
            restore_focal_lengths(database, readable)
        times.end("features")
        pairing = choose_pairs(database, names, options.matching, is_masked, options.seed)
        match(database, pairing.pairs, seed=options.seed, guided=is_masked, progress=report)
        times.end("matching")
        pipeline = pycolmap.IncrementalPipelineOptions()
        pipeline.random_seed = options.seed
        if is_masked:
            pipeline.mapper.init_min_num_inliers = _MASKED_INLIERS_FIRST
            pipeline.mapper.abs_pose_min_num_inliers = _MASKED_INLIERS
        pipeline.min_model_size = min(pipeline.min_model_size, max(2, len(names) // 2))
        (partial / "models").mkdir()
        mapping = MappingProgress(len(names), report, status)
        models = map_photos(database, readable, partial / "models", pipeline, mapping)
        times.end("mapping")
    if not models:
        raise ValueError(
            f"{image_dir}: the photos must overlap and show texture, no two of {len(names)} could be connected; take "
            f"more photos with smaller steps, {'' if is_masked else 'name masks of what was turned (--masks), '}or try "
            "`drgs sfm --camera-model OPENCV`"
        )
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    summary = SfmSummary.of(best, names, pairing, times)  # gives points their errors, which are written
    (partial / "sparse/0").mkdir(parents=True)
    write_model(best, partial / "sparse/0")
    posed = {id(model): posed_names(model) for model in models.values()}
    kept = posed.pop(id(best))
    groups = PhotoGroups.of(database, names, kept, list(posed.values()))
    report("mapping", len(kept), len(names))
    lines = groups.lines(names, is_masked, bool(pairing.left_out))
    return dataclasses.replace(summary, models=len(models), explanation=tuple(lines))


def _lenses(image_dir: Path, readable: Path, names: list[str], report: Progress) -> list[list[str]]:
    """Names of the photos that share a camera: frames of one video, or photos of one size and one focal length, as far
    as EXIF states it.

    Args:
        image_dir: The photos, maybe with a frames.json.
        readable: The same, as COLMAP reads them.
        names: Their names.
        report: Called when it begins.
    """
    from drgs.data.colmap_bindings import pycolmap

    videos = {row["file"]: row["video"] for row in (recorded_frames(image_dir) or {"frames": []})["frames"]}
    groups = dict[tuple, list[str]]()
    report("features", 0, len(names))
    for name in names:
        size, focal = image_size(image_dir / name), ""
        if name not in videos:
            stated = pycolmap.infer_camera_from_image(readable / name)
            focal = f"{stated.mean_focal_length():.3g}" if stated.has_prior_focal_length else ""
        groups.setdefault((videos.get(name), size, focal), []).append(name)
    return list(groups.values())


def _extract(
    database: Path, folder: Path, lenses: list[list[str]], options: FeatureOptions, report: Progress, originals: Path
) -> None:
    """Features of all photos, those of each lens with a camera of theirs; those that share it with no other at once."""
    from drgs.sfm.matching import extract

    alone = [lens[0] for lens in lenses if len(lens) == 1]
    groups = [*((lens, True) for lens in lenses if len(lens) > 1), *([(alone, False)] if alone else [])]
    total, before = sum(len(lens) for lens in lenses), 0
    for names, is_shared in groups:
        extract(
            database,
            folder,
            names,
            dataclasses.replace(options, is_shared=is_shared),
            lambda stage, done, _, before=before: report(stage, before + done, total),
            originals,
        )
        before += len(names)


def _install(partial: Path, output: LockedFolder, folders: _Folders) -> None:
    """Move the finished result to its place; the model, which makes the folder a data set, comes
    last.
    """
    _check_output(output, folders)  # again: minutes have passed
    new = {name: partial / name for name in folders.made}
    for name, folder in folders.linked.items():
        if (output.path / name).resolve() == folder.resolve():
            continue
        new[name] = partial / f"linked_{name}"
        try:
            new[name].symlink_to(folder.resolve(), target_is_directory=True)
        except OSError:
            shutil.copytree(folder, new[name])
    # SQLite may have left side files; they belong to the database.
    new |= {file.name: file for file in partial.glob("database.db*")} | {"sparse": partial / "sparse"}
    for name, path in new.items():
        output.record_planned(path, name)
    output.remove(output.path / "sparse")
    masks = output.path / "masks"
    # Those of an earlier result; an empty folder is nobody's.
    is_stale = output.is_ours(masks, ("sfm",)) and (masks.is_symlink() or any(masks.iterdir()))
    if is_stale and "masks" not in folders.linked:
        output.remove(masks)
    for stale in output.path.glob("database.db*"):
        output.remove(stale)
    for name, path in new.items():
        output.remove(output.path / name)
        output.put(path, name)
