"""The target that Dr.Jit compiles for on a CPU: the processor as LLVM names it, its features, and the lanes of a
packet.

Dr.Jit 1.5 takes the machine's own from LLVM and has no Python function that returns it, or chooses another: the library
that it loads has, in C++ (`jit_llvm_target_cpu`, `jit_llvm_target_features`, `jit_llvm_vector_width`,
`jit_llvm_set_target`). This is the one module that calls them, by their mangled names; in a version that has others,
`compiled_for` gives None and `compile_for` refuses. tests/test_runtime.py fails as soon as Dr.Jit has a name for it.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import platform
import re
import sys
from pathlib import Path

LANES = (4, 8, 16)  # what Mitsuba's ray tracing on a CPU, Embree, takes
# Without FMA LLVM has no instruction for Dr.Jit's fused products, calls a function that nothing provides, and Dr.Jit
# aborts the process at the first kernel. All else that an older processor lacks LLVM replaces.
_NEEDED = "fma"
# LLVM's names of x86-64 processors, and the features that a machine must have for them. Of a name that it does not
# know LLVM makes a processor of 32 bits, and aborts.
_PROCESSORS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("x86-64", "x86-64-v2", "nehalem", "westmere"), ()),
    **dict.fromkeys(("sandybridge", "ivybridge"), ("avx",)),
    **dict.fromkeys(("x86-64-v3", "haswell", "broadwell", "skylake", "alderlake"), ("avx2", _NEEDED)),
    **dict.fromkeys(("znver1", "znver2", "znver3"), ("avx2", _NEEDED)),
    **dict.fromkeys(("x86-64-v4", "skylake-avx512", "cascadelake"), ("avx512vl", _NEEDED)),
    **dict.fromkeys(("icelake-server", "sapphirerapids", "znver4", "znver5"), ("avx512vbmi2", _NEEDED)),
}
# Dr.Jit 1.5's, as C++ mangles them: processor, features, lanes of a packet; and what chooses all three.
_READERS = ("_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv", "_Z21jit_llvm_vector_widthv")
_CHOOSER = "_Z19jit_llvm_set_targetPKcS0_j"
_WRITTEN = re.compile(r"(?P<cpu>[\w.-]+)/(?P<lanes>\d+)(?:/(?P<features>[+-][\w.-]+(?:,[+-][\w.-]+)*))?")


@dataclasses.dataclass(frozen=True)
class Target:
    """The target of kernels.

    Attributes:
        cpu: LLVM's name, such as `znver4` or `x86-64-v3`.
        lanes: Rays that a packet holds: 16 with AVX-512, 8 with AVX2, 4 on ARM.
        features: LLVM's, such as `+avx2`, `-avx512f`; None where the name alone says them.
    """

    cpu: str
    lanes: int
    features: tuple[str, ...] | None


def compiled_for() -> Target | None:
    """The target of Dr.Jit's LLVM backend, which must have started; None where its library does not state it."""
    try:
        core = _core()
        cpu, features, lanes = (getattr(core, name) for name in _READERS)
    except (OSError, AttributeError):  # another version of Dr.Jit
        return None
    cpu.restype = features.restype = ctypes.c_char_p
    lanes.restype = ctypes.c_uint32
    listed = features()
    return Target((cpu() or b"").decode(), int(lanes()), None if listed is None else tuple(listed.decode().split(",")))


def compile_for(text: str, where: str) -> None:
    """Compile what comes for another x86-64 processor than this machine's, to get the digits that it gets.

    Sums depend in their last bits on the instructions and on the lanes of a packet.

    Args:
        text: `CPU/LANES` or `CPU/LANES/FEATURES` as LLVM names them: `haswell/8`, `x86-64-v2/4/+fma`.
        where: What an error begins with.
    Raises:
        ValueError: If it is not written so, the lanes are none of `LANES`, this machine lacks instructions, or this
            Dr.Jit has no such function.
    """
    found = _WRITTEN.fullmatch(text)
    here = _of_machine()
    if here is None or here.features is None or not _is_x86():
        raise ValueError(f"{where} must be left out but on x86-64 with Dr.Jit 1.5, got {platform.machine()}")
    if found is None or int(found["lanes"]) not in LANES or found["cpu"] not in _PROCESSORS:
        lanes = ", ".join(map(str, LANES))
        raise ValueError(
            f"{where} must be CPU/LANES or CPU/LANES/FEATURES with lanes of {lanes}, such as haswell/8 or "
            f"x86-64-v2/4/+fma, got {text!r}; CPU is one of {', '.join(_PROCESSORS)}"
        )
    features = found["features"]
    wanted = [*_PROCESSORS[found["cpu"]], *(x[1:] for x in (features or "").split(",") if x.startswith("+"))]
    if absent := [name for name in wanted if f"+{name}" not in here.features]:
        raise ValueError(f"{where} must be of instructions that {here.cpu} has, got {text!r} with {', '.join(absent)}")
    choose = getattr(_core(), _CHOOSER)
    choose.argtypes = (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32)
    choose.restype = None
    choose(found["cpu"].encode(), None if features is None else features.encode(), int(found["lanes"]))


def missing_features(target: Target) -> list[str]:
    """Names of the instructions that Dr.Jit's kernels need and this target lacks; none where that is not known."""
    if not _is_x86():
        return []
    stated = target.features or ()
    if _NEEDED in _PROCESSORS.get(target.cpu, ()):  # the name says it; features may take it away
        return [_NEEDED] if f"-{_NEEDED}" in stated else []
    return [] if f"+{_NEEDED}" in stated else [_NEEDED]


@functools.cache
def _of_machine() -> Target | None:
    """This machine's target: first read before another one is chosen."""
    return compiled_for()


def _is_x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


def _core() -> ctypes.CDLL:
    """Dr.Jit's core, which is loaded already; its C++ functions go by their mangled names."""
    import drjit

    suffix = {"darwin": "dylib", "win32": "dll"}.get(sys.platform, "so")
    return ctypes.CDLL(str(Path(drjit.__file__).parent / f"libdrjit-core.{suffix}"))
