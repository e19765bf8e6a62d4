"""The arm node before moveit_servo: a stand-in with its rules, on the scene of the examples.

Its status is moveit_msgs' ServoStatus where that is installed, which `make` does not, else one with its
fields that is built here.
"""

import ctypes
import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from messages import arm_command, matrix_from_transform, vector_from_twist
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from tactile_geometry import se3
from tactile_msgs.msg import ArmCommand, ArmStatus
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time, transform_stamped

ARM_NODE = "tactile_ros.nodes.arm_node"
SCENE = Path(__file__).parents[2] / "examples/external_arm/my_moveit_cell.yaml"
TIMEOUT = 0.1  # s, servo's incoming_command_timeout
MOUNT = se3.pose_from_euler([0.0, 0.0, 0.065, 0.0, 0.0, 0.0])
START = se3.pose_from_euler([0.4, 0.0, 0.115, np.pi, 0.0, 0.0])
TURN = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])  # about the sensor's own origin
FRAMES = {"frames.base": "base_link", "frames.tool": "tool0", "frames.sensor": "tactip"}


class Servo:
    """What moveit_servo makes of twists, and the transforms that its arm's robot_state_publisher has.

    A command older than the timeout is discarded; without one the arm rests. The velocity is that of the tip
    (tool0); a command in another frame is only turned into its axes, as with
    apply_twist_commands_about_ee_frame.
    """

    def __init__(self, graph) -> None:
        self.graph, self.T, self.twist = graph, START.copy(), np.zeros(6)
        self.last_ns, self.discarded = graph.now_ns(), 0
        self.commands = graph.collect(TwistStamped, "/servo_node/delta_twist_cmds", qos.COMMAND)
        self.taken = len(self.commands)
        self.tf = graph.publisher(TFMessage, "/tf", qos.TF)
        self.part = 1.0  # of what it is told that it does
        self.say = lambda: None  # its status

    def step(self) -> None:
        now_ns = self.graph.now_ns()
        for command in self.commands[self.taken :]:
            self.discarded += now_ns - ns_from_time(command.header.stamp) > TIMEOUT * 1e9
        self.taken = len(self.commands)
        self.T = self.T @ se3.exp(self.part * self._velocity(now_ns) * (now_ns - self.last_ns) * 1e-9)
        self.say()
        self.last_ns = now_ns
        elbow = se3.pose_from_euler([0.0, 0.0, 0.333, 0.0, 0.0, now_ns % 10**9 * 1e-10])
        links = ("base_link", "link1", elbow), ("link1", "tool0", se3.inverse(elbow) @ self.T)
        self.tf.publish(TFMessage(transforms=[transform_stamped(now_ns, *link) for link in links]))

    def _velocity(self, now_ns: int) -> np.ndarray:
        self.twist = np.zeros(6)
        if self.commands:
            command = self.commands[-1]
            if now_ns - ns_from_time(command.header.stamp) <= TIMEOUT * 1e9:
                R = {"tool0": np.eye(3), "tactip": MOUNT[:3, :3]}[command.header.frame_id]
                parts = vector_from_twist(command.twist).reshape(2, 3)
                self.twist = (parts @ R.T).ravel()
        return self.twist

    @property
    def sensor(self) -> np.ndarray:
        return self.T @ MOUNT

    def turned(self) -> float:
        return float(np.linalg.norm(se3.log(se3.inverse(START) @ self.T)[3:]))


INSTALLED = importlib.util.find_spec("moveit_msgs") is not None
MESSAGES = {
    "msg/ServoStatus.msg": "int8 code\nstring message\n",
    "package.xml": """\
<package format="3">
  <name>moveit_msgs</name> <version>0.0.0</version> <description>For a test.</description>
  <maintainer email="tactile-servoing@example.com">The tactile_servoing developers</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
""",
    "CMakeLists.txt": """\
cmake_minimum_required(VERSION 3.12)
project(moveit_msgs C CXX)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(moveit_msgs "msg/ServoStatus.msg")
ament_package()
""",
}


