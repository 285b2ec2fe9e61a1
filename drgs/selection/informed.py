"""Policies by the information of views.

Those whose scores depend on what has been picked are greedy: take the best, add its information to H, score again
(`drgs.selection.greedy`). How a score comes from information is a `Scoring`; its criteria are in
`drgs.information.criteria`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Mapping
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.information.blocks import SceneBlocks
from drgs.information.criteria import criterion_named
from drgs.information.gains import DENSE
from drgs.information.quantity import Joint, Quantity, ViewContext
from drgs.information.sums import Information
from drgs.selection.combine import Combination, joint_and_combination
from drgs.selection.greedy import PoolView, ViewInformation, greedy
from drgs.selection.pool import Pool, Selection
from drgs.settings import RenderSettings

_FEW_PROBES = 8  # probes of a network's information, up to which 1 / H is far too large on average


def fisher(pool: Pool) -> Selection:
    """Largest gain of Fisher information, of the blocks of the image that the scoring names."""
    scoring = pool.scoring
    if pool.information is not None:  # its groups are its own
        return _greedy(pool)
    blocks = _blocks(pool)
    joint, combination = joint_and_combination(blocks)
    selection = _greedy(pool, joint, combination)
    selection.blocks = list(blocks.names)
    selection.semantics = blocks.metric.to_json() if blocks.metric else None
    if "deformation" in blocks.names:
        selection.network = {"score": scoring.network, "probes": scoring.probes}
        if scoring.network == "ratio" and scoring.probes < _FEW_PROBES:
            selection.notes.append(
                f"deformation: with {scoring.probes} probes the ratio Hc / H is too large for parameters that one "
                f"known view informs; use --probes {_FEW_PROBES} or more"
            )
    if combination.zscored:
        selection.combine = "zscore"
        selection.notes.append(f"scores are sums of z-scores of {', '.join(combination.zscored)} over the candidates")
    return selection


def fisherrf(pool: Pool) -> Selection:
    """Largest sum Hc / (H + lambda) of FisherRF's H, which has no rotations and no features."""
    from drgs.information.diagonal import Diagonal  # loads Dr.Jit, which poses alone need not have

    prior = pool.scoring.prior_of("fisherrf")
    weights = _without_rotations(pool.scoring.weights)
    # FisherRF's lambda is in world units, whatever these are.
    prior = dataclasses.replace(prior.over(1.0), groups=_without_rotations(prior.groups))
    joint = Joint((("", Diagonal("fisherrf", without=("features",))),))
    plain = dataclasses.replace(pool, masks=None)  # which FisherRF does not have
    return _greedy(_scored(plain, criterion="eig", prior=prior, weights=weights), joint)


def coverage(pool: Pool) -> Selection:
    """Largest sum Wc / (W + lambda), W = sum over pixels of w^2."""
    from drgs.information.diagonal import Coverage  # loads Dr.Jit, which poses alone need not have

    prior = dataclasses.replace(pool.scoring.prior_of("coverage"), groups={})
    return _greedy(_scored(pool, criterion="eig", prior=prior, weights={}), Joint((("", Coverage()),)))


@dataclasses.dataclass(frozen=True)
class _OwnInformation(Quantity):
    """Information by a function of the pool's, in float32 as that of `Joint`.

    Attributes:
        function: Camera -> Information.
        of_blocks: Whether entries may be negative, as those off the diagonal of blocks.
    """

    function: Callable[[Camera], Information]
    of_blocks: bool

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """What the function returns."""
        return {name: x.to(torch.float32) for name, x in self.function(view.camera).items()}

    def key(self, camera: Camera, settings: RenderSettings) -> Hashable:
        """The function may go by what a camera is called."""
        return self.function, camera.name, settings

    @property
    def signed(self) -> tuple[str, ...]:
        """Those of dense blocks."""
        return (DENSE,) if self.of_blocks else ()


def _greedy(pool: Pool, joint: Joint | None = None, combination: Combination | None = None) -> Selection:
    """`greedy` by a quantity of the views.

    Args:
        pool: The pool whose scoring says how much it counts.
        joint: The quantity; None: the pool's own information, whatever is given, is what counts.
        combination: How that becomes a score; default by the pool's scoring, all groups together.
    """
    if pool.information is not None:
        own = _OwnInformation(pool.information, criterion_named(pool.scoring.criterion, "select").of_blocks)
        return greedy(pool, ViewInformation(pool, own), combination)
    assert joint is not None  # as of every policy here
    of_known = Joint(tuple(part for part in joint.parts if part[1].needs_known_views))
    return greedy(pool, ViewInformation(pool, joint, of_known), combination)


def compute_candidates(pool: Pool) -> None:
    """Compute the information of the candidates that `fisher` scores by, for the pool's cache; nothing is scored."""
    joint, _ = joint_and_combination(_blocks(pool))
    views = [PoolView(f"candidate {i}", camera) for i, camera in enumerate(pool.candidates)]
    for _ in ViewInformation(pool, joint).each(views):
        pass


def _blocks(pool: Pool) -> SceneBlocks:
    """The blocks of the image that count."""
    views = [*pool.train, *pool.candidates]
    return SceneBlocks.of(pool.scene, pool.scoring, views, compute=pool.compute_each, empty_outside=pool.empty_outside)


def _scored(pool: Pool, **fields: Any) -> Pool:
    """The same pool with other fields of its scoring."""
    return dataclasses.replace(pool, scoring=dataclasses.replace(pool.scoring, **fields))


def _without_rotations(groups: Mapping[str, float]) -> dict[str, float]:
    """Values of the groups that FisherRF's rasterizer has."""
    return {name: x for name, x in groups.items() if name != "rotations"}
