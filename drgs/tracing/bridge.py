"""Between torch and Dr.Jit: tensors, and a call of the renderer as a function that torch differentiates.

Not `dr.wrap`, whose description of its outputs is one global of all threads, and which `torch.func` does not know.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn

import drjit as dr
import torch

from drgs import runtime
from drgs.checks.derivatives import first_only, is_functional, refuse_batched, unwrapped

if TYPE_CHECKING:
    from drgs.tracing.call import Call
    from drgs.tracing.frames import Frame


def to_drjit(lib: ModuleType, x: torch.Tensor) -> Any:
    """A torch tensor as a Dr.Jit tensor of its precision; without its graph, which the functions below keep."""
    return (lib.TensorXf64 if x.dtype == torch.float64 else lib.TensorXf)(x.detach().contiguous())


def differentiable(call: Call) -> dict[str, torch.Tensor]:
    """Run `call.trace` on its torch inputs, through whichever bridge their derivative needs."""
    values = call.inputs.values()
    if call.count == 0 or call.pixels == 0:
        return call.nothing()
    if any(is_functional(x) for x in values):
        return dict(zip(call.image_names, _Functional.apply(call, *values), strict=True))
    if torch.is_grad_enabled() and any(x.requires_grad for x in values):
        bridge = _Recorded if call.is_recorded else _Reverse
        return dict(zip(call.image_names, bridge.apply(call, *values), strict=True))
    if call.is_recorded:
        return {name: x.torch() for name, x in _frame(call, values, ()).images.items()}
    images = call.trace(**{name: to_drjit(call.lib, x) for name, x in call.inputs.items()})
    return {name: x.torch() for name, x in images.items()}


class _Recorded(torch.autograd.Function):
    """Reverse mode of a frame that is made of recorded steps."""

    @staticmethod
    def forward(ctx: Any, call: Call, *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        ctx.save_for_backward(*values)  # torch then refuses a second backward pass without retain_graph
        ctx.call = call
        ctx.needed = tuple(name for name, need in zip(call.inputs, ctx.needs_input_grad[1:], strict=True) if need)
        frame = _frame(call, values, ctx.needed)
        ctx.graph = runtime.Graph(frame)
        return tuple(frame.images[name].torch() for name in call.image_names)

    @staticmethod
    @runtime.alone
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        call, values = ctx.call, ctx.saved_tensors
        frame = ctx.graph.take() or _frame(call, values, ctx.needed)
        slopes = frame.gradients(
            {name: _plain(call.lib, g).array for name, g in zip(call.image_names, cotangents, strict=True)}
        )
        gradients = tuple(
            slopes[name].torch().view(x.shape) if name in slopes else None
            for name, x in zip(call.inputs, values, strict=True)
        )
        return None, *first_only("render", gradients, (*values, *cotangents))


def _frame(call: Call, values: Iterable[torch.Tensor], needed: tuple[str, ...]) -> Frame:
    """The images of a call by recorded steps, with gradients by the inputs that are named."""
    return call.frame({n: to_drjit(call.lib, x).array for n, x in zip(call.inputs, values, strict=True)}, needed)


class _Reverse(torch.autograd.Function):
    """Reverse mode through the graph that Dr.Jit keeps of a call."""

    @staticmethod
    def forward(ctx: Any, call: Call, *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        ctx.save_for_backward(*values)  # torch then refuses a second backward pass without retain_graph
        ctx.call = call
        ctx.needed = ctx.needs_input_grad[1:]
        ends, images = _traced(call, values, ctx.needed)
        ctx.graph = runtime.Graph((ends, images))
        return tuple(x.torch() for x in images)

    @staticmethod
    @runtime.alone
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        values = ctx.saved_tensors
        # A traversal takes the edges of the graph with it; through what is left, another would find the old gradients.
        inputs, images = ctx.graph.take() or _traced(ctx.call, values, ctx.needed)
        for image, g in zip(images, cotangents, strict=True):
            dr.set_grad(image, _plain(ctx.call.lib, g).array)
        needed = [k for k, x in enumerate(inputs) if x is not None]
        slopes: dict[int, Any] = dict(zip(needed, dr.backward_to([inputs[k] for k in needed]), strict=True))
        gradients = tuple(slopes[k].torch() if k in slopes else None for k in range(len(inputs)))
        return None, *first_only("render", gradients, (*values, *cotangents))


def _traced(call: Call, values: Iterable[torch.Tensor], needed: Iterable[bool]) -> tuple[list, list]:
    """The ends of a graph: inputs, None where no gradient is needed, and images in the order of `call.image_names`."""
    inputs = {n: _plain(call.lib, x) for n, x in zip(call.inputs, values, strict=True)}
    ends = [x if need else None for x, need in zip(inputs.values(), needed, strict=True)]
    dr.enable_grad([x for x in ends if x is not None])
    images = call.trace(**inputs)
    return ends, [images[name] for name in call.image_names]


class _Functional(torch.autograd.Function):
    """Every mode, for `torch.func` and dual numbers: each derivative computes the view again."""

    @staticmethod
    def forward(call: Call, *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        images = call.trace(**{n: _plain(call.lib, x) for n, x in zip(call.inputs, values, strict=True)})
        return tuple(images[name].torch().clone() for name in call.image_names)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.call, *values = inputs
        ctx.save_for_backward(*values)
        ctx.save_for_forward(*values)

    @staticmethod
    @runtime.alone
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        values = ctx.saved_tensors
        inputs, images = _traced(ctx.call, values, [True] * len(values))
        for image, g in zip(images, cotangents, strict=True):
            dr.set_grad(image, _plain(ctx.call.lib, g).array)
        dr.enqueue(dr.ADMode.Backward, images)
        dr.traverse(dr.ADMode.Backward)
        gradients = tuple(dr.grad(x).torch().clone() for x in inputs)
        return None, *first_only("render", gradients, (*values, *cotangents))

    @staticmethod
    @runtime.alone
    def jvp(ctx: Any, _call: None, *tangents: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        values = ctx.saved_tensors
        inputs, images = _traced(ctx.call, values, [True] * len(values))
        for x, v in zip(inputs, tangents, strict=True):
            if v is not None:
                dr.set_grad(x, _plain(ctx.call.lib, v))
        dr.enqueue(dr.ADMode.Forward, inputs)
        dr.traverse(dr.ADMode.Forward)
        image_tangents = tuple(dr.grad(x).torch().clone() for x in images)
        return first_only("render", image_tangents, (*values, *tangents))

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *_: Any) -> NoReturn:
        refuse_batched("render")


def _plain(lib: ModuleType, x: torch.Tensor) -> Any:
    """The values below any `torch.func` wrapper, as a Dr.Jit tensor."""
    return unwrapped(x, lambda values: to_drjit(lib, values))
