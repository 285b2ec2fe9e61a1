"""First steps of a worker process of this machine, as Dask's preload: it gets ready to render with one thread."""

from __future__ import annotations

import logging
import signal

from drgs.cluster.agreement import statement


def dask_setup(worker: object) -> None:
    """Called by Dask in the main thread of the new process, before its first task."""
    # Ctrl-C reaches all processes of a terminal; this one ends with its client.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger("drgs").setLevel(logging.ERROR)  # else every worker would warn of the same
    statement()  # loads libraries, and chooses the backend
