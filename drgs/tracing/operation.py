"""The compositing of a view as one differentiable operation of Dr.Jit."""

from __future__ import annotations

import drjit as dr

from drgs.tracing.arrays import Float
from drgs.tracing.composite import Compositor

__all__ = ["Composite"]


class Composite(dr.CustomOp):
    """`dr.custom(Composite, compositor, record, sh, features, carried, keep)`: `Compositor.forward`, with AD."""

    def eval(
        self,
        compositor: Compositor,
        record: list[Float],
        sh: Float | None,
        features: Float | None,
        carried: list[Float],
        keep: bool,
    ) -> dict:
        """Dr.Jit's name for it."""
        self.compositor = compositor
        return compositor.forward(record, sh, features, carried, keep)

    def backward(self) -> None:
        """Dr.Jit reverse mode."""
        for name, x in self.compositor.adjoint(self.grad_out()).items():
            self.set_grad_in(name, x)

    def forward(self) -> None:
        """Dr.Jit forward mode: one tangent."""
        c = self.compositor
        tangent = {name: self.grad_in(name) for name in c.buffers}
        carried = self.grad_in("carried") if c.carried else []
        self.set_grad_out(c.tangents([tangent], [carried])[0])
