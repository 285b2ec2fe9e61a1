"""The figure of a study: what each policy's fit makes of one test view, and the truth: color, features, labels."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from drgs.display import pictures
from drgs.features.pictures import FeatureColors, label_picture
from drgs.features.segmentation import classify
from drgs.fitting.frames import Frame, frames_for, load_dataset
from drgs.fitting.records import LoadedRun, load_run
from drgs.integrator import render
from drgs.io.run import Run

_WIDTH = 300  # pixels of a column, about; chosen, as the numbers below
_ZOOM = 0.5  # of the width and the height of a view: the part that is enlarged
_GAP = 6  # pixels between pictures
_FRAME = (255, 200, 0)  # RGB of the frame around the part that is enlarged
_NONE = np.zeros((1, 1, 3), np.uint8)


@dataclasses.dataclass
class _Picture:
    """One row: (H, W, 3) colors, and features and labels, as far as there are any."""

    name: str
    color: np.ndarray
    features: torch.Tensor | None = None
    labels: np.ndarray | None = None


def comparison_sheet(runs: Mapping[str, Path], path: Path) -> str:
    """Write the figure: policies by row, the truth last; the middle one of the test views, and of a part of it color,
    features and labels.

    The part is where the fits differ most from each other, of half the width and height. Features are shown by the
    three principal components of the teacher's map of this view; where it has none, of the first fit's.

    Args:
        runs: What a row is called -> run folder, all of one data set and one split.
        path: The PNG.
    Returns:
        The name of the view.
    Raises:
        ValueError: If there is no run.
    """
    if not runs:
        raise ValueError("comparison_sheet: there must be a run, got none")
    loaded = {name: load_run(Run(folder)) for name, folder in runs.items()}
    frame, count = _frame(next(iter(loaded.values())))
    rows = [_rendered(name, run, frame) for name, run in loaded.items()]
    truth = _Picture("truth", frame.target().numpy())
    truth.features = None if frame.teacher is None else frame.teacher().permute(1, 2, 0).float()
    truth.labels = None if frame.labels is None else np.asarray(frame.labels())
    maps = [x.features for x in (truth, *rows) if x.features is not None]
    colors = FeatureColors.of(maps[:1]) if maps else None  # one basis for all rows
    box = _differing([row.color for row in rows])
    shown = [_row(row, box, colors, count) for row in (*rows, truth)]
    width = max(line.shape[1] for line in shown)
    padded = [np.pad(line, ((0, _GAP), (0, width - line.shape[1]), (0, 0))) for line in shown]
    pictures.write_png(path, np.concatenate(padded))
    return frame.name


def _frame(run: LoadedRun) -> tuple[Frame, int]:
    """The test view, and how many classes there are."""
    record, config = run.record, run.record.config
    test = load_dataset(record.data, config, lazy=True, points=False).split()[1]
    frame = frames_for([test[len(test) // 2].checked()], config.data)[0]
    return frame, len(run.classes) if run.classes is not None else 0


def _rendered(name: str, run: LoadedRun, frame: Frame) -> _Picture:
    with torch.no_grad():
        out = render(run.scene.at(frame.camera.time), frame.camera, run.record.config.settings)
    shown = _Picture(name, out.rgb.cpu().clamp(0, 1).numpy())
    if out.features is not None and run.decoder is not None:
        rows = [run.decoder(row.to(run.decoder.matrix)).cpu().float() for row in out.features.detach()]
        shown.features = torch.stack(rows)
        if run.classes is not None:
            shown.labels = classify(out.features, run.classes, run.decoder).numpy()
    return shown


def _differing(images: Sequence[np.ndarray]) -> tuple[int, int, int, int]:
    """(top, left, height, width) of the part of half a view's size in which the images differ most."""
    spread = np.stack(images).std(0).sum(-1) if len(images) > 1 else np.ones(images[0].shape[:2])
    height, width = (max(1, round(_ZOOM * side)) for side in spread.shape)
    total = np.pad(spread, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    top, left = np.unravel_index(int(sums.argmax()), sums.shape)
    return int(top), int(left), height, width


def _row(row: _Picture, box: tuple[int, int, int, int], colors: FeatureColors | None, classes: int) -> np.ndarray:
    """The view with a frame around the part, and the part's pictures."""
    height, width = row.color.shape[:2]
    whole = _enlarged(pictures.to_bytes(row.color), (0, 0, height, width))
    scale = whole.shape[1] / width
    top, left, bottom, right = (round(scale * x) for x in (box[0], box[1], box[0] + box[2], box[1] + box[3]))
    for line in (slice(top, top + 2), slice(bottom - 2, bottom)):
        whole[line, left:right] = _FRAME
    for line in (slice(left, left + 2), slice(right - 2, right)):
        whole[top:bottom, line] = _FRAME
    parts = [pictures.caption(whole, row.name), pictures.caption(_enlarged(pictures.to_bytes(row.color), box), "color")]
    if colors is not None:
        drawn = _NONE if row.features is None else _resized(colors.picture(row.features), (height, width))
        parts.append(pictures.caption(_enlarged(drawn, box), "features"))
    if classes:
        drawn = _NONE if row.labels is None else _resized(label_picture(row.labels, classes), (height, width))
        parts.append(pictures.caption(_enlarged(drawn, box), "labels"))
    tallest = max(part.shape[0] for part in parts)
    return np.concatenate([np.pad(p, ((0, tallest - p.shape[0]), (0, _GAP), (0, 0))) for p in parts], axis=1)


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture of another resolution at that of the view, its pixels kept."""
    import cv2

    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_NEAREST)


def _enlarged(image: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
    """A part of a picture as wide as a column."""
    import cv2

    top, left, height, width = box
    part = (
        image[top : top + height, left : left + width] if image.shape[0] > 1 else np.zeros((height, width, 3), np.uint8)
    )
    size = (_WIDTH, max(1, round(_WIDTH * height / width)))
    return cv2.resize(np.ascontiguousarray(part), size, interpolation=cv2.INTER_NEAREST)
