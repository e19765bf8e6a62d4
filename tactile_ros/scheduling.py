"""What keeps a node's process in time: its priority and cores, locked memory, no garbage to search."""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Collection

_CURRENT_AND_FUTURE = 1 | 2  # MCL_CURRENT | MCL_FUTURE of <sys/mman.h>


def set_priority(priority: int) -> str:
    """Run this process under SCHED_FIFO at a priority 1..99 with its memory locked; 0 leaves all as it is.

    Returns what could not be had, and how it can; '' where all was.
    """
    if priority == 0:
        return ""
    missing = []
    try:
        for thread in os.listdir("/proc/self/task"):  # the middleware's, too
            os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority))
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
