"""Object pushing, the paper's Tasks 3 and 4: over a floor to a target; of two arms, the leader's part."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.array_math import NUMBERS
from tactile_base.settings import SettingError, Settings, setting
from tactile_control.alignment import AlignmentController, AlignmentSettings, Bearing, target_bearing
from tactile_control.contact_phases import INTO_CONTACT
from tactile_control.contact_settings import ContactSettings, ContactTaskSettings
from tactile_control.contact_task import ContactTask
from tactile_control.motion import smooth_ramp
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING, Goal, PhaseFailed, StampedPose
from tactile_control.steering import SteeringController, SteeringSettings
from tactile_control.surface_check import SurfaceSettings
from tactile_geometry import se3

Array = NDArray[np.float64]

PUSH = "push"
FRAMES = ("base", "world")
BACK, STUCK = -0.5, 0.25  # parts of the speed: of a push that goes back, of one that goes on
OUT_OF_PLANE = 0.1  # of a direction: further out of the plane of pushing it is refused


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
    slow_depth: float = setting(
        0.0055, lower=0.0, upper=0.1, unit="m", doc="from this believed depth on the push goes slower"
    )
    stop_depth: float = setting(
        0.0059, lower=0.0, upper=0.1, unit="m",
        doc="and from this one on it goes back, at up to half the speed: more than slow_depth",
    )  # fmt: skip

    stuck_time: float = setting(
        2.0, lower=0.1, upper=60.0, unit="s",
        doc="a push that its depth holds up for so long fails: it topples, or something is in its way",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stop_depth <= self.slow_depth:
            raise SettingError(
                f"stop_depth: must be more than slow_depth ({self.slow_depth:g} m), is {self.stop_depth:g}"
            )

    def pace(self, depth: Any, math: Any = NUMBERS) -> Any:
        """How much of the speed is left at a believed depth (m): 1, less from `slow_depth` on, -0.5."""
        return math.clip((self.stop_depth - depth) / (self.stop_depth - self.slow_depth), BACK, 1.0)


@dataclass(frozen=True)
class PushingSettings(ContactTaskSettings):
    """All settings of pushing. What has lost its contact stays where it was lost; what is pushed moves."""

    contact: ContactSettings = field(
        default_factory=lambda: ContactSettings(lost_contact="fail", leave_first=False)
    )
    surface: SurfaceSettings = field(
        default_factory=lambda: SurfaceSettings(
            speed=0.03,
            turn_rate=0.5,
            yields=0.005,
            depth_margin=0.007,
            width_error=0.0014,
            still_way=0.06,
        )
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
    direction: tuple[float, ...] = setting(
        (), lower=-1.0, upper=1.0,
        doc="in which the sensor's axis is to point at the end, 3 numbers of any length; empty: as it comes",
    )  # fmt: skip
    frame: str = setting(
        "base",
        choices=FRAMES,
        doc="frame of target and direction: the arm's base; or the world, in a task file alone, whose scene "
        "says where the base stands",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.target) != 3:
            raise SettingError(f"target: must be 3 numbers (x, y, z in m), has {len(self.target)}")
        if self.direction and (len(self.direction) != 3 or not any(self.direction)):
            raise SettingError(f"direction: must be 3 numbers that are not all zero, is {self.direction}")

    def in_base(self, T_world_base: Array) -> PushingGoal:
        """A copy with the target in the arm's base."""
        if self.frame == "base":
            return self
        T = se3.inverse(T_world_base)
        target, direction = T @ np.append(self.target, 1.0), T[:3, :3] @ (self.direction or np.zeros(3))
        return replace(
            self,
            target=tuple(target[:3].tolist()),
            direction=tuple(direction.tolist()) if self.direction else (),
            frame="base",
        )


