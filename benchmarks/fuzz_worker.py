"""The process that reads damaged files for benchmarks/fuzz.py: one reader, numbered inputs, one JSON line for news.

    python benchmarks/fuzz_worker.py READER BEGIN END SCRATCH

It may die or hang: SCRATCH/number then says at which input. Memory is watched by what it asks for: an input for which
the address space grows by more than `GREEDY` bytes is a finding, whatever the reader says afterwards, and `LIMIT`
protects the machine.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import logging
import mmap
import os
import resource
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

GREEDY = 1 << 30
LIMIT = 6 << 30
SLOW = 5.0
"""Seconds of processor time that an input may take."""
_NEWS = 2.0  # seconds between counts
_IN_MEMORY = ("alloc", "out of memory", "memory for", "insufficient memory")


def peak() -> tuple[int, int]:
    """The largest address space and the largest resident set so far, in bytes."""
    text = Path("/proc/self/status").read_bytes()
    return tuple(int(text.partition(name)[2].split(None, 1)[0]) << 10 for name in (b"VmPeak:", b"VmHWM:"))  # type: ignore


def place_of(error: BaseException) -> str:
    """Where in drgs an error came from, file:line, by which findings of one cause are told."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if f"{ROOT}/drgs" in frame.filename] or list(frames)
    return f"{os.path.relpath(own[-1].filename, ROOT)}:{own[-1].lineno}" if own else "?"


def tell(**news: Any) -> None:
    """A line for the parent."""
    print(json.dumps(news), flush=True)


def main() -> None:
    name, begin, end, scratch = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
    tempfile.tempdir = str(scratch / "tmp")
    os.makedirs(tempfile.tempdir, exist_ok=True)
    logging.disable()
    warnings.simplefilter("ignore")
    faulthandler.enable((scratch / "crash.txt").open("w"))
    from fuzz_targets import TARGETS, Bench

    bench = Bench(TARGETS[name], scratch)
    bench.check()
    address, resident = peak()
    first = resident
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (size + LIMIT, size + LIMIT))
    (scratch / "number").write_bytes(struct.pack("<q", begin))
    with (scratch / "number").open("r+b") as file:
        shown = mmap.mmap(file.fileno(), 8)
    counts: Counter[str] = Counter()
    slowest, told = 0.0, time.monotonic()
    tell(ready=True)
    for number in range(begin, end):
        folder, path, data = bench.place(number)
        shown[:8] = struct.pack("<q", number)
        began = time.process_time()
        how, fault, error = bench.read(folder)
        took = time.process_time() - began
        slowest = max(slowest, took)
        now_address, now_resident = peak()
        if fault is None and took > SLOW:
            fault = f"{took:.1f} s"
        if now_address - address > GREEDY or now_resident - resident > GREEDY:
            more = max(now_address - address, now_resident - resident)
            fault = f"asks for {more / 2**30:.1f} GiB for {len(data)} bytes"
        if fault is None and error is not None and any(word in str(error).lower() for word in _IN_MEMORY):
            fault = "an error of memory"
        address, resident = max(address, now_address), max(resident, now_resident)
        counts[how] += 1
        if fault is not None:
            news = {"finding": number, "fault": fault, "file": str(path.relative_to(folder)), "damaged": str(path)}
            where = {"place": place_of(error), "text": str(error)[:500]} if error is not None else {}
            trace = "".join(traceback.format_exception(error))[-4000:] if error is not None else ""
            (scratch / "finding").write_bytes(data)
            tell(**news, **where, trace=trace)
            sys.stdin.readline()  # until the input is kept
        if error is not None:
            with contextlib.suppress(Exception):
                traceback.clear_frames(error.__traceback__)
        error = None
        if time.monotonic() - told > _NEWS or number == end - 1:
            told = time.monotonic()
            tell(done=number + 1, counts=counts, slowest=slowest, grown=resident - first)
            counts.clear()


if __name__ == "__main__":
    main()
