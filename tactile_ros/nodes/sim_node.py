"""Sim node: the simulated cell of a scene in real time, with all its arms, sensors and surfaces.

For each arm it publishes what a real arm and camera would: /tf at the arm's rate and thereby at every
exposure, `arm/pose`, `arm/status`, `command/twist_limited`, `tactile/image`; and `sim/truth`, which no real
one knows. It listens to `command/twist`. A sensor of fidelity "ideal" takes no images: its estimate and
contact presence are published in place of the estimator's.

Stamps are ROS time at the scene's rate. When the machine cannot hold the rate, time is caught up: up to
`longest_lag` behind every step is made, beyond that exposures are left out, counted and told in /diagnostics.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TwistStamped
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_drivers.scene import ArmScene, Scene, load_scene
from tactile_drivers.sim.cell import Cell, Frame
from tactile_filter import se3
from tactile_msgs.msg import ArmStatus, ContactPresence, ContactTruth
from tactile_ros.cdr import Layout, split_stamp
from tactile_ros.conversions import numbers_from_pose, transform_stamped
from tactile_ros.image_bytes import bytes_from_array
from tactile_ros.latency import LatencyPublisher
from tactile_ros.managed_node import ConfigurationError, ManagedNode, run
from tactile_ros.markers import mesh_marker
from tactile_ros.parameters import SettingsParameters
from tactile_ros.qos import COMMAND, IMAGE, LATCHED, STATE, TF, TF_STATIC
from tactile_ros.wire import gaussian_bytes, headed_bytes, read_twist, twist_bytes

WORLD = "world"
START_DELAY = 0.1  # s
JUMP = 1.0  # s; a step that lies further ahead means that the clock was set back


@dataclass(frozen=True)
class SimSettings(Settings):
    """What is simulated, and how it keeps up with real time."""

    scene: str = setting("ramp", doc="scene: the name of a packaged one, or the path of a .yaml file")
    seed: int = setting(0, lower=0, doc="seed of all noise in the cell")
    camera_rate: float = setting(
        0.0, lower=0.0, upper=240.0, unit="Hz", doc="rate of all cameras; 0: as the scene says"
    )
    status_rate: float = setting(
        30.0, lower=1.0, upper=1000.0, unit="Hz", doc="rate of arm/pose, arm/status and command/twist_limited"
    )
    longest_lag: float = setting(
        0.05, lower=0.001, upper=10.0, unit="s", doc="further behind real time, exposures are left out"
    )
    head_start: float = setting(
        0.0045,
        lower=0.0,
        upper=0.05,
        unit="s",
        doc="a step is computed this long before its time, so that what a simulation costs does not count as "
        "latency; nothing is published before its time, and commands that arrive in between wait a step",
    )


class ArmTopics:
    """The publishers and the subscription of one arm, and the conversions that they need."""

    def __init__(self, node: SimNode, scene: ArmScene) -> None:
        self.name = scene.name
        self.frames = tuple(f"{scene.name}/{part}" for part in ("base", "tool", "tactile_sensor"))
        self.base, self.tool, self.sensor = self.frames
        self.T_world_base = scene.T_world_base
        self.T_tool_sensor = scene.T_tool_sensor
        self.T_sensor_tool = se3.inverse(scene.T_tool_sensor)
        self.lost = 0
        self._node = node
        self._pose = node.publisher(PoseStamped, f"/{self.name}/arm/pose", STATE)
        self._status = node.publisher(ArmStatus, f"/{self.name}/arm/status", STATE)
        self._limited = node.publisher(TwistStamped, f"/{self.name}/command/twist_limited", STATE)
        node.subscribe(TwistStamped, f"/{self.name}/command/twist", self._receive, COMMAND, 0.0, raw=True)
        if scene.sensor is not None:
            self._open_sensor(images=scene.sensor.settings.fidelity == "image")

    def _open_sensor(self, images: bool) -> None:
        node = self._node
        self._truth = node.publisher(ContactTruth, f"/{self.name}/sim/truth", STATE)
        self._latency = LatencyPublisher(node, "camera", self.sensor, f"/{self.name}/latency")
        if images:
            self._image = node.publisher(Image, f"/{self.name}/tactile/image", IMAGE)
            return
        self._presence = node.publisher(ContactPresence, f"/{self.name}/contact/presence", STATE)
        self._estimate = node.publisher(PoseWithCovarianceStamped, f"/{self.name}/contact/estimate", STATE)

    def _receive(self, data: bytes) -> None:
        """Hand a command to the arm; one in another frame than the sensor's would move it wrongly."""
        cell, (stamp_ns, frame_id, twist) = self._node.cell, read_twist(data)
        if frame_id != self.sensor:
            reason = f"frame is '{frame_id}', must be '{self.sensor}'"
        elif cell.command(self.name, stamp_ns, np.array(twist)):
            return
        else:
            reason = cell.status(self.name).last_refusal
        self._node.count(f"{self.name} commands refused")
        self._node.warn(f"{self.name} command", f"{self.name}: command/twist refused: {reason}")

    def static_transforms(self) -> list[Any]:
        """What never moves: the base in the world, the sensor on the tool."""
        return [
            transform_stamped(0, WORLD, self.base, self.T_world_base),
            transform_stamped(0, self.tool, self.sensor, self.T_tool_sensor),
        ]

    def transform(self, stamp_ns: int, T_base_sensor: NDArray[np.float64]) -> tuple[float, ...]:
        """Where the tool is: the numbers of a TransformStamped."""
        return *split_stamp(stamp_ns), *numbers_from_pose(T_base_sensor @ self.T_sensor_tool).tolist()

    def publish_status(self, T_base_sensor: NDArray[np.float64]) -> None:
        """Where the sensor is in the base, what the arm does, and the twist that it makes of its commands."""
        status = self._node.cell.status(self.name)
        stamp_ns, numbers = status.stamp_ns, numbers_from_pose(T_base_sensor).tolist()
        self._pose.publish(headed_bytes(PoseStamped, stamp_ns, self.base, *numbers))
        self._limited.publish(twist_bytes(stamp_ns, self.sensor, status.twist))
        numbers = int(status.mode), status.command_age, status.limited, *status.twist.tolist()
        layout = _status_layout(self.base, status.reason)
        self._status.publish(layout.pack(*split_stamp(stamp_ns), *numbers))

    def publish_frame(self, frame: Frame) -> int:
        """What the sensor gives; returns when it went out, ns."""
        if frame.image is not None:
            self._image.publish(bytes_from_array(frame.stamp_ns, self.sensor, frame.image))
        else:
            self._publish_ideal(frame)
        return self._node.now_ns()

    def publish_truth(self, frame: Frame, emitted_ns: int) -> None:
        """What no real cell knows: the true contact, and how long the exposure took to be published."""
        self._truth.publish(truth_bytes(frame, self.base))
        self._latency.note(frame.stamp_ns, frame.stamp_ns, emitted_ns, self.lost)

    def _publish_ideal(self, frame: Frame) -> None:
        in_contact = frame.estimate is not None
        numbers = float(in_contact), 0.5, in_contact
        self._presence.publish(headed_bytes(ContactPresence, frame.stamp_ns, self.sensor, *numbers))
        if frame.estimate is not None:
            mean, cov = frame.estimate.mean, frame.estimate.cov
            self._estimate.publish(gaussian_bytes(frame.stamp_ns, self.sensor, mean, cov))


