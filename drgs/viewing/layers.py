"""The pictures of a subject that the viewer can draw, and how: in steps, a small one first.

What a scene does not have is not offered. A small picture comes first, then one as large as the browser shows, a band
of rows at a time. Between two steps the worker may turn to something else, so that a browser whose camera has moved
waits for one band of the picture that is no longer wanted, not for all of it.

What photographs say, where the scene is wrong and what they leave uncertain, is found once, when it is first wanted. A
sketch comes before, of few photographs and few of their pixels: within seconds it shows about the same map.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.cameras.sizes import at_most, cropped
from drgs.display import pictures
from drgs.ellipsoids import Gaussians, Scene, colors_only
from drgs.gain import Information, Prior, check, variances
from drgs.information.expected_error import ErrorRecord, expected_error
from drgs.information.sums import add
from drgs.integrator import Output, render
from drgs.settings import RenderSettings


class DrawingProgress(NamedTuple):
    """How far a picture is.

    Attributes:
        share: Share that is done.
        rows: (h, W, 3) uint8 rows from the top that are done; None where colors are not known before the end.
    """

    share: float
    rows: np.ndarray | None = None


Steps = Generator[DrawingProgress, None, np.ndarray]
"""Yields its progress between its steps, and returns the picture."""

# A first picture is there at once, and a step ends soon enough for a newer request; chosen.
_FIRST_PIXELS = 16_000  # pixels of the first picture
_BAND_PIXELS = 48_000  # pixels that are drawn in one step


def stages(camera: Camera, most: int) -> list[Camera]:
    """The cameras of one view in the order in which they are drawn: a small picture, then one of `most` pixels.

    Args:
        camera: The view, as large as the browser's window.
        most: Largest number of pixels; no picture is larger than the window either.
    """
    last = at_most(camera, most)
    first = at_most(camera, _FIRST_PIXELS)
    return [first, last] if 2 * first.width * first.height < last.width * last.height else [last]


def bands(camera: Camera, pixels: int = _BAND_PIXELS) -> list[Camera]:
    """Cameras that show the rows of a view from top to bottom, each at most so many pixels, but a row at least."""
    rows = max(1, pixels // camera.width)
    parts = []
    for top in range(0, camera.height, rows):
        parts.append(cropped(camera, 0, top, camera.width, min(rows, camera.height - top)))
    return parts


def rendered_in_bands(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    read: Callable[[Output], np.ndarray],
    features: bool = False,
    colors: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Steps:
    """Render a view band by band; `read` converts each band's output to rows, joined to (H, W, ...).

    Args:
        scene: What is drawn.
        camera: The view, as large as the picture.
        settings: Render settings.
        read: Function that takes a band's rendering, with its depth, and returns rows of the picture.
        features: Whether it reads the features, which else cost nothing.
        colors: What makes rows of the picture of that, where a row does not depend on others.
    """
    parts = []
    shown: list[np.ndarray] = []
    with torch.no_grad():  # a picture needs no gradient; a graph would keep every band's intermediates
        shown_scene = scene.at(camera.time) if features else colors_only(scene.at(camera.time), None)
    below = 0
    for part in bands(camera):
        with torch.no_grad():  # entered for each band: between two of them the thread does other work
            parts.append(read(render(shown_scene, part, settings, ("depth",))))
        below += part.height
        if colors is not None:
            shown.append(colors(parts[-1]))
        yield DrawingProgress(below / camera.height, np.concatenate(shown) if shown else None)
    return np.concatenate(parts)


def over(before: np.ndarray, rows: np.ndarray, height: int) -> np.ndarray:
    """(height, W, 3) uint8 picture whose first rows are done, over a smaller one of the same view.

    Args:
        before: (h, w, 3) uint8 smaller picture.
        rows: (r, W, 3) uint8 rows that are done.
        height: H.
    """
    import cv2

    picture = cv2.resize(before, (rows.shape[1], height), interpolation=cv2.INTER_LINEAR)
    picture[: len(rows)] = rows
    return picture


_FEATURE_PIXELS = 200_000  # pixels of a picture of features: 100 MB of 128 channels
_GAUSSIANS_AT_ONCE = 4096  # Gaussians that are colored at once: bounds the memory of their features


@dataclasses.dataclass(frozen=True)
class ColorScale:
    """Meaning of the colors of a picture: their values and unit.

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


