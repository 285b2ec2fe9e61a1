"""What is far away, or nothing that has a place: Gaussians on a shell around the scene, fitted with the others.

Where rays end in nothing near, in the sky or far behind the scene, initial points are guesses at the distance of what
is triangulated beside them, and a fit with a small budget paints each photograph's background in the air before its
camera. Here a part of the budget begins on a shell, `RADIUS` extents of the scene away, in the directions that training
photographs look in, opaque, overlapping, with the median color of the photographs there. Hierarchical 3D Gaussians [1]
have such a skybox of points. They are Gaussians as all others: every renderer shows them, and viewers of the PLY up to
their far plane.

Gaussians of equal distance change places from view to view, and `inria` and `gsplat` order by z where others order by
distance. So distances are spread over a factor of two: neighbors on the shell keep their order.

Means stay where they are by their distance: their rate, in units of the extent, moves them by about one extent at most
in 30,000 steps, where they are a hundred away. The terms of the loss that keep Gaussians small and let them fade leave
them out, or one of their scales would outweigh those of all others; density control neither moves nor copies them.

Whether there is anything far shows in the photographs before the fit: what is far has the same color in all of them
along a direction, wherever they were taken from, and what is near has not. How much light passes between Gaussians does
not show it: the first ones of `statue`, whose park is far, leave nothing open, and those of `banana`, a carpet that
points cover sparsely, leave most of it open, where a shell does harm.

Reference:
    [1] Kerbl et al., "A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very Large Datasets",
        ACM TOG 2024.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.data import scene_extent
from drgs.display.progress import Bar
from drgs.ellipsoids import Y_00, Gaussians
from drgs.fitting.components.base import Component, Conflict, Fit, Setup
from drgs.information.quantity import opacity_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drgs.fitting.frames import Frame
    from drgs.settings import RenderSettings

_log = logging.getLogger("drgs.train")

RADIUS = 100.0
"""Distance of the nearest of them from the middle of the cameras, in extents of the scene: over a camera's way of one
extent they move by half a degree. Chosen, not tuned."""

SHARE = 0.1
"""Their share of `max_gaussians`; chosen, not tuned."""

_FARTHEST_RATIO = 2.0  # distance of the farthest over that of the nearest: neighbors keep their order in depth; chosen
_OPACITY = 0.9  # at the start: nothing is behind them; below 1, so that its logit has a gradient; chosen
# Standard deviation over the mean distance of neighbors: some percent of the light pass between them.
_SCALE_RATIO = 0.75
_MARGIN = 0.05  # of the longer side of a picture, beyond its border: directions that held-out views may look in
# Directions over the sphere whose share in photographs is counted; four times as many until enough are.
_DIRECTIONS_FIRST = 4_000
_MOST_DIRECTIONS = 1 << 20  # of these: 25 a square degree; chosen
_POINTS_AT_ONCE = 1 << 18  # directions that are projected at once: 6 MB of float64 points
_COLORS_AT_ONCE = 1 << 25  # bytes of the colors of all photographs at some points; a median takes several times that
_ENOUGH_DIRECTIONS = 200  # directions in photographs for which their share is right within some percent
# Directions in photographs that are assumed, at least, where even the most drawn ones give fewer.
_FEWEST_DIRECTIONS = 20
_MEASURED_VIEWS = 8  # photographs, at most, whose share of skybox is measured at the end; chosen for its seconds
_OPEN_TRANSMITTANCE = 0.5  # transmittance of the other Gaussians from which on a pixel shows mostly the shell
_COMPARED_DIRECTIONS = 800  # directions in which colors are compared: the share is right within 2 %
_FEWEST_VIEWS = 3  # photographs that must look in a direction, so that a median is of more than two
_BLUR = 0.012  # radius of the mean that is compared, in widths of a picture: the parallax that is left, and details
_SAME_COLOR = 0.03  # of the range of colors: largest median deviation from the median color of what is far; chosen
# Share of directions beyond chance: 0.48 of `statue`, which gains 3 dB by a shell; 0.21, 0.07 and 0.00 of `rooftop` (13
# photographs, few points), `fern` and `banana`, which lose 1.4, gain nothing and lose 5.
_CLEAR_SHARE = 0.25


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
        drawn = _DIRECTIONS_FIRST
        # A narrow lens looks in few directions of the whole sphere: more are drawn until there are enough to count.
        while (
            looked_at := len(_looked_at(frames, middle, radius, drawn))
        ) < _ENOUGH_DIRECTIONS and drawn < _MOST_DIRECTIONS:
            drawn *= 4
        whole = max(1, count * drawn // max(looked_at, _FEWEST_DIRECTIONS))
        directions = _looked_at(frames, middle, radius, whole)
        if len(directions) > count:  # evenly fewer: the lattice runs from pole to pole
            directions = directions[np.linspace(0, len(directions) - 1, count).round().astype(int)]
        distances = radius * np.exp(np.random.default_rng(seed).uniform(0, math.log(_FARTHEST_RATIO), len(directions)))
        means = middle + distances[:, None] * directions
        spacing = math.sqrt(4 * math.pi / whole)
        return cls(means, _colors(frames, means), distances * spacing * _SCALE_RATIO)

    def __len__(self) -> int:
        return len(self.means)

    def rows(self, origin: np.ndarray | None = None) -> dict[str, torch.Tensor]:
        """Rows for `GaussianRows`, whose means are relative to `origin` (3,); None for 0."""
        count = len(self)
        quats = torch.zeros(count, 4)
        quats[:, 0] = 1
        return {
            "means": torch.from_numpy(self.means if origin is None else self.means - origin).float(),
            "quats": quats,
            "log_scales": torch.from_numpy(self.scales).log().float()[:, None].repeat(1, 3),
            "logit_opacities": torch.full((count,), math.log(_OPACITY / (1 - _OPACITY))),
            "sh_dc": ((torch.from_numpy(self.colors).float() - 0.5) * (1 / Y_00))[:, None, :],
            "sh_rest": torch.zeros(count, 0, 3),
        }


@dataclasses.dataclass(frozen=True)
class FarEvidence:
    """What photographs say of whether something is far away.

    Attributes:
        seen: Share of the directions that photographs look in, those that at least three of them look in.
        agreeing: Share of these directions, those in which photographs show the same color.
        chance: The same share where every photograph's colors are shuffled among its directions.
    """

    seen: float
    agreeing: float
    chance: float

    @property
    def share(self) -> float:
        """Share of all directions in which photographs agree as they do not by chance."""
        return self.seen * max(0.0, self.agreeing - self.chance)

    @property
    def is_clear(self) -> bool:
        """Whether there is clearly something far away."""
        return self.share > _CLEAR_SHARE

    def words(self) -> str:
        """What was found, in one line."""
        return (
            f"photographs agree on what is far away in {100 * self.share:.1f} % of their directions (clear above "
            f"{100 * _CLEAR_SHARE:g} %; {100 * self.seen:.0f} % are seen three times, {100 * self.agreeing:.0f} % of "
            f"these agree, by chance {100 * self.chance:.0f} %)"
        )

    def to_json(self) -> dict[str, float]:
        """The evidence as config.json has it."""
        return {"share": self.share, **dataclasses.asdict(self)}


@dataclasses.dataclass(frozen=True)
class SkyboxChoice:
    """Whether a fit begins with a shell, and why.

    Attributes:
        reason: Why there is none, in words; None where there is one.
        evidence: Agreement of the photographs; None where they were not compared.
    """

    reason: str | None
    evidence: FarEvidence | None = None

    def to_json(self, gaussians: int) -> dict[str, Any]:
        """The choice as config.json has it, with a shell of so many Gaussians."""
        return {
            "gaussians": gaussians,
            "reason": self.reason,
            **({} if self.evidence is None else self.evidence.to_json()),
        }


def far_evidence(frames: list[Frame], extent: float, seed: int = 0) -> FarEvidence:
    """Whether photographs show the same color wherever they look in one direction.

    Args:
        frames: Training photographs, at least one; pixels outside of their masks are not used.
        extent: Extent of the scene.
        seed: Seed of the shuffling that shows what chance is.
    """
    points = Skybox.around(frames, extent, _COMPARED_DIRECTIONS, seed).means
    colors = _colors_seen(frames, points, _BLUR)
    there = ~np.isnan(colors[..., 0])
    many = there.sum(axis=0) >= _FEWEST_VIEWS
    if not many.any():
        return FarEvidence(0.0, 0.0, 0.0)
    shuffled = np.full_like(colors, np.nan)
    rng = np.random.default_rng(seed)
    for row in range(len(frames)):
        index = np.flatnonzero(there[row])
        shuffled[row, index] = colors[row, rng.permutation(index)]
    agreeing, chance = (float((_deviation(x[:, many]) < _SAME_COLOR).mean()) for x in (colors, shuffled))
    return FarEvidence(float(many.sum() / there.any(axis=0).sum()), agreeing, chance)


def visible_share(gaussians: Gaussians, far: int, frames: list[Frame], settings: RenderSettings) -> float:
    """Share of the pixels of photographs that show the shell: behind all others more than half of the light is left.

    Args:
        gaussians: Gaussians, `far` of a shell first.
        frames: Photographs; nothing outside of their masks is counted.
        settings: What the others are rendered with.
    """
    others = gaussians.detach().take(slice(far, None))
    shown = total = 0.0
    with Bar("what shows of the skybox", len(frames)) as bar:
        for frame in frames:
            alpha = opacity_of(others, frame.camera, settings)
            mask = torch.ones_like(alpha) if frame.mask is None else frame.mask
            shown += float(((1 - alpha > _OPEN_TRANSMITTANCE) * mask).sum())
            total += float(mask.sum())
            bar.advance()
    return shown / max(total, 1.0)


def why_not(frames: list[Frame], background: tuple[float, float, float]) -> str | None:
    """What of a data set says what is behind everything, in words; None: nothing does, and there may be a shell.

    Args:
        frames: Training photographs.
        background: Color that is behind the Gaussians.
    """
    if any(frame.is_object and frame.mask is not None for frame in frames):
        return "masks say that nothing is behind the object"
    if any(frame.alpha is not None for frame in frames):
        return "an alpha channel says where nothing is"
    if any(background):
        return "the background has a color that is stated"
    return None


def _looked_at(frames: list[Frame], middle: np.ndarray, radius: float, whole: int) -> np.ndarray:
    """(P, 3) those of `whole` directions evenly over the sphere that photographs look in, of points at a distance."""
    kept = []
    for first in range(0, whole, _POINTS_AT_ONCE):
        directions = _directions(whole, first, min(first + _POINTS_AT_ONCE, whole))
        kept.append(directions[_seen(frames, middle + radius * directions)])
    return np.concatenate(kept)


def _directions(count: int, first: int, end: int) -> np.ndarray:
    """(end - first, 3) some of `count` unit vectors evenly over the sphere: a Fibonacci lattice."""
    index = np.arange(first, end) + 0.5
    z = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def _seen(frames: list[Frame], points: np.ndarray) -> np.ndarray:
    """(P,) which points a photograph looks at, a little beyond its borders, too."""
    seen = np.zeros(len(points), bool)
    for frame in frames:
        pixels, depth = frame.camera.project(points)
        seen |= frame.camera.contains(pixels, depth, -_MARGIN * max(frame.camera.width, frame.camera.height))
    return seen


def _colors_seen(frames: list[Frame], points: np.ndarray, blur: float = 0.0) -> np.ndarray:
    """(V, P, 3) colors of photographs at far points, NaN where a photograph or its mask does not show them; means over
    a radius of `blur` widths of the picture.
    """
    import cv2

    colors = np.full((len(frames), len(points), 3), np.nan, np.float32)
    for row, frame in enumerate(frames):
        image = frame.image().numpy()
        if blur:
            image = cv2.GaussianBlur(image, (0, 0), blur * frame.camera.width)
        pixels, depth = frame.camera.project(points)
        index = np.flatnonzero(frame.camera.contains(pixels, depth))
        columns, lines = pixels[index].astype(int).T
        if frame.mask is not None:
            kept = frame.mask.numpy()[lines, columns] > 0.5
            index, columns, lines = index[kept], columns[kept], lines[kept]
        colors[row, index] = image[lines, columns]
    return colors


def _deviation(colors: np.ndarray) -> np.ndarray:
    """(P,) median over photographs of the largest channel's distance from the median color, of (V, P, 3) colors of
    which each point has one at least.
    """
    apart = np.abs(colors - np.nanmedian(colors, axis=0)).max(axis=2)
    return np.nanmedian(apart, axis=0)


def _colors(frames: list[Frame], points: np.ndarray) -> np.ndarray:
    """(P, 3) median colors of photographs at far points; of those that none shows, the color of the nearest one.

    Some points at a time: each has a color in every photograph, which is gigabytes of many points and photographs.
    """
    has_color = np.zeros(len(points), bool)
    colors = np.full((len(points), 3), 0.5, np.float32)
    step = max(1, _COLORS_AT_ONCE // (12 * len(frames)))
    for first in range(0, len(points), step):
        some = slice(first, first + step)
        seen = _colors_seen(frames, points[some])
        there = ~np.isnan(seen[..., 0]).all(axis=0)
        if there.any():
            colors[some][there] = np.nanmedian(seen[:, there], axis=0)
        has_color[some] = there
    if not has_color.any():
        return colors
    middle = np.stack([frame.camera.center for frame in frames]).mean(axis=0)
    directions = points - middle
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    known, known_directions = colors[has_color], directions[has_color]
    for row in np.flatnonzero(~has_color):
        colors[row] = known[np.argmax(known_directions @ directions[row])]
    return colors


class SkyboxComponent(Component):
    """A shell of Gaussians around the scene as a part of a fit: `skybox` on, or auto, where photographs agree on it.

    Attributes:
        choice: Whether there is one, and why; None of a fit that is resumed.
    """

    name = "skybox"
    option = ("skybox", "off or auto")
    where = "where Gaussians begin far away"
    conflicts = (
        Conflict("selection", "whether there is one is decided by all photographs", "leave --skybox out"),
        Conflict("motion", "photographs are compared as if nothing moved", "leave --skybox out"),
    )

    def __init__(self) -> None:
        self.choice: SkyboxChoice | None = None
        self._count = 0

    def setting(self, setup: Setup) -> str | None:
        """See `Component`: `auto` gives way."""
        return "on" if setup.config.data.skybox == "on" else None

    def begin(self, setup: Setup, resumed: bool) -> None:
        """See `Component`: whether there is to be one, for which the initial points leave room."""
        if resumed:
            return
        self.choice = self._chosen(setup)
        if self.choice.reason is None:
            self._count = max(1, round(SHARE * setup.config.density.max_gaussians))
            setup.reserved += self._count

    def _chosen(self, setup: Setup) -> SkyboxChoice:
        """By what is fitted, by what data say is behind everything, and by what photographs show.

        Raises:
            ValueError: If skybox is on where the data say what is behind everything.
        """
        config, frames = setup.config, setup.frames
        if "begin" in setup.modes:
            return SkyboxChoice("the fit continues from Gaussians of another one")
        if config.data.skybox == "off":
            return SkyboxChoice("skybox is off")
        if clash := setup.conflict(self):
            return SkyboxChoice(clash[1].removeprefix("where "))
        with Bar("skybox") as bar:
            reason = why_not(frames, config.settings.background)
            if reason is not None and config.data.skybox == "on":
                raise ValueError(f"fit: skybox must be off or auto here, got on: {reason}; leave --skybox out")
            if reason is not None:
                bar.note(f"skybox: none, {reason}")
                return SkyboxChoice(reason)
            evidence = far_evidence(frames, scene_extent([frame.camera for frame in frames]), config.seed)
            is_on = config.data.skybox == "on" or evidence.is_clear
            bar.note(f"skybox: {evidence.words()}; {'there is one' if is_on else 'there is none'}")
            return SkyboxChoice(None if is_on else "photographs do not clearly agree on what is far away", evidence)

    def start(self, fit: Fit, setup: Setup) -> None:
        """See `Component`."""
        if self._count:
            with Bar("colors of the skybox"):
                skybox = Skybox.around(fit.frames, fit.extent, self._count, fit.config.seed)
            _log.info("skybox: %d Gaussians, %.4g and more away", len(skybox), RADIUS * fit.extent)
            fit.rows.add_far(skybox.rows(fit.rows.origin))

    def record(self, fit: Fit, before: Mapping[str, Any]) -> dict[str, Any]:
        """See `Component`."""
        if self.choice is not None:
            return {"skybox": self.choice.to_json(fit.rows.far)}
        # The config.json of a fit that is resumed may have been moved away, or say nothing of a skybox.
        here = {"gaussians": fit.rows.far, "reason": None} if fit.rows.far else None
        known = before.get("skybox", here)
        return {} if known is None else {"skybox": known}

    def metrics(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`: how many Gaussians it has, and how much of it photographs show."""
        count = fit.rows.far
        if not count:
            return {}
        frames = fit.photographs()
        frames = frames[:: -(-len(frames) // _MEASURED_VIEWS)]
        share = visible_share(fit.gaussians(), count, frames, fit.config.settings)
        return {"skybox": {"gaussians": count, "visible": share}}
