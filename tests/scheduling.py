"""How pytest-xdist hands out files of tests, where one of its processes ends in the middle of a test.

By itself (3.8) it runs such a test again in the process that it starts instead, however often that one ends, too, and
waits for ever for processes that it has sent no test, one alone, or some before they had said what they have collected.
"""

from __future__ import annotations

from xdist.scheduler import LoadFileScheduling

__all__ = ["FilesOnce"]


class FilesOnce(LoadFileScheduling):
    """A file's tests in one process, each test once."""

    def remove_node(self, node):
        """Take back what a process has not run, but for the test in which it ended, if there is one: its name."""
        unfinished = {file: tests for file, tests in self.assigned_work.pop(node).items() if not all(tests.values())}
        if not unfinished:
            return None
        tests = next(iter(unfinished.values()))
        ended = next(name for name, is_done in tests.items() if not is_done)
        tests[ended] = True  # it has failed
        self.workqueue.update({file: tests for file, tests in unfinished.items() if not all(tests.values())})
        self._hand_out()
        return ended

    def schedule(self):
        """Hand out files: at the start, and when a process that has come in place of another one has collected."""
        if self.collection is None:
            super().schedule()
        else:
            self._hand_out()

    def _hand_out(self):
        """Give files to all processes that have collected and have next to nothing left, or tell them that it is over.

        Twice: a process begins its only test when it knows which comes next, or that none does.
        """
        for node in 2 * [node for node in self.nodes if node in self.registered_collections]:
            self._reschedule(node)
