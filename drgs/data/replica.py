"""Replica as Semantic-NeRF renders it: `rgb/rgb_N.png`, `depth/depth_N.png`, a pose a line in `traj_w_c.txt`.

What Semantic-NeRF's own code says (Zhi et al., ICCV 2021; SSR/datasets/replica, SSR/training/trainer.py,
SSR/models/rays.py and SSR/data_generation of its repository): frames are in the order of their numbers, frame N has the
N-th pose; a pose is camera-to-world, 4x4, with x right, y down and z forward; the horizontal field of view is 90
degrees, pixels are square, and the principal point (W - 1) / 2, (H - 1) / 2 counts pixel centers at integers: it is the
middle of the image; depth is z-depth in millimeters; `semantic_class/semantic_class_N.png` has Replica's class
numbers, 1 to 101 with gaps, 0 for none. Their names are in `info_semantic.json` of the scene's `habitat` folder, to
be copied beside `rgb`. Semantic-NeRF trains on frames 0, 5, 10, ... of 900 and tests on 2, 7, 12, ....
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from drgs.cameras import Camera, intrinsics
from drgs.data.checks import inverse_pose, read_text, repaired_pose, said_of
from drgs.data.dataset import Dataset
from drgs.data.formats import Format
from drgs.data.images import IMAGE_SUFFIXES, image_size, is_damaged
from drgs.data.view_checks import report_missing_images
from drgs.data.views import View

POSES = "traj_w_c.txt"
_FIELD_OF_VIEW = 90.0  # degrees across the width
_MILLIMETER = 1e-3  # meters, in which Replica has its scenes
_LARGEST = 1 << 27  # bytes; 900 poses take 0.3 MB
_FRAME = re.compile(r"rgb_(\d{1,9})")


def load_replica(
    path: Path,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    test_every: int = 8,
    test_offset: int = 0,
    lazy: bool = False,
    strict: bool = False,
) -> Dataset:
    """Load a sequence of Replica. Views are named by their numbers, with as many digits as the last one has, so that
    their names sort as they were taken: `rgb_002` for `rgb_2.png` of 900.

    Args:
        path: The sequence's folder, as `room_0/Sequence_1`.
        background: Color that images with alpha are composited on.
        test_every, test_offset, lazy, strict: See `drgs.data.load`. Lazily, all views get the size of the first
            training image.
    Raises:
        FileNotFoundError: No poses, no `rgb` folder, or no images in it, or too few that are not damaged.
        ValueError: Poses that are none, or an image beyond them.
    """
    poses = _poses(path / POSES)
    folder = path / "rgb"
    if not folder.is_dir():
        raise FileNotFoundError(f"{path}: must hold the photos in a folder `rgb`, found none; move them there")
    frames = {}
    for file in sorted(folder.iterdir()):
        found = _FRAME.fullmatch(file.stem)
        if found and file.suffix.lower() in IMAGE_SUFFIXES:
            number = int(found[1])
            if number in frames:
                raise ValueError(f"{file}: must be the only frame {number}, {frames[number].name} is too; remove one")
            frames[number] = file
    if not frames:
        raise FileNotFoundError(f"{folder}: must hold images named rgb_0.png, rgb_1.png, ..., found none; rename them")
    last = max(frames)
    if last >= len(poses):
        raise ValueError(
            f"{frames[last]}: frame {last} must have a pose, {path / POSES} has {len(poses)} from frame 0 on; "
            "number frames from 0"
        )
    digits = len(str(len(poses) - 1))
    dataset = Dataset(path, "replica", [])
    numbers = []  # of the views
    for number in sorted(frames):
        view = View(None, f"rgb_{number:0{digits}d}", image_path=frames[number])
        if not lazy and is_damaged(frames[number]):
            dataset.absent.append(view)
            continue
        dataset.views.append(view)
        numbers.append(number)
    report_missing_images(folder, [view.image_path for view in dataset.absent], len(dataset.views), strict)
    first = dataset.split(test_every, test_offset)[0][0] if lazy else None
    size = image_size(first.image_path) if first else None
    for number, view in zip(numbers, dataset.views, strict=True):
        width, height = size or image_size(view.image_path)
        where = f"{path / POSES}: pose {number}"
        focal = 0.5 * width / math.tan(math.radians(_FIELD_OF_VIEW / 2))
        K = intrinsics(focal, focal, width / 2, height / 2)
        w2c = inverse_pose(where, repaired_pose(poses[number]))
        with said_of(where):
            view.camera = Camera(K, w2c, width, height, name=view.name)
        depth = path / "depth" / f"depth_{_FRAME.fullmatch(view.image_path.stem)[1]}.png"
        view.depth_path = depth if depth.is_file() else None
        view.depth_scale = _MILLIMETER
        view.background = background
        view.is_checked = not lazy
    return dataset


REPLICA = Format(lambda path: (path / POSES).is_file(), load_replica, (POSES,))


def _poses(file: Path) -> np.ndarray:
    """(N, 4, 4) camera-to-world."""
    words = read_text(file, "a list of poses", _LARGEST).split()
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError:
        raise ValueError(f"{file}: must hold numbers, 16 a pose, got other words; copy it again") from None
    if not len(numbers) or len(numbers) % 16:
        raise ValueError(f"{file}: must hold 16 numbers a pose, got {len(numbers)}; it is cut short, copy it again")
    poses = numbers.reshape(-1, 4, 4)
    wrong = np.flatnonzero(~np.isclose(poses[:, 3], (0, 0, 0, 1)).all(axis=1))
    if len(wrong):
        raise ValueError(
            f"{file}: pose {wrong[0]} must end in 0 0 0 1, got {' '.join(f'{x:g}' for x in poses[wrong[0], 3])}; "
            "write 4x4 matrices, camera to world, by rows"
        )
    return poses
