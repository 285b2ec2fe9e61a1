"""Local features, by a process of its own (extraction.py), and their matches, by pycolmap on the CPU, in steps small
enough to report progress.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from drgs.data.reader_process import Child
from drgs.io import interrupts
from drgs.io.atomic import check_room, temporary_folder
from drgs.runtime import thread_count
from drgs.sfm.photo_files import own_file

Progress = Callable[[str, int, int], None]
_PAIRS_A_STEP = 16  # a thread: all of them are busy, and progress is seen
# Bytes on the disk: a feature of SIFT has 128 of its descriptor and 24 of its place, a match 8 when it is found and 8
# when it is verified. SQLite writes everything twice, first into a log beside the database.
_FEATURE_BYTES, _MATCH_BYTES = 2 * 152, 2 * 16
_MOST_FEATURES = 8192  # of a photograph, as COLMAP has it

_extractor = Child("drgs.sfm.extraction", "a photograph that COLMAP finds features in", "leave it out")


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """COLMAP's log kept off the terminal, errors included: they arrive as exceptions. Signals end a command there."""
    from drgs.data.colmap_bindings import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        with interrupts.in_native_code():
            yield
    finally:
        pycolmap.logging.minloglevel = level


@dataclasses.dataclass(frozen=True)
class FeatureOptions:
    """How features are detected, and which camera their photographs get.

    Attributes:
        camera_model: COLMAP's name.
        is_shared: One camera for all photographs of a call, or one each.
        max_image_size: Pixels on the longer side above which photographs are shrunk; 0 for never.
        masks: Folder with `NAME.EXT.png` of every photograph, of its size: no features where it is 0.
        camera: Number of a camera in the database that the photographs share; None: a new one.
    """

    camera_model: str = "SIMPLE_RADIAL"
    is_shared: bool = False
    max_image_size: int = 0
    masks: Path | None = None
    camera: int | None = None


def extract(
    database: Path,
    folder: Path,
    names: list[str],
    options: FeatureOptions,
    progress: Progress | None = None,
    originals: Path | None = None,
) -> None:
    """SIFT features of photographs into a COLMAP database, with affine shapes and pooled scales, which connect views
    that are further apart, at 2.5 times the cost.

    Args:
        database: file, made if absent.
        folder, names: Folder of the photographs, and their names in it.
        options: Their camera, size and masks.
        progress: Called with ("features", done, total).
        originals: Folder of the photographs that messages name, where those in `folder` are copies.
    Raises:
        ValueError: COLMAP crashed over a photograph.
    """
    threads = thread_count()
    settings = dataclasses.asdict(options) | {"database": str(database), "folder": str(folder), "threads": threads}
    settings["masks"] = None if options.masks is None else str(options.masks)
    settings["is_shared"] = options.is_shared or options.camera is not None
    for start in range(0, len(names), threads):  # one a thread: all of them are busy, and progress is seen
        if progress:
            progress("features", start, len(names))
        check_room(database.parent, min(threads, len(names) - start) * _MOST_FEATURES * _FEATURE_BYTES)
        some = names[start : start + threads]
        shown = " or ".join(str(own_file((originals or folder) / name)) for name in some)
        # Every call would otherwise open a camera of its own.
        settings["camera"] = _extractor.call("extract_features", Path(shown), some, settings)
    if progress:
        progress("features", len(names), len(names))


def start_extraction() -> None:
    """Start the process that `extract` uses, so that the time of its first call is that of features alone."""
    _extractor.call("ready", Path())


def restore_focal_lengths(database: Path, folder: Path) -> None:
    """Give cameras the focal lengths that the EXIF of photographs states, where features came from copies without it.

    Args:
        database: COLMAP's database, with features of images whose names are those in the folder.
        folder: The photographs.
    """
    from drgs.data.colmap_bindings import opened_database, pycolmap

    with opened_database(database) as handle:
        first = {image.camera_id: image.name for image in reversed(handle.read_all_images())}
        for camera in handle.read_all_cameras():
            reader = pycolmap.ImageReaderOptions()
            reader.camera_model = camera.model_name
            stated = pycolmap.infer_camera_from_image(folder / first[camera.camera_id], reader)
            stated.camera_id = camera.camera_id
            handle.update_camera(stated)


