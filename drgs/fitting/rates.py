"""Learning rates of the tensors that every fit has, with a row a Gaussian."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drgs.fitting.config import FitConfig
    from drgs.fitting.networks import Rate


def rates_of(config: FitConfig, extent: float) -> dict[str, Rate]:
    """Learning rates by the name of the tensor in `GaussianRows`; `extent` of the scene is its unit of length."""
    return {
        "means": lambda part: means_rate(config, part) * extent,
        "quats": config.rates.rotation_rate,
        "log_scales": config.rates.scale_rate,
        "logit_opacities": config.rates.opacity_rate,
        "sh_dc": config.rates.dc_rate,
        "sh_rest": config.rates.rest_rate,
    }


def means_rate(config: FitConfig, part: float) -> float:
    """Learning rate of the means, in units of the extent, when the fraction `part` of the fit is done."""
    first, last = config.rates.means_rate
    return first * (last / first) ** part
