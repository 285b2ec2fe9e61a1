"""What a run says of each pixel of a view, against labels: those of the data set, else those that its teacher gives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.display.pictures import to_bytes, write_png
from drgs.display.progress import Bar
from drgs.features.pictures import FeatureColors, label_picture, overlay, with_legend
from drgs.features.segmentation import SCORE_DEFINITIONS, Classes, classify, scores

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians
    from drgs.features.decoder import Decoder
    from drgs.fitting.frames import Frame

_KEPT_MASK = 0.5  # mask, or opacity of a Gaussian, from which on a pixel or the Gaussian counts
_MOST_SAMPLES = 20_000  # Gaussians whose features give the principal components of pictures, at most; chosen, not tuned


class Segmentation:
    """The labels of a run's views and of their reference, one view after the other.

    Attributes:
        reference: `labels` of the data set, or `teacher`.
        folder: Folder of these in the data set.
    """

    def __init__(self, gaussians: Gaussians, decoder: Decoder, classes: Classes, reference: str, folder: str) -> None:
        self.reference = reference
        self.folder = folder
        self._gaussians = gaussians
        self._decoder = decoder
        self._classes = classes
        self._colors: FeatureColors | None = None
        self._run: list[tuple[np.ndarray, np.ndarray]] = []
        self._teacher: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, frame: Frame, features: torch.Tensor) -> dict[str, float | None]:
        """Take a view.

        Args:
            frame: The photograph, with labels or a teacher's map; where it has no reference, it does not count.
            features: (H, W, D), rendered.
        Returns:
            Of this view alone, as `SCORE_DEFINITIONS` says: `pixel_accuracy` and `miou`, None without reference.
        """
        found = self.labels(features)
        reference = self.reference_of(frame)
        if reference is None or not reference.any():
            return {"pixel_accuracy": None, "miou": None}
        pair = found.astype(np.int16), reference.astype(np.int16)
        self._run.append(pair)
        if self.reference == "labels" and frame.teacher is not None:
            self._teacher.append((self._of_teacher(frame).astype(np.int16), pair[1]))
        one = scores([pair], len(self._classes))
        return {name: one[name] for name in ("pixel_accuracy", "miou")}

    def labels(self, features: torch.Tensor) -> np.ndarray:
        """(H, W) int64 labels of rendered features (H, W, D)."""
        return classify(features, self._classes, self._decoder).numpy()

    def result(self) -> dict[str, Any]:
        """All views together.

        Returns:
            JSON-serializable: `reference`, `folder`, `classes` (names), `run` and, on the same views where all have
            maps, `teacher` (`drgs.features.segmentation.scores`; None where there is nothing to compare), `variants`.
        """
        count = len(self._classes)
        whole = len(self._teacher) == len(self._run) > 0
        return {
            "reference": self.reference,
            "folder": self.folder,
            "classes": list(self._classes.names),
            "run": scores(self._run, count) if self._run else None,
            "teacher": scores(self._teacher, count) if whole else None,
            "variants": dict(SCORE_DEFINITIONS),
        }

    def write(self, path: Path, frame: Frame, features: torch.Tensor) -> None:
        """A picture of a view: labels of the run, of the reference, the features, and labels over the photograph."""
        self._colors = self._colors or feature_colors(self._gaussians, self._decoder)
        found, reference = self.labels(features), self.reference_of(frame)
        count = len(self._classes)
        shown = np.zeros_like(found) if reference is None else reference
        photo = to_bytes(frame.image().numpy())
        panels = [
            label_picture(found, count),
            label_picture(shown, count),
            self._colors.picture(features, self._decoder),
            overlay(photo, found, count),
        ]
        seen = np.union1d(np.unique(found), np.unique(shown))
        write_png(path, with_legend(np.concatenate(panels, axis=1), self._classes.names, seen))

    def reference_of(self, frame: Frame) -> np.ndarray | None:
        """(H, W) int64 labels to compare with, 0 outside the mask; None where the view has none."""
        if self.reference == "labels":
            labels = None if frame.labels is None else frame.labels()
        else:
            labels = None if frame.teacher is None else self._of_teacher(frame)
        if labels is None or frame.mask is None:
            return labels
        return np.where(frame.mask.numpy() < _KEPT_MASK, 0, labels)

    def _of_teacher(self, frame: Frame) -> np.ndarray:
        assert frame.teacher is not None  # the caller has looked
        return teacher_labels(frame.teacher(), self._classes, frame.camera.width, frame.camera.height)


def segmentation_of(
    gaussians: Gaussians,
    decoder: Decoder | None,
    classes: Classes | None,
    labels: str,
    teacher: str,
    frames: list[Frame],
) -> Segmentation | str:
    """What to measure of frames: against the data set's labels if any of them has some, else against the teacher's.

    Args:
        gaussians: Gaussians with features; those of a scene that moves are at rest.
        decoder, classes: Decoder and classes of the run.
        labels, teacher: Names of the folders of labels and of a teacher's maps in its data set.
        frames: That will be measured.
    Returns:
        In words why it cannot be measured, if it cannot.
    """
    if decoder is None or gaussians.features is None:
        return "only the PLY of the run could be read, which has no decoder: restore state.safetensors"
    if classes is None or classes.embeddings is None:
        return "the run has no text embeddings of its classes: add text_embeddings.npy and classes.json to the data set"
    if any(frame.labels is not None for frame in frames):
        return Segmentation(gaussians, decoder, classes, "labels", labels)
    if any(frame.teacher is not None for frame in frames):
        return Segmentation(gaussians, decoder, classes, "teacher", teacher)
    return "no view has labels or a map of the teacher"


def check_references(frames: list[Frame]) -> None:
    """Read labels and maps that labels are measured against: what is wrong with them is not found after the last step.

    Raises:
        FileNotFoundError, ValueError: As `drgs.data.views.View.labels` and `teacher`.
    """
    with Bar("labels and maps of held-out views", len(frames)) as bar:
        for frame in frames:
            for read in (frame.labels, frame.teacher):
                if read is not None:
                    read()
            bar.advance()


def teacher_labels(values: torch.Tensor, classes: Classes, width: int, height: int) -> np.ndarray:
    """What a teacher's map says of each pixel.

    The class of the largest cosine after the features have been interpolated bilinearly, cells covering areas; as the
    length of a feature has no say, K scores are interpolated instead of C channels.

    Args:
        values: (C, h, w).
        classes: Classes with embeddings.
        width, height: Size of the view in pixels.
    Returns:
        (H, W) int64, 1..K.
    """
    channels, h, w = values.shape
    score = classes.vectors(channels) @ values.float().reshape(channels, h * w)
    planes = score.reshape(1, -1, h, w)
    return torch.nn.functional.interpolate(planes, (height, width), mode="bilinear").argmax(1)[0].numpy() + 1


def feature_colors(gaussians: Gaussians, decoder: Decoder | None) -> FeatureColors:
    """Colors of the features of all views alike: of the Gaussians themselves, those that can be seen above all.

    Args:
        gaussians: Gaussians with features.
        decoder: Decoder of the features; None where they are shown as they are.
    """
    assert gaussians.features is not None
    with torch.no_grad():  # for pictures
        opaque = (gaussians.opacities > _KEPT_MASK).nonzero()[:, 0]
        kept = opaque if len(opaque) > 3 else torch.arange(len(gaussians))
        kept = kept[:: -(-len(kept) // _MOST_SAMPLES)]
        sample = gaussians.features[kept].float()
        return FeatureColors.of([sample if decoder is None else decoder(sample)])
