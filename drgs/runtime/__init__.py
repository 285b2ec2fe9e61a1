"""The backend: which Dr.Jit variant computes, on which libLLVM, with how many threads.

Three entry points, from cheap to complete. Importing `drjit` or `mitsuba` loads libLLVM (libllvm.py), so the first one
has to come before: `import drgs` calls it. `import drgs.tracing` calls the second one, so the engine's modules have a
backend.

    prepare()    sets DRJIT_LIBLLVM_PATH; imports nothing; called by `import drgs`
    backend()    Dr.Jit, its array types and thread counts; no Mitsuba
    mitsuba()    the `mitsuba` module with a variant set: the user's if there is one

What computes is decorated with `alone`: one thread at a time, and not in a forked child.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import gc
import os
import sys
import threading
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

from drgs.runtime import machine
from drgs.runtime.libllvm import MINIMUM_LLVM, dotted, find_libraries, prepare, require_llvm
from drgs.runtime.llvm_target import compile_for, compiled_for, missing_features

__all__ = [
    "VARIANTS",
    "Backend",
    "alone",
    "backend",
    "cuda_status",
    "dr_types",
    "exactly",
    "info",
    "mitsuba",
    "optix_status",
    "prepare",
    "setup",
    "thread_count",
    "uncompiled",
    "version",
]

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

# What torch.compiler.disable leaves on a function, for compiled code that meets it.
_UNCOMPILED = {
    "_torchdynamo_disable": True,
    "_torchdynamo_disable_msg": "drgs: must be called outside of torch's graphs, got torch.compile(fullgraph=True); "
    "leave fullgraph out",
}
VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")

_PACKAGES = (
    "mitsuba",
    "drjit",
    "torch",
    "numpy",
    "pycolmap",
    "opencv-contrib-python-headless",
    "rich",
    "plyfile",
    "safetensors",
    "flip-evaluator",
)


@dataclasses.dataclass(frozen=True)
class Backend:
    """The backend that computes: one per process, chosen at first use.

    Attributes:
        variant: Mitsuba variant name, `llvm_ad_rgb` or `cuda_ad_rgb`.
        name: `llvm` or `cuda`.
        types: `drjit.llvm.ad` or `drjit.cuda.ad`, the namespace of differentiable array types.
        llvm_path: The libLLVM that is loaded, None on CUDA or where the system does not report it.
        llvm_version: (major, minor, patch) as Dr.Jit reports it, None on CUDA.
        threads: Dr.Jit's thread count when the backend was chosen.
    """

    variant: str
    name: str
    types: ModuleType
    llvm_path: str | None
    llvm_version: tuple[int, ...] | None
    threads: int


_active: Backend | None = None
_computing = threading.RLock()
_abandoned: list[Any] = []  # graphs that are no longer used, but were left while another thread computed
_owner: int | None = None  # the process that has computed: its worker threads exist nowhere else
_thread: int | None = None  # the thread that has computed last


def uncompiled(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Keeps `torch.compile` out of a function: compiled code calls it as it is, and with `fullgraph=True` says why not.

    `torch.compiler.disable` does so, but loads torch's compiler, which takes 2 s: here only where it is loaded already.
    """

    @functools.wraps(function)
    def as_it_is(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        if "torch._dynamo" in sys.modules:
            return _eagerly(function, *args, **kwargs)
        return function(*args, **kwargs)

    vars(as_it_is).update(_UNCOMPILED)
    return as_it_is


def _eagerly(function: Callable[_Arguments, _Result], *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
    """A call without torch's compiler, which is loaded."""
    import torch

    return torch.compiler.disable(function)(*args, **kwargs)


vars(_eagerly).update(_UNCOMPILED)


def alone(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Lets one Python thread at a time compute, as one computation uses all cores, and refuses in a forked child.

    Dr.Jit's worker threads do not survive `os.fork`: a kernel would wait for them forever.
    """

    @functools.wraps(function)
    def one_at_a_time(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        global _owner
        _refuse_fork()
        _owner = os.getpid()
        with _computing, _no_garbage():
            _abandoned.clear()
            _take_over()
            return function(*args, **kwargs)

    return uncompiled(one_at_a_time)


def _take_over() -> None:
    """Lets this thread go on with variables of another one.

    Dr.Jit orders a kernel by scopes, which each thread counts up from where it was: one that comes back is behind the
    thread whose variables it meets. Torch differentiates what is on a card in a thread of its own.
    """
    global _thread
    before, _thread = _thread, threading.get_ident()
    if _active is not None and before != _thread:
        import drjit as dr

        dr.detail.new_scope(dr.JitBackend.CUDA if _active.name == "cuda" else dr.JitBackend.LLVM)


# Dr.Jit frees a variable of a graph under its lock on graphs. If its numbers are those of a torch tensor, torch lets go
# of Python's lock in the middle (`THPVariable_clear`); the thread that takes it may need the lock on graphs next, which
# it waits for without letting go of Python's, and both wait for ever. So such variables end while no other thread
# computes: those that a torch graph keeps by `Graph`, and those in reference cycles, as `dr.wrap` makes them, because
# the garbage collector does not run by itself while something is computed, and nothing is computed while it runs.

_is_paused = False  # the garbage collector, by a computation
_COLLECT_SECONDS = 10.0  # seconds, at most, that the garbage collector waits for the thread that computes


@contextlib.contextmanager
def _no_garbage() -> Iterator[None]:
    """Python's garbage collector does not begin by itself within."""
    global _is_paused
    pauses = gc.isenabled()
    gc.disable()
    _is_paused |= pauses
    try:
        yield
    finally:
        if pauses:
            _is_paused = False
            gc.enable()


class _Collector:
    """What Python's garbage collector calls before and after it runs, one run at a time: nobody computes meanwhile."""

    def __init__(self) -> None:
        self._is_alone = False

    def __call__(self, phase: str, info: Any) -> None:
        """Take what a computation takes, and give it back."""
        if phase == "start":
            self._is_alone = _computing.acquire(timeout=_COLLECT_SECONDS)
        elif self._is_alone:
            self._is_alone = False
            _computing.release()


def _after_fork() -> None:
    """A forked child waits for no computation: one that its parent was at never ends here."""
    if _collector in gc.callbacks:  # not in a child of a child
        gc.callbacks.remove(_collector)
    if _is_paused:
        gc.enable()


_collector = _Collector()
gc.callbacks.append(_collector)
os.register_at_fork(after_in_child=_after_fork)


class Graph:
    """Dr.Jit arrays with a graph that outlive a computation: they end while no other thread computes.

    Args:
        arrays: What is kept, any object.
    """

    def __init__(self, arrays: Any) -> None:
        self._arrays = arrays

    def take(self) -> Any:
        """The graph, at the first call; then None."""
        arrays, self._arrays = self._arrays, None
        return arrays

    def __del__(self) -> None:
        # Not waited for: the thread that computes may be waiting for what this one has.
        if _computing.acquire(blocking=False):
            try:
                self._arrays = None
            finally:
                _computing.release()
        else:
            _abandoned.append(self._arrays)


def _refuse_fork() -> None:
    if _owner not in (None, os.getpid()):
        raise NotImplementedError(
            "drgs: a process must not render when it was forked from one that has rendered, or has a CUDA backend, got "
            f"process {os.getpid()} forked from {_owner}; use multiprocessing.get_context('spawn'), or fork before the "
            "first render"
        )


def setup(variant: str | None = None, threads: int | None = None) -> Backend:
    """Choose the backend and its thread counts; `backend()` returns the last one chosen.

    Args:
        variant: `llvm_ad_rgb`, `cuda_ad_rgb`, or None / `auto`: the variant that the user has set
            in Mitsuba, else DRGS_VARIANT, else CUDA if a device and a CUDA build of torch are
            there, else LLVM.
        threads: Threads of Dr.Jit and torch, or None: DRGS_THREADS, else what both have, but at
            most as many as this process may use.
    Raises:
        ValueError: If an argument or environment variable is bad, or a loaded libLLVM would abort.
        FileNotFoundError: If no backend is usable.
    """
    global _active
    _active = _started(variant, threads)
    import torch

    count = _requested_threads(threads)
    if count or torch.get_num_threads() > _usable_cores():
        torch.set_num_threads(count or _usable_cores())
    return _active


def _started(variant: str | None, threads: int | None) -> Backend:
    """`setup` of Dr.Jit alone. Loads torch, which takes ten times as long, only where there is a CUDA device."""
    global _owner
    _refuse_fork()
    wanted = _requested_variant(variant)
    count = _requested_threads(threads)
    if wanted == "llvm_ad_rgb" and "drjit" not in sys.modules:
        require_llvm()
    prepare()
    dr = _imported_drjit()

    if wanted is None:
        wanted = "cuda_ad_rgb" if cuda_status()[0] and _torch_has_cuda() else "llvm_ad_rgb"
    if wanted == "cuda_ad_rgb":
        usable, reason = cuda_status()
        if not usable:
            raise ValueError(f"drgs: variant cuda_ad_rgb must have a CUDA device, but {reason}; use llvm_ad_rgb.")
        import drjit.cuda.ad as types

        version = None
        _owner = os.getpid()  # no forked child can use the driver that this process has started
    else:
        version = _loaded_llvm(dr)
        _refuse_processor()
        import drjit.llvm.ad as types  # type: ignore[no-redef]  # the two have the same names

    # Left alone, both size their pools by the machine, which oversubscribes a container.
    dr.set_thread_count(count or min(dr.thread_count(), _usable_cores()))
    return Backend(
        variant=wanted,
        name=wanted.split("_")[0],
        types=types,
        llvm_path=_loaded_path() if version else None,
        llvm_version=version,
        threads=dr.thread_count(),
    )


def _imported_drjit() -> ModuleType:
    """The `drjit` module.

    Raises:
        FileNotFoundError: If a library of the system that it needs is missing.
    """
    try:
        import drjit
    except (ImportError, NameError) as error:  # Dr.Jit 1.5 itself answers a missing library with a NameError
        raise FileNotFoundError(
            f"drgs: Dr.Jit must find the libraries that it needs, got: {error.__context__ or error}; install that one "
            "(libatomic.so.1 is in the system's package libatomic1)"
        ) from error
    return drjit


def _torch_has_cuda() -> bool:
    """Whether torch is a build for CUDA: parameters live in its tensors, and one for CPUs would copy every frame."""
    import torch

    return torch.version.cuda is not None


def thread_count() -> int:
    """Threads that other libraries should take: those of the backend if there is one, else DRGS_THREADS, else every
    core that this process may use.
    """
    return _active.threads if _active else _requested_threads(None) or _usable_cores()


def backend() -> Backend:
    """The active backend, chosen by `setup()` at first use."""
    return _active or setup()


def dr_types() -> ModuleType:
    """`drjit.llvm.ad` or `drjit.cuda.ad`: Float, UInt32, TensorXf, ... of the active backend."""
    return backend().types


def mitsuba() -> ModuleType:
    """The `mitsuba` module. Sets the variant only if none is set: never replaces the user's.

    Raises:
        ValueError: If the user's variant is not the one that drgs computes with.
    """
    chosen = backend()
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant(chosen.variant)
    elif mi.variant() != chosen.variant and mi.variant() in VARIANTS:
        # The user has switched variants since the first use: follow.
        setup(mi.variant())
    elif mi.variant() != chosen.variant:
        raise ValueError(
            f"drgs: Mitsuba's variant must be one of {', '.join(VARIANTS)}, got {mi.variant()}; "
            f"call mitsuba.set_variant({chosen.variant!r})."
        )
    return mi


def cuda_status() -> tuple[bool, str | None]:
    """Whether Dr.Jit can run on a CUDA device and, if not, why."""
    prepare()
    dr = _imported_drjit()
    if dr.has_backend(dr.JitBackend.CUDA):
        return True, None
    try:
        code = ctypes.CDLL("libcuda.so.1").cuInit(0)
    except OSError:
        return False, "libcuda.so.1 (the NVIDIA driver) was not found"
    if code:
        return False, f"the NVIDIA driver reports no usable device (cuInit returned {code})"
    return False, "the driver must be R535 or newer and the device of compute capability >= 7.5"


def optix_status() -> tuple[bool, str | None]:
    """Whether OptiX, which only `traversal="bvh"` needs on CUDA, can be loaded; if not, why."""
    usable, reason = cuda_status()
    if not usable:
        return False, reason
    name = os.environ.get("DRJIT_LIBOPTIX_PATH") or "libnvoptix.so.1"
    try:
        ctypes.CDLL(name)
    except OSError:
        return False, f"{name} was not found (containers: NVIDIA_DRIVER_CAPABILITIES=all)"
    return True, None


def exactly(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Lets a function that computes in float64 do so on a card, too.

    There Dr.Jit takes reciprocals and reciprocal roots of float64 by `rcp.approx.ftz.f64`, which reads and returns 20
    bits of the mantissa: worse than float32. Without `FastMath` they are rounded to nearest. LLVM has no such function.
    """

    @functools.wraps(function)
    def rounded(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        if backend().name != "cuda":
            return function(*args, **kwargs)
        import drjit as dr

        with dr.scoped_set_flag(dr.JitFlag.FastMath, False):
            return function(*args, **kwargs)

    return rounded


def version() -> str:
    """Version of drgs."""
    import drgs

    return drgs.__version__


def info() -> dict:
    """Facts for a bug report or a run's env.json; never raises for want of a backend.

    Returns:
        JSON-serializable dict with keys drgs, commit, python, platform, cpu, cores, backend, llvm,
        threads, cuda, optix, packages. `backend["error"]` is None or says why nothing can run. The threads of torch
        are None where it is not loaded, which is not done for this.
    """
    import platform
    from importlib import metadata

    import drgs

    def version(package: str) -> str | None:
        try:
            return metadata.version(package)
        except metadata.PackageNotFoundError:
            return None

    report: dict[str, Any] = {
        "drgs": drgs.__version__,
        "commit": machine.commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": machine.cpu_model(),
        "cores": {"usable": _usable_cores(), "machine": os.cpu_count()},
        "packages": {package: version(package) for package in _PACKAGES},
    }
    chosen, error = None, None
    try:
        chosen = _active or _started(None, None)
    except (ValueError, OSError) as problem:
        error = str(problem)
    report["backend"] = {"variant": chosen.variant if chosen else None, "error": error}
    llvm = chosen.llvm_version if chosen else None
    target = compiled_for() if llvm else None
    environ = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"}
    report["llvm"] = {
        "path": chosen.llvm_path if chosen else None,
        "version": dotted(llvm) if llvm else None,
        "target": {"cpu": target.cpu, "lanes": target.lanes} if target else None,
        "found": [{"path": x.path, "version": dotted(x.version)} for x in find_libraries(environ)],
    }
    torch = sys.modules.get("torch")
    report["threads"] = {
        "drjit": chosen.threads if chosen else None,
        "torch": torch.get_num_threads() if chosen and torch else None,
    }
    for key, status in (("cuda", cuda_status), ("optix", optix_status)):
        try:
            usable, reason = status()
        except FileNotFoundError as problem:
            usable, reason = False, str(problem)
        report[key] = {"available": usable, "reason": reason}
    report["cuda"]["device"] = machine.gpu_name() if report["cuda"]["available"] else None
    return report


def _requested_variant(variant: str | None) -> str | None:
    """The variant requested by argument, by Mitsuba's current one or by environment; None: auto."""
    where = "setup: variant"
    if variant in (None, "auto") and "mitsuba" in sys.modules:
        current = sys.modules["mitsuba"].variant()
        variant = current if current in VARIANTS else None
    if variant in (None, "auto"):
        where = "drgs: DRGS_VARIANT"
        variant = os.environ.get("DRGS_VARIANT") or None
    if variant in (None, "auto"):
        return None
    if variant not in VARIANTS:
        raise ValueError(f"{where} must be one of auto, {', '.join(VARIANTS)}, got {variant!r}")
    return variant


def _requested_threads(threads: int | None) -> int | None:
    """The number requested by argument or by environment; None: as many as there are cores."""
    where = "setup: threads"
    text = typing.cast("int | str | None", threads)
    if threads is None:
        where = "drgs: DRGS_THREADS"
        text = os.environ.get("DRGS_THREADS") or None
    if text is None:
        return None
    try:
        count = int(text)
    except ValueError:
        count = 0
    if not 1 <= count <= 4096:
        raise ValueError(f"{where} must be a whole number in [1, 4096], got {text!r}")
    return count


def _loaded_llvm(dr: ModuleType) -> tuple[int, ...]:
    """The LLVM version that Dr.Jit has loaded, once it is known not to abort."""
    version = tuple(dr.detail.llvm_version()) if dr.has_backend(dr.JitBackend.LLVM) else ()
    if version and version[0] >= MINIMUM_LLVM:
        return version
    require_llvm()  # when nothing on this machine would do, the error says what to install
    # 15 and 16 pass has_backend and abort the process in the first kernel with a minimum.
    raise ValueError(
        f"drgs: Dr.Jit must run on libLLVM >= {MINIMUM_LLVM}, but has loaded "
        f"{dotted(version) if version else 'none'}; import drgs before drjit and mitsuba, or set "
        "DRJIT_LIBLLVM_PATH to a newer one."
    )


def _refuse_processor() -> None:
    """Choose the target that DRGS_LLVM_TARGET names; refuse one on which the first kernel would end the process."""
    if wanted := os.environ.get("DRGS_LLVM_TARGET"):
        compile_for(wanted, "drgs: DRGS_LLVM_TARGET")
    target = compiled_for()
    if target is not None and (missing := missing_features(target)):
        raise ValueError(
            f"drgs: the processor must have {' and '.join(missing).upper()}, as Intel's have since Haswell (2013) and "
            f"AMD's since Piledriver (2012), got {target.cpu} without; use another machine, in a virtual one the "
            "host's processor (qemu: -cpu host), or a CUDA device (DRGS_VARIANT=cuda_ad_rgb)."
        )


def _loaded_path() -> str | None:
    """Path of the libLLVM in this process: Dr.Jit may have been imported before our choice."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:  # not Linux
        return os.environ.get("DRJIT_LIBLLVM_PATH")
    return next((x.split(maxsplit=5)[5] for x in lines if "/libLLVM" in x), None)


def _usable_cores() -> int:
    """Cores this process may use: affinity mask and, in a container, the CPU quota."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # macOS
        cores = os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return min(cores, max(1, -(-int(quota) // int(period))))
    except (OSError, ValueError):  # no cgroup v2, or no quota ("max")
        return cores
