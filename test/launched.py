"""A launch as a process of its own, watched while it runs: what it says, how it ends, what it leaves."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tactile_bringup.launching.shared_memory import orphans
from tactile_records.runs.from_bag import read_arms
from tactile_records.runs.record import RunRecord

FIRST_DOMAIN_PORT = 7400  # of RTPS: the ports of domain 0
PATIENCE = 120.0  # s; a wait ends as soon as it can: only a test that fails waits as long, on any machine
NOTED = 0.3  # s between looks at the shared memory that is in use


class Launched:
    """Its output goes to a file in its folder, by whose name its processes are told."""

    def __init__(self, folder: Path, command: list[str], **variables: str) -> None:
        self.folder = folder
        self.output_file = folder / "output"
        self.segments: set[tuple[str, int]] = set()
        self.process = subprocess.Popen(
            command,
            env={**os.environ, **variables},
            stdin=subprocess.DEVNULL,  # no keys of whoever runs the tests
            stdout=self.output_file.open("w"),
            stderr=subprocess.STDOUT,
        )

    @property
    def output(self) -> str:
        return self.output_file.read_text()

    def wait_for(self, text: str) -> None:
        self._wait(lambda: text in self.output or self.process.poll() is not None, f"no '{text}'")
        assert text in self.output, f"ended without '{text}':\n{self.output}"

    def end(self) -> int:
        self._wait(lambda: self.process.poll() is not None, "does not end")
        return self.process.returncode

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def running(self) -> dict[int, list[str]]:
        """Processes of this launch and their command lines."""
        lines = {int(pid): _command(pid) for pid in filter(str.isdigit, os.listdir("/proc"))}
        return {pid: words for pid, words in lines.items() if str(self.folder) in " ".join(words)}

    def left(self) -> list[str]:
        """Processes and shared memory of this launch that are still there."""
        processes = [f"process {pid}" for pid in self.running()]
        dead = set(map(str, orphans()))  # another launch may have taken over a port file meanwhile
        return processes + [name for name, inode in self.segments if _inode(name) == inode and name in dead]

    def leaves_nothing(self) -> bool:
        """Whether all of it goes; what a keeper ends takes a while."""
        assert self.segments or "ROS domain" not in self.output, "no shared memory was seen to be in use"
        deadline = time.monotonic() + 0.25 * PATIENCE
        while self.left() and time.monotonic() < deadline:
            time.sleep(0.1)
        return self.left() == []

    def _wait(self, condition: Callable[[], bool], complaint: str) -> None:
        due = time.monotonic()
        deadline = due + PATIENCE
        while not condition():
            now = time.monotonic()
            assert now < deadline, f"{complaint}:\n{self.output}"
            if now >= due:  # which takes as long as a wait
                self._note_segments()
                due = now + NOTED
            time.sleep(0.05)

    def _note_segments(self) -> None:
        """Remember name and inode of the shared memory that our processes have mapped."""
        for pid in self.running():
            try:
                lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
            except OSError:
                continue
            fields = [line.split(None, 5) for line in lines if "/dev/shm/fastdds" in line]
            self.segments |= {(f[5], int(f[4])) for f in fields if not _of_all_domains(f[5])}


def launch_to_end(
    folder: Path, task: str, configuration: Path, wanted: str
) -> tuple[Launched, dict[str, RunRecord]]:
    """A task launched with a configuration folder, once `wanted` was heard: its launch and record."""
    command = [sys.executable, "-m", "tactile_bringup.cli", "launch", task, "--headless"]
    launch = Launched(
        folder,
        [*command, "--out", str(folder), "--record", str(folder / "bag")],
        TACTILE_CONFIG_DIR=str(configuration),
    )
    try:
        launch.wait_for(wanted)
        launch.end()
    finally:
        launch.kill()
    return launch, read_arms(folder / "bag")


def _command(pid: str) -> list[str]:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:  # it ended
        return []


def _inode(name: str) -> int | None:
    try:
        return os.stat(name).st_ino
    except FileNotFoundError:
        return None


def _of_all_domains(name: str) -> bool:
    """Whether it is a port that the processes of every domain share, tests beside this one, too."""
    port = name.partition("_port")[2].removesuffix("_el").removesuffix("_sl")
    return port.isdigit() and int(port) < FIRST_DOMAIN_PORT
