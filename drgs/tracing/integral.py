"""Response `integral`: a = 1 - exp(-tau), tau = softplus(logit) exp(-rho^2 / 2) W(u), W(u) = erfc(-u / sqrt 2) / 2.

tau is the optical depth of the Gaussian's density from the origin of the ray on, normalized along each ray so that a
full pass through the center has a = alpha; u = t* |d'| is the peak's distance in standard deviations. Geometry and
notation are those of peak.py. With e = d' / |d'|,

    da = (1 - a) (tau d(-rho^2 / 2) + softplus(logit) exp(-rho^2 / 2) W'(u) du),  W'(u) = exp(-u^2 / 2) / sqrt(2 pi)
    du = (e / s) . R^T dmu + (2 p_k e_k - u e_k^2) dlog s_k + w . R (S p x S^-1 e + S e x S^-1 p - u S e x S^-1 e)
"""

from __future__ import annotations

import math

import drjit as dr

from drgs.tracing import records as layout
from drgs.tracing.arrays import Float
from drgs.tracing.peak import Peak, approach, times
from drgs.tracing.primitives import Ray

_ROOT_HALF = 0.7071067811865476  # sqrt(1 / 2)
_INV_SQRT_2PI = 0.3989422804014327  # 1 / sqrt(2 pi)


class Integral(Peak):
    """a = 1 - exp(-optical depth from the origin of the ray on)."""

    front_only = False
    at_most_alpha = False

    def strength(self, logit: Float, opacity: Float, e: Float) -> Float:
        """softplus(logit): the optical depth -log(1 - alpha) of a full pass."""
        return _softplus(logit, e)

    def strength_slope(self, logit: Float, opacity: Float, e: Float) -> Float:
        """softplus' / softplus."""
        softplus = _softplus(logit, e)
        return dr.select(softplus > 0, opacity / softplus, 1)  # 1 where both vanish in float64

    def slots(self, world: bool, depth: bool) -> list[int]:
        """All numbers of the shape: the opacity depends on t*, too."""
        used = super().slots(world, False)
        return [*used, *([layout.W_NORM] if world else [layout.H1, layout.H2, layout.H3, layout.NORM])]

    def _u_in_world(self, r: list[Float], key: Float, inverse: Float) -> Float:
        return r[layout.W_NORM] * key * dr.rsqrt(inverse)

    def _u_on_screen(self, r: list[Float], along: Float, inverse: Float) -> Float:
        return r[layout.NORM] * along * dr.sqrt(inverse)

    def opacity(self, x: Float, u: Float) -> Float:
        """1 - exp(-tau)."""
        tau = x * (0.5 + 0.5 * dr.erf(u * _ROOT_HALF))
        # 1 - exp(-tau) rounds a small tau away; its series does not. At 0.03 both are right to 2e-7.
        series = tau * dr.fma(tau, dr.fma(tau, dr.fma(tau, -1 / 24, 1 / 6), -0.5), 1)
        return dr.select(tau < 0.03, series, 1 - dr.exp(-tau))

    def slopes(self, r: list[Float], extra: list[Float], ray: Ray, world: bool) -> list[Float]:
        """da of the module docstring."""
        p, e, u, rho2 = self._peak(r, extra, ray, world)
        gauss = dr.exp(-0.5 * rho2)
        strength = r[layout.W_ALPHA if world else layout.ALPHA]
        passed = 0.5 + 0.5 * dr.erf(u * _ROOT_HALF)
        left = strength * gauss * dr.exp(-strength * gauss * passed)
        along = left * passed
        across = left * dr.exp(-0.5 * u * u) * _INV_SQRT_2PI
        local = times(extra, 1, p)
        ne = times(extra, 0, e)
        le = times(extra, 1, e)
        pairs = [((i + 1) % 3, (i + 2) % 3) for i in range(3)]
        products = [local[j] * le[k] + local[k] * le[j] - u * le[j] * le[k] for j, k in pairs]
        scales = [2 * x * y - u * y * y for x, y in zip(local, le, strict=True)]
        du = [*ne, *times(extra, 2, products), *scales]
        return [*(dr.fma(across, x, along * y) for x, y in zip(du, approach(extra, p), strict=True)), along]

    def least_strength(self, alpha_min: float) -> float:
        """What it takes where all of the density lies in front, W = 1, which is the most there can be."""
        return -math.log1p(-alpha_min)


INTEGRAL = Integral()
"""The row of `RESPONSES`."""


def _softplus(logit: Float, e: Float) -> Float:
    """log(1 + exp(logit)), e = exp(-|logit|); of a small e 1 + e would lose the digits."""
    series = e * dr.fma(e, dr.fma(e, 1 / 3, -0.5), 1)
    return dr.select(logit >= 0, logit, 0) + dr.select(e < 1e-4, series, dr.log(1 + e))
