"""What a scene says of an arm that somebody else's nodes move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tactile_base.settings import SettingError, Settings, setting
from tactile_base.yaml_file import Section

SENSOR, TOOL = "sensor", "tool"

LEAST_ZEROS = 0.2  # s


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
        False, doc="whether base -> tool is published here, from kinematics and joints; else /tf has it"
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
