"""Camera node: the camera of one arm's tactile sensor on ROS, whoever exposes it.

Publishes `tactile/image`, stamped with the time of exposure, and the latency of the stage "camera". A driver
of the registry `CAMERAS` is opened here, in a process of its own; the frames of a simulated sensor come from
the process of the simulated cell, which runs this node beside its own.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

from sensor_msgs.msg import Image

from tactile_base.raised import defined_in
from tactile_base.settings import Settings, setting
from tactile_base.topics import IMAGE as IMAGE_TOPIC
from tactile_records.messages import bytes_from_array
from tactile_ros.latency import LatencyPublisher
from tactile_ros.managed_node import ConfigurationError, ManagedNode
from tactile_ros.nodes.arm_node import arm_of_scene
from tactile_ros.parameters import SettingsParameters
from tactile_ros.qos import IMAGE
from tactile_ros.run_nodes import run
from tactile_scene.camera import CAMERAS, Camera, CameraFrame, CameraStatus, open_camera
from tactile_scene.scene import EXTERNAL, SIM, ArmScene
from tactile_wire.errors import MessageError

STATUS_PERIOD = 0.1  # s


@dataclass(frozen=True)
class CameraNodeSettings(Settings):
    """Which scene the camera's sensor stands in."""

    scene: str = setting("", doc="scene: the name of a packaged one, or the path of a .yaml file")
    frame_timeout: float = setting(
        0.5, lower=0.01, upper=60.0, unit="s", doc="silence of the camera that is told in /diagnostics"
    )


class CameraNode(ManagedNode):
    """See the module's text; with `hosted` another node of the process calls `take_frame`."""

    def __init__(self, hosted: bool = False, **kwargs: Any) -> None:
        super().__init__("camera", **kwargs)
        self.settings = SettingsParameters(self, CameraNodeSettings(), read_only=("scene",))
        self.hosted, self.whose = hosted, ""
        self.camera: Camera | None = None

    def configure(self) -> None:
        """Open topics and, unless another node gives the frames, the driver."""
        self.image_out = self.publisher(Image, IMAGE_TOPIC.name, IMAGE)
        self.latency = LatencyPublisher(self, "camera", self.sensor_frame)
        self.frames = self.report.watch("frames of the camera", self.settings.value.frame_timeout)
        self.status = CameraStatus()
        if self.hosted:
            return
        arm = self._scene()
        assert arm.sensor is not None
        self.whose = f" (camera driver '{arm.sensor.camera}', {defined_in(CAMERAS.load(arm.sensor.camera))})"
        try:
            self.camera = open_camera(arm, self.take_frame)
        except (OSError, RuntimeError) as error:
            raise ConfigurationError(f"camera of '{arm.name}': {error}") from error
        self.timer(STATUS_PERIOD, self._tell_status)

    def cleanup(self) -> None:
        """Let go of the camera."""
        if self.camera is not None:
            self.camera.close()
        self.camera = None

    def take_frame(self, frame: CameraFrame) -> None:
        """Publish a frame; a driver may call this from its own thread."""
        self.frames.seen()
        if not self.active:
            return
        try:
            if not isinstance(frame, CameraFrame):
                raise MessageError(f"is a {type(frame).__name__}, must be a CameraFrame")
            data = bytes_from_array(frame.stamp_ns, self.sensor_frame, frame.image)
        except MessageError as error:
            self.count("frames refused")
            self.warn("frame", f"{self.arm}: frame of the camera refused: {error}{self.whose}")
            return
        self.image_out.publish(data)
        self.count("frames")
        self.latency.note(frame.stamp_ns, frame.stamp_ns, self.now_ns(), frame.lost)

    def _tell_status(self) -> None:
        """Tell what the driver says of itself: values and faults in /diagnostics, what is new in the log."""
        before, self.status = self.status, getattr(self.camera, "status", CameraStatus())
        self.report.values |= self.status.values
        for remark in self.status.remarks:
            self.report.complain(remark, remark)
            if remark not in before.remarks:
                self.get_logger().warning(f"camera of '{self.arm}': {remark}")
        if self.status.fault:
            self.warn("camera", self.status.fault, period=5.0)
        elif before.fault:
            self.get_logger().info(f"camera of '{self.arm}': frames come again")

    def _scene(self) -> ArmScene:
        """The arm in the scene, whose sensor needs a camera driver of the registry."""
        arm, scene = arm_of_scene(self, self.settings.value.scene)
        file = scene.path
        if arm.sensor is None:
            raise ConfigurationError(f"{file}: arm '{arm.name}' has no sensor")
        who = {SIM: "is that of the simulated cell (sim_node)", EXTERNAL: "has a driver that runs already"}
        if arm.sensor.camera in who:
            raise ConfigurationError(f"{file}: the camera of '{arm.name}' {who[arm.sensor.camera]}")
        return arm


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(CameraNode)


if __name__ == "__main__":
    sys.exit(main())
