"""The diagonal of J^T J from random images: mean of (J^T v)^2, one reverse pass a probe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import torch

from drgs.information.groups import Information
from drgs.information.replay import Replay
from drgs.tracing.bridge import own_errors, to_drjit
from drgs.tracing.call import Call

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import DeformableScene, Gaussians
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
) -> Information:
    """Mean of (J^T v)^2 over Rademacher images v of RGB and decoded features; what only features tell about is exact.

    Args:
        semantics: Of the features; v has a sign for each direction that the decoder sees, and L v is what the features
            get of it, for E (J^T L v)^2 = diag(J^T M J). None: v is of RGB only.
        scene: Where the Gaussians come from: all groups are of this scene then.
    """
    if probes < 1:
        raise ValueError(f"fisher.diagonal: probes must be >= 1, got {probes}")
    other = {name: group for name, group in groups.items() if group.outputs != (0, 3)}
    groups = {name: group for name, group in groups.items() if name not in other}
    total = {name: torch.zeros(group.shape(gaussians), dtype=torch.float64) for name, group in groups.items()}
    # Without a graph of torch, as in `Replay`.
    seen = gaussians.detach() if semantics else gaussians.detach().replace(features=None)
    call = Call(seen, camera, settings, frozenset(), scene=scene)
    lib, generator = call.lib, torch.Generator().manual_seed(seed)
    inputs = {name: to_drjit(lib, x) for name, x in call.inputs.items()}
    dr.enable_grad([inputs[group.input] for group in groups.values()])
    compositor, arguments = call.prepare(inputs)
    # The compositor's adjoint is called by hand: of the graph only what leads to its arguments is recorded.
    with dr.suspend_grad():
        record, sh, features, carried = dr.detach(list(arguments))
        compositor.forward(record, sh, features, carried, keep=True)
    # Features move where a scene computes them; those of Gaussians are nobody's input here (`groups`).
    attached = {"record": arguments.record, "sh": arguments.sh, "features": arguments.features if scene else None}
    root = torch.tensor(weights).sqrt()
    for _ in range(probes if groups else 0):
        sign = torch.randint(0, 2, (call.pixels, 3), generator=generator).float() * 2 - 1
        cotangent = {"rgb": (sign * root).reshape(-1), "alpha": torch.zeros(call.pixels)}
        if semantics:
            cotangent["features"] = semantics.cotangent(call.pixels, generator).reshape(-1)
        g = {name: to_drjit(lib, x.to(call.home)).array for name, x in cotangent.items()}
        grads = compositor.adjoint(g)
        found = [(attached[name], grads[name]) for name in attached if attached[name] is not None]
        for x, slope in found:
            dr.set_grad(x, slope)
        dr.enqueue(dr.ADMode.Backward, [x for x, _ in found])
        # The graph is used again by the next probe.
        dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
        for name, group in groups.items():
            slope = dr.grad(inputs[group.input]).torch().double().cpu()
            total[name] += group.pull(slope, call.inputs[group.input].double().cpu()).square()
        for group in groups.values():
            dr.set_grad(inputs[group.input], 0)
    result = {name: x / probes for name, x in total.items()}
    if other:
        replay = Replay(gaussians, camera, settings, geometry=False, semantics=semantics)
        result |= replay.diagonal(other, weights, False)
    return result
