"""How a task in contact runs: its phases, each a small object; `contact_task` has what they share.

    leave ->              where the task begins in a contact, which was not made by it
    go_to_start ->        where it has a start
    touch -> lift ->      where that is set (contact.dry_touch)
    approach -> settle -> the task's own phases -> retreat -> done
    stopping -> retreat -> done or failed         whenever it is asked to end, or fails

Up to the approach all goes by the presence of contact and the arm's pose alone; from `settle` on the arm is
servoed on beliefs, held against the arm's own motion. A contact that is lost there is approached again.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND
from tactile_control.contact_settings import ContactSettings
from tactile_control.motion import Odometer, along_z
from tactile_control.phases import GO_TO_START, RETREAT, Phase, PhasedTask, PhaseFailed, StampedPose
from tactile_control.servoing import ServoingOutput
from tactile_control.surface_check import Check, SurfaceCheck
from tactile_geometry import se3

Array = NDArray[np.float64]

LEAVE = "leave"
TOUCH = "touch"
LIFT = "lift"
APPROACH = "approach"
SETTLE = "settle"
INTO_CONTACT = (LEAVE, GO_TO_START, TOUCH, LIFT, APPROACH, SETTLE)  # what comes before a task's own phases
LEAVE_WITHIN = 3.0  # retreat distances, within which a contact that was there before the task has to end
LIFT_BY, LIFT_WITHIN = 0.003, 0.009  # m off a dry touch, and that its contact ends within
FELT_AGAIN = 0.0015  # m beyond a dry touch, within which an approach has to feel it again


class TaskInContact(PhasedTask, Protocol):
    """What these phases ask of their task besides (`contact_task.ContactTask` says what each is)."""

    now_ns: int
    belief: StampedPose | None
    odometer: Odometer
    dry_touched: Array | None
    touched_ns: int
    reapproaches: int
    check: SurfaceCheck
    checks: tuple[Check, ...]
    pace: float

    @property
    def needs_force(self) -> bool: ...

    def explained(self, reason: str) -> str: ...
    def contact_seen(self, begins: bool = False) -> None: ...
    def contact_made(self) -> None: ...
    def contact_lost(self) -> bool: ...
    def too_hard(self) -> str: ...
    def serve(self, velocity: Array, hold_integral: bool = False) -> ServoingOutput: ...
    def reference_velocity(self, elapsed: float) -> Array: ...
    def finished(self, elapsed: float) -> bool: ...
    def failure(self, elapsed: float) -> str: ...


class ContactPhase(Phase[TaskInContact]):
    """A phase of a task in contact."""

    @property
    def contact(self) -> ContactSettings:
        """Speeds, tolerances and time limits."""
        return self.task.settings.contact


# ---- into contact: nothing is believed yet ----


class Leave(ContactPhase):
    """Back out of a contact that was there before the task."""

    name = LEAVE

    def over(self) -> bool:
        return self.moved >= self.contact.retreat_distance and not self.touching

    def twist(self) -> Array:
        far = self.moved >= LEAVE_WITHIN * self.contact.retreat_distance
        if far or self.elapsed > self.contact.retreat_timeout:
            raise PhaseFailed(f"still in contact after backing off by {self.moved * 1e3:.1f} mm")
        return along_z(-self.contact.retreat_speed)


class Descend(ContactPhase):
    """Along the sensor's z into the surface, as long as that is sensible."""

    def twist(self) -> Array:
        contact = self.contact
        if self.moved > contact.approach_distance:
            raise PhaseFailed(f"no contact within {contact.approach_distance * 1e3:.1f} mm of approach")
        if self.elapsed > contact.approach_timeout:
            raise PhaseFailed(f"no contact within {contact.approach_timeout:g} s of approach")
        return along_z(contact.approach_speed)


class Touch(Descend):
    """Until contact is felt at all."""

    name, leads_to = TOUCH, LIFT

    def over(self) -> bool:
        if self.touching:
            self.task.contact_seen()
            self.task.dry_touched = self.T_base_sensor[:3, 3].copy()
        return self.touching


class Lift(ContactPhase):
    """Off it again: what was felt has to end."""

    name, leads_to = LIFT, APPROACH

    def over(self) -> bool:
        return self.moved >= LIFT_BY and not self.touching

    def twist(self) -> Array:
        if self.moved >= LIFT_WITHIN:
            gone = f"{self.moved * 1e3:.1f} mm"
            raise PhaseFailed(f"the contact that was felt does not end {gone} off: is it one?")
        return along_z(-self.contact.approach_speed)


class Approach(Descend):
    """Into contact, and on for the press distance: images say little of a contact that only begins."""

    name, leads_to = APPROACH, SETTLE

    def begin(self) -> None:
        self.touched: Array | None = None  # where the sensor was at the first touch

    def over(self) -> bool:
        pose, dry = self.T_base_sensor, self.task.dry_touched
        if not self.touching:
            self.touched = None
        elif self.touched is None:
            self.touched = pose[:3, 3].copy()
            self.task.contact_seen(begins=True)
        if self.touched is not None:
            if se3.norm(pose[:3, 3] - self.touched) < self.contact.press_distance:
                return False
            self.task.contact_made()
            return True
        beyond = -1.0 if dry is None else float(pose[:3, 2] @ (pose[:3, 3] - dry))
        if beyond > FELT_AGAIN:
            raise PhaseFailed(f"a contact was felt {beyond * 1e3:.1f} mm before, and is not felt again")
        return False


