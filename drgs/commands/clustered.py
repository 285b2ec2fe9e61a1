"""The workers that a command line names: `--scheduler` joins some, `--workers` starts them."""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drgs.cluster.workers import Cluster
    from drgs.commands.options import Clustered

__all__ = ["workers_of"]


def workers_of(args: Clustered) -> AbstractContextManager[Cluster | None]:
    """The workers for the length of a block; None where no option asks for some, and nothing of Dask is loaded then."""
    if args.scheduler is None and args.workers is None:
        return contextlib.nullcontext()
    from drgs.cluster.connect import opened

    return opened(args.scheduler, args.workers)
