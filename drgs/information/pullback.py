"""J^T of one view: reverse mode from cotangents of its images, any number of times after one traversal."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import torch

from drgs.tracing.bridge import to_drjit
from drgs.tracing.call import Call


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
            self.compositor.forward(*dr.detach(list(arguments)), keep=True)
        # Features move where a scene computes them; those of Gaussians are wanted where rows are eliminated.
        moving = arguments.features if call.field or "features" in self.names else None
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
        reached = [(x, grads[name]) for name, x in self.attached.items() if x is not None]
        for x, slope in reached:
            dr.set_grad(x, slope)
        dr.enqueue(dr.ADMode.Backward, [x for x, _ in reached])
        # The graph is used again by the next cotangent.
        dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
        # Copies: what Dr.Jit and torch share is reset for the next cotangent.
        slopes = {name: dr.grad(self.inputs[name]).torch().to("cpu", torch.float64, copy=True) for name in self.names}
        for name in self.names:
            dr.set_grad(self.inputs[name], 0)
        return slopes
