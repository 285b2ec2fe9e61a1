"""What the photographs leave uncertain: their information is added up once, view by view, when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.gain import Information, Prior, check, variances
from drgs.information.blocks import add

if TYPE_CHECKING:
    import torch

    from drgs.cameras import Camera

__all__ = ["Uncertainty"]


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
        return self._weights is not None

    def learn(self, told: Callable[[], None]) -> Iterator[None]:
        """Add what is not yet, a view a step.

        Args:
            told: Called after each view.
        """
        while self.done < len(self.cameras):
            camera = self.cameras[self.done]
            said = self._said(camera)
            check(f"view: {camera.name}", said)
            add(self._sum, said)
            self.done += 1
            if self.done == len(self.cameras):
                self._weights = variances(self._sum, self._prior)
                self._sum = {}
            told()
            yield

    def map(self, camera: Camera) -> np.ndarray:
        """(H, W) predictive variance of a view's pixels, for unit noise.

        Raises:
            RuntimeError: Before all views have been added.
        """
        if self._weights is None:
            raise RuntimeError(f"view: all {len(self.cameras)} views must be added first, {self.done} are")
        return self._mapped(camera, self._weights)
