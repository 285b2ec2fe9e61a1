"""Labels from features: the class whose text embedding is nearest, and how often that is right.

Labels are int64: 0 is no label, k is class k (1-based), `Classes.names[k - 1]`. `SCORE_DEFINITIONS` says exactly what
each number of `scores` is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch

from drgs.checks.arguments import kind_of
from drgs.features.decoder import Decoder

__all__ = ["SCORE_DEFINITIONS", "Classes", "classify", "cosines", "scores"]

SCORE_DEFINITIONS = {
    "pixel_accuracy": "share of the labelled pixels of all images whose predicted class is the reference's",
    "class_accuracy": "that share (recall) for each class that the reference has, averaged over these classes",
    "miou": "intersection over union, counted over all images, averaged over the classes that the reference has",
    "miou_top7": (
        "of each image the average IoU of the 7 labels that are most frequent in prediction and reference together, "
        "averaged over images (the rule of Feature 3DGS; of equally frequent labels the smaller number first)"
    ),
    "iou": "intersection over union of each class over all images; none where the reference does not have the class",
}
_TOP_LABELS = 7  # labels, Feature 3DGS's own number
_CHUNK = 1 << 22  # numbers that a step holds: 16 MB of float32, 8,192 pixels of 512 channels


@dataclasses.dataclass(frozen=True, eq=False)
class Classes:
    """Names of classes, with their text embeddings if any.

    Attributes:
        names: Names of classes 1..K; class k is `names[k - 1]`.
        embeddings: (K, C) float32 rows of length 1, the names in the teacher's space; whatever lengths are given are
            divided out. None: names only.
    """

    names: tuple[str, ...]
    embeddings: torch.Tensor | None = None

    def __post_init__(self) -> None:
        names = tuple(self.names)
        if isinstance(self.names, str) or not names or not all(isinstance(name, str) and name for name in names):
            raise ValueError(f"Classes: names must be texts, one or more, got {kind_of(self.names)}; name each class")
        object.__setattr__(self, "names", names)
        if self.embeddings is not None:
            rows = unit_rows(self.embeddings, "Classes: embeddings")
            if len(rows) != len(names):
                raise ValueError(
                    f"Classes: embeddings must have a row for each of the {len(names)} names, got {len(rows)}; "
                    "make both from one list"
                )
            object.__setattr__(self, "embeddings", rows)

    def __len__(self) -> int:
        return len(self.names)

    def labels_of(self, name: str) -> tuple[int, ...]:
        """The labels of a name, case aside; several where several classes are called alike.

        Raises:
            ValueError: If there is none; all names are listed.
        """
        wanted = name.strip().casefold()
        found = tuple(k for k, known in enumerate(self.names, 1) if known.strip().casefold() == wanted)
        if not found:
            raise ValueError(f"class {name!r}: must be one of {', '.join(self.names)}; correct it")
        return found

    def vectors(self, channels: int) -> torch.Tensor:
        """The embeddings.

        Args:
            channels: Number of channels that they must have.
        Raises:
            ValueError: If there are none, or they have another number of channels.
        """
        if self.embeddings is None:
            raise ValueError("classes: must have text embeddings, have names only; add text_embeddings.npy to the data")
        if self.embeddings.shape[1] != channels:
            raise ValueError(
                f"classes: text embeddings must have the features' {channels} channels, got "
                f"{self.embeddings.shape[1]}; take both from one teacher"
            )
        return self.embeddings


def unit_rows(vectors: torch.Tensor, where: str) -> torch.Tensor:
    """(K, C) float32 of length 1 each, from (K, C) of any floating type.

    Raises:
        ValueError: If it is no such matrix, or a row is 0 or not finite (the first one is named).
    """
    if not isinstance(vectors, torch.Tensor) or vectors.ndim != 2 or not vectors.is_floating_point():
        raise ValueError(f"{where} must be a (K, C) tensor of floats, got {kind_of(vectors)}; give a row for each text")
    if 0 in vectors.shape:
        raise ValueError(f"{where} must have rows and channels, got shape {tuple(vectors.shape)}; give one at least")
    rows = vectors.detach().cpu().double()  # values, not a function of what they were computed from
    lengths = rows.norm(dim=1)
    bad = ~(torch.isfinite(lengths) & (lengths > 0))
    if bool(bad.any()):
        first = int(bad.nonzero()[0])
        raise ValueError(f"{where} must be finite and not 0, row {first} is not; make it again")
    return (rows / lengths[:, None]).float()


def classify(features: torch.Tensor, classes: Classes, decoder: Decoder | None = None) -> torch.Tensor:
    """The class of the largest cosine.

    The length of a feature has no say in which cosine is largest, so that with a decoder E (W f + b) = (E W) f + E b
    is all that is computed: K numbers a pixel, never C. Of 128 features, 512 channels and 18 classes that takes a ninth
    of the time of decoding first.

    Args:
        features: (..., C) in the teacher's space; with a decoder (..., D) before it.
        classes: Classes that have embeddings.
        decoder: Decoder of D features to C.
    Returns:
        (...) int64 labels 1..K, on the CPU; of equal cosines the smaller label.
    Raises:
        ValueError: If widths differ, or a feature is not finite.
    """
    channels = features.shape[-1] if decoder is None else decoder.channels
    matrix = classes.vectors(channels)
    offset = None
    if decoder is not None:
        _check_width("classify", features, decoder.width)
        # A label has no derivative; with the weights' graph every chunk of scores would be kept until the end.
        weight, bias = (x.detach().cpu().float() for x in (decoder.matrix, decoder.bias))
        matrix, offset = matrix @ weight, matrix @ bias
    parts = []
    for chunk in _chunks(features, max(matrix.shape)):
        score = torch.nn.functional.linear(chunk, matrix, offset)
        _check_finite("classify", score)
        parts.append(score.argmax(1) + 1)
    return torch.cat(parts).reshape(features.shape[:-1])


def cosines(features: torch.Tensor, vectors: torch.Tensor, decoder: Decoder | None = None) -> torch.Tensor:
    """Cosine of every feature with every vector.

    Args:
        features: (..., C) features; with a decoder the (..., D) features before it.
        vectors: (K, C) vectors, of any length but 0.
        decoder: Decoder of D features to C, applied to a few pixels at a time.
    Returns:
        (..., K) float32 on the CPU; 0 where a feature is 0.
    Raises:
        ValueError: If widths differ, or a feature is not finite.
    """
    channels = features.shape[-1] if decoder is None else decoder.channels
    rows = unit_rows(vectors, "cosines: vectors")
    if rows.shape[1] != channels:
        raise ValueError(f"cosines: vectors must have the features' {channels} channels, got {rows.shape[1]}")
    if decoder is not None:
        _check_width("cosines", features, decoder.width)
    parts = []
    with torch.no_grad():  # values alone: cosines are shown, not differentiated
        for chunk in _chunks(features, max(channels, *rows.shape)):
            decoded = chunk if decoder is None else decoder(chunk.to(decoder.matrix)).cpu().float()
            _check_finite("cosines", decoded)
            # torch's own 1e-12 would shorten features that are merely small; 0 stays 0.
            parts.append(torch.nn.functional.normalize(decoded, dim=1, eps=1e-30) @ rows.T)
    return torch.cat(parts).reshape(*features.shape[:-1], len(rows))


def _chunks(features: torch.Tensor, numbers: int) -> Iterator[torch.Tensor]:
    """Rows of (n, C) float32, so few at a time that `numbers` of each make no more than `_CHUNK`."""
    flat = features.detach().reshape(-1, features.shape[-1])  # labels and cosines that are shown have no derivative
    step = max(1, _CHUNK // max(numbers, 1))
    for start in range(0, max(len(flat), 1), step):  # of no rows, too, there is one part
        yield flat[start : start + step].cpu().float()


def _check_width(where: str, features: torch.Tensor, width: int) -> None:
    if features.shape[-1] != width:
        raise ValueError(
            f"{where}: features must have the decoder's {width} channels, got {features.shape[-1]}; take both from one "
            "run"
        )


def _check_finite(where: str, values: torch.Tensor) -> None:
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{where}: features must be finite, some are not; look at where they come from")


def scores(pairs: Iterable[tuple[Any, Any]], classes: int) -> dict[str, Any]:
    """How well predicted labels agree with reference labels, from one confusion matrix over all images.

    Pixels where the reference is 0 are left out. A prediction of 0 where the reference has a label is wrong.

    Args:
        pairs: Pairs of label maps (predicted, reference) of one shape, integers in 0..classes; an image at a time, so
            that they may be made on the way. What the reference is (labels of the data set, or a teacher's) the caller
            says.
        classes: Number K of classes.
    Returns:
        JSON-serializable: the entries of `SCORE_DEFINITIONS` (`iou` a list of K), and `images` and `pixels`, how many
        there were with a label.
    Raises:
        ValueError: If shapes differ, a label is out of range, or no pixel of any reference has a label.
    """
    confusion = np.zeros((classes + 1, classes + 1), np.int64)  # reference x predicted
    tops = []
    for index, (predicted, reference) in enumerate(pairs):
        one = _confusion(np.asarray(predicted), np.asarray(reference), classes, index)
        if one.any():
            tops.append(_top(one))
            confusion += one
    if not tops:
        raise ValueError("scores: the reference must label a pixel of an image, labels none; check the labels")
    right, union, present = _overlaps(confusion)
    recall = right[present] / confusion.sum(1)[1:][present]
    iou = right[present] / union[present]
    each: list[float | None] = [None] * classes
    for k, value in zip(present.nonzero()[0], iou, strict=True):
        each[k] = float(value)
    return {
        "pixel_accuracy": float(right.sum() / confusion.sum()),
        "class_accuracy": float(recall.mean()),
        "miou": float(iou.mean()),
        "miou_top7": float(np.mean(tops)),
        "iou": each,
        "images": len(tops),
        "pixels": int(confusion.sum()),
    }


def _confusion(predicted: np.ndarray, reference: np.ndarray, classes: int, index: int) -> np.ndarray:
    """(K + 1, K + 1) counts, reference x predicted, of the labelled pixels of an image."""
    if predicted.shape != reference.shape:
        raise ValueError(
            f"scores: image {index}: prediction and reference must have one shape, got {predicted.shape} and "
            f"{reference.shape}; resize the prediction"
        )
    for name, labels in (("prediction", predicted), ("reference", reference)):
        if not np.issubdtype(labels.dtype, np.integer):
            raise ValueError(f"scores: image {index}: the {name} must hold integers, got {labels.dtype}")
        if labels.size and not 0 <= labels.min() <= labels.max() <= classes:
            bad = labels.max() if labels.max() > classes else labels.min()
            raise ValueError(f"scores: image {index}: labels of the {name} must be in [0, {classes}], got {bad}")
    known = reference > 0
    pairs = reference[known].astype(np.int64) * (classes + 1) + predicted[known]
    return np.bincount(pairs, minlength=(classes + 1) ** 2).reshape(classes + 1, classes + 1)


def _overlaps(confusion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intersection and union of each class, and whether the reference has it, (K,) each."""
    right = np.diagonal(confusion)[1:]
    of_reference = confusion.sum(1)[1:]
    return right, of_reference + confusion.sum(0)[1:] - right, of_reference > 0


def _top(confusion: np.ndarray) -> float:
    """The average IoU of the labels of an image that are most frequent in prediction and reference together."""
    right, union, _ = _overlaps(confusion)
    often = confusion.sum(1)[1:] + confusion.sum(0)[1:]
    top = np.argsort(-often, kind="stable")[:_TOP_LABELS]  # stable: of equally frequent labels the smaller number first
    top = top[often[top] > 0]
    return float((right[top] / union[top]).mean())
