"""ContactTask: what the phases of a task in contact share, and what a task fills in.

A library without ROS and without a clock of its own: whoever owns the time calls `step(now_ns, inputs)` at
the control rate and sends the twist of the `Command` that comes back. In between, settings can be replaced
(`configure`) and the task can be asked to end (`finish`, `stop`)::

    task = SurfaceFollowing(SurfaceFollowingSettings(), FollowingGoal(length=0.1), T_base_start)
    while not (command := task.step(now_ns(), inputs())).done:
        send(command.twist)

Its phases are in `contact_phases`. What a task adds is one file of tactile_control/tasks: a phase of its own
with the reference velocity in it and when it is done, or several.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_control import contact_phases
from tactile_control.carried_check import CarriedCheck
from tactile_control.contact_phases import APPROACH, LEAVE, LIFT, SETTLE, TOUCH, InContact, Servo
from tactile_control.contact_settings import ContactTaskSettings
from tactile_control.force_reference import ForceReference, StampedForce, normal_force
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import (
    GO_TO_START,
    RETREAT,
    Goal,
    GoToPose,
    InputRefused,
    Phase,
    StampedPose,
    Stopping,
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
STEEPEST, TINY = 0.2, 1e-12  # cosine of a slope that `along_surface` takes for no steeper; m/s

# progress at which each phase begins; the work takes the large middle part
PROGRESS = {TOUCH: 0.02, LIFT: 0.03, APPROACH: 0.04, SETTLE: 0.07, RETREAT: 0.97}
WORK_PROGRESS = 0.1


class ContactTask(PhaseMachine):
    """Base of tasks in contact; see the module's text. One object runs one goal.

    A task names its phase `work` and fills in `reference_velocity`, `finished`, and where it has them
    `failure` and `fraction`; or it has phases of its own (`own_phases`).
    It approaches from its `start` in the air; without one, from where the arm stands.
    """

    settings: ContactTaskSettings

    def __init__(self, settings: ContactTaskSettings, goal: Goal, start: Array | None = None) -> None:
        super().__init__(settings, goal, start)
        settings = self.settings
        self.odometer.step = settings.contact.pose_step
        self.servoing = ServoingController(settings.servoing, settings.pid)
        self.predictor = ContactPredictor(settings.prediction)
        self.press = ForceReference(settings.force)
        self.force: StampedForce | None = None
        self.check = SurfaceCheck(settings.surface, self._deepest_reference)
        self.width, self.carried = WidthCheck(settings.surface), CarriedCheck(settings.surface)
        self.checks: tuple[Check, ...] = (self.check, self.width, self.carried)
        self._T_base_work: Array | None = None
        self.dry_touched: Array | None = None  # where a dry touch was, to be felt there again
        self.touched_ns = 0  # when the contact began
        self.reapproaches = 0
        self._contact_ns: int | None = None  # when there was contact last
        self._begins = True
        self._track = TransformBuffer(TRACK_NS)
        self._hold: StampedPose | None = None
        self._servo: ServoingOutput | None = None
        self.pace = 1.0  # how much of the last twist was followed

    def configure(self, settings: ContactTaskSettings) -> None:
        """Replace the settings; they hold from the next step on, gains without a jump of the twist."""
        super().configure(settings)
        settings = self.settings
        self.servoing.configure(settings.servoing, settings.pid)
        self.predictor.configure(settings.prediction)
        self.press.settings = settings.force
        self.check.configure(settings.surface, self._deepest_reference)
        self.width.configure(settings.surface)
        self.carried.configure(settings.surface)
        self.odometer.step = settings.contact.pose_step

    # ---- what a task fills in ----

    def own_phases(self) -> Sequence[Phase[Any]]:
        """What it does between settling and the retreat; the first one follows on settling."""
        return [Servo(self, self.work)]

    def reference_velocity(self, elapsed: float) -> Array:
        """Velocity (6,) in the reference frame {s'} after `elapsed` s of the task's own phase."""
        return np.zeros(6)

    def finished(self, elapsed: float) -> bool:
        """Whether the goal has been reached."""
        return False

    def failure(self, elapsed: float) -> str:
        """Why the goal cannot be reached any more; '' while it can."""
        return ""

    def fraction(self) -> float:
        """Part of the goal that is done, 0 to 1."""
        return 0.0

    def follows_motion(self) -> bool:
        """Whether the motion of the touched surface is to be estimated."""
        return self.settings.prediction.enabled

    # ---- what a task uses ----

    @property
    def T_base_reference(self) -> Array:
        """The reference sensor frame {s'} (4, 4) in the base, by the newest belief."""
        assert self.belief is not None
        X_sf = self.belief.T
        _, X_fs_reference = self.servoing.reference_for(se3.inverse(X_sf))
        return se3.compose(self.T_base_sensor, se3.compose(X_sf, X_fs_reference))

    @property
    def T_base_work(self) -> Array:
        """Where its work began (4, 4), in the base: {s'} at the sensor's centre when first asked for."""
        if self._T_base_work is None:
            self._T_base_work = self.T_base_reference.copy()
            self._T_base_work[:3, 3] = self.T_base_sensor[:3, 3]
        return self._T_base_work

    @property
    def place(self) -> Array:
        """The sensor's centre (3,) in the frame `T_base_work`, m: by the arm's pose alone."""
        return se3.point_in(self.T_base_work, self.T_base_sensor[:3, 3])

    def along_surface(self, velocity: Array) -> Array:
        """Reference velocity (6,) in {s'} over the surface, of one (2,) along x and y of `T_base_work`, m/s.

        It is projected onto the surface along z there, at the same speed: who steers by `place` goes along a
        path in the base, whatever the shape of the surface and however the sensor turns on it.
        """
        R = self.T_base_reference[:3, :3].T @ self.T_base_work[:3, :3]  # {s'} from there
        normal = R[2]
        along = np.append(velocity, 0.0)
        along[2] = -(along @ normal) / max(normal[2], STEEPEST)
        along *= se3.norm(velocity) / max(se3.norm(along), TINY)
        return np.append(R @ along, np.zeros(3))

    def serve(self, velocity: Array, hold_integral: bool = False) -> ServoingOutput:
        """Servo on the belief if it is a new one or carried on; else the last output holds."""
        assert self.belief is not None
        belief = self._carried_on(self.belief)
        if self._servo is None or belief.stamp_ns > (self.servoing.pid.stamp_ns or 0):
            self._press()
            self._servo = self.servoing.step(
                belief.stamp_ns, belief.T, velocity, hold_integral or self.limited
            )
        return self._servo

    @property
    def limited(self) -> bool:
        """Whether the last twist was slower than wanted: an integral would only wind up."""
        return "speed" in self.limited_by or self.pace < 1.0

    @property
    def needs_force(self) -> bool:
        """Whether contacts have to know their force."""
        return self.settings.force.needed

    @property
    def _deepest_reference(self) -> float:
        """The largest depth (m) that a contact may be servoed to."""
        depth, force = self.settings.servoing.reference[2], self.settings.force
        return max(depth, force.most_depth) if force.normal > 0.0 else depth

    def too_hard(self) -> str:
        """Why the contact presses with too much force; '' while it does not."""
        most = self.settings.force.most
        if most == 0.0 or self.force is None or self.belief is None or self.force.stamp_ns < self.touched_ns:
            return ""
        pressed = normal_force(self.force.force, self.belief.T)
        return f"the contact presses with {pressed:.1f} N, over {most:g} N" if pressed > most else ""

    def _press(self) -> None:
        """In its own phases: to the depth at which the contact presses with the reference force."""
        if self.settings.force.normal == 0.0 or not isinstance(self.current_phase, Servo):
            return
        assert self.force is not None and self.belief is not None
        X_sf = self.belief.T
        depth, force = float(se3.inverse(X_sf)[2, 3]), normal_force(self.force.force, X_sf)
        start = self.settings.servoing.reference[2]
        self.servoing.press(self.press.step(self.belief.stamp_ns, start, depth, force, self.pace < 1.0))

    # ---- its phases ----

    def make_phases(self) -> Iterable[Phase[Any]]:
        """Those of every task in contact, and its own in between."""
        own = self.own_phases()
        return (
            contact_phases.Leave(self, leads_to=self.first_phase()),
            GoToPose(self, leads_to=self.into_contact, needs=("pose", "presence")),
            contact_phases.Touch(self),
            contact_phases.Lift(self),
            contact_phases.Approach(self),
            contact_phases.Settle(self, leads_to=own[0].name),
            *own,
            Stopping(self, needs=()),
            contact_phases.Retreat(self),
        )

    def first_phase(self) -> str:
        """To the start, or into contact."""
        return self.into_contact if self.start is None else GO_TO_START

    @property
    def into_contact(self) -> str:
        """The phase that makes the first contact."""
        return TOUCH if self.settings.contact.dry_touch else APPROACH

    @property
    def may_touch(self) -> bool:
        """Where there has been contact, or something went wrong that may be one."""
        return self._contact_ns is not None

    @property
    def meets_something(self) -> bool:
        """In contact for longer than a skin that comes back explains."""
        touching = self.current_phase is not None and self.current_phase.touching
        return touching and self.elapsed > self.settings.contact.lost_contact_time

    def before_phase(self) -> None:
        """Whether the task begins in a contact, which was not made by it, the first presence says."""
        if not self._begins or self.presence is None or self.pose is None:
            return
        self._begins = False
        if self.presence.in_contact and self.settings.contact.leave_first:
            self.enter(LEAVE)
        elif self.presence.in_contact:
            self.contact_seen(begins=True)
            self.enter(SETTLE)

    def fail(self, reason: str) -> None:
        """Fail with a retreat first."""
        self._contact_ns = self._contact_ns or self.now_ns  # it may touch: retreat after the stop
        super().fail(reason)

    # ---- what its phases tell it, and ask ----

    def contact_seen(self, begins: bool = False) -> None:
        """The newest image shows contact, which may begin with it."""
        assert self.presence is not None
        self._contact_ns = self.presence.stamp_ns
        if begins:
            self.touched_ns = self.presence.stamp_ns

    def contact_made(self) -> None:
        """An approach has made a contact: another feature than before, and the way to it is no motion."""
        self.dry_touched = self._servo = None
        self.servoing.reset()
        self.servoing.press(self.settings.servoing.reference[2])
        self.press.reset()
        self.predictor.reset()

    def contact_lost(self) -> bool:
        """Whether contact has been absent for too long."""
        presence = self.presence
        assert presence is not None and self._contact_ns is not None
        if presence.in_contact:
            self._contact_ns = max(self._contact_ns, presence.stamp_ns)
        absent = (presence.stamp_ns - self._contact_ns) * NANOSECOND
        return absent > self.settings.contact.lost_contact_time

    # ---- inputs ----

    def take(self, inputs: TaskInputs) -> None:
        pose, belief = inputs.sensor_pose, inputs.belief
        if newer(pose, self.pose):
            se3.checked_pose("sensor pose", pose.T)
            self.pose = pose
            self._track.set_transform("base", "sensor", pose.stamp_ns, pose.T)
        if newer(inputs.presence, self.presence):
            self.presence = inputs.presence
            if isinstance(self.current_phase, InContact) and inputs.presence.in_contact:
                self.check.see(newer(belief, self.belief), inputs.presence.still)
        if newer(belief, self.belief):
            se3.checked_pose("belief", belief.T)
            self.belief = belief
            self._follow_contact(belief.stamp_ns, belief.T)
        if newer(inputs.force, self.force):
            if not np.isfinite(inputs.force.force).all():
                raise InputRefused("the believed force is not finite")
            self.force = inputs.force

    def _follow_contact(self, stamp_ns: int, X_sf: Array) -> None:
        """Let those know the belief who compare it with the sensor's pose at its exposure."""
        try:
            T_base_sensor = self._track.lookup("base", "sensor", stamp_ns)
        except TransformUnavailable:
            self.predictor.reset()  # without the pose then, nothing can be carried on
            return
        if self.follows_motion():
            self.predictor.update(stamp_ns, X_sf, T_base_sensor)
        if isinstance(self.current_phase, InContact) and stamp_ns >= self.touched_ns:
            self.check.add(stamp_ns, X_sf, T_base_sensor)
        if isinstance(self.current_phase, Servo) and self.T_world_base is not None:
            T_world_sensor = se3.compose(self.T_world_base, T_base_sensor)
            self._hold = StampedPose(stamp_ns, se3.compose(T_world_sensor, X_sf))
            self.width.hear(self.partner_hold)
            self.width.add(self._hold)
            self.carried.hear(self.partner_hold)
            self.carried.add(stamp_ns, X_sf, T_world_sensor)

    def _carried_on(self, belief: StampedPose) -> StampedPose:
        """The belief as predicted for now, if that is set and can be done; else the belief."""
        if not self.settings.prediction.enabled or self.pose is None:
            return belief
        since = (self.now_ns - self.pose.stamp_ns) * NANOSECOND
        T_base_sensor = self.pose.T @ se3.exp(since * self.limiter.twist)
        X_sf = self.predictor.ahead(self.now_ns, T_base_sensor)
        return belief if X_sf is None else StampedPose(self.now_ns, X_sf)

    # ---- what a step says ----

    def details(self) -> dict[str, Any]:
        """What it is servoed to and by, and where it holds what it works at."""
        servo = self._servo if isinstance(self.current_phase, InContact) else None
        said: dict[str, Any] = {"hold": self._hold if isinstance(self.current_phase, Servo) else None}
        if servo is not None and self.belief is not None:
            said |= {"error": servo.error, "feedforward": servo.feedforward, "reference": servo.reference}
            said["exposure_ns"] = self.belief.stamp_ns
        return said

    def progress(self) -> float:
        """By the phase, and in its own by what it says."""
        if self.phase == self.work:
            return WORK_PROGRESS + (PROGRESS[RETREAT] - WORK_PROGRESS) * self.fraction()
        return PROGRESS.get(self.phase, 0.0)
