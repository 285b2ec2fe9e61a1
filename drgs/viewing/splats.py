"""Gaussians as the client takes them: centers, covariances in half floats, colors and opacities of 8 bits."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from drgs.ellipsoids import Y_00, Gaussians, semi_axes

__all__ = ["ClientGaussians"]

_LARGE = 64.0  # units of the client's lengths that the larger Gaussians have as their standard deviation
_QUANTILE = 0.999  # quantile of the sizes that says which Gaussians those are
_MOST = 60_000.0  # largest entry of a covariance: half floats end at 65,504
_FARTHEST = 1e30  # largest coordinate: what is farther is nowhere to be seen, and float32 ends
_SMALLEST = 1e-30  # smallest size of the larger Gaussians, in the world's unit: its inverse is a float32, too


@dataclasses.dataclass(frozen=True, eq=False)
class ClientGaussians:
    """What viser's `add_gaussian_splats` takes.

    The client keeps covariances as half floats, from 6e-5 to 65,504 with all their digits: lengths are therefore
    multiplied so that a Gaussian of nearly the largest has a standard deviation of 64, and all down to 1/8000 of that
    are drawn as they are, those above 3.8 times that as large. All of it is finite, whatever the Gaussians are.

    Attributes:
        centers: (N, 3) float32, relative to the origin, in the client's lengths.
        covariances: (N, 3, 3) float32, in the client's lengths squared.
        rgbs: (N, 3) uint8 colors.
        opacities: (N, 1) float32 in [0, 1].
        scale: World units of a client's length, 1 / the factor that lengths were multiplied by.
    """

    centers: np.ndarray
    covariances: np.ndarray
    rgbs: np.ndarray
    opacities: np.ndarray
    scale: float

    @classmethod
    def of(cls, g: Gaussians, rgbs: np.ndarray | None = None) -> ClientGaussians:
        """Convert Gaussians; they are sent relative to their origin.

        Args:
            g: Gaussians at one time.
            rgbs: (N, 3) uint8 colors; None: their color of degree 0, which is the mean over all directions.
        """
        with torch.no_grad():  # what a browser is sent has no derivative, and NumPy takes no tensor that has one
            scales = g.scales.double()  # may be infinite: float32 ends at the exponential of 88
            sizes = scales.amax(1).cpu().numpy()
            large = float(np.quantile(sizes, _QUANTILE)) if len(sizes) else 1.0
            factor = _LARGE / large if _SMALLEST < large < 1 / _SMALLEST else 1.0
            # An infinite scale times a 0 of the rotation would be NaN; the products stay below half floats' end.
            axes = semi_axes(g.quats.double(), (scales * factor).clamp_max(_MOST**0.5))
            covariances = (axes @ axes.transpose(1, 2)).float().clamp(-_MOST, _MOST).cpu().numpy()
            if rgbs is None:
                color = (0.5 + Y_00 * g.sh[:, 0]).clamp(0, 1)  # bytes would wrap around
                rgbs = (255 * color).round().to(torch.uint8).cpu().numpy()
            # Beyond float32 a center would be infinite, which the client draws nothing of, neighbors included.
            centers = (g.means.double() * factor).clamp(-_FARTHEST, _FARTHEST).float().cpu().numpy()
            opacities = g.opacities.float()[:, None].cpu().numpy()
        return cls(centers, covariances, rgbs, opacities, 1.0 / factor)
