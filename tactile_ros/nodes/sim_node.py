"""Sim node: the simulated cell of a scene in real time, beside the nodes of its arms and cameras.

Its process runs an arm node for each simulated arm and a camera node for each simulated camera, the same
that serve real ones (`arm_node`, `camera_node`), and this node, which paces the cell, hands them states and
frames, and publishes what no real cell knows: `sim/truth` of each sensor and the surfaces of all bodies, and
what the force sensors measure that a scene says there are (`force_sensor`), once an exposure. A
sensor of fidelity "ideal" takes no images: its estimate and contact presence are published in place of the
estimator's.

Stamps are ROS time at the scene's rate. When the machine cannot hold the rate, time is caught up: up to
`longest_lag` behind every step is made, beyond that exposures are left out, counted and told in /diagnostics.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, Vector3, WrenchStamped
from rclpy.parameter import Parameter
from std_msgs.msg import Bool, ColorRGBA
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from tactile_base import topics
from tactile_base.settings import LARGEST_SEED, Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_doubles.rehearsal import DOUBLES, Double, FollowedArm, doubled, rehearsed
from tactile_doubles.reported import ReportedDouble
from tactile_drivers.arm_distance import neighbours
from tactile_msgs.msg import ContactPresence, ContactTruth
from tactile_records.messages import truth_bytes
from tactile_ros.conversions import pose_from_matrix, transform_stamped
from tactile_ros.latency import LatencyPublisher
from tactile_ros.managed_node import ConfigurationError, ManagedNode
from tactile_ros.message_bytes import Layout, headed_bytes, transforms_from_bytes
from tactile_ros.nodes.arm_node import ArmNode
from tactile_ros.nodes.camera_node import CameraNode
from tactile_ros.parameters import SettingsParameters
from tactile_ros.qos import FORCE, LATCHED, STATE, TF
from tactile_ros.run_nodes import run
from tactile_scene.arm import ArmState
from tactile_scene.camera import CameraFrame
from tactile_scene.motions import FIXED
from tactile_scene.scene import SIM, Scene
from tactile_scene.scene_file import load_scene
from tactile_sim.cell import Cell
from tactile_sim.force_sensor import ForceSensor
from tactile_sim.frame import Frame
from tactile_wire.packing import gaussian_bytes, split_stamp
from tactile_wire.pose_numbers import numbers_from_pose, pose_from_numbers

START_DELAY = 0.1  # s
SURFACE_COLOR = ColorRGBA(r=0.72, g=0.74, b=0.78, a=1.0)
JUMP = 1.0  # s; a step that lies further ahead means that the clock was set back


@dataclass(frozen=True)
class SimSettings(Settings):
    """What is simulated, and how it keeps up with real time."""

    scene: str = setting("ramp", doc="scene: the name of a packaged one, or the path of a .yaml file")
    seed: int = setting(0, lower=0, upper=LARGEST_SEED, doc="seed of all noise in the cell")
    camera_rate: float = setting(
        0.0, lower=0.0, upper=240.0, unit="Hz", doc="rate of all simulated cameras; 0: as the scene says"
    )
    status_rate: float = setting(
        30.0, lower=1.0, upper=1000.0, unit="Hz", doc="rate of arm/pose, arm/status and command/twist_limited"
    )
    rehearse: bool = setting(
        False, doc="whether arms with real drivers have doubles here, and their sensors simulated cameras"
    )
    feels: bool = setting(True, doc="whether filters tell what the sensors feel; see the parameter of arm")
    longest_lag: float = setting(
        0.05, lower=0.001, upper=10.0, unit="s", doc="further behind real time, exposures are left out"
    )
    head_start: float = setting(
        0.0045, lower=0.0, upper=0.05, unit="s",
        doc="a step is computed this long before its time, so that what a simulation costs does not count as "
        "latency; nothing is published before its time, and commands that arrive in between wait a step",
    )  # fmt: skip


class SensorOutlet:
    """What the cell knows of one simulated sensor: the truth, and the estimate of one without a camera."""

    def __init__(self, node: SimNode, arm: str, camera: CameraNode | None) -> None:
        self.base, self.frame = topics.base_frame(arm), topics.sensor_frame(arm)
        self.arm, self.camera, self.lost = arm, camera, 0
        self._node = node
        self.truth = node.publisher(ContactTruth, topics.TRUTH.of(arm).name, STATE)
        if arm in node.force_sensors:
            self.force = node.publisher(WrenchStamped, topics.FORCE_SENSOR.of(arm).name, FORCE)
        if camera is None:
            self._presence = node.publisher(ContactPresence, topics.PRESENCE.of(arm).name, STATE)
            self._estimate = node.publisher(PoseWithCovarianceStamped, topics.ESTIMATE.of(arm).name, STATE)
            self._latency = LatencyPublisher(node, "camera", self.frame, topics.LATENCY.of(arm).name)

    def publish(self, frame: Frame) -> None:
        """What the sensor gives, and the force sensor behind it."""
        if self.arm in self._node.force_sensors:
            measured = self._node.force_sensors[self.arm].measured(frame).tolist()
            self.force.publish(
                headed_bytes(WrenchStamped, frame.stamp_ns, self.frame, *measured, 0.0, 0.0, 0.0)
            )
        if self.camera is None:
            self._publish_ideal(frame)
        elif frame.image is not None:
            self.camera.take_frame(CameraFrame(frame.stamp_ns, frame.image, self.lost))

    def _publish_ideal(self, frame: Frame) -> None:
        in_contact = frame.estimate is not None
        numbers = float(in_contact), 0.5, in_contact, False, math.nan
        self._presence.publish(headed_bytes(ContactPresence, frame.stamp_ns, self.frame, *numbers))
        if frame.estimate is not None:
            mean, cov = frame.estimate.mean, frame.estimate.cov
            self._estimate.publish(gaussian_bytes(frame.stamp_ns, self.frame, mean, cov))
        self._latency.note(frame.stamp_ns, frame.stamp_ns, self._node.now_ns(), self.lost)


class SimNode(ManagedNode):
    """See the module's text; the simulation is `Cell`."""

    cell: Cell

    def __init__(self) -> None:
        super().__init__("sim")
        fixed = ("scene", "seed", "camera_rate", "status_rate", "rehearse", "feels")
        self.settings = SettingsParameters(self, SimSettings(), read_only=fixed)
        try:
            scene = load_scene(self.settings.value.scene)
            scene = rehearsed(scene) if self.settings.value.rehearse else scene
            self.scene = with_camera_rate(scene, self.settings.value.camera_rate)
        except (ValueError, OSError) as error:
            raise ConfigurationError(str(error)) from error
        self.doubles: dict[str, Double] = {}
        self.reported: list[ReportedDouble] = []
        arms = self.scene.arms.items()
        self.arms = {name: self._hosted(ArmNode, arm, name) for name, arm in arms if arm.driver == SIM}
        exposed = [name for name, arm in arms if arm.simulated_sensor and self.scene.gives_images(name)]
        self.cameras = {name: self._hosted(CameraNode, True, name) for name in exposed}

    def _hosted(self, kind: Any, hosted: Any, arm: str) -> Any:
        """A node of this process; names given on the command line are this node's alone."""
        names = ("use_sim_time", "autostart", "diagnostics_period")
        passed = {name: self.get_parameter(name).value for name in names}
        if kind is ArmNode:
            passed |= {name: getattr(self.settings.value, name) for name in ("status_rate", "feels")}
        overrides = [Parameter(name, value=value) for name, value in passed.items()]
        return kind(hosted, namespace=f"/{arm}", use_global_arguments=False, parameter_overrides=overrides)

    def nodes(self) -> list[ManagedNode]:
        """All nodes of the process; this one starts last, so that the others are there when time begins."""
        return [*self.arms.values(), *self.cameras.values(), self]

    def configure(self) -> None:
        """Build the cell once (the skin is cached) and open the topics."""
        try:
            for name, arm in self.scene.arms.items():
                if self.settings.value.rehearse and doubled(arm):
                    self.doubles[name] = DOUBLES.load(arm.driver)(arm)
            self._follow_reported()
            self._start_cell()
        except (ValueError, OSError) as error:
            raise ConfigurationError(str(error)) from error
        self.report.values["scene"] = str(self.scene.path)
        simulated = [name for name in self.cell.arms if self.scene.arms[name].simulated_sensor]
        self.outlets = [SensorOutlet(self, name, self.cameras.get(name)) for name in simulated]
        self.loose = [name for name in self.scene.bodies if not _frame_of(self.scene, name)]
        self.tf_out = self.publisher(TFMessage, topics.TF.name, TF)
        moving = [node.moving_transform() for node in self.arms.values()]
        frames = map(topics.body_frame, self.loose)
        moving += [transform_stamped(0, topics.WORLD, frame, np.eye(4)) for frame in frames]
        self.tf_layout = Layout(TFMessage(transforms=moving))
        self.markers_out = self.publisher(MarkerArray, topics.SIM_MARKERS.name, LATCHED)

    def _follow_reported(self) -> None:
        """Tell doubles that stand where drivers say what these say, and stop arms for them."""
        reported = {
            (topics.base_frame(name), topics.tool_frame(name)): double
            for name, double in self.doubles.items()
            if isinstance(double, ReportedDouble)
        }
        self.reported = list(reported.values())
        if not reported:
            return

        def take(data: bytes) -> None:
            for told in transforms_from_bytes(data):
                double = reported.get((told.parent, told.child))
                if double is not None:
                    T = pose_from_numbers((*told.translation, *told.rotation))
                    double.take(told.stamp_ns, T)

        self.subscribe(TFMessage, topics.TF.name, take, TF, always=True, raw=True)
        self.estop_out = self.publisher(Bool, topics.ESTOP.name, STATE)

    def activate(self) -> None:
        """The cell starts anew, as soon as everything else has been made ready."""
        self._start_cell(self.now_ns() + round(START_DELAY * SECOND_NS))
        for name, node in self.arms.items():
            node.attach(self.cell.arm(name))
            node.safe.neighbours = neighbours(self.scene, name, self.cell.status, self.cell.arms)
        for outlet in self.outlets:
            outlet.lost = 0
        self.markers_out.publish(MarkerArray(markers=body_markers(self.scene)))

    def cleanup(self) -> None:
        """End the doubles."""
        for double in self.doubles.values():
            double.close()
        self.doubles.clear()
        self.reported.clear()

    def _start_cell(self, stamp_ns: int = 0) -> None:
        arms, doubles = self.scene.arms, self.doubles.items()
        followed = {name: FollowedArm(arms[name], double, stamp_ns) for name, double in doubles}
        seed = self.settings.value.seed
        self.cell = Cell(self.scene, seed, stamp_ns, followed=followed)
        self.force_sensors = {
            name: ForceSensor(seed, arm.T_world_base)
            for name, arm in arms.items()
            if arm.sensor is not None and arm.sensor.settings.force_sensor and self.scene.gives_images(name)
        }  # of what gives no images no force is modelled

    def due_in(self) -> float:
        """Seconds until the next step is to be computed."""
        if not self.active:
            return math.inf
        lead = self._lead_of_next_step()
        jumped = lead > START_DELAY + JUMP
        return 0.0 if jumped else lead - self.settings.value.head_start

    def work(self) -> None:
        """Make the step that is due."""
        lead = self._lead_of_next_step()
        if lead > START_DELAY + JUMP:
            self.warn("jump", f"time jumped back by {lead:.3f} s: the cell starts anew")
            self.count("backward time jumps")
            self.activate()
        else:
            self._step(in_time=-lead <= self.settings.value.longest_lag)

    def _lead_of_next_step(self) -> float:
        """Seconds from now to the stamp of the next step."""
        next_ns = self.cell.stamp_ns + SECOND_NS // self.scene.simulation.rate
        return (next_ns - self.now_ns()) / SECOND_NS

    def _step(self, in_time: bool) -> None:
        """One step of all arms, published at its time: images first, since all else waits for them."""
        stamp_ns = self.cell.step()
        raw = [(node, self.cell.status(name)) for name, node in self.arms.items()]
        states = [(node, node.checked(state) or state) for node, state in raw]
        frames = []
        for outlet in self.outlets:
            if self.cell.exposure_due(outlet.arm) and self._in_time(outlet, in_time):
                frames.append((outlet, self.cell.expose(outlet.arm)))
        for double in self.reported:
            if double.stop_asked:
                self.estop_out.publish(Bool(data=True))
                double.stop_asked = False
                self.warn("deep", "as after a collision, the cell stops the arm: too deep in a surface")
        time.sleep(max(0.0, (stamp_ns - self.now_ns()) / SECOND_NS))
        for outlet, frame in frames:
            outlet.publish(frame)
        self._publish_transforms(stamp_ns, states)
        for outlet, frame in frames:
            outlet.truth.publish(truth_bytes(frame, outlet.base))
        for node, state in states:
            node.publish_status(state)

    def _publish_transforms(self, stamp_ns: int, states: list[tuple[ArmNode, ArmState]]) -> None:
        """Where all tools are, and the bodies that a motion model moves."""
        numbers = [number for node, state in states for number in node.transform_numbers(state)]
        for name in self.loose:
            numbers += [*split_stamp(stamp_ns), *numbers_from_pose(self.cell.T_world_body(name)).tolist()]
        if numbers:  # doubles have arm nodes of their own
            self.tf_out.publish(self.tf_layout.pack(*numbers))

    def _in_time(self, outlet: SensorOutlet, in_time: bool) -> bool:
        """Whether there is time for an exposure; else it is left out, counted and told."""
        if in_time:
            self.count(f"{outlet.arm} exposures")
            return True
        outlet.lost += 1
        self.count(f"{outlet.arm} exposures left out")
        limit = self.settings.value.longest_lag
        self.warn(
            "rate",
            f"cannot hold {self.scene.simulation.rate} steps a second: more than {limit * 1e3:.0f} ms behind "
            f"real time, {outlet.lost} exposures of {outlet.arm} left out so far; the machine is busy or too "
            "slow: end what else runs (`top`), or launch with a lower --rate",
        )
        return False


