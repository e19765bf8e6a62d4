"""Surface following as a state machine: go to the start, approach, settle, follow, retreat.

A library without ROS and without a clock of its own: whoever owns the time calls `step(now_ns, inputs)` at
the control rate and sends the twist of the `Command` that comes back. In between, settings can be replaced
(`configure`) and the task can be asked to end (`stop`)::

    task = SurfaceFollowing(settings, PathGoal(direction=math.pi / 2, length=0.1))
    while not (command := task.step(now_ns(), inputs())).done:
        send(command.twist)

Phases: go_to_start -> approach -> settle -> follow -> retreat -> done, or failed. An input that is too old
takes the twist to zero (`watchdog`). The task goes on when it is back; after the watchdog's patience it fails
where it is, since an arm that cannot feel or does not know where it is does not move. Every other failure
retreats first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_control.limiter import TwistLimiter
from tactile_control.motion import Odometer, Waypoint, smooth_ramp, twist_towards, way_to_start
from tactile_control.pid import NANOSECOND, ControlInputError
from tactile_control.servoing import ServoingController, ServoingOutput, checked_pose
from tactile_control.task_settings import SurfaceFollowingSettings
from tactile_control.watchdog import Watchdog
from tactile_filter import se3
from tactile_filter.prediction import ContactPredictor
from tactile_filter.transform_buffer import TransformBuffer, TransformUnavailable

Array = NDArray[np.float64]

GO_TO_START = "go_to_start"
APPROACH = "approach"
SETTLE = "settle"
FOLLOW = "follow"
STOPPING = "stopping"
RETREAT = "retreat"
DONE = "done"
FAILED = "failed"
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
AT_REST = 1e-6  # m/s and rad/s
TRACK_NS = 1_000_000_000  # the sensor's poses are remembered for this long

# progress at which each phase begins; following takes the large middle part
PROGRESS = {GO_TO_START: 0.0, APPROACH: 0.04, SETTLE: 0.07, FOLLOW: 0.1, RETREAT: 0.97, DONE: 1.0}


@dataclass(frozen=True)
class StampedPose:
    """A pose (4, 4) with the instant it holds for: a belief's mean X_sf, or T_base_sensor."""

    stamp_ns: int
    T: Array


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
            checked_pose("start", self.start)
        if self.target is not None and (np.shape(self.target) != (3,) or not np.isfinite(self.target).all()):
            raise ValueError(f"target = {self.target}: must be three finite numbers, m")


@dataclass(frozen=True)
class Command:
    """What one step of the task says.

    Attributes
    ----------
    twist : ndarray (6,)
        [v, omega] in {s} to send now: after watchdog and limiter.
    unlimited : ndarray (6,)
        The same before watchdog and limiter.
    error, feedforward : ndarray (6,)
        log(X_ss') and Ad(X_ss') v of the servoing controller; NaN and zero in phases that do not servo.
    phase : str
        One of `PHASES`.
    progress : float
        0 to 1 over all phases; it never goes back.
    travelled : float
        Arc length followed so far, m.
    exposure_ns : int
        Stamp of the belief that the twist is based on, 0 for none.
    done, succeeded : bool
        The task is over and the twist is zero; whether it did what it was asked to.
    reason : str
        Why it failed or is about to, '' where all is well.
    limited : str
        What the limiter held back in this step, '' for nothing: speeding up and braking are no trouble.
    """

    twist: Array
    unlimited: Array
    error: Array
    feedforward: Array
    phase: str
    progress: float
    travelled: float
    exposure_ns: int
    done: bool
    succeeded: bool
    reason: str
    limited: str = ""


