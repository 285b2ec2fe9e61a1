"""Adam, as torch has it, without torch's compiler.

The functions of its optimizers are marked so that the compiler leaves them alone, and the first marked one that is
called loads it, which takes as long as importing torch: 1.3 s. What the marks are around is the same function.
"""

from __future__ import annotations

import inspect

import torch


class Adam(torch.optim.Adam):
    """`torch.optim.Adam`, whose numbers these are; not to be called from compiled code."""

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))