def _frame_of(scene: Scene, body: str) -> str:
    """The frame that a body stands still in; empty if a motion model moves it."""
    described = scene.bodies[body]
    if described.carried_by:
        return topics.tool_frame(described.carried_by)
    return topics.WORLD if described.motion == FIXED else ""


def body_markers(scene: Scene) -> list[Marker]:
    """The true surfaces of all bodies, for RViz, each in the frame that it moves with."""
    markers = []
    for number, (name, body) in enumerate(scene.bodies.items()):
        frame = _frame_of(scene, name)
        frame, T = (frame, body.T_parent_body) if frame else (topics.body_frame(name), np.eye(4))
        marker = Marker(ns=name, id=number, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
        marker.header.frame_id, marker.frame_locked = frame, frame != topics.WORLD
        marker.pose, marker.scale = pose_from_matrix(T), Vector3(x=1.0, y=1.0, z=1.0)
        marker.color = SURFACE_COLOR
        vertices, faces = body.make().mesh()
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in vertices[faces.ravel()].tolist()]
        markers.append(marker)
    return markers


def with_camera_rate(scene: Scene, camera_rate: float) -> Scene:
    """The scene with this rate (Hz) for all simulated cameras, and steps that it divides; 0: as it is.

    Raises
    ------
    ValueError
        If no number of steps up to 1000 a second is a multiple of the rate.
    """
    if camera_rate == 0.0:
        return scene
    rate = scene.simulation.rate
    multiples = (n for n in range(rate, 1001) if math.isclose(n / camera_rate, round(n / camera_rate)))
    steps = next(multiples, 0)
    if camera_rate > steps:
        raise ValueError(
            f"camera_rate = {camera_rate:g} Hz: no whole number of steps a second is a multiple of it"
        )
    arms = dict(scene.arms)
    for name, arm in scene.arms.items():
        if arm.sensor is not None and arm.simulated_sensor:
            settings = arm.sensor.settings.replaced(camera_rate=camera_rate)
            arms[name] = dataclasses.replace(arm, sensor=dataclasses.replace(arm.sensor, settings=settings))
    simulation = dataclasses.replace(scene.simulation, rate=steps)
    return dataclasses.replace(scene, arms=arms, simulation=simulation)


def main() -> int:
    """Run the nodes until a signal; returns the exit code."""
    return run(lambda: SimNode().nodes())


if __name__ == "__main__":
    sys.exit(main())
