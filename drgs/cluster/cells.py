"""Cells of a study, each on the next worker that is free: fitted in the run folders that all of them share.

A cell whose worker dies is done again by another one, which goes on from the last checkpoint. The lock of a process
that was killed is taken over on the machine where it ran; another machine cannot know whether it still runs, so there
such a cell is left to a worker of that machine, or counts as taken.
"""

from __future__ import annotations

import contextlib
import dataclasses
import queue
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.cluster.agreement import check_agreement, statement, this_worker
from drgs.cluster.payloads import Missing, opened_payload
from drgs.io.atomic import is_full
from drgs.io.locks import InUse, host_of
from drgs.io.outputs import write_whole
from drgs.studies.cells import FAILURES, Study, out_of_race, result_line, run_cell
from drgs.studies.rows import Cell, append_row, is_done, read_study

if TYPE_CHECKING:
    from distributed import Future

    from drgs.cluster.workers import Cluster

__all__ = ["do_cell", "run_cells_on"]

_TOPIC = "drgs-cells-"
_POLL_SECONDS = 2.0  # seconds between two polls of the scheduler while nothing comes; chosen
_END_SECONDS = 10.0  # seconds within which a killed process must be gone; chosen
# seconds within which a new file must appear through a shared file system; NFS caches attributes for a few. Chosen
_SHARED_SECONDS = 10.0
# times that a cell is handed out again because its worker had not got the study, or could not take it; chosen
_MAX_TRIES = 20


def run_cells_on(
    cluster: Cluster,
    study: Study,
    cells: Sequence[Cell],
    runs: Path,
    rows: Path,
    say: Callable[[str], object] = print,
) -> tuple[list[Cell], dict[Cell, str]]:
    """Work through cells on a cluster, one at a time on each worker; rows are appended here, as they come.

    A fit that fails is logged and left for the next call; the others go on. On Ctrl-C, workers of this machine end;
    those of a cluster that was joined finish the cell that they have, and its row is found by the next call. All cells
    are handed out at once: who has left a race (`drgs.studies.statistics`) is computed when the call begins.

    Args:
        cluster: The workers.
        study: What to do. Workers call its `folder`: its data sets must lie under the same paths for all of them.
        cells: Cells of the study, in the order in which they are begun.
        runs: Folder of all runs, which all workers must see under this path.
        rows: The JSON-lines file, of this machine alone; cells that it has are skipped.
        say: Takes a line whenever a cell begins or ends.
    Returns:
        Cells that other processes have, and those that failed, with the reason.
    Raises:
        OSError: If there is no room left on the disk of a worker.
        ValueError: If a worker does not see the folder of the runs, or computes with something else than this process.
        ConnectionError: If the scheduler, or all workers, have gone.
    """
    runs = runs.resolve()
    runs.mkdir(parents=True, exist_ok=True)
    there = read_study(rows)
    out = {protocol: out_of_race(study, there, protocol) for protocol in {cell.protocol for cell in cells}}
    for sentence in (x for found in out.values() for x in found.values()):
        say(sentence)
    open_cells = [
        (number, cell)
        for number, cell in enumerate(cells, 1)
        if cell.policy not in out[cell.protocol] and not is_done(study.name, cell, there, study.measured_later)
    ]
    if not open_cells:
        return [], {}
    with _token(runs) as token:
        _check_shared(cluster, token)
        return _Round(cluster, study, open_cells, len(cells), runs, rows, token, say).all()


@contextlib.contextmanager
def _token(runs: Path) -> Any:
    """A small file in the folder of all runs, for the length of a block."""
    path = runs / f".drgs.cluster.{uuid.uuid4().hex}"
    write_whole(path, path.name.encode())
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def _check_shared(cluster: Cluster, token: Path) -> None:
    """Refuse workers that do not see a file."""
    names = cluster.workers()
    for address, found in cluster.client.run(sees, str(token), on_error="return").items():
        if found is not True and not isinstance(found, OSError):
            raise ValueError(_not_shared(names.get(address, address), token.parent))


def _not_shared(worker: str, folder: Path) -> str:
    return (
        f"cluster: worker {worker} must see the folder of the runs, {folder}, as this machine does, does not; put it "
        "on a file system that all share"
    )


