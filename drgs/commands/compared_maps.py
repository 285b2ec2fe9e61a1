"""A view beside maps of what different rules look at in it, as one picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs import fisher
from drgs.display import pictures
from drgs.information.maps import fisherrf_map, moments_map
from drgs.information.sums import add
from drgs.integrator import render

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene
    from drgs.gain import Prior
    from drgs.settings import RenderSettings

__all__ = ["ComparedMaps"]

_SMALL = 200  # pixels of width, below which a picture is enlarged by a whole number


class ComparedMaps:
    """Maps of `moments`, of `fisherrf` and of every block, of views that are compared with known ones.

    Args:
        scene: The scene that is seen.
        settings: Settings of the renderer.
        prior: lambda.
    """

    def __init__(self, scene: Scene, settings: RenderSettings, prior: Prior) -> None:
        self.scene = scene
        self.settings = settings
        self.prior = prior
        self.known: dict[str, torch.Tensor] = {}  # as FisherRF's code computes it

    def know(self, camera: Camera) -> None:
        """Add a known view."""
        add(self.known, fisher.diagonal(self.scene, camera, self.settings, "fisherrf"))

    def row(self, camera: Camera, blocks: dict[str, np.ndarray]) -> np.ndarray:
        """(H, W, 3) uint8: the view as it is rendered, then the maps, each on a scale of its own.

        Args:
            camera: The camera of the view.
            blocks: Block -> (H, W) variance map.
        """
        with torch.no_grad():  # a picture
            seen = self.scene.at(camera.time)
        image = render(seen.replace(features=None), camera, self.settings, outputs=()).rgb.cpu().numpy()
        maps = {
            "moments": moments_map(seen, camera, self.settings).numpy(),
            "fisherrf": fisherrf_map(seen, camera, self.known, self.prior, self.settings).numpy(),
            **blocks,
        }
        times = max(1, -(-_SMALL // camera.width))
        large = lambda x: np.repeat(np.repeat(x, times, 0), times, 1)  # noqa: E731
        when = "" if camera.time is None else f" at {camera.time:g}"
        panels = [pictures.caption(large(image), f"{camera.name or 'view'}{when}")]
        panels += [pictures.caption(pictures.map_picture(large(x)), name) for name, x in maps.items()]
        return np.concatenate(panels, axis=1)
