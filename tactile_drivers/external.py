"""An arm that somebody else's nodes move: what a scene says of them, and what moveit_servo says of itself.

moveit_servo publishes moveit_msgs/msg/ServoStatus on its `~/status` in every period of its loop: `code`
(int8) and `message` (string), as msg/ServoStatus.msg of moveit_msgs (branch ros2) and servo_node.cpp of
moveit2 (branches jazzy, kilted, main) have them. The codes are those of `StatusCode` in
moveit_servo/utils/datatypes.hpp there. The status is that of the newest command that servo has taken: it
stays as it is while there is none.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tactile_base.settings import SettingError, Settings, setting
from tactile_base.yaml_file import Section

SENSOR, TOOL = "sensor", "tool"

LEAST_ZEROS = 0.2  # s
_INVALID, _NO_WARNING = -1, 0
_HALTS = (_INVALID, 2, 5, 6)  # HALT_FOR_SINGULARITY, HALT_FOR_COLLISION, JOINT_BOUND: the arm does not move
_CURRENT = 0.1  # s; a twist that went out less long ago is still followed
_SETTLES = 0.1  # s from a first twist, in which servo may still tell of those before a pause
_KEPT = 0.5  # s, for which a status counts
_REFUSED = "its frame, the IK solver or the command type; servo's log says which"


@dataclass(frozen=True)
class ExternalArmSettings(Settings):
    """What a scene says of an arm whose nodes run already."""

    twist_of: str = setting(
        SENSOR, choices=(SENSOR, TOOL),
        doc="whose twist they follow, in its own frame: the controlled frame's, or the tool's (moveit_servo)",
    )  # fmt: skip
    publish_mount: bool = setting(
        False, doc="whether tool -> sensor is published here, as in_tool says; else it must agree with that"
    )
    zeros: float = setting(
        0.5, lower=0.0, upper=3600.0, unit="s",
        doc="after the last other one, twists of zero go out for so long, and then none",
    )  # fmt: skip
    servo_status: str = setting(
        "", doc="topic of moveit_servo's status (moveit_msgs/msg/ServoStatus); empty: nobody listens to it"
    )
    joint_velocities: str = setting(
        "", doc="topic of a velocity controller (std_msgs/msg/Float64MultiArray), which gets velocities of "
        "joints in place of twists; empty: twists",
    )  # fmt: skip
    joints: tuple[str, ...] = setting(
        (), doc="its joints, in its order; empty: those of the kinematics, in theirs"
    )
    joint_prefix: str = setting("", doc="what its joints' names have in front of those of the kinematics")
    joint_states: str = setting("/joint_states", doc="topic of its arm's joints (sensor_msgs/msg/JointState)")
    publish_tool: bool = setting(
        False,
        doc="whether base -> tool is published here, as kinematics and joints say; else it is taken from /tf",
    )

    def joint_order(self, names: Sequence[str]) -> list[int]:
        """Where each joint of the velocity controller is among those of the kinematics, by its `names`.

        Raises
        ------
        SettingError
            If they are not the same joints.
        """
        known = [self.joint_prefix + name for name in names]
        joints = list(self.joints or known)
        if sorted(joints) != sorted(known):
            raise SettingError(f"joints: must be {', '.join(known)}, in the order of the velocity controller")
        return [known.index(name) for name in joints]

    def check(self, names: Sequence[str] | None) -> None:
        """Raise `SettingError` for what does not go together; `names` of the kinematics' joints, if known."""
        if not self.joint_velocities:
            if self.publish_tool:
                raise SettingError("publish_tool: needs joint_velocities; else /tf says where the arm is")
            return
        if names is None:
            raise SettingError("joint_velocities: needs the arm's `kinematics`")
        if self.zeros < LEAST_ZEROS:
            raise SettingError(
                f"zeros = {self.zeros:g} s: must be at least {LEAST_ZEROS:g} s with joint_velocities: "
                "a velocity controller goes on with what it was told last"
            )
        self.joint_order(names)


def check_external(section: Section, names: Sequence[str] | None) -> None:
    """Refuse `driver_settings` of an arm's section that mean nothing, with file and line.

    `names` are those of the joints of its kinematics; None where they are not known.
    """
    settings = section.settings("driver_settings", ExternalArmSettings)
    try:
        settings.check(names)
    except SettingError as error:
        section.fail(f"{section.name}.driver_settings: {error}", "driver_settings")


def servo_trouble(code: int, message: str) -> tuple[str, str]:
    """Why moveit_servo keeps the arm from moving, and what else it does with its twists, in words; or ''.

    `code` and `message` are those of a ServoStatus.
    """
    if code == _NO_WARNING:
        return "", ""
    text = f"moveit_servo: {message or f'status {code}'}"
    if code == _INVALID:
        text = f"moveit_servo does not take the twist ({_REFUSED})"
    return (text, "") if code in _HALTS else ("", text)


class ServoWatch:
    """What moveit_servo says of the twists that it is given.

    Attributes
    ----------
    fault : str
        Why it has halted the arm, until `clear`; '' if it has not.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since = self._told = self._heard = -math.inf
        self._remark = self.fault = ""

    @property
    def remark(self) -> str:
        """What it does with the twists, other than to follow them; '' if it follows, or says nothing."""
        return self._remark if self._clock() - self._heard < _KEPT else ""

    def told(self) -> None:
        """A twist other than zero has gone out to it."""
        now = self._clock()
        if now - self._told > _CURRENT:
            self._since = now
        self._told = now

    def hear(self, code: int, message: str) -> None:
        """Take a status; one that may be of twists from before a pause says nothing."""
        now = self._clock()
        is_ours = now - self._told <= _CURRENT and now - self._since >= _SETTLES
        fault, self._remark = servo_trouble(code, message) if is_ours else ("", "")
        self.fault, self._heard = self.fault or fault, now

    def clear(self) -> None:
        """Forget that it has halted the arm."""
        self.fault, self._told = "", -math.inf
