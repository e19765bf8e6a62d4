"""The launcher against a fake cell: real processes, real DDS, and every way in which a run can end."""

import os
import re
import signal
import sys
import time
from pathlib import Path

import pytest
from launched import Launched

from tactile_bringup.launching.environment import free_domain_id

pytest.importorskip("rclpy", reason="needs ROS 2")
pytestmark = pytest.mark.ros

FAKES = Path(__file__).parent / "fakes"


class Launch(Launched):
    """`launch_fake.py` with its fake cell."""

    def __init__(
        self, folder: Path, fault: str = "", seconds: float = 0.3, goals: int = 1, **variables: str
    ) -> None:
        command = [
            sys.executable,
            str(FAKES / "launch_fake.py"),
            str(folder),
            fault,
            str(seconds),
            str(goals),
        ]
        given = os.pathsep.join(filter(None, [str(FAKES), os.environ.get("PYTHONPATH")]))
        super().__init__(folder, command, PYTHONPATH=given, **variables)


@pytest.fixture
def start(tmp_path):
    launches = []

    def start(**options) -> Launch:
        folder = tmp_path / f"launch{len(launches)}"
        folder.mkdir()
        launches.append(Launch(folder, **options))
        return launches[-1]

    yield start
    for launch in launches:
        launch.kill()


def test_a_task_that_is_done_ends_with_0_and_leaves_nothing(start):
    launch = start(goals=2)
    assert launch.end() == 0, launch.output
    assert "[2/2] goal_1: done (50 mm" in launch.output
    assert re.search(r"ROS domain \d+ \((chosen|as set)\), discovery LOCALHOST", launch.output)
    assert "OUTCOME 0 True []" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_a_task_that_fails_ends_with_1_and_its_reason(start):
    launch = start(fault="fail", goals=2)
    assert launch.end() == 1
    assert "goal_0: lost the contact at 12 mm" in launch.output
    assert "goal_1" not in launch.output  # what comes after a failed goal is not run


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
    launch.wait_for("arm: follow")
    launch.process.send_signal(number)
    assert launch.end() == 128 + number
    assert f"stopped by {number.name}: bringing the arm to rest" in launch.output
    assert f"OUTCOME {128 + number} True []" in launch.output
    assert "cancel requested" in (launch.folder / "logs" / "arm.cell.log").read_text()
    assert launch.leaves_nothing(), launch.left()


def held_up(launch) -> int:
    """Hold the cell up and ask for the end; its process."""
    launch.wait_for("arm: follow")
    cell = next(pid for pid, words in launch.running().items() if any("fake_cell" in word for word in words))
    os.kill(cell, signal.SIGSTOP)
    launch.process.send_signal(signal.SIGINT)
    launch.wait_for("bringing the arm to rest")
    return cell


def test_an_arm_that_is_held_up_is_waited_for(start):
    launch = start(seconds=30)
    cell = held_up(launch)
    time.sleep(1.3)
    os.kill(cell, signal.SIGCONT)
    assert launch.end() == 130
    assert "OUTCOME 130 True []" in launch.output


def test_of_an_arm_that_was_not_seen_at_rest_the_last_word_is_told(start):
    launch = start(seconds=30)
    cell = held_up(launch)
    launch.wait_for("arm was not seen at rest: it has not reported for ")
    os.kill(cell, signal.SIGCONT)
    assert launch.end() == 130
    assert "OUTCOME 130 False" in launch.output


def test_a_signal_during_the_start_ends_it(start):
    launch = start(fault="never_active")
    launch.wait_for("ROS domain")
    launch.process.send_signal(signal.SIGINT)
    assert launch.end() == 130
    assert not launch.running()


def test_a_launch_waits_for_the_end_of_another_one_in_its_domain(start):
    domain = str(free_domain_id())
    other = start(seconds=30, ROS_DOMAIN_ID=domain)
    other.wait_for("arm: follow")
    launch = start(ROS_DOMAIN_ID=domain)
    launch.wait_for("waiting for another launch to end: /arm/cell")
    assert not (launch.folder / "logs" / "arm.cell.log").exists()
    other.process.kill()
    assert launch.end() == 0, launch.output
    assert f"ROS domain {domain} (as set)" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_a_launch_beside_another_one_that_goes_on_in_its_domain_is_refused(start):
    domain = str(free_domain_id())
    other = start(seconds=60, ROS_DOMAIN_ID=domain)
    other.wait_for("arm: follow")
    launch = start(fault="impatient", ROS_DOMAIN_ID=domain)
    assert launch.end() == 4
    assert "nodes of these names run in this ROS domain already: /arm/cell; end them" in launch.output
    assert not (launch.folder / "logs" / "arm.cell.log").exists()
    assert other.process.poll() is None and "stopp" not in other.output


def test_a_node_that_ignores_signals_is_killed_and_said_so(start):
    launch = start(fault="deaf")
    assert launch.end() == 0, launch.output
    assert "/arm/cell took SIGKILL to end" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_a_killed_launcher_leaves_no_node_and_no_shared_memory(start):
    launch = start(seconds=30)
    launch.wait_for("arm: follow")
    launch.process.kill()
    assert launch.end() == -signal.SIGKILL
    assert launch.leaves_nothing(), launch.left()
