"""The diagonal of J^T J from J^T of a view: mean of (J^T v)^2 over random images v, one reverse pass each."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from drgs.information.complement import left
from drgs.information.elimination import ViewRows
from drgs.information.groups import Information
from drgs.information.pullback import Pullback
from drgs.information.replay import Replay
from drgs.tracing.call import Call
from drgs.tracing.errors import own_errors

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import DeformableScene, Gaussians
    from drgs.information.nuisances import Nuisances
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings

__all__ = ["by_probes"]


@own_errors()
def by_probes(
    gaussians: Gaussians,
    camera: Camera,
    settings: RenderSettings,
    groups: dict,
    weights: Sequence[float],
    probes: int,
    seed: int,
    semantics: SemanticMetric | None = None,
    scene: DeformableScene | None = None,
    mask: torch.Tensor | None = None,
    nuisances: Nuisances | None = None,
) -> Information:
    """Mean of (J^T v)^2 over Rademacher images v of RGB and decoded features; what only features tell about is exact.

    Args:
        semantics: The metric of the features; v has a sign for each direction that the decoder sees, and L v is what
            the features get of it, for E (J^T L v)^2 = diag(J^T M J). None: v is of RGB only.
        scene: The scene that the Gaussians come from: all groups are of it then.
        mask: (H, W) what the image is multiplied by; None: 1.
        nuisances: Unknowns of the view that are eliminated: v is freed of what they explain, for E (J^T W^(1/2) v)^2.
    """
    if not (isinstance(probes, int) and probes >= 1):
        raise ValueError(f"fisher.diagonal: probes must be >= 1 and whole, got {probes!r}; try 16")
    other = {name: group for name, group in groups.items() if group.outputs != (0, 3)}
    groups = {name: group for name, group in groups.items() if name not in other}
    total = {name: torch.zeros(group.shape(gaussians), dtype=torch.float64) for name, group in groups.items()}
    # Detached: information is a number, and its derivatives are taken by Dr.Jit. Features that nobody asks about would
    # be composited for nothing.
    seen = gaussians.detach() if semantics else gaussians.detach().replace(features=None)
    call = Call(seen, camera, settings, frozenset(), scene=scene)
    generator = torch.Generator().manual_seed(seed)
    pull = Pullback(call, [group.input for group in groups.values()])
    root = torch.tensor(weights).sqrt()
    # float32, as cotangents of images are; squares of the slopes are summed in float64.
    factor = torch.ones(1, 1) if mask is None else mask.detach().float().cpu().reshape(-1, 1)
    # With a row for each direction that the decoder sees, as v has.
    every = None if semantics is None else dataclasses.replace(semantics, estimate="exact")
    rows = ViewRows.of(gaussians, camera, settings, weights, every, mask, nuisances)
    for _ in range(probes if groups else 0):
        sign = torch.randint(0, 2, (call.pixels, 3), generator=generator).float() * 2 - 1
        signs = semantics.signs(call.pixels, generator) if semantics else None
        if rows is not None:
            v = rows.eliminated.root(sign.double() if signs is None else torch.cat([sign.double(), signs], 1))
            sign, signs = v[:, :3].float(), None if signs is None else v[:, 3:]
        features = semantics.cotangent(signs) * factor if semantics and signs is not None else None
        slopes = pull(sign * root * factor, features)
        for name, group in groups.items():
            total[name] += group.pull(slopes[group.input], call.inputs[group.input].double().cpu()).square()
    result = {name: x / probes for name, x in total.items()}
    if other:
        replay = Replay(gaussians, camera, settings, geometry=False, semantics=semantics, mask=mask)
        result |= replay.diagonal(other, weights, False)
        if rows is not None:
            result |= {name: left(result[name], lost) for name, lost in rows.lost(other).items()}
    return result
