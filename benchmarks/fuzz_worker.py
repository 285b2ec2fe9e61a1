"""The process that reads damaged files for benchmarks/fuzz.py: one reader, one JSON line for news.

    python benchmarks/fuzz_worker.py READER BEGIN END SCRATCH [CORPUS]

Inputs are numbered, or, given a CORPUS, chosen by atheris (libFuzzer) by the lines of drgs that they reach: what
reaches new ones is kept there, to be damaged further. It may die or hang: SCRATCH/number then says at which input, and
which file it was. Memory is watched by what it asks for, in the processes that it starts too: an input for which the
address space grows by more than `GREEDY` bytes is a finding, whatever the reader says afterwards, and `LIMIT` protects
the machine.
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
from random import Random
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from clocks import processor_seconds  # noqa: E402

GREEDY = 1 << 30
LIMIT = 6 << 30
SLOW = 5.0
"""Seconds of processor time that an input may take."""
WATCHED = [
    *("drgs.codecs", "drgs.data", "drgs.checks", "drgs.io", "drgs.features.teacher", "drgs.features.decoder"),
    *("drgs.fitting.records", "drgs.pages.report.account", "drgs.lab.rasterizers"),
]
"""Modules whose lines atheris watches."""
_NEWS = 2.0  # seconds between counts
_IN_MEMORY = ("alloc", "out of memory", "memory for", "insufficient memory")
_ENDED = "the process that reads it ended with"  # drgs/data/reader_process.py
_LARGEST = 1 << 16  # bytes of an input that atheris chooses


def children() -> list[int]:
    """Processes that the main thread has started."""
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return [int(x) for x in file.read().split()]


def peak() -> tuple[int, int]:
    """The largest address space and the largest resident set so far, in bytes, of all processes together."""
    sums = [0, 0]
    for pid in ("self", *children()):
        text = Path(f"/proc/{pid}/status").read_bytes()
        for i, name in enumerate((b"VmPeak:", b"VmHWM:")):
            sums[i] += int((text.partition(name)[2].split(None, 1) or [b"0"])[0]) << 10  # a dead one has none
    return sums[0], sums[1]


def spent() -> float:
    """Seconds of processor time of all processes together."""
    return time.process_time() + sum(processor_seconds(pid) for pid in children())


def place_of(error: BaseException) -> str:
    """The place in drgs that an error came from, file:line, by which findings of one cause are told."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if f"{ROOT}/drgs" in frame.filename] or list(frames)
    return f"{os.path.relpath(own[-1].filename, ROOT)}:{own[-1].lineno}" if own else "?"


def tell(**news: Any) -> None:
    """A line for the parent."""
    print(json.dumps(news), flush=True)


