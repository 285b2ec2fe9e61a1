"""Workers that compute: those of a Dask cluster that runs already, or processes that are started on this machine.

    with opened("10.0.0.7:8786") as cluster: ...     # joins what `dask scheduler` and `dask worker` have started
    with opened(workers=4) as cluster: ...           # four processes, which end with the block

Every worker is asked what it computes with before it gets work, and again by each task, so that one which joins later
is refused as well. Dask runs what anyone sends to its scheduler: see docs/many-machines.md.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import platform
import signal
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from drgs import runtime
from drgs.cluster.agreement import Disagreement, check_agreement, statement, worker_name, worker_statement
from drgs.cluster.payloads import Parcel, keep
from drgs.cluster.views import answers
from drgs.cluster.wanted import check_wanted
from drgs.display.progress import Bar
from drgs.guards.memory import available, is_out_of_memory
from drgs.guards.unfinished import temporary_folder

if TYPE_CHECKING:
    import torch
    from distributed import Client, Future, LocalCluster

    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene
    from drgs.gain import Information
    from drgs.information.pool import Question

__all__ = ["CONNECT_SECONDS", "WORKER_SECONDS", "Cluster", "opened"]

CONNECT_SECONDS = 10.0
"""Within which a scheduler must answer."""
WORKER_SECONDS = 60.0
"""That a cluster may be without any worker."""

_START_SECONDS = 300  # for a local worker to come up, on a busy machine
_RUN_AGAIN = 64  # exit code of a worker that has found itself running its parent's script (EX_USAGE)
_LOOK = 2.0  # seconds between two looks at the scheduler while nothing comes
_log = logging.getLogger(__name__)


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
    address = check_wanted(scheduler, workers)
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
                preload=["drgs.cluster.worker"],
                env=environ,
                death_timeout=_START_SECONDS,
            )
        except (OSError, TimeoutError, RuntimeError) as error:
            raise ConnectionError(f"cluster: --workers {count} must all start, did not: {_why(ended, error)}") from None
        return Client(local, timeout=_START_SECONDS, set_as_default=False, name="drgs", direct_to_workers=True), local


def _watched(ended: list[int]) -> type:
    """Dask's keeper of a worker process, which also notes the exit code of one that ends."""
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


