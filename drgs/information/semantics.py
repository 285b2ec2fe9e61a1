"""How much a difference of features counts: the metric of a frozen decoder, and scalar channels that sum up to it.

A pixel's features F = sum_i w_i f_i are decoded to W F + b. With unit noise in every decoded channel, what the feature
image says about a parameter theta is sum_p (dF_p/dtheta)^T M (dF_p/dtheta), M = W^T W; the bias is a constant. Features
have no direction and no background, so for the geometry of Gaussian i the derivative at a hit is
(da/dtheta) T (f_i - B_i), with B_i the features composited behind it, and only the square of one length is needed:
q = T^2 (f_i - B_i)^T M (f_i - B_i).

Everything here turns that length into a sum of squares of K scalar channels a Gaussian, which the replay composites
beside the colors: (f - B)^T M (f - B) = sum_k (y_k - B(y)_k)^2 with y = P^T f, as compositing is linear.

    exact      P P^T = M: one channel for each direction that the decoder sees
    collapsed  P = L S / sqrt(K), M = L L^T, S random signs (rank, K): the sum's expected value is right
    principal  P = L [Q_1 ... Q_{K-1}, S]: the directions in which the Gaussians' decoded features differ most from 0,
               each exactly, and what is left of them collapsed into one channel: the expected value is right as well,
               and only what is left is random (as Hutch++ [1] does for traces)

Reference:
    [1] Meyer, Musco, Musco, Woodruff: Hutch++: Optimal Stochastic Trace Estimation, SOSA 2021.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any, Protocol

import torch

from drgs.checks.arguments import must_be
from drgs.information.choices import ESTIMATES, Estimate

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians

_RANK_TOLERANCE = 1e-12  # of the largest eigenvalue: below, float64 rounding of W^T W
# Gaussians that the directions in which features differ are computed from: any directions are right, these have little
# variance
_SAMPLED_GAUSSIANS = 4096


class _Decodes(Protocol):
    """What a metric can be made of."""

    def metric(self) -> torch.Tensor:
        """(D, D) W^T W."""


@dataclasses.dataclass(frozen=True, eq=False)
class SemanticMetric:
    """The metric in which features count, frozen: no information is about the decoder's weights.

    Two are equal if they give the same numbers.

    Attributes:
        matrix: (D, D) float64, symmetric and positive semidefinite: W^T W of the decoder.
        weight: gamma, the inverse noise variance of a decoded channel, where that of a color is 1.
        estimate: `exact`, `principal` or `collapsed` (the module's text).
        samples: K, channels of `principal` and `collapsed`; `exact` is taken where it needs no more.
        seed: Seed of its signs: the same for all views that are compared.
    Raises:
        ValueError: If a value is out of range, or the matrix is no metric.
    """

    matrix: torch.Tensor
    weight: float = 1.0
    estimate: Estimate = "principal"
    samples: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        must_be("SemanticMetric", "matrix", self.matrix, torch.Tensor, "e.g. decoder.metric()")
        # A copy that no graph and no later step of the optimizer reaches: the metric is frozen.
        M = self.matrix.detach().to("cpu", torch.float64, copy=True)
        if M.ndim != 2 or M.shape[0] != M.shape[1] or not len(M):
            raise ValueError(
                f"SemanticMetric: matrix must be (D, D) with D >= 1, got {tuple(M.shape)}; use decoder.metric()"
            )
        if not torch.isfinite(M).all():
            raise ValueError("SemanticMetric: matrix must be finite, got NaN or Inf; check the decoder")
        if float((M - M.T).abs().max()) > 1e-6 * float(M.abs().max()):  # more than W^T W in float32 leaves
            raise ValueError("SemanticMetric: matrix must be symmetric, got one that is not; use W.T @ W")
        object.__setattr__(self, "matrix", 0.5 * (M + M.T))
        if not (isinstance(self.weight, int | float) and 0 < self.weight < float("inf")):
            raise ValueError(f"SemanticMetric: weight must be a finite number > 0, got {self.weight!r}; try 1")
        if self.estimate not in ESTIMATES:
            known = ", ".join(ESTIMATES)
            raise ValueError(f"SemanticMetric: estimate must be one of {known}, got {self.estimate!r}; choose one")
        if not (isinstance(self.samples, int) and self.samples >= 1):
            raise ValueError(f"SemanticMetric: samples must be a whole number >= 1, got {self.samples!r}; try 4")
        if not (isinstance(self.seed, int) and 0 <= self.seed < 1 << 63):
            raise ValueError(f"SemanticMetric: seed must be a whole number >= 0, got {self.seed!r}; try 0")
        self._factor  # noqa: B018  refuses what is not positive semidefinite

    @classmethod
    def of(cls, decoder: _Decodes | None, width: int, **fields: Any) -> SemanticMetric:
        """The metric of a decoder as it is now; without one, that of `width` channels that count alike."""
        return cls(torch.eye(width, dtype=torch.float64) if decoder is None else decoder.metric(), **fields)

    @property
    def width(self) -> int:
        """D, channels of a feature."""
        return len(self.matrix)

    @property
    def scale(self) -> float:
        """Information about a channel of a feature per sum w^2, on average over the channels: gamma tr(M) / D."""
        return self.weight * float(self.matrix.trace()) / self.width

    @functools.cached_property
    def _factor(self) -> torch.Tensor:
        """(D, rank) L with L L^T = M, without the directions that the decoder does not see."""
        values, vectors = torch.linalg.eigh(self.matrix)
        top = float(values[-1])
        if float(values[0]) < -1e-6 * max(top, 0.0) or top < 0:  # below what rounding of float32 makes of 0
            raise ValueError(
                f"SemanticMetric: matrix must be positive semidefinite, got an eigenvalue of {float(values[0]):.3g}; "
                "use W.T @ W"
            )
        seen = values > _RANK_TOLERANCE * self.width * top
        return vectors[:, seen] * values[seen].sqrt()

    def directions(self, features: torch.Tensor) -> torch.Tensor:
        """(D, K) P: the channels of (N, D) features are P^T f. No more than the directions that the decoder sees."""
        L, K = self._factor, self.samples
        rank = L.shape[1]
        if self.estimate == "exact" or rank <= K:
            return L
        generator = torch.Generator().manual_seed(self.seed)
        draw = lambda *shape: torch.randint(0, 2, shape, generator=generator).double() * 2 - 1  # noqa: E731
        if self.estimate == "collapsed":
            return L @ draw(rank, K) / K**0.5
        # Detached: directions are frozen, too. float64, for eigenvectors of sums of thousands of squares.
        some = features[:: max(1, len(features) // _SAMPLED_GAUSSIANS)].detach().double().cpu() @ L
        Q = torch.linalg.eigh(some.T @ some)[1].flip(1)  # eigenvalues descend
        return L @ torch.cat([Q[:, : K - 1], Q[:, K - 1 :] @ draw(rank - K + 1, 1)], 1)

    def channels(self, features: torch.Tensor) -> torch.Tensor:
        """(N, K) float32 scalars of (N, D) features, whose squared differences add up to that of the features."""
        P = self.directions(features)
        # A part at a time: float64 of all would be twice the features, and fit no cache.
        parts = [(part.double().cpu() @ P).float() for part in features.detach().split(_SAMPLED_GAUSSIANS)]
        return torch.cat(parts).to(features.device) if parts else features.new_zeros(0, P.shape[1])

    def squares(self, features: torch.Tensor) -> torch.Tensor:
        """(...) gamma f^T M f of (..., D) features, exactly."""
        return self.weight * (features.double().cpu() @ self._factor).square().sum(-1)

    def signs(self, pixels: int, generator: torch.Generator) -> torch.Tensor:
        """(pixels, rank) float64 random signs v, one a pixel and direction that the decoder sees."""
        return torch.randint(0, 2, (pixels, self._factor.shape[1]), generator=generator).double() * 2 - 1

    def cotangent(self, v: torch.Tensor) -> torch.Tensor:
        """(pixels, D) float32 sqrt(gamma) L v of (pixels, rank) v."""
        return (self.weight**0.5 * v @ self._factor.T).float()

    def check(self, where: str, gaussians: Gaussians) -> None:
        """Raise ValueError unless the Gaussians have features of this width."""
        if gaussians.features is None:
            raise ValueError(f"{where}: semantics must be of a scene with features, got one without; drop semantics")
        if gaussians.features.shape[1] != self.width:
            raise ValueError(
                f"{where}: semantics must be of the width of the features, {gaussians.features.shape[1]}, got "
                f"{self.width}; use the decoder of this scene"
            )

    def to_json(self) -> dict:
        """What a report says of it; not the matrix."""
        sampled = {"samples": self.samples, "seed": self.seed} if self.estimate != "exact" else {}
        return {"estimate": self.estimate, **sampled, "gamma": self.weight, "width": self.width}

    def _value(self) -> tuple:
        numbers = (self.weight, self.estimate, self.samples, self.seed)
        return (self.matrix.numpy().tobytes(), *numbers)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SemanticMetric) and self._value() == other._value()

    def __hash__(self) -> int:
        return hash(self._value())