@pytest.fixture(scope="module")
def messages(tmp_path_factory):
    """A folder with a package moveit_msgs that has ServoStatus alone, built in some six seconds."""
    folder = tmp_path_factory.mktemp("moveit_msgs")
    for name, text in MESSAGES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    build, install = folder / "build", folder / "install"
    where = [f"-DCMAKE_INSTALL_PREFIX={install}", f"-DCMAKE_INSTALL_RPATH={install}/lib"]
    options = [*where, f"-DPython3_EXECUTABLE={sys.executable}", "-DCMAKE_UNITY_BUILD=ON"]
    for command in (["-S", folder, "-B", build, *options], ["--build", build, "-t", "install"]):
        subprocess.run(["cmake", *command], check=True, capture_output=True)
    return install


@pytest.fixture
def status_type(graph, request, monkeypatch):
    """ServoStatus, here and in nodes that are started from now on."""
    if INSTALLED:
        return importlib.import_module("moveit_msgs.msg").ServoStatus
    messages = request.getfixturevalue("messages")
    (site,) = messages.glob("lib/python3*/site-packages")
    libraries = f"{messages / 'lib'}:{graph.variables.get('LD_LIBRARY_PATH', '')}"
    graph.variables["LD_LIBRARY_PATH"] = libraries
    graph.import_from([str(site)])
    monkeypatch.syspath_prepend(site)
    for library in sorted((messages / "lib").glob("*.so")):
        ctypes.CDLL(str(library))  # this process's own search path is that of its start
    return importlib.import_module("moveit_msgs.msg").ServoStatus


def start(graph) -> Servo:
    """The node on the example's scene, and the stand-in."""
    remap = "import sys; sys.argv += ['-r', 'command/twist:=/servo_node/delta_twist_cmds']; "
    code = f"{remap}from {ARM_NODE} import main; sys.exit(main())"
    graph.start_code(ARM_NODE, code, {"scene": str(SCENE), "feels": False, **FRAMES})
    return Servo(graph)


@pytest.fixture
def servo(graph):
    """Where there is no moveit_msgs."""
    return start(graph)


def test_moveit_servo_turns_the_tool_about_the_tip_and_rests_when_commands_end(graph, servo):
    static = graph.collect(TFMessage, "/tf_static", qos.TF_STATIC)
    ask = graph.commands("tactip")

    def command(twist, until):
        for _ in graph.ticks(0.01):
            servo.step()
            ask(twist)
            if until():
                return
        raise AssertionError("it never held")

    command(np.zeros(6), lambda: bool(static))
    assert not servo.commands  # an arm that nobody wants to move is left to others
    mount = static[0].transforms[0]
    assert (mount.header.frame_id, mount.child_frame_id) == ("tool0", "tactip")
    np.testing.assert_allclose(matrix_from_transform(mount.transform), MOUNT, atol=1e-12)
    start = servo.sensor[:3, 3].copy()
    command(TURN, lambda: servo.turned() > 0.15)
    assert np.linalg.norm(servo.sensor[:3, 3] - start) < 5e-4  # the tip stays where it is
    assert {message.header.frame_id for message in servo.commands} == {"tool0"}
    assert servo.discarded <= 0.2 * len(servo.commands)  # those for which this process was held up
    # no command any more: zeros, and then silence
    ended_ns = graph.now_ns()
    for _ in graph.ticks(0.01):
        servo.step()
        newest_ns = ns_from_time(servo.commands[-1].header.stamp)
        if graph.now_ns() - max(newest_ns, ended_ns) > 8e8:
            break
    moving = [vector_from_twist(message.twist).any() for message in servo.commands]
    zeros = servo.commands[len(moving) - moving[::-1].index(True) :]
    first_ns, last_ns = (ns_from_time(zeros[at].header.stamp) for at in (0, -1))
    assert len(zeros) > 3 and 0.2 < (last_ns - first_ns) * 1e-9 < 0.8
    before = len(servo.commands)
    for _ in range(30):
        servo.step()
        ask(np.zeros(6))
        graph.spin(0.01)
    assert len(servo.commands) == before
    # and again, until the node is killed: servo's own timeout is what is left
    command(-TURN, lambda: servo.twist[3] < -0.3)
    graph.processes.children[ARM_NODE].process.kill()
    killed_ns = graph.now_ns()
    for _ in graph.ticks(0.005):
        servo.step()
        if not servo.twist.any():
            break
    assert ns_from_time(servo.commands[-1].header.stamp) < killed_ns  # no command outlives it by more


