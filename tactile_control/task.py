"""Surface following as a state machine: go to the start, approach, settle, follow, retreat.

A library without ROS and without a clock of its own: whoever owns the time calls `step(now_ns, inputs)` at
the control rate and sends the twist of the `Command` that comes back. In between, settings can be replaced
(`configure`) and the task can be asked to end (`stop`)::

    task = SurfaceFollowing(settings, PathGoal(direction=math.pi / 2, length=0.1))
    while not (command := task.step(now_ns(), inputs())).done:
        send(command.twist)

Phases: go_to_start -> approach -> settle -> follow -> retreat -> done, or failed; how a task stops and fails
is told in `phases`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_control.motion import Odometer, Waypoint, smooth_ramp, twist_towards, way_to_start
from tactile_control.phases import (
    DONE,
    FAILED,
    GO_TO_START,
    RETREAT,
    STOPPING,
    PhaseMachine,
    StampedPose,
    TaskCommand,
    newer,
)
from tactile_control.pid import NANOSECOND
from tactile_control.servoing import ServoingController, ServoingOutput
from tactile_control.task_settings import SurfaceFollowingSettings
from tactile_filter import se3
from tactile_filter.prediction import ContactPredictor
from tactile_filter.transform_buffer import TransformBuffer, TransformUnavailable

Array = NDArray[np.float64]

APPROACH = "approach"
SETTLE = "settle"
FOLLOW = "follow"
PHASES = (GO_TO_START, APPROACH, SETTLE, FOLLOW, STOPPING, RETREAT, DONE, FAILED)

# inputs whose age matters, by phase; a phase that is not here moves without looking
NEEDS = {
    GO_TO_START: ("sensor_pose", "presence"),
    APPROACH: ("sensor_pose", "presence"),
    SETTLE: ("sensor_pose", "presence", "belief"),
    FOLLOW: ("sensor_pose", "presence", "belief"),
    RETREAT: ("sensor_pose",),
}
WATCHDOG_NAMES = {"sensor_pose": "pose", "presence": "presence", "belief": "belief"}
TRACK_NS = SECOND_NS  # the sensor's poses are remembered for this long

# progress at which each phase begins; following takes the large middle part
PROGRESS = {GO_TO_START: 0.0, APPROACH: 0.04, SETTLE: 0.07, FOLLOW: 0.1, RETREAT: 0.97, DONE: 1.0}


@dataclass(frozen=True)
class StampedPresence:
    """Whether the sensor touches, at the exposure's stamp."""

    stamp_ns: int
    in_contact: bool


@dataclass(frozen=True)
class TaskInputs:
    """The latest of each input; None where none has arrived yet."""

    belief: StampedPose | None = None
    presence: StampedPresence | None = None
    sensor_pose: StampedPose | None = None


@dataclass(frozen=True)
class PathGoal:
    """One path over a surface.

    Attributes
    ----------
    direction : float
        Direction of motion in the xy-plane of the reference frame {s'}, rad from x towards y.
    length : float
        Arc length of the sensor centre's path after which the path is done, m.
    start : ndarray (4, 4) or None
        T_base_sensor in the air from where to approach; None: approach from where the arm stands.
    target : ndarray (3,) or None
        Position in the base, m: done when the sensor's centre comes within `target_radius` of it. Arriving
        nowhere near within `length` is then a failure.
    name : str
        For people.
    """

    direction: float = np.pi / 2
    length: float = 0.1
    start: Array | None = None
    target: Array | None = None
    target_radius: float = 0.002
    name: str = "path"

    def __post_init__(self) -> None:
        if not np.isfinite(self.direction):
            raise ValueError(f"direction = {self.direction}: must be a finite angle in rad")
        if not 0.0 < self.length < 100.0:
            raise ValueError(f"length = {self.length} m: must lie in (0, 100) m")
        if self.start is not None:
            se3.checked_pose("start", self.start)
        if self.target is not None and (np.shape(self.target) != (3,) or not np.isfinite(self.target).all()):
            raise ValueError(f"target = {self.target}: must be three finite numbers, m")


