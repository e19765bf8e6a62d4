"""What a process may take of the machine (`ulimit`), what others leave of it, and what our processes need.

Python, its libraries and Fast DDS end in the middle of something where a limit is reached: by SIGABRT,
SIGSEGV, or with a traceback out of an import.
"""

from __future__ import annotations

import os
import resource
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

MIB = 1 << 20
KIB = 1 << 10
# of address space, for the buffers of OpenBLAS (41 MB measured for each of its threads, one a core)
CORE = 40 * MIB
OVERLOAD = 0.95  # part of all cores' time that is in use, from which on latencies suffer
OVERLOADED = "the machine is overloaded"  # what is said of it begins so
LATELY, AT_LEAST, LOOK = 6.0, 2.0, 0.5  # s: how long ago, and for how long, it is told; between two looks


class LimitError(RuntimeError):
    """A limit of this process that is too low, with what to type."""


@dataclass(frozen=True)
class Needs:
    """The least limits with which something runs.

    Attributes
    ----------
    files : files that one process has open at once
    address_space : bytes of one process, without those for each core
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


class CoreWatch:
    """Whether the machine has had no time left, for somebody who looks now and then."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float, float]] = deque()  # when (s), and `core_times`
        self.look()

    def look(self) -> None:
        """Note how busy the cores are, at most every `LOOK` (s)."""
        now = time.monotonic()
        if self._seen and now - self._seen[-1][0] < LOOK:
            return
        while self._seen and now - self._seen[0][0] > LATELY:
            self._seen.popleft()
        self._seen.append((now, *core_times()))

    def overload(self) -> str:
        """What to do about a machine that was overloaded for `AT_LEAST` of the last seconds; else empty."""
        self._seen.append((time.monotonic(), *core_times()))
        seen = list(self._seen)
        spans = [
            (1.0 - (end[1] - begin[1]) / (end[2] - begin[2]), end[0] - begin[0])
            for number, begin in enumerate(seen)
            for end in seen[number + 1 :]
            if end[0] - begin[0] >= AT_LEAST and end[2] > begin[2]
        ]
        used, seconds = max(spans, default=(0.0, 0.0))
        if used < OVERLOAD:
            return ""
        return (
            f"{OVERLOADED}: its cores were in use for {used:.0%} of {seconds:.0f} s lately; end what "
            "else runs (`top`), or give the nodes a real-time priority (--priority 20)"
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
