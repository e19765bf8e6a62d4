"""How much of a twist another arm allows: links and tools of two arms with known kinematics stay apart.

    safe.neighbours = neighbours(scene, "leader", cell.status)        # state of an arm by its name

What is looked at are capsules along the links (`tactile_scene.kinematics`); what an arm carries besides
its tool is none of them. Each arm minds the others by itself, and takes half of the room that is left, so
that two that come towards each other stop before they have used it up.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Container
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_scene.arm import ArmState
from tactile_scene.kinematics.capsules import gaps
from tactile_scene.kinematics.chain import point_velocities

if TYPE_CHECKING:
    from tactile_scene.scene import ArmScene, Scene

Array = NDArray[np.float64]

_AHEAD = 0.1  # m; looked at beyond what matters now, so that the next look can wait
_SILENCE = 0.1  # s; joints of another arm older than this say nothing of where it is


class Neighbour:
    """Another arm as one arm sees it.

    Parameters
    ----------
    arm, other : ArmScene
        Both with kinematics; `name` is the other's.
    state_of_other : callable
        Its newest state, with joints, on the clock of the arm's own states; None if there is none.
    """

    def __init__(self, arm: ArmScene, other: ArmScene, state_of_other: Callable[[], ArmState | None]) -> None:
        assert arm.kinematics is not None and other.kinematics is not None
        self._own, self._other = arm.kinematics, other.kinematics
        self.name, self._state_of_other = other.name, state_of_other
        self._limits, self._least = arm.limits, arm.safety.min_arm_distance
        self._looked: tuple[Array, Array, float] | None = None  # joints of both, and how far they were apart
        self._T_base_other = se3.inverse(arm.T_world_base) @ other.T_world_base

    def allowed_part(self, state: ArmState, twist: Array, rates: Array, delay: float) -> tuple[float, str]:
        """The part 0..1 of a twist (6,) of the controlled frame, and what makes it less ('' for 1).

        With it the arm can, `delay` (s) from now, still brake before it is too near. Links that go apart are
        never held back. `rates` (n,) are the speeds of the joints, rad/s, that make the twist.
        """
        if state.joints is None or not rates.any():
            return 1.0, ""
        other = self._state_of_other()
        silence_ns = _SILENCE * SECOND_NS
        if other is None or other.joints is None or abs(state.stamp_ns - other.stamp_ns) > silence_ns:
            return 0.0, f"no joints of {self.name}"
        late = max(0, state.stamp_ns - other.stamp_ns) / SECOND_NS  # it was further away then
        half, lead = self._stopping(twist, delay + late)
        needed = self._least + 2.0 * (half + lead) * float(np.abs(rates) @ self._own.spans)
        if self._still_clear(state.joints, other.joints, needed):
            return 1.0, ""
        links = self._own.capsules(state.joints)
        others = self._other.capsules(other.joints).moved(self._T_base_other)
        found = gaps(links, others, needed + _AHEAD)
        nearest = float(found.distances.min(initial=needed + _AHEAD))
        self._looked = state.joints, other.joints, nearest
        if nearest > needed:
            return 1.0, ""
        joints = links.joints[found.first]
        velocities = point_velocities(self._own.frames(state.joints), joints, found.points, rates)
        closing = (velocities * found.towards).sum(axis=1)
        room = np.maximum(found.distances - self._least, 0.0)
        room[others.joints[found.second] > 0] *= 0.5  # the base of an arm does not come nearer
        part = _slowest(closing, room, half, lead)
        return (part, f"{self._least:g} m from {self.name}") if part < 1.0 else (1.0, "")

    def distance(self, q: Array, q_other: Array) -> float:
        """Between the arms' links, m, at joint angles (n,) of both; negative where they overlap."""
        others = self._other.capsules(q_other).moved(self._T_base_other)
        return float(gaps(self._own.capsules(q), others).distances.min())

    def _still_clear(self, q: Array, q_other: Array, needed: float) -> bool:
        """Whether what was seen last says that the arms are further apart than `needed` (m)."""
        if self._looked is None:
            return False
        before, other_before, distance = self._looked
        moved = np.abs(q - before) @ self._own.spans + np.abs(q_other - other_before) @ self._other.spans
        return bool(distance - moved > needed)

    def _stopping(self, twist: Array, delay: float) -> tuple[float, float]:
        """Times (s): what a point goes on is its speed times both, the first less the slower the twist."""
        limits = self._limits
        linear, angular = limits.linear_acceleration, limits.angular_acceleration
        half = max(se3.norm(twist[:3]) / (2.0 * linear), se3.norm(twist[3:]) / (2.0 * angular))
        return half, delay + max(linear / limits.linear_jerk, angular / limits.angular_jerk) / 2.0


def _slowest(closing: Array, room: Array, half: float, lead: float) -> float:
    """The largest part p <= 1 with p closing (p half + lead) <= room, for all that come closer."""
    nearing = closing > 0.0
    if not nearing.any():
        return 1.0
    closing, room = closing[nearing], room[nearing]
    a, b = half * closing, lead * closing
    parts = 2.0 * room / (b + np.sqrt(b * b + 4.0 * a * room))  # stable also where half or room is 0
    return min(1.0, float(parts.min()))


def neighbours(
    scene: Scene, arm: str, state_of: Callable[[str], ArmState | None], known: Container[str]
) -> tuple[Neighbour, ...]:
    """What an arm of a scene minds, of the `known` arms."""
    return tuple(
        Neighbour(scene.arms[arm], scene.arms[name], functools.partial(state_of, name))
        for name in watched_arms(scene, arm)
        if name in known
    )


def watched_arms(scene: Scene, arm: str) -> list[str]:
    """The arms that an arm minds: the others with kinematics, if it has some itself."""
    own = scene.arms[arm]
    if own.kinematics is None or own.safety.min_arm_distance == 0.0:
        return []
    return [name for name, other in scene.arms.items() if name != arm and other.kinematics is not None]
