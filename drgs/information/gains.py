"""Information gain of a view, given the information of the known views: criteria of Fisher information.

`logdet` and `block_logdet` are twice a mutual information in nats, `eig` is its first-order bound, `v_opt` the drop of
the variance of pixels, `trace_cov` that of the variances of parameters.

Symbols: H Fisher information of the training views, Hc of a candidate (sums of squared derivatives of the image, unit
noise on every channel), l the prior's precision lambda, in the inverse squared unit of its parameter. `drgs.gain` is
the public side; docs/information.md says what the criteria mean, and where others publish something else under the same
names.

Reference:
    [1] Next Best View Selections for Semantic and Dynamic 3D Gaussian Splatting, arXiv 2512.22771: `eig`, section 3.3.
    [2] Jiang et al., FisherRF, ECCV 2024: `eig` of a diagonal, lambda = 1e-6.
    [3] Wilson et al., POp-GS, CVPR 2025: `logdet` ("D-opt"), `trace_cov` ("T-opt"), one block a Gaussian.
    [4] Bates & Watts, Nonlinear Regression Analysis, 1988: V-optimality. Ash et al. (BAIT), NeurIPS 2021: of a pool.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from drgs.checks.arguments import must_be
from drgs.checks.derivatives import ends_of
from drgs.information.criteria import criterion_named
from drgs.information.prior import Prior
from drgs.information.sums import Information

BLOCK_LAYOUT = {
    "means": slice(0, 3),
    "rotations": slice(3, 6),
    "log_scales": slice(6, 9),
    "logit_opacities": slice(9, 10),
    "sh": slice(10, 13),
}
"""Places of the groups in a block of `drgs.fisher.blocks`; of `sh` it holds the base color."""

DENSE = "blocks"  # the name under which blocks (N, 13, 13) travel as an Information

_CHUNK = 1 << 15  # parameters scored at a time: what fits in a core's cache is twice as fast
_ROUNDING = 1e-6  # share of a block's diagonal that float32 sums leave of an eigenvalue that is 0, on a real scene
_LARGEST_RIDGE = 1e-2  # share of a block's diagonal: more than a percent is not rounding any more
_BLOCKS_AT_ONCE = 1 << 12  # blocks of 1,352 bytes in each of several tensors: 3 times as fast as all, on 50,000
# share of a column's length that float64 leaves of one that depends on others: 100 times its rounding
_SINGULAR = 1e-13


@dataclasses.dataclass(frozen=True)
class Gain:
    """The score of a candidate, in nats for `logdet` (twice the mutual information of independent parameters).

    Attributes:
        total: Sum of the parts.
        parts: Group -> its share, weight included.
        left_out: Group -> number of parameters that were not counted: lambda = 0 and H = 0.
        unseen: Group -> the share of its part that comes from parameters with H = 0, which lambda alone decides.
        repaired: Blocks that rounding had made indefinite (`block_gain` only).
    """

    total: float
    parts: dict[str, float]
    left_out: dict[str, int]
    unseen: dict[str, float] = dataclasses.field(default_factory=dict)
    repaired: int = 0


def information_gain(
    candidate: Information,
    train: Information,
    criterion: str,
    prior: Prior | None = None,
    weights: Mapping[str, float] | None = None,
    pool: Information | None = None,
) -> Gain:
    """How much a candidate view adds to the training views, parameters taken as independent.

    `eig` = sum Hc / (H + l), `logdet` = sum log(1 + Hc / (H + l)), `trace_cov` = sum 1 / (H + l) - 1 / (H + Hc + l),
    `v_opt` = sum P (1 / (H + l) - 1 / (H + Hc + l)), P the information of all views that will be rendered: the drop of
    the predicted variance of their pixels [4].
    Features count once: all D channels have the same information, which divides out of the mean over them.

    Args:
        candidate, train: Same groups and shapes, entries >= 0.
        criterion: A name in `CRITERIA`, or `package.module:function` of a function (ratio, variance) -> terms, see
            `ViewCriterion`; `block_logdet` takes {"blocks": (N, 13, 13)}, see `block_gain`.
        prior: Default `Prior()`, lambda = 1e-6 everywhere.
        weights: Group -> factor >= 0, default 1. `trace_cov` adds variances of different units unless they say how.
        pool: P, of `v_opt` and criteria of one's own that need it; same groups and shapes.
    Raises:
        ValueError: If groups, shapes, criterion or weights are wrong, or an entry is negative, NaN or infinite.
    """
    for name, value in (("candidate", candidate), ("train", train)):
        must_be("information_gain", name, value, Mapping, "group -> tensor, as fisher.diagonal returns")
    if prior is not None:
        must_be("information_gain", "prior", prior, Prior, "e.g. drgs.gain.Prior(1e-6)")
    signed = criterion_named(criterion, "information_gain").of_blocks
    check("information_gain: train", train, signed)
    check("information_gain: candidate", candidate, signed)
    if pool is not None:
        must_be("information_gain", "pool", pool, Mapping, "group -> tensor, as fisher.diagonal returns")
        check("information_gain: pool", pool, signed)
    return scorer(train, criterion, prior, weights, pool)(candidate)


def scorer(
    train: Information,
    criterion: str,
    prior: Prior | None = None,
    weights: Mapping[str, float] | None = None,
    pool: Information | None = None,
    shares: Information | None = None,
) -> Callable[[Information], Gain]:
    """`information_gain` against a fixed H: what does not depend on the candidate is done once.

    Candidates are not searched for negative entries, see `check`; NaN or inf in them raises as the score is not finite.

    Args:
        train, criterion, prior, weights, pool: The same as for `information_gain`.
        shares: Factors in [0, 1] of what each parameter adds to the score, as `shares_of` makes them; None: 1.
    """
    rule = criterion_named(criterion, "information_gain")
    prior = prior or Prior()
    if (pool is not None) != rule.needs_pool:
        raise ValueError(
            f"information_gain: pool must be {'given' if rule.needs_pool else 'None'} with criterion {criterion}, got "
            f"{'none' if pool is None else 'one'}; it is the information of all views that will be rendered"
        )
    if rule.term is None:
        if weights:
            raise ValueError(
                f"information_gain: weights must be None for {criterion}, got {dict(weights)}; a block has no parts"
            )
        return _Blocks(train[DENSE], prior, BLOCK_LAYOUT, shares=None if shares is None else shares[DENSE])
    return _Diagonal(train, criterion, rule.term, prior, dict(weights or {}), pool, shares)


def shares_of(part: Information, whole: Information) -> dict[str, torch.Tensor]:
    """The share of each parameter's information that is of a part of it, float64 in [0, 1]; 0 where there is none.

    Args:
        part, whole: Group -> information, of the same parameters. Of dense blocks the share is one of each Gaussian,
            of the sums of the diagonals.
    """
    shares = {}
    for name, x in whole.items():
        own, all_of_it = (y.diagonal(dim1=1, dim2=2).sum(1) if name == DENSE else y for y in (part[name], x))
        ratio = own.to(torch.float64) / all_of_it.to(torch.float64)
        shares[name] = torch.where(all_of_it > 0, ratio, 0.0).clamp(0, 1)  # above 1 by rounding alone
    return shares


def variances(train: Information, prior: Prior | None = None) -> dict[str, torch.Tensor]:
    """1 / (H + l) a parameter, 0 where both are 0: what `drgs.fisher.variance_map` weighs a pixel's derivatives by.

    Raises:
        ValueError: If the prior names a group that H does not have, or an entry of H is negative, NaN or infinite.
    """
    check("variances", train)  # else what is broken had the variance of what is perfectly known
    lambdas = (prior or Prior()).per_group(train)
    result = {}
    for name, H in train.items():
        # float64: lambda = 1e-6 beside an H of 1e4 would vanish in float32.
        precision = H.to(torch.float64) + lambdas[name]
        # 1 / 0 would be inf and inf * 0 NaN; a variance of 0 drops the parameter from every criterion.
        result[name] = torch.where(precision > 0, precision.reciprocal(), 0.0)
    return result


def check(where: str, information: Information, signed: bool = False) -> None:
    """Raise ValueError, naming group and index, unless every entry is finite and, but for `signed` ones, >= 0.

    Args:
        where: What the error begins with.
        information: The information of one view or of many.
        signed: Whether entries may be negative, as those off the diagonal of dense blocks.
    """
    lowest = -math.inf if signed else 0.0
    for name, x in information.items():
        if not x.numel():
            continue
        low, high = ends_of(x)
        if lowest <= low and -math.inf < low and high < math.inf:
            continue
        bad = ~torch.isfinite(x) | (x < lowest)
        first = tuple(bad.nonzero()[0].tolist())
        raise ValueError(
            f"{where}: information must be finite{' and >= 0' if lowest == 0 else ''}, got {float(x[first]):g} in "
            f"{name} at {first} ({int(bad.sum())} of {x.numel()} entries); check the Gaussians and the camera"
        )


# -------------------------------------------------- parameters taken as independent


class _Diagonal:
    """Scores of candidates against a diagonal H."""

    def __init__(
        self,
        train: Information,
        criterion: str,
        term: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
        prior: Prior,
        weights: dict,
        pool: Information | None = None,
        shares: Information | None = None,
    ):
        for name, weight in weights.items():
            if name not in train:
                raise ValueError(f"information_gain: weights must be of {', '.join(train)}, got {name!r}; drop it")
            if not 0 <= weight < math.inf:
                raise ValueError(f"information_gain: weight of {name} must be in [0, inf), got {weight}; correct it")
        self.criterion = criterion
        self.term = term
        self.weights = weights
        self.inverse = variances(train, prior)
        self.left_out = {name: int((x == 0).sum()) for name, x in self.inverse.items()}
        self.unseen = {name: (H == 0).to(torch.float64) for name, H in train.items()}
        self.wanted = self.inverse
        self.shares = shares
        if pool is not None:
            _check_alike("pool", pool, self.inverse)
            self.wanted = {name: pool[name].to(torch.float64) * x for name, x in self.inverse.items()}

    def __call__(self, candidate: Information) -> Gain:
        """The gain of one candidate."""
        _check_alike("candidate", candidate, self.inverse)
        parts = {}
        unseen = {}
        for name, variance in self.inverse.items():
            weight = float(self.weights.get(name, 1.0))
            seen_or_not = 0.0
            only_unseen = 0.0
            rows = _informed_rows(candidate[name])
            each = [candidate[name], variance, self.wanted[name], self.unseen[name]]
            each += [] if self.shares is None else [self.shares[name]]
            chunks = (x[rows].flatten().split(_CHUNK) for x in each)
            for new, known, wanted, is_unseen, *share in zip(*chunks, strict=True):
                # float64, as ratios span more than float32 has digits for; a copy, which a term may overwrite.
                terms = self.term(new.to(torch.float64, copy=True).mul_(known), wanted)
                terms = terms * share[0] if share else terms
                seen_or_not += float(terms.sum())
                only_unseen += float(terms @ is_unseen)
            parts[name] = weight * seen_or_not
            unseen[name] = weight * only_unseen
        return Gain(_total(self.criterion, parts), parts, dict(self.left_out), unseen)


def _total(criterion: str, parts: dict[str, float]) -> float:
    """The sum of the parts, which must be finite."""
    total = math.fsum(parts.values()) if all(map(math.isfinite, parts.values())) else math.nan
    if not math.isfinite(total):
        raise ValueError(
            f"information_gain: {criterion} must be finite, got {parts}; H + lambda is too small for float64, "
            "raise lambda or check the information for NaN"
        )
    return total


def _informed_rows(candidate: torch.Tensor) -> torch.Tensor | Any:
    """Rows of which a view says anything: others have the term 0. `...`, all, where they are most."""
    if candidate.dim() == 0 or candidate.numel() < _CHUNK:
        return ...
    rows = candidate.reshape(len(candidate), -1).any(1)
    return rows.nonzero()[:, 0] if float(rows.float().mean()) < 0.8 else ...


def _check_alike(what: str, information: Information, train: Information) -> None:
    """Refuse information that is of other parameters than that of the training views."""
    if information.keys() != train.keys():
        raise ValueError(
            f"information_gain: {what} must have the groups of train, {', '.join(train)}, got "
            f"{', '.join(information)}; compute both alike"
        )
    for name, x in train.items():
        if information[name].shape != x.shape:
            raise ValueError(
                f"information_gain: {name} must have the shape of train, {tuple(x.shape)}, got "
                f"{tuple(information[name].shape)} of {what}; use the same Gaussians for both"
            )


# -------------------------------------------------- one block a Gaussian


def block_gain(
    candidate: torch.Tensor,
    train: torch.Tensor,
    prior: Prior | None = None,
    layout: Mapping[str, slice] | None = None,
    rounding: float = _ROUNDING,
) -> Gain:
    """sum_i logdet(I + (H_i + L)^-1 Hc_i): what `logdet` becomes when the parameters of a Gaussian are not independent.

    Args:
        candidate, train: (N, B, B), symmetric up to rounding, from `drgs.fisher.blocks`.
        prior: lambda per group of `layout`, on the diagonal.
        layout: Group -> slice of the block, default `BLOCK_LAYOUT`.
        rounding: H and Hc are taken as uncertain by this share of their diagonals, which is added to them: one or two
            views leave directions without information, and there the rounding of float32 sums would decide. 0 for
            blocks that are exact in float64.
    Returns:
        A `Gain` with one part, `blocks`. Parameters with lambda = 0 and H = 0 are left out; other singular directions
        get the gain that `rounding` allows.
    Raises:
        ValueError: If shapes are wrong, a value is not finite, or a block is not positive (semi)definite.
    """
    for where, x in (("train", train), ("candidate", candidate)):
        check(f"block_gain: {where}", {DENSE: x}, signed=True)
    return _Blocks(train, prior or Prior(), layout or BLOCK_LAYOUT, rounding)({DENSE: candidate})


class _Blocks:
    """Scores of candidates against one block a Gaussian."""

    def __init__(
        self,
        train: torch.Tensor,
        prior: Prior,
        layout: Mapping[str, slice],
        rounding: float = _ROUNDING,
        shares: torch.Tensor | None = None,
    ):
        if train.ndim != 3 or train.shape[1] != train.shape[2]:
            raise ValueError(
                f"block_gain: train must have shape (N, B, B), got {tuple(train.shape)}; use fisher.blocks"
            )
        if sorted(k for x in layout.values() for k in range(*x.indices(1 << 30))) != list(range(train.shape[1])):
            raise ValueError(
                f"block_gain: layout must cover 0..{train.shape[1] - 1} once, got {dict(layout)}; correct it"
            )
        self.rounding = rounding
        self.shares = shares
        self.H = train
        diagonal = train.diagonal(dim1=1, dim2=2).to(torch.float64)
        lambdas = prior.per_group({name: diagonal[:, place] for name, place in layout.items()})
        self.added = torch.empty(train.shape[1], dtype=torch.float64)
        for name, place in layout.items():
            self.added[place] = lambdas[name]
        self.keep = diagonal + self.added != 0  # NaN and what is negative stay, to be refused
        self.left_out = {name: int((~self.keep[:, place]).sum()) for name, place in layout.items()}
        self.before, self.repaired = _log_determinants([train], self.keep, self.added, rounding)

    def __call__(self, candidate: Information) -> Gain:
        """The gain of one candidate."""
        Hc = candidate[DENSE]
        if Hc.shape != self.H.shape:
            raise ValueError(
                f"block_gain: candidate must have the shape of train, {tuple(self.H.shape)}, got {tuple(Hc.shape)}; "
                "use the same Gaussians for both"
            )
        after, repaired = _log_determinants([self.H, Hc], self.keep, self.added, self.rounding)
        gains = after - self.before
        gains = gains if self.shares is None else gains * self.shares
        parts = {DENSE: float(gains.sum())}
        unseen = {DENSE: float(gains[self.H.diagonal(dim1=1, dim2=2).sum(1) == 0].sum())}
        return Gain(_total("block_logdet", parts), parts, dict(self.left_out), unseen, self.repaired + repaired)


def _log_determinants(
    summands: Sequence[torch.Tensor], keep: torch.Tensor, added: torch.Tensor, rounding: float
) -> tuple[torch.Tensor, int]:
    """(N,) float64 log determinants, and how many blocks rounding had made indefinite.

    Args:
        summands: (N, B, B) each, symmetric up to rounding; their sum is H.
        keep: (N, B) False where a parameter is left out, with its row and column.
        added: (B,) lambda, on the diagonals.
        rounding: Share of the diagonals of H that is added to them, too.
    Raises:
        ValueError: If a block is not positive definite by more than rounding.
    """
    chunks = zip(keep.split(_BLOCKS_AT_ONCE), *(x.split(_BLOCKS_AT_ONCE) for x in summands), strict=True)
    parts = [
        _log_determinants_of(number * _BLOCKS_AT_ONCE, own, blocks, added, rounding)
        for number, (own, *blocks) in enumerate(chunks)
    ]
    return torch.cat([logs for logs, _ in parts]), sum(repaired for _, repaired in parts)


def _log_determinants_of(
    first: int, keep: torch.Tensor, summands: list[torch.Tensor], added: torch.Tensor, rounding: float
) -> tuple[torch.Tensor, int]:
    """The same for the Gaussians from `first` on."""
    H = functools.reduce(torch.add, [x.to(torch.float64) for x in summands])
    diagonal = H.diagonal(dim1=1, dim2=2) * (1 + rounding) + added
    scale = torch.where(keep, diagonal.rsqrt(), 0.0)
    # Units differ by many powers of ten; with 1 on the diagonal Cholesky loses none of the small ones.
    A = scale[:, :, None] * (0.5 * (H + H.mT)) * scale[:, None, :]
    A.diagonal(dim1=1, dim2=2).fill_(1.0)
    factor, failed = torch.linalg.cholesky_ex(A)
    bad = failed.nonzero()[:, 0]
    repaired = len(bad)
    ridge = _ROUNDING
    while len(bad):
        if ridge > _LARGEST_RIDGE:
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


# -------------------------------------------------- whole Jacobians, of scenes where these fit


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
            "dense: H + lambda must be positive definite, got parameters that training rows cannot separate; "
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
