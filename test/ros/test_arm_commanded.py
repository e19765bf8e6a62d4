"""The arm node between commanders and drivers that misbehave: one node, configured anew by each test."""

import numpy as np
import pytest
from arm_bench import ALONG, ARM_NODE, SENSOR, SENSOR_TEXT, TOOL, keep_commanding, position, scene_text
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import Transition
from messages import arm_command
from other_package import installed
from std_srvs.srv import Trigger

from tactile_geometry import se3
from tactile_msgs.msg import ArmCommand, ArmStatus, ContactState
from tactile_ros import qos
from tactile_ros.conversions import matrix_from_pose

ERROR = int.from_bytes(DiagnosticStatus.ERROR, "little")


class Bench:
    """The node on a scene of the other package's arm."""

    def __init__(self, graph, folder) -> None:
        graph.import_from(installed(folder))
        self.graph, self._scene, self._said = graph, folder / "bench.yaml", 0

    def __call__(self, **scene: str) -> None:
        """Have it drive the arm of another scene, from its start on."""
        self._scene.write_text(scene_text(**scene))
        if ARM_NODE not in self.graph.processes.children:
            # nobody tells what the sensor feels
            self.graph.start(ARM_NODE, {"scene": self._scene, "feels": False})
            return
        for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
            self.graph.change("arm", transition)
        assert self.graph.wait(lambda: self._listeners() == 0), "it still listens"
        self._said = len(self._log())
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            self.graph.change("arm", transition)
        assert self.graph.wait(lambda: self._listeners() == 1), "it does not listen"
        self.graph.settle()
        self.graph.diagnostics.clear()

    def _listeners(self) -> int:
        return self.graph.node.count_subscribers("command/request")

    def _log(self) -> str:
        return self.graph.log(ARM_NODE).read_text()

    @property
    def told(self) -> str:
        """What node and driver have printed since they have had this scene."""
        return self._log()[self._said :]


@pytest.fixture(scope="module")
def running(shared_graph, tmp_path_factory):
    return Bench(shared_graph, tmp_path_factory.mktemp("bench"))


@pytest.fixture
def bench(running):
    return running


@pytest.fixture
def graph(bench):
    return bench.graph


def test_an_arm_whose_driver_does_not_watch_its_commands_is_stopped_when_they_stop_coming(graph, bench):
    poses = graph.collect(PoseStamped, "arm/pose")
    statuses = graph.collect(ArmStatus, "arm/status")
    bench()
    assert graph.wait(lambda: bool(poses))
    start = matrix_from_pose(poses[-1].pose)

    def moved() -> np.ndarray:
        return se3.inverse(start) @ matrix_from_pose(poses[-1].pose)

    keep_commanding(graph, SENSOR, lambda: moved()[1, 3] > 0.003)
    assert abs(moved()[0, 3]) < 1e-9
    assert graph.wait(lambda: statuses[-1].mode == ArmStatus.RESTING)
    assert "no command for" in statuses[-1].reason and "(limit 0.1 s)" in statuses[-1].reason


def test_an_arm_whose_driver_falls_silent_is_stopped_and_commands_are_refused(graph, bench):
    bench(settings="{states: 300}")  # it has to be commanded before
    keep_commanding(graph, SENSOR, lambda: "stop: no state from the driver for" in bench.told)
    report = graph.wait_for_count("arm", "commands refused")
    assert "no state from the driver" in report.message


@pytest.mark.parametrize("sensor, right, wrong", [(SENSOR_TEXT, SENSOR, TOOL), ("", TOOL, SENSOR)])
def test_commands_are_in_the_controlled_frame_the_tool_of_an_arm_without_a_sensor(
    graph, bench, sensor, right, wrong
):
    bench(sensor=sensor)
    statuses = graph.collect(ArmStatus, "arm/status")
    twists = graph.publisher(ArmCommand, "command/request", qos.COMMAND)
    twists.publish(arm_command(graph.now_ns(), wrong, ALONG))
    assert f"must be '{right}'" in graph.wait_for_count("arm", "commands refused").message
    ask = graph.commands(right)
    for _ in graph.ticks(0.02):
        ask(ALONG)
        if statuses and statuses[-1].mode == ArmStatus.MOVING:
            return
    raise AssertionError("the arm never moved")


def test_a_second_commander_is_refused_and_named_and_the_first_goes_on(graph, bench):
    bench(safety="{owner_timeout: 10.0}")  # longer than a machine may hold us up
    statuses = graph.collect(ArmStatus, "arm/status")
    controller, stray, joystick = (
        graph.publisher(ArmCommand, "command/request", qos.COMMAND) for _ in range(3)
    )
    controller.publish(arm_command(graph.now_ns(), SENSOR, np.zeros(6), "/arm/controller"))
    assert graph.wait(lambda: bool(statuses) and bool(statuses[-1].owner))
    for _ in graph.ticks(0.02):
        controller.publish(arm_command(graph.now_ns(), SENSOR, ALONG, "/arm/controller"))
        stray.publish(arm_command(graph.now_ns() + 95_000_000, SENSOR, -ALONG, "/stray"))
        joystick.publish(arm_command(graph.now_ns(), SENSOR, -ALONG, "/joystick"))
        if statuses and statuses[-1].twist[1] > 0.019:
            break
    assert statuses[-1].owner == "/arm/controller"
    assert all(status.twist[1] >= 0.0 for status in statuses)
    refusal = "command of /joystick refused: the arm is commanded by /arm/controller"
    graph.wait_for_report("arm", lambda report: refusal in report.message)


