"""The exact information gain of a linear model beside what is computed of real scenes; for scenes where J fits.

Reference:
    [1] Next Best View Selections for Semantic and Dynamic 3D Gaussian Splatting, arXiv 2512.22771.
"""

from __future__ import annotations

import dataclasses

import torch

__all__ = ["Chain", "dense"]

# Of a column's length: what float64 leaves of a column that depends on the others, some hundred times its rounding.
_SINGULAR = 1e-13


@dataclasses.dataclass(frozen=True)
class Chain:
    """From the exact expected information gain of a linear model to what is computed on real scenes, all in nats.

    Attributes:
        mutual_information: 0.5 logdet(I + R^-T Hc R^-1), R^T R = H + L, full matrices.
        trace_bound: 0.5 tr((H + L)^-1 Hc) >= mutual_information.
        block_logdet: 0.5 sum_b logdet(I + (H_b + L_b)^-1 Hc_b) over the diagonal blocks, None without labels.
        logdet, eig: 0.5 times the criteria of the diagonals. Neither bounds the two above.
        left_out: Parameters with lambda = 0 that no training row moves.
    """

    mutual_information: float
    trace_bound: float
    block_logdet: float | None
    logdet: float
    eig: float
    left_out: int


def dense(
    candidate: torch.Tensor, train: torch.Tensor, prior: float | torch.Tensor, labels: torch.Tensor | None = None
) -> Chain:
    """The chain of [1], section 3.3, from whole Jacobians: P up to a few thousand.

    Args:
        candidate, train: (M, P) and (M', P) Jacobians, one row a pixel and channel.
        prior: lambda, a number or (P,).
        labels: (P,) integers, the block each parameter belongs to.
    Raises:
        ValueError: If a shape is wrong, or H + lambda is singular after leaving out what no row moves.
    """
    # float64 is what the chain is about: its inequalities hold to rounding, which float32 would break.
    Jc, J = candidate.to(torch.float64), train.to(torch.float64)
    if Jc.ndim != 2 or J.ndim != 2 or Jc.shape[1] != J.shape[1]:
        raise ValueError(
            f"dense: candidate and train must be (M, P) and (M', P), got {tuple(Jc.shape)} and {tuple(J.shape)}; "
            "one column a parameter"
        )
    added = torch.as_tensor(prior, dtype=torch.float64).expand(J.shape[1])
    keep = (J != 0).any(0) | (added > 0)
    Jc = Jc[:, keep]
    J = J[:, keep]
    added = added[keep]
    # R from the rows themselves: H = J^T J would square the condition number.
    rows = torch.cat([J, added.sqrt().diag()])
    length = rows.norm(dim=0)
    R = torch.linalg.qr(rows / length, mode="r")[1]
    if len(R) and not bool((R.diagonal().abs() > _SINGULAR).all()):
        raise ValueError(
            "dense: H + lambda must be positive definite, got parameters that training rows cannot tell apart; "
            "use lambda > 0"
        )
    whitened = torch.linalg.solve_triangular(R, Jc / length, upper=True, left=False)
    spectrum = torch.linalg.svdvals(whitened).square()
    H = J.square().sum(0) + added
    Hc = Jc.square().sum(0)
    ratio = Hc / H
    blocks = None
    if labels is not None:
        labels = torch.as_tensor(labels)[keep]
        blocks = 0.0
        for label in labels.unique():
            one = labels == label
            blocks += dense(Jc[:, one], J[:, one], added[one]).mutual_information
    return Chain(
        mutual_information=0.5 * float(spectrum.log1p().sum()),
        trace_bound=0.5 * float(spectrum.sum()),
        block_logdet=blocks,
        logdet=0.5 * float(ratio.log1p().sum()),
        eig=0.5 * float(ratio.sum()),
        left_out=int((~keep).sum()),
    )