class SimNode(ManagedNode):
    """See the module's text; the simulation is `Cell`."""

    cell: Cell

    def __init__(self) -> None:
        super().__init__("sim")
        self.settings = SettingsParameters(
            self, SimSettings(), read_only=("scene", "seed", "camera_rate", "status_rate")
        )

    def configure(self) -> None:
        """Read the scene, build the cell once (the skin is cached) and open the topics."""
        settings = self.settings.value
        try:
            self.scene = with_camera_rate(load_scene(settings.scene), settings.camera_rate)
            self.cell = Cell(self.scene, settings.seed)
        except (ValueError, OSError) as error:
            raise ConfigurationError(str(error)) from error
        self.report.values["scene"] = str(self.scene.path)
        self.arms = [ArmTopics(self, self.scene.arms[name]) for name in self.cell.arms]
        self.tf_out = self.publisher(TFMessage, "/tf", TF)
        moving = [transform_stamped(0, arm.base, arm.tool, np.eye(4)) for arm in self.arms]
        self.tf_layout = Layout(TFMessage(transforms=moving))
        self.tf_static_out = self.publisher(TFMessage, "/tf_static", TF_STATIC)
        self.markers_out = self.publisher(MarkerArray, "/sim/markers", LATCHED)
        self.status_every = max(1, round(self.scene.rate / settings.status_rate))

    def activate(self) -> None:
        """The cell starts anew, as soon as everything else has been made ready."""
        self.cell = Cell(self.scene, self.settings.value.seed, self.now_ns() + round(START_DELAY * SECOND_NS))
        self.steps = 0
        for arm in self.arms:
            arm.lost = 0
        self.tf_static_out.publish(
            TFMessage(transforms=[t for arm in self.arms for t in arm.static_transforms()])
        )
        self.markers_out.publish(MarkerArray(markers=surface_markers(self.scene)))

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
            self._restart(f"time jumped back by {lead:.3f} s")
        else:
            self._step(in_time=-lead <= self.settings.value.longest_lag)

    def _lead_of_next_step(self) -> float:
        """Seconds from now to the stamp of the next step."""
        next_ns = self.cell.stamp_ns + SECOND_NS // self.scene.rate
        return (next_ns - self.now_ns()) / SECOND_NS

    def _wait_until(self, stamp_ns: int) -> None:
        lead = (stamp_ns - self.now_ns()) / SECOND_NS
        if lead > 0.0:
            time.sleep(lead)

    def _restart(self, reason: str) -> None:
        self.warn("jump", f"{reason}: the cell starts anew")
        self.count("backward time jumps")
        self.activate()

    def _step(self, in_time: bool) -> None:
        """One step of all arms, published at its time: images first, since all else waits for them."""
        stamp_ns = self.cell.step()
        self.steps += 1
        poses = [self.cell.T_base_sensor(arm.name) for arm in self.arms]
        frames = [
            self._expose(arm, in_time) if self.cell.exposure_due(arm.name) else None for arm in self.arms
        ]
        self._wait_until(stamp_ns)
        sent_ns = [
            0 if frame is None else arm.publish_frame(frame)
            for arm, frame in zip(self.arms, frames, strict=True)
        ]
        transforms = (arm.transform(stamp_ns, T) for arm, T in zip(self.arms, poses, strict=True))
        self.tf_out.publish(self.tf_layout.pack(*itertools.chain.from_iterable(transforms)))
        for arm, frame, emitted_ns in zip(self.arms, frames, sent_ns, strict=True):
            if frame is not None:
                arm.publish_truth(frame, emitted_ns)
        if self.steps % self.status_every == 0:
            for arm, T in zip(self.arms, poses, strict=True):
                arm.publish_status(T)

    def _expose(self, arm: ArmTopics, in_time: bool) -> Frame | None:
        """The frame of an exposure; None if there was no time for it."""
        if in_time:
            self.count(f"{arm.name} exposures")
            return self.cell.expose(arm.name)
        arm.lost += 1
        self.count(f"{arm.name} exposures left out")
        limit = self.settings.value.longest_lag
        self.warn(
            "rate",
            f"cannot hold {self.scene.rate} steps a second: more than {limit * 1e3:.0f} ms behind real time, "
            f"{arm.lost} exposures of {arm.name} left out so far",
        )
        return None