@dataclass(frozen=True)
class Command(TaskCommand):
    """What one step of surface following says, beyond a `TaskCommand`; its phase is one of `PHASES`.

    Attributes
    ----------
    error, feedforward : ndarray (6,)
        log(X_ss') and Ad(X_ss') v of the servoing controller; NaN and zero in phases that do not servo.
    progress : float
        0 to 1 over all phases; it never goes back.
    travelled : float
        Arc length followed so far, m.
    exposure_ns : int
        Stamp of the belief that the twist is based on, 0 for none.
    """

    error: Array
    feedforward: Array
    progress: float
    travelled: float
    exposure_ns: int


class SurfaceFollowing(PhaseMachine[TaskInputs, Command]):
    """Follows one path over a surface; see the module's text. One object runs one goal."""

    def __init__(self, settings: SurfaceFollowingSettings, goal: PathGoal) -> None:
        handlers = {
            GO_TO_START: self._go_to_start,
            APPROACH: self._approach,
            SETTLE: self._settle,
            FOLLOW: self._follow,
            STOPPING: self._stopping,
            RETREAT: self._retreat,
        }
        first = GO_TO_START if goal.start is not None else APPROACH
        super().__init__(first, handlers, settings.limiter, settings.watchdog)
        self.settings = settings
        self.goal = goal
        self.servoing = ServoingController(settings.servoing, settings.pid)
        self.predictor = ContactPredictor(settings.prediction)
        self._odometer = Odometer(settings.task.pose_step)
        self._track = TransformBuffer(TRACK_NS)
        self._phase_pose: Array | None = None
        self._belief: StampedPose | None = None
        self._presence: StampedPresence | None = None
        self._servo: ServoingOutput | None = None
        self._waypoints: list[Waypoint] | None = None
        self._contact_ns: int | None = None
        self._touch_ns = 0
        self._touch_position: Array | None = None
        self._settled_ns: int | None = None
        self._reapproaches = 0
        self._progress = 0.0
        self._limited = False

    # ---- what the owner calls ----

    def configure(self, settings: SurfaceFollowingSettings) -> None:
        """Replace the settings; they hold from the next step on, gains without a jump of the twist."""
        self.settings = settings
        self.servoing.configure(settings.servoing, settings.pid)
        self.limiter.configure(settings.limiter)
        self.watchdog.configure(settings.watchdog)
        self.predictor.configure(settings.prediction)
        self._odometer.step = settings.task.pose_step

    # ---- inputs ----

    def _take(self, inputs: TaskInputs) -> None:
        pose, belief = inputs.sensor_pose, inputs.belief
        if newer(pose, self._pose):
            se3.checked_pose("sensor pose", pose.T)
            self._pose = pose
            self._follow_sensor()
        if newer(inputs.presence, self._presence):
            self._presence = inputs.presence
        if newer(belief, self._belief):
            se3.checked_pose("belief", belief.T)
            self._belief = belief
            self._follow_contact()

    def _follow_sensor(self) -> None:
        assert self._pose is not None
        if self.settings.prediction.enabled:
            self._track.set_transform("base", "sensor", self._pose.stamp_ns, self._pose.T)

    def _follow_contact(self) -> None:
        """Let the predictor know the belief, with the sensor's pose at its exposure."""
        assert self._belief is not None
        if not self.settings.prediction.enabled:
            return
        stamp_ns = self._belief.stamp_ns
        try:
            self.predictor.update(stamp_ns, self._belief.T, self._track.lookup("base", "sensor", stamp_ns))
        except TransformUnavailable:
            self.predictor.reset()  # without the pose then, nothing can be carried on

    def _stamps(self) -> dict[str, int | None]:
        latest = {"sensor_pose": self._pose, "presence": self._presence, "belief": self._belief}
        return {
            WATCHDOG_NAMES[name]: value.stamp_ns if (value := latest[name]) is not None else None
            for name in NEEDS.get(self.phase, ())
        }

    def _missing(self) -> list[str]:
        """After a touch the belief has to be of an image exposed since: one from before was of no contact."""
        missing = super()._missing()
        if self.phase == SETTLE and not missing and self._belief is not None:
            missing = ["belief since the contact"] if self._belief.stamp_ns < self._touch_ns else []
        return missing

    def _start_timeout(self) -> float:
        return self.settings.task.start_timeout

    # ---- phases: each returns the twist wanted now ----

    def _go_to_start(self, now_ns: int) -> Array:
        pose, settings = self._sensor_pose(), self.settings.task
        assert self.goal.start is not None
        if self._waypoints is None:
            self._waypoints = way_to_start(pose, self.goal.start, settings)
        if self._touching() and self._in_phase(now_ns) > settings.lost_contact_time:
            return self._fail("touched something on the way to the start")
        if self._in_phase(now_ns) > settings.travel_timeout:
            return self._fail(f"the start was not reached within {settings.travel_timeout:g} s")
        while self._waypoints and self._waypoints[0].reached(pose):
            self._waypoints.pop(0)
        if not self._waypoints:
            self._enter(APPROACH)
            return np.zeros(6)
        return twist_towards(pose, self._waypoints[0].T_base_goal, settings)

    def _approach(self, now_ns: int) -> Array:
        settings = self.settings.task
        if self._pressed() >= settings.press_distance:
            self.servoing.reset()
            self._servo = None
            self._enter(SETTLE)
            return np.zeros(6)
        if self._gone_from_phase_start() > settings.approach_distance:
            return self._fail(f"no contact within {settings.approach_distance * 1e3:.1f} mm of approach")
        if self._in_phase(now_ns) > settings.approach_timeout:
            return self._fail(f"no contact within {settings.approach_timeout:g} s of approach")
        return _along_z(settings.approach_speed)

    def _pressed(self) -> float:
        """Way since the first touch of this approach, m; negative before it."""
        if not self._touching():
            self._touch_position = None
            return -1.0
        assert self._presence is not None
        position = self._sensor_pose()[:3, 3]
        if self._touch_position is None:
            self._touch_position = position.copy()
            self._touch_ns = self._contact_ns = self._presence.stamp_ns
        return float(np.linalg.norm(position - self._touch_position))

    def _settle(self, now_ns: int) -> Array:
        settings = self.settings.task
        if self._contact_lost():
            return self._after_lost_contact()
        # the way in is no steady error: an integral of it would only be an offset on the path
        output = self._serve(np.zeros(6), hold_integral=True)
        depth, tilt = abs(output.error[2]), float(np.linalg.norm(output.error[3:5]))
        if depth > settings.settle_depth_tolerance or tilt > settings.settle_angle_tolerance:
            self._settled_ns = None
        elif self._settled_ns is None:
            self._settled_ns = now_ns
        if self._settled_ns is not None and (now_ns - self._settled_ns) * NANOSECOND >= settings.settle_time:
            self._odometer.break_off()
            self._enter(FOLLOW)
        elif self._in_phase(now_ns) > settings.settle_timeout:
            return self._fail(
                f"not settled within {settings.settle_timeout:g} s: depth error {depth * 1e3:.2f} mm, "
                f"tilt error {np.degrees(tilt):.2f} deg"
            )
        return output.twist

    def _follow(self, now_ns: int) -> Array:
        settings = self.settings.task
        if self._contact_lost():
            return self._after_lost_contact()
        position = self._sensor_pose()[:3, 3]
        travelled = self._odometer.add(position)
        near = (
            self.goal.target is not None
            and np.linalg.norm(position - self.goal.target) <= self.goal.target_radius
        )
        if near or (self.goal.target is None and travelled >= self.goal.length):
            self._enter(RETREAT)
        elif travelled >= self.goal.length:
            return self._fail(f"the target was not reached within {self.goal.length * 1e3:.1f} mm of path")
        elif self._in_phase(now_ns) > settings.follow_timeout:
            return self._fail(f"the path was not done within {settings.follow_timeout:g} s")
        return self._serve(self._reference_velocity(self._in_phase(now_ns))).twist

    def _stopping(self, now_ns: int) -> Array:
        if self._at_rest():
            self._enter(RETREAT if self._contact_ns is not None else FAILED)
        return np.zeros(6)

    def _retreat(self, now_ns: int) -> Array:
        settings = self.settings.task
        if self._gone_from_phase_start() >= settings.retreat_distance:
            self._enter(FAILED if self.reason else DONE)
            return np.zeros(6)
        if self._in_phase(now_ns) > settings.retreat_timeout:
            return self._retreat_late(settings.retreat_timeout)
        return _along_z(-settings.retreat_speed)

    # ---- parts of phases ----

    def _serve(self, velocity: Array, hold_integral: bool = False) -> ServoingOutput:
        """Servo on the belief if it is a new one or carried on; else the last output holds."""
        assert self._belief is not None
        belief = self._carried_on(self._belief)
        if self._servo is None or belief.stamp_ns > (self.servoing.pid.stamp_ns or 0):
            self._servo = self.servoing.step(
                belief.stamp_ns, belief.T, velocity, hold_integral or self._limited
            )
        return self._servo

    def _carried_on(self, belief: StampedPose) -> StampedPose:
        """The belief as predicted for now, if that is set and can be done; else the belief."""
        if not self.settings.prediction.enabled or self._pose is None or self._now_ns is None:
            return belief
        since = (self._now_ns - self._pose.stamp_ns) * NANOSECOND
        T_base_sensor = self._pose.T @ se3.exp(since * self.limiter.twist)
        X_sf = self.predictor.ahead(self._now_ns, T_base_sensor)
        return belief if X_sf is None else StampedPose(self._now_ns, X_sf)

    def _reference_velocity(self, elapsed: float) -> Array:
        """Velocity in {s'}: along the path, with the turning that a known curvature asks for."""
        settings = self.settings.task
        speed = settings.speed * smooth_ramp(elapsed, settings.ramp_time)
        along = np.array([np.cos(self.goal.direction), np.sin(self.goal.direction), 0.0])
        turn = settings.curvature * speed * np.array([along[1], -along[0], 0.0])  # along x z
        return np.concatenate([speed * along, turn])

    def _touching(self) -> bool:
        """In contact, by an image exposed since this phase began."""
        presence = self._presence
        return presence is not None and presence.in_contact and presence.stamp_ns >= self._phase_since_ns

    def _contact_lost(self) -> bool:
        presence = self._presence
        assert presence is not None and self._contact_ns is not None
        if presence.in_contact:
            self._contact_ns = max(self._contact_ns, presence.stamp_ns)
        return (presence.stamp_ns - self._contact_ns) * NANOSECOND > self.settings.task.lost_contact_time

    def _after_lost_contact(self) -> Array:
        settings = self.settings.task
        self._reapproaches += 1
        if settings.lost_contact == "fail":
            return self._fail(f"contact was lost in phase {self.phase}")
        if self._reapproaches > settings.reapproaches:
            return self._fail(f"contact was lost {self._reapproaches} times")
        self._enter(APPROACH)
        return np.zeros(6)

    def _fail(self, reason: str) -> Array:
        """Fail with a retreat first."""
        self._contact_ns = self._contact_ns or self._now_ns  # it may touch: retreat after the stop
        return super()._fail(reason)

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._phase_pose = None
        self._touch_position = None
        self._settled_ns = None

    def _gone_from_phase_start(self) -> float:
        """Distance from where the sensor was at the first step of this phase, m."""
        pose = self._sensor_pose()
        if self._phase_pose is None:
            self._phase_pose = pose.copy()
        return float(np.linalg.norm(pose[:3, 3] - self._phase_pose[:3, 3]))

    # ---- output ----

    def _answer(self, wanted: Array, waiting: str) -> Command:
        common = self._command(wanted, waiting)
        self._limited = "speed" in common.limited
        servo = self._servo if self.phase in (SETTLE, FOLLOW) else None
        return Command(
            **vars(common),
            error=servo.error if servo else np.full(6, np.nan),
            feedforward=servo.feedforward if servo else np.zeros(6),
            progress=self._advance_progress(),
            travelled=self._odometer.length,
            exposure_ns=self._belief.stamp_ns if servo and self._belief else 0,
        )

    def _advance_progress(self) -> float:
        progress = PROGRESS.get(self.phase, 0.0)
        if self.phase == FOLLOW:
            progress += (PROGRESS[RETREAT] - progress) * self._followed()
        self._progress = max(self._progress, progress if not self.reason else 0.0)
        return self._progress

    def _followed(self) -> float:
        """Part of the path done, 0 to 1."""
        return min(1.0, self._odometer.length / self.goal.length)


def _along_z(speed: float) -> Array:
    return np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0])
