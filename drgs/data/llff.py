"""LLFF data sets: `poses_bounds.npy` and the photos in `images`, paired in the order of their
names.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drgs.cameras import Camera, c2w_from_llff, intrinsics
from drgs.cameras.checks import check_handedness
from drgs.data.checks import inverse_pose, read_npy, said_of
from drgs.data.dataset import Dataset
from drgs.data.formats import Format
from drgs.data.images import list_images
from drgs.data.resampling import fit_to_image
from drgs.data.videos import list_videos
from drgs.data.view_checks import make_names_unique
from drgs.data.views import View

POSES_BOUNDS = "poses_bounds.npy"


def load_llff(path: Path, background: tuple[float, float, float] = (0.0, 0.0, 0.0), lazy: bool = False) -> Dataset:
    """Load an LLFF data set: (N,17) rows of a 3x5 matrix [pose | height, width, focal] and two
    depth bounds.

    Args:
        path: The folder, or the `.npy` file.
        background: Color that images with alpha are composited on.
        lazy: Open no image, see `drgs.data.load`.
    Raises:
        FileNotFoundError: No such file, no `images`, or videos in their place whose names do not say their order.
        ValueError: Not an (N,17) array, another number of images, or a pose that is not one.
    """
    file = path if path.is_file() else path / POSES_BOUNDS
    folder = file.parent / "images"
    if (videos := list_videos(file.parent)) and not folder.is_dir():
        raise FileNotFoundError(
            f"{path}: videos of {file.name} must be named cam00.mp4, cam01.mp4, ..., got {videos[0].name}; "
            "rename them in the order of its rows"
        )
    rows = pose_rows(file)
    if not folder.is_dir():
        raise FileNotFoundError(f"{file}: the photos must lie in {folder}, found no such folder; move them there")
    images = list_images(folder)
    if len(images) != len(rows):
        raise ValueError(
            f"{file}: must have one row an image, in the order of their names, got {len(rows)} rows and {len(images)} "
            "images; rows name no image, so that none may be missing: restore them, or drop the rows of missing ones"
        )
    views = []
    for index, (row, image) in enumerate(zip(rows, images, strict=True)):
        where = f"{file}: row {index} ({image.name})"
        camera = row_camera(where, row, image.stem)
        views.append(
            View(
                fit_to_image(camera, image, where, lazy),
                name=image.stem,
                image_path=image,
                background=background,
                is_checked=not lazy,
            )
        )
    make_names_unique(views)
    return Dataset(path, "llff", views)


LLFF = Format(lambda path: (path / POSES_BOUNDS).is_file(), load_llff, (POSES_BOUNDS,), suffix=".npy")


def pose_rows(file: Path) -> np.ndarray:
    """(N, 17) float64 rows of a `poses_bounds.npy`; ValueError if it is none."""
    rows = read_npy(file)
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
        raise ValueError(f"{file}: must have shape (N, 17), got {rows.shape}; this is no LLFF file")
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise ValueError(f"{file}: poses must be finite, got NaN or Inf in row {bad[0]}; remove it and its image")
    # Cameras are float64, whatever the file was saved as.
    return rows.astype(np.float64)


def row_camera(where: str, row: np.ndarray, name: str) -> Camera:
    """The camera of a row (17,), of the size that it states; ValueError if it is none."""
    matrix = row[:15].reshape(3, 5)
    check_handedness(where, matrix[:, :3], "(down, right, backward)", "3 of its 3x5 matrix")
    height, width, focal = matrix[:, 4]
    w2c = inverse_pose(where, c2w_from_llff(matrix))
    with said_of(where):
        K = intrinsics(focal, focal, width / 2, height / 2)
        return Camera(K=K, w2c=w2c, width=width, height=height, name=name)
