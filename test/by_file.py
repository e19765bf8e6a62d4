"""Tests by file to the processes of pytest-xdist, so that one that dies costs its test and nothing more."""

from contextlib import suppress

from xdist.scheduler import LoadFileScheduling
from xdist.workermanage import WorkerController


class ByFile(LoadFileScheduling):
    """`--dist loadfile`, which may wait forever once a process has died (pytest-xdist 3.8, its issue 1378).

    There the test that it died of runs again, in the next process and the one after that; what the dead
    process had done is handed out once more, as files without a test, which nobody ever reports as done; and
    a process that got a single test waits for a second one before it starts.
    """

    def remove_node(self, node: WorkerController) -> str | None:
        """Hand to others what a process has not done, but for the test that it died of."""
        files = self.assigned_work.pop(node)
        left = {file: tests for file, tests in files.items() if not all(tests.values())}
        if not left:
            return None
        tests = next(iter(left.values()))
        died_of = next(test for test, done in tests.items() if not done)
        tests[died_of] = True
        self.workqueue.update((file, tests) for file, tests in left.items() if not all(tests.values()))
        for other in self.assigned_work:
            self._reschedule(other)
        return died_of

    def _reschedule(self, node: WorkerController) -> None:
        """Give a process more than the two tests without which it would wait; end it where there are none.

        One that has just died cannot be given any; that it has died is told next, and `remove_node` hands to
        others what it was given here.
        """
        with suppress(OSError):
            while not node.shutting_down and self._pending_of(self.assigned_work[node]) <= 2:
                super()._reschedule(node)
