"""ExternalArm: the driver of an arm that somebody else's nodes move, moveit_servo for instance.

They follow `command/twist` and publish the tool's pose on /tf; what passes between them and a controller
passes the safe command stage here. A twist has the time of its emission, since its receivers discard what is
old. After the arm was stopped twists of zero go out for a while, and then none: silence means rest, and
leaves the arm to others.

moveit_servo tells on `~/status` what keeps it from following (`tactile_drivers.servo_watch`): a halt is a
fault of the arm, with its reason, and being slowed down a remark.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from numpy.typing import ArrayLike, NDArray

from tactile_base import topics
from tactile_base.stamps import SECOND_NS
from tactile_drivers.servo_watch import ServoWatch
from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformUnavailable
from tactile_ros.conversions import message_class
from tactile_ros.message_bytes import twist_bytes
from tactile_ros.qos import COMMAND, STATE
from tactile_ros.transforms import TransformListener
from tactile_scene.arm import ArmMode, ArmState
from tactile_scene.external_settings import TOOL, ExternalArmSettings
from tactile_scene.scene import ArmScene

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

AT_REST = 1e-4  # m/s and rad/s: what poses say of an arm that does not move
REPEAT = 0.05  # s between two zeros after a stop
NOTHING = 1e-6  # m/s and rad/s: no more than what rounding makes of rest
SERVO_STATUS = "moveit_msgs/msg/ServoStatus"
SERVO_SILENCE = 1.0  # s without a status, which comes 100 times a second, that is told
MOUNTED = 1e-3, 1e-2  # m and rad by which /tf and the scene may differ on where the sensor is mounted


def external_settings(arm: ArmScene) -> ExternalArmSettings:
    """What the scene says of the nodes that move an arm."""
    given = arm.driver_settings
    return given.checked(ExternalArmSettings, given.values)


class ExternalArm:
    """An `Arm` whose states are the transforms of its tool, and whose twists are published."""

    keeps_limits = False  # nothing is known of it
    prompt = shared = True

    def __init__(self, node: ManagedNode, arm: ArmScene, report: Callable[[ArmState], None]) -> None:
        self._node, self._report = node, report
        self._settings = external_settings(arm)
        self._tool, self._base = node.tool_frame, node.base_frame
        self._controlled = node.frame_of(arm.controlled_frame)
        self._T_tool_controlled = arm.T_tool_controlled
        self._reason, self._stopped = "", False
        self._moved = -math.inf  # when the last twist other than zero went out, on the steady clock
        self._last: tuple[int, NDArray[np.float64]] | None = None
        self._out = self._opened()
        self._transforms = TransformListener(
            node,
            on_update=self._on_transform,
            frames=[(self._base, self._tool), (self._tool, self._controlled)],
        )
        node.timer(REPEAT, self._repeat)
        self._servo = ServoWatch()
        if self._settings.servo_status:
            self._listen_to_servo(self._settings.servo_status)

    @property
    def remark(self) -> str:
        """What moveit_servo does with the twists, other than to follow them."""
        return self._servo.remark

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """Publish a twist, stamped now: its receivers have limits of their own for its age."""
        self._reason, self._stopped = "", False
        self._publish(twist)

    def stop(self, reason: str) -> None:
        """Publish twists of zero."""
        self._reason, self._stopped = reason, True
        self._publish(np.zeros(6))

    def recover(self) -> None:
        """Give moveit_servo another chance; if it halts the arm again that is a fault again."""
        self._servo.clear()

    def close(self) -> None:
        """Nothing was opened but what the node closes."""

    def _repeat(self) -> None:
        """Say again that the arm is to rest, since a single message may not be heard."""
        if self._stopped:
            self._publish(np.zeros(6))

    def _publish(self, twist: ArrayLike) -> None:
        now, twist = time.monotonic(), np.asarray(twist, dtype=np.float64)
        if np.abs(twist).max() > NOTHING:
            self._moved = now
            self._servo.told()
        elif now - self._moved > self._settings.zeros:
            return
        self._send(twist)

    def _opened(self) -> Any:
        """What commands are published by."""
        return self._node.publisher(TwistStamped, topics.EXTERNAL_COMMAND.name, COMMAND)

    def _send(self, twist: NDArray[np.float64]) -> None:
        frame = self._controlled
        if self._settings.twist_of == TOOL:
            frame, twist = self._tool, se3.adjoint(self._T_tool_controlled) @ twist
        self._out.publish(twist_bytes(self._node.now_ns(), frame, twist))

    @property
    def _fault(self) -> str:
        """Why the arm does not move, and is not to; '' if it does."""
        return self._servo.fault

    def _on_transform(self) -> None:
        """Report where the arm is."""
        try:
            stamp_ns, T_base_tool = self._transforms.newest(self._base, self._tool)
        except TransformUnavailable:
            return  # nothing of this arm has come yet
        self._tell(stamp_ns, T_base_tool @ self._T_tool_controlled)

    def _tell(self, stamp_ns: int, T: NDArray[np.float64], joints: NDArray[np.float64] | None = None) -> None:
        """Report a pose (4, 4) of the controlled frame that is news, and the twist by which it came there."""
        if (self._last is not None and stamp_ns <= self._last[0]) or not self._mounted(stamp_ns):
            return
        twist = np.zeros(6)
        if self._last is not None:
            twist = se3.log(se3.inverse(self._last[1]) @ T) * (SECOND_NS / (stamp_ns - self._last[0]))
        self._last = stamp_ns, T
        mode = ArmMode.RESTING if np.abs(twist).max() < AT_REST else ArmMode.MOVING
        reason, fault = self._reason, self._fault
        if fault:
            mode, reason = ArmMode.FAULT, fault
            if not self._stopped:  # the safe stage leaves that to an arm that is in fault by itself
                self.stop(fault)
        # how much slower servo goes it does not say: any part of what it is told is right then
        scaling = 0.0 if self._servo.remark else 1.0
        self._report(ArmState(stamp_ns, T, twist, mode, reason, joints, scaling))

    def _listen_to_servo(self, topic: str) -> None:
        """Hear what moveit_servo says; where its messages are not installed, tell that nobody does."""
        status = message_class(SERVO_STATUS)
        if status is None:
            text = f"{SERVO_STATUS} is not installed: what moveit_servo says on {topic} is not heard"
            self._node.get_logger().warning(text)
            return

        def hear(message: Any) -> None:
            self._servo.hear(message.code, message.message)

        self._node.subscribe(status, topic, hear, STATE, SERVO_SILENCE)

    def _mounted(self, stamp_ns: int) -> bool:
        """Whether /tf has the sensor on the tool where the scene has it, as far as it says so."""
        try:
            T = self._transforms.lookup(self._tool, self._controlled, stamp_ns)
        except TransformUnavailable:
            return True
        error = se3.log(se3.inverse(self._T_tool_controlled) @ T)
        way, turn = se3.norm(error[:3]), se3.norm(error[3:])
        if way <= MOUNTED[0] and turn <= MOUNTED[1]:
            return True
        off = f"{way * 1e3:.1f} mm and {math.degrees(turn):.1f} degrees"
        where = f"/tf: {self._tool} -> {self._controlled}"
        self._node.warn("mount", f"{where} is {off} off in_tool of the scene: the arm is not followed")
        return False
