"""The arm node before a velocity controller of ros2_control: a stand-in with its rules, and a UR5e."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from messages import matrix_from_transform
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformBuffer
from tactile_msgs.msg import ArmStatus
from tactile_ros import qos
from tactile_ros.conversions import header, matrix_from_pose, transform_stamped

ARM_NODE = "tactile_ros.nodes.arm_node"
COMMANDS = "/forward_velocity_controller/commands"
KNOWN = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
JOINTS = [f"left_{name}_joint" for name in KNOWN]
ORDER = [2, 0, 1, 5, 4, 3]  # of the controller, among these
READY = np.array([0.2, -1.6, 1.8, -1.8, -1.57, 0.3])
MOUNT = se3.pose_from_euler([0.0, 0.0, 0.065, 0.0, 0.0, 0.0])
ALONG = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
SCENE = """\
arms:
  arm:
    driver: external
    driver_settings: {{joint_velocities: {commands}, joints: [{joints}], joint_prefix: left_,
      publish_mount: true, publish_tool: {tool}}}
    kinematics: {{description: {arm}}}
    start: {{}}
    sensor: {{in_tool: {{position: [0, 0, 0.065]}}}}
"""


def ur5e(q) -> np.ndarray:
    """Pose of the sensor in the base, by Universal Robots' table of Denavit-Hartenberg parameters."""
    T = np.eye(4)
    a, d = (0.0, -0.425, -0.3922, 0, 0, 0), (0.1625, 0, 0, 0.1333, 0.0997, 0.0996)
    for theta, a_i, d_i, alpha in zip(q, a, d, (90, 0, 0, 90, -90, 0), strict=True):
        step = np.eye(4)
        turn = Rotation.from_euler("z", theta) * Rotation.from_euler("x", alpha, degrees=True)
        step[:3, :3], step[:3, 3] = turn.as_matrix(), (a_i * np.cos(theta), a_i * np.sin(theta), d_i)
        T = T @ step
    return T @ MOUNT


class Controller:
    """A forward_velocity_controller, the joint_state_broadcaster beside it, and the arm that they have.

    Each command holds until the next one comes; one that is not finite, or of another length, is dropped
    (ros2_controllers, forward_controllers_base.cpp). All that the broadcaster knows is on /joint_states.
    """

    def __init__(self, graph, q=READY) -> None:
        self.graph, self.q, self.rates = graph, np.array(q), np.zeros(6)
        self.commands = graph.collect(Float64MultiArray, COMMANDS, qos.COMMAND)
        self.states = graph.publisher(JointState, "/joint_states")
        self.last, self.fastest, self.tell = time.monotonic(), np.zeros(6), True

    def step(self) -> None:
        now = time.monotonic()
        self.q = self.q + self.rates * (now - self.last)
        self.last = now
        if self.commands and len(data := self.commands[-1].data) == 6 and np.isfinite(data).all():
            self.rates[ORDER] = data
        self.fastest = np.maximum(self.fastest, np.abs(self.rates))
        if self.tell:
            self.publish()

    def publish(self, **changed: float) -> None:
        angles = {
            "gripper": 0.1,
            **dict(zip(reversed(JOINTS), self.q[::-1].tolist(), strict=True)),
            **changed,
        }
        stamp = header(self.graph.now_ns(), "")
        self.states.publish(JointState(header=stamp, name=list(angles), position=list(angles.values())))

    @property
    def pose(self) -> np.ndarray:
        return ur5e(self.q)


@pytest.fixture
def bench(graph):
    """Starts the node on a scene, with the stand-in; what the node says, and who commands it."""

    def start(q=READY, tool="true", arm="ur5e", commands=COMMANDS):
        scene = graph.folder / "cell.yaml"
        joints = ", ".join(JOINTS[i] for i in ORDER)
        scene.write_text(SCENE.format(commands=commands, joints=joints, tool=tool, arm=arm))
        graph.start(ARM_NODE, {"scene": str(scene), "feels": False})
        return (
            Controller(graph, q),
            graph.collect(ArmStatus, "arm/status"),
            graph.commands("arm/tactile_sensor"),
        )

    return start


def go_on(graph, controller, until, ask=None, twist=ALONG, seconds=30.0) -> None:
    """Step the stand-in and send a twist until something holds."""
    end = time.monotonic() + seconds
    for _ in graph.ticks(0.01):
        controller.step()
        if ask is not None:
            ask(twist)
        if until():
            return
        assert time.monotonic() < end, f"it never held: {controller.rates}"


