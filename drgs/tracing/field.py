"""The torch function that a scene's Gaussians may come from, as one operation of Dr.Jit.

A scene that moves may compute its Gaussians in torch, by a network. In reverse mode torch's own graph leads through it,
from `Scene.at` to the renderer's inputs. Forward mode and the probes of Fisher information are driven from Dr.Jit:
there `Field` is one more operation in front of the projection (`Call.prepare`), so that tangents and gradients of the
scene's parameters pass through it as those of Gaussians do. Not `dr.wrap`, whose description of its outputs is one
global of all threads.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import drjit as dr
import torch

from drgs.tracing.bridge import to_drjit
from drgs.tracing.protocols import Lib

if TYPE_CHECKING:
    from drgs.ellipsoids import DeformableScene

__all__ = ["Field"]


class Field:
    """The raw fields of a scene's Gaussians at one time, as a function of the scene's parameters.

    Args:
        time: Of the view.
        names: Of the fields that are wanted.
        shift: (3,) that is taken from the means: the call's own origin; None for no shift.
        fixed: Those of the scene's parameters that nothing is differentiated by, as they are no floats.
    """

    def __init__(
        self,
        scene: DeformableScene,
        time: float | None,
        names: Iterable[str],
        shift: torch.Tensor | None = None,
        fixed: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        self.scene, self.time, self.names, self.shift, self.fixed = scene, time, tuple(names), shift, dict(fixed or {})

    def __call__(self, lib: Lib, parameters: dict) -> dict:
        """Dr.Jit tensors by name to Dr.Jit tensors by name, with AD in both modes."""
        return dr.custom(_Deform, self, lib, parameters)

    def values(self, parameters: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """The same in torch; `time` among the parameters is that of the view, as a scalar."""
        given = {**self.fixed, **parameters}
        fields = self.scene.deform(given, given.pop("time", self.time)).parameters()
        if self.shift is not None:
            fields["means"] = fields["means"] - self.shift
        return {name: fields[name] for name in self.names}


class _Deform(dr.CustomOp):
    """`dr.custom(_Deform, field, lib, parameters)`; its derivatives evaluate the field once more in torch."""

    def eval(self, field: Field, lib: Lib, parameters: dict) -> dict:
        """Dr.Jit's name for it."""
        self.field, self.lib = field, lib
        # Clones, as Dr.Jit and torch would share the memory.
        self.given = {name: x.torch().clone() for name, x in parameters.items()}
        with torch.no_grad():  # what torch would record is asked for in `forward` and `backward`
            return self._back(field.values(self.given))

    def forward(self) -> None:
        """Dr.Jit forward mode: torch's, along the parameters' tangents."""
        tangents = {name: x.torch() for name, x in self.grad_in("parameters").items()}
        self.set_grad_out(self._back(torch.func.jvp(self.field.values, (self.given,), (tangents,))[1]))

    def backward(self) -> None:
        """Dr.Jit reverse mode: torch's, from the fields' cotangents."""
        pull = torch.func.vjp(self.field.values, self.given)[1]
        slopes = pull({name: x.torch() for name, x in self.grad_out().items()})[0]
        self.set_grad_in("parameters", self._back(slopes))

    def _back(self, tensors: dict) -> dict:
        return {name: to_drjit(self.lib, x) for name, x in tensors.items()}
