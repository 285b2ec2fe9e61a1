"""Free memory, and refusal of work that needs more before it starts: a process that is killed cannot report."""

from __future__ import annotations

import os
import resource
from pathlib import Path

# Measured: what a frame of 1024^2 to 4096^2 pixels adds to the resident set of a fresh process (LLVM, one thread; rgb,
# alpha and depth of 1,000 Gaussians), divided by its pixels; the constants are the least of them. Tiles: 61 to 67 bytes
# a pixel in the order of centers, in that of rays as much and their rows; bvh: 156 to 172; gradients: 54 to 61 more.
# Lists of Gaussians, rows (128 MB at a time) and kernels come on top, hence "at least".
_TILES_BYTES = 60
_BVH_BYTES = 155
_GRADIENT_BYTES = 50
_FEATURE_BYTES = 8
PICTURES = {"png": 12, "jpg": 12, "exr": 28, "webm": 90, "mp4": 90}
"""Bytes a pixel that writing a file of a format adds, measured in the same way."""
TANGENT = 70
"""Bytes a pixel that each column of forward mode adds (measured with six: 73)."""
PAIR = 24
"""Bytes an entry of the tile lists takes while they are made: keys, their sorted copy, and the sort's own."""
_MEMINFO = Path("/proc/meminfo")
_GROUP_OF = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")
_RESERVE_BYTES = 256 << 20  # bytes for kernels, tensors of the Gaussians and whatever else a command holds; chosen
# bytes up to which free memory is not checked, because the check costs more than it is worth; chosen
_UNCHECKED_BYTES = 256 << 20


def frame_bytes(pixels: int, traversal: str, features: int = 0, gradients: bool = False) -> int:
    """Bytes that rendering an image takes at least, whatever it shows.

    Args:
        pixels: Number of pixels of the image.
        traversal: `RenderSettings.traversal`.
        features: Channels besides the colors.
        gradients: Whether it will be differentiated.
    """
    each = _BVH_BYTES if traversal == "bvh" else _TILES_BYTES
    return pixels * (each + _FEATURE_BYTES * features + _GRADIENT_BYTES * gradients)


def require(where: str, needed: int, what: str, advice: str, cuda: bool = False) -> None:
    """Raise ValueError if `needed` bytes are more than there are.

    Args:
        where: The function.
        needed: Bytes, a lower bound.
        what: That takes them.
        advice: How it takes less.
        cuda: Check the device's memory, in place of the machine's.
    """
    if needed < _UNCHECKED_BYTES:
        return
    there = _device() if cuda else available()
    if cuda and there is not None and needed + _RESERVE_BYTES > there:
        _release()
        there = _device()
    if there is not None and needed + _RESERVE_BYTES > there:
        raise ValueError(
            f"{where}: there must be memory for {what}, which takes at least {_gigabytes(needed)}, "
            f"got {_gigabytes(max(there, 0))} available; {advice}"
        )


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory has run out: Python's and NumPy's do by type, torch's and Dr.Jit's in words."""
    words = ("can't allocate memory", "out of memory", "bad allocation", "std::bad_alloc")
    return isinstance(error, MemoryError) or any(word in str(error).lower() for word in words)


def available() -> int | None:
    """Bytes that this process may still take: of the machine, its control group and its limits; None if unknown."""
    known = [x for x in (_machine(), _control_group(), _address_space()) if x is not None]
    return min(known, default=None)


def of_card() -> int | None:
    """Bytes of a card's memory, whoever has them; None if unknown."""
    import torch

    return torch.cuda.mem_get_info()[1] if torch.cuda.is_available() else None


def _device() -> int | None:
    import torch

    return torch.cuda.mem_get_info()[0] if torch.cuda.is_available() else None


def _release() -> None:
    """Give back what torch and Dr.Jit keep of a card for later use."""
    import drjit as dr
    import torch

    dr.flush_malloc_cache()
    torch.cuda.empty_cache()


def _machine() -> int | None:
    try:
        for line in _MEMINFO.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) << 10
    except (OSError, ValueError):
        pass
    try:  # macOS does not report free memory; the total is an upper bound
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return None


def _control_group() -> int | None:
    """Bytes that the container may still allocate: the tightest limit of its control group and those above it."""
    left = []
    try:
        lines = _GROUP_OF.read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        _, controllers, inside = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root = _GROUPS / ("memory" if controllers else "")
        files = ("memory.limit_in_bytes", "memory.usage_in_bytes") if controllers else ("memory.max", "memory.current")
        folder = root / inside.lstrip("/")
        for group in (folder, *folder.parents):
            if root not in (group, *group.parents):
                break
            try:
                most, taken = (int((group / name).read_text()) for name in files)
                cached = dict(row.split() for row in (group / "memory.stat").read_text().splitlines())
                left.append(most - taken + int(cached.get("inactive_file", 0)))  # the kernel gives files' pages back
            except (OSError, ValueError):  # no such group here, or no limit ("max")
                continue
    return min(left, default=None)


def _address_space() -> int | None:
    """Bytes that `ulimit -v` leaves."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return None
    try:
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        taken = 0
    return limit - taken


def _gigabytes(count: int) -> str:
    return f"{count / 2**30:.1f} GiB"
