"""Trajectory: an arm moves what it carries along a given path, as the leader of the paper's Task 1 does."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_control.free_task import MOVE, FreeTask, FreeTaskSettings
from tactile_control.motion import path_twist
from tactile_control.phases import DONE, Goal, Phase, PhaseFailed
from tactile_geometry import se3

Array = NDArray[np.float64]

_DIFFERENCE = 1e-4  # s of path time; velocities are central differences of poses, exact to 1e-8 of them
_TOLD = 150  # poses of the trajectory, where it is told what lies ahead
_STEPS = 1000  # in which a period is integrated: to a micrometre for the paper's motion
BASE, START, TOOL = "base", "start", "tool"
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
    """A displacement, an oscillation, or both one upon the other, along and about the `axes`.

    The oscillation is the paper's periodic velocity v(t) = (2 pi b / T) cos(2 pi t / T + phi), integrated:
    along the axes of the controlled frame as it moves ("tool"), or along fixed ones. About fixed axes
    rotations are rotation vectors about the controlled frame's origin, so that its rotational part is the
    angular velocity where the three rotational phases are equal, as they are in the paper.
    """

    axes: str = setting(
        BASE,
        choices=(BASE, START, TOOL),
        doc="of what follows: the base's; those of the controlled frame at the start; or of that frame as it "
        "moves, so that velocities are twists in it",
    )
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

    def velocity(self, seconds: float) -> Array:
        """Velocity (6,) at that time of full speed, m/s and rad/s."""
        rate = 2.0 * np.pi / self.period
        part = np.array(self.displacement) / self.duration
        part += np.array(self.amplitude) * rate * np.cos(rate * seconds + np.radians(self.phase_deg))
        return np.concatenate([part[:3], np.radians(part[3:])])

    def offset(self, seconds: float) -> Array:
        """Displacement (m) and rotation vector (rad), (6,) along fixed axes, after that time."""
        part = np.array(self.displacement) * (seconds / self.duration)
        angle = 2.0 * np.pi * seconds / self.period
        phase = np.radians(self.phase_deg)
        part += np.array(self.amplitude) * (np.sin(angle + phase) - np.sin(phase))
        return np.concatenate([part[:3], np.radians(part[3:])])


class Along(Phase["Trajectory"]):
    """Feedforward of the trajectory's own twist, and feedback of the distance from it."""

    name, leads_to, needs = MOVE, DONE, ("pose",)

    def begin(self) -> None:
        self.T_base_origin: Array | None = None
        self.path_s = self.rate = 0.0
        self.moved_ns = self.ended_ns = self.last_ns = 0
        self.error, self.feedforward = np.full(6, np.nan), np.zeros(6)
        self._whole: list[tuple[float, Array]] = []
        self._period = [np.eye(4)]  # motions since the start under the twists of one period
        goal, step = self.task.goal, self.task.goal.period / _STEPS
        for k in range(_STEPS if goal.axes == TOOL else 0):
            self._period.append(self._period[-1] @ se3.exp(step * goal.velocity((k + 0.5) * step)))

    def pose(self, seconds: float) -> Array:
        """Where the controlled frame is to be in the base (4, 4), after that time at full speed."""
        assert self.T_base_origin is not None
        origin, goal = self.T_base_origin, self.task.goal
        if goal.axes == TOOL:
            return np.asarray(origin @ self._driven(seconds))
        offset = goal.offset(seconds)
        turn = se3.exp(np.concatenate([np.zeros(3), offset[3:]]))[:3, :3]
        T = origin.copy()
        T[:3, :3] = turn @ origin[:3, :3] if goal.axes == BASE else origin[:3, :3] @ turn
        T[:3, 3] += offset[:3] if goal.axes == BASE else origin[:3, :3] @ offset[:3]
        return T

    def _driven(self, seconds: float) -> Array:
        """Motion (4, 4) since the start under the twists of the goal, which repeat with its period."""
        goal, step = self.task.goal, self.task.goal.period / _STEPS
        periods, rest = divmod(seconds, goal.period)
        whole = self._period[-1] if periods >= 0 else se3.inverse(self._period[-1])
        k = min(int(rest / step), _STEPS - 1)
        left = rest - k * step
        last = se3.exp(left * goal.velocity(k * step + 0.5 * left))
        return np.asarray(np.linalg.matrix_power(whole, abs(int(periods))) @ self._period[k] @ last)

    def over(self) -> bool:
        pose, now_ns = self.task.pose, self.task.now_ns
        assert pose is not None
        if self.T_base_origin is None:
            self.T_base_origin, self.moved_ns = pose.T.copy(), pose.stamp_ns
        if now_ns - self.last_ns > WAITED * SECOND_NS:  # the arm was led to rest meanwhile
            self.moved_ns, self.rate = pose.stamp_ns, 0.0
        self.last_ns = now_ns
        self._advance(pose.stamp_ns)
        self.feedforward, self.error = path_twist(self.pose, self.path_s, self.rate, _DIFFERENCE, pose.T)
        off = float(np.linalg.norm(self.error[:3]))
        if off > self.task.settings.task.largest_error:
            raise PhaseFailed(f"the arm is {1e3 * off:.1f} mm off its trajectory")
        return self.path_s >= self.task.goal.duration and self._arrived(pose.stamp_ns)

    def ahead(self) -> list[Array]:
        if self.T_base_origin is not None and not self._whole:
            seconds = np.linspace(0.0, self.task.goal.duration, _TOLD).tolist()
            self._whole = [(second, self.pose(second)) for second in seconds]
        return [T for second, T in self._whole if second >= self.path_s]

    def twist(self) -> Array:
        return self.feedforward + self.task.settings.task.gain * self.error

    def _arrived(self, stamp_ns: int) -> bool:
        """Whether the arm has come to the trajectory's end; it fails if that takes too long."""
        travel = self.task.settings.travel
        self.ended_ns = self.ended_ns or stamp_ns
        if (stamp_ns - self.ended_ns) * NANOSECOND > travel.timeout:
            raise PhaseFailed(f"the end of the trajectory was not reached within {travel.timeout:g} s")
        distance, angle = np.linalg.norm(self.error[:3]), np.linalg.norm(self.error[3:])
        return bool(distance <= travel.position_tolerance and angle <= travel.angle_tolerance)

    def _advance(self, stamp_ns: int) -> None:
        """Go on along the trajectory to where the arm should be at the stamp of its pose."""
        settings = self.task.settings.task
        elapsed = (stamp_ns - self.moved_ns) * NANOSECOND
        self.moved_ns = stamp_ns
        left = self.task.goal.duration - self.path_s
        if left <= 0.0:
            self.rate = 0.0
            return
        full, ramp = settings.speed_factor, settings.ramp_time
        if ramp > 0.0:
            # a square-root law slows down evenly to the end, so that the last stretch takes the ramp's time
            speeding = self.rate + full * elapsed / ramp
            braking = np.sqrt(max(0.0, 2.0 * left * full / ramp))
            self.rate = float(min(full, speeding, max(braking, full * 1e-2)))
        else:
            self.rate = full
        self.path_s = min(self.task.goal.duration, self.path_s + elapsed * self.rate)


class Trajectory(FreeTask):
    """Moves the controlled frame along a trajectory from where it is, or from its start."""

    settings_class = TrajectoryTaskSettings
    goal_class = TrajectoryGoal

    settings: TrajectoryTaskSettings
    goal: TrajectoryGoal

    def move(self) -> Along:
        self._along = Along(self)
        self._along.begin()
        return self._along

    def details(self) -> dict[str, Any]:
        """How far off it is."""
        if self.phase != MOVE:
            return super().details()
        return {**super().details(), "error": self._along.error, "feedforward": self._along.feedforward}

    def progress(self) -> float:
        """By the time along the trajectory."""
        return self._along.path_s / self.goal.duration
