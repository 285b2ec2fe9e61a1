"""Errors raised by Python code that Dr.Jit calls while it traces a loop, a branch or an operation."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def own_errors() -> Iterator[None]:
    """Raise the original error or interrupt, which Dr.Jit replaces by its own where it comes from inside an
    operation.
    """
    try:
        yield
    except RuntimeError as error:
        cause = error.__cause__
        while cause is not None and not isinstance(cause, ValueError | NotImplementedError | KeyboardInterrupt):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None
