"""Options for workers, checked before anything is loaded, which takes seconds."""

from __future__ import annotations

import importlib.util
import re

_MAX_WORKERS = 1024  # local workers; chosen: more is a mistake
_ADDRESS = re.compile(r"(?:tcp://)?(\[[0-9a-fA-F:.]+\]|[^\s:/\[\]]+):(\d{1,5})")


def check_address(scheduler: str) -> str:
    """`HOST:PORT` as Dask has it.

    Raises:
        ValueError: If it is none.
    """
    found = _ADDRESS.fullmatch(scheduler)
    if not found or not 1 <= int(found[2]) <= 65535:
        raise ValueError(
            f"cluster: --scheduler must be HOST:PORT, got {scheduler!r}; `dask scheduler` says both, its port is 8786 "
            "unless another was chosen"
        )
    return f"tcp://{found[1]}:{int(found[2])}"


def check_options(scheduler: str | None, workers: int | None) -> str | None:
    """Refuse what `opened` would, but for what only a connection shows.

    Returns:
        The scheduler's address as Dask has it.
    Raises:
        ValueError: If an argument is bad, both are given, or Dask is not installed.
    """
    if scheduler is not None and workers is not None:
        raise ValueError("cluster: --scheduler must be without --workers, got both; join a cluster, or start one here")
    address = None if scheduler is None else check_address(scheduler)
    if workers is not None and not 1 <= workers <= _MAX_WORKERS:
        raise ValueError(
            f"cluster: --workers must be in [1, {_MAX_WORKERS}], got {workers}; one for each core is most useful"
        )
    for package in ("dask", "distributed") if (scheduler, workers) != (None, None) else ():
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"cluster: {package} must be installed, is not; pip install 'drgs[cluster]'")
    return address
