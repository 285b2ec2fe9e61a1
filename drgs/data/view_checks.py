"""What the views of a data set must be: images that are there, of their cameras' shapes, each once, and from several
places; and what photographs with an alpha channel are composited on.
"""

from __future__ import annotations

import filecmp
import logging
from collections import defaultdict
from pathlib import Path

import numpy as np

from drgs.cameras.origins import rounding
from drgs.data.dataset import Dataset
from drgs.data.images import png_has_alpha, read_image, unit_range
from drgs.data.resampling import resize_area
from drgs.data.views import View
from drgs.io.foreign import is_file

# of cameras that film what moves (docs/dynamic-data.md, Layouts)
_FEW_PLACES = 4
_ENOUGH_PLACES = 6
_MIN_IMAGES = 3  # images that a data set must have where others are missing
_NAMED_PATHS = 5  # missing images that a message names with their folders
_NAMED_FILES = 50  # more of them that it names by file name, at most
_MAX_PATH_SHOWN = 400  # characters of a path in messages
# Copies of one photograph have nearly one pose: structure from motion places each by itself, by the same features.
_SAME_POSE = 1e-2  # of the spread of the cameras' centers; also the largest difference of entries of their rotations
_IDENTICAL_POSE = 1e-9  # of the spread and of 1: the same numbers, but for rounding
_THUMBNAIL_SIDE = 32  # pixels across the small pictures by which copies in two formats are compared
_SAME_PICTURE = 0.05  # largest difference of these, white being 1: compression stays below 0.01, a passer-by is above

_log = logging.getLogger(__name__)


def report_missing_images(where: Path, missing: list[Path], left: int, strict: bool) -> None:
    """Say which images of a data set are not there, or damaged, or refuse the data set.

    Args:
        where: The file that lists them.
        missing: The images that are not there or damaged; nothing is done if there are none.
        left: How many are there.
        strict: Refuse whatever is left.
    Raises:
        FileNotFoundError: `strict`, or fewer than 3 are left.
    """
    if not missing:
        return
    names = [str(path)[:_MAX_PATH_SHOWN] for path in missing]
    count = len(missing) + left
    shown = ", ".join(names[:_NAMED_PATHS]) + (", ..." if len(names) > _NAMED_PATHS else "")
    damaged = sum(is_file(path) for path in missing)
    state = "not there" if not damaged else "damaged" if damaged == len(missing) else "not there or damaged"
    problem = f"{where}: {len(names)} of the {count} images that it lists are {state} ({shown})"
    if strict or left < _MIN_IMAGES:
        rule = "all must be there" if strict else f"at least {_MIN_IMAGES} must be there"
        hint = ", or drop --strict (strict=True) to go on without them" if strict and left >= _MIN_IMAGES else ""
        raise FileNotFoundError(f"{problem}; {rule}: restore them{hint}")
    _log.warning("%s; going on with the other %d (--strict refuses that)", problem, left)
    if len(names) > _NAMED_PATHS:
        others = [path.name[:_MAX_PATH_SHOWN] for path in missing[_NAMED_PATHS : _NAMED_PATHS + _NAMED_FILES]]
        more = len(names) - _NAMED_PATHS - len(others)
        _log.info("also %s: %s%s", state, ", ".join(others), f" and {more} more" if more else "")