Drawings = Generator[DrawingProgress, None, Drawing]
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
    semantic: Mapping[str, Callable[[Output], np.ndarray]], maps: Iterable[PhotographMap], pixels: int | None
) -> tuple[Layer, ...]:
    """Layers that a scene has.

    Args:
        semantic: Kind (`features`, `labels`, `overlay`) -> function that colors a rendering with features.
        maps: Maps of what photographs say, where there are any.
        pixels: Largest number of pixels of these; None: as many as of other pictures.
    """
    layers = [
        Layer("rgb", "colors", _rgb),
        Layer("depth", "distance along the ray, near is bright; gray where less than half of the light stops", _depth),
        Layer("missing", "share of the light that no Gaussian stops: black nothing, bright all of it", _missing),
    ]
    hints = {
        "features": "three principal components of the semantic features",
        "labels": "the class of each pixel",
        "overlay": "classes over the colors",
    }
    for kind, colors_of in semantic.items():
        tint = None if kind == "overlay" else _tint_of(colors_of)
        layers.append(Layer(kind, hints.get(kind, kind), _semantic(colors_of), _FEATURE_PIXELS, tint))
    layers += [Layer(shown.name, shown.hint, _mapped(shown), pixels) for shown in maps]
    return tuple(layers)


def tinted(layer: Layer, gaussians: Gaussians) -> np.ndarray | None:
    """(N, 3) uint8 colors of the client's Gaussians; None: their own."""
    return None if layer.tint is None else layer.tint(gaussians)


