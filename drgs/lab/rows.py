"""Rows of a cross-validation's report; `dataclasses.asdict` of them is what `crossval.json` holds."""

from __future__ import annotations

import dataclasses

__all__ = ["AlphaRow", "Crop", "ErrorRow", "GroupRow", "OwnRow", "ViewRow", "WorstGaussian", "WorstPixel"]


@dataclasses.dataclass(frozen=True)
class WorstPixel:
    """A pixel where two images differ most."""

    x: int
    y: int
    difference: float


@dataclasses.dataclass(frozen=True)
class AlphaRow:
    """How far alpha is off: root of the mean square, and the mean."""

    rms: float
    bias: float


@dataclasses.dataclass(frozen=True)
class ErrorRow:
    """The place where an image is wrong, and what its error looks like.

    Attributes:
        pixels: Number of pixels that count and differ by more than 0.001.
        box: The smallest rectangle that holds them: x and y of its first and of its last pixel.
        x, y: Column and row of the worst of them.
        rasterizer: RGB of that pixel in the rasterizer's image.
        model: RGB of that pixel in the model's image.
        pattern: One of `drgs.lab.image_errors.PATTERNS`.
        what: The pattern in words, with its numbers.
        explained: Share of the squared error that the pattern explains, or that lies where it says; null for `none`.
    """

    pixels: int
    box: list[int]
    x: int
    y: int
    rasterizer: list[float]
    model: list[float]
    pattern: str
    what: str
    explained: float | None


@dataclasses.dataclass(frozen=True)
class ViewRow:
    """One view's image beside the model's.

    Attributes:
        view: The camera's name, or its number where it has none.
        rms: Root of the mean square of the difference.
        max: Largest difference.
        share: Share of the pixels that differ by more than 0.001.
        alpha: Difference of the alphas.
        near_ties: Number of pixels that do not count.
        worst: Up to five pixels of the largest difference.
        error: Place and look of the error; null where the image is the model's.
    """

    view: str
    rms: float
    max: float
    share: float
    alpha: AlphaRow
    near_ties: int
    worst: list[WorstPixel]
    error: ErrorRow | None = None


@dataclasses.dataclass(frozen=True)
class WorstGaussian:
    """A Gaussian (of `viewmats`: a view) whose gradient is off by most, as a norm."""

    gaussian: int
    difference: float


@dataclasses.dataclass(frozen=True)
class OwnRow:
    """A gradient beside the rasterizer's own central differences.

    Attributes:
        entries: Flat indices of the group's parameters.
        central: Central difference at each of them.
        uncertainty: Error bar of each central difference.
        gradient: The rasterizer's gradient at each of them.
        relative: L2 norm of the error over that of the differences.
        left_out: Number of entries that did not converge.
        bug: Whether the gradient contradicts the differences.
        what: The finding in words.
        pixels_left_out: Number of pixels that jump on one of the steps.
    """

    entries: list[int]
    central: list[float]
    uncertainty: list[float]
    gradient: list[float]
    relative: float
    left_out: int
    bug: bool
    what: str
    pixels_left_out: int


@dataclasses.dataclass
class GroupRow:
    """One parameter group's gradient beside the model's.

    Attributes:
        verdict: One of `crossval.VERDICTS`, None while it is to be explained.
        why: The reason in words.
        worst: Up to five Gaussians of the largest difference.
        relative: L2 norm of the difference over that of the model's gradient.
        cosine: Cosine of the angle between the two gradients.
        bias: How much too long the gradient is along the model's.
        max: Largest difference.
        norm: L2 norm of the model's gradient.
        differences: Central differences that decided, where they were asked for.
    """

    verdict: str | None
    why: str
    worst: list[WorstGaussian]
    relative: float
    cosine: float
    bias: float
    max: float
    norm: float
    differences: OwnRow | None = None

    def settle(self, verdict: str, why: str) -> None:
        """Give it its verdict."""
        self.verdict = verdict
        self.why = why

    def json(self) -> dict:
        """The row as crossval.json holds it, without `differences` where there are none."""
        return {name: x for name, x in dataclasses.asdict(self).items() if name != "differences" or x is not None}


@dataclasses.dataclass(frozen=True)
class Crop:
    """The place of a crop in its view: a corner, its size, and the view's (width, height), in pixels."""

    x: int
    y: int
    width: int
    height: int
    of: list[int]
