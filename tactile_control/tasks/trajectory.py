"""Trajectory: an arm moves what it carries along a given path, as the leader of the paper's Task 1 does."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_control.free_task import MOVE, FreeTask, FreeTaskSettings
from tactile_control.phases import DONE, Command, Goal
from tactile_geometry import se3

Array = NDArray[np.float64]

_DIFFERENCE = 1e-4  # s of path time; velocities are central differences of poses, exact to 1e-8 of them
WAITED = 0.1  # s between two steps of the move, in which the arm has waited: it goes on from there


@dataclass(frozen=True)
class TrajectorySettings(Settings):
    """How fast a trajectory is gone along, and how closely."""

    speed_factor: float = setting(
        1.0, lower=0.01, upper=20.0, doc="the trajectory is gone along so many times as fast as its goal says"
    )
    ramp_time: float = setting(
        1.0, lower=0.0, upper=30.0, unit="s", doc="time in which the speed comes in, and goes out, smoothly"
    )
    gain: float = setting(
        2.0, lower=0.0, upper=50.0, unit="1/s", doc="feedback: speed per distance from the trajectory"
    )
    largest_error: float = setting(
        0.02, lower=1e-4, upper=1.0, unit="m", doc="further from the trajectory than this the task fails"
    )


@dataclass(frozen=True)
class TrajectoryTaskSettings(FreeTaskSettings):
    """All settings of the trajectory task."""

    task: TrajectorySettings = field(default_factory=TrajectorySettings)


def _six(doc: str) -> tuple[float, ...]:
    """A setting of six numbers: x, y, z (m), then about x, y, z (deg)."""
    upper = [2.0] * 3 + [360.0] * 3
    lower = [-bound for bound in upper]
    value: tuple[float, ...] = setting([0.0] * 6, length=6, lower=lower, upper=upper, unit="m, deg", doc=doc)
    return value


@dataclass(frozen=True)
class TrajectoryGoal(Goal):
    """A displacement, an oscillation, or both one upon the other, along and about the axes of the base.

    The oscillation is the paper's periodic velocity v(t) = (2 pi b / T) cos(2 pi t / T + phi), integrated;
    rotations are rotation vectors about the controlled frame's origin, so that its rotational part is the
    angular velocity where the three rotational phases are equal, as they are in the paper.
    """

    displacement: tuple[float, ...] = _six("x, y, z (m) and turn about x, y, z (deg) at the end")
    speed: float = setting(0.015, lower=1e-5, upper=1.0, unit="m/s", doc="speed of the displacement")
    angular_speed_deg: float = setting(
        5.0, lower=1e-2, upper=180.0, unit="deg/s", doc="speed of its turn; the slower of both determines it"
    )
    amplitude: tuple[float, ...] = _six("b of the oscillation")
    phase_deg: tuple[float, ...] = setting(
        [0.0] * 6, length=6, lower=-360.0, upper=360.0, unit="deg", doc="phi of the oscillation"
    )
    period: float = setting(30.0, lower=0.1, upper=3600.0, unit="s", doc="T of the oscillation")
    periods: float = setting(3.0, lower=0.0, upper=1e4, doc="length of the oscillation in periods")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.duration == 0.0:
            raise SettingError("displacement and amplitude are zero: there is nothing to move along")

    @property
    def duration(self) -> float:
        """Time that it takes at full speed, s."""
        way = np.array(self.displacement)
        lengths = np.linalg.norm(way[:3]) / self.speed, np.linalg.norm(way[3:]) / self.angular_speed_deg
        swing = self.period * self.periods if any(self.amplitude) else 0.0
        return max(float(lengths[0]), float(lengths[1]), swing)

    def offset(self, seconds: float) -> Array:
        """Displacement (m) and rotation vector (rad), (6,) in the base, after that time at full speed."""
        part = np.array(self.displacement) * (seconds / self.duration)
        angle = 2.0 * np.pi * seconds / self.period
        phase = np.radians(self.phase_deg)
        part += np.array(self.amplitude) * (np.sin(angle + phase) - np.sin(phase))
        return np.concatenate([part[:3], np.radians(part[3:])])


class Trajectory(FreeTask):
    """Moves the controlled frame along a trajectory from where it is, or from its start."""

    settings_class = TrajectoryTaskSettings
    goal_class = TrajectoryGoal

    settings: TrajectoryTaskSettings
    goal: TrajectoryGoal

    def __init__(
        self, settings: TrajectoryTaskSettings, goal: TrajectoryGoal, start: Array | None = None
    ) -> None:
        super().__init__(settings, goal, start)
        self._T_base_origin: Array | None = None
        self._path_s = 0.0
        self._moved_ns: int | None = None
        self._ended_ns = self._last_ns = 0
        self._rate = 0.0
        self._error = np.full(6, np.nan)
        self._feedforward = np.zeros(6)

    def pose(self, seconds: float) -> Array:
        """Where the controlled frame is to be in the base (4, 4), after that time at full speed."""
        assert self._T_base_origin is not None
        offset = self.goal.offset(seconds)
        T = np.eye(4)
        T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), offset[3:]]))[:3, :3] @ self._T_base_origin[:3, :3]
        T[:3, 3] = self._T_base_origin[:3, 3] + offset[:3]
        return T

    def _move(self, now_ns: int) -> Array:
        """Feedforward of the trajectory's own twist, and feedback of the distance from it."""
        pose = self._pose
        assert pose is not None
        if self._T_base_origin is None:
            self._T_base_origin, self._moved_ns = pose.T.copy(), pose.stamp_ns
        if now_ns - self._last_ns > WAITED * SECOND_NS:  # the arm was led to rest meanwhile
            self._moved_ns, self._rate = pose.stamp_ns, 0.0
        self._last_ns = now_ns
        self._advance(pose.stamp_ns)
        wanted = self.pose(self._path_s)
        X_error = se3.inverse(pose.T) @ wanted
        self._error = se3.log(X_error)
        if np.linalg.norm(self._error[:3]) > self.settings.task.largest_error:
            distance = 1e3 * float(np.linalg.norm(self._error[:3]))
            return self._fail(f"the arm is {distance:.1f} mm off its trajectory")
        if self._path_s >= self.goal.duration and self._arrived(pose.stamp_ns):
            self._enter(DONE)
            return np.zeros(6)
        ahead, behind = self.pose(self._path_s + _DIFFERENCE), self.pose(self._path_s - _DIFFERENCE)
        twist = se3.log(se3.inverse(behind) @ ahead) * (self._rate / (2.0 * _DIFFERENCE))
        self._feedforward = se3.adjoint(X_error) @ twist
        return self._feedforward + self.settings.task.gain * self._error

    def _arrived(self, stamp_ns: int) -> bool:
        """Whether the arm has come to the trajectory's end; it fails if that takes too long."""
        travel = self.settings.travel
        self._ended_ns = self._ended_ns or stamp_ns
        if (stamp_ns - self._ended_ns) * NANOSECOND > travel.timeout:
            self._fail(f"the end of the trajectory was not reached within {travel.timeout:g} s")
        distance, angle = np.linalg.norm(self._error[:3]), np.linalg.norm(self._error[3:])
        return bool(distance <= travel.position_tolerance and angle <= travel.angle_tolerance)

    def _advance(self, stamp_ns: int) -> None:
        """Go on along the trajectory to where the arm should be at the stamp of its pose."""
        assert self._moved_ns is not None
        settings = self.settings.task
        elapsed = (stamp_ns - self._moved_ns) * NANOSECOND
        self._moved_ns = stamp_ns
        left = self.goal.duration - self._path_s
        if left <= 0.0:
            self._rate = 0.0
            return
        full, ramp = settings.speed_factor, settings.ramp_time
        if ramp > 0.0:
            # a square-root law slows down evenly to the end, so that the last stretch takes the ramp's time
            speeding = self._rate + full * elapsed / ramp
            braking = np.sqrt(max(0.0, 2.0 * left * full / ramp))
            self._rate = float(min(full, speeding, max(braking, full * 1e-2)))
        else:
            self._rate = full
        self._path_s = min(self.goal.duration, self._path_s + elapsed * self._rate)

    def _answer(self, wanted: Array, waiting: str) -> Command:
        common = super()._answer(wanted, waiting)
        moving = self.phase == MOVE
        return Command(
            **{
                **vars(common),
                "error": self._error if moving else np.full(6, np.nan),
                "feedforward": self._feedforward if moving else np.zeros(6),
            }
        )

    def _fraction(self) -> float:
        return self._path_s / self.goal.duration
