"""Pictures of features and labels: three principal components as a color, classes by a table, overlays and legends.

Images are NumPy (H, W, 3), RGB, uint8, as `drgs.display.pictures` writes them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence

import numpy as np
import torch

from drgs.display.pictures import to_bytes
from drgs.features.decoder import Decoder

NO_LABEL = (40, 40, 40)
"""Color of pixels without a label."""
_PERCENTILES = 1.0, 99.0  # of each component, which become 0 and 255: outliers do not take the range
_BASIS_SAMPLES = 5000  # samples of a basis: 20 MB of 512 channels in float64
_INK = (235, 235, 235)  # RGB of a legend's text
_BACKGROUND = (18, 18, 18)  # RGB behind a legend; chosen by eye, like the other colors and sizes
_LINE_HEIGHT = 17  # pixels of a legend's line
_SWATCH = 12  # pixels of its square's side
_MAX_NAME = 34  # characters of a name, at most
_BORDER_DARKENING = 0.35  # how much darker the border between two classes is


@dataclasses.dataclass(frozen=True, eq=False)
class FeatureColors:
    """Three principal components of unit features as red, green and blue: one basis for all pictures of a run.

    Features are divided by their length first, so that the color says what, not how much. Each component goes from its
    1st percentile (0) to its 99th (255).

    Attributes:
        mean: (C,) float32 mean of the unit features.
        axes: (C, 3) float32, orthonormal, by falling variance; the largest entry of each is positive, so that the same
            features always have the same colors.
        low, high: (3,) float32, the percentiles.
    """

    mean: torch.Tensor
    axes: torch.Tensor
    low: torch.Tensor
    high: torch.Tensor

    @classmethod
    def of(cls, maps: Iterable[torch.Tensor], rows: int = _BASIS_SAMPLES) -> FeatureColors:
        """The basis of some maps.

        Args:
            maps: Feature maps (..., C), channels last; of all pixels of one map, evenly spaced ones are taken, and
                features that are 0 or not finite are left out.
            rows: Largest number of samples of a map, and of all maps together.
        Raises:
            ValueError: If there is no feature to look at.
        """
        sample = _sample(maps, rows)
        mean = sample.mean(0)
        covariance = (sample - mean).T @ (sample - mean) / len(sample)
        axes = torch.linalg.eigh(covariance).eigenvectors.flip(1)[:, :3]  # `eigh` sorts by rising variance
        if axes.shape[1] < 3:  # of fewer channels: the others stay in the middle
            axes = torch.nn.functional.pad(axes, (0, 3 - axes.shape[1]))
        largest = axes.gather(0, axes.abs().argmax(0, keepdim=True))
        axes = axes * torch.where(largest < 0, -1.0, 1.0)
        shown = ((sample - mean) @ axes).numpy()
        low, high = (torch.from_numpy(np.percentile(shown, q, axis=0)) for q in _PERCENTILES)
        return cls(*(x.float() for x in (mean, axes, low, high)))

    def picture(self, features: torch.Tensor, decoder: Decoder | None = None) -> np.ndarray:
        """(H, W, 3) uint8 of (H, W, C) features (with a decoder: of (H, W, D) features before it); black where 0."""
        rows = []
        with torch.no_grad():  # a picture needs no gradient; the decoder's graph would keep every row
            for row in features.detach():  # as NumPy wants it below
                decoded = (row if decoder is None else decoder(row.to(decoder.matrix))).cpu().float()
                length = decoded.norm(dim=1, keepdim=True)
                # An empty pixel is 0 / 0, and is left out below.
                parts = (decoded / length.clamp_min(1e-30) - self.mean) @ self.axes
                span = (self.high - self.low).clamp_min(1e-12)  # of one color only, too, there is a span
                rows.append(torch.where(length > 0, (parts - self.low) / span, 0.0))
        return to_bytes(torch.stack(rows).numpy())


def _sample(maps: Iterable[torch.Tensor], rows: int) -> torch.Tensor:
    """(n, C) float64 unit features, at most `rows` of each map and of all; ValueError if there is none."""
    parts = []
    for features in maps:
        flat = features.detach().reshape(-1, features.shape[-1])  # the basis is a choice of colors, no function
        flat = flat[:: max(1, -(-len(flat) // rows))].cpu().float()
        length = flat.norm(dim=1)
        good = torch.isfinite(length) & (length > 0)
        parts.append(flat[good] / length[good][:, None])
    sample = torch.cat(parts) if parts else torch.empty(0, 1)
    if not len(sample):
        raise ValueError("FeatureColors: maps must hold a feature that is finite and not 0, hold none")
    return sample[:: -(-len(sample) // rows)].double()  # eigenvectors of a covariance of nearly equal colors


@functools.cache
def label_colors(count: int) -> np.ndarray:
    """(count + 1, 3) uint8: `NO_LABEL`, then a color for each label; the first of them do not depend on `count`.

    Each color is the one of a grid of the sRGB cube that is farthest, in CIELAB, from all before it, black, white and
    the color of no label included; very dark and very light ones are not taken.
    """
    import cv2

    levels = np.linspace(0, 255, 14).astype(np.uint8)
    grid = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), -1).reshape(-1, 3)
    grid = np.concatenate([np.array([NO_LABEL, (0, 0, 0), (255, 255, 255)], np.uint8), grid])
    lab = cv2.cvtColor(grid[None].astype(np.float32) / 255, cv2.COLOR_RGB2Lab)[0]
    allowed = (lab[:, 0] > 35) & (lab[:, 0] < 92) & (np.hypot(lab[:, 1], lab[:, 2]) < 75)
    distance = np.min([np.linalg.norm(lab - lab[i], axis=1) for i in range(3)], axis=0)
    table = [grid[0]]
    for _ in range(count):
        best = int(np.where(allowed, distance, -1).argmax())
        table.append(grid[best])
        distance = np.minimum(distance, np.linalg.norm(lab - lab[best], axis=1))
    return np.array(table)


def label_picture(labels: np.ndarray, count: int) -> np.ndarray:
    """(H, W, 3) uint8 of (H, W) labels 0..count, by `label_colors`."""
    return label_colors(count)[np.asarray(labels)]


def overlay(image: np.ndarray, labels: np.ndarray, count: int, strength: float = 0.55) -> np.ndarray:
    """The photograph with its labels over it, and dark lines between classes; it stays as it is where there is none.

    Args:
        image: (H, W, 3) photograph, uint8 or float in [0, 1].
        labels: (H, W) labels in 0..count.
        count: Number of classes.
        strength: Share of the labels' colors, in [0, 1].
    """
    labels = np.asarray(labels)
    photo = (image if image.dtype == np.uint8 else to_bytes(image)).astype(np.float32)
    mixed = (1 - strength) * photo + strength * label_picture(labels, count)
    edge = np.zeros(labels.shape, bool)
    edge[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    edge[:-1] |= labels[:-1] != labels[1:]
    mixed = np.where((labels > 0)[..., None], mixed, photo)
    return np.rint(np.where(edge[..., None], (1 - _BORDER_DARKENING) * mixed, mixed)).astype(np.uint8)


def mask_picture(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The picture with the pixels of a mask in orange, and the rest darker and gray.

    Args:
        image: (H, W, 3) picture, uint8 or float in [0, 1].
        mask: (H, W) bool, what is shown in orange.
    """
    photo = (image if image.dtype == np.uint8 else to_bytes(image)).astype(np.float32)
    gray = 0.7 * photo.mean(2, keepdims=True).repeat(3, 2)
    shown = 0.55 * photo + 0.45 * np.array([255, 120, 0], np.float32)
    return np.rint(np.where(mask[..., None], shown, gray)).astype(np.uint8)