def test_an_arm_whose_sensor_is_mounted_elsewhere_than_the_scene_says_is_not_followed(graph, tmp_path):
    scene = tmp_path / "cell.yaml"
    scene.write_text(
        "arms: {arm: {driver: external, start: {}, sensor: {in_tool: {position: [0, 0, 0.065]}}}}\n"
    )
    graph.start(ARM_NODE, {"scene": str(scene)})
    arm = graph.arm()  # its sensor is at the flange
    twists = graph.publisher(ArmCommand, "command/request", qos.COMMAND)
    for _ in graph.ticks(0.02):
        arm.at(graph.now_ns(), START)
        twists.publish(arm_command(graph.now_ns(), "arm/tactile_sensor", TURN))
        if any("65.0 mm and 0.0 degrees off in_tool" in r.message for r in graph.reports("arm")):
            break
    report = graph.wait_for_count("arm", "commands refused")
    assert "the arm has no state yet" in report.message


@pytest.fixture
def outspoken(graph, status_type):
    """A stand-in that tells its status, and what the arm's node says."""
    servo = start(graph)
    out = graph.publisher(status_type, "/servo_node/status")
    servo.status = 0, "No warnings"
    servo.say = lambda: out.publish(status_type(code=servo.status[0], message=servo.status[1]))
    return servo, graph.collect(ArmStatus, "arm/status"), graph.commands("tactip")


def go_on(graph, servo, ask, until, twist=TURN) -> None:
    for _ in graph.ticks(0.01):
        servo.step()
        ask(twist)
        if until():
            return
    raise AssertionError("it never held")


def test_what_moveit_servo_halts_for_is_the_arms_fault_and_a_reset_gives_it_another_chance(graph, outspoken):
    servo, statuses, ask = outspoken
    go_on(graph, servo, ask, lambda: servo.turned() > 0.05)
    assert statuses[-1].mode == ArmStatus.MOVING and not statuses[-1].remark
    servo.part, servo.status = 0.0, (2, "Very close to a singularity, emergency stop")
    reason = "moveit_servo: Very close to a singularity, emergency stop"
    go_on(graph, servo, ask, lambda: statuses[-1].mode == ArmStatus.FAULT)
    assert statuses[-1].reason == reason
    go_on(graph, servo, ask, lambda: f"fault: {reason}; arm/reset leaves it" in statuses[-1].refused)
    graph.wait_for_report("arm", lambda report: reason in report.message)
    assert not vector_from_twist(servo.commands[-1].twist).any()
    servo.part, servo.status = 1.0, (0, "No warnings")
    assert graph.call(Trigger, "arm/reset", Trigger.Request()).success
    turned = servo.turned()
    go_on(graph, servo, ask, lambda: servo.turned() < turned - 0.03, -TURN)
    assert statuses[-1].mode == ArmStatus.MOVING


def test_an_arm_that_moveit_servo_slows_down_says_why_and_is_not_taken_for_one_that_does_not_obey(
    graph, outspoken
):
    servo, statuses, ask = outspoken
    go_on(graph, servo, ask, lambda: servo.turned() > 0.05)
    servo.part, servo.status = 0.02, (4, "Close to a collision, decelerating")
    remark = "moveit_servo: Close to a collision, decelerating"
    go_on(graph, servo, ask, lambda: statuses[-1].remark == remark)
    begun = graph.now_ns()
    go_on(graph, servo, ask, lambda: graph.now_ns() - begun > 2e9)  # of which 0.4 s would be a fault
    assert statuses[-1].mode == ArmStatus.MOVING and statuses[-1].remark == remark
    graph.wait_for_report("arm", lambda report: remark in report.message)
    servo.say = lambda: None  # servo's word is no excuse for longer than it says it
    go_on(graph, servo, ask, lambda: "does not do what it is told" in statuses[-1].reason)


@pytest.mark.skipif(INSTALLED, reason="moveit_msgs is installed")
def test_without_its_messages_nobody_hears_moveit_servo_which_is_said_once(graph, servo):
    go_on(graph, servo, graph.commands("tactip"), lambda: servo.turned() > 0.05)
    log = graph.log(ARM_NODE).read_text()
    missing = "moveit_msgs/msg/ServoStatus is not installed: what moveit_servo says on /servo_node/status"
    assert log.count(missing) == 1