def test_what_the_sensor_feels_bounds_how_deep_any_command_takes_it(graph, bench):
    bench()
    statuses = graph.collect(ArmStatus, "arm/status")
    poses = graph.collect(PoseStamped, "arm/pose")
    ask = graph.commands(SENSOR)
    states = graph.publisher(ContactState, "contact/state")
    assert graph.wait(lambda: bool(poses))
    T_base_surface = matrix_from_pose(poses[-1].pose) @ se3.exp(np.array([0, 0, -0.005, 0, 0, 0]))
    for _ in graph.ticks(0.02):
        X_sf = se3.inverse(matrix_from_pose(poses[-1].pose)) @ T_base_surface
        state = ContactState(header=poses[-1].header, xi=se3.log(X_sf))
        state.header.frame_id = SENSOR
        states.publish(state)
        ask([0, 0, 0.05, 0, 0, 0])
        if statuses and statuses[-1].limited_by and abs(statuses[-1].twist[2]) < 1e-4:
            break
    depth = (se3.inverse(T_base_surface) @ matrix_from_pose(poses[-1].pose))[2, 3]
    assert 0.009 < depth < 0.0101
    assert statuses[-1].limited_by == "depth 0.01 m"


def test_an_arm_that_says_it_is_somewhere_else_is_stopped_until_a_reset(graph, bench):
    bench(settings="{jump_after: 300}")  # it has to be commanded before
    poses, statuses = graph.collect(PoseStamped, "arm/pose"), graph.collect(ArmStatus, "arm/status")
    keep_commanding(graph, SENSOR, lambda: "stop: the arm cannot have moved by 300" in bench.told)
    assert "cannot have moved" in graph.wait_for_count("arm", "states refused").message
    assert graph.wait(lambda: statuses[-1].mode == ArmStatus.FAULT)
    assert "where it is is not known" in statuses[-1].reason
    graph.spin(2.0)  # no waiting makes it believable
    ways = np.diff([matrix_from_pose(pose.pose)[1, 3] for pose in poses])
    assert np.abs(ways).max() < 0.1  # how far it had come before is the machine's affair
    where = position(poses)[1]
    assert statuses[-1].mode == ArmStatus.FAULT
    assert graph.call(Trigger, "arm/reset", Trigger.Request()).success
    assert graph.wait(lambda: abs(position(poses)[1] - where) > 0.2)
    assert graph.wait(lambda: statuses[-1].mode == ArmStatus.RESTING)


def test_an_arm_that_does_otherwise_is_stopped_and_the_reason_is_an_error_until_a_reset(graph, bench):
    bench(settings="{flips: true}")
    statuses = graph.collect(ArmStatus, "arm/status")
    keep_commanding(graph, SENSOR, lambda: bool(statuses) and statuses[-1].mode == ArmStatus.FAULT)
    assert "the arm does not do what it is told: in " in statuses[-1].reason
    graph.wait_for_report("arm", lambda report: report.level == ERROR)
    assert "the arm does not do what it is told" in graph.reports("arm")[-1].message
    assert "arm/reset leaves it" in bench.told
    assert graph.wait(lambda: graph.call(Trigger, "arm/reset", Trigger.Request()).success)  # once it rests
    assert graph.wait(lambda: statuses[-1].mode == ArmStatus.RESTING)
    graph.wait_for_report("arm", lambda report: report.level != ERROR)


def test_a_second_process_that_calls_itself_as_the_owner_is_refused(graph, bench):
    bench(safety="{owner_timeout: 10.0}")
    statuses, poses = graph.collect(ArmStatus, "arm/status"), graph.collect(PoseStamped, "arm/pose")
    owner, other = (graph.publisher(ArmCommand, "command/request", qos.COMMAND) for _ in range(2))
    message = arm_command(graph.now_ns(), SENSOR, np.zeros(6), "/arm/controller")
    message.session, message.sequence = 4711, 1
    owner.publish(message)
    assert graph.wait(lambda: bool(statuses) and statuses[-1].owner == "/arm/controller")
    assert "commanded by /arm/controller" in bench.told
    where = position(poses)
    for _ in range(20):
        for twist in (np.zeros(6), ALONG):
            other.publish(arm_command(graph.now_ns(), SENSOR, twist, statuses[-1].owner))
        graph.spin(0.02)
    refusal = "somebody else commands the arm as /arm/controller, too"
    graph.wait_for_report("arm", lambda report: refusal in report.message)
    assert statuses[-1].refused_source == "/arm/controller" and refusal in statuses[-1].refused
    np.testing.assert_array_equal(position(poses), where)
