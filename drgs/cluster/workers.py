"""Workers behind a scheduler: the check that they agree with this process, the data they get, the results they return.

Quantities of single views are computed by them: the scene goes to each of them once, views come back one by one. A few
views for each worker are on their way at any time, so that this process holds no more results than without workers.
They are taken in their order, rounded to float32 as they are without workers, and added up here: it does not matter
who has computed which. A view whose worker has gone is given to another one by Dask; one that has not got the scene,
because it has started since, says so, is sent it, and the view is computed again.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import platform
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.cluster.agreement import Disagreement, check_agreement, statement, this_worker, worker_name, worker_statement
from drgs.cluster.payloads import Missing, Payload, keep, opened_payload
from drgs.information.quantity import Quantity, ViewContext

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

    from drgs.ellipsoids import Scene
    from drgs.information.sums import Information
    from drgs.selection.pool import ViewRequest
    from drgs.settings import RenderSettings

WORKER_SECONDS = 60.0
"""Time that a cluster may be without any worker."""

_POLL_SECONDS = 2.0  # seconds between two polls of the scheduler while nothing comes; chosen
_SPAWN_SECONDS = 5.0  # seconds within which a process that is being started has a number
_VIEWS_PER_WORKER = 2  # views on their way for each worker: one that it computes, and the next one
_MAX_TRIES = 20  # times that a worker may report missing data; chosen
_log = logging.getLogger(__name__)


class Cluster:
    """Workers behind a scheduler, as `drgs.select` takes them; `opened` makes one.

    Attributes:
        client: Dask's client.
        ours: What every worker must have in common with this process.
        sent_bytes: Bytes that were sent to each worker so far.
        sent_seconds: Time that it took to send them to all workers.
        views: Worker -> how many views it has computed.
        view_seconds: Wall time of each of these views on its worker.
        cpu_seconds: CPU time of all of these views together.
        received_bytes: Size of all results.
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
        self._payloads: dict[str, Payload] = {}  # of the current call
        self._is_there = time.monotonic()  # when a worker was seen last

    def each(self, scene: Scene, settings: RenderSettings, requests: Sequence[ViewRequest]) -> Iterator[Information]:
        """Quantities of views of a scene, in the order of the requests.

        Raises:
            ValueError: As the quantity does, or if something cannot be pickled, or a worker disagrees.
            ConnectionError: If the scheduler, or all workers, have gone.
        """
        if not requests:
            return
        quantities: list[Quantity] = []
        for quantity, _, _ in requests:
            if not any(quantity is other for other in quantities):
                quantities.append(quantity)
        payloads = [self.send(scene), self.send((settings, quantities))]
        self.forget(payloads)
        pending: dict[int, Future] = {}

        def begin(i: int) -> Future:
            quantity, camera, mask = requests[i]
            number = next(k for k, other in enumerate(quantities) if other is quantity)
            return self.submit(compute_view, self.ours, *payloads, number, Payload.of((camera, mask)).data)

        try:
            ahead = max(1, len(self.workers())) * _VIEWS_PER_WORKER
            for i in range(len(requests)):
                for j in range(i, min(i + ahead, len(requests))):
                    if j not in pending:
                        pending[j] = begin(j)
                what = f"view {requests[i][1].name or i}"
                for _ in range(_MAX_TRIES):
                    reply = self.result(pending.pop(i), what)
                    if "missing" not in reply:
                        break
                    self.send_again(payloads, [reply["address"]])
                    pending[i] = begin(i)
                else:
                    raise ConnectionError(
                        f"cluster: worker {reply['worker']} must keep what it is sent, does not; restart it"
                    )
                self.views[reply["worker"]] += 1
                self.view_seconds.append(reply["seconds"])
                self.cpu_seconds += reply["cpu_seconds"]
                self.received_bytes += sum(getattr(x, "nbytes", 8) for x in reply["computed"].values())
                yield _tensors(reply["computed"])
        finally:
            if pending:
                self.client.cancel(list(pending.values()))

    def workers(self) -> dict[str, str]:
        """Address -> name of each worker there is now."""
        found = self.client.scheduler_info(n_workers=-1)["workers"]
        return {address: worker_name(address, one["name"]) for address, one in found.items()}

    def workers_of(self, host: str | None) -> list[str]:
        """Addresses of those that run on a machine."""
        nodes = self.client.run(platform.node, on_error="ignore")
        return [address for address, node in nodes.items() if node == host]

    def check(self) -> None:
        """Compare every worker's statement with this process's.

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
        payload = Payload.of(thing)
        if payload.digest not in self._payloads:
            self._payloads[payload.digest] = payload
            self.send_again([payload.digest])
        return payload.digest

    def send_again(self, digests: Sequence[str], workers: list[str] | None = None) -> None:
        """Send what has been sent before, to some workers; None: to all."""
        began = time.perf_counter()
        for digest in digests:
            for piece in self._payloads[digest].pieces():
                # A worker that cannot be reached will say that it misses something, or never say anything again.
                self.client.run(keep, *piece, workers=workers, on_error="ignore")
            self.sent_bytes += len(self._payloads[digest].data) if workers is None else 0
        self.sent_seconds += time.perf_counter() - began

    def forget(self, keeping: Sequence[str] = ()) -> None:
        """Drop the bytes of what was sent, which would be kept for workers that come later."""
        self._payloads = {digest: self._payloads[digest] for digest in keeping if digest in self._payloads}

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
        while not done.wait(_POLL_SECONDS):
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
        """Raise unless a worker is alive.

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

            nannies = list(self._local.workers.values())
            for nanny in nannies:
                nanny.status = Status.closing_gracefully  # else it would start another one
            until = time.monotonic() + _SPAWN_SECONDS
            for nanny in nannies:
                # One whose worker has died may be starting the next one, which has no number yet.
                while not (pid := nanny.pid) and nanny.status != Status.closed and time.monotonic() < until:
                    time.sleep(0.01)
                if pid:
                    with contextlib.suppress(OSError):
                        os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(Exception):
            self.client.close(timeout=2)
        if self._local is not None:
            with contextlib.suppress(Exception):
                self._local.close(timeout=5)


def _tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Arrays of a message, which is read-only, as tensors of their own."""
    return {name: torch.from_numpy(np.array(x)) for name, x in arrays.items()}


# --------------------------------------------------------------------------------------------------- on the worker


def compute_view(ours: Mapping[str, str], scene: str, quantities: str, number: int, view: bytes) -> dict[str, Any]:
    """Compute a quantity of one view, on a worker.

    Args:
        ours: What the worker must agree with.
        scene: Digest of the payload that holds the scene.
        quantities: Digest of the payload that holds the settings and the list of quantities.
        number: Index of the view's quantity in that list.
        view: Camera and mask, pickled.
    Returns:
        `computed`, arrays by name, `seconds` and the process's `cpu_seconds`; or what is `missing`; always `worker`,
        its `address` and its `host`.
    """
    reply: dict[str, Any] = {**this_worker()}
    check_agreement(reply["worker"], statement(), ours)
    began, cpu = time.perf_counter(), time.process_time()
    try:
        shown, (settings, known) = opened_payload(scene), opened_payload(quantities)
    except Missing as missing:
        return reply | {"missing": str(missing)}
    camera, mask = pickle.loads(view)
    # Numbers; a graph of the worker's process could not travel.
    found = known[number].compute(ViewContext(shown, camera, settings, mask))
    computed = {name: x.detach().cpu().numpy() for name, x in found.items()}
    seconds = time.perf_counter() - began
    return reply | {"computed": computed, "seconds": seconds, "cpu_seconds": time.process_time() - cpu}
