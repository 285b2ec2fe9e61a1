"""The unknowns of a view itself (nuisances), eliminated from its information about the scene.

A photograph has unknowns of its own besides the scene's: three log gains g (exposure and white balance), image_c' =
exp(g_c) image_c, and the pose of its camera, a twist of six numbers. With J the Jacobian of the view's rows (channels
of pixels, each divided by its noise and multiplied by its mask) by the scene's parameters, N that by the m unknowns and
P the precision with which these are known before, the information about the scene is the Schur complement

    H = J^T J - J^T N (N^T N + P)^-1 N^T J = J^T W J,     W = 1 - N (N^T N + P)^-1 N^T = (1 + N P^-1 N^T)^-1

(the inverse of H is the scene's part of the inverse of all information about both). N (N^T N + P)^-1 N^T = U S U^T with
orthonormal U of at most m columns and shares S in (0, 1], all 1 where nothing is known before (P = 0), so that of an
entry of the diagonal, or a block of a Gaussian,

    H_kk = sum_p J_pk^2 - sum_j S_j (U_j^T J_k)^2,      H_i = J_i^T J_i - sum_j S_j (J_i^T U_j) (J_i^T U_j)^T

and U_j^T J is one reverse pass with U_j as the derivative by the image. Estimates by
random rows u, E u u^T = 1, take W^(1/2) u = u - U (1 - (1 - S)^(1/2)) U^T u in
their place.

That U, not N, goes through the renderer is for float32: rounding of a pass is relative to the length of what goes
through it, and N^T N of a pose is nearly singular, because a camera that turns and one that moves sideways show much
the same.
"""

from __future__ import annotations

import dataclasses

import torch

_NULL = 1e-8
"""Eigenvalue of the nuisances' information, scaled to a diagonal of 1, below which a direction is none: what rounding
of float32 images leaves of a direction that changes nothing (1e-6 of what each unknown alone does), squared, is 1e-12.
A direction of unknowns that together do less than 1e-4 of what each does alone stays in the scene's information."""
_MIN_SHARE = 1e-12  # of a direction's information; below it the prior on the unknowns decides, and nothing is lost
_ROUNDING = 4e-6
"""Share of an entry that is no information: the sum and what is taken from it are sums of float32 images that were
found in two ways, apart by up to 1e-6 of the entry on scenes of 20,000 Gaussians."""


def remaining(whole: torch.Tensor, lost: torch.Tensor) -> torch.Tensor:
    """Entries of a diagonal less the share that a view's unknowns explain; 0 where the rest is rounding, of either
    sign.
    """
    rest = whole - lost
    return torch.where(rest > _ROUNDING * whole, rest, 0.0)


def remaining_blocks(whole: torch.Tensor, lost: torch.Tensor) -> torch.Tensor:
    """(N, B, B) blocks less what a view's unknowns explain; of blocks that lose more than rounding, 0 along directions
    where the rest is rounding, of either sign.
    """
    rest = whole - lost
    before, taken = (x.diagonal(dim1=1, dim2=2) for x in (whole, lost))
    changed = (taken > _ROUNDING * before).any(1) & rest.flatten(1).isfinite().all(1)
    size = before[changed].sqrt()
    inverse = torch.where(size > 0, 1 / size, 0.0)
    values, vectors = torch.linalg.eigh(inverse[:, :, None] * rest[changed] * inverse[:, None, :])
    kept = torch.where(values > _ROUNDING, values, 0.0)
    rest[changed] = size[:, :, None] * ((vectors * kept[:, None, :]) @ vectors.mT) * size[:, None, :]
    return rest


@dataclasses.dataclass(frozen=True, eq=False)
class Eliminated:
    """The part of a view's rows that its own unknowns explain.

    Attributes:
        directions: (pixels, C, r) float64 U, orthonormal over all rows.
        shares: (r,) float64 S, share of a direction's information that the view alone has; 1: nothing is known before.
    """

    directions: torch.Tensor
    shares: torch.Tensor

    @classmethod
    def spanned(cls, N: torch.Tensor, precision: torch.Tensor) -> Eliminated:
        """U and S of the (pixels, C, m) float64 derivatives N of the rows by m unknowns, and their precisions (m,)."""
        flat = N.reshape(-1, N.shape[-1])
        M = flat.T @ flat + torch.diag(precision)
        size = M.diagonal().sqrt()
        inverse = torch.where(size > 0, 1 / size, 0.0)  # an unknown that changes nothing, as of a black view
        values, vectors = torch.linalg.eigh(inverse[:, None] * M * inverse)
        there = values > _NULL
        Q = flat @ (inverse[:, None] * vectors[:, there] / values[there].sqrt())
        # Q Q^T is N M^-1 N^T; its own eigenvectors are orthonormal whatever is known before.
        shares, turned = torch.linalg.eigh(Q.T @ Q)
        seen = shares > _MIN_SHARE
        U = Q @ (turned[:, seen] / shares[seen].sqrt())
        # A share is at most 1 but for rounding, which would be information below 0.
        return cls(U.reshape(*N.shape[:-1], -1), shares[seen].clamp_max(1.0))

    def __len__(self) -> int:
        return len(self.shares)

    def root(self, rows: torch.Tensor) -> torch.Tensor:
        """W^(1/2) times (..., pixels, C) float64 rows."""
        flat = self.directions.reshape(-1, len(self))
        own = rows.flatten(-2)
        along = (own @ flat) * (1 - (1 - self.shares).sqrt())
        return (own - along @ flat.T).reshape(rows.shape)

    def lost(self, rows: torch.Tensor) -> torch.Tensor:
        """(...) of the squared length of (..., pixels, C) float64 rows, what the unknowns explain."""
        return ((rows.flatten(-2) @ self.directions.reshape(-1, len(self))).square() * self.shares).sum(-1)
