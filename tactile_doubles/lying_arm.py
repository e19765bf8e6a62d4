"""Arms that lie: drivers of the simulated arm that do not do what they are told, or say what is not true.

    lies = LyingArm("flipped_y", begins=4.0)
    run_arms_offline("plane", options=OfflineOptions(lies=lies))
    lies.witness["arm"].way                              # m, of the true arm since then

Each is a kind of fault that real cells have had: a frame's axis mistaken, units or an override of the speed,
brakes that are closed or a servo that is off, a stop that is not wired, a program beside the commander's, a
state server that repeats itself or lags, a network that loses packets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import unknown_name
from tactile_base.stamps import SECOND_NS
from tactile_doubles.lies import Lies
from tactile_geometry import se3
from tactile_scene.arm import ArmState

if TYPE_CHECKING:
    from tactile_sim.arm import SimArm

Array = NDArray[np.float64]

_REST = np.zeros(6)


class LyingDriver:
    """The driver of a simulated arm that tells the truth; a lie overrides `does` or `says`.

    It has a time of its own: somebody asks for its `state` at each step of the cell.

    Parameters
    ----------
    arm : SimArm
        The arm that really moves.
    begun : callable
        Whether the lie holds at a stamp (ns).
    """

    prompt = True

    def __init__(self, arm: SimArm, begun: Callable[[int], bool], seed: int = 0) -> None:
        self.arm, self.begun = arm, begun
        self.random = np.random.default_rng(seed)
        self.told = _REST
        self._told_ns: int | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.arm, name)

    def does(self, told: Array) -> Array | None:
        """The twist (6,) that the arm makes of the one that it was told last; None: its own business."""
        return None

    def says(self, state: ArmState) -> ArmState:
        """What is said of its state."""
        return state

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """See `Arm`."""
        self.told, self._told_ns = np.array(twist, dtype=np.float64), stamp_ns
        does = self.does(self.told) if self.begun(self.arm.stamp_ns) else None
        self.arm.command(stamp_ns, self.told if does is None else does)

    def stop(self, reason: str) -> None:
        """See `Arm`."""
        self.told, self._told_ns = _REST, None
        self.arm.stop(reason)

    @property
    def state(self) -> ArmState:
        """What it says now, after it has moved on."""
        now_ns = self.arm.stamp_ns
        if not self.begun(now_ns):
            return self.arm.state
        does = self.does(self.told)
        if does is not None:
            moving = self._told_ns is not None or np.any(does)
            self.arm.command(now_ns if moving else 0, does)
        return self.says(self.arm.state)


class IgnoresStop(LyingDriver):
    """It goes on with the twist that it was told last, whatever it is told."""

    _last = _REST

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """See `Arm`."""
        self._last = np.array(twist, dtype=np.float64)
        super().command(stamp_ns, twist)

    def does(self, told: Array) -> Array | None:
        return self._last


def _making(does: Callable[[Array], Array]) -> type[LyingDriver]:
    """A driver that makes that of each twist that it is told."""

    class Making(LyingDriver):
        def does(self, told: Array) -> Array | None:
            return does(told)

    return Making


class LosesCommands(LyingDriver):
    """Nine commands of ten never arrive."""

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        if not self.begun(stamp_ns) or self.random.random() < 0.1:
            super().command(stamp_ns, twist)


class FrozenPose(LyingDriver):
    """Its states have new stamps, and the pose and twist of the first."""

    _first: ArmState | None = None

    def says(self, state: ArmState) -> ArmState:
        self._first = self._first or state
        return replace(self._first, stamp_ns=state.stamp_ns)


class FrozenPoseAlone(FrozenPose):
    """The pose stays what it was; the twist is reported truly."""

    def says(self, state: ArmState) -> ArmState:
        return replace(super().says(state), twist=state.twist)


class LateStates(LyingDriver):
    """Its states come 80 to 300 ms late, with the stamps that they had."""

    def __init__(self, arm: SimArm, begun: Callable[[int], bool], seed: int = 0) -> None:
        super().__init__(arm, begun, seed)
        self._kept: deque[ArmState] = deque()
        self._late_ns = 0

    def says(self, state: ArmState) -> ArmState:
        self._kept.append(state)
        if self.random.random() < 0.05:
            self._late_ns = round(self.random.uniform(0.08, 0.3) * SECOND_NS)
        due = [kept for kept in self._kept if kept.stamp_ns <= state.stamp_ns - self._late_ns]
        while due and self._kept[0] is not due[-1]:
            self._kept.popleft()
        return self._kept[0]


class PoseJumps(LyingDriver):
    """It says that it is 50 mm further along its y axis than it is."""

    def says(self, state: ArmState) -> ArmState:
        T = state.T_base_controlled @ se3.exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]))
        return replace(state, T_base_controlled=T)


#: Drivers that lie, by name.
ARM_LIES: dict[str, type[LyingDriver]] = {
    "ignores_stop": IgnoresStop,
    # 20 mm/s, whatever it is told: another program commands it, too
    "moves_by_itself": _making(lambda told: np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])),
    # 50 mm/s sideways besides what it is told, as long as it is told something
    "moves_sideways": _making(lambda told: told + np.array([0.05 * np.any(told), 0.0, 0.0, 0.0, 0.0, 0.0])),
    "flipped_y": _making(lambda told: told * [1.0, -1.0, 1.0, 1.0, 1.0, 1.0]),
    "double_speed": _making(lambda told: 2.0 * told),
    "servo_off": _making(lambda told: _REST),
    "loses_commands": LosesCommands,
    "frozen_pose": FrozenPose,
    "frozen_pose_alone": FrozenPoseAlone,
    "late_states": LateStates,
    "pose_jumps": PoseJumps,
}


class LyingArm(Lies):
    """A run in which the driver of an arm (or of all) lies; `name` is one of `ARM_LIES`.

    Raises
    ------
    ValueError
        If there is no lie of that name.
    """

    def __init__(self, name: str, begins: float = 0.0, arm: str = "", seed: int = 0) -> None:
        super().__init__(begins, arm)
        if name not in ARM_LIES:
            raise ValueError(f"lie of an arm: {unknown_name(name, list(ARM_LIES))}")
        self._kind, self._seed = ARM_LIES[name], seed

    def driver(self, name: str, arm: SimArm) -> Any:
        """The arm's driver that lies, if it is about this arm."""
        if self.about and name != self.about:
            return arm
        return self._kind(arm, lambda stamp_ns: self.begun(stamp_ns, name), self._seed)