class Watch:
    """Judges inputs one after the other.

    Args:
        bench: What reads.
        scratch: Folder that the parent looks at.
        begin: Number of the first input.
    """

    def __init__(self, bench: Any, scratch: Path, begin: int) -> None:
        self.bench = bench
        self.scratch = scratch
        self.number = begin
        self.counts: Counter[str] = Counter()
        self.slowest = 0.0
        self._told = time.monotonic()
        self.address, self.resident = peak()
        self._first = self.resident
        for pid in (0, *children()):
            size = int(Path(f"/proc/{pid or 'self'}/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            resource.prlimit(pid, resource.RLIMIT_AS, (size + LIMIT, size + LIMIT))
        (scratch / "number").write_bytes(struct.pack("<q", begin).ljust(4096, b"\0"))
        with (scratch / "number").open("r+b") as file:
            self._shown = mmap.mmap(file.fileno(), 4096)

    def see(self, folder: Path, path: Path, data: bytes) -> None:
        """Read an input, which is in its place, and say what was found."""
        name = str(path).encode()
        self._shown[8 : 10 + len(name)] = len(name).to_bytes(2, "little") + name
        self._shown[:8] = struct.pack("<q", self.number)
        began = spent()
        how, fault, error = self.bench.read(folder)
        took = spent() - began
        self.slowest = max(self.slowest, took)
        now_address, now_resident = peak()
        if fault is None and took > SLOW:
            fault = f"{took:.1f} s"
        if now_address - self.address > GREEDY or now_resident - self.resident > GREEDY:
            more = max(now_address - self.address, now_resident - self.resident)
            fault = f"asks for {more / 2**30:.1f} GiB for {len(data)} bytes"
        if fault is None and error is not None and any(word in str(error).lower() for word in _IN_MEMORY):
            fault = "an error of memory"
        self.address = max(self.address, now_address)
        self.resident = max(self.resident, now_resident)
        self.counts["ended" if error is not None and _ENDED in str(error) else how] += 1
        if fault is not None:
            news = {"finding": self.number, "fault": fault, "file": str(path.relative_to(folder)), "damaged": str(path)}
            where = {"place": place_of(error), "text": str(error)[:500]} if error is not None else {}
            trace = "".join(traceback.format_exception(error))[-4000:] if error is not None else ""
            (self.scratch / "finding").write_bytes(data)
            tell(**news, **where, trace=trace)
            sys.stdin.readline()  # until the input is kept
        if error is not None:
            with contextlib.suppress(Exception):
                traceback.clear_frames(error.__traceback__)
        self.number += 1
        if time.monotonic() - self._told > _NEWS:
            self.say()

    def say(self, **more: Any) -> None:
        """Tell the parent what was counted since."""
        self._told = time.monotonic()
        tell(done=self.number, counts=self.counts, slowest=self.slowest, grown=self.resident - self._first, **more)
        self.counts.clear()


def by_number(name: str, scratch: Path, begin: int, end: int) -> None:
    """Read the inputs of these numbers."""
    from fuzz_targets import TARGETS, Bench

    bench = Bench(TARGETS[name], scratch)
    bench.check()
    watch = Watch(bench, scratch, begin)
    tell(ready=True)
    for number in range(begin, end):
        watch.see(*bench.place(number))
    watch.say()


def by_reach(name: str, scratch: Path, begin: int, end: int, corpus: Path) -> None:
    """Read inputs that atheris chooses; the first byte of each says which file the others are of."""
    import atheris

    with atheris.instrument_imports(include=WATCHED):
        from fuzz_formats import mutate
        from fuzz_targets import TARGETS, Bench

        bench = Bench(TARGETS[name], scratch)
        bench.check()
    corpus.mkdir(parents=True, exist_ok=True)
    for i, (_, _, data) in enumerate(bench.files[:256]):
        (corpus / f"seed{i}").write_bytes(bytes([i]) + data)
    watch = Watch(bench, scratch, begin)

    def file_of(data: bytes) -> tuple[Path, Path, bytes]:
        return bench.files[data[0] % len(bench.files)]

    def one(data: bytes) -> None:
        folder, path, _ = file_of(data or b"\0")
        bench.put(path, data[1:])
        watch.see(folder, path, data[1:])
        if watch.number == end:
            watch.say()
            os._exit(0)

    def damage(data: bytes, largest: int, seed: int) -> bytes:
        draw = Random(seed)
        if not data or draw.random() < 0.3:
            return atheris.Mutate(data, len(data) + 64 if len(data) + 64 < largest else largest)
        suffix = file_of(data)[1].suffix
        others = [other for _, path, other in bench.files if path.suffix == suffix]
        return (data[:1] + mutate(data[1:], suffix, draw, others))[:largest]

    tell(ready=True)
    # Its own handling of signals, time and memory would hide from the parent what it looks for.
    signals = ("abrt", "bus", "fpe", "ill", "int", "segv", "term", "usr1", "usr2", "xfsz")
    quiet = [f"-handle_{name}=0" for name in signals] + ["-timeout=1000000", "-rss_limit_mb=0", "-verbosity=0"]
    options = [*quiet, f"-max_len={_LARGEST}", f"-seed={begin + 1}", f"-artifact_prefix={scratch}/"]
    atheris.Setup([sys.argv[0], *options, str(corpus)], one, custom_mutator=damage)
    atheris.Fuzz()


def main() -> None:
    name = sys.argv[1]
    begin = int(sys.argv[2])
    end = int(sys.argv[3])
    scratch = Path(sys.argv[4])
    tempfile.tempdir = str(scratch / "tmp")
    os.makedirs(tempfile.tempdir, exist_ok=True)
    logging.disable()
    warnings.simplefilter("ignore")
    faulthandler.enable((scratch / "crash.txt").open("w"))
    if len(sys.argv) > 5:
        by_reach(name, scratch, begin, end, Path(sys.argv[5]))
    else:
        by_number(name, scratch, begin, end)


if __name__ == "__main__":
    main()
