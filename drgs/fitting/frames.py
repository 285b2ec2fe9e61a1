"""Photographs at the resolution of a fit: decoded once, undistorted, reduced, with their masks."""

from __future__ import annotations

import dataclasses
import functools
import logging
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch

from drgs import data
from drgs.cameras.sizes import reduced_size
from drgs.data.resampling import resize_area
from drgs.data.synchronous import late_cameras
from drgs.display.progress import Bar

if TYPE_CHECKING:
    from pathlib import Path

    from drgs.cameras import Camera
    from drgs.data import Dataset, View
    from drgs.fitting.config import DataConfig, FitConfig, MaskUse, UndistortUse

_log = logging.getLogger(__name__)

_Map = Callable[[], torch.Tensor]
_Pixels = Callable[[], np.ndarray]

_MOTION_SIZE = 160  # pixels of the longer side at which photographs of two times are compared; chosen, not tuned
_FLOAT_BYTES = 2 << 30  # bytes of all photographs in float32; larger sets are kept as 8 bits, a quarter of it; chosen


@dataclasses.dataclass
class Frame:
    """One photograph at the resolution of the fit.

    Attributes:
        name: The view's.
        camera: Pinhole, of the image's size, named as the view.
        pixels: (H, W, 3) float32 in [0, 1], or uint8.
        mask: (H, W) float32 in [0, 1], or None.
        is_object: Whether nothing but background is outside the mask.
        alpha: (H, W), as `pixels`, how much of each pixel the photograph's own alpha channel covers: nothing but
            background is where it does not; None: there is no such channel, or it is not used.
        transient: (H, W) bool, what no other photograph shows, and the photometric term leaves out; None: nothing.
        teacher: Reads the (C, h, w) map of a teacher, which covers the view at a size of its own; None: there is none.
        labels: Reads the (H, W) int64 labels of the pixels, 0 for none; None: there are none.
        depth: Reads the (H, W) float32 z-depth of a sensor, scene units, 0 where unknown; None: there is none.
        relative_depth: Reads (H, W) float32 z-depth or its inverse up to scale and shift, NaN where unknown; likewise.
    """

    name: str
    camera: Camera
    pixels: torch.Tensor
    mask: torch.Tensor | None = None
    is_object: bool = False
    alpha: torch.Tensor | None = None
    transient: torch.Tensor | None = None
    teacher: _Map | None = None
    labels: _Pixels | None = None
    depth: _Pixels | None = None
    relative_depth: _Pixels | None = None

    def image(self) -> torch.Tensor:
        """(H, W, 3) float32 in [0, 1]."""
        return _as_float(self.pixels)

    def target(self) -> torch.Tensor:
        """`image`, black outside the mask."""
        return self.image() if self.mask is None else self.image() * self.mask[..., None]

    @property
    def is_measurable(self) -> bool:
        """Whether its mask keeps a pixel; one whose mask keeps none has no PSNR."""
        return self.mask is None or bool((self.mask > 0).any())

    def empty(self) -> torch.Tensor | None:
        """(H, W) float32 in [0, 1], how much of each pixel is known to show nothing; None if that is not known."""
        shown = self.mask if self.is_object else None
        if self.alpha is not None:
            alpha = _as_float(self.alpha)
            shown = alpha if shown is None else shown * alpha
        return None if shown is None else 1 - shown

    def object_weights(self) -> torch.Tensor | None:
        """(H, W) float32 in [0, 1], how much of each pixel shows the object; None if it is not known where that is."""
        empty = self.empty()
        if empty is None:
            return None
        return 1 - empty if self.mask is None or self.is_object else (1 - empty) * self.mask


def load_dataset(path: str | os.PathLike, config: FitConfig, **options: Any) -> Dataset:
    """The data set of a fit: with the frames, split and background of its configuration.

    Args:
        path: The data set.
        config: Configuration of the fit.
        options: Others of `drgs.data.load`.
    Raises:
        FileNotFoundError, ValueError: As `drgs.data.load`.
    """
    return data.load(
        path,
        test_every=config.data.test_every,
        test_offset=config.data.test_offset,
        times=config.data.times,
        test_cameras=config.data.test_cameras,
        background=config.settings.background,
        **options,
    )


def frames_for(views: list[View], data: DataConfig, max_pixels: int | None = None) -> list[Frame]:
    """Photographs as a fit with this configuration sees them.

    Args:
        views: Whatever their sizes; those whose image has not been opened yet are checked now.
        data: What of photographs is used, and how.
        max_pixels: Pixels of one image at most, if others than those of the fit.
    """
    return load_frames(views, max_pixels or data.max_pixels, data.mask, data.undistort)


