"""Spherical harmonics up to degree 3, in the order and with the signs of 3DGS (Kerbl et al. 2023)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

from drgs.ellipsoids import Y_00
from drgs.tracing.arrays import Float

# Factors of the real spherical harmonics of degrees 1 to 3, as INRIA's code orders and signs them.
_LINEAR = 0.4886025119029199
_QUADRATIC = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_CUBIC = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def sh_basis(direction: list[Float], coefficients: int) -> list[Float]:
    """The first 1, 4, 9 or 16 real spherical harmonics at a unit `direction` (three floats)."""
    return [type(direction[0])(Y_00), *higher_harmonics(direction, coefficients)]


def higher_harmonics(direction: list[Any], coefficients: int) -> list[Any]:
    """The same without the first one, which is a constant; of Dr.Jit's floats or of tensors."""
    x, y, z = direction
    basis: list[Any] = []
    if coefficients > 1:
        basis += [-_LINEAR * y, _LINEAR * z, -_LINEAR * x]
    if coefficients > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        c: tuple[float, ...] = _QUADRATIC
        basis += [c[0] * x * y, c[1] * y * z, c[2] * (2 * zz - xx - yy), c[3] * x * z, c[4] * (xx - yy)]
    if coefficients > 9:
        c = _CUBIC
        basis += [
            c[0] * y * (3 * xx - yy),
            c[1] * x * y * z,
            c[2] * y * (4 * zz - xx - yy),
            c[3] * z * (2 * zz - 3 * xx - 3 * yy),
            c[4] * x * (4 * zz - xx - yy),
            c[5] * z * (xx - yy),
            c[6] * x * (xx - 3 * yy),
        ]
    return basis


def sh_color(basis: list[Float], coefficient: Callable[[int, int], Float]) -> list[Float]:
    """RGB = max(0.5 + sum_k basis_k coefficient(k, channel), 0); the gradient is 0 where it is clamped."""
    rgb = []
    for channel in range(3):
        value = basis[0] * coefficient(0, channel)
        for k in range(1, len(basis)):
            value = dr.fma(basis[k], coefficient(k, channel), value)
        value += 0.5
        rgb.append(dr.select(value > 0, value, 0))
    return rgb
