"""How benchmarks time things: peers take turns in one process, and what counts are medians and their ratios."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path

__all__ = ["in_turns", "interleaved", "processor_seconds"]


def in_turns(
    runs: Mapping[str, Callable[[], object]],
    turns: int,
    clock: Callable[[], float] = time.perf_counter,
    warm: bool = False,
) -> dict[str, list[float]]:
    """Seconds of each run in each turn, after a turn that compiles.

    Args:
        runs: Name -> what is timed.
        turns: Number of turns that count.
        clock: Clock in seconds; `time.process_time` is stretched little by what else runs on the machine.
        warm: Each is run once before each time that counts, so that it does not pay for what its peer has left: a frame
            after one of `volprim_rf_basic` takes twice its time.
    """
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(turns + 1):
        for name, run in runs.items():
            if warm and turn:
                run()
            start = clock()
            run()
            if turn:
                seconds[name].append(clock() - start)
    return seconds


def interleaved(
    runs: Mapping[str, Callable[[], object]],
    turns: int,
    clock: Callable[[], float] = time.perf_counter,
    warm: bool = False,
) -> dict[str, float]:
    """Median seconds of each run, taking turns (`in_turns`)."""
    return {name: statistics.median(x) for name, x in in_turns(runs, turns, clock, warm).items()}


def processor_seconds(pid: int) -> float:
    """Seconds of processor time that a process has taken; 0 of one that is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
