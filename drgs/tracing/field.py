"""The torch function that a scene's Gaussians may come from, as one operation of Dr.Jit.

A scene that moves may compute its Gaussians in torch, by a network. In reverse mode torch's own graph leads through it,
from `Scene.at` to the renderer's inputs. Forward mode and the probes of Fisher information are driven from Dr.Jit:
there `Field` is one more operation in front of the projection (`Call.prepare`), so that tangents and gradients of the
scene's parameters pass through it as those of Gaussians do.

The bridge is `dr.wrap`, from Dr.Jit to torch. (The other direction keeps the description of its outputs in one global
of all threads; this one does not.) As it is, it goes backward once: torch frees its graph, and gradients of a second
time would be added to those of the first. Probes go backward many times, so what is wrapped keeps its graph, from the
first time on (`_RetainedGraph`): K probes evaluate the function twice, K tangents K + 1 times.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import drjit as dr
import torch

if TYPE_CHECKING:
    from drgs.ellipsoids import DeformableScene

_Tensors = dict[str, torch.Tensor]


@dataclasses.dataclass(eq=False)
class Field:
    """The raw fields of a scene's Gaussians at one time, as a function of the scene's parameters.

    Attributes:
        scene: What is deformed.
        time: Time of the view; None where the parameters have it.
        names: Names of the fields that are wanted.
        shift: (3,) that is taken from the means: the call's own origin; None for no shift.
        fixed: Parameters of the scene that are no floats, by which nothing is differentiated.
        cached: The fields, once they are computed: a call's parameters are constant.
    """

    scene: DeformableScene
    time: float | None
    names: Iterable[str]
    shift: torch.Tensor | None = None
    fixed: Mapping[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    cached: _Tensors = dataclasses.field(default_factory=dict)

    def __call__(self, parameters: dict) -> dict:
        """Dr.Jit tensors by name to Dr.Jit tensors by name, with AD in both modes, by those that it is enabled of."""
        moving = {name: x for name, x in parameters.items() if dr.grad_enabled(x)}
        # Numbers cost no derivative.
        still = {name: x.torch() for name, x in parameters.items() if name not in moving}
        return wrapped(lambda some: self.values({**still, **some}), self.cached)(moving)

    def values(self, parameters: _Tensors) -> _Tensors:
        """The fields in torch; `time` among the parameters is that of the view, as a scalar."""
        given = {**self.fixed, **parameters}
        fields = self.scene.deform(given, given.pop("time", self.time)).parameters()
        if self.shift is not None:
            fields["means"] = fields["means"] - self.shift.to(fields["means"].device)
        return {name: fields[name] for name in self.names}


def wrapped(function: Callable[[_Tensors], _Tensors], cached: _Tensors | None = None) -> Callable[[dict], dict]:
    """A torch function of tensors by name as a function of Dr.Jit tensors by name, by `dr.wrap`.

    Args:
        function: What is wrapped, made of operations that torch differentiates in both modes.
        cached: What it returns, where that is known already; if empty it is filled.
    Returns:
        Differentiated by Dr.Jit in both modes; backward any number of times.
    """
    cached = {} if cached is None else cached

    def retained(inputs: _Tensors) -> _Tensors:
        if any(torch.autograd.forward_ad.unpack_dual(x).tangent is not None for x in inputs.values()):
            return {name: _dual(x) for name, x in function(inputs).items()}
        with torch.enable_grad():  # `dr.wrap` calls it as the thread is, and differentiates it later
            outputs = _RetainedGraph.apply(function, cached, tuple(inputs), *inputs.values())
        return dict(zip(cached, outputs, strict=True))

    wrap: Callable = dr.wrap(source="drjit", target="torch")
    return wrap(retained)


def _dual(x: torch.Tensor) -> torch.Tensor:
    """The tensor with a tangent, be it 0: `dr.wrap` reads that of every output."""
    value, tangent = torch.autograd.forward_ad.unpack_dual(x)
    return x if tangent is not None else torch.autograd.forward_ad.make_dual(value, torch.zeros_like(value))


class _RetainedGraph(torch.autograd.Function):
    """A function whose graph stays, so that it can be differentiated again; each time by itself."""

    @staticmethod
    def forward(ctx: Any, function: Callable, cached: _Tensors, names: tuple, *values: torch.Tensor) -> tuple:
        if not cached:
            cached.update(function(dict(zip(names, values, strict=True))))
        ctx.function = function
        ctx.names = names
        ctx.values = values
        ctx.graph = None
        return tuple(x.detach() for x in cached.values())  # an output that is an input would be taken for it

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple:  # type: ignore[override]
        """Slopes of `values`; their `grad`, which `dr.wrap` reads, begins anew."""
        for x in ctx.values:
            x.grad = None
        if ctx.graph is None:
            # Leaves of their own: the graph that is kept ends here, whatever made the values.
            leaves = [x.detach().requires_grad_() for x in ctx.values]
            with torch.enable_grad():
                ctx.graph = leaves, tuple(ctx.function(dict(zip(ctx.names, leaves, strict=True))).values())
        leaves, outputs = ctx.graph
        ends = [(x, g) for x, g in zip(outputs, cotangents, strict=True) if x.requires_grad]
        slopes = torch.autograd.grad(
            [x for x, _ in ends], leaves, [g for _, g in ends], retain_graph=True, materialize_grads=True
        )
        return None, None, None, *slopes
