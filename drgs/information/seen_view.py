"""A view while it is asked: what questions find out on their way is there for the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable
from typing import TYPE_CHECKING

from drgs.information.backdrop import opacity_of

if TYPE_CHECKING:
    import torch

    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.information.network import NetworkProbes
    from drgs.settings import RenderSettings

__all__ = ["SeenView"]


@dataclasses.dataclass
class SeenView:
    """A view while it is asked: what one question finds out on its way, another one need not render again.

    Attributes:
        scene: The scene that is seen.
        camera: The view's camera.
        settings: Settings of the renderer.
        mask: (H, W) in [0, 1] what the image is multiplied by; None: 1.
        opacity: (H, W) float32, once a question has come to know it.
        beside: Question -> what a traversal for another one may sum up for it.
    """

    scene: Scene
    camera: Camera
    settings: RenderSettings
    mask: torch.Tensor | None = None
    opacity: torch.Tensor | None = None
    beside: dict[Hashable, NetworkProbes] = dataclasses.field(default_factory=dict)

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians at the time of the view."""
        return self.scene.at(self.camera.time)

    @property
    def masks(self) -> list[torch.Tensor | None] | None:
        """The mask as functions of `drgs.fisher` take it."""
        return None if self.mask is None else [self.mask]

    def known_opacity(self) -> torch.Tensor:
        """(H, W) float32 opacity, rendered where no question has found it."""
        if self.opacity is None:
            self.opacity = opacity_of(self.scene, self.camera, self.settings)
        return self.opacity
