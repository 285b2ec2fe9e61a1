"""Views: cameras with images, masks, depth and feature maps and labels, which are read at first use."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import Camera
from drgs.data.checks import read_npy
from drgs.data.images import read_image, unit_range
from drgs.data.masks import read_mask
from drgs.data.resampling import fit_to_image, lens_maps, nearest_resized, resize_area, undistorted_map
from drgs.data.semantics import Semantics, plain_labels
from drgs.data.videos import VideoFrame

if TYPE_CHECKING:
    import torch


@dataclass
class View:
    """One photograph: its camera and where its files are. Nothing is decoded before a method is called.

    Attributes:
        camera: The camera as calibrated, of the size of the image file, lens included.
        name: Unique in the data set; the image's path below the image folder without its suffix.
        image_path, mask_path, depth_path: files, or None. Masks: white is kept. Depth: z-depth, 0
            is unknown.
        relative_depth_path: File of a map that says depth up to scale and shift, as networks do, or None.
        confidence_path: File of a sensor's confidence in its depth, whose lowest level, 0, is unknown depth, or None.
        empty_outside: Whether nothing is where the mask or the alpha channel keeps nothing, unless an option of the fit
            says otherwise: False where other photographs of the data set have neither, and show what is there.
        depth_scale: Scene units in one unit of the depth file.
        background: Color in [0,1] that images with an alpha channel are composited on.
        split: `train`, `val` or `test` where the data set itself says so, else empty.
        label_path: Image of the class of each pixel, or None.
        teacher_path: Feature map of a teacher, or None.
        semantics: What their numbers mean, as in the data set; None without.
        camera_name: Name of the camera that took it, as `cam03`, where a data set has several synchronous cameras;
            else empty.
        frame: The frame of a video, where the photograph is one; `image_path` is None then.
        keeps_lens: Images and what belongs to them are as they were taken, of `camera` itself, not undistorted.
        decode: Decodes the image file, as `drgs.data.images.read_image`; a capture's keeps what it has decoded.
        is_checked: False while the camera's size is what the camera file states and no image has been opened.
    """

    camera: Camera
    name: str
    image_path: Path | None = None
    mask_path: Path | None = None
    depth_path: Path | None = None
    relative_depth_path: Path | None = None
    confidence_path: Path | None = None
    depth_scale: float = 1.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    split: str = ""
    is_checked: bool = True
    label_path: Path | None = None
    teacher_path: Path | None = None
    semantics: Semantics | None = dataclasses.field(default=None, repr=False)
    camera_name: str = ""
    frame: VideoFrame | None = None
    keeps_lens: bool = False
    empty_outside: bool = True
    decode: Callable[[Path], np.ndarray] = dataclasses.field(default=read_image, repr=False, compare=False)

    @property
    def shown_camera(self) -> Camera:
        """The camera of `image`, `mask` and so on, at the size of the photograph."""
        return self.camera if self.keeps_lens else self.camera.undistorted()

    @property
    def _is_bent(self) -> bool:
        """Whether there is a lens to be taken out."""
        return self.camera.is_distorted and not self.keeps_lens

    @property
    def has_image(self) -> bool:
        """Whether there is a photograph to be read, be it a file or a frame of a video."""
        return self.image_path is not None or self.frame is not None

    @property
    def stem(self) -> str:
        """Stem of the names of its maps and labels: the image's name without its suffix, or the number of the frame."""
        return self.name.rpartition("/")[2] if self.image_path is None else self.image_path.stem

    def checked(self) -> View:
        """The view with its camera at the size of its image file, whose header is read now if it has not been.

        Raises:
            FileNotFoundError, ValueError: As `fit_to_image`.
        """
        if self.is_checked or self.image_path is None:
            return self
        camera = fit_to_image(self.camera, self.image_path, f"view {self.name!r}")
        return dataclasses.replace(self, camera=camera, is_checked=True)

    def image(self, width: int | None = None, height: int | None = None) -> np.ndarray:
        """(H,W,3) float32 in [0,1] as stored (no transfer function applied), area-resized.

        It is undistorted unless `keeps_lens`: it belongs to `shown_camera.resized(width, height)`.

        Args:
            width, height: Pixels; the camera's own size if left out.
        Raises:
            FileNotFoundError, ValueError: The file is missing, no image, or not of the camera's
                size.
        """
        return self.image_and_alpha(width, height)[0]

    def image_and_alpha(
        self, width: int | None = None, height: int | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """`image`, and how much of each of its pixels the photograph's own alpha channel covers.

        Args, Raises:
            As `image`.
        Returns:
            (H,W,3) float32, and (H,W) float32 in [0,1]; None if there is no such channel, or it covers everything.
            Pixels of an undistorted image that the photo did not see count as covered.
        """
        import cv2

        if self.frame is not None:
            data = self.frame.read()
            path = self.frame.path
        elif self.image_path is not None:
            data = self.decode(self.image_path)
            path = self.image_path
        else:
            raise ValueError(f"view {self.name!r}: must have an image, has none; drop this view")
        data = unit_range(data, path)
        self._check_size(data, path)
        if data.ndim == 2:
            data = np.repeat(data[..., None], 3, axis=2)
        alpha = None
        if data.shape[2] == 4:
            alpha = data[..., 3]
            data = data[..., :3] * data[..., 3:] + (1 - data[..., 3:]) * np.asarray(self.background, dtype=np.float32)
            alpha = alpha if alpha.min() < 1 else None
        if self._is_bent:
            columns, rows, unseen = lens_maps(self.camera)
            data = cv2.remap(data, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            data = np.clip(data, 0.0, 1.0)  # cubic interpolation overshoots at edges
            if alpha is not None:
                alpha = cv2.remap(alpha, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                alpha = alpha if unseen is None else np.where(unseen, np.float32(1), alpha)
        size = self._size(width, height)
        return resize_area(data, *size), None if alpha is None else resize_area(alpha, *size)

    def mask(self, width: int | None = None, height: int | None = None) -> np.ndarray | None:
        """(H,W) float32 in [0,1], 1 where the image counts; None if all of it does.

        Pixels of an undistorted image that the photo did not see are 0, also where there is no mask file.
        """
        unseen = self._unseen()
        if self.mask_path is None and unseen is None:
            return None
        if self.mask_path is None:
            data = np.ones((self.camera.height, self.camera.width), dtype=np.float32)
        else:
            data = self._nearest(read_mask(self.mask_path), self.mask_path)
        if unseen is not None:
            data = np.where(unseen, np.float32(0), data)
        return resize_area(data, *self._size(width, height)).clip(0, 1)  # averages of ones can be 1 + 1e-7

    def depth(self, width: int | None = None, height: int | None = None) -> np.ndarray | None:
        """(H,W) float32 z-depth in scene units, 0 where unknown, nearest pixel; None if there is no depth map.

        Unknown are numbers that are not positive and finite, and where a map of confidence has 0.

        Raises:
            FileNotFoundError, ValueError: No such file, of several channels, or of another shape than the photo's.
        """
        if self.depth_path is None:
            return None
        # Depths are stored as integers, or as float64 that no picture has the digits of.
        data = _single_channel(self.depth_path, "a depth map").astype(np.float32) * np.float32(self.depth_scale)
        data = self._nearest(np.where(np.isfinite(data) & (data > 0), data, np.float32(0)), self.depth_path)
        if self.confidence_path is not None:
            levels = _single_channel(self.confidence_path, "a map of confidence").astype(np.float32)
            data = np.where(self._nearest(levels, self.confidence_path) > 0, data, np.float32(0))
        return self._at_size(data, 0.0, width, height)

    def relative_depth(self, width: int | None = None, height: int | None = None) -> np.ndarray | None:
        """(H,W) float32 numbers m such that a m + b is the z-depth, or its inverse, for some a and b; NaN where
        unknown, nearest pixel; None if there is no such map.

        Raises:
            FileNotFoundError, ValueError: As `depth`.
        """
        if self.relative_depth_path is None:
            return None
        data = _single_channel(self.relative_depth_path, "a depth map").astype(np.float32)
        data = self._nearest(np.where(np.isfinite(data), data, np.float32(np.nan)), self.relative_depth_path)
        return self._at_size(data, np.nan, width, height)

    def _at_size(self, data: np.ndarray, unknown: float, width: int | None, height: int | None) -> np.ndarray:
        """A depth map at the camera's size at another one, nearest pixel; `unknown` where the photo did not see."""
        import cv2

        if (unseen := self._unseen()) is not None:
            data = np.where(unseen, np.float32(unknown), data)
        # Averaging depths across an edge, or with unknown zeros, would invent surfaces.
        return cv2.resize(data, self._size(width, height), interpolation=cv2.INTER_NEAREST_EXACT)

    def labels(self, width: int | None = None, height: int | None = None) -> np.ndarray | None:
        """(H,W) int64 classes: 0 where there is no label, k for `semantics.classes.names[k - 1]`; undistorted,
        nearest pixel; None if there is no label image.

        Raises:
            FileNotFoundError, ValueError: No label image, another shape than the photo's, or numbers of no class.
        """
        import cv2

        if self.label_path is None:
            return None
        raw = plain_labels(self.label_path)
        if self.semantics is None:  # no data set that says what numbers mean
            labels = np.where(raw == np.iinfo(raw.dtype).max, 0, raw)
        else:
            labels = self.semantics.numbered(raw, self.label_path)
        # OpenCV has no int64; float32 holds all numbers of 16 bits.
        labels = self._nearest(labels.astype(np.float32), self.label_path)
        if (unseen := self._unseen()) is not None:
            labels = np.where(unseen, np.float32(0), labels)
        return cv2.resize(labels, self._size(width, height), interpolation=cv2.INTER_NEAREST_EXACT).astype(np.int64)

    def teacher(self) -> torch.Tensor | None:
        """(C,h,w) feature map of the teacher, float16 or float32, memory-mapped; None if there is none.

        The map covers the undistorted photo, whatever its size. Of a lens, cells are moved as pixels are, bilinearly,
        in memory; cells that the photo did not see repeat its border (`mask` is 0 there). The first use of a file in
        a process looks through it for NaN.

        Raises:
            FileNotFoundError, ValueError: No such map, of other channels than the data set's, or larger than the photo.
        """
        from drgs.features.teacher import used_map

        if self.teacher_path is None:
            return None
        values = used_map(self.teacher_path)
        if self.semantics is not None:
            self.semantics.check_map(values, self.teacher_path, self.camera)
        return undistorted_map(values, self.camera) if self._is_bent else values

    def _unseen(self) -> np.ndarray | None:
        """(H,W) bool: pixels of the undistorted image that the photo did not see; None if it saw all."""
        return lens_maps(self.camera)[2] if self._is_bent else None

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

        data = nearest_resized(data, (self.camera.width, self.camera.height), path)
        if self._is_bent:
            columns, rows, _ = lens_maps(self.camera)
            data = cv2.remap(data, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return data


def _single_channel(path: Path, what: str) -> np.ndarray:
    """(H,W) an image or array file of one channel, as stored."""
    raw = read_npy(path) if path.suffix == ".npy" else read_image(path)
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    if raw.ndim != 2:
        raise ValueError(f"{path}: {what} must have one channel, got shape {raw.shape}; convert it")
    return raw
