"""Data collection as a state machine: approach, rotate, contact, shear, image, retreat, again and again.

The paper's Algorithm "Data collection" for an arm that takes twists. A library without ROS and without a
clock of its own: whoever owns the time calls `step(now_ns, inputs)` at the control rate, sends the twist of
what comes back and, where that holds a `Capture`, stores the image of its exposure under its number::

    task = DataCollection(settings, targets, T_base_f)
    while not (command := task.step(now_ns(), inputs())).done:
        send(command.twist)
        if command.capture:
            store(image_of(command.capture.stamp_ns), command.capture)

Phases: go_to_start -> reference -> (touch) -> (rotate -> contact -> shear -> capture -> retreat) for each
sample -> done, or failed. The label is where the arm says that the sensor was at the exposure, not where it
was sent. How a task stops and fails is told in `phases`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND
from tactile_control import collection_geometry as geometry
from tactile_control.collection import (
    CAPTURE,
    CONTACT,
    PHASES,
    REFERENCE,
    ROTATE,
    SHEAR,
    TOUCH,
    Capture,
    CollectionCommand,
    CollectionGoal,
    CollectionInputs,
    DataCollectionSettings,
    Exposure,
    Target,
)
from tactile_control.motion import Odometer, TravelSettings, Waypoint, pose_difference, twist_towards
from tactile_control.phases import (
    DONE,
    FAILED,
    GO_TO_START,
    RETREAT,
    STOPPING,
    PhaseMachine,
    StampedPose,
    newer,
)
from tactile_control.touch_off import TouchFailed, TouchOff, at
from tactile_geometry import se3

Array = NDArray[np.float64]


class DataCollection(PhaseMachine[CollectionInputs, CollectionCommand]):
    """Collects one sample after the other; see the module's text.

    Parameters
    ----------
    settings : DataCollectionSettings
    targets : sequence of Target
    T_base_f : ndarray (4, 4)
        Contact frame of the flat surface (see `collection_geometry`); touches correct it.

    Raises
    ------
    ValueError
        Without a target, or with a contact frame that is no rigid transform.
    """

    settings_class = DataCollectionSettings
    goal_class = CollectionGoal
    phases = PHASES
    work = CAPTURE
    node = "collector"

    def __init__(self, settings: DataCollectionSettings, targets: Sequence[Target], T_base_f: Array) -> None:
        if not targets:
            raise ValueError("no sample to collect")
        handlers = {
            GO_TO_START: self._go_to_start,
            REFERENCE: self._reference,
            TOUCH: self._touch,
            ROTATE: self._rotate,
            CONTACT: self._contact,
            SHEAR: self._shear,
            CAPTURE: self._capture,
            RETREAT: self._retreat,
            STOPPING: self._stopping,
        }
        super().__init__(GO_TO_START, handlers, settings.limiter, settings.watchdog)
        self.settings = settings
        self.targets = list(targets)
        self.T_base_f = se3.checked_pose("contact frame", T_base_f)
        self.collected = 0
        self.touch = TouchOff(settings.touch)
        self._odometer = Odometer(1e-4)
        self._exposure: Exposure | None = None
        self._goal: Array | None = None
        self._still: StampedPose | None = None
        self._captured: Capture | None = None

    # ---- what the owner calls ----

    def configure(self, settings: DataCollectionSettings) -> None:
        """Replace the settings; they hold from the next step on."""
        self.settings = settings
        self.limiter.configure(settings.limiter)
        self.watchdog.configure(settings.watchdog)

    # ---- inputs ----

    def _take(self, inputs: CollectionInputs) -> None:
        pose, exposure = inputs.sensor_pose, inputs.exposure
        if newer(pose, self._pose):
            se3.checked_pose("sensor pose", pose.T)
            self._pose = pose
            self._odometer.add(pose.T[:3, 3])
        if newer(exposure, self._exposure):
            se3.checked_pose("sensor pose at the exposure", exposure.T_base_sensor)
            self._exposure = exposure

    def _stamps(self) -> dict[str, int | None]:
        """Stamps of what this phase needs; leaving the surface needs no image."""
        stamps = {"pose": self._pose.stamp_ns if self._pose else None}
        if self.phase not in (RETREAT, STOPPING):
            stamps["image"] = self._exposure.stamp_ns if self._exposure else None
        return stamps

    # ---- phases: each returns the twist wanted now ----

    def _go_to_start(self, now_ns: int) -> Array:
        motion = self.settings.motion
        twist = self._go_to(self._in_base(at(0.0, 0.0, -motion.standoff)), motion.in_air, now_ns)
        if twist is None:
            self._enter(REFERENCE)
            return np.zeros(6)
        return twist

    def _reference(self, now_ns: int) -> Array:
        """At rest off the surface until the image without contact is known."""
        exposure, motion = self._exposure, self.settings.motion
        if exposure is not None and exposure.in_contact is not None and self._resting(now_ns):
            if exposure.in_contact:
                return self._fail("the image shows contact where there is none: the reference is no good")
            self._enter(TOUCH if self.settings.touch.points else ROTATE)
            return np.zeros(6)
        if self._in_phase(now_ns) > motion.capture_timeout + motion.settle_time:
            return self._fail(f"no image without contact was taken within {motion.capture_timeout:g} s")
        return np.zeros(6)

    def _touch(self, now_ns: int) -> Array:
        """Touch the surface in places, then correct the contact frame by what was found."""
        exposure, motion = self._exposure, self.settings.motion
        assert exposure is not None
        X_exposed = self._in_contact_frame(exposure.T_base_sensor)
        try:
            move = self.touch.step(
                now_ns, self._X_fs(), exposure.stamp_ns, X_exposed, bool(exposure.in_contact)
            )
        except TouchFailed as error:
            return self._fail(str(error))
        if self.touch.done:
            self.T_base_f = self.touch.corrected(self.T_base_f)
            self._enter(ROTATE)
            return np.zeros(6)
        if self._in_phase(now_ns) > motion.motion_timeout * self.settings.touch.points:
            return self._fail(f"{len(self.touch.touches) + 1} touches took too long")
        pace = motion.in_contact.replaced(speed=self.settings.touch.speed)
        return twist_towards(
            self._sensor_pose(), self._in_base(move.X_fs), pace if move.slowly else motion.in_air
        )

    def _rotate(self, now_ns: int) -> Array:
        """Back over the point of first touch, turned to the contact angles, in the air."""
        target, motion = self._target(), self.settings.motion
        if self._late(now_ns):
            return self._fail(f"the start of the contact was not reached within {motion.motion_timeout:g} s")
        twist = self._towards(geometry.above(target.euler, motion.clearance), motion.in_air)
        if twist is not None:
            return twist
        if self._clear():
            self._enter(CONTACT)
        elif self._in_phase(now_ns) > motion.capture_timeout:
            return self._fail(
                f"the image shows contact {motion.clearance * 1e3:.1f} mm off the surface: the surface is "
                "nearer than it is said to be (find it by touch), or the reference image is no good"
            )
        return np.zeros(6)

    def _contact(self, now_ns: int) -> Array:
        return self._slow_leg(now_ns, geometry.pressed(self._target().euler), SHEAR, "depth")

    def _shear(self, now_ns: int) -> Array:
        return self._slow_leg(now_ns, se3.pose_from_euler(self._target().euler), CAPTURE, "shear")

    def _capture(self, now_ns: int) -> Array:
        """At rest until an exposure of that rest has come."""
        exposure, motion, target = self._exposure, self.settings.motion, self._target()
        assert exposure is not None
        if self._resting(now_ns) and self._rested(exposure):
            X_fs = self._in_contact_frame(exposure.T_base_sensor)
            if X_fs[2, 3] >= motion.certain_depth and not exposure.in_contact:
                return self._fail(
                    f"the image shows no contact at a depth of {X_fs[2, 3] * 1e3:.1f} mm: the surface is "
                    "further away than it is said to be (find it by touch)"
                )
            euler = se3.euler_from_pose(X_fs)
            self._captured = Capture(
                target.number, exposure.stamp_ns, euler, target.euler, exposure.T_base_sensor
            )
            self.collected += 1
            self._enter(RETREAT)
        elif self._in_phase(now_ns) > motion.capture_timeout + motion.settle_time:
            return self._fail(f"the arm did not rest, or no image came, within {motion.capture_timeout:g} s")
        return np.zeros(6)

    def _retreat(self, now_ns: int) -> Array:
        motion = self.settings.motion
        ends = bool(self.reason) or self.collected == len(self.targets)
        gap = motion.standoff if ends else motion.clearance
        if self._goal is None:
            self._goal = geometry.lifted(self._X_fs(), gap)
        if self._X_fs()[2, 3] <= -gap + 10.0 * motion.position_tolerance:
            return self._next_or_end()
        if self._late(now_ns):
            return self._retreat_late(motion.motion_timeout)
        return twist_towards(self._sensor_pose(), self._in_base(self._goal), motion.in_air)

    def _stopping(self, now_ns: int) -> Array:
        if self._at_rest():
            self._enter(RETREAT)
        return np.zeros(6)

    # ---- parts of phases ----

    def _next_or_end(self) -> Array:
        """On to the next sample, or to the end."""
        if self.reason:
            self._enter(FAILED)
        else:
            self._enter(DONE if self.collected == len(self.targets) else ROTATE)
        return np.zeros(6)

    def _slow_leg(self, now_ns: int, X_fs: Array, following: str, what: str) -> Array:
        """On the way in contact; a leg that ends begins the next phase."""
        motion = self.settings.motion
        if self._late(now_ns):
            return self._fail(f"the {what} was not reached within {motion.motion_timeout:g} s")
        twist = self._towards(X_fs, motion.in_contact)
        if twist is None:
            self._enter(following)
            return np.zeros(6)
        return twist

    def _towards(self, X_fs: Array, pace: TravelSettings) -> Array | None:
        """Twist towards a pose in {f}; None where it is reached."""
        goal = self._in_base(X_fs)
        reached = Waypoint(goal, pace.position_tolerance, pace.angle_tolerance).reached(self._sensor_pose())
        return None if reached else twist_towards(self._sensor_pose(), goal, pace)

    def _clear(self) -> bool:
        """No contact in an image exposed since this phase began."""
        exposure = self._exposure
        assert exposure is not None
        known = exposure.in_contact is not None
        return known and not exposure.in_contact and exposure.stamp_ns >= self._phase_since_ns

    def _resting(self, now_ns: int) -> bool:
        """Whether the commanded twist is zero and the pose has not moved for `settle_time`."""
        motion, pose = self.settings.motion, self._pose
        assert pose is not None
        moved = self._still is None or not self._near(pose.T, self._still.T)
        if moved or not self._at_rest():
            self._still = pose
            return False
        assert self._still is not None
        return (pose.stamp_ns - self._still.stamp_ns) * NANOSECOND >= motion.settle_time

    def _rested(self, exposure: Exposure) -> bool:
        """Whether an exposure was made after rest had settled, where the sensor rests."""
        assert self._still is not None
        rest = (exposure.stamp_ns - self._still.stamp_ns) * NANOSECOND
        settled = rest >= self.settings.motion.settle_time
        return settled and self._near(exposure.T_base_sensor, self._still.T)

    def _near(self, T: Array, other: Array) -> bool:
        position, rotation = pose_difference(T, other)
        motion = self.settings.motion
        return bool(
            np.linalg.norm(position) <= motion.still_distance
            and np.linalg.norm(rotation) <= motion.still_angle
        )

    def _target(self) -> Target:
        return self.targets[self.collected]

    def _in_base(self, X_fs: Array) -> Array:
        return np.asarray(self.T_base_f @ X_fs)

    def _in_contact_frame(self, T_base_sensor: Array) -> Array:
        return np.asarray(se3.inverse(self.T_base_f) @ T_base_sensor)

    def _X_fs(self) -> Array:
        return self._in_contact_frame(self._sensor_pose())

    def _late(self, now_ns: int) -> bool:
        return self._in_phase(now_ns) > self.settings.motion.motion_timeout

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._goal = self._still = None

    # ---- output ----

    def _answer(self, wanted: Array, waiting: str) -> CollectionCommand:
        if waiting:
            self._still = None
        captured, self._captured = self._captured, None
        return CollectionCommand(
            **{
                **vars(self._command(wanted, waiting)),
                "travelled": self._odometer.length,
                "progress": self.collected / len(self.targets),
            },
            number=self._target().number if self.collected < len(self.targets) else 0,
            collected=self.collected,
            total=len(self.targets),
            capture=captured,
        )
