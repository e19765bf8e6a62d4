"""Less priority for what runs beside arms."""

import contextlib
import os
from pathlib import Path

NICENESS = 10


def give_way(process: int = 0) -> None:
    """Let a process (by its number; 0: this one) have less of the processor than the nodes of arms.

    Where the kernel shares time out by session first (autogroup), a nice value counts within its session:
    of a process that leads one, the whole session gives way.
    """
    now = os.getpriority(os.PRIO_PROCESS, process)
    os.setpriority(os.PRIO_PROCESS, process, max(now, NICENESS))
    process = process or os.getpid()
    if os.getsid(process) == process:
        with contextlib.suppress(OSError):  # a kernel that does not share so
            Path(f"/proc/{process}/autogroup").write_text(str(NICENESS))
