"""The page in the browser as a process beside a launch, or beside a run without ROS."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from tactile_base.end_signals import LAUNCHER

HOST = "127.0.0.1"
ENDS = 5.0  # s, until it is killed


def free_port(host: str) -> int:
    """A port of this address that nobody listens at."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


class ServedPage(NamedTuple):
    """Where a page is served, and by whom."""

    address: str
    process: subprocess.Popen[bytes]


@contextlib.contextmanager
def served_page(variables: Mapping[str, str], log: Path, *bag: Path) -> Iterator[ServedPage]:
    """`tactile view` of a recording, or else of the ROS domain of these variables; it is ended in the end."""
    port = free_port(HOST)
    command = [sys.executable, "-m", "tactile_bringup.cli", "view", *map(str, bag), "--port", str(port)]
    with log.open("w") as file:
        process = subprocess.Popen(
            command, env={**variables, LAUNCHER: str(os.getpid())}, stdin=subprocess.DEVNULL, stdout=file,
            stderr=file, start_new_session=True,
        )  # fmt: skip
    try:
        yield ServedPage(f"http://{HOST}:{port}", process)
    finally:
        process.terminate()
        try:
            process.wait(ENDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
