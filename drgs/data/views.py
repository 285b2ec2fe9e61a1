"""Views and data sets: cameras with images, masks and depth maps that are read when asked for."""

from __future__ import annotations

import dataclasses
import functools
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drgs.cameras import Camera
from drgs.data.checks import image_size, read_image, read_npy
from drgs.data.splits import SplitRule

__all__ = ["Dataset", "View", "check_parallax", "fit_to_image", "go_on_without", "make_unique"]

_ASPECT_TOLERANCE = 0.01
# An undistorted border pixel may look this many pixels past the photo before it counts as unseen.
_BORDER = 1.0
# Of an undistorted image, the share that its photo did not see: ordinary lenses leave below a tenth in the corners.
_LOST_WARNED, _LOST_MAX = 0.25, 0.9
_FEWEST = 3  # images that a data set must have where others are missing
_SHOWN = 5  # of those are named at once

_log = logging.getLogger(__name__)


@dataclass
class View:
    """One photograph: its camera and where its files are. Nothing is decoded before a method asks.

    Attributes:
        camera: the camera as calibrated, of the size of the image file, lens included.
        name: unique in the data set; the image's path below the image folder without its suffix.
        image_path, mask_path, depth_path: files, or None. Masks: white is kept. Depth: z-depth, 0
            is unknown.
        depth_scale: scene units in one unit of the depth file.
        background: color in [0,1] that images with an alpha channel are composited on.
        split: ``train``, ``val`` or ``test`` where the data set itself says so, else empty.
        is_checked: False while the camera's size is what the camera file states and no image has been opened.
    """

    camera: Camera
    name: str
    image_path: Path | None = None
    mask_path: Path | None = None
    depth_path: Path | None = None
    depth_scale: float = 1.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    split: str = ""
    is_checked: bool = True

    def checked(self) -> View:
        """The view with its camera at the size of its image file, whose header is read now if it has not been.

        Raises:
            FileNotFoundError, ValueError: as `fit_to_image`.
        """
        if self.is_checked or self.image_path is None:
            return self
        camera = fit_to_image(self.camera, self.image_path, f"view {self.name!r}")
        return dataclasses.replace(self, camera=camera, is_checked=True)

    def image(self, width: int | None = None, height: int | None = None) -> np.ndarray:
        """(H,W,3) float32 in [0,1] as stored (no transfer function applied), undistorted,
        area-resized.

        The result belongs to ``camera.undistorted().resized(width, height)``.

        Args:
            width, height: pixels; the camera's own size if left out.

        Raises:
            FileNotFoundError, ValueError: the file is missing, no image, or not of the camera's
                size.
        """
        import cv2

        if self.image_path is None:
            raise ValueError(f"view {self.name!r}: must have an image, has none; drop this view")
        data = _unit_range(read_image(self.image_path), self.image_path)
        self._check_size(data, self.image_path)
        if data.ndim == 2:
            data = np.repeat(data[..., None], 3, axis=2)
        if data.shape[2] == 4:
            alpha = data[..., 3:]
            data = data[..., :3] * alpha + (1 - alpha) * np.asarray(self.background, dtype=np.float32)
        if self.camera.is_distorted:
            columns, rows, _ = _lens_maps(self.camera)
            data = cv2.remap(data, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            data = np.clip(data, 0.0, 1.0)  # cubic interpolation overshoots at edges
        return _resize_area(data, *self._size(width, height))

    def mask(self, width: int | None = None, height: int | None = None) -> np.ndarray | None:
        """(H,W) float32 in [0,1], 1 where the image counts; None if all of it does.

        Pixels of an undistorted image that the photo did not see are 0, also where there is no mask
        file.
        """
        if self.mask_path is None and not (self.camera.is_distorted and _lens_maps(self.camera)[2] is not None):
            return None
        if self.mask_path is None:
            data = np.ones((self.camera.height, self.camera.width), dtype=np.float32)
        else:
            raw = read_image(self.mask_path)
            if raw.ndim == 3:
                raw = raw[..., 3] if raw.shape[2] == 4 else raw[..., 0]
            # Masks stored as 0 and 1 in 8 bits would otherwise be nearly black.
            data = raw.astype(np.float32) if raw.max() <= 1 else _unit_range(raw, self.mask_path)
            data = self._nearest(data, self.mask_path)
        if self.camera.is_distorted:
            unseen = _lens_maps(self.camera)[2]
            if unseen is not None:
                data = np.where(unseen, np.float32(0), data)
        return _resize_area(data, *self._size(width, height))

    def depth(self, width: int | None = None, height: int | None = None) -> np.ndarray | None:
        """(H,W) float32 z-depth in scene units, 0 where unknown, nearest pixel; None if there is
        no depth map.
        """
        import cv2

        if self.depth_path is None:
            return None
        raw = read_npy(self.depth_path) if self.depth_path.suffix == ".npy" else read_image(self.depth_path)
        if raw.ndim == 3 and raw.shape[2] == 1:
            raw = raw[..., 0]
        if raw.ndim != 2:
            raise ValueError(f"{self.depth_path}: a depth map must have one channel, got shape {raw.shape}; convert it")
        data = raw.astype(np.float32) * np.float32(self.depth_scale)
        data = np.where(np.isfinite(data) & (data > 0), data, np.float32(0))
        data = self._nearest(data, self.depth_path)
        if self.camera.is_distorted and _lens_maps(self.camera)[2] is not None:
            data = np.where(_lens_maps(self.camera)[2], np.float32(0), data)
        # Averaging depths across an edge, or with unknown zeros, would invent surfaces.
        return cv2.resize(data, self._size(width, height), interpolation=cv2.INTER_NEAREST_EXACT)

    def _size(self, width: int | None, height: int | None) -> tuple[int, int]:
        return width or self.camera.width, height or self.camera.height

    def _check_size(self, data: np.ndarray, path: Path) -> None:
        height, width = data.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise ValueError(
                f"{path}: must be {self.camera.width}x{self.camera.height} pixels as its camera, "
                f"got {width}x{height}; load the data set again"
            )

    def _nearest(self, data: np.ndarray, path: Path) -> np.ndarray:
        """A mask or depth map at the camera's size and undistorted, without mixing pixels."""
        import cv2

        height, width = data.shape
        if abs(width * self.camera.height / (height * self.camera.width) - 1) > _ASPECT_TOLERANCE:
            raise ValueError(
                f"{path}: must have the shape of its image "
                f"({self.camera.width}x{self.camera.height}), "
                f"got {width}x{height}; export it again"
            )
        size = (self.camera.width, self.camera.height)
        if (width, height) != size:
            data = cv2.resize(data, size, interpolation=cv2.INTER_NEAREST_EXACT)
        if self.camera.is_distorted:
            columns, rows, _ = _lens_maps(self.camera)
            data = cv2.remap(data, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return data


@dataclass
class Dataset:
    """Views of one scene and, where the data set has them, its points.

    Attributes:
        path: what was loaded.
        format: ``colmap``, ``transforms`` or ``llff``.
        views: in the order of the data set.
        points: (P,3) float64 world points, or None.
        colors: (P,3) float32 in [0,1], or None.
        point_source: where the points come from, one line, empty without points.
        test_every: every how many views one is held out.
        test_offset: index, by name, of the first view that is held out.
        absent: views that the data set lists, but whose image is not there; they have no camera, and count in `split`
            alone, which therefore stays the same whatever is missing.
    """

    path: Path
    format: str
    views: list[View]
    points: np.ndarray | None = None
    colors: np.ndarray | None = None
    point_source: str = ""
    test_every: int = 8
    absent: list[View] = dataclasses.field(default_factory=list)
    test_offset: int = 0

    def split(self, test_every: int | None = None, test_offset: int | None = None) -> tuple[list[View], list[View]]:
        """(train, test) views, both sorted by name, by the rule that `split_rule` names.

        A split that the data set's own files state (`View.split`) wins over both numbers.

        Args:
            test_every: 8 holds out every 8th view, 0 none; the data set's own number if left out.
            test_offset: 2 holds out the 3rd view first; the data set's own number if left out, 0 if `test_every` is
                given alone.
        Raises:
            ValueError: If a number is out of range, or the offset lies beyond the last view.
        """
        train, test = self._rule(test_every, test_offset).parts([*self.views, *self.absent])
        there = {id(view) for view in self.views}
        return [view for view in train if id(view) in there], [view for view in test if id(view) in there]

    def split_rule(self, test_every: int | None = None, test_offset: int | None = None) -> str:
        """The rule of `split` in words, to be recorded with results."""
        return self._rule(test_every, test_offset).words()

    def _rule(self, test_every: int | None, test_offset: int | None) -> SplitRule:
        if test_offset is None:
            test_offset = self.test_offset if test_every is None else 0
        every = self.test_every if test_every is None else test_every
        return SplitRule.of([*self.views, *self.absent], len(self.views), every, test_offset)


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
    names, count = [str(path) for path in missing], len(missing) + left
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
    width, height = image_size(path)
    if (width, height) == (camera.width, camera.height):
        return camera
    if abs(width * camera.height / (height * camera.width) - 1) > _ASPECT_TOLERANCE:
        raise ValueError(
            f"{where}: the image {path} must have the shape of its camera "
            f"({camera.width}x{camera.height}), "
            f"got {width}x{height}; give this view its own intrinsics"
        )
    return camera.resized(width, height)


def _unit_range(data: np.ndarray, path: Path) -> np.ndarray:
    """Image data as float32 in [0,1], by its bit depth."""
    if data.dtype == np.uint8:
        return data.astype(np.float32) / np.float32(255)
    if data.dtype == np.uint16:
        return data.astype(np.float32) / np.float32(65535)
    if data.dtype.kind == "f":
        return np.clip(data.astype(np.float32), 0.0, 1.0)
    raise ValueError(f"{path}: an image must have 8 or 16 bits or floats a channel, got {data.dtype}; convert it")


def _resize_area(data: np.ndarray, width: int, height: int) -> np.ndarray:
    import cv2

    if data.shape[1::-1] == (width, height):
        return np.ascontiguousarray(data)
    shrinks = width <= data.shape[1] and height <= data.shape[0]
    return cv2.resize(data, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _lens_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """OpenCV remap tables of an undistortion (columns, rows) and the pixels (H,W) bool that the
    photo did not see.

    Raises:
        ValueError: the photo saw next to nothing of its own undistorted image.
    """
    *maps, lost = _cached_lens_maps(camera.K.tobytes(), camera.width, camera.height, camera.model, camera.distortion)
    if lost > _LOST_MAX:
        raise ValueError(
            f"view {camera.name!r}: its lens must show what its undistorted image shows, {lost:.0%} of that lie "
            f"outside the photo or where the lens folds back, got {camera.model} {camera.distortion}; "
            "check the coefficients"
        )
    return tuple(maps)


@functools.lru_cache(maxsize=8)
def _cached_lens_maps(
    K: bytes, width: int, height: int, model: str, distortion: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, float]:
    """As `_lens_maps`, and the share of pixels that were not seen."""
    matrix = np.frombuffer(K, dtype=np.float64).reshape(3, 3)
    lens = Camera(K=matrix, w2c=np.eye(4), width=width, height=height, model=model, distortion=distortion)
    rays = lens.undistorted().pixel_directions().reshape(-1, 3)
    pixels = lens.project(rays)[0].reshape(height, width, 2)
    x, y = pixels[..., 0], pixels[..., 1]
    unseen = ~((x > -_BORDER) & (x < width + _BORDER) & (y > -_BORDER) & (y < height + _BORDER))
    # Past the radius where the lens polynomial turns back, rays land on pixels that show something
    # else.
    radius = np.hypot(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]).reshape(height, width)
    probe = np.linspace(0.0, radius.max(), 1024)
    spread = lens.project(np.stack([probe, np.zeros(1024), np.ones(1024)], axis=-1))[0][:, 0]
    folds = np.flatnonzero(np.diff(spread) <= 0)
    if len(folds):
        unseen |= radius > probe[folds[0]]
    lost = float(unseen.mean())
    if lost > _LOST_WARNED:
        _log.warning(
            "lens %s %s: %.0f%% of the undistorted image was not seen by the photo%s; check the coefficients",
            model,
            distortion,
            100 * lost,
            ", the lens folds back inside it" if len(folds) else "",
        )
    # OpenCV counts pixel centers at integers; its tables are float32.
    table = np.clip(np.nan_to_num(pixels - 0.5, nan=-1e6), -1e6, 1e6).astype(np.float32)
    return table[..., 0].copy(), table[..., 1].copy(), unseen if unseen.any() else None, lost
