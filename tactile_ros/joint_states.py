"""Joints of arms on ROS, where they are known: `joint_states`, and of a URDF what RViz shows it by.

Links of a URDF are frames `<namespace>/urdf/<link>`, so that none has the name of another frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from tactile_base import topics
from tactile_ros.conversions import header, ns_from_time, transform_stamped
from tactile_ros.qos import LATCHED, STATE, TF
from tactile_scene.arm import ArmMode, ArmState
from tactile_scene.kinematics.chain import Chain
from tactile_wire.errors import MessageError

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

Array = NDArray[np.float64]


class JointPublisher:
    """Tells the joints of an arm.

    Attributes
    ----------
    static : list of TransformStamped
        Where links are that do not move, for /tf_static.
    """

    def __init__(self, node: ManagedNode, chain: Chain) -> None:
        self._names, self._described = list(chain.names), chain.description
        self._states = node.publisher(JointState, topics.JOINT_STATES.name, STATE)
        self.static: list[TransformStamped] = []
        self._told = False
        if self._described is None:
            return
        self._prefix = topics.link_frame(node.get_namespace().strip("/"), "")
        self._description = node.publisher(String, topics.ROBOT_DESCRIPTION.name, LATCHED)
        self._links = node.publisher(TFMessage, topics.TF.name, TF)
        fixed = [joint for joint in self._described.joints if joint.name not in self._names]
        self._turning = [joint for joint in self._described.joints if joint.name in self._names]
        root = transform_stamped(
            0, node.base_frame, self._prefix + self._described.root, self._described.T_base_root
        )
        self.static = [root, *(self._link(0, joint.parent, joint.child, joint.T) for joint in fixed)]

    def publish(self, state: ArmState) -> None:
        """The joints of a state, if it has any."""
        if state.joints is None:
            return
        angles = state.joints.tolist()
        stamp = header(state.stamp_ns, "")
        self._states.publish(JointState(header=stamp, name=self._names, position=angles))
        if self._described is not None:
            if not self._told:  # an arm without joints would be shown in pieces
                self._description.publish(String(data=self._described.text))
                self._told = True
            at = dict(zip(self._names, angles, strict=True))
            moving = [
                self._link(state.stamp_ns, joint.parent, joint.child, joint.at(at[joint.name]))
                for joint in self._turning
            ]
            self._links.publish(TFMessage(transforms=moving))

    def _link(self, stamp_ns: int, parent: str, child: str, T: Array) -> TransformStamped:
        return transform_stamped(stamp_ns, self._prefix + parent, self._prefix + child, T)


class JointListener:
    """The newest joints of an arm, by their names.

    Parameters
    ----------
    names : sequence of str
        Of its joints in the messages, in the order of the kinematics.
    on_update : callable, optional
        Called after each message that has them.

    Attributes
    ----------
    state : ArmState or None
        With stamp and `joints`; None before the first.
    rates : ndarray (n,) or None
        Speeds of the joints, rad/s, where the message tells them.
    """

    def __init__(
        self, node: ManagedNode, topic: str, names: Sequence[str], on_update: Callable[[], None] | None = None
    ) -> None:
        self.state: ArmState | None = None
        self.rates: Array | None = None
        self._node, self._names, self._on_update = node, names, on_update
        node.subscribe(JointState, topic, self._take, STATE)

    def _take(self, message: JointState) -> None:
        """Keep the joints; `MessageError` where they are not those of the arm."""
        if not set(self._names) & set(message.name):
            return  # a gripper, or another arm on the same topic
        joints = self._of(message.name, message.position)
        missing = [name for name, angle in zip(self._names, joints, strict=True) if not math.isfinite(angle)]
        if missing:
            raise MessageError(f"no position of {', '.join(missing)}")
        stamp_ns = ns_from_time(message.header.stamp)
        self._node.check_stamp(stamp_ns)
        rates = self._of(message.name, message.velocity)
        self.rates = rates if np.isfinite(rates).all() else None
        self.state = ArmState(stamp_ns, np.eye(4), np.zeros(6), ArmMode.RESTING, joints=joints)
        if self._on_update is not None:
            self._on_update()

    def _of(self, names: Sequence[str], values: Sequence[float]) -> Array:
        """The values of the arm's joints, NaN where there is none."""
        at = dict(zip(names, values, strict=False))
        return np.array([at.get(name, math.nan) for name in self._names])
