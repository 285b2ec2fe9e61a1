"""Versions and hardware that a worker must share with the process that sends it work, for the same bits to come
back.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from drgs import runtime
from drgs.runtime import machine

_PACKAGES = ("dask", "distributed", "torch", "drjit", "mitsuba", "numpy")
_ADVICE = {
    "drgs": "install the same on both",
    "variant": "set DRGS_VARIANT for both",
    "threads": "start it with DRGS_THREADS=1 in its environment",
    "tasks": "start it with --nthreads 1",
}


class Disagreement(ValueError):
    """A worker that would find other bits, or none."""


@functools.cache
def statement() -> dict[str, dict[str, str]]:
    """Versions, code and hardware of this process, as they were at the first call.

    Returns:
        `must` agree: versions, a hash of the code, the variant, Dr.Jit's threads; `may` differ: the machine.
    """
    backend = runtime.backend()
    must = {"drgs": _code(), "python": ".".join(platform.python_version_tuple()[:2])}
    must |= {name: metadata.version(name) for name in _PACKAGES}
    must |= {"variant": backend.variant, "threads": str(backend.threads)}
    llvm = ".".join(map(str, backend.llvm_version or ()))
    may = {"host": platform.node(), "processor": machine.cpu_model(), "LLVM": llvm, "pid": str(os.getpid())}
    return {"must": must, "may": may}


def _code() -> str:
    """Version, commit, and a hash of the actual source files: a checkout may be edited, and an installation has no
    commit.
    """
    root = Path(__file__).resolve().parents[1]
    found = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    commit = f"commit {(machine.commit() or 'unknown')[:16]}"
    return f"{runtime.version()} ({commit}, code {found.hexdigest()[:8]})"


def worker_statement() -> Callable[[], dict]:
    """A function that makes the statement of the process that it is sent to, whatever drgs that has.

    It travels by its value, not by its name, and needs nothing of this module.
    """

    def state() -> dict:
        import importlib

        try:
            there = importlib.import_module("drgs.cluster.agreement")
        except ImportError:
            try:
                return {"must": {"drgs": importlib.import_module("drgs").__version__}, "may": {}}
            except ImportError:
                return {"must": {"drgs": "none"}, "may": {}}
        try:
            return there.statement()
        except (ValueError, OSError) as error:  # no backend
            return {"error": str(error)}

    return state


def worker_name(address: str, name: object) -> str:
    """A worker's name for people: `0 (127.0.0.1:40123)`, or its address if it has no other."""
    place = address.removeprefix("tcp://")
    return place if name in (None, "", address) else f"{name} ({place})"


def this_worker() -> dict[str, str]:
    """The worker that runs the task that calls this: `worker`, its name, its `address` and its `host`."""
    from distributed import get_worker

    this = get_worker()
    return {"worker": worker_name(this.address, this.name), "address": this.address, "host": platform.node()}


def check_agreement(worker: str, theirs: Mapping[str, Any], ours: Mapping[str, str]) -> None:
    """Refuse a worker that differs.

    Args:
        worker: Name of the worker, for messages.
        theirs: Statement of the worker, as `worker_statement` returns it.
        ours: What this process must agree with, `statement()["must"]`.
    Raises:
        Disagreement: In one line, with what both have.
    """
    if "error" in theirs:
        raise Disagreement(f"cluster: worker {worker} must be able to compute, cannot: {theirs['error']}")
    for name, value in {**ours, "threads": "1"}.items():
        found = theirs["must"].get(name, "unknown")
        if name == "drgs" and _same_code(found, value):
            continue
        if found != value:
            what = {"threads": "threads of Dr.Jit", "variant": "the variant"}.get(name, name)
            advice = _ADVICE.get(name, f"install {name} {value} there, or {found} here")
            raise Disagreement(f"cluster: worker {worker} must have {what} {value}, has {found}; {advice}")


def _same_code(one: str, other: str) -> bool:
    """Whether two statements are of the same files, wherever these were installed from."""
    return one.rpartition(", code ")[2] == other.rpartition(", code ")[2]