class SurfaceFollowing:
    """Follows one path over a surface; see the module's text. One object runs one goal."""

    def __init__(self, settings: SurfaceFollowingSettings, goal: PathGoal) -> None:
        self.settings = settings
        self.goal = goal
        self.servoing = ServoingController(settings.servoing, settings.pid)
        self.limiter = TwistLimiter(settings.limiter)
        self.watchdog = Watchdog(settings.watchdog)
        self.predictor = ContactPredictor(settings.prediction)
        self.phase = GO_TO_START if goal.start is not None else APPROACH
        self.reason = ""
        self._odometer = Odometer(settings.task.pose_step)
        self._track = TransformBuffer(TRACK_NS)
        self._handlers: dict[str, Callable[[int], Array]] = {
            GO_TO_START: self._go_to_start,
            APPROACH: self._approach,
            SETTLE: self._settle,
            FOLLOW: self._follow,
            STOPPING: self._stopping,
            RETREAT: self._retreat,
        }
        self._now_ns: int | None = None
        self._phase_since_ns: int | None = None
        self._phase_pose: Array | None = None
        self._belief: StampedPose | None = None
        self._presence: StampedPresence | None = None
        self._pose: StampedPose | None = None
        self._servo: ServoingOutput | None = None
        self._waypoints: list[Waypoint] | None = None
        self._wanted = np.zeros(6)
        self._contact_ns: int | None = None
        self._touch_ns = 0
        self._touch_position: Array | None = None
        self._settled_ns: int | None = None
        self._reapproaches = 0
        self._progress = 0.0
        self._limited = False
        self._refused = ""

    # ---- what the owner calls ----

    def configure(self, settings: SurfaceFollowingSettings) -> None:
        """Replace the settings; they hold from the next step on, gains without a jump of the twist."""
        self.settings = settings
        self.servoing.configure(settings.servoing, settings.pid)
        self.limiter.configure(settings.limiter)
        self.watchdog.configure(settings.watchdog)
        self.predictor.configure(settings.prediction)
        self._odometer.step = settings.task.pose_step

    def stop(self, reason: str) -> None:
        """Ask the task to end: it comes to rest, retreats if it may be in contact, fails with `reason`."""
        if self.phase in (DONE, FAILED, STOPPING) or self.reason:
            return
        self.reason = reason or "stopped"
        self._enter(STOPPING if self.phase != RETREAT else RETREAT)

    def step(self, now_ns: int, inputs: TaskInputs) -> Command:
        """Advance to `now_ns` with the latest inputs. Bad inputs do not raise: they fail the task."""
        if self._now_ns is not None and now_ns < self._now_ns:
            back = (self._now_ns - now_ns) * NANOSECOND
            self._fail_here(f"the clock went back by {back:.3f} s")
        self._now_ns = now_ns
        self._take(inputs)
        if self._phase_since_ns is None:
            self._phase_since_ns = now_ns
        if self.phase in (DONE, FAILED):
            self._wanted = np.zeros(6)
            return self._command(now_ns, self._wanted)
        if self._waiting(now_ns):
            return self._command(now_ns, np.zeros(6))
        state = self.watchdog.step(now_ns, self._stamps())
        if state.failed:
            self._fail_here(state.reason + self._refused)
            return self._command(now_ns, np.zeros(6))
        if not state.ok:
            return self._command(now_ns, state.scale * self._wanted, state.reason + self._refused)
        self._wanted = self._handlers[self.phase](now_ns)
        return self._command(now_ns, self._wanted)

    # ---- inputs ----

    def _take(self, inputs: TaskInputs) -> None:
        """Keep each input if it is later than the last and usable; a refused one counts as not come."""
        try:
            if _newer(inputs.sensor_pose, self._pose):
                checked_pose("sensor pose", inputs.sensor_pose.T)  # type: ignore[union-attr]
                self._pose = inputs.sensor_pose
                self._follow_sensor()
            if _newer(inputs.presence, self._presence):
                self._presence = inputs.presence
            if _newer(inputs.belief, self._belief):
                checked_pose("belief", inputs.belief.T)  # type: ignore[union-attr]
                self._belief = inputs.belief
                self._follow_contact()
        except ControlInputError as error:
            self._refused = f" (the last one was refused: {error})"
        else:
            self._refused = ""

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

    def _waiting(self, now_ns: int) -> bool:
        """True while inputs that this phase needs have yet to arrive for the first time; fails after a while.

        After touching the surface the belief has to be of an image exposed since: one from before was of no
        contact.
        """
        missing = [name for name, stamp in self._stamps().items() if stamp is None]
        if self.phase == SETTLE and not missing and self._belief is not None:
            missing = ["belief since the contact"] if self._belief.stamp_ns < self._touch_ns else []
        if not missing:
            return False
        self._wanted = np.zeros(6)
        limit = self.settings.task.start_timeout
        if self._in_phase(now_ns) > limit:
            self._fail_here(f"no {' and no '.join(missing)} has arrived within {limit:g} s{self._refused}")
        return True

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
        if np.abs(self.limiter.twist).max() <= AT_REST:
            self._enter(RETREAT if self._contact_ns is not None else FAILED)
        return np.zeros(6)

    def _retreat(self, now_ns: int) -> Array:
        settings = self.settings.task
        if self._gone_from_phase_start() >= settings.retreat_distance:
            self._enter(FAILED if self.reason else DONE)
            return np.zeros(6)
        if self._in_phase(now_ns) > settings.retreat_timeout:
            late = f"the retreat took longer than {settings.retreat_timeout:g} s"
            self._fail_here(f"{self.reason}; {late}" if self.reason else late)
            return np.zeros(6)
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
        since = self._phase_since_ns or 0
        return self._presence is not None and self._presence.in_contact and self._presence.stamp_ns >= since

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
        self.reason = self.reason or reason
        self._contact_ns = self._contact_ns or self._now_ns  # it may touch: retreat after the stop
        self._enter(STOPPING)
        return np.zeros(6)

    def _fail_here(self, reason: str) -> None:
        """Fail where it stands: what is known does not allow to move."""
        if self.phase not in (DONE, FAILED):
            self.reason = self.reason or reason
            self._enter(FAILED)

    def _enter(self, phase: str) -> None:
        self.phase = phase
        self._phase_since_ns = self._now_ns
        self._phase_pose = None
        self._touch_position = None
        self._settled_ns = None
        self.watchdog.reset()

    def _in_phase(self, now_ns: int) -> float:
        return (now_ns - (self._phase_since_ns or 0)) * NANOSECOND

    def _sensor_pose(self) -> Array:
        assert self._pose is not None
        return self._pose.T

    def _gone_from_phase_start(self) -> float:
        """Distance from where the sensor was at the first step of this phase, m."""
        pose = self._sensor_pose()
        if self._phase_pose is None:
            self._phase_pose = pose.copy()
        return float(np.linalg.norm(pose[:3, 3] - self._phase_pose[:3, 3]))

    # ---- output ----

    def _command(self, now_ns: int, wanted: Array, reason: str = "") -> Command:
        limited = self.limiter.step(now_ns, wanted)
        self._limited = "speed" in limited.reason
        resting = float(np.abs(limited.twist).max()) <= AT_REST
        servo = self._servo if self.phase in (SETTLE, FOLLOW) else None
        return Command(
            twist=limited.twist,
            unlimited=self._wanted.copy(),
            error=servo.error if servo else np.full(6, np.nan),
            feedforward=servo.feedforward if servo else np.zeros(6),
            phase=self.phase,
            progress=self._advance_progress(),
            travelled=self._odometer.length,
            exposure_ns=self._belief.stamp_ns if servo and self._belief else 0,
            done=self.phase in (DONE, FAILED) and resting,
            succeeded=self.phase == DONE,
            reason="; ".join(text for text in (self.reason, reason) if text),
            limited=limited.reason,
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


def _newer(value: StampedPose | StampedPresence | None, last: StampedPose | StampedPresence | None) -> bool:
    return value is not None and (last is None or value.stamp_ns > last.stamp_ns)


def _along_z(speed: float) -> Array:
    return np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0])
