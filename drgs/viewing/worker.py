"""The one thread that computes: jobs in steps, so that what is wanted now goes before what can wait.

Rendering uses all cores, so that two renderings at once end no sooner than one after the other. A job is a generator;
between two of its steps another one may come first, or it may no longer be wanted.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterator


class Worker:
    """A thread that runs jobs, a step of each in turn; those that can wait only where no other is left.

    Args:
        failed: Function that is called with a job's key and what it raised, which has ended it.
    """

    def __init__(self, failed: Callable[[Hashable, Exception], None]) -> None:
        self._failed = failed
        self._jobs: dict[Hashable, Iterator[None]] = {}
        self._waiting: dict[Hashable, Iterator[None]] = {}
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="drgs view", daemon=True)
        self._thread.start()

    def put(self, key: Hashable, steps: Iterator[None], can_wait: bool = False) -> None:
        """Have a job done; what was to be done under the same key is not wanted any more."""
        with self._changed:
            self._jobs.pop(key, None)
            self._waiting.pop(key, None)
            (self._waiting if can_wait else self._jobs)[key] = steps
            self._changed.notify_all()

    def drop(self, key: Hashable) -> None:
        """Leave a job, after the step that it is at."""
        with self._changed:
            self._jobs.pop(key, None)
            self._waiting.pop(key, None)
            self._changed.notify_all()

    def has(self, key: Hashable) -> bool:
        """Whether there is something left to do under a key."""
        with self._changed:
            return key in self._jobs or key in self._waiting

    def close(self, seconds: float) -> bool:
        """Leave everything; whether the step that it was at has ended within so many seconds."""
        with self._changed:
            self._is_closed = True
            self._jobs.clear()
            self._waiting.clear()
            self._changed.notify_all()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self) -> None:
        """The thread: one step of the first job, which then stands last."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._jobs or self._waiting)
                if self._is_closed:
                    return
                queue = self._jobs or self._waiting
                key = next(iter(queue))
                steps = queue.pop(key)
                queue[key] = steps
            ended, error = False, None
            try:
                next(steps)
            except StopIteration:
                ended = True
            except Exception as raised:  # noqa: BLE001 (the thread serves all browsers, whatever one job meets)
                ended, error = True, raised
            with self._changed:
                if ended and queue.get(key) is steps:
                    del queue[key]
            if error is not None:
                self._failed(key, error)
            del key, steps, error  # while nothing is to be done, nothing of what was done is kept
