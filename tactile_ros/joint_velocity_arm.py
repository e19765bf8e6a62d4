"""JointVelocityArm: the driver of an arm whose ros2_control velocity controller takes joint velocities.

That is a velocity_controllers/JointGroupVelocityController, or a forward_command_controller with the
interface `velocity`: std_msgs/msg/Float64MultiArray on `~/commands`, one number for each of its `joints`, in
their order (velocity_controllers/doc/userdoc.rst and forward_command_controller/doc/userdoc.rst of
ros2_controllers, branches jazzy and kilted). It keeps no time: what it was told last holds until it is told
otherwise (`update` in forward_controllers_base.cpp there). So zeros go out wherever twists end, until they
are acknowledged where the node ends, and from a process of its own where the node is killed or stands still
(`tactile_ros.last_zeros`). The arm has no state, and so follows nothing, before both have found the
controller.

Twists become joint velocities by the kinematics that the scene names, at the joints of `joint_states`. Where
the tool is say /tf or, with `publish_tool`, the same kinematics. The safe command stage minds the ranges and
speeds of the joints, and singularities, as it has both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rclpy.duration import Duration
from std_msgs.msg import Float64MultiArray

from tactile_base.stamps import SECOND_NS
from tactile_ros.external_arm import ExternalArm
from tactile_ros.joint_states import JointListener
from tactile_ros.last_zeros import LastZeros
from tactile_ros.qos import COMMAND
from tactile_scene.arm import ArmState
from tactile_scene.kinematics.joint_limits import limited_rates
from tactile_scene.scene import ArmScene

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

Array = NDArray[np.float64]

APART = 0.05  # s by which joints may be older or newer than what /tf says
FOUND = 5.0  # s, from which on it is told that there is no controller
HEARD = 0.5  # s, at most, for the controller to acknowledge the last zeros


class JointVelocityArm(ExternalArm):
    """An `ExternalArm` that publishes joint velocities; see the module's text."""

    def __init__(self, node: ManagedNode, arm: ArmScene, report: Callable[[ArmState], None]) -> None:
        assert arm.kinematics is not None  # the scene was checked
        self.kinematics = arm.kinematics
        super().__init__(node, arm, report)
        settings, names = self._settings, arm.kinematics.names
        self._order = settings.joint_order(names)
        named = [settings.joint_prefix + name for name in names]
        self._joints = JointListener(node, settings.joint_states, named, self._on_joints)
        topic = node.resolve_topic_name(settings.joint_velocities)
        self._unheard = f"nobody listens to {topic}"
        self._begun, self._ready = time.monotonic(), False
        self._last_zeros = LastZeros(node, topic, len(names), arm.limits.command_timeout)

    @property
    def remark(self) -> str:
        """A warning that nobody listens to the velocities; '' while somebody does."""
        return "" if self._out.get_subscription_count() else self._unheard

    def recover(self) -> None:
        """Have somebody stop the arm again who outlives this process."""
        self._last_zeros.restart()

    def close(self) -> None:
        """See that the last zeros have arrived."""
        if not self._out.wait_for_all_acked(Duration(seconds=HEARD)):
            topic = self._settings.joint_velocities
            self._node.get_logger().error(f"{topic}: the last zeros were not acknowledged, look at the arm")
        self._last_zeros.close()

    @property
    def _fault(self) -> str:
        return self._last_zeros.fault

    def _opened(self) -> Any:
        return self._node.publisher(Float64MultiArray, self._settings.joint_velocities, COMMAND)

    def _send(self, twist: Array) -> None:
        rates = np.zeros(len(self._order))
        if twist.any() and self._joints.state is not None and self._joints.state.joints is not None:
            rates = limited_rates(self.kinematics, self._joints.state.joints, twist)
        self._last_zeros.told(bool(rates.any()))
        self._out.publish(Float64MultiArray(data=rates[self._order].tolist()))

    def _on_joints(self) -> None:
        """Report where the arm is by its joints, where that is who says so."""
        state = self._joints.state
        if self._settings.publish_tool and state is not None and state.joints is not None:
            self._tell_with(state.stamp_ns, self.kinematics.pose(state.joints), state.joints)

    def _tell(self, stamp_ns: int, T: Array, joints: Array | None = None) -> None:
        """Report what /tf says, with the joints of that time; without them nothing is known of the arm."""
        state = self._joints.state
        if self._settings.publish_tool or state is None or state.joints is None:
            return
        if abs(stamp_ns - state.stamp_ns) > APART * SECOND_NS:
            text = f"{self._settings.joint_states}: no joints within {APART:g} s of what /tf says of the arm"
            self._node.warn("joints", text)
            return
        self._tell_with(stamp_ns, T, state.joints)

    def _tell_with(self, stamp_ns: int, T: Array, joints: Array) -> None:
        """Report; an arm has no state, and follows nothing, before both processes have its controller."""
        if not self._is_ready() and not self._fault:
            if time.monotonic() - self._begun > FOUND:
                self._node.warn("controller", f"{self._unheard}: nothing is told of the arm", period=5.0)
            return
        super()._tell(stamp_ns, T, joints)

    def _is_ready(self) -> bool:
        self._ready = self._ready or self._out.get_subscription_count() > 0
        return self._ready and self._last_zeros.ready
