"""Gaussians by their covariances, as quaternions and standard deviations: for who stores the matrices."""

from __future__ import annotations

import torch

from drgs.guards.arguments import ArgumentError

__all__ = ["quats_and_scales"]

_SAME = 1e-6  # relative difference of two eigenvalues, below which their axes are anybody's
_LEAST = 1e-40  # of an eigenvalue, whose square root is differentiated


def quats_and_scales(
    where: str, covars: torch.Tensor, lead: tuple[int, ...] | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """(..., 4) wxyz and (..., 3) of covariances (..., 3, 3), float64, by their eigenvectors.

    Args:
        where: What the caller is called, for messages.
        covars: Symmetric to rounding, no eigenvalue below 0; differentiable.
        lead: Their leading axes; None: any.
    Raises:
        ValueError: If one is not symmetric, not finite, or has a negative eigenvalue.
        NotImplementedError: If a derivative is asked for of one with two equal eigenvalues: what its off-diagonal
            elements do there is no rotation and no scaling of the axes that it has.
    """
    shape = (*(covars.shape[:-2] if lead is None else lead), 3, 3)
    if tuple(covars.shape) != shape:
        raise ArgumentError(f"{where}: covars must have shape {tuple(shape)}, got {tuple(covars.shape)}")
    x = covars.to(torch.float64)
    numbers = x.detach()  # checks have no derivative
    size = numbers.abs().amax((-1, -2)).clamp_min(1e-300)
    _refuse(where, ~torch.isfinite(numbers).all(-1).all(-1), numbers, "finite")
    skewed = (numbers - numbers.mT).abs().amax((-1, -2)) > 1e-5 * size
    _refuse(where, skewed, numbers, "symmetric to 1e-5 of its largest element")
    values, axes = torch.linalg.eigh(0.5 * (x + x.mT))
    found = values.detach()  # as above
    _refuse(where, found[..., 0] < -1e-6 * size, numbers, "without a negative eigenvalue")
    if covars.requires_grad:
        same = (found.diff(dim=-1) <= _SAME * size[..., None]).any(-1)
        if bool(same.any()):
            at = same.nonzero()[0].tolist()
            raise NotImplementedError(
                f"{where}: covars must have three different eigenvalues where they are differentiated, got "
                f"{found[tuple(at)].tolist()} at index {at}; pass quats and scales, or differentiate these"
            )
    # A reflection of an axis is no rotation, and changes no Gaussian.
    mirrored = torch.linalg.det(axes.detach()) < 0
    axes = torch.cat([axes[..., :2], torch.where(mirrored[..., None, None], -axes[..., 2:], axes[..., 2:])], -1)
    return _quaternions(axes), values.clamp_min(_LEAST).sqrt()


def _refuse(where: str, bad: torch.Tensor, values: torch.Tensor, must: str) -> None:
    """Raise for the first covariance that is bad."""
    if bool(bad.any()):
        at = bad.nonzero()[0].tolist()
        raise ArgumentError(
            f"{where}: covars must be {must}, got {values[tuple(at)].tolist()} at index {at}; correct it"
        )


def _quaternions(R: torch.Tensor) -> torch.Tensor:
    """(..., 4) wxyz, not normalized, of rotations (..., 3, 3): a column of the matrix whose columns are the quaternion
    times each of its entries, that with the largest diagonal element (Bar-Itzhack 2000).
    """
    m = [[R[..., i, j] for j in range(3)] for i in range(3)]
    (a, b, c), (d, e, f), (g, h, i) = m
    rows = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    K = torch.stack([torch.stack(row, -1) for row in rows], -2)
    largest = K.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)  # a choice, without a derivative
    return torch.take_along_dim(K, largest[..., None, None], -1)[..., 0]
