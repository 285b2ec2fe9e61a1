"""What single views tell, computed by workers: the scene goes to each of them once, views come back one by one.

A few views for each worker are on their way at any time, so that this process holds no more answers than without
workers. They are taken in their order, rounded to float32 as they are without workers, and added up here: it does not
matter who has computed which. A view whose worker has gone is given to another one by Dask; one that has not got the
scene, because it has started since, says so, is sent it, and the view is asked for again.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.cluster.agreement import check_agreement, statement, this_worker
from drgs.cluster.payloads import Missing, Parcel, opened_parcel

if TYPE_CHECKING:
    from distributed import Future

    from drgs.cameras import Camera
    from drgs.cluster.connect import Cluster
    from drgs.ellipsoids import Scene
    from drgs.gain import Information
    from drgs.information.pool import Question

__all__ = ["answers", "ask"]

_AHEAD = 2  # views on their way for each worker: one that it computes, and the next one
_TRIES = 20  # how often a worker may say that it misses something


def answers(
    cluster: Cluster, scene: Scene, views: Sequence[tuple[Question, Camera, torch.Tensor | None]]
) -> Iterator[Information]:
    """What views of a scene say, in their order; see `Cluster.each`.

    Raises:
        ValueError: As the question does, or if something cannot be pickled, or a worker disagrees.
        ConnectionError: If the scheduler, or all workers, have gone.
    """
    if not views:
        return
    questions: list[Question] = []
    for question, _, _ in views:
        if not any(question is other for other in questions):
            questions.append(question)
    parcels = [cluster.send(scene), cluster.send(questions)]
    cluster.forget(parcels)
    pending: dict[int, Future] = {}

    def begin(i: int) -> Future:
        question, camera, mask = views[i]
        number = next(k for k, other in enumerate(questions) if other is question)
        return cluster.submit(ask, cluster.ours, *parcels, number, Parcel.of((camera, mask)).data)

    try:
        ahead = max(1, len(cluster.workers())) * _AHEAD
        for i in range(len(views)):
            for j in range(i, min(i + ahead, len(views))):
                if j not in pending:
                    pending[j] = begin(j)
            what = f"view {views[i][1].name or i}"
            for _ in range(_TRIES):
                said = cluster.result(pending.pop(i), what)
                if "missing" not in said:
                    break
                cluster.send_again(parcels, [said["address"]])
                pending[i] = begin(i)
            else:
                raise ConnectionError(
                    f"cluster: worker {said['worker']} must keep what it is sent, does not; restart it"
                )
            cluster.views[said["worker"]] += 1
            cluster.view_seconds.append(said["seconds"])
            cluster.cpu_seconds += said["cpu_seconds"]
            cluster.received_bytes += sum(getattr(x, "nbytes", 8) for x in said["answer"].values())
            yield _tensors(said["answer"])
    finally:
        if pending:
            cluster.client.cancel(list(pending.values()))


def _tensors(answer: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Arrays of a message, which is read-only, as tensors of their own."""
    return {name: torch.from_numpy(np.array(x)) for name, x in answer.items()}


# --------------------------------------------------------------------------------------------------- on the worker


def ask(ours: Mapping[str, str], scene: str, questions: str, number: int, view: bytes) -> dict[str, Any]:
    """Runs on a worker: what one view says.

    Args:
        ours: What the worker must agree with.
        scene, questions: Digests of parcels.
        number: Of the question.
        view: Camera and mask, pickled.
    Returns:
        `answer`, arrays by name, `seconds` and the process's `cpu_seconds`; or what is `missing`; always `worker`, its
        `address` and its `host`.
    """
    said: dict[str, Any] = {**this_worker()}
    check_agreement(said["worker"], statement(), ours)
    began, cpu = time.perf_counter(), time.process_time()
    try:
        seen, asked = opened_parcel(scene), opened_parcel(questions)
    except Missing as missing:
        return said | {"missing": str(missing)}
    camera, mask = pickle.loads(view)
    found = asked[number](seen, camera, mask)
    answer = {name: x.detach().cpu().numpy() for name, x in found.items()}
    seconds = time.perf_counter() - began
    return said | {"answer": answer, "seconds": seconds, "cpu_seconds": time.process_time() - cpu}
