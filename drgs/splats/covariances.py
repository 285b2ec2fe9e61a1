"""Gaussians by their covariances: the quaternions and standard deviations of each, and how it is differentiated.

C = R S^2 R^T, but no derivative passes through R and S: the eigenvectors of a covariance with two equal eigenvalues
have none, although the image does. A small change of C is instead a strain E of space around the mean, symmetric, with
(I + E) C (I + E) = C + dC to first order,

    E C + C E = dC,    (R^T E R)_ij = (R^T dC R)_ij / (s_i^2 + s_j^2),

whose denominators are sums, not differences, of eigenvalues. The renderer is given strains of 0 that have this
derivative (`render_with_offsets`), so that it is exact for spheres, discs and needles, too: R^T E R, in the axes of the
Gaussian, for a disc's derivative across itself is too small for a sum of others to hold.
"""

from __future__ import annotations

import torch

from drgs.checks.arguments import ArgumentError

# share of the largest eigenvalue that one of 0 gets: a flat Gaussian has 1e-12 of its size as thickness
_MIN_EIGENVALUE_SHARE = 1e-24
_MIN_EIGENVALUE = 1e-40  # scene units squared, least eigenvalue: of a covariance of 0


def factors(
    where: str, covars: torch.Tensor, lead: tuple[int, ...] | None = None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Quaternions, standard deviations and strains of covariances (..., 3, 3), in float64.

    Args:
        where: Name of the caller, for messages.
        covars: Symmetric to rounding, no eigenvalue below 0; differentiable: both elements off the diagonal get half of
            the derivative by their common value.
        lead: Their leading axes; None: any.
    Returns:
        Quaternions (..., 4) wxyz and standard deviations (..., 3), numbers; strains (..., 6) of 0, the elements xx, xy,
        xz, yy, yz, zz of R^T E R, with the graph of the covariances.
    Raises:
        ValueError: If one is not symmetric, not finite, or has a negative eigenvalue.
    """
    is_tensor = isinstance(covars, torch.Tensor)
    shape = (*(covars.shape[:-2] if is_tensor and lead is None else lead or ()), 3, 3)
    if not is_tensor or tuple(covars.shape) != shape:
        got = tuple(covars.shape) if is_tensor else type(covars).__name__
        raise ArgumentError(f"{where}: covars must be a tensor of shape {shape}, got {got}; pass matrices")
    x = covars.to(torch.float64)
    fixed = x.detach()  # the axes in which a change is expressed have no derivative
    size = fixed.abs().amax((-1, -2)).clamp_min(1e-300)
    _refuse(where, ~torch.isfinite(fixed).all(-1).all(-1), fixed, "finite")
    skewed = (fixed - fixed.mT).abs().amax((-1, -2)) > 1e-5 * size
    _refuse(where, skewed, fixed, "symmetric to 1e-5 of its largest element")
    values, axes = torch.linalg.eigh(0.5 * (fixed + fixed.mT))
    _refuse(where, values[..., 0] < -1e-6 * size, fixed, "without a negative eigenvalue")
    values = torch.maximum(values, _MIN_EIGENVALUE_SHARE * values[..., 2:]).clamp_min(_MIN_EIGENVALUE)
    # A reflection of an axis is no rotation, and changes no Gaussian.
    mirrored = torch.linalg.det(axes) < 0
    axes = torch.cat([axes[..., :2], torch.where(mirrored[..., None, None], -axes[..., 2:], axes[..., 2:])], -1)
    change = x - fixed  # 0, with the graph
    seen = axes.mT @ (0.5 * (change + change.mT)) @ axes
    strain = seen / (values[..., :, None] + values[..., None, :])
    rows, columns = torch.triu_indices(3, 3, device=x.device)
    return _quaternions(axes), values.sqrt(), strain[..., rows, columns]


def strained(axes: torch.Tensor, strains: torch.Tensor) -> torch.Tensor:
    """(..., 3, 3) axes of unit length as columns, after strains (..., 6) in these axes: R (I + E)."""
    xx, xy, xz, yy, yz, zz = strains.unbind(-1)
    E = torch.stack([torch.stack(row, -1) for row in ([xx, xy, xz], [xy, yy, yz], [xz, yz, zz])], -2)
    return axes + axes @ E


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
    largest = K.diagonal(dim1=-2, dim2=-1).argmax(-1)
    return torch.take_along_dim(K, largest[..., None, None], -1)[..., 0]
