"""Refuse second derivatives, batches of `torch.func.vmap` and tensors without numbers, each in one sentence.

The renderer's derivatives are computed by Dr.Jit, once: torch sees numbers, not the functions that they are. Without
`first_only` it would take them for constants, and whatever is built on a second derivative would vanish.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

import torch

from drgs.checks.arguments import ArgumentError
from drgs.checks.torch_func import is_batched, is_wrapped, without_wrappers

_Result = TypeVar("_Result")

Derivatives = tuple[torch.Tensor | None, ...]


def first_only(where: str, derivatives: Derivatives, by: Sequence[torch.Tensor | None]) -> Derivatives:
    """First derivatives that cannot be differentiated again: a second derivative raises NotImplementedError.

    Unlike `torch.autograd.function.once_differentiable`, which marks them only where the cotangents have a graph: those
    of a loss that is linear in the image have none, and its second derivative would silently be 0. A graph that is
    built and never used (`create_graph=True`) changes nothing.

    Args:
        where: The function, for the message.
        derivatives: Derivatives, None where there is none.
        by: What they depend on: the point and the cotangents, or tangents.
    """
    if not any(_is_differentiated(x) for x in by if x is not None):
        return derivatives
    present = [x for x in derivatives if x is not None]
    marked = iter(_NoSecond.apply(where, len(present), *present, *(x for x in by if x is not None)))
    return tuple(None if x is None else next(marked) for x in derivatives)


def is_functional(x: torch.Tensor) -> bool:
    """Whether torch differentiates without a graph here: a dual number of forward mode, or within `torch.func`."""
    return is_wrapped(x) or torch.autograd.forward_ad.unpack_dual(x).tangent is not None


def _is_differentiated(x: torch.Tensor) -> bool:
    """Whether torch would differentiate what is computed from it: by a graph, a dual number or `torch.func`."""
    return (torch.is_grad_enabled() and x.requires_grad) or is_functional(x)


class _NoSecond(torch.autograd.Function):
    """The first `count` tensors, tied to all of them by a derivative that raises."""

    @staticmethod
    def forward(where: str, count: int, *tensors: torch.Tensor) -> Derivatives:
        return tuple(x.clone() for x in tensors[:count])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.where = inputs[0]

    @staticmethod
    def backward(ctx: Any, *_: torch.Tensor) -> NoReturn:
        _refuse_second(ctx.where)

    @staticmethod
    def jvp(ctx: Any, *_: torch.Tensor | None) -> NoReturn:
        _refuse_second(ctx.where)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, where: str, *_: Any) -> NoReturn:
        refuse_batched(where)


def _refuse_second(where: str) -> NoReturn:
    raise NotImplementedError(
        f"{where}: must be differentiated once, got a derivative of its derivative, which would be taken for 0; take "
        "central differences of the first one, or J^T J (Gauss-Newton) from drgs.fisher"
    )


def check_unbatched(where: str, x: torch.Tensor) -> None:
    """Raise NotImplementedError for a batch of `torch.func.vmap` or `is_grads_batched`."""
    if is_batched(x):
        refuse_batched(where)


def unwrapped(x: torch.Tensor, convert: Callable[[torch.Tensor], _Result]) -> _Result:
    """`convert` of the values of a torch tensor, below any wrapper of `torch.func`, without a graph.

    Raises:
        NotImplementedError: If one of the wrappers is a batch of `torch.func.vmap`.
    """
    check_unbatched("render", x)
    return without_wrappers(x, convert)


def refuse_batched(where: str) -> NoReturn:
    """Raise NotImplementedError: a function was called with a batch of `torch.func.vmap`."""
    raise NotImplementedError(
        f"{where}: must be computed one at a time, got a batch of torch.func.vmap, which jacrev, jacfwd and hessian "
        "use, too; loop over it, pass a list of cameras, or K tangents at once to drgs.render_jvp"
    )


def check_has_numbers(where: str, name: str, x: torch.Tensor) -> None:
    """Raise unless a tensor's values can be read: on the device `meta` it has none, in a vmap several sets.

    Raises:
        ArgumentError: On `meta`.
        NotImplementedError: In a batch of `torch.func.vmap`.
    """
    refuse_meta(where, name, x)
    check_unbatched(where, x)


def ends_of(x: torch.Tensor) -> tuple[float, float]:
    """The least and the largest entry of a tensor that is not empty, NaN if one is. Works for dual numbers, too."""
    low, high = torch.stack((x.amin(), x.amax())).tolist()  # `aminmax` has no forward mode in all of torch's releases
    return low, high


def refuse_meta(where: str, name: str, x: torch.Tensor) -> None:
    """Raise `ArgumentError` for a tensor on the device `meta`, which has no numbers."""
    if x.device.type == "meta":
        raise ArgumentError(
            f"{where}: {name} must have numbers, got a tensor of shape {tuple(x.shape)} on the device meta, which has "
            "none; make it on cpu or cuda"
        )
