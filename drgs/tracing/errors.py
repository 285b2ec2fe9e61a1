"""What is raised in Python code of ours that Dr.Jit calls while it traces a loop, a branch or an operation."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

__all__ = ["own_errors"]


@contextlib.contextmanager
def own_errors() -> Iterator[None]:
    """Dr.Jit turns an error inside an operation of ours into its own: what was refused, or interrupted, is raised as it
    was."""
    try:
        yield
    except RuntimeError as error:
        cause = error.__cause__
        while cause is not None and not isinstance(cause, ValueError | NotImplementedError | KeyboardInterrupt):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None
