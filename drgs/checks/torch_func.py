"""Tensors inside a transform of `torch.func` (grad, vjp, jvp, vmap): are they wrapped, batched, and with which values.

torch has no public function that says so, although code that hands a tensor's memory to another library must know: a
wrapped tensor has no memory of its own. `torch.func.debug_unwrap` gives values, but by its documentation for debuggers
alone, and does not say whether there is a batch. So this module, and no other, calls private names of torch:
`torch._C._functorch.is_functorch_wrapped_tensor`, `is_batchedtensor`, `is_legacy_batchedtensor`, `get_unwrapped` and
`torch._C._DisableFuncTorch`. They are there in torch 2.13, which this is tested with. tests/test_torch_func.py
fails when torch drops one of them, and when `torch.func` gets a public name to use instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

_Result = TypeVar("_Result")


def is_wrapped(x: torch.Tensor) -> bool:
    """Whether a transform of `torch.func` (vmap included) wraps a tensor, which then has no memory of its own."""
    return bool(torch._C._functorch.is_functorch_wrapped_tensor(x))


def is_batched(x: torch.Tensor) -> bool:
    """Whether a tensor stands for a batch: of `torch.func.vmap`, at any depth, or of `is_grads_batched`."""
    functorch = torch._C._functorch
    if functorch.is_legacy_batchedtensor(x):
        return True
    while functorch.is_functorch_wrapped_tensor(x):
        if functorch.is_batchedtensor(x):
            return True
        x = functorch.get_unwrapped(x)
    return False


def without_wrappers(x: torch.Tensor, convert: Callable[[torch.Tensor], _Result]) -> _Result:
    """`convert` of the innermost tensor, detached, called outside of all transforms of `torch.func`."""
    functorch = torch._C._functorch
    # Otherwise every operation wraps its result again.
    with torch._C._DisableFuncTorch():
        while functorch.is_functorch_wrapped_tensor(x):
            x = functorch.get_unwrapped(x)
        return convert(x.detach())  # numpy takes no tensor with a graph
