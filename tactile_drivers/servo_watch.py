"""What moveit_servo says of itself: whether it does what it is told.

moveit_servo publishes moveit_msgs/msg/ServoStatus on its `~/status` in every period of its loop: `code`
(int8) and `message` (string), as msg/ServoStatus.msg of moveit_msgs (branch ros2) and servo_node.cpp of
moveit2 (branches jazzy, kilted, main) have them. The codes are those of `StatusCode` in
moveit_servo/utils/datatypes.hpp there. The status is that of the newest command that servo has taken: it
stays as it is while there is none.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

_INVALID, _NO_WARNING = -1, 0
_HALTS = (_INVALID, 2, 5, 6)  # HALT_FOR_SINGULARITY, HALT_FOR_COLLISION, JOINT_BOUND: the arm does not move
_CURRENT = 0.1  # s; a twist that went out less long ago is still followed
_SETTLES = 0.1  # s from a first twist, in which servo may still tell of those before a pause
_KEPT = 0.5  # s, for which a status counts
_REFUSED = "its frame, the IK solver or the command type; servo's log says which"


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