def measurable(frames: list[Frame], where: str) -> list[Frame]:
    """The photographs whose mask keeps a pixel; a warning names the others.

    Args:
        frames: Photographs that something is to be compared with.
        where: Who compares, for the warning.
    """
    if empty := [frame.name for frame in frames if not frame.is_measurable]:
        _log.warning(
            "%s: masks must keep at least one pixel, those of %d of %d views keep none (%s); they are not compared "
            "with anything, mend the masks or drop these views",
            where,
            len(empty),
            len(frames),
            ", ".join(empty),
        )
    return [frame for frame in frames if frame.is_measurable]


def warn_of_late_cameras(dataset: Dataset, frames: list[Frame]) -> None:
    """Warn, by name, of synchronous cameras that seem to have started later or earlier than the others.

    Args:
        dataset: The data set of the frames; without named cameras nothing is done.
        frames: Its photographs, held-out ones included. Cameras that lack some of the times are left out.
    """
    if len(dataset.camera_names) < 2 or len(dataset.times) < 2:
        return
    names = {view.name: view.camera_name for view in dataset.views}
    found: dict[str, dict[float, np.ndarray]] = {name: {} for name in dataset.camera_names}
    for frame in frames:
        scale = min(1.0, _MOTION_SIZE / max(frame.camera.width, frame.camera.height))
        size = (max(1, round(scale * side)) for side in (frame.camera.width, frame.camera.height))
        if frame.camera.time is not None and frame.name in names:
            gray = frame.image().mean(dim=2).numpy()
            found[names[frame.name]][frame.camera.time] = resize_area(gray, *size)
    whole = {
        name: np.stack([pictures[time] for time in dataset.times])
        for name, pictures in found.items()
        if len(pictures) == len(dataset.times)
    }
    numbers = dataset.frames
    spacing = (numbers[-1] - numbers[0]) / (len(numbers) - 1) if len(numbers) > 1 else 1.0
    for camera in late_cameras(whole):
        _log.warning("%s: %s", dataset.path, camera.words(spacing))


def load_frames(
    views: list[View], max_pixels: int, mask: MaskUse = "auto", undistort: UndistortUse = "on"
) -> list[Frame]:
    """Decode, undistort and reduce photographs (area average) to at most `max_pixels` pixels each.

    Args:
        views: Whatever their sizes; those whose image has not been opened yet are checked now.
        max_pixels: Pixels of one image at most; smaller ones keep their size.
        mask: Use of masks, as `DataConfig` has it.
        undistort: Whether lenses are taken out, likewise; `auto`, which a fit decides, is on.
    """
    views = [dataclasses.replace(view, keeps_lens=undistort == "off") for view in views]
    frames = []
    with Bar("photographs", len(views)) as bar:
        views = [view.checked() for view in views]
        sizes = [reduced_size(view.camera, max_pixels) for view in views]
        is_float = sum(12 * w * h for w, h in sizes) <= _FLOAT_BYTES
        store = _as_stored if is_float else _as_bytes
        for view, (width, height) in zip(views, sizes, strict=True):
            image, alpha = view.image_and_alpha(width, height)
            weights = None if mask == "ignore" else view.mask(width, height)
            is_empty = mask == "object" or (mask == "auto" and view.empty_outside)  # outside of a mask or by alpha
            if alpha is not None and mask == "auto" and not is_empty:
                weights = alpha if weights is None else weights * alpha
            frames.append(
                Frame(
                    name=view.name,
                    camera=dataclasses.replace(view.shown_camera.resized(width, height), name=view.name),
                    pixels=store(image),
                    mask=None if weights is None else torch.from_numpy(np.ascontiguousarray(weights)),
                    is_object=mask == "object" or (is_empty and view.mask_path is not None),
                    alpha=store(alpha) if alpha is not None and is_empty else None,
                    teacher=cast("_Map | None", None if view.teacher_path is None else view.teacher),
                    labels=_reader(view.label_path, view.labels, width, height),
                    depth=_reader(view.depth_path, view.depth, width, height),
                    relative_depth=_reader(view.relative_depth_path, view.relative_depth, width, height),
                )
            )
            bar.advance()
    return frames


def _reader(path: Path | None, read: Callable[..., Any], width: int, height: int) -> _Pixels | None:
    """Reads a map of a view at the size of the fit, when it is called; None if there is no file."""
    return None if path is None else functools.partial(read, width, height)


def _as_float(pixels: torch.Tensor) -> torch.Tensor:
    """Numbers in [0, 1] of pixels as they are stored."""
    return pixels if pixels.dtype == torch.float32 else pixels.float() / 255


def _as_stored(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image))


def _as_bytes(image: np.ndarray) -> torch.Tensor:
    """8 bits of numbers in [0, 1]."""
    return (torch.from_numpy(image) * 255).round().to(torch.uint8)
