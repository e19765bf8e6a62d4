"""The page in the browser as a process beside a launch."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

HOST = "127.0.0.1"
ENDS = 5.0  # s, until it is killed


def free_port(host: str) -> int:
    """A port of this address that nobody listens at."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def served_page(variables: Mapping[str, str], log: Path) -> Iterator[str]:
    """`tactile view` in the ROS domain of these variables; gives its address, and ends it in the end."""
    port = free_port(HOST)
    command = [sys.executable, "-m", "tactile_bringup.cli", "view", "--port", str(port)]
    with log.open("w") as file:
        process = subprocess.Popen(
            command, env=dict(variables), stdin=subprocess.DEVNULL, stdout=file, stderr=file,
            start_new_session=True,
        )  # fmt: skip
    try:
        yield f"http://{HOST}:{port}"
    finally:
        process.terminate()
        try:
            process.wait(ENDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