def with_legend(picture: np.ndarray, names: Sequence[str], labels: Iterable[int] | None = None) -> np.ndarray:
    """The picture with colors and names of classes at its right, in as many columns as its height requires.

    Args:
        picture: (H, W, 3) uint8 picture.
        names: Names of all classes.
        labels: Labels that are named, e.g. those that occur; default all. 0 is named "no label".
    """
    import cv2

    table = label_colors(len(names))
    shown = sorted(set(range(1, len(names) + 1) if labels is None else map(int, labels)))
    if not shown:
        return picture
    texts = ["no label" if k == 0 else _shortened(names[k - 1]) for k in shown]
    height = max(len(picture), _LINE_HEIGHT + 4)
    lines = (height - 4) // _LINE_HEIGHT
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.4
    columns = []
    for start in range(0, len(shown), lines):
        part = list(zip(shown, texts, strict=True))[start : start + lines]
        wide = max(cv2.getTextSize(text, font, scale, 1)[0][0] for _, text in part)
        column = np.full((height, _SWATCH + wide + 18, 3), _BACKGROUND, np.uint8)
        for row, (k, text) in enumerate(part):
            top = 4 + row * _LINE_HEIGHT
            column[top : top + _SWATCH, 6 : 6 + _SWATCH] = table[k]
            cv2.putText(column, text, (6 + _SWATCH + 5, top + 10), font, scale, _INK, 1, cv2.LINE_AA)
        columns.append(column)
    below = np.full((height - len(picture), picture.shape[1], 3), _BACKGROUND, np.uint8)
    return np.concatenate([np.concatenate([picture, below]), *columns], axis=1)


def _shortened(name: str) -> str:
    """A name as the font draws it: ASCII, and not too long."""
    drawn = "".join(c if " " <= c <= "~" else "?" for c in name)
    return drawn if len(drawn) <= _MAX_NAME else drawn[: _MAX_NAME - 2] + ".."
