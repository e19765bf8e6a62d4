"""Arm node: one arm of a scene on ROS, whoever drives it.

Publishes /tf from base to tool at every state of the driver, `arm/pose`, `arm/status` and
`command/twist_limited`; listens to `command/twist`, in the arm's controlled frame. A driver of the registry
`ARMS` is opened here, in a process of its own. A simulated arm is given by the process of the simulated cell,
which runs this node beside its own (`attach`) and publishes /tf of all its arms in one message: that every
node takes every message of /tf is most of what a second arm costs them.

The arm is stopped when commands stop coming, when the driver reports no state any more, and when the node is
deactivated.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped, TwistStamped
from numpy.typing import NDArray
from tf2_msgs.msg import TFMessage

from tactile_base import topics
from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_drivers.arm import Arm, ArmMode, ArmState, open_arm
from tactile_drivers.scene import EXTERNAL, SIM, ArmScene, load_scene
from tactile_filter import se3
from tactile_msgs.msg import ArmStatus
from tactile_ros.cdr import Layout, headed_bytes, read_twist, split_stamp, twist_bytes
from tactile_ros.conversions import numbers_from_pose, transform_stamped
from tactile_ros.managed_node import ConfigurationError, ManagedNode, run
from tactile_ros.parameters import SettingsParameters
from tactile_ros.qos import COMMAND, STATE, TF, TF_STATIC


@dataclass(frozen=True)
class ArmNodeSettings(Settings):
    """Which scene the arm stands in, and what is told of it."""

    scene: str = setting("", doc="scene: the name of a packaged one, or the path of a .yaml file")
    status_rate: float = setting(
        30.0, lower=1.0, upper=1000.0, unit="Hz", doc="rate of arm/pose, arm/status and command/twist_limited"
    )
    state_timeout: float = setting(
        0.25, lower=0.01, upper=10.0, unit="s", doc="silence of the driver at which the arm is stopped"
    )


def arm_of_scene(node: ManagedNode, scene: str) -> tuple[ArmScene, Path]:
    """The node's arm in a scene, and the scene's file; raises `ConfigurationError` if it is not there."""
    loaded = load_scene(scene)
    if node.arm not in loaded.arms:
        raise ConfigurationError(f"{loaded.path}: no arm '{node.arm}'; arms: {', '.join(loaded.arms)}")
    return loaded.arms[node.arm], loaded.path


class ArmNode(ManagedNode):
    """See the module's text; `hosted` is the arm's scene where another node of the process drives it."""

    def __init__(self, hosted: ArmScene | None = None, **kwargs: Any) -> None:
        super().__init__("arm", **kwargs)
        self.settings = SettingsParameters(self, ArmNodeSettings(), read_only=("scene", "status_rate"))
        self.hosted = hosted
        self.driver: Arm | None = None

    # ---- lifecycle ----

    def configure(self) -> None:
        """Open topics and, unless another node does, the driver."""
        scene = self.hosted or self._scene()
        self.frame = f"{self.arm}/{scene.controlled_frame}"
        self.tool_frame = topics.tool_frame(self.arm)
        self.limits = scene.limits
        self.T_controlled_tool = se3.inverse(scene.T_tool_controlled)
        self.static = [transform_stamped(0, topics.WORLD, self.base_frame, scene.T_world_base)]
        if scene.sensor is not None:
            self.static.append(transform_stamped(0, self.tool_frame, self.frame, scene.T_tool_controlled))
        self.tf_static_out = self.publisher(TFMessage, topics.TF_STATIC.name, TF_STATIC)
        self.pose_out = self.publisher(PoseStamped, topics.ARM_POSE.name, STATE)
        self.status_out = self.publisher(ArmStatus, topics.ARM_STATUS.name, STATE)
        self.limited_out = self.publisher(TwistStamped, topics.LIMITED_COMMAND.name, STATE)
        self.subscribe(TwistStamped, topics.COMMAND.name, self._receive, COMMAND, 0.0, raw=True)
        self.states = self.report.watch("states of the driver", self.settings.value.state_timeout)
        self._forget()
        if self.hosted is None:
            self.tf_out = self.publisher(TFMessage, topics.TF.name, TF)
            self.tf_layout = Layout(TFMessage(transforms=[self.moving_transform()]))
            self.timer(scene.limits.command_timeout / 4, self._watch)
            try:
                self.driver = open_arm(scene, self.take_state)
            except (OSError, RuntimeError) as error:
                raise ConfigurationError(f"arm driver '{scene.driver}': {error}") from error
        else:  # a simulated arm watches its commands itself, and every timer costs the cell time
            self.timer(self.settings.value.state_timeout / 2, self._watch)

    def activate(self) -> None:
        """Tell what never moves; commands are followed from now on."""
        self._forget()
        self.tf_static_out.publish(TFMessage(transforms=self.static))

    def deactivate(self) -> None:
        """Bring the arm to rest."""
        if self.driver is not None:
            self.driver.stop("the arm's node was deactivated")

    def cleanup(self) -> None:
        """Let go of an arm that was opened here."""
        if self.driver is not None and self.hosted is None:
            self.driver.close()
        self.driver = None

    def attach(self, driver: Arm) -> None:
        """Drive this arm from now on; whoever gives it calls `take_state` with its states."""
        self.driver = driver
        self._forget()

    def _scene(self) -> ArmScene:
        """The arm in the scene, which needs a driver of the registry."""
        arm, file = arm_of_scene(self, self.settings.value.scene)
        who = {SIM: "is moved by the simulated cell (sim_node)", EXTERNAL: "has a driver that runs already"}
        if arm.driver in who:
            raise ConfigurationError(f"{file}: arm '{arm.name}' {who[arm.driver]}")
        return arm

    def _forget(self) -> None:
        self._state: ArmState | None = None
        self._status_due_ns = 0
        self._commanded_at: float | None = None  # on the steady clock
        self._refused = ""

    # ---- what the arm says ----

    def take_state(self, state: ArmState) -> None:
        """Publish a state of the arm; a driver may call this from its own thread."""
        if self.active:
            self.tf_out.publish(self.tf_layout.pack(*self.transform_numbers(state)))
        self.publish_status(state)

    def moving_transform(self) -> TransformStamped:
        """An example of what /tf says of the arm; `transform_numbers` are its numbers."""
        return transform_stamped(0, self.base_frame, self.tool_frame, np.eye(4))

    def transform_numbers(self, state: ArmState) -> tuple[float, ...]:
        """Stamp and pose of the tool in the base, which all else waits for."""
        T_base_tool = state.T_base_controlled @ self.T_controlled_tool
        return *split_stamp(state.stamp_ns), *numbers_from_pose(T_base_tool).tolist()

    def publish_status(self, state: ArmState) -> None:
        """Where the controlled frame is, what the arm does and the twist that it makes, if that is due."""
        self.states.seen()
        first = self._state is None or state.stamp_ns < self._state.stamp_ns
        self._state = state
        if not self.active or (state.stamp_ns < self._status_due_ns and not first):
            return
        period_ns = int(SECOND_NS / self.settings.value.status_rate)
        due_ns = self._status_due_ns + period_ns
        self._status_due_ns = due_ns if due_ns > state.stamp_ns and not first else state.stamp_ns + period_ns
        if state.mode is ArmMode.FAULT:
            self.report.complain("fault", f"{self.arm}: in fault: {state.reason}")
        numbers = numbers_from_pose(state.T_base_controlled).tolist()
        self.pose_out.publish(headed_bytes(PoseStamped, state.stamp_ns, self.base_frame, *numbers))
        self.limited_out.publish(twist_bytes(state.stamp_ns, self.frame, state.twist))
        numbers = int(state.mode), state.command_age, state.limited, *state.twist.tolist()
        status = headed_bytes(ArmStatus, state.stamp_ns, self.base_frame, *numbers, reason=state.reason)
        self.status_out.publish(status)

    # ---- commands ----

    def _receive(self, data: bytes) -> None:
        """Hand a command to the arm; refused ones are counted and told."""
        stamp_ns, frame_id, twist = read_twist(data)
        self._refused = self._refusal(stamp_ns, frame_id, np.array(twist))
        if self._refused:
            self.count("commands refused")
            self.warn("command", f"{self.arm}: command/twist refused: {self._refused}")
        else:
            self._commanded_at = time.monotonic()

    def _refusal(self, stamp_ns: int, frame_id: str, twist: NDArray[np.float64]) -> str:
        """Why the command is not followed; empty if the driver has taken it."""
        if frame_id != self.frame:  # in another frame it would move the arm wrongly
            return f"frame is '{frame_id}', must be '{self.frame}'"
        if self.driver is None:
            return "nobody drives the arm yet"
        silence = self._silence()
        if silence or self.driver.command(stamp_ns, twist):
            return silence
        state = self.driver.state
        return state.last_refusal if state is not None else "the driver has no state yet"

    def _silence(self) -> str:
        """Why what the driver says cannot be relied on; empty if it can."""
        age, limit = self.states.age, self.settings.value.state_timeout
        silent = self._state is not None and age > limit
        return f"no state from the driver for {age:.3f} s (limit {limit:g} s)" if silent else ""

    def _watch(self) -> None:
        """Stop the arm if nobody commands it any more, or its driver says nothing."""
        if self._commanded_at is None or self.driver is None:
            return
        reason, age = self._silence(), time.monotonic() - self._commanded_at
        if not reason and age > self.limits.command_timeout:
            refused = f"; last refused: {self._refused}" if self._refused else ""
            reason = f"no command for {age:.3f} s (limit {self.limits.command_timeout:g} s){refused}"
        if reason:
            self._commanded_at = None
            self.driver.stop(reason)


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(ArmNode)


if __name__ == "__main__":
    sys.exit(main())