def go_on_for(graph, controller, seconds, ask=None) -> None:
    """The same for so long."""
    end = time.monotonic() + seconds
    go_on(graph, controller, lambda: time.monotonic() > end, ask)


def node_pid(graph) -> int:
    return graph.processes.children[ARM_NODE].process.pid


def guard_pid(graph) -> int:
    pid = node_pid(graph)
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text())


def test_twists_become_velocities_of_the_joints_in_the_controllers_order_and_end_with_zeros(graph, bench):
    controller, statuses, ask = bench()
    poses = graph.collect(PoseStamped, "arm/pose")
    tf, static = (
        graph.collect(TFMessage, "/tf", qos.TF),
        graph.collect(TFMessage, "/tf_static", qos.TF_STATIC),
    )
    told = graph.collect(JointState, "joint_states")
    go_on(graph, controller, lambda: len(statuses) > 5)
    assert not controller.commands  # an arm that nobody wants to move is left to others
    start = controller.pose
    moved = lambda: se3.inverse(start) @ controller.pose  # noqa: E731
    go_on(graph, controller, lambda: moved()[1, 3] > 0.04, ask)
    way = se3.log(moved())
    np.testing.assert_allclose(way[[0, 2]], 0.0, atol=1e-3)
    np.testing.assert_allclose(way[3:], 0.0, atol=5e-3)
    start = controller.pose
    turn = np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    go_on(graph, controller, lambda: se3.log(moved())[3] > 0.2, ask, turn)
    assert np.linalg.norm(moved()[:3, 3]) < 2e-3  # the tip stays where it is
    # no command any more: zeros, and then silence
    go_on(graph, controller, lambda: not controller.rates.any())
    rested = controller.q.copy()
    go_on(graph, controller, lambda: "no command for" in statuses[-1].reason)
    last = len(controller.commands)
    go_on_for(graph, controller, 1.5)
    zeros = [not any(command.data) for command in controller.commands[last - 1 :]]
    assert all(zeros) and 3 < len(zeros) < 15
    count = len(controller.commands)
    go_on_for(graph, controller, 0.5)
    assert len(controller.commands) == count and (controller.q == rested).all()
    # what the node says of the arm is where the maker's table has it
    graph.spin(0.2)
    np.testing.assert_allclose(matrix_from_pose(poses[-1].pose), controller.pose, atol=1e-6)
    buffer = TransformBuffer()
    for message in [*static, *tf[-5:]]:
        for item in message.transforms:
            frames = item.header.frame_id, item.child_frame_id
            T = matrix_from_transform(item.transform)
            buffer.set_transform(*frames, 1, T, static=message in static)
    _, T = buffer.newest("arm/base", "arm/tactile_sensor")
    np.testing.assert_allclose(T, controller.pose, atol=1e-6)
    assert [f"left_{name}" for name in told[-1].name] == JOINTS


def test_when_joint_states_stop_zeros_go_out_and_commands_are_refused(graph, bench):
    controller, _, ask = bench()
    go_on(graph, controller, lambda: np.abs(controller.rates).max() > 0.005, ask)
    controller.tell, begun = False, time.monotonic()
    go_on(graph, controller, lambda: not controller.rates.any(), ask)
    assert time.monotonic() - begun < 1.0
    graph.wait_for_report("arm", lambda report: "no state from the driver" in report.message)
    go_on_for(graph, controller, 1.0, ask)
    assert not controller.rates.any() and not any(controller.commands[-1].data)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_node_that_is_killed_or_stands_still_leaves_no_arm_moving(graph, bench, number):
    controller, _, ask = bench()
    guard = guard_pid(graph)
    go_on(graph, controller, lambda: np.abs(controller.rates).max() > 0.005, ask)
    os.kill(node_pid(graph), number)
    begun = time.monotonic()
    go_on(graph, controller, lambda: not controller.rates.any())
    assert time.monotonic() - begun < 1.0
    go_on_for(graph, controller, 0.5)
    assert not controller.rates.any()
    if number == signal.SIGSTOP:
        os.kill(node_pid(graph), signal.SIGCONT)
        go_on_for(graph, controller, 1.0)
        assert not controller.rates.any()
    else:
        graph.wait(lambda: not os.path.exists(f"/proc/{guard}"))
        assert not os.path.exists(f"/proc/{guard}")


