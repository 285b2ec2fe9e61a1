"""J^T of a view, and the diagonal of J^T J from it: mean of (J^T v)^2 over random images v, one reverse pass each."""

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

__all__ = ["Pullback", "by_probes"]


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
) -> Information:
    """Mean of (J^T v)^2 over Rademacher images v of RGB and decoded features; what only features tell about is exact.

    Args:
        semantics: The metric of the features; v has a sign for each direction that the decoder sees, and L v is what
            the features get of it, for E (J^T L v)^2 = diag(J^T M J). None: v is of RGB only.
        scene: The scene that the Gaussians come from: all groups are of it then.
        mask: (H, W) what the image is multiplied by; None: 1.
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
    for _ in range(probes if groups else 0):
        sign = torch.randint(0, 2, (call.pixels, 3), generator=generator).float() * 2 - 1
        features = semantics.cotangent(call.pixels, generator) * factor if semantics else None
        slopes = pull(sign * root * factor, features)
        for name, group in groups.items():
            total[name] += group.pull(slopes[group.input], call.inputs[group.input].double().cpu()).square()
    result = {name: x / probes for name, x in total.items()}
    if other:
        replay = Replay(gaussians, camera, settings, geometry=False, semantics=semantics, mask=mask)
        result |= replay.diagonal(other, weights, False)
    return result


class Pullback:
    """J^T of one view: slopes of inputs along cotangents of its images, any number of times after one traversal."""

    def __init__(self, call: Call, names: Sequence[str]) -> None:
        """
        Args:
            call: The call of the view; its scene, if it has one, is where the Gaussians come from.
            names: The call's inputs that slopes are wanted of.
        """
        self.call = call
        self.names = list(names)
        lib = call.lib
        self.inputs = {name: to_drjit(lib, x) for name, x in call.inputs.items()}
        dr.enable_grad([self.inputs[name] for name in self.names])
        self.compositor, arguments = call.prepare(self.inputs)
        # The compositor's adjoint is called by hand: of the graph only what leads to its arguments is recorded.
        with dr.suspend_grad():
            record, sh, features, carried = dr.detach(list(arguments))
            self.compositor.forward(record, sh, features, carried, keep=True)
        # Features move where a scene computes them; those of Gaussians are nobody's input here (`groups`).
        moving = arguments.features if call.field else None
        self.attached = {"record": arguments.record, "sh": arguments.sh, "features": moving}

    def __call__(self, rgb: torch.Tensor, features: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Float64 slopes on the CPU, by name.

        Args:
            rgb: (pixels, 3) float32 cotangent.
            features: (pixels, D) likewise; None where it is 0, or there are none.
        """
        call = self.call
        cotangent = {"rgb": rgb.reshape(-1), "alpha": torch.zeros(call.pixels)}
        if features is not None:
            cotangent["features"] = features.reshape(-1)
        elif call.width:
            cotangent["features"] = torch.zeros(call.pixels * call.width)
        grads = self.compositor.adjoint({n: to_drjit(call.lib, x.to(call.home)).array for n, x in cotangent.items()})
        found = [(x, grads[name]) for name, x in self.attached.items() if x is not None]
        for x, slope in found:
            dr.set_grad(x, slope)
        dr.enqueue(dr.ADMode.Backward, [x for x, _ in found])
        # The graph is used again by the next cotangent.
        dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
        # Copies: what Dr.Jit and torch share is reset for the next cotangent.
        slopes = {name: dr.grad(self.inputs[name]).torch().to("cpu", torch.float64, copy=True) for name in self.names}
        for name in self.names:
            dr.set_grad(self.inputs[name], 0)
        return slopes
