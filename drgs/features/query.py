"""Search by text: a score for every Gaussian, and every pixel, by its decoded feature.

Two scores, named with every result:

    cosine        the largest cosine with a positive; what reaches the threshold is selected
    probability   of the positives together, by a softmax of cosines / temperature over them and the negatives;
                  what reaches the threshold is selected, or without one, where a positive has the largest cosine
                  of all, whatever the temperature

Feature 3DGS takes a softmax without a temperature: cosines differ by tenths, so that its probabilities are nearly alike
and its thresholds (0.198 for five names) say little. CLIP multiplies its cosines by 100 before the softmax that it is
trained with; that is the temperature 0.01 here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch

from drgs.features.decoder import Decoder
from drgs.features.segmentation import Classes, cosines, unit_rows

TEMPERATURE = 0.01
"""1 / 100, CLIP's own (Radford et al. 2021, section 2.5)."""
_SAME_MEANING = 0.999  # cosine from which on a class means the same as a positive, and is no negative; chosen


@dataclasses.dataclass(frozen=True, eq=False)
class TextQuery:
    """Text embeddings that are searched for (positives), and those of other classes (negatives).

    Attributes:
        positives: (Q, C) float32 vectors of length 1.
        negatives: (O, C) vectors alike, or None: the score is the cosine, not the probability.
        threshold: Least score that is selected; None: the largest cosine of all must be that of a positive.
        temperature: Temperature of the softmax.
    """

    positives: torch.Tensor
    negatives: torch.Tensor | None = None
    threshold: float | None = None
    temperature: float = TEMPERATURE

    def __post_init__(self) -> None:
        object.__setattr__(self, "positives", unit_rows(self.positives, "query: the wanted vectors"))
        if self.negatives is not None:
            object.__setattr__(self, "negatives", unit_rows(self.negatives, "query: the other vectors"))
            if self.negatives.shape[1] != self.channels:
                raise ValueError(
                    f"query: what is wanted must have the {self.negatives.shape[1]} channels of the classes, got "
                    f"{self.channels}; take both from one text encoder"
                )
        if self.threshold is None and self.negatives is None:
            raise ValueError("query: a threshold must be given where nothing else competes; choose a cosine")
        low = -1.0 if self.negatives is None else 0.0
        if self.threshold is not None and not low <= self.threshold <= 1:
            raise ValueError(
                f"query: the threshold of a {self.score_name} must be in [{low:g}, 1], got {self.threshold}; correct it"
            )
        if not (math.isfinite(self.temperature) and self.temperature > 0):
            raise ValueError(f"query: the temperature must be a number > 0, got {self.temperature}; correct it")

    @classmethod
    def of_classes(
        cls,
        classes: Classes,
        names: Sequence[str],
        threshold: float | None = None,
        temperature: float = TEMPERATURE,
    ) -> TextQuery:
        """Some of the classes against all others; of all classes by the cosine.

        Raises:
            ValueError: If a name is no class's (all are listed), or the classes have no embeddings.
        """
        labels = {label for name in names for label in classes.labels_of(name)}
        if classes.embeddings is None:
            raise ValueError("query: the classes must have text embeddings, have names only; use --text-embedding")
        rows = [label - 1 for label in sorted(labels)]
        others = [k for k in range(len(classes)) if k not in rows]
        negatives = classes.embeddings[others] if others else None
        return cls(classes.embeddings[rows], negatives, threshold, temperature)

    @classmethod
    def of_vectors(
        cls,
        vectors: torch.Tensor,
        classes: Classes | None = None,
        threshold: float | None = None,
        temperature: float = TEMPERATURE,
    ) -> TextQuery:
        """Text embeddings: with a threshold by their cosine; without one against the classes.

        Args:
            vectors: (C,) or (Q, C) text embeddings.
            classes: Classes that compete, but for those that mean the same (cosine >= 0.999).
            threshold, temperature: Fields of a `TextQuery`.
        Raises:
            ValueError: If there is neither a threshold nor a class that competes.
        """
        positives = unit_rows(vectors[None] if vectors.ndim == 1 else vectors, "query: text embeddings")
        if threshold is not None:
            return cls(positives, None, threshold, temperature)
        if classes is None or classes.embeddings is None:
            raise ValueError(
                "query: --threshold must be given, as there are no classes with embeddings to compare with; choose a "
                "cosine"
            )
        negatives = classes.vectors(positives.shape[1])
        negatives = negatives[(negatives @ positives.T).amax(1) < _SAME_MEANING]
        if not len(negatives):
            raise ValueError("query: --threshold must be given, every class means the same; choose a cosine")
        return cls(positives, negatives, None, temperature)

    @property
    def channels(self) -> int:
        """C of the vectors."""
        return self.positives.shape[1]

    @property
    def score_name(self) -> str:
        """`cosine` or `probability`."""
        return "cosine" if self.negatives is None else "probability"

    @property
    def rule(self) -> str:
        """The rule of selection, in words."""
        if self.negatives is None:
            return f"cosine >= {self.threshold:g}"
        if self.threshold is None:
            return f"largest cosine of {len(self.positives) + len(self.negatives)} texts"
        count = len(self.positives) + len(self.negatives)
        return f"probability >= {self.threshold:g} (softmax over {count} texts, temperature {self.temperature:g})"

    def score(self, features: torch.Tensor, decoder: Decoder | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """The score of each feature, and whether it is selected.

        Args:
            features: (..., C) features; with a decoder the (..., D) features before it.
            decoder: Decoder of D features to C.
        Returns:
            (...) float32 and (...) bool, on the CPU.
        Raises:
            ValueError: If widths differ, or a feature is not finite.
        """
        channels = features.shape[-1] if decoder is None else decoder.channels
        if channels != self.channels:
            what = "decoded features"
            advice = "take those of the teacher's own text encoder"
            if decoder is None:
                what = "features, which no decoder was given for"
                advice = "name theirs (--decoder), or other texts"
            raise ValueError(
                f"query: text embeddings must have the {channels} channels of the {what}, got {self.channels}; {advice}"
            )
        count = len(self.positives)
        if self.negatives is None:
            score = cosines(features, self.positives, decoder).amax(-1)
            assert self.threshold is not None  # or it would have been refused
            return score, score >= self.threshold
        found = cosines(features, torch.cat([self.positives, self.negatives]), decoder)
        score = torch.softmax(found / self.temperature, -1)[..., :count].sum(-1)
        if self.threshold is not None:
            return score, score >= self.threshold
        return score, found[..., :count].amax(-1) > found[..., count:].amax(-1)
