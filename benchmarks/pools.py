"""Pools of photographs as people leave them, made of captures: near copies, views that look away, blurred copies.

    python benchmarks/pools.py moved DATA FOLDER      three photographs a place, a tenth of which look away
    python benchmarks/pools.py blurred DATA FOLDER    each photograph, and a near copy of it that is blurred

FOLDER becomes a data set (`transforms_train.json`, `transforms_test.json`). Held-out views are every eighth photograph
of DATA, as they are; no copy of one is a candidate. A near copy is what the same camera sees when it is turned by about
two degrees about its center, which is exact: a photograph says what is seen in every direction, whatever its depth. A
view that looks away is a corner of a photograph, a third of its width.

Named before any fit ran: `moved` of every fourth photograph of `bonsai`, `blurred` of `watch`, and `rooftop.mp4` as
`drgs sfm` leaves it, two starts each, with the policies of the race on captures but `blur`, and `random`:

    drgs reproduce captures --protocol blind --seeds 2 --data FOLDER --policy random --policy uniform \
        --policy farthest --policy fisherrf --policy "geometry+backdrop, v_opt" -o OUT

Rows: benchmarks/pools.jsonl; the sentences of docs/next-views.md are made by benchmarks/captures.py.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from drgs.data import View, load

TEST_EVERY = 8
WIDTH = 400  # pixels of what is written: the fits look at 10,800 pixels
TURN = 2.0  # degrees, standard deviation about each axis of the camera
ZOOM = 1.12  # of a near copy, which then sees nothing beyond its photograph's edges, in nearly all
AWAY_EVERY = 10
CORNER = 1 / 3  # of the width and of the height
BLUR = 3.0  # standard deviation in pixels of WIDTH


def photograph(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(H,W,3) uint8 RGB of `WIDTH` pixels, K and w2c of a photograph without its lens."""
    camera = view.camera.undistorted()
    camera = camera.resized(WIDTH, round(WIDTH * camera.height / camera.width))
    image = view.image(camera.width, camera.height)
    return np.round(255 * image).astype(np.uint8), camera.K, camera.w2c


def turned(
    image: np.ndarray, K: np.ndarray, w2c: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the camera sees when it is turned a little about its center."""
    R = cv2.Rodrigues(np.deg2rad(TURN * rng.standard_normal(3)))[0]
    near = K.copy()
    near[:2, :2] *= ZOOM
    centers = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts pixels from the center of the first
    warp = np.linalg.inv(centers) @ near @ R @ np.linalg.inv(K) @ centers
    size = image.shape[1], image.shape[0]
    seen = cv2.warpPerspective(image, warp, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    pose = np.eye(4)
    pose[:3, :3] = R
    return seen, near, pose @ w2c


def corner(
    image: np.ndarray, K: np.ndarray, w2c: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A corner of the photograph, as a photograph of its own."""
    height, width = round(CORNER * image.shape[0]), round(CORNER * image.shape[1])
    left, top = rng.choice([0, image.shape[1] - width]), rng.choice([0, image.shape[0] - height])
    part = K.copy()
    part[:2, 2] -= left, top
    return image[top : top + height, left : left + width], part, w2c


def write(folder: Path, split: str, rows: list[tuple]) -> None:
    """Photographs and cameras of one split."""
    (folder / split).mkdir(parents=True)
    frames = []
    for number, (image, K, w2c) in enumerate(rows):
        name = f"{split}/{number:04d}.png"
        cv2.imwrite(str(folder / name), image[..., ::-1])
        frames.append(
            {
                "file_path": name,
                "fl_x": K[0, 0],
                "fl_y": K[1, 1],
                "cx": K[0, 2],
                "cy": K[1, 2],
                "w": image.shape[1],
                "h": image.shape[0],
                "transform_matrix": (np.linalg.inv(w2c) @ np.diag([1, -1, -1, 1])).tolist(),  # OpenGL axes
            }
        )
    (folder / f"transforms_{split}.json").write_text(json.dumps({"frames": frames}, indent=1) + "\n")


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("moved", "blurred"))
    parser.add_argument("data", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take every n-th photograph only")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    views = sorted(load(args.data, lazy=False).views, key=lambda view: view.name)[:: args.every]
    taken = [photograph(view) for view in views]
    train = [row for number, row in enumerate(taken) if number % TEST_EVERY]
    pool = []
    for number, row in enumerate(train):
        if args.kind == "moved":
            pool += [row, turned(*row, rng), turned(*row, rng)]
            pool += [corner(*row, rng)] * (number % (AWAY_EVERY // 3) == 0)
        else:
            image, K, w2c = turned(*row, rng)
            pool += [row, (cv2.GaussianBlur(image, (0, 0), BLUR), K, w2c)]
    write(args.folder, "train", pool)
    write(args.folder, "test", taken[::TEST_EVERY])
    print(f"{args.folder}: {len(pool)} photographs, {len(taken[::TEST_EVERY])} held out")


if __name__ == "__main__":
    main()
