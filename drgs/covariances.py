"""Covariances as quaternions and scales, with the derivative by the covariance that an eigendecomposition loses.

C = R S^2 R^T. In the axes R, a change D = R^T dC R turns them by w and changes the scales,

    d s_i = D_ii / (2 s_i),        [w]x_ij = D_ij / (s_j^2 - s_i^2),

which does not exist where two scales are the same, although the image has a derivative there. Gaussians whose scales
are nearly the same get them spread by two small factors h and 2h, and 2 f'(h) - f'(2h) is the derivative within O(h^2).
"""

from __future__ import annotations

import torch

__all__ = ["SPREAD", "check_covariances", "factors", "nearly_round"]

SPREAD = 1e-2
"""Relative difference of variances below which they count as the same; also h above."""
_THIN = 1e-24  # of the largest variance: a flat Gaussian has this much in place of 0


def check_covariances(where: str, covars: torch.Tensor, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless covariances are symmetric, positive semidefinite and of shape (..., N, 3, 3).

    Args:
        where: The function that is called.
        covars: What was given.
        shape: (..., N).
    Raises:
        ValueError: They are not.
        NotImplementedError: They belong to `torch.func` or are dual numbers, which derivatives here do not know.
    """
    if not isinstance(covars, torch.Tensor) or tuple(covars.shape) != (*shape, 3, 3):
        got = tuple(covars.shape) if isinstance(covars, torch.Tensor) else type(covars).__name__
        raise ValueError(f"{where}: covars must be a tensor of shape {(*shape, 3, 3)}, got {got}; pass matrices")
    if (
        torch._C._functorch.is_functorch_wrapped_tensor(covars)
        or torch.autograd.forward_ad.unpack_dual(covars).tangent is not None
    ):
        raise NotImplementedError(
            f"{where}: derivatives by covars must be by torch.autograd's reverse mode, got torch.func or forward_ad; "
            "use backward, or quats and scales"
        )
    x = covars.detach().double()  # a check has no derivative
    if not x.numel():
        return
    size = x.abs().amax((-2, -1))
    least = torch.linalg.eigvalsh(x).amin(-1)
    skew = (x - x.transpose(-2, -1)).abs().amax((-2, -1))
    bad = ~((least >= -1e-6 * size) & (skew <= 1e-5 * size) & torch.isfinite(size))
    if bool(bad.any()):
        at = bad.nonzero()[0].tolist()
        raise ValueError(
            f"{where}: covars must be symmetric and positive semidefinite, got a smallest eigenvalue of "
            f"{float(least[tuple(at)]):g} at index {at}; form them as A A^T"
        )


def nearly_round(covars: torch.Tensor) -> torch.Tensor:
    """(...,) whether two variances of each of (..., 3, 3) differ by less than `SPREAD` of the larger one."""
    variances = torch.linalg.eigvalsh(covars.detach().double())  # which ones is a choice, without derivative
    return (variances.diff(dim=-1) < SPREAD * variances[..., 1:]).any(-1)


def factors(covars: torch.Tensor, spread: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Quaternions (..., 4) and scales (..., 3) of covariances (..., 3, 3), in their precision.

    Args:
        covars: Symmetric; the upper and the lower half get the same derivative.
        spread: Variances of what is `nearly_round` are spread by this factor; 0 leaves every value as it is, and gives
            what is nearly round no derivative by rotations.
    """
    fixed = covars.detach().double()  # the axes that a change is seen in
    variances, axes = torch.linalg.eigh(0.5 * (fixed + fixed.transpose(-2, -1)))
    axes = axes * torch.linalg.det(axes).sign()[..., None, None]
    variances = torch.maximum(variances, _THIN * variances[..., 2:].clamp_min(1e-30))
    if spread:
        steps = torch.tensor([-spread, 0.0, spread], dtype=torch.float64, device=fixed.device)
        variances = variances * (1 + steps * nearly_round(fixed)[..., None])
    change = covars.double() - fixed  # 0, with a graph
    seen = axes.transpose(-2, -1) @ (0.5 * (change + change.transpose(-2, -1))) @ axes
    scales = variances.sqrt()
    scales = scales + seen.diagonal(dim1=-2, dim2=-1) / (2 * scales)

    def turn(i: int, j: int) -> torch.Tensor:
        gap = variances[..., j] - variances[..., i]
        near = gap.abs() < 0.5 * SPREAD * torch.maximum(variances[..., i], variances[..., j])
        return torch.where(near, 0.0, seen[..., i, j] / torch.where(near, 1.0, gap))

    half = 0.5 * torch.stack([turn(2, 1), turn(0, 2), turn(1, 0)], -1)
    return _turned(_quaternions(axes), half).to(covars.dtype), scales.to(covars.dtype)


def _turned(q: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    """q times (1, half): a turn by 2 half in the axes that q describes, to first order."""
    w, v = q[..., :1], q[..., 1:]
    real = w - (v * half).sum(-1, keepdim=True)
    return torch.cat([real, v + w * half + torch.linalg.cross(v, half)], -1)


def _quaternions(R: torch.Tensor) -> torch.Tensor:
    """(..., 4) wxyz of rotations (..., 3, 3): the row of 4 q q^T with the largest diagonal (Shepperd 1978)."""
    r = lambda i, j: R[..., i, j]  # noqa: E731
    trace = r(0, 0) + r(1, 1) + r(2, 2)
    squares = [1 + trace, *[1 - trace + 2 * r(k, k) for k in range(3)]]
    x, y, z = r(2, 1) - r(1, 2), r(0, 2) - r(2, 0), r(1, 0) - r(0, 1)
    xy, xz, yz = r(0, 1) + r(1, 0), r(0, 2) + r(2, 0), r(1, 2) + r(2, 1)
    rows = [[squares[0], x, y, z], [x, squares[1], xy, xz], [y, xy, squares[2], yz], [z, xz, yz, squares[3]]]
    table = torch.stack([torch.stack(row, -1) for row in rows], -2)
    best = torch.stack(squares, -1).argmax(-1)[..., None, None]
    return torch.nn.functional.normalize(table.gather(-2, best.expand(*best.shape[:-1], 4)).squeeze(-2), dim=-1)