def test_a_node_that_ends_while_the_arm_moves_ends_with_zeros(graph, bench):
    controller, _, ask = bench()
    guard = guard_pid(graph)
    go_on(graph, controller, lambda: np.abs(controller.rates).max() > 0.005, ask)
    for _ in range(2):  # a second signal ends it at once
        os.kill(node_pid(graph), signal.SIGTERM)
    process = graph.processes.children[ARM_NODE].process
    go_on(graph, controller, lambda: process.poll() is not None, ask)
    go_on(graph, controller, lambda: not controller.rates.any())
    assert not any(controller.commands[-1].data) and process.returncode == 0
    assert not os.path.exists(f"/proc/{guard}")


def test_without_the_process_that_outlives_the_node_the_arm_is_in_fault(graph, bench):
    controller, statuses, ask = bench()
    go_on(graph, controller, lambda: np.abs(controller.rates).max() > 0.005, ask)
    os.kill(guard_pid(graph), signal.SIGKILL)
    go_on(graph, controller, lambda: not controller.rates.any(), ask)
    go_on(graph, controller, lambda: statuses[-1].mode == ArmStatus.FAULT, ask)
    assert "the process that stops the arm if this one dies has ended" in statuses[-1].reason
    assert graph.call(Trigger, "arm/reset", Trigger.Request()).success  # which starts another one
    go_on(graph, controller, lambda: np.abs(controller.rates).max() > 0.005, ask)


def test_no_joint_is_faster_than_it_may_be_and_towards_a_singularity_the_arm_slows_down(graph, bench):
    controller, statuses, ask = bench(q=[0.3, -1.0, 0.5, -1.8, -1.57, 0.0])
    go_on(graph, controller, lambda: len(statuses) > 3)
    T = controller.pose
    outward = np.zeros(6)  # away from the shoulder, which stretches the elbow
    shoulder = np.array([0.0, 0.0, 0.1625])
    outward[:3] = 0.09 * T[:3, :3].T @ (T[:3, 3] - shoulder) / np.linalg.norm(T[:3, 3] - shoulder)
    held = lambda: "singularity" in statuses[-1].limited_by  # noqa: E731
    go_on(graph, controller, lambda: held() and not statuses[-1].twist.round(3).any(), ask, outward)
    assert controller.fastest.max() < 3.1416
    assert abs(controller.q[2]) > 0.02  # the elbow is not quite stretched
    go_on(graph, controller, lambda: not held() and np.abs(controller.rates).max() > 0.01, ask, -outward)


def test_an_arm_that_tf_has_elsewhere_than_its_kinematics_is_not_followed(graph, bench):
    controller, _, ask = bench(tool="false")
    tf = graph.publisher(TFMessage, "/tf", qos.TF)
    off = se3.pose_from_euler([0.05, 0, 0, 0, 0, 0])  # an adapter that the scene does not know

    def publish(T) -> bool:
        T_base_tool = T @ controller.pose @ se3.inverse(MOUNT)
        tf.publish(
            TFMessage(transforms=[transform_stamped(graph.now_ns(), "arm/base", "arm/tool", T_base_tool)])
        )
        return any("50 mm and 0 degrees from where it says" in r.message for r in graph.reports("arm"))

    go_on(graph, controller, lambda: publish(off), ask)
    assert not controller.commands
    graph.restart("arm")
    go_on(graph, controller, lambda: publish(np.eye(4)) or np.abs(controller.rates).max() > 0.005, ask)


def test_joints_that_are_not_finite_are_refused_and_those_of_others_passed_over(graph, bench):
    controller, statuses, _ = bench()
    go_on(graph, controller, lambda: len(statuses) > 3)
    others = JointState(header=header(graph.now_ns(), ""), name=["gripper"], position=[0.1])
    controller.states.publish(others)
    controller.publish(left_elbow_joint=np.nan)
    graph.wait_for_count("arm", "/joint_states messages refused")
    report = graph.reports("arm")[-1]
    assert report.values["/joint_states messages refused"] == "1"


def test_where_there_is_no_controller_the_arm_has_no_state_which_is_told(graph, bench):
    controller, statuses, ask = bench(commands="/somewhere/commands")
    complaint = "nobody listens to /somewhere/commands: nothing is told of the arm"
    told = lambda: any(complaint in report.message for report in graph.reports("arm"))  # noqa: E731
    go_on(graph, controller, told, ask)
    assert not statuses
    graph.collect(Float64MultiArray, "/somewhere/commands", qos.COMMAND)
    go_on(graph, controller, lambda: bool(statuses))
