"""What a process may take of the machine (`ulimit`), what others leave of it, and what our processes need.

Python, its libraries and Fast DDS end in the middle of something where a limit is reached: by SIGABRT,
SIGSEGV, or with a traceback out of an import. `bench/process_needs.py` measures what is needed.
"""

from __future__ import annotations

import os
import resource
from dataclasses import dataclass
from pathlib import Path

MIB = 1 << 20
KIB = 1 << 10
# of address space, for the buffers of OpenBLAS (41 MB measured for each of its threads, one a core)
CORE = 40 * MIB
OVERLOAD = 0.95  # part of all cores' time that is in use, from which on latencies suffer


class LimitError(RuntimeError):
    """A limit of this process that is too low, with what to type."""


@dataclass(frozen=True)
class Needs:
    """The least limits with which something runs.

    Attributes
    ----------
    files : int
        Files that one process has open at once.
    address_space : int
        Bytes of one process, without those for each core.
    """

    files: int
    address_space: int


COMMAND = Needs(files=20, address_space=720 * MIB)  # measured: 6 files, 718 MB with two cores
GRAPH = Needs(files=64, address_space=2200 * MIB)  # measured: 27 files, 2.07 GB with two cores


def address_space(needs: Needs) -> int:
    """What they come to on this machine, in bytes."""
    return needs.address_space + CORE * (os.cpu_count() or 1)


def core_times(counters: Path = Path("/proc/stat")) -> tuple[float, float]:
    """Time in which the cores did nothing, and all of it, since the machine started; zeros: not told."""
    try:
        user, nice, system, idle, waiting, *others = map(float, counters.read_text().split(None, 9)[1:9])
    except (OSError, ValueError):
        return 0.0, 0.0
    return idle + waiting, user + nice + system + idle + waiting + sum(others)


_STARTED = core_times()  # before anything else was


def overload() -> str:
    """What to do about a machine that had no time left since this process began; empty for others."""
    idle, total = (now - then for now, then in zip(core_times(), _STARTED, strict=True))
    if total <= 0.0 or (used := 1.0 - idle / total) < OVERLOAD:
        return ""
    return (
        f"the machine is overloaded: its cores were in use for {used:.0%} of the time; end what else runs "
        "(`top`), or give the nodes a real-time priority (--priority 20)"
    )


def require(needs: Needs, what: str) -> None:
    """Raise `LimitError` where this process, and so those that it starts, may not have what `what` needs."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if files != resource.RLIM_INFINITY and files < needs.files:
        raise LimitError(
            f"no process may have more than {files} files open, {what} needs {needs.files}: "
            "type `ulimit -n 1024` before"
        )
    space = resource.getrlimit(resource.RLIMIT_AS)[0]
    needed = address_space(needs)
    if space != resource.RLIM_INFINITY and space < needed:
        raise LimitError(
            f"no process may have more than {space // KIB} KiB of address space, {what} needs "
            f"{needed // KIB}: type `ulimit -v unlimited` before"
        )
