"""What the views of a data set must be, whatever its format: images that are there, of their cameras' shapes, under
names of their own, from several places.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.data.checks import image_size

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.data.views import Dataset, View

__all__ = [
    "ASPECT_TOLERANCE",
    "check_cameras",
    "check_parallax",
    "check_times",
    "fit_to_image",
    "go_on_without",
    "make_unique",
    "nearest_resized",
    "resized_to",
]

ASPECT_TOLERANCE = 0.01  # of the shape of an image against that of its camera
# of cameras that film what moves (docs/dynamic.md, Data)
_FEW_PLACES = 4
_ENOUGH_PLACES = 6
_FEWEST = 3  # images that a data set must have where others are missing
_SHOWN = 5  # of those are named at once
_LONGEST = 400  # characters of a path in messages

_log = logging.getLogger(__name__)


def go_on_without(where: Path, missing: list[Path], left: int, strict: bool) -> None:
    """Say which images of a data set are not there, or refuse the data set.

    Args:
        where: The file that lists them.
        missing: The images that are not there; nothing is done if there are none.
        left: How many are there.
        strict: Refuse whatever is left.

    Raises:
        FileNotFoundError: `strict`, or fewer than 3 are left.
    """
    if not missing:
        return
    names = [str(path)[:_LONGEST] for path in missing]
    count = len(missing) + left
    shown = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    told = f"{where}: {len(names)} of the {count} images that it lists are not there ({shown})"
    if strict or left < _FEWEST:
        rule = "all must be there" if strict else f"at least {_FEWEST} must be there"
        hint = ", or drop --strict (strict=True) to go on without them" if strict and left >= _FEWEST else ""
        raise FileNotFoundError(f"{told}; {rule}: restore them{hint}")
    _log.warning("%s; going on with the other %d (--strict refuses that)", told, left)
    if len(names) > _SHOWN:
        _log.info("also not there: %s", ", ".join(names[_SHOWN:]))


def check_parallax(views: list[View]) -> None:
    """Warn about views that stand in one place, from which no depth can be told; refuse views that are all the same.

    Views of one pose at several times are one place: a camera that stands still before something that moves.

    Raises:
        ValueError: two views or more, all of one pose and of one time (or of none).
    """
    poses = np.stack([view.camera.c2w for view in views])
    spread = np.abs(poses - poses[0]).max(axis=(1, 2))
    # Equal poses that a file states in several ways differ by rounding.
    tiny = 1e-9 * max(1.0, float(np.abs(poses).max()))
    if len(views) < 2:
        return
    times = [[view.camera.time or 0.0] for view in views]  # from one place at two times, things may have moved
    if spread.max() <= tiny and times.count(times[0]) == len(times):
        raise ValueError(
            f"the {len(views)} training views must have poses of their own, all have the same one (as view "
            f"{views[0].name!r}); check the camera file"
        )
    if np.abs(poses[:, :3, 3] - poses[0, :3, 3]).max() <= tiny:
        _log.warning(
            "all %d training views stand in one place: the photographs tell no depths, other places will look wrong",
            len(views),
        )
        return
    if same := len(poses) - len(np.unique(np.c_[np.round(poses / tiny).reshape(len(poses), -1), times], axis=0)):
        _log.warning(
            "%d of the %d training views have the pose of another one; check the camera file", same, len(poses)
        )


def check_cameras(views: list[View]) -> None:
    """Warn where something that moves is seen from few places: of two or three synchronous cameras a fit learns the
    pictures by heart.

    Args:
        views: For training, all that there will be. Those of one place alone are `check_parallax`'s.
    """
    times = {view.camera.time for view in views} - {None}
    centers = np.stack([view.camera.center for view in views])
    # Cameras on stands may have been calibrated anew for every time.
    near = max(1e-3 * float(np.ptp(centers, axis=0).max()), 1e-6 * max(1.0, float(np.abs(centers).max())))
    found: list[np.ndarray] = []
    for center in centers:
        if len(found) < _FEW_PLACES and all(np.abs(center - other).max() > near for other in found):
            found.append(center)
    places = len(found)
    if len(times) >= 2 and 2 <= places < _FEW_PLACES:
        _log.warning(
            "the %d training views of %d times are from %d places only: from others it will look far worse than "
            "from these; film with %d cameras or more, or hold fewer out (--test-cameras)",
            len(views),
            len(times),
            places,
            _ENOUGH_PLACES,
        )


def check_times(dataset: Dataset) -> None:
    """Refuse views without a time among those of a scene that moves, and warn where test views are before or after all
    training views.

    Times may be in any unit and order, and views may share one.

    Raises:
        ValueError: training views of two times or more, and a view of none.
    """
    if not dataset.is_dynamic:
        return
    train, test = dataset.split()
    without = [view.name for view in train + test if view.camera.time is None]
    if without:
        raise ValueError(
            f"{dataset.path}: every view of a scene that moves must have a time, {len(without)} have none (as view "
            f"{without[0]!r}); state all, or remove all for a scene that stands still"
        )
    first = min(view.camera.time for view in train)
    last = max(view.camera.time for view in train)
    beyond = [view.name for view in test if not first <= view.camera.time <= last]
    if beyond:
        _log.warning(
            "%d of the %d test views are before or after all training views (%g to %g), as %r: nothing says how things "
            "move there",
            len(beyond),
            len(test),
            first,
            last,
            beyond[0],
        )


def make_unique(views: list[View]) -> None:
    """Views are told apart by their names, in splits, picks and file names: a repeated one gets a number."""
    taken = {view.name for view in views}
    seen: set[str] = set()
    for view in views:
        name, number = view.name, 1
        while view.name in seen or (number > 1 and view.name in taken):
            number += 1
            view.name = f"{name}_{number}"
        seen.add(view.name)


def fit_to_image(camera: Camera, path: Path, where: str, lazy: bool = False) -> Camera:
    """The camera at the size of its image file, from the file's header.

    Data sets are often downscaled after calibration, so K is scaled when the shapes agree to 1 %. With `lazy` the file
    must exist, but is not opened, and the camera stays as it is.

    Raises:
        FileNotFoundError: no such image.
        ValueError: not an image, or another shape.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{where}: the image {path} must exist, found none; restore it or drop the view")
    if lazy:
        return camera
    return resized_to(camera, image_size(path), path, where)


def resized_to(camera: Camera, size: tuple[int, int], path: Path, where: str) -> Camera:
    """The camera at the size (width, height) that an image or video has.

    Raises:
        ValueError: another shape, by more than 1 %.
    """
    width, height = size
    if (width, height) == (camera.width, camera.height):
        return camera
    if abs(width * camera.height / (height * camera.width) - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"{where}: the image {path} must have the shape of its camera "
            f"({camera.width}x{camera.height}), "
            f"got {width}x{height}; give this view its own intrinsics"
        )
    return camera.resized(width, height)


def nearest_resized(data: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    """A mask, label image or depth map (H,W) at the size (width, height) of its image, without mixing pixels.

    Args:
        path: The file that it is of, for the message.

    Raises:
        ValueError: another shape than the image's, by more than 1 %.
    """
    import cv2

    height, width = data.shape
    if abs(width * size[1] / (height * size[0]) - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"{path}: must have the shape of its image ({size[0]}x{size[1]}), got {width}x{height}; export it again"
        )
    return data if (width, height) == size else cv2.resize(data, size, interpolation=cv2.INTER_NEAREST_EXACT)
