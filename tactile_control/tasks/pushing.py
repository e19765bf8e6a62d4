"""Object pushing, the paper's Tasks 3 and 4: over a floor to a target; of two arms, the leader's part."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_control.alignment import AlignmentController, AlignmentSettings, Bearing, target_bearing
from tactile_control.contact_task import (
    APPROACH,
    LEAVE,
    SETTLE,
    ContactSettings,
    ContactTask,
    ContactTaskSettings,
)
from tactile_control.motion import smooth_ramp
from tactile_control.phases import DONE, FAILED, GO_TO_START, RETREAT, STOPPING, Goal, StampedPose
from tactile_control.steering import SteeringController, SteeringSettings
from tactile_filter import se3

Array = NDArray[np.float64]

PUSH = "push"
FRAMES = ("base", "world")


@dataclass(frozen=True)
class PushSettings(Settings):
    """How an object is pushed."""

    speed: float = setting(
        0.010, lower=1e-4, upper=0.1, unit="m/s", doc="reference speed into the surface, along z of {s'}"
    )
    ramp_time: float = setting(
        0.5,
        lower=0.0,
        upper=10.0,
        unit="s",
        doc="time in which the velocity comes in, smoothly; a tip that hardly presses yet slips sideways",
    )
    tip_radius: float = setting(
        0.020,
        lower=1e-3,
        upper=0.1,
        unit="m",
        doc="radius of the sensor's tip: nearer to the target than this the sensor's centre has arrived",
    )
    timeout: float = setting(180.0, lower=0.1, upper=3600.0, unit="s", doc="longest push")


@dataclass(frozen=True)
class PushingSettings(ContactTaskSettings):
    """All settings of pushing. What has lost its contact stays where it was lost."""

    contact: ContactSettings = field(
        default_factory=lambda: ContactSettings(lost_contact="fail", leave_first=False)
    )
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)
    steering: SteeringSettings = field(default_factory=SteeringSettings)
    task: PushSettings = field(default_factory=PushSettings)


@dataclass(frozen=True)
class PushingGoal(Goal):
    """Where to push."""

    target: tuple[float, ...] = setting(
        (), lower=-10.0, upper=10.0, unit="m", doc="position where the contact is to arrive, 3 numbers"
    )
    frame: str = setting(
        "base",
        choices=FRAMES,
        doc="frame of the target: the arm's base; or the world, in a task file alone, whose scene says where "
        "the base stands",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.target) != 3:
            raise SettingError(f"target: must be 3 numbers (x, y, z in m), has {len(self.target)}")

    def in_base(self, T_world_base: Array) -> PushingGoal:
        """The same target in the arm's base."""
        if self.frame == "base":
            return self
        target = se3.inverse(T_world_base) @ np.append(self.target, 1.0)
        return replace(self, target=tuple(target[:3].tolist()), frame="base")


