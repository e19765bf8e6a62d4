"""Ends the process groups of a launcher that was killed, then removes their shared memory.

Runs beside the launcher (`processes.ProcessGroup` starts it; its argument says when: epoch, ns) and reads
`watch PID` and `release PID` lines from it. When the pipe ends, groups that were not released have lost their
launcher: they had the kernel's SIGTERM when it died, get `GRACE_S` to bring the arm to rest and end in order,
and then SIGKILL.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time

from tactile_bringup.launching import shared_memory

GRACE_S = 7.0  # longer than nodes take to end (`ManagedNode.patience`)
REAP_S = 2.0  # how long a killed process may take to vanish; where nobody reaps it, it never does


def main() -> None:
    """Read lines until the launcher ends, then end what it left."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    started_ns = int(sys.argv[1])  # not when this process came to run: the launcher's memory may be older
    groups: set[int] = set()
    for line in sys.stdin:
        verb, pid = line.split()
        (groups.add if verb == "watch" else groups.discard)(int(pid))
    if groups:
        end(groups)
        shared_memory.remove_orphans(started_ns)


def end(groups: set[int], grace_s: float = GRACE_S) -> None:
    """Signal SIGTERM, wait for up to `grace_s`, then SIGKILL."""
    for number, wait_s in ((signal.SIGTERM, grace_s), (signal.SIGKILL, REAP_S)):
        for group in groups:
            signal_group(group, number)
        deadline = time.monotonic() + wait_s
        while time.monotonic() < deadline and any(map(_lives, groups)):
            time.sleep(0.02)


def signal_group(group: int, number: int) -> None:
    """Send a signal to a process group, unless it has ended by itself."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, number)


def _lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


if __name__ == "__main__":
    main()
