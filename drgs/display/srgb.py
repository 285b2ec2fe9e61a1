"""The transfer function of sRGB (IEC 61966-2-1), both ways, of NumPy arrays and of torch tensors."""

from __future__ import annotations

from typing import Any

import numpy as np

# Up to these the function is a straight line.
_STRAIGHT = 0.04045  # of the sRGB value
_STRAIGHT_LIGHT = 0.0031308  # of the light


def linear_from_srgb(values: Any) -> Any:
    """Linear light of sRGB values, of any shape, as an array or a tensor of the same type; differentiable.

    Args:
        values: 0 is black, 1 is white; what is negative goes on along the straight line.
    """
    # The power is evaluated where it is not taken, too: below -0.055 it is NaN, and so would the gradient be.
    curve = ((values.clip(_STRAIGHT) + 0.055) / 1.055) ** 2.4
    return _where(values <= _STRAIGHT, values / 12.92, curve)


def srgb_from_linear(light: Any) -> Any:
    """sRGB values of linear light, as `linear_from_srgb` takes and returns them."""
    curve = 1.055 * light.clip(_STRAIGHT_LIGHT) ** (1 / 2.4) - 0.055
    return _where(light <= _STRAIGHT_LIGHT, 12.92 * light, curve)


def _where(condition: Any, a: Any, b: Any) -> Any:
    return a.where(condition, b) if hasattr(a, "where") else np.where(condition, a, b)  # a tensor has the method
