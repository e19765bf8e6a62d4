"""What keeps a node's process in time: its priority and cores, locked memory, no garbage to search."""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Collection
from pathlib import Path

_SPINNING = "dds.asyn"  # Fast DDS's threads of this name
_CURRENT_AND_FUTURE = 1 | 2  # MCL_CURRENT | MCL_FUTURE of <sys/mman.h>


def set_priority(priority: int) -> str:
    """Run this process under SCHED_FIFO at a priority 1..99 with its memory locked; 0 leaves all as it is.

    Fast DDS's thread for late samples spins while another of its threads holds the writer it wants
    (ros2/rmw_fastrtps issue 666): at the same priority, on as many cores as nodes that do so, the other would
    never run again. So it comes one below, and at 1 without a priority.

    Returns what could not be had, and how it can; '' where all was.
    """
    if priority == 0:
        return ""
    missing = []
    try:
        for thread in os.listdir("/proc/self/task"):  # the middleware's, too
            spins = Path(f"/proc/self/task/{thread}/comm").read_text().startswith(_SPINNING)
            wanted = priority - spins
            policy = os.SCHED_FIFO if wanted else os.SCHED_OTHER
            os.sched_setscheduler(int(thread), policy, os.sched_param(wanted))
    except PermissionError:
        missing.append(f"SCHED_FIFO {priority} (rtprio in /etc/security/limits.conf allows it)")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_CURRENT_AND_FUTURE) != 0:
        missing.append("locked memory (memlock in /etc/security/limits.conf allows it)")
    return ", ".join(missing)


def set_cores(cores: Collection[int]) -> str:
    """Have this process, and those that it starts, run on these cores alone; none: on any.

    Returns what could not be had; '' where all was.
    """
    if not cores:
        return ""
    try:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), cores)
    except OSError:
        return f"the cores {', '.join(map(str, cores))}"
    return ""


def freeze_gc() -> None:
    """Take everything loaded so far out of the collector's sight: a full collection costs 10 ms."""
    gc.collect()
    gc.freeze()
