"""Workers that compute: those of a Dask cluster that runs already, or processes that are started on this machine.

    with opened("10.0.0.7:8786") as cluster: ...     # joins what `dask scheduler` and `dask worker` have started
    with opened(workers=4) as cluster: ...           # four processes, which end with the block

Every worker states what it computes with before it gets work, and again with each task, so that one which joins later
is refused as well. Dask runs what anyone sends to its scheduler: see docs/many-machines.md.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import signal
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from drgs import runtime
from drgs.cluster.options import check_options
from drgs.cluster.workers import WORKER_SECONDS, Cluster
from drgs.display.progress import Bar
from drgs.io.atomic import temporary_folder
from drgs.runtime.memory import available, is_out_of_memory

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

__all__ = ["CONNECT_SECONDS", "WORKER_SECONDS", "Cluster", "opened"]

CONNECT_SECONDS = 10.0
"""Time within which a scheduler must answer."""

_START_SECONDS = 300  # seconds within which a local worker must be up, also on a busy machine; chosen
_RUN_AGAIN = 64  # exit code of a worker that has found itself running its parent's script (EX_USAGE)


@contextlib.contextmanager
def opened(scheduler: str | None = None, workers: int | None = None) -> Iterator[Cluster | None]:
    """Workers for the length of a block; None where neither argument is given.

    Args:
        scheduler: `HOST:PORT` of a Dask cluster to join.
        workers: How many processes to start here, of one thread each. They are spawned: a script that calls this must
            do so below `if __name__ == "__main__":`.
    Raises:
        ValueError: If an argument is bad, Dask is not installed, or a worker computes with something else than this
            process (`Disagreement`).
        ConnectionError: If no scheduler answers, there are no workers, or one does not start, and why.
    """
    if scheduler is None and workers is None:
        yield None
        return
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # as multiprocessing asks itself
        raise SystemExit(_RUN_AGAIN)  # a worker to be, which runs the script of its parent; that says so
    address = check_options(scheduler, workers)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_silent())
        if address is not None:
            with Bar(f"the scheduler {scheduler}"):
                client = _joined(address)
                local = None
        else:
            folder = stack.enter_context(temporary_folder("cluster"))
            with Bar(f"starting {workers} workers"):
                client, local = _started(workers or 1, str(folder))
        cluster = Cluster(client, local)
        stack.callback(cluster.close)
        with Bar("asking the workers"):
            cluster.check()
        yield cluster


def _joined(address: str) -> Client:
    """A client of a scheduler that has workers."""
    from distributed import Client

    name = address.removeprefix("tcp://")
    try:
        _knock(address)
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False, name="drgs")
    except (OSError, TimeoutError, ImportError, ValueError, RuntimeError):
        raise ConnectionError(
            f"cluster: a Dask scheduler must answer at {name}, none did in {CONNECT_SECONDS:.0f} s; start one with "
            "`dask scheduler`, or correct --scheduler"
        ) from None
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except TimeoutError:
        client.close(timeout=2)
        raise ConnectionError(
            f"cluster: the scheduler at {name} must have workers, had none for {WORKER_SECONDS:.0f} s; start some with "
            f"`DRGS_THREADS=1 dask worker {name} --nthreads 1`"
        ) from None
    return client


def _knock(address: str) -> None:
    """Find out in bounded time whether Dask answers: its client waits forever for who accepts and says nothing."""
    from distributed.comm import connect

    async def greeted() -> None:
        (await connect(address, timeout=CONNECT_SECONDS)).abort()

    def knock() -> None:
        asyncio.run(asyncio.wait_for(greeted(), CONNECT_SECONDS))

    with ThreadPoolExecutor(1) as other:  # the caller's thread may have an event loop
        other.submit(knock).result()


def _started(count: int, folder: str) -> tuple[Client, LocalCluster]:
    """A scheduler in a thread of this process, workers in processes of their own, all on the loopback interface."""
    import dask
    from distributed import Client, LocalCluster

    variant = runtime.backend().variant
    one = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "DRGS_THREADS"), "1")
    config = {
        "distributed.worker.multiprocessing-method": "spawn",  # a fork would have Dr.Jit's locks, not its threads
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        "distributed.nanny.pre-spawn-environ": {},  # it would be written into the environment of this process
    }
    environ = {**one, "DRGS_VARIANT": variant, "OMP_WAIT_POLICY": "PASSIVE"}
    ended: list[int] = []
    with dask.config.set(config):
        try:
            local = LocalCluster(
                worker_class=_watched(ended),
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                memory_limit=0,  # nothing is spilled, paused or restarted for its memory
                local_directory=folder,
                silence_logs=logging.CRITICAL,
                preload=["drgs.cluster.preload"],
                env=environ,
                death_timeout=_START_SECONDS,
            )
        except (OSError, TimeoutError, RuntimeError) as error:
            raise ConnectionError(f"cluster: --workers {count} must all start, did not: {_why(ended, error)}") from None
        return Client(local, timeout=_START_SECONDS, set_as_default=False, name="drgs", direct_to_workers=True), local


def _watched(ended: list[int]) -> type:
    """Dask's keeper of a worker process, which also notes the exit code of one that ends.

    By a private method, for Dask 2026.8 has no public way to the code: where it is called otherwise, the message of
    `_why` has none.
    """
    from distributed import Nanny

    class Watched(Nanny):
        def _on_worker_exit_sync(self, exitcode: int) -> None:
            ended.append(exitcode)
            super()._on_worker_exit_sync(exitcode)

    return Watched


def _why(ended: Sequence[int], error: BaseException) -> str:
    """Why workers did not start, and what to do.

    Args:
        ended: Exit codes of those that have ended; of a signal, its negative number.
        error: What Dask has raised.
    """
    if _RUN_AGAIN in ended:
        return 'each runs the script that starts it once more, which must do so below `if __name__ == "__main__":`'
    while error.__cause__ is not None:
        error = error.__cause__
    if -signal.SIGKILL in ended or is_out_of_memory(error):
        there = available()
        left = "" if there is None else f"; {there / 1e9:.1f} GB are left now"
        what = "one was killed (SIGKILL), as systems do that" if -signal.SIGKILL in ended else "they"
        return f"{what} have no memory left{left}; free some, or start fewer"
    if codes := [code for code in ended if code]:
        code = codes[0]
        how = f"one was ended by {signal.Signals(-code).name}" if code < 0 else f"one ended with exit code {code}"
        return f"{how}; look at what it printed before"
    if isinstance(error, TimeoutError):
        return f"they were not ready in {_START_SECONDS} s; start fewer, or try again when the machine is less busy"
    return f"{error or type(error).__name__}; try again, or without them"


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Neither Dask's log nor its warnings on stderr: what matters is raised."""
    import distributed  # makes its loggers
    from distributed.versions import VersionMismatchWarning

    assert distributed
    roots = ("distributed", "tornado", "asyncio")
    names = {*roots, *(name for name in logging.root.manager.loggerDict if name.split(".")[0] in roots)}
    before = {name: logging.getLogger(name).level for name in names}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)
        for name in names:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        try:
            yield
        finally:
            for name, level in before.items():
                logging.getLogger(name).setLevel(level)
