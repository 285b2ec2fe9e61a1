"""What the photographs leave uncertain: their information is added up once, view by view, when it is asked for.

A sketch comes first, of few photographs and few of their pixels: within seconds it shows about the same map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.gain import Information, Prior, check, variances
from drgs.information.blocks import add
from drgs.sizes import at_most

if TYPE_CHECKING:
    import torch

    from drgs.cameras import Camera

__all__ = ["Uncertainty"]

_VIEWS = 24  # of the sketch, at most
_PIXELS = 2400  # of each, at most


class Uncertainty:
    """Maps of the predictive variance, given the views that a scene was fitted to.

    Args:
        cameras: The cameras of these views, at least one.
        said: What a view says about the parameters.
        mapped: (camera, weights) -> (H, W) sum over the parameters of squared derivatives times weights.
        prior: lambda.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        said: Callable[[Camera], Information],
        mapped: Callable[[Camera, Information], np.ndarray],
        prior: Prior,
    ) -> None:
        self.cameras = tuple(cameras)
        self._said = said
        self._mapped = mapped
        self._prior = prior
        self.done = 0
        self._sum: dict[str, torch.Tensor] = {}
        self._weights: Information | None = None

    @property
    def is_known(self) -> bool:
        """Whether all views have been added."""
        return self.done == len(self.cameras)

    @property
    def is_sketched(self) -> bool:
        """Whether there is a map, if only a sketch."""
        return self._weights is not None

    def learn(self, told: Callable[[], None], sketch: bool = True) -> Iterator[None]:
        """Sketch the map, if there is none, then add the views that are not added yet, one a step.

        Args:
            told: Called after the sketch and each view.
            sketch: Whether somebody waits for a sketch; of few small views there is none.
        """
        few = len(self.cameras) <= _VIEWS and max(x.width * x.height for x in self.cameras) <= _PIXELS
        if sketch and not few and not self.is_sketched:
            yield from self._sketch()
            told()
            yield
        while self.done < len(self.cameras):
            camera = self.cameras[self.done]
            add(self._sum, self._of(camera))
            self.done += 1
            if self.done == len(self.cameras):
                self._weights = variances(self._sum, self._prior)
                self._sum = {}
            told()
            yield

    def _sketch(self) -> Iterator[None]:
        """Add up few pixels of few views, evenly spaced, each for those of all that it stands for."""
        total: dict[str, torch.Tensor] = {}
        count = min(len(self.cameras), _VIEWS)
        for k in range(count):
            camera = self.cameras[k * len(self.cameras) // count]
            small = at_most(camera, _PIXELS)
            stands_for = len(self.cameras) / count * (camera.width * camera.height) / (small.width * small.height)
            add(total, {name: x * stands_for for name, x in self._of(small).items()})
            yield
        self._weights = variances(total, self._prior)

    def _of(self, camera: Camera) -> Information:
        said = self._said(camera)
        check(f"view: {camera.name}", said)
        return said

    def map(self, camera: Camera) -> np.ndarray:
        """(H, W) predictive variance of a view's pixels, for unit noise.

        Raises:
            RuntimeError: Before all views have been added, or sketched.
        """
        if self._weights is None:
            raise RuntimeError(f"view: all {len(self.cameras)} views must be added first, {self.done} are")
        return self._mapped(camera, self._weights)
