"""What tasks in contact share while they are in it: settle, servo on beliefs, contact lost and found again.

A library without ROS and without a clock of its own: whoever owns the time calls `step(now_ns, inputs)` at
the control rate and sends the twist of the `Command` that comes back. In between, settings can be replaced
(`configure`) and the task can be asked to end (`finish`, `stop`)::

    task = SurfaceFollowing(SurfaceFollowingSettings(), FollowingGoal(length=0.1), T_base_start)
    while not (command := task.step(now_ns(), inputs())).done:
        send(command.twist)

Phases: go_to_start -> approach -> settle -> a task's own -> retreat -> done, or failed. How the contact is
made and ended is in `contact_phases`, how a task stops and fails in `phases`. What a task adds is one file of
tactile_control/tasks: its own phase's name, the reference velocity in it, and when it is done.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_control.carried_check import CarriedCheck
from tactile_control.contact_phases import APPROACH, LEAVE, LIFT, SETTLE, TOUCH, ContactPhases
from tactile_control.contact_settings import ContactTaskSettings
from tactile_control.motion import Odometer
from tactile_control.phases import (
    DONE,
    GO_TO_START,
    RETREAT,
    Command,
    Goal,
    StampedPose,
    TaskInputs,
    newer,
)
from tactile_control.servoing import ServoingController, ServoingOutput
from tactile_control.surface_check import Check, SurfaceCheck
from tactile_control.width_check import WidthCheck
from tactile_filter.prediction import ContactPredictor
from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformBuffer, TransformUnavailable

Array = NDArray[np.float64]

TRACK_NS = SECOND_NS  # the sensor's poses are remembered for this long

# progress at which each phase begins; the work takes the large middle part
PROGRESS = {
    LEAVE: 0.0,
    GO_TO_START: 0.0,
    TOUCH: 0.02,
    LIFT: 0.03,
    APPROACH: 0.04,
    SETTLE: 0.07,
    RETREAT: 0.97,
    DONE: 1.0,
}
WORK_PROGRESS = 0.1


class ContactTask(ContactPhases):
    """Base of tasks in contact; see the module's text. One object runs one goal.

    A task names its phase `work` and fills in `reference_velocity`, `finished`, and where it has them
    `failure` and `fraction`.

    Parameters
    ----------
    settings : ContactTaskSettings
        Of the task's `settings_class`.
    goal : Goal
        Of the task's `goal_class`.
    start : ndarray (4, 4), optional
        T_base_sensor in the air from where to approach; without, the approach begins where the arm stands.
    """

    def __init__(self, settings: ContactTaskSettings, goal: Goal, start: Array | None = None) -> None:
        super().__init__(settings, start, {SETTLE: self._settle, self.work: self._work})
        self.goal = goal
        self.servoing = ServoingController(settings.servoing, settings.pid)
        self.predictor = ContactPredictor(settings.prediction)
        self.check = SurfaceCheck(settings.surface, settings.servoing.reference[2])
        self._needs = {
            LEAVE: ("pose", "presence"),
            GO_TO_START: ("pose", "presence"),
            TOUCH: ("pose", "presence"),
            LIFT: ("pose", "presence"),
            APPROACH: ("pose", "presence"),
            SETTLE: ("pose", "presence", "belief"),
            self.work: ("pose", "presence", "belief"),
            RETREAT: ("pose",),
        }
        self.width = WidthCheck(settings.surface)
        self.carried = CarriedCheck(settings.surface)
        self._hold: StampedPose | None = None
        self._odometer = Odometer(settings.contact.pose_step)
        self._track = TransformBuffer(TRACK_NS)
        self._belief: StampedPose | None = None
        self._servo: ServoingOutput | None = None
        self._settled_ns: int | None = None
        self._reapproaches = 0
        self._progress = 0.0
        self._limited = False
        self._pace = 1.0

    # ---- what the owner calls ----

    def configure(self, settings: ContactTaskSettings) -> None:
        """Replace the settings; they hold from the next step on, gains without a jump of the twist."""
        self.settings = settings
        self.servoing.configure(settings.servoing, settings.pid)
        self.limiter.configure(settings.limiter)
        self.watchdog.configure(settings.watchdog)
        self.predictor.configure(settings.prediction)
        self.check.configure(settings.surface, settings.servoing.reference[2])
        self.width.configure(settings.surface)
        self.carried.configure(settings.surface)
        self._odometer.step = settings.contact.pose_step

    # ---- what a task fills in ----

    @abstractmethod
    def reference_velocity(self, elapsed: float) -> Array:
        """Velocity (6,) in the reference frame {s'} after `elapsed` s of the task's own phase."""

    @abstractmethod
    def finished(self, elapsed: float) -> bool:
        """Whether the goal has been reached."""

    def failure(self, elapsed: float) -> str:
        """Why the goal cannot be reached any more; '' while it can."""
        return ""

    def fraction(self) -> float:
        """Part of the goal that is done, 0 to 1."""
        return 0.0

    def follows_motion(self) -> bool:
        """Whether the motion of the touched surface is to be estimated."""
        return self.settings.prediction.enabled

    # ---- inputs ----

    def _take(self, inputs: TaskInputs) -> None:
        pose, belief = inputs.sensor_pose, inputs.belief
        if newer(pose, self._pose):
            se3.checked_pose("sensor pose", pose.T)
            self._pose = pose
            self._track.set_transform("base", "sensor", pose.stamp_ns, pose.T)
        if newer(inputs.presence, self._presence):
            self._presence = inputs.presence
            if self.phase in (SETTLE, self.work) and inputs.presence.in_contact:
                self.check.see(newer(belief, self._belief), inputs.presence.still)
        if newer(belief, self._belief):
            se3.checked_pose("belief", belief.T)
            self._belief = belief
            self._follow_contact()

    def _follow_contact(self) -> None:
        """Let those know the belief who compare it with the sensor's pose at its exposure."""
        assert self._belief is not None
        stamp_ns, X_sf = self._belief.stamp_ns, self._belief.T
        try:
            T_base_sensor = self._track.lookup("base", "sensor", stamp_ns)
        except TransformUnavailable:
            self.predictor.reset()  # without the pose then, nothing can be carried on
            return
        if self.follows_motion():
            self.predictor.update(stamp_ns, X_sf, T_base_sensor)
        if self.phase in (SETTLE, self.work) and stamp_ns >= self._touch_ns:
            self.check.add(stamp_ns, X_sf, T_base_sensor)
        if self.phase == self.work and self.T_world_base is not None:
            T_world_sensor = se3.compose(self.T_world_base, T_base_sensor)
            self._hold = StampedPose(stamp_ns, se3.compose(T_world_sensor, X_sf))
            self.width.hear(self.partner_hold)
            self.width.add(self._hold)
            self.carried.hear(self.partner_hold)
            self.carried.add(stamp_ns, X_sf, T_world_sensor)

    def _stamps(self) -> dict[str, int | None]:
        latest = {"pose": self._pose, "presence": self._presence, "belief": self._belief}
        return {
            name: value.stamp_ns if (value := latest[name]) is not None else None
            for name in self._needs.get(self.phase, ())
        }

    def _missing(self) -> list[str]:
        """After a touch the belief has to be of an image exposed since: one from before was of no contact."""
        missing = super()._missing()
        if self.phase == SETTLE and not missing and self._belief is not None:
            missing = ["belief since the contact"] if self._belief.stamp_ns < self._touch_ns else []
        return missing

    # ---- phases: each returns the twist wanted now ----

    def _next_twist(self, now_ns: int) -> tuple[Array, str]:
        """Lost contact goes before the watchdog: without contact there is no belief, which then grows old."""
        if self.phase in (SETTLE, self.work) and self._contact_lost():
            self._wanted = self._after_lost_contact()
            return self._wanted, ""
        twist, waiting = super()._next_twist(now_ns)
        return self._believed(twist, waiting) if self.phase in (SETTLE, self.work) else (twist, waiting)

    def _believed(self, twist: Array, waiting: str) -> tuple[Array, str]:
        """Slower where the arm's own motion speaks against the beliefs; away where it refutes them."""
        checks: tuple[Check, ...] = (self.check, self.width, self.carried)
        check = min(checks, key=lambda check: (check.pace(), -check.doubt))
        self._pace = check.pace()
        if self._pace == 0.0:
            self._wanted = self._fail(check.contradiction)
            return self._wanted, ""
        if self._pace < 1.0 and not waiting:
            waiting = f"slower: what is believed of the contact nears a limit ({check.doubt:.0%} of it)"
        slowed = self._pace * twist
        slowed[2] = min(slowed[2], twist[2])  # the way out, -z of the sensor, is no slower
        return slowed, waiting

    def _settle(self, now_ns: int) -> Array:
        settings = self.settings.contact
        # the way in is no steady error: an integral of it would only be an offset on the path
        output = self._serve(np.zeros(6), hold_integral=True)
        pid = self.settings.pid
        controlled = (np.asarray(pid.kp) > 0.0) | (np.asarray(pid.ki) > 0.0)
        error = np.where(controlled, output.error, 0.0)
        depth, tilt = abs(error[2]), se3.norm(error[3:5])
        if depth > settings.settle_depth_tolerance or tilt > settings.settle_angle_tolerance:
            self._settled_ns = None
        elif self._settled_ns is None:
            self._settled_ns = now_ns
        if self._settled_ns is not None and (now_ns - self._settled_ns) * NANOSECOND >= settings.settle_time:
            self._odometer.break_off()
            self._enter(self.work)
        elif self._in_phase(now_ns) > settings.settle_timeout:
            return self._fail(
                f"not settled within {settings.settle_timeout:g} s: depth error {depth * 1e3:.2f} mm, "
                f"tilt error {np.degrees(tilt):.2f} deg"
            )
        return output.twist

    def _work(self, now_ns: int) -> Array:
        self._odometer.add(self._sensor_pose()[:3, 3])
        elapsed = self._in_phase(now_ns)
        if self.finished(elapsed):
            self._enter(RETREAT)
        elif reason := self.failure(elapsed):
            return self._fail(reason)
        return self._serve(self.reference_velocity(self._in_phase(now_ns))).twist

    # ---- parts of phases ----

    def _contact_made(self) -> None:
        """See `ContactPhases`."""
        self.servoing.reset()
        self.predictor.reset()  # a new contact is another feature: the way to it is no motion
        self._servo = None

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

    def _contact_lost(self) -> bool:
        presence = self._presence
        assert presence is not None and self._contact_ns is not None
        if presence.in_contact:
            self._contact_ns = max(self._contact_ns, presence.stamp_ns)
        return (presence.stamp_ns - self._contact_ns) * NANOSECOND > self.settings.contact.lost_contact_time

    def _after_lost_contact(self) -> Array:
        settings = self.settings.contact
        self._reapproaches += 1
        if settings.lost_contact == "fail":
            return self._fail(f"contact was lost in phase {self.phase}")
        if self._reapproaches > settings.reapproaches:
            return self._fail(f"contact was lost {self._reapproaches} times")
        self._enter(APPROACH)
        return np.zeros(6)

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._settled_ns = None
        if phase == SETTLE:
            self.check.begin()
            self.width.begin()
            self.carried.begin()
        elif phase == self.work:
            self.check.work()

    # ---- output ----

    def _answer(self, wanted: Array, waiting: str) -> Command:
        servo = self._servo if self.phase in (SETTLE, self.work) else None
        shown: dict[str, Any] = {}
        if servo is not None and self._belief is not None:
            shown = {
                "error": servo.error,
                "feedforward": servo.feedforward,
                "reference": servo.reference,
                "exposure_ns": self._belief.stamp_ns,
            }
        command = self._command(
            wanted,
            waiting,
            progress=self._advance_progress(),
            travelled=self._odometer.length,
            hold=self._hold if self.phase == self.work else None,
            **shown,
        )
        self._limited = "speed" in command.limited or self._pace < 1.0
        return command

    def _advance_progress(self) -> float:
        if self.phase == self.work:
            progress = WORK_PROGRESS + (PROGRESS[RETREAT] - WORK_PROGRESS) * self.fraction()
        else:
            progress = PROGRESS.get(self.phase, 0.0)
        self._progress = max(self._progress, progress if not self.reason else 0.0)
        return self._progress
