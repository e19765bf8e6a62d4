"""One arm's nodes beside somebody else's arm and camera, twice in one domain, run by `tactile run`."""

import subprocess
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from messages import image_message, vector_from_twist
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage

from tactile_bringup.attached_arm import Place, load_servoing_graph
from tactile_geometry import se3
from tactile_msgs.msg import ArmStatus
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time, time_from_ns, transform_stamped
from tactile_sim.tactip import TacTip

MOUNT = se3.pose_from_euler([0.0, 0.0, 0.065, 0.0, 0.0, 0.0])
START = se3.pose_from_euler([0.1, 0.2, 0.3, 0.0, np.pi, 0.0])
SCENE = """
arms:
  arm:
    driver: external
    start: {position: [0.1, 0.2, 0.235], rotation_deg: [0, 180, 0]}
    sensor: {in_tool: {position: [0, 0, 0.065]}, camera: external, camera_rate: 10}
"""
TASK = """
roles:
  follower:
    task: surface_following
    settings:
      watchdog: {presence_age: 1.0, pose_age: 1.0, patience: 30.0, start_timeout: 60.0}
      contact: {approach_distance: 0.003, retreat_distance: 0.001, approach_timeout: 60.0}
scenes: {bench: {follower: {goals: [{name: down}]}}}
"""
PARAMETERS = "/**/controller: {ros__parameters: {contact.approach_distance: 0.002}}"
SIM_TIME_NS = 1_000_000_000_000
LEFT = Place(within="/lab", image_topic="/cameras/left")
RIGHT = Place(
    namespace="right",
    base_frame="base_link",
    tool_frame="tool0",
    sensor_frame="tip",
    contact_frame="touched",
    image_topic="camera/image_raw",
    twist_topic="/servo/twist",
    use_sim_time=True,
)


@dataclass
class Names:
    """What the nodes of an arm are to call things."""

    namespace: str
    base: str
    tool: str
    sensor: str
    images: str
    twists: str


class Bench:
    """Somebody else's arm, which follows twists, and camera, which shows the same again and again."""

    def __init__(self, graph, names: Names, now_ns, image) -> None:
        self.names, self.now_ns, self._image = names, now_ns, image
        self.T, self._last_ns, self._exposed_ns = START.copy(), now_ns(), 0
        self.twists = graph.collect(TwistStamped, names.twists, qos.COMMAND)
        self.statuses = graph.collect(ArmStatus, f"{names.namespace}/arm/status")
        self._tf = graph.publisher(TFMessage, "/tf", qos.TF)
        self._images = graph.publisher(Image, names.images, qos.IMAGE)
        static = graph.publisher(TFMessage, "/tf_static", qos.TF_STATIC)
        static.publish(TFMessage(transforms=[transform_stamped(0, names.tool, names.sensor, MOUNT)]))

    @property
    def depth(self) -> float:
        """How far it has come along the sensor's axis, m."""
        return float((se3.inverse(START) @ self.T)[2, 3])

    def step(self) -> None:
        now_ns = self.now_ns()
        twist = vector_from_twist(self.twists[-1].twist) if self.twists else np.zeros(6)
        self.T = self.T @ MOUNT @ se3.exp(twist * (now_ns - self._last_ns) * 1e-9) @ se3.inverse(MOUNT)
        self._last_ns = now_ns
        frames = [transform_stamped(now_ns, self.names.base, self.names.tool, self.T)]
        self._tf.publish(TFMessage(transforms=frames))
        if now_ns - self._exposed_ns > 90_000_000:
            self._exposed_ns = now_ns
            self._images.publish(image_message(now_ns, self.names.sensor, self._image()))


@pytest.fixture(scope="module")
def ran(shared_graph, tmp_path_factory):
    """Both arms after their tasks, with what the clients have printed."""
    graph, folder = shared_graph, tmp_path_factory.mktemp("cell")
    scene, task, parameters = (folder / name for name in ("bench.yaml", "down.yaml", "mine.yaml"))
    for file, text in ((scene, SCENE), (task, TASK), (parameters, PARAMETERS)):
        file.write_text(text)
    places = [LEFT, replace(RIGHT, params_file=parameters)]
    for place in places:
        for node in load_servoing_graph(str(task), str(scene), "", place).nodes:
            file = folder / f"{node.file_stem}.yaml"
            file.write_text(node.parameter_text())
            log = graph.log(node.file_stem)
            graph.processes.start(node.full_name, node.command(file), graph.variables, log)
    clock = graph.node.create_publisher(Clock, "/clock", 10)
    started_ns = graph.now_ns()

    def sim_ns() -> int:
        return graph.now_ns() - started_ns + SIM_TIME_NS

    for name in list(graph.processes.children):
        graph.wait_until_active(name)
    image = TacTip(seed=1).image  # with noise of its own each time: no two exposures are equal
    lab, frames = "/lab/arm", ("lab/arm/base", "lab/arm/tool", "lab/arm/tactile_sensor")
    left = Names(lab, *frames, "/cameras/left", f"{lab}/command/twist")
    right = Names("/right", "base_link", "tool0", "tip", "/right/camera/image_raw", "/servo/twist")
    benches = [Bench(graph, left, graph.now_ns, image), Bench(graph, right, sim_ns, image)]
    command = [sys.executable, "-m", "tactile_bringup.cli", "run", str(task), "--scene", str(scene)]
    clients = [
        subprocess.Popen(
            [*command, "--headless", "--namespace", names.namespace],
            env=graph.variables,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for names in (left, right)
    ]
    for _ in graph.ticks(0.01):
        clock.publish(Clock(clock=time_from_ns(sim_ns())))
        for bench in benches:
            bench.step()
        if all(client.poll() is not None for client in clients):
            break
    return [(bench, client.communicate()[0]) for bench, client in zip(benches, clients, strict=True)]


@pytest.mark.parametrize(("number", "distance"), [(0, 3.0), (1, 2.0)], ids=["left", "right"])
def test_each_arm_runs_its_own_task_with_its_own_parameters(ran, number, distance):
    bench, said = ran[number]
    assert f"down: failed: no contact within {distance} mm of approach" in said
    moved = [vector_from_twist(message.twist) for message in bench.twists]
    assert max(np.abs(twist).max() for twist in moved) > 0.003
    assert all(np.allclose(np.delete(twist, 2), 0.0, atol=1e-4) for twist in moved)


def test_twists_and_states_are_in_the_frames_that_the_user_has_named(ran):
    for bench, _ in ran:
        assert {message.header.frame_id for message in bench.twists} == {bench.names.sensor}
        assert {message.header.frame_id for message in bench.statuses} == {bench.names.base}


def test_nodes_with_sim_time_stamp_by_the_clock_topic_and_others_do_not(ran):
    (left, _), (right, _) = ran
    assert all(ns_from_time(m.header.stamp) > 2 * SIM_TIME_NS for m in left.twists)
    assert all(0 <= ns_from_time(m.header.stamp) - SIM_TIME_NS < SIM_TIME_NS for m in right.twists)
