"""Joints of arms on ROS, where they are known: `joint_states`, and of a URDF what RViz shows it by.

Links of a URDF are frames `<namespace>/urdf/<link>`, so that none has the name of another frame.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from tactile_base import topics
from tactile_drivers.arm import ArmMode, ArmState
from tactile_drivers.kinematics.chain import Chain
from tactile_ros.conversions import MessageError, header, ns_from_time, transform_stamped
from tactile_ros.qos import LATCHED, STATE, TF

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
    """The newest joints of another arm, by their names; `state` is None before the first."""

    def __init__(self, node: ManagedNode, topic: str, chain: Chain) -> None:
        self.state: ArmState | None = None
        self._names = chain.names
        node.subscribe(JointState, topic, self._take, STATE)

    def _take(self, message: JointState) -> None:
        """Keep the joints; `MessageError` where they are not those of the arm."""
        at = dict(zip(message.name, message.position, strict=False))
        missing = [name for name in self._names if not math.isfinite(at.get(name, math.nan))]
        if missing:
            raise MessageError(f"no position of {', '.join(missing)}")
        joints = np.array([at[name] for name in self._names])
        stamp_ns = ns_from_time(message.header.stamp)
        self.state = ArmState(stamp_ns, np.eye(4), np.zeros(6), ArmMode.RESTING, joints=joints)
