"""What Dr.Jit compiles for on a CPU: the processor as LLVM names it, its features, and the lanes of a packet.

Dr.Jit asks LLVM for the machine's own. Its Python module says nothing of it, the library that it loads does.
"""

from __future__ import annotations

import ctypes
import dataclasses
import platform
import re
import sys
from pathlib import Path

__all__ = ["LANES", "Target", "compile_for", "compiled_for", "missing_features"]

LANES = (4, 8, 16)  # what Mitsuba's ray tracing on a CPU, Embree, takes
# Without FMA LLVM has no instruction for Dr.Jit's fused products, calls a function that nothing provides, and Dr.Jit
# aborts the process at the first kernel. All else that an older processor lacks LLVM replaces.
_NEEDED = {"x86_64": ("fma",), "amd64": ("fma",)}
# LLVM's names of processors with 64 bits, and whether they have FMA. Of a name that it does not know LLVM makes one of
# 32 bits, and aborts.
_PROCESSORS = {
    **dict.fromkeys(("x86-64", "x86-64-v2", "nehalem", "westmere", "sandybridge", "ivybridge", "btver2"), False),
    **dict.fromkeys(("x86-64-v3", "x86-64-v4", "haswell", "broadwell", "skylake", "alderlake"), True),
    **dict.fromkeys(("skylake-avx512", "cascadelake", "icelake-server", "sapphirerapids"), True),
    **dict.fromkeys(("znver1", "znver2", "znver3", "znver4", "znver5"), True),
    **dict.fromkeys(("generic", "cortex-a76", "neoverse-n1", "neoverse-v1", "apple-m1", "apple-m2"), True),
}
_WRITTEN = re.compile(r"(?P<cpu>[\w.-]+)/(?P<lanes>\d+)(?:/(?P<features>[+-][\w.-]+(?:,[+-][\w.-]+)*))?")


@dataclasses.dataclass(frozen=True)
class Target:
    """What kernels are compiled for.

    Attributes:
        cpu: LLVM's name, such as `znver4` or `x86-64-v3`.
        lanes: Rays that a packet holds: 16 with AVX-512, 8 with AVX2, 4 on ARM.
        features: LLVM's, such as `+avx2`, `-avx512f`; None where the name alone says them.
    """

    cpu: str
    lanes: int
    features: tuple[str, ...] | None


def compiled_for() -> Target | None:
    """The target of Dr.Jit's LLVM backend, which must have started; None where its library does not tell."""
    try:
        core = _core()
        cpu, features, lanes = (
            core._Z19jit_llvm_target_cpuv,
            core._Z24jit_llvm_target_featuresv,
            core._Z21jit_llvm_vector_widthv,
        )
    except (OSError, AttributeError):  # another version of Dr.Jit
        return None
    cpu.restype = features.restype = ctypes.c_char_p
    lanes.restype = ctypes.c_uint32
    listed = features()
    return Target((cpu() or b"").decode(), int(lanes()), None if listed is None else tuple(listed.decode().split(",")))


def compile_for(text: str, where: str) -> None:
    """Compile what comes for another processor than this machine's, to get the digits that it gets.

    Sums depend in their last bits on the instructions and on the lanes of a packet. The processor must have the
    instructions: those of a newer one end the process.

    Args:
        text: `CPU/LANES` or `CPU/LANES/FEATURES` as LLVM names them: `haswell/8`, `x86-64-v2/4/+fma`.
        where: What an error begins with.
    Raises:
        ValueError: If it is not written so, the lanes are none of `LANES`, or this Dr.Jit cannot be told.
    """
    found = _WRITTEN.fullmatch(text)
    if found is None or int(found["lanes"]) not in LANES or found["cpu"] not in _PROCESSORS:
        lanes = ", ".join(map(str, LANES))
        raise ValueError(
            f"{where} must be CPU/LANES or CPU/LANES/FEATURES with lanes of {lanes}, such as haswell/8 or "
            f"x86-64-v2/4/+fma, got {text!r}; CPU is one of {', '.join(_PROCESSORS)}"
        )
    try:
        choose = _core()._Z19jit_llvm_set_targetPKcS0_j
    except (OSError, AttributeError):
        raise ValueError(f"{where} must be left out with this version of Dr.Jit, which takes no target") from None
    choose.argtypes, choose.restype = (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32), None
    features = found["features"]
    choose(found["cpu"].encode(), None if features is None else features.encode(), int(found["lanes"]))


def missing_features(target: Target | None) -> list[str]:
    """Names of the instructions that Dr.Jit's kernels need and this target lacks; none where that is not known."""
    needed = _NEEDED.get(platform.machine().lower(), ())
    if target is None:
        return []
    if _PROCESSORS.get(target.cpu, target.features is None):  # what the name says, features may take away
        return [name for name in needed if f"-{name}" in (target.features or ())]
    return [name for name in needed if f"+{name}" not in (target.features or ())]


def _core() -> ctypes.CDLL:
    """Dr.Jit's core, which is loaded already; its C++ functions go by their mangled names."""
    import drjit

    suffix = {"darwin": "dylib", "win32": "dll"}.get(sys.platform, "so")
    return ctypes.CDLL(str(Path(drjit.__file__).parent / f"libdrjit-core.{suffix}"))