@dataclasses.dataclass(eq=False)
class _Round:
    """Cells that are being computed, and their results.

    Attributes:
        cells: Cells with their numbers, of `count` in all.
        begun: Number of a cell -> name and address of who has begun it.
        moved: Number of a cell -> how often it was handed to the machine that has its lock.
    """

    cluster: Cluster
    study: Study
    cells: Sequence[tuple[int, Cell]]
    count: int
    runs: Path
    rows: Path
    token: Path
    say: Callable[[str], object]
    topic: str = dataclasses.field(default_factory=lambda: _TOPIC + uuid.uuid4().hex)
    news: queue.Queue = dataclasses.field(default_factory=queue.Queue)
    begun: dict[int, tuple[str, str]] = dataclasses.field(default_factory=dict)
    pending: dict[int, Future] = dataclasses.field(default_factory=dict)
    tries: Counter[int] = dataclasses.field(default_factory=Counter)
    moved: Counter[int] = dataclasses.field(default_factory=Counter)
    taken: list[Cell] = dataclasses.field(default_factory=list)
    failed: dict[Cell, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self.payload = self.cluster.send(self.study)

    def all(self) -> tuple[list[Cell], dict[Cell, str]]:
        """Hand out the cells and wait until every one is done, taken or failed."""
        named = dict(self.cells)
        client = self.cluster.client
        client.subscribe_topic(self.topic, lambda event: self.news.put(("begun", event[1])))
        try:
            for number, cell in self.cells:
                self.hand_out(number, cell)
            while self.pending:
                try:
                    kind, what = self.news.get(timeout=_POLL_SECONDS)
                except queue.Empty:
                    self.cluster.check_alive()
                    continue
                if kind == "begun":
                    self.report_start(what["number"], named[what["number"]], what["worker"], what["address"])
                else:
                    self.take_in(what, named[what])
        finally:
            client.unsubscribe_topic(self.topic)
            if self.pending:
                client.cancel(list(self.pending.values()))
            self.cluster.forget()
        return self.taken, self.failed

    def hand_out(self, number: int, cell: Cell, workers: list[str] | None = None) -> None:
        """Hand a cell to the next worker that is free; preferably to one of `workers`, if they are named."""
        where = {"workers": workers, "allow_other_workers": True} if workers else {}
        arguments = (self.cluster.ours, self.payload, cell, str(self.runs), str(self.token), self.topic, number)
        # An earlier cell first, also where it comes again because its worker has gone.
        future = self.cluster.client.submit(do_cell, *arguments, pure=False, priority=-number, **where)
        self.pending[number] = future
        future.add_done_callback(lambda _: self.news.put(("done", number)))

    def report_start(self, number: int, cell: Cell, worker: str, address: str) -> None:
        """Report that a worker has begun a cell, and whether it took over that of a worker that is gone."""
        before = self.begun.get(number)
        self.begun[number] = (worker, address)
        again = "" if before is None else ", again"
        if before is not None and before[1] not in self.cluster.workers():
            again += f": {before[0]} has gone"
        self.say(f"{number} of {self.count}: {cell.name} on worker {worker}{again}")

    def take_in(self, number: int, cell: Cell) -> None:
        """Handle the end of a cell's task: its row, a reason why there is none, or one to hand it out again."""
        future = self.pending.pop(number)
        try:
            found = self.cluster.finished(future, f"cell {cell.name}")
        except ConnectionError:
            if self.cluster.client.status != "running":
                raise
            self.fail(cell, "its workers died of it")
            return
        if "missing" in found:
            self.tries[number] += 1
            if self.tries[number] > _MAX_TRIES:
                raise ConnectionError(f"cluster: worker {found['worker']} must keep what it is sent, but forgets it")
            self.cluster.send_again([self.payload], [found["address"]])
            self.hand_out(number, cell)
        elif "unseen" in found:
            raise ValueError(_not_shared(found["worker"], self.runs))
        elif "taken" in found:
            # A worker that is far away may have it again, when all that are near are busy, or have gone.
            far = found["host"] != found["taken"]
            if far and self.moved[number] < _MAX_TRIES and (near := self.cluster.workers_of(found["taken"])):
                self.moved[number] += 1
                self.hand_out(number, cell, near)
            else:
                self.say(f"{cell.name}: taken: {found['why']}")
                self.taken.append(cell)
        elif "failed" in found:
            self.fail(cell, found["failed"])
        else:
            append_row(self.rows, found["row"])
            self.say(f"{result_line(self.study, cell, found['row'])}, worker {found['worker']}")

    def fail(self, cell: Cell, why: str) -> None:
        """Report that a cell has failed, and remember it."""
        self.say(f"{cell.name}: failed: {why}")
        self.failed[cell] = why


# --------------------------------------------------------------------------------------------------- on the worker


def sees(token: str) -> bool:
    """Whether this process finds a file; runs on every worker."""
    try:
        return Path(token).read_bytes() == Path(token).name.encode()
    except OSError:
        return False


def do_cell(
    ours: Mapping[str, str], study: str, cell: Cell, runs: str, token: str, topic: str, number: int
) -> dict[str, Any]:
    """Do one cell, on a worker.

    Args:
        ours: What the worker must agree with.
        study: Digest of the payload that holds the study.
        cell: The cell to do.
        runs: Folder of all runs.
        token: A file that must be seen.
        topic: Topic of Dask's events under which the worker says that it has begun.
        number: Number of the cell in that event.
    Returns:
        `row`, or why there is none: `failed`, `taken` (the host that has it), `missing`, `unseen`; always `worker`,
        its `address` and its `host`.
    """
    from distributed import get_worker

    said: dict[str, Any] = {**this_worker()}
    check_agreement(said["worker"], statement(), ours)
    try:
        whole = opened_payload(study)
    except Missing as missing:
        return said | {"missing": str(missing)}
    until = time.monotonic() + _SHARED_SECONDS
    while not sees(token):
        if time.monotonic() > until:
            return said | {"unseen": token}
        time.sleep(0.5)
    get_worker().log_event(topic, {"number": number, "worker": said["worker"], "address": said["address"]})
    until = time.monotonic() + _END_SECONDS
    while True:
        try:
            return said | {"row": run_cell(whole, cell, Path(runs))}
        except InUse as busy:
            # The lock is that of a process that was killed just now and is about to go, or of one that works: wait.
            if time.monotonic() > until:
                return said | {"taken": host_of(Path(runs) / whole.name / cell.name), "why": str(busy)}
            time.sleep(1.0)
        except FAILURES as error:
            if is_full(error):
                raise
            return said | {"failed": str(error)}