def check_parallax(views: list[View]) -> None:
    """Warn about views that stand in one place, from which no depth can be determined; refuse views that are all the
    same.

    Views of one pose at several times are one place: a camera that stands still before something that moves.

    Raises:
        ValueError: Two views or more, all of one pose and of one time (or of none).
    """
    poses = np.stack([view.camera.c2w for view in views])
    spread = np.abs(poses - poses[0]).max(axis=(1, 2))
    tiny = rounding(poses)  # equal poses that a file states in several ways
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
            "all %d training views stand in one place: the photographs determine no depths, other places will look "
            "wrong",
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
        views: All training views that there will be. Those of one place alone are `check_parallax`'s.
    """
    times = {view.camera.time for view in views} - {None}
    centers = np.stack([view.camera.center for view in views])
    # Cameras on stands may have been calibrated anew for every time.
    near = max(1e-3 * float(np.ptp(centers, axis=0).max()), 1e-6, rounding(centers))
    distinct: list[np.ndarray] = []
    for center in centers:
        if len(distinct) < _FEW_PLACES and all(np.abs(center - other).max() > near for other in distinct):
            distinct.append(center)
    places = len(distinct)
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
        ValueError: Training views of two times or more, and a view of none.
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
    times = [view.camera.time for view in train if view.camera.time is not None]
    first, last = min(times), max(times)
    beyond = [view.name for view in test if view.camera.time is not None and not first <= view.camera.time <= last]
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


def make_names_unique(views: list[View]) -> None:
    """Views are told apart by their names, in splits, picks and file names: a repeated one gets a number."""
    taken = {view.name for view in views}
    seen: set[str] = set()
    for view in views:
        name, number = view.name, 1
        while view.name in seen or (number > 1 and view.name in taken):
            number += 1
            view.name = f"{name}_{number}"
        seen.add(view.name)


def drop_duplicates(dataset: Dataset) -> None:
    """Leave out photographs that are listed again, under the same name or another one, and say so.

    Two views are of one photograph if they have one file (or links to it), nearly one pose and files of the same bytes
    or names that differ in the suffix alone, or exactly one pose and pictures that look the same; of different times or
    cameras they never are. The first that is listed is kept. It is held out if any of them is, unless that would leave
    no photograph to train on. No file is opened but those of nearly one pose.
    """
    listed = [*dataset.views, *dataset.absent]
    copies = _copies(listed)
    if not copies:
        return
    splits = [view.split for view in listed]
    kept = [view for index, view in enumerate(listed) if index not in copies]
    held_out, unused = ("test", "val") if "test" in splits else ("val", "test")
    for order in ((held_out, "train", "", unused), ("train", "", held_out, unused)):
        for first in set(copies.values()):
            named = [splits[index] for index, of in copies.items() if of == first]
            listed[first].split = min((splits[first], *named), key=order.index)
        if any(view.split not in ("val", "test") for view in kept):
            break
    shown = [f"{listed[index].name} is the same as {listed[first].name}" for index, first in copies.items()][
        :_NAMED_PATHS
    ]
    _log.warning(
        "%s: %d of the %d photographs are listed again (%s); each one counts once, in one split",
        dataset.path,
        len(copies),
        len(listed),
        ", ".join(shown) + (", ..." if len(copies) > _NAMED_PATHS else ""),
    )
    there = {id(view) for view in kept}
    dataset.views = [view for view in dataset.views if id(view) in there]
    dataset.absent = [view for view in dataset.absent if id(view) in there]


def _copies(views: list[View]) -> dict[int, int]:
    """Index of each view that is of the same photograph as an earlier one -> index of the first such view."""
    poses = np.full((len(views), 3, 4), np.nan)  # of what is absent: near nothing
    for index, view in enumerate(views):
        if view.camera is not None:
            poses[index] = view.camera.c2w[:3]
    if np.isnan(poses).all():
        return {}
    centers = poses[..., 3]
    poses[..., 3] /= max(np.ptp(centers[~np.isnan(centers[:, 0])], axis=0).max(), _IDENTICAL_POSE)
    alike: dict[tuple, list[int]] = defaultdict(list)
    for index, view in enumerate(views):
        path = view.image_path
        if path is None:
            continue
        about = view.camera_name, view.camera.time if view.camera else None
        alike["name", path.with_suffix(""), *about].append(index)
        if view.camera is None:
            continue
        file = path.stat()
        alike["file", file.st_dev, file.st_ino, *about].append(index)
        alike["size", file.st_size, *about].append(index)
        alike["pose", (np.round(poses[index] / _IDENTICAL_POSE) + 0.0).tobytes(), *about].append(index)  # -0.0 is 0.0
    first_of: dict[int, int] = {}
    for (kind, *_), members in alike.items():
        for n, index in enumerate(members):
            path = Path(views[index].image_path or "")
            near = np.abs(poses[members[:n]] - poses[index]).max(axis=(1, 2)) <= _SAME_POSE
            for other, is_near in zip(members[:n], near, strict=True):
                before = Path(views[other].image_path or "")
                same = kind == "file" or path == before
                same = same or bool(is_near and (kind == "name" or filecmp.cmp(path, before, shallow=False)))
                if same or (kind == "pose" and _look_alike(path, before)):
                    first_of[index] = min(first_of.get(index, index), other)
                    break
    for index in sorted(first_of):  # a copy of a copy is one of the first
        first_of[index] = first_of.get(first_of[index], first_of[index])
    return first_of


def _look_alike(one: Path, other: Path) -> bool:
    """Whether two image files show the same picture, perhaps in two formats or sizes."""
    try:
        pictures = [unit_range(read_image(path), path) for path in (one, other)]
    except ValueError:  # what cannot be read is said where it is read
        return False
    gray = [picture[..., :3].mean(axis=-1) if picture.ndim == 3 else picture for picture in pictures]
    small = [resize_area(picture, _THUMBNAIL_SIDE, _THUMBNAIL_SIDE) for picture in gray]
    return bool(np.abs(small[0] - small[1]).max() <= _SAME_PICTURE)


def mark_partial_masks(views: list[View], lazy: bool) -> None:
    """Set `View.empty_outside` to False where some views alone are cut out, by a mask file or an alpha channel.

    The others show what is outside: it is not empty.

    Args:
        views: Of one data set.
        lazy: Open no image: alpha channels are not looked for.
    """
    is_cut_out = [
        view.mask_path is not None or (not lazy and view.image_path is not None and png_has_alpha(view.image_path))
        for view in views
    ]
    if any(is_cut_out) and not all(is_cut_out):
        for view, cut_out in zip(views, is_cut_out, strict=True):
            view.empty_outside = not cut_out


_EDGE_PROBES = 8  # photographs whose edges are compared, evenly spaced; chosen
_OPAQUE_ALPHA = 0.995  # alpha from which on a pixel shows the object alone
_EDGE_ALPHA = (0.2, 0.8)  # range of alpha of pixels that show both object and background
_MIN_EDGE_VALUES = 200  # color values at edges; fewer decide nothing. Chosen
_EDGE_BRIGHTNESS = (0.8, 1.25)  # of edges, in that of the object beside them, which is shaded differently there
_CLEARLY_MIXED = 0.5  # share of the error of unmixed colors below which a mix is clear: 0.05 to 0.4 where one was made
_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def default_background(dataset: Dataset, lazy: bool = False) -> tuple[tuple[float, float, float], str]:
    """The color to composite the photographs of a data set on, and why, in words; no words where none has alpha.

    Colors of half-transparent pixels should be those of the object. If they are clearly mixed with black or white, the
    object was cut out of photographs on that color, and another one behind it would leave a rim. Otherwise data of
    Blender's and D-NeRF's layout (`transforms_train.json`) are put on white, as the other readers of these data do, and
    all others on black.

    Args:
        dataset: Its training views that are PNGs are compared.
        lazy: Open none but the first training view, and of that the header alone.
    Returns:
        RGB in [0, 1], and one line.
    """
    views = [view for view in dataset.split()[0] if view.image_path is not None]
    views = [view for view in (views[:1] if lazy else views) if view.image_path and png_has_alpha(view.image_path)]
    if not views:
        return _COLORS["black"], ""
    found = "" if lazy else _mixed_with(views[:: -(-len(views) // _EDGE_PROBES)])
    if found:
        return _COLORS[found], f"{found}, which half-transparent pixels at the edges of objects are mixed with"
    path = dataset.path
    is_blender = not (path / "transforms.json").is_file() if path.is_dir() else path.name == "transforms_train.json"
    if dataset.format == "transforms" and is_blender:
        return _COLORS["white"], "white, as readers of Blender's and D-NeRF's data sets take it"
    return _COLORS["black"], "black"


def _mixed_with(views: list[View]) -> str:
    """`black` or `white` if colors of half-transparent pixels are clearly mixed with it, else empty."""
    parts = [_edges(view) for view in views]
    alpha, object_color, color = (np.concatenate(x) for x in zip(*parts, strict=True))
    if len(color) < _MIN_EDGE_VALUES:
        return ""

    def error(base: np.ndarray, ground: np.ndarray | float) -> float:
        """Mean absolute error of the colors as `base`, as bright as fits best, over the ground."""
        factor = np.dot(base, color - ground) / max(np.dot(base, base), 1e-12)
        return float(np.abs(color - ground - np.clip(factor, *_EDGE_BRIGHTNESS) * base).mean())

    errors = {"black": error(alpha * object_color, 0.0), "white": error(alpha * object_color, 1 - alpha)}
    best = min(errors, key=errors.__getitem__)
    return best if errors[best] < _CLEARLY_MIXED * error(object_color, 0.0) else ""


def _edges(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(P,) alpha, color of the object beside it, and color, of each channel of half-transparent pixels of a photo."""
    import cv2

    assert view.image_path is not None
    data = unit_range(read_image(view.image_path), view.image_path)
    if data.ndim != 3 or data.shape[2] != 4:
        return (np.empty(0, np.float32),) * 3
    color, alpha = data[..., :3], data[..., 3]
    solid = (alpha >= _OPAQUE_ALPHA).astype(np.float32)
    # Sums over 5x5 pixels; nothing is added beyond the border.
    count, total = (
        cv2.boxFilter(x, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for x in (solid, color * solid[..., None])
    )
    chosen = (alpha > _EDGE_ALPHA[0]) & (alpha < _EDGE_ALPHA[1]) & (count >= 3)
    beside = total[chosen] / count[chosen][:, None]
    return np.repeat(alpha[chosen], 3), beside.ravel(), color[chosen].ravel()
