"""Joints of an arm with known kinematics on the graph, and what RViz shows it by."""

import sys

import numpy as np
import pytest
from messages import matrix_from_transform
from other_package import installed
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from tactile_drivers.arm_distance import Neighbour
from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformBuffer
from tactile_msgs.msg import ArmStatus
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time
from tactile_scene.scene_file import load_scene

ARM_NODE, SIM = "tactile_ros.nodes.arm_node", "tactile_ros.nodes.sim_node"
# a UR5e's lengths: (type, xyz, rpy, axis) of each joint, a mount below the base, and a finger that slides
JOINTS = {
    "mount": ("fixed", "0 0 -0.2", "0 0 0", "0 0 1"),
    "pan": ("revolute", "0 0 0.1625", "0 0 0", "0 0 1"),
    "lift": ("revolute", "0 0 0", "1.570796327 0 0", "0 0 1"),
    "elbow": ("revolute", "-0.425 0 0", "0 0 0", "0 0 1"),
    "wrist1": ("revolute", "-0.3922 0 0.1333", "0 0 0", "0 0 1"),
    "wrist2": ("revolute", "0 -0.0997 0", "1.570796327 0 0", "0 0 1"),
    "wrist3": ("revolute", "0 0.0996 0", "-1.570796327 0 0", "0 0 2"),
    "finger": ("prismatic", "0 0 0.05", "0 0 0", "1 0 0"),
}
SCENE = """
arms:
  arm:
    base: {position: [0.1, 0.2, 0.0], rotation_deg: [0, 0, 30]}
    start: {position: [0.45, 0.25, 0.3], rotation_deg: [180, 0, 30]}
    kinematics: {description: arm.yaml}
  free:
    start: {}
simulation: {rate: 60}
"""
ARM = """
urdf: arm.urdf
base: base
flange: wrist3_link
acceleration: [3, 3, 3, 3, 3, 3]
ready_deg: [0, -90, -90, -90, 90, 0]
capsules: {}
"""
JOINT = (
    '<link name="{name}_link"/><joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/>'
    '<axis xyz="{axis}"/><parent link="{parent}"/><child link="{name}_link"/>'
    '<limit lower="-6.28" upper="6.28" velocity="3" effort="1"/></joint>'
)


def urdf() -> str:
    """The base hangs below a root, `world_link`, as those of drivers' packages do."""
    parts, parent = [], "base"
    for name, (kind, xyz, rpy, axis) in JOINTS.items():
        parts.append(JOINT.format(name=name, kind=kind, xyz=xyz, rpy=rpy, axis=axis, parent=parent))
        parent = parent if name == "mount" else f"{name}_link"
    root = (
        '<link name="world_link"/><joint name="stand" type="fixed"><origin xyz="0 0 0.7" rpy="0 0 3.14159"/>'
        '<parent link="world_link"/><child link="base"/></joint>'
    )
    return f'<robot name="ur"><link name="base"/>{root}{"".join(parts)}</robot>'


@pytest.fixture
def cell(graph, tmp_path):
    """The simulated cell; what it says of the arm."""
    for name, text in (("arm.urdf", urdf()), ("arm.yaml", ARM), ("cell.yaml", SCENE)):
        (tmp_path / name).write_text(text)
    heard = {
        "joints": graph.collect(JointState, "joint_states"),
        "description": graph.collect(String, "robot_description", qos.LATCHED),
        "tf": graph.collect(TFMessage, "/tf", qos.TF),
        "static": graph.collect(TFMessage, "/tf_static", qos.TF_STATIC),
        "free": graph.collect(JointState, "/free/joint_states"),
    }
    graph.start(SIM, {"scene": str(tmp_path / "cell.yaml")}, namespace="")
    return heard