def surface_markers(scene: Scene) -> list[Any]:
    """The true surfaces, for RViz."""
    return [
        mesh_marker(WORLD, name, number, surface.T_world_surface, *surface.make().mesh())
        for number, (name, surface) in enumerate(scene.surfaces.items())
    ]


def with_camera_rate(scene: Scene, camera_rate: float) -> Scene:
    """The scene with this rate (Hz) for all cameras, and steps that it divides; 0 leaves it as it is.

    Raises
    ------
    ValueError
        If no number of steps up to 1000 a second is a multiple of the rate.
    """
    if camera_rate == 0.0:
        return scene
    steps = next(
        (n for n in range(scene.rate, 1001) if math.isclose(n / camera_rate, round(n / camera_rate))), None
    )
    if steps is None or camera_rate > steps:
        raise ValueError(
            f"camera_rate = {camera_rate:g} Hz: no whole number of steps a second is a multiple of it"
        )
    arms = {
        name: arm
        if arm.sensor is None
        else dataclasses.replace(
            arm,
            sensor=dataclasses.replace(
                arm.sensor, settings=arm.sensor.settings.replaced(camera_rate=camera_rate)
            ),
        )
        for name, arm in scene.arms.items()
    }
    return dataclasses.replace(scene, rate=steps, arms=arms)


def truth_bytes(frame: Frame, base_frame: str) -> bytes:
    """ContactTruth message of a frame."""
    truth = frame.truth
    valid = bool(np.isfinite(truth.T_fs).all())
    return headed_bytes(
        ContactTruth,
        frame.stamp_ns,
        base_frame,
        truth.in_contact,
        truth.depth,
        truth.normal_angle,
        *(se3.euler_from_pose(truth.T_fs) if valid else np.full(6, np.nan)).tolist(),
        *np.asarray(truth.shear).tolist(),
        truth.slip_fraction,
        truth.normal_force,
        *numbers_from_pose(frame.T_base_sensor).tolist(),
        *truth.point.tolist(),
        *truth.normal.tolist(),
    )


@functools.lru_cache(maxsize=32)
def _status_layout(frame_id: str, reason: str) -> Layout:
    example = ArmStatus(reason=reason)
    example.header.frame_id = frame_id
    return Layout(example)


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(SimNode)


if __name__ == "__main__":
    sys.exit(main())
