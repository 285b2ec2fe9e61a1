"""Responses: the opacity of a Gaussian for a ray. peak.py, integral.py and ewa.py have the formulas of one each.

A new one is a class that keeps the `Response` protocol and an instance of it in `RESPONSES`, here or from another
package. What is to be checked has its equations in the float64 oracle (oracle/reference.py), written independently of
this.
"""

from __future__ import annotations

from typing import Protocol

from drgs.settings import RESPONSES, RenderSettings
from drgs.tracing.arrays import Float, Lib, Mask
from drgs.tracing.primitives import Activated, Patch, Projected, Ray, Screen

__all__ = ["RESPONSES", "Response", "response_of"]


class Response(Protocol):
    """One formula of the opacity of a hit, with all that follows from it.

    Attributes:
        planar: The response is a model of the image plane: tiles, order `center` and pinhole cameras only.
        front_only: Peaks behind the origin of a ray do not count.
        at_most_alpha: No hit has more opacity than alpha exp(-rho^2 / 2); else none has more than softplus(logit) times
            that exponential. The adaptive extent hangs on it.
        extra: Floats a Gaussian that `slopes` needs besides the record (`extras`).
        by_tangents: These floats are tangents of the record, not closed forms.
    """

    planar: bool
    front_only: bool
    at_most_alpha: bool
    extra: int
    by_tangents: bool

    # Once a Gaussian and view, in float64.

    def strength(self, logit: Float, opacity: Float, e: Float) -> Float:
        """What stands for alpha in the record; e = exp(-|logit|)."""

    def strength_slope(self, logit: Float, opacity: Float, e: Float) -> Float:
        """d log strength / d logit."""

    def project(self, g: Activated, screen: Screen) -> tuple[list[Float], list[Float], Mask, tuple | None]:
        """Entries of a screen record behind the anchor, bounds in pixels, mask of what is there, `Projected.frame`."""

    def extras(self, lib: Lib, projected: Projected, moved: list[list[Float]] | None) -> list[Float]:
        """(N,) columns for `slopes`; `moved`: tangents of the record by means, rotations and log-scales."""

    # Once a hit, in float32.

    def slots(self, world: bool, depth: bool) -> list[int]:
        """Entries of a record that carry a derivative; `depth`: whether t* has a cotangent or tangent."""

    def along(self, r: list[Float], ray: Ray, world: bool) -> tuple[Float, Float, Float | None]:
        """rho^2, t* (the order key) and u = t* |d'| (None where `opacity` does not need it) of a ray."""

    def opacity(self, x: Float, u: Float | None) -> Float:
        """Opacity of a hit, from x = strength exp(-rho^2 / 2)."""

    def slopes(self, r: list[Float], extra: list[Float], ray: Ray, world: bool) -> list[Float]:
        """d opacity / d (mean 3, rotation 3, log-scale 3, log strength)."""

    # Once a tile and Gaussian, in float32.

    def least_strength(self, alpha_min: float) -> float:
        """Least strength exp(-rho^2 / 2) of a hit whose opacity reaches alpha_min."""

    def may_hit(self, r: list[Float], patch: Patch, limit: Float) -> Mask:
        """False only where no ray of the patch hits with rho^2 <= limit."""


def response_of(settings: RenderSettings) -> Response:
    """The response that settings name."""
    return RESPONSES[settings.response]
