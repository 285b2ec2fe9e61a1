"""A quantity as a block: the brightness s of a rendered image S in exp(s) S (docs/extending.md)."""

import dataclasses

import drgs
from drgs.information.blocks import ImageBlock
from drgs.information.quantity import Quantity


@dataclasses.dataclass(frozen=True)
class Brightness(Quantity):
    """Information about s: the sum of S^2."""

    def compute(self, view):
        """The sum over pixels and channels; `view` has scene, camera, settings, mask, Gaussians and opacity."""
        rgb = drgs.render(view.scene, view.camera, view.settings).rgb
        return {"brightness": rgb.double().square().sum()[None]}

    def variance_map(self, view, weights):
        """The same pixel by pixel, times the weight of s."""
        return drgs.render(view.scene, view.camera, view.settings).rgb.square().sum(-1) * weights["brightness"].float()


BRIGHTNESS = ImageBlock(groups=("brightness",), quantity=lambda blocks, names: Brightness())
