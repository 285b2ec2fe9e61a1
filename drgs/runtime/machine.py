"""The processor, the card, the memory and the commit of the checkout, for `drgs info` and env.json."""

from __future__ import annotations

import contextlib
import platform
import sys
from pathlib import Path


def cpu_model() -> str:
    """Name of the processor, as the system gives it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:  # not Linux
        pass
    brand = _output("sysctl", "-n", "machdep.cpu.brand_string") if sys.platform == "darwin" else None
    return brand or platform.processor() or platform.machine()


def commit() -> str | None:
    """Commit of the checkout that this package lies in, `-dirty` appended if its code has changed since.

    None when installed. Results that a study has added to the checkout are no change of what it computes.
    """
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    git = "git", "-C", str(root)
    there = _output(*git, "describe", "--always", "--exclude=*")
    is_dirty = there and _output(*git, "status", "--porcelain", "--untracked-files=no", "--", "*.py", "*.toml")
    return f"{there}-dirty" if is_dirty else there


def gpu_name() -> str | None:
    """Names and driver versions of NVIDIA cards; None without."""
    return _output("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader")


def peak_memory() -> int | None:
    """The most bytes of memory that this process has held so far; None where the system does not say."""
    # Linux counts in ru_maxrss what the process that started this one held before it became this program.
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:  # not Linux
        pass
    try:
        import resource
    except ImportError:  # not POSIX
        return None
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return held if sys.platform == "darwin" else 1024 * held


def forget_peak_memory() -> None:
    """Count `peak_memory` anew from what is held now, where the system can: for several fits of one process."""
    with contextlib.suppress(OSError):  # not Linux, or not allowed
        Path("/proc/self/clear_refs").write_text("5")


def _output(*command: str) -> str | None:
    """First line that a command prints, or None when it fails or is not there."""
    import subprocess

    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return next(iter(done.stdout.splitlines()), None)
