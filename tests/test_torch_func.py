"""drgs/checks/torch_func.py, which calls private names of torch: are they there, and is there a public way by now?"""

from __future__ import annotations

import re

import pytest
import torch

from drgs.checks.torch_func import is_batched, is_wrapped, without_wrappers

pytestmark = pytest.mark.core


@pytest.mark.parametrize("transform", ["grad", "vmap", "both"])
def test_wrapped_tensors_are_known_and_give_their_values(transform):
    """Within one transform and within two; outside of them nothing is wrapped or a batch."""
    x = torch.arange(6.0).reshape(2, 3)
    seen = []

    def look(x):
        seen.append((is_wrapped(x), is_batched(x), without_wrappers(x, lambda values: values.numpy().copy())))
        return x.sum()

    calls = {
        "grad": torch.func.grad(look),
        "vmap": torch.func.vmap(look),
        "both": torch.func.vmap(torch.func.grad(look)),
    }
    calls[transform](x)
    wrapped, batched, values = seen[0]
    assert wrapped
    assert batched == (transform != "grad")
    assert (values == x.numpy()).all()
    assert not is_wrapped(x)
    assert not is_batched(x)


def test_torch_has_no_public_name_for_this_yet():
    """Fails when a new torch can say publicly whether a tensor is wrapped: then `drgs.checks.torch_func` calls that."""
    public = [name for name in dir(torch.func) if re.match(r"is_|unwrap|get_unwrapped", name)]
    assert not public, f"torch.func has {', '.join(public)}: use it in drgs/checks/torch_func.py in place of torch._C"
