"""What a fit is made of besides its photographs and Gaussians: here a new term, tensor or network is put in."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from drgs.ellipsoids import Scene
from drgs.fitting.config import FitConfig
from drgs.fitting.losses import LossTerm, terms_of
from drgs.fitting.networks import Network, Rate
from drgs.fitting.rows import GaussianRows

__all__ = ["Parts", "means_rate", "parts_of"]


@dataclasses.dataclass(frozen=True)
class Parts:
    """What a fit is made of.

    Attributes:
        terms: Of the loss, in the order in which they are added up.
        rates: Learning rates by the name of the tensor in `GaussianRows`.
        networks: What is fitted beside the Gaussians, and called by terms or by the scene.
        scene: What is rendered of the rows: their Gaussians, or a scene that has others at the time of a view.
    """

    terms: Sequence[LossTerm]
    rates: Mapping[str, Rate]
    networks: Sequence[Network] = ()
    scene: Callable[[GaussianRows], Scene] = GaussianRows.gaussians


def parts_of(config: FitConfig, extent: float) -> Parts:
    """The parts of a plain fit with a config; the `extent` of the scene is its unit of length."""
    rates: dict[str, Rate] = {
        "means": lambda part: means_rate(config, part) * extent,
        "quats": config.rotation_rate,
        "log_scales": config.scale_rate,
        "logit_opacities": config.opacity_rate,
        "sh_dc": config.dc_rate,
        "sh_rest": config.rest_rate,
    }
    return Parts(terms_of(config, extent), rates)


def means_rate(config: FitConfig, part: float) -> float:
    """Learning rate of the means, in units of the extent, when the fraction `part` of the fit is done."""
    first, last = config.means_rate
    return first * (last / first) ** part
