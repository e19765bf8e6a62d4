"""Arm: what every arm driver offers, simulated or real, and what it is told about the arm that it drives.

A driver is a class in the registry `ARMS`; a scene names it, and another package adds its own by an entry
point of the group "tactile_servoing.arms" (docs/scenes.md)::

    class MyArm:
        settings_class = MyArmSettings               # checked against `driver_settings` of the scene

        def __init__(self, arm: ArmScene, settings: MyArmSettings, report: Callable[[ArmState], None]):
            ...                                      # connect; then report(state) at each new state

Twists and poses are those of the arm's controlled frame: its tactile sensor's, or the tool's where it has
none (`ArmScene.controlled_frame`, which stands in the tool at `ArmScene.T_tool_controlled`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.contract import Contract
from tactile_base.raised import defined_in
from tactile_base.registry import Registry
from tactile_base.settings import SettingError, Settings
from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]


AT_REST = np.repeat([1e-3, 5e-3], 3)  # m/s, rad/s: what speeds say of an arm that does not move
LONGEST_CALL = 0.01  # s, that `command` and `stop` of a driver may take
HELD_UP = "machine or line to the arm is held up: end what else runs, or use --priority"  # of late states


class ArmMode(IntEnum):
    """What the arm does; the values are those of tactile_msgs/ArmStatus."""

    RESTING = 0
    MOVING = 1
    STOPPING = 2
    FAULT = 3
    ESTOP = 4


def is_at_rest(twist: ArrayLike) -> bool:
    """Whether speeds (6,), m/s and rad/s, are those of an arm that does not move; NaN is not."""
    return bool((np.abs(twist) < AT_REST).all())


@dataclass(frozen=True)
class ArmState:
    """State of the arm at a stamp; down to `speed_scaling` it is the driver's, the rest the safe stage's.

    Attributes
    ----------
    T_base_controlled : ndarray (4, 4)
        Pose of the controlled frame in the arm's base.
    twist : ndarray (6,)
        Twist [v (m/s), omega (rad/s)] of the controlled frame, in the controlled frame.
    reason : str
        Why the arm does what it does; empty in normal operation.
    joints : ndarray (n,) or None
        Angles of the joints, rad, of an arm whose driver has `kinematics`.
    speed_scaling : float
        The part (0 to 1) of what it is told that the arm is set to do, by a slider at its pendant say.
    owner : str
        Who commands the arm; empty for nobody.
    command_age : float
        Seconds since the stamp of the command in force; -1 while there is none.
    limited : bool
        True while the arm does less than it is asked for.
    limited_by : str
        Which bound of speed, depth, shear, workspace, joints or other arms makes the command less; or empty.
    refused, refused_source : str
        Why the last command was not followed, and whose it was; empty if it was followed.
    remark : str
        What is not as it should be and no fault yet; or empty.
    """

    stamp_ns: int
    T_base_controlled: Array
    twist: Array
    mode: ArmMode
    reason: str = ""
    joints: Array | None = None
    speed_scaling: float = 1.0
    owner: str = ""
    command_age: float = -1.0
    limited: bool = False
    limited_by: str = ""
    refused: str = ""
    refused_source: str = ""
    remark: str = ""


class Arm(Protocol):
    """A driver that has been opened. Any thread may call it, and `stop` while another call is under way.

    Attributes
    ----------
    keeps_limits : bool
        Whether it keeps the limits of acceleration and jerk itself. If not, it is given twists that do, one
        after each of its states.
    prompt : bool, optional
        Whether `command` and `stop` always return at once, since they wait for nothing. Without it they are
        called in threads of their own (`tactile_drivers.sender`).
    shared : bool, optional
        Whether others may move the arm while nobody commands it here. Without it that is a fault.
    kinematics : Kinematics, optional
        Of an arm that has them; then its states tell `joints`, and the stage minds their limits.
    watchdog : float, optional
        Seconds without commands after which the arm's own controller stops it, if this computer hangs, too.
    agreed : str, optional
        What its controller says as the scene does (tool, payload, model), since it would not have opened
        else.
    """

    keeps_limits: bool

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """Follow a twist (6,) of the controlled frame, in that frame, emitted at `stamp_ns`.

        It comes from the safe command stage, which has refused what no arm may follow. It returns within
        `LONGEST_CALL`; a longer call is told, and commands that come meanwhile are left out but the newest.
        """

    def stop(self, reason: str) -> None:
        """Bring the arm to rest within its limits; the next command moves it again.

        It returns within `LONGEST_CALL`, also while `command` has not returned yet.
        """

    def recover(self) -> None:
        """Leave a fault, if the arm allows it; `RuntimeError` says why it does not."""

    def close(self) -> None:
        """Stop, and let go of the arm; no state is reported after it returns."""


class ArmDriver(Protocol):
    """What an entry of `ARMS` is.

    Called with the arm of the scene, the driver's own settings, and what to call with each new state, from
    any thread. Raises `OSError` or `RuntimeError`, in words for its user, if the arm cannot be had.
    """

    settings_class: ClassVar[type[Settings]]

    def __call__(self, arm: ArmScene, settings: Any, report: Callable[[ArmState], None]) -> Arm: ...


#: Arm drivers by name, besides the simulated cell's.
ARMS: Registry[ArmDriver] = Registry(
    "arm driver",
    "tactile_servoing.arms",
    {"franka": "tactile_drivers.franka:FrankaArm", "ur": "tactile_drivers.ur:UrArm"},
    Contract(
        ("arm", "settings", "report"),
        {"command": ("stamp_ns", "twist"), "stop": ("reason",), "recover": (), "close": ()},
        settings=True,
    ),
)


def open_arm(arm: ArmScene, report: Callable[[ArmState], None]) -> Arm:
    """The arm of a scene, driven by the driver that the scene names.

    Raises
    ------
    SettingError
        If there is no such driver, it has no `keeps_limits`, or `driver_settings` hold what it does not know.
    OSError, RuntimeError
        If the driver cannot have the arm.
    """
    driver = ARMS.load(arm.driver)
    given = arm.driver_settings
    opened = driver(arm, given.checked(driver.settings_class, given.values), report)
    if not isinstance(getattr(opened, "keeps_limits", None), bool):
        opened.close()
        where = defined_in(driver)
        raise SettingError(f"arm driver '{arm.driver}': has no keeps_limits, must be True or False ({where})")
    return opened
