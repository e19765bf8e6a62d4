"""How a process is asked to end: signals as requests that a loop looks at, and its parent's death.

SIGINT is Ctrl-C, SIGTERM comes from service managers and for a parent that has ended, SIGHUP when a terminal
is closed; a process that was started with `nohup` goes on ignoring that one.
"""

from __future__ import annotations

import ctypes
import os
import signal
import time
from types import FrameType
from typing import Any

SAME_REQUEST = 2.0  # s; one Ctrl-C can come from the terminal and, up to a second later, from a launcher
LAUNCHER = "TACTILE_LAUNCHER"  # environment: the process id of a launcher with which its nodes are to end
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)


def signals_into(received: list[int]) -> dict[int, Any]:
    """From now on append the signal of each request to end, in place of dying by it.

    Signals that follow within `SAME_REQUEST` mean the same request.

    Returns
    -------
    dict
        The handlers that stood before, by signal.
    """
    last = -SAME_REQUEST

    def collect(number: int, frame: FrameType | None) -> None:
        nonlocal last
        if time.monotonic() - last >= SAME_REQUEST:
            last = time.monotonic()
            received.append(number)

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    return {number: signal.signal(number, collect) for number in numbers}


def end_with(parent: int) -> None:
    """Have the kernel send this process SIGTERM when its parent ends; end at once if `parent` has ended."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    try:
        os.kill(parent, 0)
    except ProcessLookupError:
        os._exit(1)


def end_with_launcher() -> None:
    """`end_with` the launcher that the environment names, if it names one."""
    launcher = os.environ.get(LAUNCHER)
    if launcher:
        end_with(int(launcher))
