"""What a person says and sees from another terminal, on a graph that follows the ramp."""

import contextlib
import dataclasses
import fcntl
import math
import os
import pty
import signal
import subprocess
import sys
import termios

import pytest
from ramp_cell import CONTROLLER, SIM, Cell
from std_srvs.srv import Trigger

from tactile_msgs.msg import ArmStatus
from tactile_scene.scene_file import load_scene


class Terminal:
    """Runs commands of `tactile` in the ROS domain of a cell."""

    def __init__(self, cell: Cell) -> None:
        self.cell, self.graph = cell, cell.graph

    def __call__(self, *words: str, code: int = 0) -> str:
        """What a command prints, once it has ended with this code."""
        with self.start(*words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
            assert self.graph.wait(lambda: process.poll() is not None), words
            said = process.stdout.read()
        assert process.returncode == code, said
        return said

    def start(self, *words: str, **options) -> subprocess.Popen:
        command = [sys.executable, "-m", "tactile_bringup.cli", *words]
        return subprocess.Popen(command, env=self.graph.variables, **options)

    def following(self):
        """A goal under way for longer than a command takes to be there, the other way than the last one."""
        goal = self.cell.goal
        turned = goal.goal.replaced(direction_deg=(goal.goal.direction_deg + 180.0) % 360.0)
        self.cell.goal = dataclasses.replace(goal, goal=turned)
        return self.cell.following()

    def stopped(self) -> bool:
        status = self.cell.arms[-1]
        return status.mode == ArmStatus.ESTOP and not any(status.twist)


@pytest.fixture(scope="module")
def tactile(shared_graph, tmp_path_factory):
    return Terminal(Cell(shared_graph, tmp_path_factory.mktemp("cell"), length=0.12))


@pytest.fixture(autouse=True)
def rested(tactile):
    """An alarm of a machine that was held up for a moment is no matter of the next test."""
    if tactile.cell.arms and tactile.cell.arms[-1].mode == ArmStatus.FAULT:
        tactile("reset")


def test_a_stop_brings_the_arm_to_rest_fails_the_goal_and_lasts_until_a_reset(tactile):
    handle = tactile.following()
    said = tactile("stop")
    assert "/arm was told to stop" in said and "/arm rests after" in said
    assert tactile.graph.wait(tactile.stopped)
    result = tactile.cell.result(handle)
    assert not result.success and "asked for by `tactile stop`" in result.reason
    said = tactile("status", code=1)
    assert "/arm: estop" in said and "emergency stop: asked for by `tactile stop`" in said
    assert "the arm moves again once" in tactile("reset")
    said = tactile("status")
    assert "/arm: resting" in said
    limits = load_scene("ramp").arms["arm"].limits
    speeds = f"{1e3 * limits.linear_velocity:g} mm/s, {math.degrees(limits.angular_velocity):.3g} deg/s"
    assert f"limits:       {speeds}; {limits.linear_acceleration:g} m/s^2" in said
    assert "workspace:    x " in said and "touch limits: 10 mm deep" in said


def test_one_arm_is_stopped_by_name_and_an_unknown_name_stops_all(tactile):
    tactile("stop", "arm")
    assert tactile.graph.wait(tactile.stopped)
    tactile("reset")
    said = tactile("stop", "arn", "--here", code=1)
    assert "no arm of this host is called /arn; all that were found were told to stop: /arm" in said
    assert tactile.graph.wait(tactile.stopped)
    tactile("reset")
    assert "leave the names out" in tactile("stop", "arm", "--ready", code=2)


def test_a_new_reference_is_asked_of_the_arms_estimator(tactile):
    assert tactile("reference", code=1) == "no arm has an estimator\n"

    def answer(request, response):
        response.success, response.message = True, "the next images become the reference"
        return response

    service = tactile.graph.node.create_service(Trigger, "/arm/estimator/capture_reference", answer)
    try:
        assert tactile("reference", "arm") == "/arm: the next images become the reference\n"
    finally:
        tactile.graph.node.destroy_service(service)


def test_an_arm_that_only_ros_finds_is_stopped_by_the_topic(tactile, tmp_path):
    handle = tactile.following()
    tactile.graph.variables["TACTILE_STOP_FOLDER"] = str(tmp_path)  # where there is no line
    try:
        assert "/arm rests (by /estop" in tactile("stop")
        assert tactile("stop", "--here", code=1) == "tactile stop: no arm was found\n"
    finally:
        del tactile.graph.variables["TACTILE_STOP_FOLDER"]
    assert "asked for on /estop" in tactile.cell.result(handle).reason
    tactile("reset", "arm")


def test_a_stop_that_is_ready_acts_by_a_key_again_and_again(tactile):
    ours, theirs = pty.openpty()

    def take_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    terminal = {"stdin": theirs, "stdout": theirs, "stderr": theirs}
    process = tactile.start("stop", "--ready", **terminal, start_new_session=True, preexec_fn=take_terminal)
    os.close(theirs)
    os.set_blocking(ours, False)
    shown = [""]

    def says(text: str) -> bool:
        with contextlib.suppress(BlockingIOError):
            shown[0] += os.read(ours, 65536).decode()
        return text in shown[0]

    try:
        assert tactile.graph.wait(lambda: says("ready to stop: /arm")), shown
        for _ in range(2):
            handle = tactile.following()
            shown[0] = ""
            os.write(ours, b" ")
            assert tactile.graph.wait(lambda: says("/arm rests after")), shown
            assert tactile.graph.wait(tactile.stopped)
            assert not tactile.cell.result(handle).success
            tactile("reset")
        os.write(ours, b"q")
        assert tactile.graph.wait(lambda: process.poll() is not None) and process.returncode == 0
    finally:
        process.kill()
        process.wait()
        os.close(ours)


def test_a_goal_is_sent_followed_and_done(tactile):
    said = tactile("goal", "{direction_deg: 90, length: 0.01}", "--name", "a little")
    assert "follow" in said and said.endswith(("done (10 mm)\n", "done (11 mm)\n"))  # it brakes at its end
    assert tactile.cell.statuses[-1].goal_name == "a little"


def test_a_goal_that_is_none_is_refused_with_the_reason(tactile):
    assert "goal refused: goal: unknown name 'lenth'" in tactile("goal", "{lenth: 0.01}", code=1)
    assert "has 5000 characters" in tactile("goal", "{}", "--name", "n" * 5000, code=1)
    assert "/arm" not in tactile("goal", "{}", "--arm", "arn", code=1).replace("unknown", "")


def test_a_goal_is_cancelled_from_another_terminal(tactile):
    handle = tactile.following()
    assert "/arm: its goal ends" in tactile("cancel")
    assert "cancelled" in tactile.cell.result(handle).reason
    assert "/arm: no goal runs" in tactile("cancel", "arm")


def test_parameters_are_shown_with_range_and_meaning_and_set(tactile):
    said = tactile("get", "/arm/controller", "task.speed")
    assert said.startswith("task.speed: ") and "m/s" in said
    assert tactile("set", "/arm/controller", "task.speed=0.012").endswith("-> 0.012\n")
    assert tactile.graph.get_parameter("controller", "task.speed") == 0.012
    tactile("set", "/arm/controller", "pid.kp=[0, 0, 3, 2, 2, 0]")  # whole numbers are meant as others
    assert "task.speed = 99" in tactile("set", "/arm/controller", "task.speed=99", code=1)
    assert tactile.graph.get_parameter("controller", "task.speed") == 0.012
    assert "did you mean" in tactile("set", "/arm/controller", "task.sped=0.01", code=1)
    assert "/arm/controller" in tactile("get", "/arm/contoller", code=1)
    listed = (tactile("get") for _ in range(3))  # nodes are found one by one, slowly on a busy machine
    assert any("/arm/filter" in names for names in listed)


def test_a_stop_says_so_where_the_arms_node_stands_still(tactile):
    child = tactile.graph.processes.children[SIM].process
    child.send_signal(signal.SIGSTOP)
    try:
        said = tactile("stop", "--here", code=1)
    finally:
        child.send_signal(signal.SIGCONT)
    assert "1 of 1 arms was not seen at rest: no answer" in said
    assert tactile.graph.wait(tactile.stopped)  # what was called waits for it
    assert CONTROLLER in tactile.graph.processes.children
    tactile("reset")
