"""The tasks `pushing` and `object_tracking` of many arms side by side, in the plane: their phases and laws.

Settings are the tasks' own, and so are the laws that take `math`: steering, the ramp, the pace of a push.
Here again are, for arrays, the PID and the limiter, which the tasks have in C, and the phases from
the approach to the end of the work. Not here: what a task does when its beliefs are contradicted, or late.

A direction of a sensor is a complex number, ahead + i left (`plane_filter`); four rows of an array are ahead,
left, down and turning, seen from above.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tactile_base.array_math import ArrayMath
from tactile_base.settings import SettingError
from tactile_control.alignment import CHANNEL, MM
from tactile_control.contact_settings import ContactTaskSettings
from tactile_control.motion import smooth_ramp
from tactile_control.pid import PidSettings
from tactile_control.steering import SteeringController
from tactile_control.tasks.object_tracking import ObjectTrackingSettings
from tactile_control.tasks.pushing import STUCK, PushingSettings
from tactile_filter.plane_filter import PlaneBelief

Array = Any  # of the library in use

#: Of the six channels of a tangent space: ahead (z), left (y), down (x), and about x, downwards.
CHANNELS = (2, 1, 0, 3)
TINY = 1e-12
REASONS = (
    "",
    "no contact was made",
    "contact was lost",
    "not settled in time",
    "the target was passed",
    "the push was not done in time",
    "the object does not go on",
    "the follower failed",
    "the object begins to tilt, which the plane does not have",
)


class ArrayPid:
    """`TangentPid` of some channels of N arms: the gains' rows are channels."""

    def __init__(self, settings: PidSettings, channels: Any, count: int, math: ArrayMath) -> None:
        def rows(values: Any) -> Array:
            return math.array(np.array([[values[channel]] for channel in channels], dtype=float))

        self._math, self._decay, self._longest = math, settings.ewma_decay, settings.longest_step
        self._kp, self._ki, self._kd = (rows(getattr(settings, name)) for name in ("kp", "ki", "kd"))
        self._limit, self._most = rows(settings.integral_limit), rows(settings.output_limit)
        self._integral = math.array(np.zeros((len(channels), count)))
        self._smooth = self._integral
        self._started = self._integral[0] > 1.0

    def step(self, error: Array, dt: float, active: Array, integrates: Array) -> Array:
        """The output (C, N) for errors (C, N); what is not active keeps its state."""
        math, goes_on = self._math, self._started & (dt <= self._longest)
        decayed = self._decay * self._smooth + (1.0 - self._decay) * error
        smooth = math.where(goes_on, decayed, error)
        slope = math.where(goes_on, (smooth - self._smooth) / dt, 0.0)
        law = self._kp * error + self._kd * slope
        output = law + self._ki * self._integral
        advanced = math.where(self._started, error * min(dt, self._longest), 0.0)
        grown = math.clip(self._integral + advanced, -self._limit, self._limit)
        outwards = ((output > 0.0) & (grown > self._integral)) | ((output < 0.0) & (grown < self._integral))
        held = (outwards & (abs(output) > self._most)) | ~integrates | ~active
        self._integral = math.where(held, self._integral, grown)
        self._smooth = math.where(active, smooth, self._smooth)
        self._started = self._started | active
        return math.clip(law + self._ki * self._integral, -self._most, self._most)


@dataclass
class Told:
    """What an arm says of itself: where N sensors are, and their turns."""

    at: Array
    turn: Array