def match(
    database: Path,
    pairs: list[tuple[str, str]],
    *,
    seed: int = 0,
    guided: bool = False,
    progress: Progress | None = None,
) -> None:
    """Match image pairs and verify them geometrically; results go to the database.

    Args:
        database: COLMAP's database, with features.
        pairs: Names of the two images of each pair.
        seed: Seed of the random sampling in the verification.
        guided: Look for more matches once the epipolar geometry of a pair is known.
        progress: Called with ("matching", done, total).
    """
    from drgs.data.colmap_bindings import opened_database, pycolmap

    threads = thread_count()
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = threads
    options.guided_matching = guided
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    with opened_database(database) as handle:
        most = max((handle.num_keypoints_for_image(image.image_id) for image in handle.read_all_images()), default=0)
    needed = min(len(pairs), _PAIRS_A_STEP * threads) * most * _MATCH_BYTES
    with temporary_folder("pairs") as folder, _numbered(database) as numbers:
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = folder / "pairs.txt"
        at_once = _PAIRS_A_STEP * threads
        for start in range(0, len(pairs), at_once):
            if progress:
                progress("matching", start, len(pairs))
            step = pairs[start : start + at_once]
            check_room(database.parent, needed)
            pairing.match_list_path.write_text("".join(f"{numbers[a]} {numbers[b]}\n" for a, b in step))
            pycolmap.match_image_pairs(
                database,
                matching_options=options,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
    if progress:
        progress("matching", len(pairs), len(pairs))


@contextlib.contextmanager
def _numbered(database: Path) -> Iterator[dict[str, str]]:
    """Name -> number that the images of a database are called by meanwhile: COLMAP splits a list of pairs at spaces."""
    from drgs.data.colmap_bindings import opened_database

    with opened_database(database) as handle:
        images = handle.read_all_images()
        names = {image.image_id: image.name for image in images}
        for image in images:
            image.name = str(image.image_id)
            handle.update_image(image)
    yield {name: str(number) for number, name in names.items()}
    with opened_database(database) as handle:
        for image in handle.read_all_images():
            image.name = names[image.image_id]
            handle.update_image(image)


def sequential_pairs(names: list[str], window: int) -> list[tuple[str, str]]:
    """Each name with the `window` names after it, and with powers of two beyond, to bridge
    gaps.
    """
    steps = set(range(1, window + 1)) | {2**k for k in range(16) if 2**k > window}
    return [(names[i], names[i + s]) for i in range(len(names)) for s in sorted(steps) if i + s < len(names)]


def nearby_pairs(centers: np.ndarray, axes: np.ndarray, neighbors: int) -> list[tuple[int, int]]:
    """Pairs of posed cameras that are likely to see the same things.

    Args:
        centers: (V,3) camera centers.
        axes: (V,3) unit viewing directions.
        neighbors: Partners of each camera; all pairs if there are no more cameras than that.
    Returns:
        index pairs (i, j), i < j.
    """
    count = len(centers)
    if count <= neighbors + 1:
        return list(itertools.combinations(range(count), 2))
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    # One median distance counts as much as turning by 60 degrees; cameras back to back share
    # nothing.
    cost = distance / max(float(np.median(distance)), 1e-12) + 2.0 * (1.0 - axes @ axes.T)
    np.fill_diagonal(cost, np.inf)
    # Stable: of equal costs, as on a regular circle, the lower index wins on every machine.
    nearest = np.argsort(cost, axis=1, kind="stable")[:, :neighbors]
    return sorted({(min(i, j), max(i, j)) for i in range(count) for j in nearest[i].tolist()})
