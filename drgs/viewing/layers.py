"""Which pictures there are of what is looked at: what it does not have is not offered."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from drgs.display import pictures
from drgs.integrator import Output
from drgs.viewing.drawing import Done, drawn

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.settings import RenderSettings
    from drgs.viewing.uncertainty import Uncertainty

__all__ = ["UNCERTAINTY", "ColorScale", "Drawing", "Layer", "layers_of", "tinted"]

UNCERTAINTY = "uncertainty"
_WIDE_PIXELS = 200_000  # pixels of a picture of features: 100 MB of 128 channels
_VARIANCE = "variance of the color, as a multiple of the photographs' noise, logarithmic"
_ROW = 4096  # Gaussians that are painted at once


@dataclasses.dataclass(frozen=True)
class ColorScale:
    """What the colors of a picture mean.

    Attributes:
        dark: Value at the dark end.
        bright: Value at the bright end.
        of: Quantity that has these values, and its unit.
    """

    dark: float
    bright: float
    of: str


@dataclasses.dataclass(frozen=True, eq=False)
class Drawing:
    """A picture (H, W, 3) uint8, and its scale, if it has one."""

    picture: np.ndarray
    scale: ColorScale | None = None


Drawings = Generator[Done, None, Drawing]
"""Yields its progress between its steps, and returns the picture."""

Draw = Callable[["Scene", "Camera", "RenderSettings"], Drawings]


@dataclasses.dataclass(frozen=True)
class Layer:
    """A kind of picture.

    Attributes:
        name: Name under which the browser offers it.
        hint: What it shows, in a few words.
        draw: Function of scene, camera and settings that returns steps to a `Drawing`.
        pixels: Largest number of pixels, whatever the window; None: the window's.
        tint: Function of Gaussians: (N, 3) uint8 colors in which the client draws them; None: their own.
    """

    name: str
    hint: str
    draw: Draw
    pixels: int | None = None
    tint: Callable[[Gaussians], np.ndarray] | None = None


def layers_of(
    paint: Mapping[str, Callable[[Output], np.ndarray]], uncertainty: Uncertainty | None, pixels: int | None
) -> tuple[Layer, ...]:
    """Layers that a scene has.

    Args:
        paint: Kind -> function that draws it of a rendering with features.
        uncertainty: What the photographs leave uncertain, where there are any.
        pixels: Largest number of pixels of its map; None: as many as of other pictures.
    """
    made = [
        Layer("rgb", "colors", _rgb),
        Layer("depth", "distance along the ray, near is bright; gray where less than half of the light stops", _depth),
        Layer("missing", "share of the light that no Gaussian stops: black nothing, bright all of it", _missing),
    ]
    hints = {
        "features": "three principal components of the semantic features",
        "labels": "the class of each pixel",
        "overlay": "classes over the colors",
    }
    for kind, painter in paint.items():
        tint = None if kind == "overlay" else _tint_of(painter)
        made.append(Layer(kind, hints.get(kind, kind), _painted(painter), _WIDE_PIXELS, tint))
    if uncertainty is not None:
        hint = "variance that the photographs leave to each pixel's color: bright is uncertain, dark is well known"
        made.append(Layer(UNCERTAINTY, hint, _mapped(uncertainty), pixels))
    return tuple(made)


def tinted(layer: Layer, gaussians: Gaussians) -> np.ndarray | None:
    """(N, 3) uint8 colors of the client's Gaussians; None: their own."""
    return None if layer.tint is None else layer.tint(gaussians)


def _rgb(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
    read = lambda out: pictures.to_bytes(out.rgb.cpu().numpy())  # noqa: E731
    return Drawing((yield from drawn(scene, camera, settings, read, colors=lambda rows: rows)))


def _depth(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
    def read(out: Output) -> np.ndarray:
        assert out.depth is not None  # asked for
        return np.stack([out.depth.cpu().numpy(), out.alpha.cpu().numpy()], axis=-1)

    found = yield from drawn(scene, camera, settings, read)
    picture, (near, far) = pictures.depth_colors(found[..., 0], found[..., 1])
    return Drawing(picture, ColorScale(far, near, "distance, in the scene's unit"))


def _missing(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
    read = lambda out: 1 - out.alpha.cpu().numpy()  # noqa: E731
    found = yield from drawn(scene, camera, settings, read, colors=pictures.inferno)
    return Drawing(pictures.inferno(found), ColorScale(0.0, 1.0, "share of the light, none to all"))


def _painted(painter: Callable[[Output], np.ndarray]) -> Draw:
    def draw(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
        return Drawing((yield from drawn(scene, camera, settings, painter, True, lambda rows: rows)))

    return draw


def _mapped(uncertainty: Uncertainty) -> Draw:
    def draw(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
        found = uncertainty.map(camera)
        yield Done(1.0)
        picture, (low, high) = pictures.map_colors(found)
        return Drawing(picture, ColorScale(low, high, _VARIANCE))

    return draw


def _tint_of(painter: Callable[[Output], np.ndarray]) -> Callable[[Gaussians], np.ndarray]:
    """What paints pixels paints Gaussians, too: as rows of pixels that show one each."""
    import torch

    def tint(g: Gaussians) -> np.ndarray:
        assert g.features is not None  # else there is no such painter
        rows = []
        for features in g.features.detach().split(_ROW):  # colors for a browser: NumPy takes no tensor with a gradient
            rgb = torch.zeros(1, len(features), 3)
            alpha = torch.ones(1, len(features))
            rows.append(painter(Output(rgb=rgb, alpha=alpha, features=features[None]))[0])
        return np.concatenate(rows) if rows else np.zeros((0, 3), np.uint8)

    return tint