class PlaneContactTask:
    """N tasks in contact, each in a phase of its own; a task adds its reference velocity and its end.

    Attributes
    ----------
    begun, settling, working, over : (N,) conditions; what is over has come to its end, for `reason`
    reason : (N,) numbers of `REASONS`; 0: well, or not over
    worked_s : (N,) seconds of its own phase
    """

    def __init__(self, settings: ContactTaskSettings, count: int, math: ArrayMath) -> None:
        self.settings, self._math = settings, math
        _check(settings)
        zeros = math.array(np.zeros(count))
        no = zeros > 1.0
        self.begun = self.settling = self.working = self.over = no
        self.reason, self.worked_s = zeros, zeros
        self._near = self._touched = no
        self._since, self._settled, self._seen = zeros, zeros - 1.0, zeros
        self._place, self._start = 0j * zeros, 0j * zeros
        self.belief = PlaneBelief(no, 0j * zeros, zeros, zeros)
        self._pid = ArrayPid(settings.pid, CHANNELS, count, math)
        self._served = math.array(np.zeros((4, count)))
        self._twist, self._time = self._served, 0.0
        self._stamp: float | None = None
        self._belief_step = 0.0  # from the last belief to a new one, s; 0 where there is no new one
        self._just_there = no
        x, y, z, alpha, beta, gamma = settings.servoing.reference
        if beta or gamma:
            raise SettingError("fidelity plane: servoing.reference has to have beta and gamma 0")
        self._reference = complex(z, y), -alpha, x  # X_fs' in the plane

    # ---- what a task fills in ----

    def ahead(self, told: Told, elapsed: Array) -> Array:
        """Velocity in {s'}, ahead + i left."""
        return 0j * elapsed

    def ended(self, told: Told, elapsed: Array) -> tuple[Array, Array]:
        """Which have reached their goal, and why others cannot any more (number of `REASONS`)."""
        return self.over & ~self.over, 0.0 * elapsed

    # ---- a step ----

    def step(self, now: float, told: Told, news: tuple[float, PlaneBelief] | None, may_begin: Array) -> Array:
        """The twists (4, N) to send at `now`, s, with the belief of an exposure at a time, if one is new."""
        math = self._math
        self._belief_step = 0.0 if news is None else self._take(*news)
        begins = may_begin & ~self.begun & (self._stamp is not None)
        self.begun = self.begun | begins
        self._enter(begins, now)
        self._start = math.where(begins, told.at, self._start)
        at_once = begins & self._near  # it begins in a contact, which was not made by it
        self.settling = self.settling | at_once
        wanted = self._serve(now, told, self._approach(now, told, begins))
        self._twist = self._limited(wanted, min(now - self._time, self.settings.limiter.longest_step))
        self._time = now
        return self._twist

    def _take(self, stamp: float, belief: PlaneBelief) -> float:
        """Keep a belief; since the last, s."""
        math, old = self._math, self.belief
        self._near = belief.present
        self._seen = math.where(belief.present, stamp + 0.0 * self._seen, self._seen)
        at, turn, down = (
            math.where(belief.present, getattr(belief, name), getattr(old, name))
            for name in ("at", "turn", "down")
        )
        self.belief = PlaneBelief(belief.present, at, turn, down)
        since = 0.0 if self._stamp is None else stamp - self._stamp
        self._stamp = stamp
        return since

    def _approach(self, now: float, told: Told, begins: Array) -> Array:
        """Into contact and on for the press distance; which then settle."""
        math, contact = self._math, self.settings.contact
        approaching = self.begun & ~begins & ~self.settling & ~self.working & ~self.over
        self._place = math.where(self._near & ~self._touched, told.at, self._place)
        self._touched = self._near
        there = approaching & self._near & (abs(told.at - self._place) >= contact.press_distance)
        far = approaching & (
            (abs(told.at - self._start) > contact.approach_distance)
            | (now - self._since > contact.approach_timeout)
        )
        self.fail(far & ~there, 1)
        self._enter(there, now)
        self.settling = self.settling | there
        self._just_there = there
        speed = math.where(approaching & ~there & ~far, contact.approach_speed + 0.0 * self._since, 0.0)
        return math.stack([speed, 0.0 * speed, 0.0 * speed, 0.0 * speed])

    def _serve(self, now: float, told: Told, wanted: Array) -> Array:
        """Servo those in contact, and see who has settled, is at the goal or cannot get there."""
        math, contact = self._math, self.settings.contact
        serving = (self.settling | self.working) & ~self.over & ~self._just_there
        self.fail(serving & (now - self._seen > contact.lost_contact_time + 1e-9), 2)
        serving = serving & ~self.over
        elapsed = now - self._since
        done, why = self.ended(told, elapsed)
        done = done & self.working & serving
        self.over = self.over | done
        self.worked_s = math.where(self.working & serving, elapsed, self.worked_s)
        self.fail(self.working & serving & ~done & (why > 0.0), why)
        serving = serving & ~self.over
        velocity = math.where(self.working, self.ahead(told, elapsed), 0j)
        if (dt := self._belief_step) > 0.0:
            error, turn = self._error()
            feedback = self._pid.step(error, dt, serving, self.working)
            way = math.exp(1j * turn) * velocity
            zero = 0.0 * turn
            served = feedback + math.stack([way.real, way.imag, zero, zero])
            self._served = math.where(serving, served, self._served)
            self._settle(now, serving & self.settling, error)
        return math.where(serving, self._served, math.where(self.over, 0.0, wanted))

    def _error(self) -> tuple[Array, Array]:
        """log(X_ss') as rows, and the turn of {s'} in the sensor."""
        math, belief, (at, turn, down) = self._math, self.belief, self._reference
        at = belief.at + math.exp(1j * belief.turn) * at
        turn = belief.turn + turn
        half = 0.5 * turn
        square = half * half
        way = at * (1.0 - square / 3.0 - square * square / 45.0 - 1j * half)
        return math.stack([way.real, way.imag, belief.down + down, turn]), turn

    def _settle(self, now: float, settling: Array, error: Array) -> None:
        contact, pid = self.settings.contact, self.settings.pid
        controlled = [max(pid.kp[channel], pid.ki[channel]) > 0.0 for channel in CHANNELS]
        off = 0.0 * error[0] > 1.0
        if controlled[0]:
            off = off | (abs(error[0]) > contact.settle_depth_tolerance)
        if controlled[3]:
            off = off | (abs(error[3]) > contact.settle_angle_tolerance)
        math = self._math
        fresh = math.where(self._settled < 0.0, now + 0.0 * self._settled, self._settled)
        self._settled = math.where(off | ~settling, -1.0, fresh)
        done = settling & (self._settled >= 0.0) & (now - self._settled >= contact.settle_time - 1e-9)
        self.fail(settling & ~done & (now - self._since > contact.settle_timeout), 3)
        self._enter(done, now)
        self.settling, self.working = self.settling & ~done, self.working | done

    def _limited(self, wanted: Array, dt: float) -> Array:
        """`TwistLimiter`."""
        math, limits, last = self._math, self.settings.limiter, self._twist
        size = math.sqrt(wanted[0] ** 2 + wanted[1] ** 2 + wanted[2] ** 2) + TINY
        linear = math.clip(limits.linear_speed / size, 0.0, 1.0)
        angular = math.clip(wanted[3], -limits.angular_speed, limits.angular_speed)
        step = math.stack([linear * part for part in (wanted[0], wanted[1], wanted[2])] + [angular]) - last
        size = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) + TINY
        linear = math.clip(limits.linear_acceleration * dt / size, 0.0, 1.0)
        most = limits.angular_acceleration * dt
        angular = math.clip(step[3], -most, most)
        return last + math.stack([linear * step[0], linear * step[1], linear * step[2], angular])

    def _enter(self, which: Array, now: float) -> None:
        self._since = self._math.where(which, now + 0.0 * self._since, self._since)

    def fail(self, which: Array, reason: Any) -> None:
        """Which end here, and why: numbers of `REASONS`."""
        first = which & ~self.over
        self.reason = self._math.where(first, reason + 0.0 * self.reason, self.reason)
        self.over = self.over | first


