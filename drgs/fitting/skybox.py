"""What is far away, or nothing that has a place: Gaussians on a shell around the scene, fitted with the others.

Where rays end in nothing near, in the sky or far behind the scene, initial points are guesses at the distance of what
is triangulated beside them, and a fit with a small budget paints each photograph's background in the air before its
camera. Here a part of the budget begins on a shell, `RADIUS` extents of the scene away, in the directions that training
photographs look in, opaque, overlapping, with the median color of the photographs there. Hierarchical 3D Gaussians [1]
have such a skybox of points. They are Gaussians as all others: every renderer and every viewer of the PLY shows them.

Gaussians of equal distance change places from view to view, and `inria` and `gsplat` order by z where others order by
distance. So distances are spread over a factor of two: neighbors on the shell keep their order.

Means stay by their distance: a rate in units of the extent moves them by less than a tenth of it in a whole fit. The
terms of the loss that keep Gaussians small and let them fade leave them out, or one of their scales would outweigh
those of all others; density control neither moves nor copies them.

Whether the scene needs it shows in the fit: which part of the light that reaches the cameras comes from behind the
other Gaussians. `auto` looks once, in the middle, and takes the shell away where it shows next to nowhere.

Reference:
    [1] Kerbl et al., "A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very Large Datasets",
        ACM TOG 2024.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.ellipsoids import Y_00
from drgs.integrator import render

if TYPE_CHECKING:
    from drgs.data import View
    from drgs.ellipsoids import Gaussians
    from drgs.fitting.frames import Frame
    from drgs.fitting.rows import GaussianRows
    from drgs.settings import RenderSettings

__all__ = ["RADIUS", "SHARE", "Skybox", "Visible", "line_of", "visible_share", "why_not"]

RADIUS = 100.0
"""Distance of the nearest of them from the middle of the cameras, in extents of the scene."""

SHARE = 0.1
"""Their part of the budget of Gaussians."""

_FARTHEST = 2.0  # distance of the farthest, in those of the nearest
_OPACITY = 0.9
_WIDTH = 0.75  # of their scales, in the mean distance of neighbors: less than 2 % of the light passes between them
_MARGIN = 0.05  # of the longer side of a picture, beyond its border: directions that held-out views may look in
_DRAWN = 4_000  # directions over the whole sphere, of which the part that photographs look in is counted
_LOOK = 0.5  # of the steps, when it is decided
_OPEN = 0.5  # transmittance of the others from which on the shell is what a pixel shows
_CLEAR = 0.1  # share of pixels of all photographs: 0.40 of `statue`, 0.02 of `fern`


@dataclasses.dataclass(frozen=True)
class Skybox:
    """Gaussians of a shell, in directions that photographs look in.

    Attributes:
        means: (K, 3) float64 world.
        colors: (K, 3) float32 in [0, 1]: of each channel the median over the photographs that look there.
        scales: (K,) float64 standard deviations, of all three axes.
    """

    means: np.ndarray
    colors: np.ndarray
    scales: np.ndarray

    @classmethod
    def around(cls, frames: list[Frame], extent: float, count: int, seed: int = 0) -> Skybox:
        """About `count` Gaussians, evenly over the directions that photographs look in.

        Args:
            frames: Training photographs, at least one; what is outside of their masks has no color.
            extent: Extent of the scene.
            count: How many at most.
            seed: Seed of the distances.
        """
        middle = np.stack([frame.camera.center for frame in frames]).mean(axis=0)
        radius = RADIUS * extent
        looked_at = _seen(frames, middle + radius * _directions(_DRAWN)).any(axis=0)
        whole = max(1, int(count * _DRAWN / max(1, int(looked_at.sum()))))
        directions = _directions(whole)
        directions = directions[_seen(frames, middle + radius * directions).any(axis=0)][:count]
        distances = radius * np.exp(np.random.default_rng(seed).uniform(0, math.log(_FARTHEST), len(directions)))
        means = middle + distances[:, None] * directions
        spacing = math.sqrt(4 * math.pi / whole)
        return cls(means, _colors(frames, means), distances * spacing * _WIDTH)

    def __len__(self) -> int:
        return len(self.means)

    def rows(self, features: int = 0) -> dict[str, torch.Tensor]:
        """Rows for `GaussianRows`, with `features` channels of features that are 0."""
        count = len(self)
        quats = torch.zeros(count, 4)
        quats[:, 0] = 1
        return {
            "means": torch.from_numpy(self.means).float(),
            "quats": quats,
            "log_scales": torch.from_numpy(self.scales).log().float()[:, None].repeat(1, 3),
            "logit_opacities": torch.full((count,), math.log(_OPACITY / (1 - _OPACITY))),
            "sh_dc": ((torch.from_numpy(self.colors).float() - 0.5) * (1 / Y_00))[:, None, :],
            "sh_rest": torch.zeros(count, 0, 3),
            **({"features": torch.zeros(count, features)} if features else {}),
        }


@dataclasses.dataclass(frozen=True)
class Visible:
    """How much of photographs shows the shell.

    Attributes:
        share: Of the pixels of all photographs, those behind whose other Gaussians more than half of the light is left.
        largest: The largest share of one photograph.
    """

    share: float
    largest: float

    @property
    def is_clear(self) -> bool:
        """Whether the scene needs the shell."""
        return self.share > _CLEAR


def is_due(done: int, max_steps: int) -> bool:
    """Whether `auto` is decided before step `done`."""
    return done == round(_LOOK * max_steps) and done > 0


def visible_share(rows: GaussianRows, frames: list[Frame], settings: RenderSettings) -> Visible:
    """How much of photographs shows the shell of rows: what is left of the light behind all others.

    Args:
        rows: Gaussians, the shell first.
        frames: Photographs; nothing outside of their masks is counted.
        settings: What the others are rendered with.
    """
    others: Gaussians = rows.gaussians().detach().take(slice(rows.skybox, None))
    others = others.replace(features=None)
    shares, weights = [], []
    with torch.no_grad():  # looked at, not optimized
        for frame in frames:
            is_open = (1 - render(others, frame.camera, settings, outputs=()).alpha > _OPEN).float()
            mask = torch.ones_like(is_open) if frame.mask is None else frame.mask
            weights.append(float(mask.sum()))
            shares.append(float((is_open * mask).sum()) / max(weights[-1], 1.0))
    return Visible(float(np.average(shares, weights=np.maximum(weights, 1e-9))), max(shares))


def line_of(event: dict) -> str:
    """What `auto` has decided, in one line."""
    said = (
        f"the sky shows in {100 * event['share']:.1f} % of the pixels of training photographs, up to "
        f"{100 * event['largest']:.1f} % of one (clear from {100 * _CLEAR:g} % on)"
    )
    return f"{said}: {event['gaussians']} Gaussians of it stay" if event["found"] else f"{said}: taken away"


def why_not(views: list[View], frames: list[Frame], background: tuple[float, float, float]) -> str | None:
    """What of a data set says what is behind everything, in words; None: nothing does, and there may be a shell.

    Args:
        views: Training views, whose images are opened.
        frames: The same as photographs.
        background: Color that is behind the Gaussians.
    """
    if any(frame.is_object and frame.mask is not None for frame in frames):
        return "masks say that nothing is behind the object"
    if any(view.has_alpha() for view in views):
        return "an alpha channel says where nothing is"
    if any(background):
        return "the background has a color that is stated"
    return None


def _directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors evenly over the sphere: a Fibonacci lattice."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def _seen(frames: list[Frame], points: np.ndarray) -> np.ndarray:
    """(V, P) which photographs look at which points, a little beyond their borders, too."""
    seen = np.zeros((len(frames), len(points)), bool)
    for row, frame in enumerate(frames):
        size = np.array([frame.camera.width, frame.camera.height])
        pixels, depth = frame.camera.project(points)
        margin = _MARGIN * size.max()
        seen[row] = (depth > 0) & ((pixels > -margin) & (pixels < size + margin)).all(axis=1)
    return seen


def _colors(frames: list[Frame], points: np.ndarray) -> np.ndarray:
    """(P, 3) median colors of photographs at far points; of those that none shows, the color of the nearest one."""
    found = np.ma.masked_all((len(frames), len(points), 3), np.float32)
    for row, frame in enumerate(frames):
        pixels, depth = frame.camera.project(points)
        inside = (depth > 0) & ((pixels >= 0) & (pixels < (frame.camera.width, frame.camera.height))).all(axis=1)
        index = np.flatnonzero(inside)
        columns, lines = pixels[index].astype(int).T
        if frame.mask is not None:
            kept = frame.mask.numpy()[lines, columns] > 0.5
            index, columns, lines = index[kept], columns[kept], lines[kept]
        found[row, index] = frame.image().numpy()[lines, columns]
    has_color = ~np.ma.getmaskarray(found).any(axis=2).all(axis=0)
    colors = np.full((len(points), 3), 0.5, np.float32)
    if not has_color.any():
        return colors
    colors[has_color] = np.ma.median(found[:, has_color], axis=0).filled(0.5)
    middle = np.stack([frame.camera.center for frame in frames]).mean(axis=0)
    directions = points - middle
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for row in np.flatnonzero(~has_color):
        colors[row] = colors[has_color][np.argmax(directions[has_color] @ directions[row])]
    return colors
