"""What keeps the planes of a field smooth, and still where nothing moves: terms of a loss, each a scalar.

As 4D Gaussian Splatting has them, but that its "plane TV" takes differences along one of the two axes only. All are
sums over planes and levels of means over entries, so that a weight means the same at each resolution. They are
differentiated by the planes, in reverse mode, once.

Reference:
    Cao & Johnson 2023 (HexPlane), section 3.3; Fridovich-Keil et al. 2023 (K-Planes), section 3.2; Wu et al. 2024
    (4D Gaussian Splatting), section 4.3.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch

from drgs.checks.derivatives import first_only
from drgs.dynamics.hexplane import HexPlane, levels


def time_smoothness(grid: HexPlane) -> torch.Tensor:
    """Mean squared second difference along the time of the planes (t, x), (t, y), (t, z): what moves does so evenly.

    0 of a plane with fewer than three times.
    """
    return _sum(_Bend.apply(plane, (0,)) for _, times in levels(list(grid)) for plane in times)


def plane_smoothness(grid: HexPlane) -> torch.Tensor:
    """Mean squared second difference along both axes of the planes (x, y), (x, z), (y, z): neighbors move alike.

    The mean over both axes, so that a weight of 4DGS keeps its strength.
    """
    return _sum(_Bend.apply(plane, (0, 1)) for space, _ in levels(list(grid)) for plane in space)


def time_l1(grid: HexPlane) -> torch.Tensor:
    """Mean |1 - plane| of the planes with a time: 1, as at the start, is a factor that no time changes."""
    return _sum(_FromOne.apply(plane) for _, times in levels(list(grid)) for plane in times)


def _sum(parts: Iterable[torch.Tensor]) -> torch.Tensor:
    return torch.stack(list(parts)).sum()


class _Bend(torch.autograd.Function):
    """Mean of |x_(k-1) - 2 x_k + x_(k+1)|^2, over entries and axes; its gradient is known with it."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, axes: tuple[int, ...]) -> torch.Tensor:
        total = x.new_zeros(())
        slope = torch.zeros_like(x)
        for axis in axes:
            inner = x.shape[axis] - 2
            if inner < 1:
                continue
            d = x.narrow(axis, 0, inner) + x.narrow(axis, 2, inner)
            d.sub_(x.narrow(axis, 1, inner), alpha=2)
            scale = 1 / (d.numel() * len(axes))
            total.add_(torch.dot(d.reshape(-1), d.reshape(-1)), alpha=scale)
            for start, weight in ((0, 1.0), (1, -2.0), (2, 1.0)):
                slope.narrow(axis, start, inner).add_(d, alpha=2 * weight * scale)
        ctx.save_for_backward(slope, x)
        return total

    @staticmethod
    def backward(ctx: Any, cotangent: torch.Tensor) -> tuple[torch.Tensor | None, None]:  # type: ignore[override]
        slope, x = ctx.saved_tensors
        (found,) = first_only("smoothness of a field", (slope * cotangent,), (x, cotangent))
        return found, None


class _FromOne(torch.autograd.Function):
    """Mean |1 - x|, with slope 0 at 1."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(x)
        return (x - 1).abs_().mean()

    @staticmethod
    def backward(ctx: Any, slope: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        return (x - 1).sign_().mul_(slope / x.numel())
