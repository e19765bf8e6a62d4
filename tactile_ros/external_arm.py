"""ExternalArm: the driver of an arm that somebody else's nodes move.

They follow `command/twist` and publish the tool's pose on /tf; what passes between them and a controller
passes the safe command stage here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import TwistStamped
from numpy.typing import ArrayLike, NDArray

from tactile_base import topics
from tactile_base.stamps import SECOND_NS
from tactile_drivers.arm import ArmMode, ArmState
from tactile_drivers.scene import ArmScene
from tactile_filter import se3
from tactile_filter.transform_buffer import TransformUnavailable
from tactile_ros.cdr import twist_bytes
from tactile_ros.qos import COMMAND
from tactile_ros.transforms import TransformListener

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

AT_REST = 1e-4  # m/s and rad/s: what poses say of an arm that does not move


class ExternalArm:
    """An `Arm` whose states are the transforms of its tool, and whose twists are published."""

    keeps_limits = False  # nothing is known of it

    def __init__(self, node: ManagedNode, arm: ArmScene, report: Callable[[ArmState], None]) -> None:
        self._node, self._report = node, report
        self._frame = node.frame_of(arm.controlled_frame)
        self._tool, self._base = node.tool_frame, node.base_frame
        self._T_tool_controlled = arm.T_tool_controlled
        self._reason = ""
        self._last: tuple[int, NDArray[np.float64]] | None = None
        self._out = node.publisher(TwistStamped, topics.EXTERNAL_COMMAND.name, COMMAND)
        self._transforms = TransformListener(
            node, on_update=self._on_transform, frames=[(self._base, self._tool)]
        )

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """Publish a twist, stamped now: its receivers have limits of their own for its age."""
        self._reason = ""
        self._publish(twist)

    def stop(self, reason: str) -> None:
        """Publish a twist of zero."""
        self._reason = reason
        self._publish(np.zeros(6))

    def recover(self) -> None:
        """There is no fault that these nodes would tell of."""

    def close(self) -> None:
        """Nothing was opened but what the node closes."""

    def _publish(self, twist: ArrayLike) -> None:
        self._out.publish(twist_bytes(self._node.now_ns(), self._frame, twist))

    def _on_transform(self) -> None:
        """Report where the arm is, and the twist by which it came here."""
        try:
            stamp_ns, T_base_tool = self._transforms.newest(self._base, self._tool)
        except TransformUnavailable:
            return  # nothing of this arm has come yet
        if self._last is not None and stamp_ns <= self._last[0]:
            return
        T = T_base_tool @ self._T_tool_controlled
        twist = np.zeros(6)
        if self._last is not None:
            twist = se3.log(se3.inverse(self._last[1]) @ T) * (SECOND_NS / (stamp_ns - self._last[0]))
        self._last = stamp_ns, T
        mode = ArmMode.RESTING if np.abs(twist).max() < AT_REST else ArmMode.MOVING
        self._report(ArmState(stamp_ns, T, twist, mode, self._reason))
