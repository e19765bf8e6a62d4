"""The launcher against a fake cell: real processes, real DDS, and every way in which a run can end."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tactile_bringup.shared_memory import orphans

pytest.importorskip("rclpy", reason="needs ROS 2")
pytestmark = pytest.mark.ros

FAKES = Path(__file__).parent / "fakes"


class Launch:
    """`launch_fake.py` as a process of its own, with its output in a file; watched while it runs."""

    def __init__(self, folder: Path, fault: str = "", seconds: float = 0.3, paths: int = 1) -> None:
        self.folder = folder
        self.output_file = folder / "output"
        self.segments: set[tuple[str, int]] = set()
        script = str(FAKES / "launch_fake.py")
        paths_given = os.pathsep.join(filter(None, [str(FAKES), os.environ.get("PYTHONPATH")]))
        self.process = subprocess.Popen(
            [sys.executable, script, str(folder), fault, str(seconds), str(paths)],
            env={**os.environ, "PYTHONPATH": paths_given},
            stdout=self.output_file.open("w"),
            stderr=subprocess.STDOUT,
        )

    @property
    def output(self) -> str:
        return self.output_file.read_text()

    def wait_for(self, text: str, timeout_s: float = 15.0) -> None:
        deadline = time.monotonic() + timeout_s
        while text not in self.output:
            assert time.monotonic() < deadline, f"no '{text}' in:\n{self.output}"
            assert self.process.poll() is None, f"ended without '{text}':\n{self.output}"
            self.note_segments()
            time.sleep(0.05)

    def end(self, timeout_s: float = 20.0) -> int:
        deadline = time.monotonic() + timeout_s
        while self.process.poll() is None:
            assert time.monotonic() < deadline, f"does not end:\n{self.output}"
            self.note_segments()
            time.sleep(0.05)
        return self.process.returncode

    def running(self) -> list[int]:
        """Processes of this launch, told by their command line."""
        return [pid for pid in map(int, filter(str.isdigit, os.listdir("/proc"))) if self._is_ours(pid)]

    def note_segments(self) -> None:
        """Remember name and inode of the shared memory that our processes have mapped."""
        for pid in self.running():
            try:
                lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
            except OSError:
                continue
            fields = [line.split(None, 5) for line in lines if "/dev/shm/fastdds" in line]
            self.segments |= {(f[5], int(f[4])) for f in fields}

    def left(self) -> list[str]:
        """Processes and shared memory of this launch that are still there."""
        processes = [f"process {pid}" for pid in self.running()]
        dead = set(map(str, orphans()))  # another launch may have taken over a port file meanwhile
        return processes + [name for name, inode in self.segments if _inode(name) == inode and name in dead]

    def leaves_nothing(self, timeout_s: float = 8.0) -> bool:
        assert self.segments or "ROS domain" not in self.output, "no shared memory was seen to be in use"
        deadline = time.monotonic() + timeout_s
        while self.left() and time.monotonic() < deadline:
            time.sleep(0.1)
        return self.left() == []

    def _is_ours(self, pid: int) -> bool:
        try:
            return str(self.folder).encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            return False


def _inode(name: str) -> int | None:
    try:
        return os.stat(name).st_ino
    except FileNotFoundError:
        return None


@pytest.fixture
def start(tmp_path):
    launches = []

    def start(**options) -> Launch:
        launches.append(Launch(tmp_path, **options))
        return launches[-1]

    yield start
    for launch in launches:
        if launch.process.poll() is None:
            launch.process.kill()
            launch.process.wait()


def test_a_task_that_is_done_ends_with_0_and_leaves_nothing(start):
    launch = start(paths=2)
    assert launch.end() == 0, launch.output
    assert "[2/2] path_1: done (50 mm" in launch.output
    assert re.search(r"ROS domain \d+ \((chosen|as set)\), discovery LOCALHOST", launch.output)
    assert "OUTCOME 0 True []" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_a_task_that_fails_ends_with_1_and_its_reason(start):
    launch = start(fault="fail", paths=2)
    assert launch.end() == 1
    assert "path path_0: lost the contact at 12 mm" in launch.output
    assert "path_1" not in launch.output  # what comes after a failed path is not run


def test_a_node_that_cannot_start_is_named_with_its_log(start):
    launch = start(fault="configure")
    assert launch.end() == 3
    assert "node /arm/cell ended with exit code 1" in launch.output
    assert f"log: {launch.folder}/logs/arm.cell.log" in launch.output
    assert "the model file is missing: /no/such/model.onnx" in launch.output


def test_a_node_that_dies_in_mid_run_ends_the_run_with_its_name_and_last_words(start):
    launch = start(fault="die", seconds=30)
    assert launch.end() == 3
    assert "node /arm/cell ended with exit code 7" in launch.output
    assert "FATAL: the gel is torn" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_nodes_that_do_not_become_active_are_named(start):
    launch = start(fault="never_active")
    assert launch.end() == 4
    assert "not active after 3 s: /arm/cell (not there yet)" in launch.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_brings_the_arm_to_rest_first(start, number):
    launch = start(seconds=30)
    launch.wait_for("arm  follow")
    launch.process.send_signal(number)
    assert launch.end() == 128 + number
    assert f"stopped by {number.name}: bringing the arm to rest" in launch.output
    assert f"OUTCOME {128 + number} True []" in launch.output
    assert "cancel requested" in (launch.folder / "logs" / "arm.cell.log").read_text()
    assert launch.leaves_nothing(), launch.left()


def test_a_signal_during_the_start_ends_it(start):
    launch = start(fault="never_active")
    launch.wait_for("ROS domain")
    launch.process.send_signal(signal.SIGINT)
    assert launch.end() == 130
    assert launch.running() == []


def test_a_node_that_ignores_signals_is_killed_and_said_so(start):
    launch = start(fault="deaf")
    assert launch.end() == 0, launch.output
    assert "/arm/cell took SIGKILL to end" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_a_killed_launcher_leaves_no_node_and_no_shared_memory(start):
    launch = start(seconds=30)
    launch.wait_for("arm  follow")
    launch.process.kill()
    assert launch.end() == -signal.SIGKILL
    assert launch.leaves_nothing(), launch.left()
