"""ArmWatch: is what a driver says of its arm possible, in time, and what the arm was told?

States that cannot be true are not believed. An arm that is where it cannot have come to, that does otherwise
than it was told, or whose states come late, is stopped by the safe command stage until a reset: an alarm.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_drivers.tracking_monitor import Deviation, TrackingMonitor, in_base
from tactile_geometry import se3
from tactile_scene import _native
from tactile_scene.arm import HELD_UP, ArmState
from tactile_scene.arm_settings import ArmLimits, SafetySettings, TrackingSettings
from tactile_scene.kinematics.joint_limits import Kinematics

Array = NDArray[np.float64]

_OFF, _TURNED = 0.02, 0.05  # m, rad, by which an arm may differ from its kinematics
_AVERAGED, _COUNTED = 0.3, 0.02  # s, over which states' lateness is averaged, and counted at most of each

DOES_NOT_STOP = "THE ARM DOES NOT STOP"  # how the loudest reason begins


class ArmWatch:
    """What is to be held against an arm; see the module's text.

    Parameters
    ----------
    clock : callable
        The time now, ns, on the clock of the states.

    Attributes
    ----------
    alarm : str
        Why the arm has to be stopped until a reset; '' if it has not. The first reason stays.
    runaway : str
        That it does not stop, although it was told to, in words that are hard to overlook; else ''.
    """

    def __init__(
        self, limits: ArmLimits, safety: SafetySettings, tracking: TrackingSettings, clock: Callable[[], int]
    ) -> None:
        self._limits, self._safety, self._clock = limits, safety, clock
        self._monitor = TrackingMonitor(limits, tracking)
        braking = limits.linear_velocity / limits.linear_acceleration
        self._brakes_ns = round((tracking.lag + tracking.window + braking) * SECOND_NS)
        self.restart()

    def restart(self) -> None:
        """Nothing is known of the arm, and there is no alarm."""
        self.alarm = self.runaway = ""
        self._monitor.restart()
        self._last: ArmState | None = None
        self._fastest = 0.0  # m/s, that the arm was told since its last state
        self._lateness, self._heard_ns = 0.0, 0
        self._stop, self._stop_ns = "", 0  # why it was told to stop, and when, until it rests

    @property
    def moves(self) -> bool:
        """Whether its poses moved lately."""
        return self._monitor.moves

    # ---- what the arm is told ----

    def told(self, twist: Array) -> None:
        """It is told a twist (6,) of the controlled frame, in it."""
        self._fastest = max(self._fastest, _native.speed(twist))
        if self._last is not None:
            self._monitor.told(self._clock(), in_base(self._last.T_base_controlled, twist))

    def told_to_stop(self, reason: str) -> None:
        """It is told to stop, after a twist of zero."""
        if not self._stop:
            self._stop, self._stop_ns = reason, self._clock()

    # ---- what it says ----

    def objection(self, state: ArmState, kinematics: Kinematics | None, others: bool) -> str:
        """Why a state cannot be true; '' if it can. `others`: whether somebody else may move the arm now."""
        if not isinstance(state, ArmState):
            return f"it is a {type(state).__name__}, must be an ArmState"
        try:
            se3.checked_pose("pose", state.T_base_controlled)
        except se3.PoseError as error:
            return str(error)
        if np.shape(state.twist) != (6,):
            return f"twist has the shape {np.shape(state.twist)}, must be (6,)"
        if not _native.finite(state.twist):
            return f"twist is not finite: {np.asarray(state.twist).tolist()}"
        if state.joints is not None and not np.isfinite(state.joints).all():
            return f"joints are not finite: {np.asarray(state.joints).tolist()}"
        if self._last is None:
            return another_arm(state, kinematics)
        elapsed = (state.stamp_ns - self._last.stamp_ns) / SECOND_NS
        if elapsed < 0.0:
            return f"the state is {-elapsed:.3f} s older than the last one"
        way = _native.distance(state.T_base_controlled, self._last.T_base_controlled)
        if way <= self._safety.jump or way <= self._safety.jump + self._reach(elapsed, others):
            return ""
        self.alarm = self.alarm or (
            f"the arm cannot have moved by {way * 1e3:.1f} mm in {elapsed * 1e3:.1f} ms: "
            "where it is is not known"
        )
        return self.alarm

    def see(self, state: ArmState, twist: Array, others: bool) -> bool:
        """Take a state that can be true, of an arm that is told a twist (6,); whether to stop it (again).

        Parameters
        ----------
        others : whether somebody else may move the arm now
        """
        self._last, self._fastest = state, _native.speed(twist)
        self._note_lateness(state.stamp_ns)
        if others:
            self._monitor.restart()
            return False
        if not self._monitor.due(state.stamp_ns):
            return False
        self._monitor.told(state.stamp_ns, in_base(state.T_base_controlled, twist))
        deviation = self._monitor.see(state, self._clock() - state.stamp_ns)
        if not self._monitor.moves:
            self._stop = ""
        return self._judged(deviation, bool(twist.any()))

    def remarks(self) -> str:
        """What is not as it should be, and no reason for an alarm."""
        late = self._lateness > 0.5 * self._safety.state_age
        return "; ".join(filter(None, (self._monitor.shortfall, self._late_by() if late else "")))

    def _judged(self, deviation: Deviation | None, told_to_move: bool) -> bool:
        """Whether the arm is to be stopped, for what it does otherwise or for what it says too late.

        At rest nothing depends on when it says something: a busy machine is no fault of an arm that waits.
        """
        late = told_to_move and self._lateness > self._safety.state_age
        if deviation is None:
            new = late and not self.alarm
            self.alarm = self.alarm or (self._late_by() if late else "")
            return new
        if deviation.by_itself and self._stop and self._clock() - self._stop_ns > self._brakes_ns:
            self.runaway = self.runaway or (
                f"{DOES_NOT_STOP}, press the emergency stop that is wired to it: {deviation.text}, "
                f"after a stop ({self._stop})"
            )
        what = "moves by itself" if deviation.by_itself else "does not do what it is told"
        self.alarm = self.alarm or f"the arm {what}: {deviation.text}"
        return True

    def _reach(self, elapsed: float, others: bool) -> float:
        """How far (m) the arm can have come since its last state by what it was told.

        Silence stops it, and then it does not go on. Twice: each axis has the limit, and the clock of an arm
        is not ours.
        """
        assert self._last is not None
        if others:
            return 2.0 * self._limits.linear_velocity * elapsed
        speed = max(self._fastest, _native.speed(self._last.twist))
        moving = min(elapsed, self._limits.command_timeout + self._monitor.settings.lag)
        braking = self._limits.braking_distance(speed) if elapsed > moving else 0.0
        return 2.0 * (speed * moving + braking)

    def _note_lateness(self, stamp_ns: int) -> None:
        """Average how late states come, so that what a pause has held up counts for little."""
        now_ns = self._clock()
        late = max(0.0, (now_ns - stamp_ns) / SECOND_NS)
        counted = min(max(0.0, (now_ns - self._heard_ns) / SECOND_NS), _COUNTED)
        self._lateness += counted / _AVERAGED * (late - self._lateness)
        self._heard_ns = now_ns

    def _late_by(self) -> str:
        late, limit = self._lateness, self._safety.state_age
        return f"states of the arm come {late:.3f} s late (limit {limit:g} s): {HELD_UP}"


def another_arm(state: ArmState, kinematics: Kinematics | None) -> str:
    """Why the joints of a state are not those of the kinematics; '' if they are, or are not known."""
    if kinematics is None or state.joints is None:
        return ""
    if len(state.joints) != len(kinematics.names):
        return f"the arm tells {len(state.joints)} joints, its kinematics have {len(kinematics.names)}"
    error = se3.log(se3.inverse(kinematics.pose(state.joints)) @ state.T_base_controlled)
    way, turn = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    if way <= _OFF and turn <= _TURNED:
        return ""
    return (
        f"with its joints as they are, its kinematics in the scene put it {way * 1e3:.0f} mm and "
        f"{np.degrees(turn):.0f} degrees from where it says it is: are `description` "
        "and `tool` those of this arm?"
    )