def _rgb(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
    read = lambda out: pictures.to_bytes(out.rgb.cpu().numpy())  # noqa: E731
    return Drawing((yield from rendered_in_bands(scene, camera, settings, read, colors=lambda rows: rows)))


def _depth(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
    def read(out: Output) -> np.ndarray:
        assert out.depth is not None  # among the outputs
        return np.stack([out.depth.cpu().numpy(), out.alpha.cpu().numpy()], axis=-1)

    values = yield from rendered_in_bands(scene, camera, settings, read)
    picture, (near, far) = pictures.depth_colors(values[..., 0], values[..., 1])
    return Drawing(picture, ColorScale(far, near, "distance, in the scene's unit"))


def _missing(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
    read = lambda out: 1 - out.alpha.cpu().numpy()  # noqa: E731
    shares = yield from rendered_in_bands(scene, camera, settings, read, colors=pictures.inferno)
    return Drawing(pictures.inferno(shares), ColorScale(0.0, 1.0, "share of the light, none to all"))


def _semantic(colors_of: Callable[[Output], np.ndarray]) -> Draw:
    def draw(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
        return Drawing((yield from rendered_in_bands(scene, camera, settings, colors_of, True, lambda rows: rows)))

    return draw


def _mapped(shown: PhotographMap) -> Draw:
    def draw(scene: Scene, camera: Camera, settings: RenderSettings) -> Drawings:
        values = shown.map(camera)
        yield DrawingProgress(1.0)
        picture, (low, high) = pictures.map_colors(values)
        return Drawing(picture, ColorScale(low, high, shown.unit))

    return draw


def _tint_of(colors_of: Callable[[Output], np.ndarray]) -> Callable[[Gaussians], np.ndarray]:
    """What colors pixels colors Gaussians, too: as rows of pixels that show one each."""
    import torch

    def tint(g: Gaussians) -> np.ndarray:
        assert g.features is not None  # else there is no such layer
        rows = []
        # Colors for a browser: NumPy takes no tensor with a gradient.
        for features in g.features.detach().split(_GAUSSIANS_AT_ONCE):
            rgb = torch.zeros(1, len(features), 3)
            alpha = torch.ones(1, len(features))
            rows.append(colors_of(Output(rgb=rgb, alpha=alpha, features=features[None]))[0])
        return np.concatenate(rows) if rows else np.zeros((0, 3), np.uint8)

    return tint


SKETCH_VIEWS = 24
"""Training views that a sketch of a map uses, at most: it takes seconds. Chosen."""
SKETCH_PIXELS = 2400
"""Pixels of each of these views, at most; chosen."""


class PhotographMap(Protocol):
    """A map that the viewer draws of any view, once it has looked at the photographs that a scene was fitted to.

    Attributes:
        name: Name of the layer.
        hint: What it shows, in a few words.
        unit: What its numbers are.
        count: Number of photographs that are looked at.
        done: How many have been.
    """

    name: str
    hint: str
    unit: str
    count: int
    done: int

    @property
    def is_complete(self) -> bool:
        """Whether all have been looked at."""
        return self.done == self.count

    @property
    def has_map(self) -> bool:
        """Whether there is a map, if only a sketch."""

    def add_views(self, progress: Callable[[], None], sketch: bool = True) -> Iterator[None]:
        """Sketch the map, if there is none, then look at the photographs.

        Args:
            progress: Called whenever `done` has changed, and after the sketch.
            sketch: Whether somebody waits for a sketch.
        """

    def map(self, camera: Camera) -> np.ndarray:
        """(H, W) of a view.

        Raises:
            RuntimeError: Before there is a map.
        """


class ExpectedError(PhotographMap):
    """Maps of the expected error (`drgs.expected_error`), in units of color.

    Args:
        scene: The scene.
        count: Number of photographs of its record.
        saved: The record that there is already; None where there is none.
        made: The record of the photographs, each of at most so many pixels; None: of as many as the fit has seen.
    """

    name = "expected error"
    hint = "how wrong each pixel's color is expected to be, by the photographs: bright is wrong, dark is right"
    unit = "error of a color between 0 and 1, logarithmic"

    def __init__(
        self,
        scene: Scene,
        count: int,
        saved: Callable[[], ErrorRecord | None],
        made: Callable[[int | None], ErrorRecord],
    ) -> None:
        self.count = count
        self.done = 0
        self._scene = scene
        self._saved = saved
        self._made = made
        self._record: ErrorRecord | None = None

    @property
    def has_map(self) -> bool:
        """See `PhotographMap`."""
        return self._record is not None

    def add_views(self, progress: Callable[[], None], sketch: bool = True) -> Iterator[None]:
        """See `PhotographMap`: all photographs are one step."""
        found = self._saved()
        if found is None and sketch and not self.has_map:
            self._record = self._made(SKETCH_PIXELS)
            progress()
            yield
            found = self._saved()  # a fit that still runs may have written one meanwhile
        self._record = found or self._made(None)
        self.done = self.count
        progress()
        yield

    def map(self, camera: Camera) -> np.ndarray:
        """See `PhotographMap`."""
        if self._record is None:
            raise RuntimeError(f"view: {self.count} photographs must be looked at first, none are")
        return expected_error(self._scene, camera, self._record).sqrt().numpy()


class Uncertainty(PhotographMap):
    """Maps of the predictive variance, given the views that a scene was fitted to.

    Args:
        cameras: The cameras of these views, at least one.
        information_of: Information of a view about the parameters.
        variance_of: (camera, weights) -> (H, W) sum over the parameters of squared derivatives times weights.
        prior: lambda.
    """

    name = "uncertainty"
    hint = "variance that the photographs leave to each pixel's color: bright is uncertain, dark is well known"
    unit = "variance of the color, as a multiple of the photographs' noise, logarithmic"

    def __init__(
        self,
        cameras: Sequence[Camera],
        information_of: Callable[[Camera], Information],
        variance_of: Callable[[Camera, Information], np.ndarray],
        prior: Prior,
    ) -> None:
        self.cameras = tuple(cameras)
        self.count = len(self.cameras)
        self._information_of = information_of
        self._variance_of = variance_of
        self._prior = prior
        self.done = 0
        self._sum: dict[str, torch.Tensor] = {}
        self._weights: Information | None = None

    @property
    def has_map(self) -> bool:
        """Whether there is a map, if only a sketch."""
        return self._weights is not None

    def add_views(self, progress: Callable[[], None], sketch: bool = True) -> Iterator[None]:
        """See `PhotographMap`: each view is a step; of few small views there is no sketch."""
        few = len(self.cameras) <= SKETCH_VIEWS and max(x.width * x.height for x in self.cameras) <= SKETCH_PIXELS
        if sketch and not few and not self.has_map:
            yield from self._sketch()
            progress()
            yield
        while self.done < len(self.cameras):
            camera = self.cameras[self.done]
            add(self._sum, self._of(camera))
            self.done += 1
            if self.done == len(self.cameras):
                self._weights = variances(self._sum, self._prior)
                self._sum = {}
            progress()
            yield

    def _sketch(self) -> Iterator[None]:
        """Add up few pixels of few views, evenly spaced, each for those of all that it stands for."""
        total: dict[str, torch.Tensor] = {}
        count = min(len(self.cameras), SKETCH_VIEWS)
        for k in range(count):
            camera = self.cameras[k * len(self.cameras) // count]
            small = at_most(camera, SKETCH_PIXELS)
            stands_for = len(self.cameras) / count * (camera.width * camera.height) / (small.width * small.height)
            add(total, {name: x * stands_for for name, x in self._of(small).items()})
            yield
        self._weights = variances(total, self._prior)

    def _of(self, camera: Camera) -> Information:
        information = self._information_of(camera)
        check(f"view: {camera.name}", information)
        return information

    def map(self, camera: Camera) -> np.ndarray:
        """(H, W) predictive variance of a view's pixels, for unit noise.

        Raises:
            RuntimeError: Before all views have been added, or sketched.
        """
        if self._weights is None:
            raise RuntimeError(f"view: all {len(self.cameras)} views must be added first, {self.done} are")
        return self._variance_of(camera, self._weights)