class PlaneTracking(PlaneContactTask):
    """`ObjectTracking` of N arms."""

    def __init__(self, settings: ObjectTrackingSettings, count: int, math: ArrayMath) -> None:
        super().__init__(settings, count, math)
        if settings.task.feedforward:
            raise SettingError("fidelity plane: task.feedforward of the follower has to be 0")


class PlanePushing(PlaneContactTask):
    """`Pushing` of N arms, to a target in the world, x + iy."""

    settings: PushingSettings

    def __init__(self, settings: PushingSettings, target: complex, count: int, math: ArrayMath) -> None:
        super().__init__(settings, count, math)
        self.target = target
        self._align = ArrayPid(settings.alignment.pid(), (CHANNEL,), count, math)
        self._steering = SteeringController(settings.steering, math, self._since)
        self._went_on, self._sideways = self._since, self._since
        self._way: tuple[Array, Array, Array] | None = None  # place and heading, and who was at work

    def bearing(self, told: Told) -> tuple[Array, Array]:
        """Where the target is in {s'}: to its left and ahead, m."""
        math, belief, (at, turn, _) = self._math, self.belief, self._reference
        back = math.exp(1j * belief.turn)
        place = told.at + math.exp(1j * told.turn) * (belief.at + back * at)
        way = (self.target - place) * math.exp(-1j * (told.turn + belief.turn + turn))
        return way.imag, way.real

    def ahead(self, told: Told, elapsed: Array) -> Array:
        """As `Pushing.reference_velocity`."""
        math, task = self._math, self.settings.task
        ramp = smooth_ramp(elapsed, task.ramp_time, math)
        if self._belief_step > 0.0:
            self._sideways = self._steered(told, ramp * task.speed)
        feature = math.exp(-1j * self.belief.turn) * self.belief.at
        pace = ramp * task.pace(-feature.real, math)
        goes_on = (pace > STUCK) | (ramp < 1.0) | ~self.working
        self._went_on = math.where(goes_on, elapsed * self.working, self._went_on)
        return pace * task.speed + 1j * math.clip(pace, 0.0, None) * self._sideways

    def _steered(self, told: Told, speed: Array) -> Array:
        """The sideways velocity for new beliefs."""
        math, settings = self._math, self.settings
        left, ahead = self.bearing(told)
        if not settings.steering.enabled:
            error = settings.alignment.reference_bearing_deg - np.degrees(1.0) * math.arctan2(left, ahead)
            error = math.stack([error])
            wanted = self._align.step(error, self._belief_step, self.working, self.working)[0]
            near = math.sqrt(left * left + ahead * ahead) < settings.alignment.cutoff_distance
            return math.where(near, 0.0, MM * wanted)
        normal = told.turn + self.belief.turn
        if self._way is not None:
            place, heading, worked = self._way
            way = (told.at - place) * math.exp(-1j * heading)
            turned = math.arctan2(math.sin(normal - heading), math.cos(normal - heading))
            active = self.working & worked
            # {s} looks ahead and turns to its right where the model's normal does (x is down)
            self._steering.model.advance(way.imag * active, way.real * active, -turned * active)
        self._way = told.at, normal, self.working
        return self._steering.sideways(left, ahead, speed, settings.task.tip_radius)

    def ended(self, told: Told, elapsed: Array) -> tuple[Array, Array]:
        """As `Pushing.finished` and `Pushing.failure`."""
        math, task = self._math, self.settings.task
        _, ahead = self.bearing(told)
        why = math.where(elapsed - self._went_on > task.stuck_time, 6.0 + 0.0 * elapsed, 0.0)
        why = math.where(elapsed > task.timeout, 5.0 + 0.0 * why, why)
        why = math.where(ahead < 0.0, 4.0 + 0.0 * why, why)
        return abs(self.target - told.at) < task.tip_radius, why


def _check(settings: ContactTaskSettings) -> None:
    """`SettingError` for what is not modelled in the plane."""
    servoing, contact = settings.servoing, settings.contact
    for wrong, name in (
        (servoing.tangent_space != "local", "servoing.tangent_space has to be local"),
        (servoing.free_shear, "servoing.free_shear has to be false"),
        (settings.prediction.enabled, "prediction.enabled has to be false"),
        (contact.dry_touch, "contact.dry_touch has to be false"),
        (contact.lost_contact != "fail", "contact.lost_contact has to be fail"),
    ):
        if wrong:
            raise SettingError(f"fidelity plane: {name}")
