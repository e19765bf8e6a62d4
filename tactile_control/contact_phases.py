"""Into contact and out of it, by the presence of contact and the arm's pose alone: nothing is believed yet.

Phases: go_to_start -> approach -> settle, and retreat -> done, or failed; where that is set, touch and lift
before the approach. A task that begins in a contact, which was not made by it, leaves the surface before.
What is done in contact, from `settle` to the retreat, is in `contact_task`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from tactile_control.contact_settings import ContactSettings, ContactTaskSettings
from tactile_control.motion import along_z
from tactile_control.phases import (
    DONE,
    FAILED,
    GO_TO_START,
    RETREAT,
    STOPPING,
    Command,
    PhaseMachine,
    StampedPresence,
    TaskInputs,
)
from tactile_geometry import se3

Array = NDArray[np.float64]

LEAVE = "leave"
TOUCH = "touch"
LIFT = "lift"
APPROACH = "approach"
SETTLE = "settle"
INTO_CONTACT = (LEAVE, GO_TO_START, TOUCH, LIFT, APPROACH, SETTLE)  # what comes before a task's own phase
LEAVE_WITHIN = 3.0  # retreat distances, within which a contact that was there before the task has to end
LIFT_BY, LIFT_WITHIN = 0.003, 0.009  # m off a dry touch, and that its contact ends within
FELT_AGAIN = 0.0015  # m beyond a dry touch, within which an approach has to feel it again


class ContactPhases(PhaseMachine[TaskInputs, Command]):
    """The phases of a task in contact that make the contact and end it; see the module's text.

    Parameters
    ----------
    settings : ContactTaskSettings
    start : ndarray (4, 4), optional
        T_base_sensor in the air from where to approach; without, the approach begins where the arm stands.
    handlers : mapping
        Of the other phases, as of a `PhaseMachine`.
    """

    def __init__(
        self,
        settings: ContactTaskSettings,
        start: Array | None,
        handlers: Mapping[str, Callable[[int], Array]],
    ) -> None:
        own = {
            LEAVE: self._leave,
            GO_TO_START: self._go_to_start,
            TOUCH: self._touch,
            LIFT: self._lift,
            APPROACH: self._approach,
            STOPPING: self._stopping,
            RETREAT: self._retreat,
        }
        self._after_leaving = self._into_contact(settings.contact) if start is None else GO_TO_START
        super().__init__(self._after_leaving, {**own, **handlers}, settings.limiter, settings.watchdog)
        self.settings = settings
        self.start = None if start is None else se3.checked_pose("start", start)
        self._presence: StampedPresence | None = None
        self._phase_pose: Array | None = None
        self._contact_ns: int | None = None
        self._touch_ns = 0
        self._touch_position: Array | None = None
        self._dry: Array | None = None  # where the sensor was when it touched first, to be felt there again
        self._begins = True

    @abstractmethod
    def _contact_made(self) -> None:
        """An approach has made a contact: `settle` begins."""

    # ---- phases: each returns the twist wanted now ----

    def _next_twist(self, now_ns: int) -> tuple[Array, str]:
        """What the task begins with depends on whether it touches: the first presence says so."""
        if self._begins and self._presence is not None and self._pose is not None:
            self._begins = False
            if self._presence.in_contact:
                self._begin_in_contact(self._presence.stamp_ns)
        return super()._next_twist(now_ns)

    def _begin_in_contact(self, stamp_ns: int) -> None:
        """Leave the contact, which was not made by the task, or go on with it."""
        if self.settings.contact.leave_first:
            self._enter(LEAVE)
        else:
            self._touch_ns = self._contact_ns = stamp_ns
            self._enter(SETTLE)

    def _leave(self, now_ns: int) -> Array:
        """Back out of a contact that was there before the task."""
        settings = self.settings.contact
        gone = self._gone_from_phase_start()
        if gone >= settings.retreat_distance and not self._touching():
            self._enter(self._after_leaving)
            return np.zeros(6)
        if (
            gone >= LEAVE_WITHIN * settings.retreat_distance
            or self._in_phase(now_ns) > settings.retreat_timeout
        ):
            return self._fail(f"still in contact after backing off by {gone * 1e3:.1f} mm")
        return along_z(-settings.retreat_speed)

    def _go_to_start(self, now_ns: int) -> Array:
        assert self.start is not None
        if self._touching() and self._in_phase(now_ns) > self.settings.contact.lost_contact_time:
            return self._fail("touched something on the way to the start")
        twist = self._go_to(self.start, self.settings.travel, now_ns)
        if twist is None:
            self._enter(self._into_contact(self.settings.contact))
            return np.zeros(6)
        return twist

    @staticmethod
    def _into_contact(settings: ContactSettings) -> str:
        """The phase that makes the first contact."""
        return TOUCH if settings.dry_touch else APPROACH

    def _touch(self, now_ns: int) -> Array:
        """Into the surface until contact is felt at all."""
        if self._touching():
            assert self._presence is not None
            self._contact_ns = self._presence.stamp_ns
            self._dry = self._sensor_pose()[:3, 3].copy()
            self._enter(LIFT)
            return np.zeros(6)
        return self._no_contact_yet(now_ns)

    def _lift(self, now_ns: int) -> Array:
        """Off it again: what was felt has to end."""
        gone = self._gone_from_phase_start()
        if gone >= LIFT_BY and not self._touching():
            self._enter(APPROACH)
            return np.zeros(6)
        if gone >= LIFT_WITHIN:
            return self._fail(f"the contact that was felt does not end {gone * 1e3:.1f} mm off: is it one?")
        return along_z(-self.settings.contact.approach_speed)

    def _approach(self, now_ns: int) -> Array:
        settings = self.settings.contact
        if self._pressed() >= settings.press_distance:
            self._dry = None
            self._contact_made()
            self._enter(SETTLE)
            return np.zeros(6)
        if self._dry is not None and self._touch_position is None:
            pose = self._sensor_pose()
            beyond = float(pose[:3, 2] @ (pose[:3, 3] - self._dry))
            if beyond > FELT_AGAIN:
                return self._fail(f"a contact was felt {beyond * 1e3:.1f} mm before, and is not felt again")
        return self._no_contact_yet(now_ns)

    def _no_contact_yet(self, now_ns: int) -> Array:
        """On into the surface, as long as that is sensible."""
        settings = self.settings.contact
        if self._gone_from_phase_start() > settings.approach_distance:
            return self._fail(f"no contact within {settings.approach_distance * 1e3:.1f} mm of approach")
        if self._in_phase(now_ns) > settings.approach_timeout:
            return self._fail(f"no contact within {settings.approach_timeout:g} s of approach")
        return along_z(settings.approach_speed)

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
        return se3.norm(position - self._touch_position)

    def _stopping(self, now_ns: int) -> Array:
        if self._at_rest():
            if self._contact_ns is not None:
                self._enter(RETREAT)
            else:
                self._enter(FAILED if self.reason else DONE)
        return np.zeros(6)

    def _retreat(self, now_ns: int) -> Array:
        settings = self.settings.contact
        if self._gone_from_phase_start() >= settings.retreat_distance:
            self._enter(FAILED if self.reason else DONE)
            return np.zeros(6)
        if self._in_phase(now_ns) > settings.retreat_timeout:
            return self._retreat_late(settings.retreat_timeout)
        return along_z(-settings.retreat_speed)

    # ---- parts of phases ----

    def _touching(self) -> bool:
        """In contact, by an image exposed since this phase began."""
        presence = self._presence
        return presence is not None and presence.in_contact and presence.stamp_ns >= self._phase_since_ns

    def _gone_from_phase_start(self) -> float:
        """Distance from where the sensor was at the first step of this phase, m."""
        pose = self._sensor_pose()
        if self._phase_pose is None:
            self._phase_pose = pose.copy()
        return se3.norm(pose[:3, 3] - self._phase_pose[:3, 3])

    def _fail(self, reason: str) -> Array:
        """Fail with a retreat first."""
        self._contact_ns = self._contact_ns or self._now_ns  # it may touch: retreat after the stop
        return super()._fail(reason)

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._phase_pose = None
        self._touch_position = None