# ---- in contact ----


class InContact(ContactPhase):
    """Servoed on beliefs: slower where they are doubtful, to an end where they are refuted."""

    needs = ("pose", "presence", "belief")
    ends_moving = True

    def inputs(self) -> tuple[str, ...]:
        return (*self.needs, "force") if self.task.needs_force else self.needs

    def interrupted(self) -> str:
        """Contact lost: asked before the watchdog, since without contact the last belief grows old."""
        if not self.task.contact_lost():
            return ""
        self.task.reapproaches += 1
        if self.contact.lost_contact == "fail":
            raise PhaseFailed(f"contact was lost in phase {self.name}")
        if self.task.reapproaches > self.contact.reapproaches:
            raise PhaseFailed(f"contact was lost {self.task.reapproaches} times")
        return APPROACH

    def adjust(self, twist: Array, waiting: str) -> tuple[Array, str]:
        """Slower where the arm's own motion speaks against the beliefs; away where it refutes them."""
        if why := self.task.too_hard():
            raise PhaseFailed(why)
        check = min(self.task.checks, key=lambda check: (check.pace(), -check.doubt))
        self.task.pace = pace = check.pace()
        if pace == 0.0:
            why = check.contradiction
            raise PhaseFailed(self.task.explained(why) if check.unheard else why)
        if pace < 1.0 and not waiting:
            waiting = f"slower: what is believed of the contact nears a limit ({check.doubt:.0%} of it)"
        slowed = pace * twist
        slowed[2] = min(slowed[2], twist[2])  # the way out, -z of the sensor, is no slower
        return slowed, waiting


class Settle(InContact):
    """To the reference contact pose, until the errors that have a gain stay within their tolerances."""

    name = SETTLE

    def begin(self) -> None:
        self.settled_ns: int | None = None
        for check in self.task.checks:
            check.begin()

    def missing(self) -> list[str]:
        """The belief has to be of an image exposed since the touch: one from before was of no contact."""
        missing, belief = super().missing(), self.task.belief
        if not missing and belief is not None and belief.stamp_ns < self.task.touched_ns:
            missing = ["belief since the contact"]
        return missing

    def over(self) -> bool:
        # the way in is no steady error: an integral of it would only be an offset on the path
        self.servo = self.task.serve(np.zeros(6), hold_integral=True)
        pid, contact, now_ns = self.task.settings.pid, self.contact, self.task.now_ns
        controlled = (np.asarray(pid.kp) > 0.0) | (np.asarray(pid.ki) > 0.0)
        error = np.where(controlled, self.servo.error, 0.0)
        depth, tilt = abs(error[2]), se3.norm(error[3:5])
        if depth > contact.settle_depth_tolerance or tilt > contact.settle_angle_tolerance:
            self.settled_ns = None
        elif self.settled_ns is None:
            self.settled_ns = now_ns
        if self.settled_ns is not None and (now_ns - self.settled_ns) * NANOSECOND >= contact.settle_time:
            self.task.odometer.break_off()
            return True
        if self.elapsed > contact.settle_timeout:
            raise PhaseFailed(
                f"not settled within {contact.settle_timeout:g} s: depth error {depth * 1e3:.2f} mm, "
                f"tilt error {np.degrees(tilt):.2f} deg"
            )
        return False

    def twist(self) -> Array:
        return self.servo.twist


class Servo(InContact):
    """A phase of a task's own in contact: servoed to a reference that moves at a velocity.

    It asks the task for all that it does; where a task has several, each says for itself.
    """

    leads_to = RETREAT

    def begin(self) -> None:
        self.task.check.work()

    def velocity(self) -> Array:
        """Of the reference (6,), in its own frame {s'}."""
        return self.task.reference_velocity(self.elapsed)

    def finished(self) -> bool:
        """Whether it is over; may raise `PhaseFailed`."""
        finished = self.task.finished(self.elapsed)
        if not finished and (reason := self.task.failure(self.elapsed)):
            raise PhaseFailed(reason)
        return finished

    def over(self) -> bool:
        self.task.odometer.add(self.T_base_sensor[:3, 3])
        return self.finished()

    def twist(self) -> Array:
        return self.task.serve(self.velocity()).twist


# ---- out of contact ----


class Retreat(ContactPhase):
    """Along the sensor's -z, off the surface; no image is needed for that."""

    name = RETREAT
    needs = ("pose",)

    def over(self) -> bool:
        return self.moved >= self.contact.retreat_distance

    def twist(self) -> Array:
        if self.elapsed > self.contact.retreat_timeout:
            raise PhaseFailed(f"the retreat took longer than {self.contact.retreat_timeout:g} s")
        return along_z(-self.contact.retreat_speed)

    def next_phase(self) -> str:
        return self.task.outcome if self.task.nothing_left else self.leads_to or self.task.outcome
