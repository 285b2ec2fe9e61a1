"""Images and gradients that the ladder compares (ladder.py), each computed once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from drgs import reference
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.lab.raw import PARAMETERS
from drgs.oracle import sh_colors
from drgs.settings import RenderSettings

__all__ = ["Pictures", "State", "constant_colors"]


@dataclasses.dataclass
class State:
    """What one rasterizer makes of a scene, and differences of such.

    Attributes:
        image: (P, 3) float64, the pixels of all views.
        gradient: Parameter -> J^T u; empty without gradients.
    """

    image: torch.Tensor
    gradient: dict[str, torch.Tensor]

    def __add__(self, other: State) -> State:
        gradient = {name: x.double() + other.gradient[name].double() for name, x in self.gradient.items()}
        return State(self.image + other.image, gradient)

    def __sub__(self, other: State) -> State:
        gradient = {name: x.double() - other.gradient[name].double() for name, x in self.gradient.items()}
        return State(self.image - other.image, gradient)


class Pictures:
    """Images and gradients of one scene and its cameras, each computed once.

    Give the same one to several calls of `ladder` (other starts) to share what they have in common.

    Args:
        g: N Gaussians.
        cameras: Pinhole cameras, at least one.
        crop: Width and height in pixels of the crops of the first camera; 0 for none.
        seed: Seed of the cotangent.
        gradients: Whether J^T u is wanted.
        advance: Called after each image.
    """

    def __init__(
        self,
        g: Gaussians,
        cameras: Sequence[Camera],
        crop: int = 24,
        seed: int = 0,
        gradients: bool = True,
        advance: Callable[[], None] | None = None,
    ):
        if not len(cameras) or not len(g):
            raise ValueError(
                f"ladder: there must be a camera and a Gaussian, got {len(cameras)} and {len(g)}; give both"
            )
        if crop < 0:
            raise ValueError(f"ladder: crop must be >= 0 pixels, got {crop}; correct it")
        # Each picture makes leaves of its own; a graph behind these would be walked by each of them.
        self.g = g.detach()
        self.cameras = list(cameras)
        self.crop = crop
        self.gradients = gradients
        self.advance = advance or (lambda: None)
        self.background = (0.0, 0.0, 0.0)
        rng = np.random.default_rng(seed)
        self.u = [torch.from_numpy(rng.choice([-1.0, 1.0], (c.height, c.width, 3))) for c in self.cameras]
        self.windows: list[tuple[int, int, int, int]] = []
        self._made: dict[tuple, State] = {}

    def full(self, s: RenderSettings, detached: bool = False) -> State:
        """All pixels of all cameras, by `drgs.render`; `detached`: colors ignore how the direction follows a mean."""
        return self._once(("full", s, detached), lambda: self._full(s, detached))

    def part(self, s: RenderSettings, kind: str) -> State:
        """The crops: kind `float32` (`drgs.render`), `float64` (`reference.render`) or `volume`."""
        return self._once((kind, s), lambda: self._part(s, kind))

    def place_crops(self, s: RenderSettings) -> None:
        """The middle of the first camera's image and, if it does not overlap, the corner with the most opacity."""
        camera = self.cameras[0]
        width, height = min(self.crop, camera.width), min(self.crop, camera.height)
        x, y = (camera.width - width) // 2, (camera.height - height) // 2
        self.windows = [(x, y, width, height)]
        if x < width and y < height:
            return
        with torch.no_grad():  # where a crop lies has no derivative
            alpha = render(self.g, camera, s, outputs=()).alpha
        corners = [(x, y) for y in (0, camera.height - height) for x in (0, camera.width - width)]
        x, y = max(corners, key=lambda at: float(alpha[at[1] : at[1] + height, at[0] : at[0] + width].sum()))
        self.windows.append((x, y, width, height))

    def _once(self, key: tuple, make: Callable[[], State]) -> State:
        if key not in self._made:
            self._made[key] = make()
            self.advance()
        return self._made[key]

    def _leaves(self) -> Gaussians:
        moving = {name: self.g.parameters()[name].clone().requires_grad_(self.gradients) for name in PARAMETERS}
        return self.g.replace(features=None, **moving)

    def _state(self, g: Gaussians, images: list[torch.Tensor], cotangents: list[torch.Tensor]) -> State:
        """Images as rows of pixels, and J^T u by backward mode where gradients are wanted."""
        gradient = {}
        if self.gradients:
            # In float64, so that rounding of the sum is no rung of the ladder.
            loss: Any = sum((image.double() * u).sum() for image, u in zip(images, cotangents, strict=True))
            leaves = [g.parameters()[name] for name in PARAMETERS]
            found: Sequence[torch.Tensor | None] = [None] * len(leaves)
            if loss.requires_grad:
                found = torch.autograd.grad(loss, leaves, allow_unused=True)
            for name, leaf, x in zip(PARAMETERS, leaves, found, strict=True):
                gradient[name] = torch.zeros_like(leaf) if x is None else x.detach().cpu()
        # What is kept are numbers: a graph would hold every picture's intermediates.
        return State(torch.cat([x.detach().cpu().double().reshape(-1, 3) for x in images]), gradient)

    def _full(self, s: RenderSettings, detached: bool) -> State:
        states = []
        for camera, u in zip(self.cameras, self.u, strict=True):
            g = self._leaves()
            drawn = constant_colors(g, camera) if detached else g
            states.append(self._state(g, [render(drawn, camera, s, outputs=()).rgb.cpu()], [u]))
        return _joined(states)

    def _part(self, s: RenderSettings, kind: str) -> State:
        """Both crops, in float32 by drawing the whole picture, in float64 by the oracle's window."""
        camera = self.cameras[0]
        states = []
        for x, y, width, height in self.windows:
            rows, columns = slice(y, y + height), slice(x, x + width)
            g = self._leaves()
            window = (x, y, width, height)
            with torch.set_grad_enabled(self.gradients):
                if kind == "float32":
                    image = render(g, camera, s, outputs=()).rgb.cpu()[rows, columns]
                elif kind == "float64":
                    image = reference.render(g, camera, s, window=window).rgb
                else:
                    image = reference.render_volume(g, camera, s, window=window).rgb
            states.append(self._state(g, [image], [self.u[0][rows, columns]]))
        return _joined(states)


def _joined(states: list[State]) -> State:
    """Pixels of all, and the sum of their gradients."""
    gradient: dict[str, Any] = {name: sum(x.gradient[name] for x in states) for name in states[0].gradient}
    return State(torch.cat([x.image for x in states]), gradient)


def constant_colors(g: Gaussians, camera: Camera) -> Gaussians:
    """The same image with colors computed beforehand, from directions that are constants."""
    offset = torch.from_numpy(np.asarray(camera.center, np.float64) - np.asarray(g.origin, np.float64))
    towards = g.means.detach().cpu().double() - offset  # this is the approximation: the mean gets nothing through it
    base = (sh_colors(g.sh.cpu().double(), towards) - 0.5) * np.sqrt(4 * np.pi)
    return g.replace(sh=base.to(g.sh.dtype).to(g.sh.device)[:, None, :])
