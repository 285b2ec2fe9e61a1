"""A response: Gaussians that are thinner by the square root of 2 (docs/extending.md)."""

from drgs.tracing.peak import Peak


class Narrow(Peak):
    """a = alpha exp(-rho^2)."""

    def along(self, r, ray, world):
        """rho^2, twice that of `peak`, the order key and u."""
        rho2, key, u = super().along(r, ray, world)
        return 2 * rho2, key, u

    def slopes(self, r, extra, ray, world):
        """Derivatives by mean, rotation, log-scale and log strength."""
        *moves, strength = super().slopes(r, extra, ray, world)
        return [*(2 * x for x in moves), strength]


NARROW = Narrow()