class Pushing(ContactTask):
    """Pushes an object to a target."""

    settings_class = PushingSettings
    goal_class = PushingGoal
    work = PUSH
    phases = (*INTO_CONTACT, PUSH, STOPPING, RETREAT, DONE, FAILED)

    settings: PushingSettings
    goal: PushingGoal

    def __init__(self, settings: PushingSettings, goal: PushingGoal, start: Array | None = None) -> None:
        super().__init__(settings, goal, start)
        self.alignment = AlignmentController(settings.alignment)
        self.steering = SteeringController(settings.steering)
        self._target = np.array(goal.target)
        self._sideways = np.zeros(6)
        self._steered_ns = 0
        self._went_on = self._way = 0.0
        self._checked = False

    def configure(self, settings: ContactTaskSettings) -> None:
        """Replace the settings, as in all tasks."""
        super().configure(settings)
        self.alignment.configure(self.settings.alignment)
        self.steering.configure(self.settings.steering)

    def reference_velocity(self, elapsed: float) -> Array:
        """Into the surface, and sideways as target alignment says; slower in all where it is too deep."""
        assert self.belief is not None
        settings = self.settings.task
        ramp = smooth_ramp(elapsed, settings.ramp_time)
        if self.belief.stamp_ns > self._steered_ns:
            self._steered_ns = self.belief.stamp_ns
            self._sideways = self._steer(self.belief, ramp * settings.speed)
        pace = ramp * settings.pace(se3.inverse(self.belief.T)[2, 3])
        if pace > STUCK or ramp < 1.0:
            self._went_on = elapsed
        velocity = max(pace, 0.0) * self._sideways
        velocity[2] += pace * settings.speed
        return velocity

    def _steer(self, belief: StampedPose, speed: float) -> Array:
        """The sideways velocity (6,) in {s'} for a new belief."""
        T_base_sensor, T_base_reference = self.T_base_sensor, self.T_base_reference
        bearing = target_bearing(self._target, T_base_reference)
        down = T_base_sensor[:3, 0]
        self.steering.model.update(T_base_sensor[:3, 3], (T_base_sensor @ belief.T)[:3, 2], down)
        if not self.settings.steering.enabled:
            return self.alignment.step(belief.stamp_ns, bearing, self.limited)
        if not self.goal.direction:
            return self.steering.step(bearing.position, speed, self.settings.task.tip_radius)
        return self.steering.step_to_pose(*self._end(bearing, T_base_reference), speed)

    def finished(self, elapsed: float) -> bool:
        """The sensor's centre is nearer to the target than its radius."""
        return self._distance(self.T_base_sensor) < self.settings.task.tip_radius

    def failure(self, elapsed: float) -> str:
        """The target was passed, the object does not go on, or the push takes too long."""
        bearing = target_bearing(self._target, self.T_base_reference)
        if bearing.position[2] < 0.0:
            beside = abs(bearing.position[1]) * 1e3
            missed = f"the target was passed {beside:.1f} mm beside the contact"
            return f"{missed}: it cannot be reached any more{self._why_missed()}"
        if elapsed > self.settings.task.timeout:
            return f"the push was not done within {self.settings.task.timeout:g} s"
        if (stuck := elapsed - self._went_on) > self.settings.task.stuck_time:
            return (
                f"the object has not gone on for {stuck:.1f} s: any further the contact would be deeper than "
                f"{self.settings.task.stop_depth * 1e3:g} mm; it topples, or something is in its way"
            )
        return ""

    def _why_missed(self) -> str:
        """What turned the object aside, if it was more than what steering is to expect."""
        steering = self.settings.steering
        drift = self.steering.model.drift
        if abs(drift) < steering.drift_deviation:
            return ""
        turned = f"; it turns by {0.01 * np.degrees(abs(drift)):.1f} deg for each 10 mm ahead"
        mended = "" if steering.enabled else ", which steering makes up for (controller pushing_tuned)"
        return f"{turned}: its friction is centred beside the contact{mended}"

    def ahead(self) -> list[Array]:
        """To the target, until it leaves; how the sensor will be turned there nobody knows."""
        if self.phase in (STOPPING, RETREAT, DONE, FAILED) or self.pose is None:
            return super().ahead()
        T = self.T_base_sensor.copy()
        T[:3, 3] = self.goal.target
        return [*super().ahead(), T]

    def fraction(self) -> float:
        """By the way that is left."""
        left = self._distance(self.T_base_sensor) - self.settings.task.tip_radius
        return min(max(1.0 - left / self._way, 0.0), 1.0)

    def before_phase(self) -> None:
        """Before anything moves, whether the target can be reached from where it begins."""
        if not self._checked and self.pose is not None:
            self._checked = True
            start = self.T_base_sensor if self.start is None else self.start
            self._way = self._distance(start) - self.settings.task.tip_radius
            bearing = target_bearing(self._target, start)
            if reason := self._objection(bearing) or self._objection_to_direction(bearing, start):
                raise PhaseFailed(reason, here=True)
        super().before_phase()

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

    def _objection_to_direction(self, bearing: Bearing, start: Array) -> str:
        """Why the push cannot end in the goal's direction; '' where it can or has none."""
        if not self.goal.direction:
            return ""
        if not self.settings.steering.enabled:
            return "a push can end in a direction with steering alone: set steering.enabled, or leave it out"
        end, direction = self._end(bearing, start)
        if abs(direction[0]) > OUT_OF_PLANE:
            out = math.degrees(math.asin(abs(direction[0])))
            return (
                f"the direction points {out:.0f} deg out of the plane in which the sensor pushes, its "
                "yz-plane: give one in it"
            )
        needed, most = self.steering.bends_at_most(end, direction, self.settings.task.speed)
        if needed > most:
            return (
                f"to end in that direction the push needs a curve of {1e3 / needed:.0f} mm radius, and an "
                f"object is pushed along one of {1e3 / most:.0f} mm at the tightest (steering.turning, "
                "steering.limit, task.speed): give a direction nearer to the target's, or a lower speed"
            )
        return ""

    def _end(self, bearing: Bearing, T_base_reference: Array) -> tuple[Array, Array]:
        """Where the sensor's centre is to end, and its axis then: (3,) each, in the reference frame."""
        direction = T_base_reference[:3, :3].T @ np.array(self.goal.direction)
        direction = direction / se3.norm(direction)
        return bearing.position - self.settings.task.tip_radius * direction, direction

    def _distance(self, T_base_sensor: Array) -> float:
        """Of the sensor's centre from the target, m."""
        return math.dist(T_base_sensor[:3, 3].tolist(), self.goal.target)