class Cluster:
    """Workers behind a scheduler, as `drgs.select` takes them; `opened` makes one.

    Attributes:
        client: Dask's.
        ours: What every worker must have in common with this process.
        sent_bytes, sent_seconds: To each worker, and for all of them, so far.
        views: Worker -> how many views it has answered for.
        view_seconds: Of each of these, on its worker.
        cpu_seconds: Of all of these together.
        received_bytes: Of all answers.
    """

    def __init__(self, client: Client, local: LocalCluster | None = None) -> None:
        self.client = client
        self._local = local
        self.ours = {**statement()["must"], "threads": "1"}
        self.sent_bytes = 0
        self.sent_seconds = 0.0
        self.received_bytes = 0
        self.views: Counter[str] = Counter()
        self.view_seconds: list[float] = []
        self.cpu_seconds = 0.0
        self._parcels: dict[str, Parcel] = {}  # of the call that is being answered
        self._is_there = time.monotonic()  # when a worker was seen last

    def each(
        self, scene: Scene, views: Sequence[tuple[Question, Camera, torch.Tensor | None]]
    ) -> Iterator[Information]:
        """What views say, in their order; see `drgs.cluster.views`."""
        return answers(self, scene, views)

    def workers(self) -> dict[str, str]:
        """Address -> name of each worker there is now."""
        found = self.client.scheduler_info(n_workers=-1)["workers"]
        return {address: worker_name(address, one["name"]) for address, one in found.items()}

    def workers_of(self, host: str | None) -> list[str]:
        """Addresses of those that run on a machine."""
        nodes = self.client.run(platform.node, on_error="ignore")
        return [address for address, node in nodes.items() if node == host]

    def check(self) -> None:
        """Ask every worker what it computes with.

        Raises:
            Disagreement: If one differs in what must agree.
        """
        info = self.client.scheduler_info(n_workers=-1)["workers"]
        found = self.client.run(worker_statement(), on_error="return")
        machines = set()
        for address, said in sorted(found.items()):
            name = worker_name(address, info[address]["name"] if address in info else address)
            if isinstance(said, OSError):
                continue  # it has gone
            if isinstance(said, BaseException):
                raise Disagreement(
                    f"cluster: worker {name} must be able to load drgs, cannot: {said}; install it there"
                )
            check_agreement(name, said, self.ours)
            if (threads := info.get(address, {}).get("nthreads", 1)) != 1:
                raise Disagreement(
                    f"cluster: worker {name} must do one task at a time, does {threads}; start it with --nthreads 1"
                )
            machines.add((said["may"].get("processor"), said["may"].get("LLVM")))
        if len(machines) > 1:
            shown = "; ".join(f"{processor}, LLVM {llvm}" for processor, llvm in sorted(machines, key=str))
            _log.warning("cluster: workers are unlike each other (%s): last digits depend on which gets a view", shown)

    def send(self, thing: object) -> str:
        """See to it that all workers have something; the digest under which they know it."""
        parcel = Parcel.of(thing)
        if parcel.digest not in self._parcels:
            self._parcels[parcel.digest] = parcel
            self.send_again([parcel.digest])
        return parcel.digest

    def send_again(self, digests: Sequence[str], workers: list[str] | None = None) -> None:
        """Send what has been sent before, to some workers; None: to all."""
        began = time.perf_counter()
        for digest in digests:
            for piece in self._parcels[digest].pieces():
                # A worker that cannot be reached will say that it misses something, or never say anything again.
                self.client.run(keep, *piece, workers=workers, on_error="ignore")
            self.sent_bytes += len(self._parcels[digest].data) if workers is None else 0
        self.sent_seconds += time.perf_counter() - began

    def forget(self, keeping: Sequence[str] = ()) -> None:
        """Drop the bytes of what was sent, which would be kept for workers that come later."""
        self._parcels = {digest: self._parcels[digest] for digest in keeping if digest in self._parcels}

    def submit(self, function: Callable, *args: Any) -> Future:
        """A task for whichever worker is free."""
        return self.client.submit(function, *args, pure=False)

    def result(self, future: Future, what: str) -> Any:
        """What a task returned, or raised; `what` it is, for messages.

        Raises:
            ConnectionError: If the scheduler or all workers have gone, or workers die of it.
        """
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        while not done.wait(_LOOK):
            self.check_alive()
        return self.finished(future, what)

    def finished(self, future: Future, what: str) -> Any:
        """`result` of a task that is done."""
        from concurrent.futures import CancelledError

        from distributed.scheduler import KilledWorker

        try:
            return future.result()
        except CancelledError:
            raise ConnectionError(f"cluster: the scheduler must stay until {what} is done, it has gone") from None
        except KilledWorker as error:
            raise ConnectionError(
                f"cluster: workers must survive {what}, {error.allowed_failures + 1} of them died of it; look at their "
                "logs, they may need more memory"
            ) from None

    def check_alive(self) -> None:
        """Find out whether there is still somebody who works.

        Raises:
            ConnectionError: If the scheduler has gone, or there have been no workers for `WORKER_SECONDS`.
        """
        now = time.monotonic()
        if self.client.status != "running":
            raise ConnectionError("cluster: the scheduler must stay until all is done, it has gone; start it again")
        if self.client.scheduler_info(n_workers=-1)["workers"]:
            self._is_there = now
        elif now - self._is_there > WORKER_SECONDS:
            raise ConnectionError(
                f"cluster: there must be a worker, there was none for {WORKER_SECONDS:.0f} s; start some, then do it "
                "again"
            )

    def close(self) -> None:
        """Leave the cluster; workers of this machine end at once, whatever they do."""
        self.forget()
        if self._local is not None:
            from distributed.core import Status

            for nanny in list(self._local.workers.values()):
                pid = nanny.pid
                nanny.status = Status.closing_gracefully  # else it would start another one
                if pid:
                    with contextlib.suppress(OSError):
                        os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(Exception):
            self.client.close(timeout=2)
        if self._local is not None:
            with contextlib.suppress(Exception):
                self._local.close(timeout=5)
