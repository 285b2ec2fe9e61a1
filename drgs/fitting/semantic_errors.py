"""How wrong the labels and the decoded features of a run are expected to be: records of their errors in the views that
it was fitted to, for `drgs.information.expected_error`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.display.progress import Bar
from drgs.fitting.segments import segmentation_of
from drgs.information.expected_error import ErrorRecord, expected_error, residual_record
from drgs.integrator import render

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene
    from drgs.features.decoder import Decoder
    from drgs.fitting.frames import Frame
    from drgs.fitting.records import LoadedRun

_CHANNELS = 32  # channels that are decoded at once; chosen


def label_record(loaded: LoadedRun, frames: Sequence[Frame]) -> ErrorRecord:
    """What training views say about wrong labels.

    A pixel's residual is 1 where the label of the run, as `drgs eval` draws it, is not that of the data set, or where
    this labels none of the frames, not that of the teacher's map, whose own errors count then. Pixels without a label
    have no say. A prediction without Gaussians has the most frequent label everywhere.

    Args:
        loaded: A run with a decoder and embeddings of its classes.
        frames: The views that it was fitted to.
    Raises:
        ValueError: If the run draws no labels, or no pixel of the frames has any to compare with.
    """
    semantics, classes = loaded.record.semantics, loaded.classes
    names = ("", "") if semantics is None else (semantics.labels, semantics.teacher)
    segmentation = segmentation_of(loaded.gaussians, loaded.decoder, classes, *names, list(frames))
    if isinstance(segmentation, str):
        raise ValueError(f"label_record: {segmentation}")
    assert classes is not None  # a run without has been refused
    counts = np.zeros(len(classes) + 1, np.int64)
    residuals, masks = [], []
    with Bar("labels", len(frames)) as bar:
        for frame in frames:
            found = segmentation.labels(_features(loaded, frame.camera))
            reference = segmentation.reference_of(frame)
            reference = np.zeros_like(found) if reference is None else reference
            counts += np.bincount(reference.ravel(), minlength=len(counts))
            residuals.append(torch.from_numpy(found != reference).float())
            masks.append(torch.from_numpy(reference > 0).float())
            bar.advance()
    empty = 1 - float(counts[1:].max() / max(1, counts[1:].sum()))
    cameras, settings = [frame.camera for frame in frames], loaded.record.config.settings
    return residual_record(loaded.scene, cameras, residuals, empty, settings, masks=masks)


def wrong_label(scene: Scene, camera: Camera, record: ErrorRecord) -> torch.Tensor:
    """(H, W) float32 in [0, 1]: the probability that is expected of a pixel's label to be wrong.

    Args:
        scene, camera: The same as for `drgs.expected_error`.
        record: Of labels, by `label_record`.
    """
    return expected_error(scene, camera, record).clamp(max=1)  # from new directions the sum may be above 1


def feature_record(loaded: LoadedRun, frames: Sequence[Frame]) -> ErrorRecord:
    """What training views say about errors of decoded features: squared differences from the teacher's maps, mean over
    channels. Views without a map have no say. A prediction without Gaussians is 0.

    Args:
        loaded: A run with a decoder.
        frames: The views that it was fitted to.
    Raises:
        ValueError: If the run has no decoder, or no frame a map.
    """
    decoder = loaded.decoder
    if decoder is None or not any(frame.teacher is not None for frame in frames):
        raise ValueError("feature_record: must have a run with a decoder and views with a teacher's maps; name others")
    residuals, masks, squares = [], [], []
    with Bar("features", len(frames)) as bar:
        for frame in frames:
            size = (frame.camera.height, frame.camera.width)
            mask = torch.ones(size) if frame.mask is None else frame.mask
            if frame.teacher is None:
                residuals.append(torch.zeros(size))
                masks.append(torch.zeros(size))
            else:
                residuals.append(feature_residual(_features(loaded, frame.camera), frame, decoder))
                masks.append(mask)
                squares.append(float(frame.teacher().float().square().mean()))
            bar.advance()
    cameras, settings = [frame.camera for frame in frames], loaded.record.config.settings
    return residual_record(loaded.scene, cameras, residuals, float(np.mean(squares)), settings, masks=masks)


def feature_residual(features: torch.Tensor, frame: Frame, decoder: Decoder) -> torch.Tensor:
    """(H, W) squared differences of decoded features from the teacher's map, mean over channels.

    Args:
        features: (H, W, D), rendered.
        frame: A view with a map, which is interpolated bilinearly, cells covering areas.
        decoder: Decoder of the features.
    """
    assert frame.teacher is not None  # the caller has looked
    size = (frame.camera.height, frame.camera.width)
    total = torch.zeros(size)
    with torch.no_grad():  # a map is a number a pixel
        map_of_teacher = frame.teacher().float()
        for channels in torch.arange(decoder.channels).split(_CHANNELS):
            decoded = torch.nn.functional.linear(features, decoder.matrix[channels], decoder.bias[channels])
            shown = torch.nn.functional.interpolate(map_of_teacher[None, channels], size, mode="bilinear")[0]
            total += (decoded.permute(2, 0, 1) - shown).square().sum(0)
    return total / decoder.channels


def _features(loaded: LoadedRun, camera: Camera) -> torch.Tensor:
    """(H, W, D) rendered features, on the CPU."""
    with torch.no_grad():  # a map is a number a pixel
        features = render(loaded.scene, camera, loaded.record.config.settings, outputs=()).features
    assert features is not None  # a run with a decoder has some
    return features.cpu()