class Pushing(ContactTask):
    """Pushes an object to a target."""

    settings_class = PushingSettings
    goal_class = PushingGoal
    work = PUSH
    phases = (LEAVE, GO_TO_START, APPROACH, SETTLE, PUSH, STOPPING, RETREAT, DONE, FAILED)

    settings: PushingSettings
    goal: PushingGoal

    def __init__(self, settings: PushingSettings, goal: PushingGoal, start: Array | None = None) -> None:
        super().__init__(settings, goal, start)
        self.alignment = AlignmentController(settings.alignment)
        self.steering = SteeringController(settings.steering)
        self._target = np.array(goal.target)
        self._sideways = np.zeros(6)
        self._steered_ns = 0
        self._way = 0.0
        self._checked = False

    def configure(self, settings: ContactTaskSettings) -> None:
        """Replace the settings, as in all tasks."""
        super().configure(settings)
        self.alignment.configure(self.settings.alignment)
        self.steering.configure(self.settings.steering)

    def reference_velocity(self, elapsed: float) -> Array:
        """Into the surface, and sideways as target alignment says."""
        ramp = smooth_ramp(elapsed, self.settings.task.ramp_time)
        speed = self.settings.task.speed * ramp
        assert self._belief is not None
        if self._belief.stamp_ns > self._steered_ns:
            self._steered_ns = self._belief.stamp_ns
            self._sideways = self._steer(self._belief, speed)
        return np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0]) + ramp * self._sideways

    def _steer(self, belief: StampedPose, speed: float) -> Array:
        """The sideways velocity (6,) in {s'} for a new belief."""
        T_base_sensor = self._sensor_pose()
        if not self.settings.steering.enabled:
            return self.alignment.step(belief.stamp_ns, self._bearing(), self._limited)
        down = T_base_sensor[:3, 0]
        self.steering.model.update(T_base_sensor[:3, 3], (T_base_sensor @ belief.T)[:3, 2], down)
        return self.steering.step(self._bearing().position, speed)

    def finished(self, elapsed: float) -> bool:
        """The sensor's centre is nearer to the target than its radius."""
        return self._distance(self._sensor_pose()) < self.settings.task.tip_radius

    def failure(self, elapsed: float) -> str:
        """The target was passed, or the push takes too long."""
        bearing = self._bearing()
        if bearing.position[2] < 0.0:
            beside = abs(bearing.position[1]) * 1e3
            return f"the target was passed {beside:.1f} mm beside the contact: it cannot be reached any more"
        if elapsed > self.settings.task.timeout:
            return f"the push was not done within {self.settings.task.timeout:g} s"
        return ""

    def fraction(self) -> float:
        """By the way that is left."""
        left = self._distance(self._sensor_pose()) - self.settings.task.tip_radius
        return min(max(1.0 - left / self._way, 0.0), 1.0)

    def _next_twist(self, now_ns: int) -> tuple[Array, str]:
        """Before anything moves, whether the target can be reached from where it begins."""
        if not self._checked and self._pose is not None:
            self._checked = True
            start = self._sensor_pose() if self.start is None else self.start
            self._way = self._distance(start) - self.settings.task.tip_radius
            if reason := self._objection(target_bearing(self._target, start, np.eye(4))):
                self._fail_here(reason)
                return np.zeros(6), ""
        return super()._next_twist(now_ns)

    def _objection(self, bearing: Bearing) -> str:
        """Why a target cannot be reached from there; '' where it can."""
        settings = self.settings.task
        x, _, z = bearing.position
        radius, seconds = settings.tip_radius, self._way / settings.speed
        if self.goal.frame != "base":
            return "the target is in the world, where only a task file knows the base: give it in frame base"
        if abs(x) >= radius:
            side = "below" if x > 0.0 else "above"
            return (
                f"the target lies {abs(x) * 1e3:.1f} mm {side} the plane in which the sensor pushes, its "
                f"yz-plane: give one within {radius * 1e3:g} mm of it"
            )
        if self._way <= 0.0:
            return (
                f"the target is {(self._way + radius) * 1e3:.1f} mm from the sensor's centre, nearer than "
                f"its radius of {radius * 1e3:g} mm: there is no way to push; give one further ahead"
            )
        if z <= 0.0:
            return (
                f"the target lies behind the sensor (bearing {bearing.angle_deg:.0f} deg), which pushes "
                "along its z: give a target ahead of it, or start on the object's other side"
            )
        if seconds > settings.timeout:
            return (
                f"the target is {self._way:.2f} m of pushing away, at {settings.speed * 1e3:g} mm/s "
                f"{seconds:.0f} s, over task.timeout ({settings.timeout:g} s): give a nearer one or more time"
            )
        return ""

    def _bearing(self) -> Bearing:
        """Of the target, in the reference sensor frame."""
        assert self._belief is not None
        X_sf = self._belief.T
        _, X_fs_reference = self.servoing.reference_for(se3.inverse(X_sf))
        return target_bearing(self._target, self._sensor_pose(), se3.compose(X_sf, X_fs_reference))

    def _distance(self, T_base_sensor: Array) -> float:
        """Of the sensor's centre from the target, m."""
        return se3.norm(T_base_sensor[:3, 3] - self._target)
