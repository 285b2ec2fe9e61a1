"""How many threads are left to Dr.Jit and to torch while both compute."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

import torch

_here = threading.local()  # `are_fewer`: within `fewer_torch_threads` of this thread


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One Dr.Jit thread: additions of several come in any order, and float additions do not commute with that."""
    import drjit as dr

    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(threads)


@contextlib.contextmanager
def fewer_torch_threads() -> Iterator[None]:
    """Half of torch's threads while fitting, and while views are chosen.

    Between its operations OpenMP's threads spin and take cores from Dr.Jit's, and each operation waits for the last of
    them: with all of them, a step on two cores takes 0.10 s instead of 0.07 s (banana, 130,000 pixels), five times as
    long once other processes run, and a pick in motion 5.0 s instead of 4.3 (a hall, 15,000 Gaussians).
    """
    if getattr(_here, "are_fewer", False):  # a pick within a fit: half of them, not a quarter
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(max(1, threads // 2))
    _here.are_fewer = True
    try:
        yield
    finally:
        _here.are_fewer = False
        torch.set_num_threads(threads)
