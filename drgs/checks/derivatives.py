"""What torch asks of a derivative that has none of its own, and of tensors that have no numbers: refused in a sentence.

The renderer's derivatives are computed by Dr.Jit, once: torch sees numbers, not the functions that they are. Without
`first_only` it would take them for constants, and whatever is built on a second derivative would vanish.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

import torch

from drgs.checks.arguments import ArgumentError

__all__ = [
    "check_has_numbers",
    "check_unbatched",
    "ends_of",
    "first_only",
    "refuse_batched",
    "refuse_meta",
    "unwrapped",
]

_Result = TypeVar("_Result")

Derivatives = tuple[torch.Tensor | None, ...]


def first_only(where: str, derivatives: Derivatives, by: Sequence[torch.Tensor | None]) -> Derivatives:
    """First derivatives that cannot be differentiated: asking for a second one raises NotImplementedError.

    Unlike `torch.autograd.function.once_differentiable`, which marks them only where the cotangents have a graph: of a
    loss that is linear in the image they have none, and its second derivative would be 0 without a word. What asks for
    a graph and never uses it (`create_graph=True`) gets the first derivatives as they are.

    Args:
        where: The function, for the message.
        derivatives: Derivatives, None where there is none.
        by: What they depend on: the point and the cotangents, or tangents.
    """
    if not any(_watched(x) for x in by if x is not None):
        return derivatives
    made = [x for x in derivatives if x is not None]
    known = iter(_Last.apply(where, len(made), *made, *(x for x in by if x is not None)))
    return tuple(None if x is None else next(known) for x in derivatives)


def _watched(x: torch.Tensor) -> bool:
    """Whether torch would differentiate what is computed from it: by a graph, a dual number or `torch.func`."""
    return (
        (torch.is_grad_enabled() and x.requires_grad)
        or torch._C._functorch.is_functorch_wrapped_tensor(x)
        or torch.autograd.forward_ad.unpack_dual(x).tangent is not None
    )


class _Last(torch.autograd.Function):
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
    """Raise NotImplementedError for a tensor that `torch.func.vmap` or `is_grads_batched` made."""
    functorch = torch._C._functorch
    if functorch.is_legacy_batchedtensor(x):
        refuse_batched(where)
    while functorch.is_functorch_wrapped_tensor(x):
        if functorch.is_batchedtensor(x):
            refuse_batched(where)
        x = functorch.get_unwrapped(x)


def unwrapped(x: torch.Tensor, convert: Callable[[torch.Tensor], _Result]) -> _Result:
    """`convert` of the values of a torch tensor, below any wrapper of `torch.func`, without a graph.

    Raises:
        NotImplementedError: If one of the wrappers is a batch of `torch.func.vmap`.
    """
    check_unbatched("render", x)
    functorch = torch._C._functorch
    # Otherwise every operation wraps its result again.
    with torch._C._DisableFuncTorch():
        while functorch.is_functorch_wrapped_tensor(x):
            x = functorch.get_unwrapped(x)
        return convert(x.detach())  # numpy takes no tensor with a graph


def refuse_batched(where: str) -> NoReturn:
    """Raise NotImplementedError: a function was called with a batch of `torch.func.vmap`."""
    raise NotImplementedError(
        f"{where}: must be computed one at a time, got a batch of torch.func.vmap, which jacrev, jacfwd and hessian "
        "use, too; loop over it, pass a list of cameras, or K tangents at once to drgs.render_jvp"
    )


def check_has_numbers(where: str, name: str, x: torch.Tensor) -> None:
    """Raise unless a tensor has numbers that can be looked at: on the device `meta` it has none, in a vmap many.

    Raises:
        ArgumentError: On `meta`.
        NotImplementedError: In a batch of `torch.func.vmap`.
    """
    refuse_meta(where, name, x)
    check_unbatched(where, x)


def ends_of(x: torch.Tensor) -> tuple[float, float]:
    """The least and the largest entry of a tensor that has some: NaN if one is. Also of a dual number."""
    low, high = torch.stack((x.amin(), x.amax())).tolist()  # `aminmax` has no forward mode in all of torch's releases
    return low, high


def refuse_meta(where: str, name: str, x: torch.Tensor) -> None:
    """Raise `ArgumentError` for a tensor on the device `meta`, which has no numbers."""
    if x.device.type == "meta":
        raise ArgumentError(
            f"{where}: {name} must have numbers, got a tensor of shape {tuple(x.shape)} on the device meta, which has "
            "none; make it on cpu or cuda"
        )