def test_the_links_of_a_urdf_follow_the_joints_and_end_where_the_tool_is(graph, cell, tmp_path):
    ask = graph.commands("arm/tool")
    turning = [name for name, (kind, *_) in JOINTS.items() if kind == "revolute"]
    start = None
    for _ in graph.ticks(0.02):
        ask([0.0, 0.05, 0.02, 0.2, 0.0, 0.1])
        if cell["joints"]:
            now = np.array(cell["joints"][-1].position)
            start = now if start is None else start
            if np.abs(now - start).max() > 0.05 and cell["description"]:
                break
    graph.spin(0.2)
    assert cell["description"][0].data == urdf()
    assert not cell["free"]
    buffer = TransformBuffer()
    for kind in ("static", "tf"):
        for message in cell[kind]:
            for item in message.transforms:
                T, stamp_ns = matrix_from_transform(item.transform), ns_from_time(item.header.stamp)
                frames = item.header.frame_id, item.child_frame_id
                buffer.set_transform(*frames, stamp_ns, T, static=kind == "static")
    chain = load_scene(tmp_path / "cell.yaml").arms["arm"].kinematics
    checked, heard_ns = 0, ns_from_time(cell["tf"][0].transforms[0].header.stamp)
    for message in cell["joints"]:
        stamp_ns = ns_from_time(message.header.stamp)
        assert list(message.name) == turning
        if stamp_ns < heard_ns:  # each topic is found by itself, this one first
            continue
        flange = buffer.lookup("arm/base", "arm/urdf/wrist3_link", stamp_ns)
        tool = buffer.lookup("arm/base", "arm/tool", stamp_ns)
        error = se3.log(se3.inverse(tool) @ flange)
        assert np.linalg.norm(error[:3]) < 1e-3 and np.linalg.norm(error[3:]) < 1e-2
        np.testing.assert_allclose(flange, chain.pose(np.array(message.position)), atol=1e-8)
        checked += 1
    assert checked > 5
    np.testing.assert_allclose(
        buffer.lookup("arm/base", "arm/urdf/base", stamp_ns), np.eye(4), atol=1e-9
    )  # below the root of the file
    assert buffer.lookup("arm/urdf/world_link", "arm/base", stamp_ns)[2, 3] == pytest.approx(0.7)
    finger = buffer.lookup("arm/urdf/wrist3_link", "arm/urdf/finger_link", stamp_ns)
    assert finger[2, 3] == pytest.approx(0.05)


TWO = """
arms:
  left:
    driver: bench_arm
    base: {position: [-0.5, 0.0, 0.0]}
    start: {position: [-0.08, 0.0, 0.4], rotation_deg: [180, 0, 0]}
    kinematics: {description: panda, tool: {position: [0.0, 0.0, 0.1]}}
  right:
    driver: bench_arm
    base: {position: [0.5, 0.0, 0.0], rotation_deg: [0, 0, 180]}
    start: {position: [0.08, 0.0, 0.4], rotation_deg: [180, 0, 180]}
    kinematics: {description: fr3, tool: {position: [0.0, 0.0, 0.1]}}
"""


def test_two_arms_in_nodes_of_their_own_keep_apart_and_one_that_falls_silent_stops_the_other(graph, tmp_path):
    graph.import_from(installed(tmp_path))
    path = tmp_path / "two.yaml"
    path.write_text(TWO)
    for name in ("left", "right"):
        words = ["-m", ARM_NODE, "--ros-args", "-r", f"__ns:=/{name}", "-p", f"scene:={path}"]
        graph.processes.start(name, [sys.executable, *words], graph.variables, graph.log(name))
    for name in ("left", "right"):
        graph.wait_until_active(name)
    joints = {name: graph.collect(JointState, f"/{name}/joint_states") for name in ("left", "right")}
    statuses = {name: graph.collect(ArmStatus, f"/{name}/arm/status") for name in joints}
    asks = [graph.commands(f"{name}/tool", arm=name) for name in joints]
    (tmp_path / "here.yaml").write_text(TWO.replace("bench_arm", "sim"))  # which this process knows
    arms = load_scene(tmp_path / "here.yaml").arms
    pair = Neighbour(arms["left"], arms["right"], lambda: None)
    distances = []

    def drive(velocity, until) -> None:
        """Both along x of their tools, towards each other."""
        for _ in graph.ticks(0.02):
            for ask in asks:
                ask([velocity, 0, 0, 0, 0, 0])
            if all(joints.values()):
                q = [np.array(joints[name][-1].position) for name in ("left", "right")]
                distances.append(pair.distance(*q))
            if all(statuses.values()) and until(*(found[-1] for found in statuses.values())):
                return
        raise AssertionError(f"it never held: {[found[-1:] for found in statuses.values()]}")

    def near(left, right) -> bool:
        rest = max(abs(left.twist[0]), abs(right.twist[0])) < 1e-4
        return rest and left.limited_by == "0.02 m from right" and min(distances, default=1.0) < 0.05

    drive(0.05, near)
    assert 0.019 < min(distances) < 0.05 < distances[0]
    assert statuses["left"][-1].limited_by == "0.02 m from right"
    drive(-0.05, lambda left, right: max(left.twist[0], right.twist[0]) < -0.04)  # the way back is open
    graph.processes.children["right"].process.kill()
    drive(-0.05, lambda left, _: left.limited_by == "no joints of right" and not any(left.twist))
