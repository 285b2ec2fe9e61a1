"""Log determinants of the blocks of H, one a Gaussian: what float32 sums allow, in little memory."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch

__all__ = ["ROUNDING", "log_determinants"]

ROUNDING = 1e-6  # relative to the diagonal: what float32 sums leave of an eigenvalue that is 0, on a real scene

_AT_ONCE = 1 << 12  # blocks of 1,352 bytes in each of several tensors: 3 times as fast as all, on 50,000


def log_determinants(
    told: Sequence[torch.Tensor], keep: torch.Tensor, added: torch.Tensor, rounding: float
) -> tuple[torch.Tensor, int]:
    """(N,) float64 log determinants, and how many blocks rounding had made indefinite.

    Args:
        told: (N, B, B) each, symmetric up to rounding; their sum is H.
        keep: (N, B) False where a parameter is left out, with its row and column.
        added: (B,) lambda, on the diagonals.
        rounding: Share of the diagonals of H that is added to them, too.
    Raises:
        ValueError: If a block is not positive definite by more than rounding.
    """
    chunks = zip(keep.split(_AT_ONCE), *(x.split(_AT_ONCE) for x in told), strict=True)
    parts = [_some(number * _AT_ONCE, own, blocks, added, rounding) for number, (own, *blocks) in enumerate(chunks)]
    return torch.cat([logs for logs, _ in parts]), sum(repaired for _, repaired in parts)


def _some(
    first: int, keep: torch.Tensor, told: list[torch.Tensor], added: torch.Tensor, rounding: float
) -> tuple[torch.Tensor, int]:
    """The same for the Gaussians from `first` on."""
    H = functools.reduce(torch.add, [x.to(torch.float64) for x in told])
    diagonal = H.diagonal(dim1=1, dim2=2) * (1 + rounding) + added
    scale = torch.where(keep, diagonal.rsqrt(), 0.0)
    # Units differ by many powers of ten; with 1 on the diagonal Cholesky loses none of the small ones.
    A = scale[:, :, None] * (0.5 * (H + H.mT)) * scale[:, None, :]
    A.diagonal(dim1=1, dim2=2).fill_(1.0)
    factor, failed = torch.linalg.cholesky_ex(A)
    bad = failed.nonzero()[:, 0]
    repaired = len(bad)
    ridge = ROUNDING
    while len(bad):
        if ridge > 1e-2:  # a percent of the diagonal is not rounding any more
            raise ValueError(
                f"block_gain: H + lambda must be positive definite, but is not for Gaussian {first + int(bad[0])}; "
                "raise lambda or pass blocks that are sums of outer products"
            )
        again = A[bad]
        again.diagonal(dim1=1, dim2=2).add_(ridge)
        factor[bad], failed = torch.linalg.cholesky_ex(again)
        bad = bad[failed > 0]
        ridge = 10 * ridge
    logs = 2 * factor.diagonal(dim1=1, dim2=2).log() + torch.where(keep, diagonal, 1.0).log()
    return logs.sum(1), repaired
