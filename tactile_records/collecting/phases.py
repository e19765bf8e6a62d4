"""The phases of data collection that look at the images; `task.DataCollection` puts them in order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND
from tactile_control.motion import TravelSettings, Waypoint, pose_difference
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import RETREAT, Phase, PhaseFailed, StampedImage, StampedPose, StraightTo
from tactile_geometry import se3
from tactile_perception.estimating.image import ImageError
from tactile_records.collecting import geometry
from tactile_records.collecting.inputs import Look, MeasuredForces
from tactile_records.collecting.sample_store import SampleStore
from tactile_records.collecting.settings import (
    CAPTURE,
    CONTACT,
    REFERENCE,
    ROTATE,
    TARE,
    TOUCH,
    Capture,
    CollectionGoal,
    CollectionMotionSettings,
    DataCollectionSettings,
    Target,
)

Array = NDArray[np.float64]

OVER, DOWN, UP = "over", "down", "up"  # steps of a touch
NEEDS = ("pose", "image")
_NEAR = 1e-3  # m; a touch need not begin and end more exactly than this
_NEAR_ANGLE = 0.1  # rad; nor a turn go on


class Collection(PhaseMachine):
    """What the phases of a collection know of it, and make of it.

    Attributes
    ----------
    store, look : where samples go; whether images show contact
    T_base_f : ndarray (4, 4)
        Contact frame on the flat surface or edge (see `geometry`); touches correct it.
    touches : list of ndarray (3,)
        Positions of the sensor's centre in {f} at which a touch has found the surface.
    surface_known : whether touches have found it before
    targets, collected : the samples to collect, and how many of them are there
    image, in_contact : the newest image; whether it shows contact, None where nobody can say
    forces : what a force sensor has measured
    """

    settings: DataCollectionSettings
    goal: CollectionGoal
    store: SampleStore
    look: Look
    T_base_f: Array
    touches: list[Array]
    surface_known: bool
    targets: list[Target]
    collected: int
    image: StampedImage | None
    in_contact: bool | None
    forces: MeasuredForces

    @property
    def target(self) -> Target:
        """The sample under way."""
        return self.targets[self.collected]

    def in_base(self, X_fs: Array) -> Array:
        """A pose in {f} (4, 4) in the base."""
        return np.asarray(self.T_base_f @ X_fs)

    def in_contact_frame(self, T_base_sensor: Array) -> Array:
        """A pose in the base (4, 4) in {f}."""
        return np.asarray(se3.inverse(self.T_base_f) @ T_base_sensor)


class CollectionPhase(Phase[Collection]):
    """A phase that looks at the images, in the contact frame {f}."""

    needs = NEEDS

    @property
    def motion(self) -> CollectionMotionSettings:
        """Speeds, tolerances and times."""
        return self.task.settings.motion

    @property
    def exposure(self) -> StampedImage:
        """The newest image."""
        assert self.task.image is not None
        return self.task.image

    @property
    def X_fs(self) -> Array:
        """The sensor (4, 4) in {f}."""
        return self.task.in_contact_frame(self.T_base_sensor)

    def keep(self, what: Callable[..., Any], *arguments: Any) -> None:
        """Have it written, or fail off the surface."""
        try:
            what(*arguments)
        except (OSError, ImageError) as error:
            raise PhaseFailed(f"cannot write to {self.task.settings.data.folder}: {error}") from error


class Rest(CollectionPhase):
    """At rest until an exposure of that rest has come."""

    def begin(self) -> None:
        self.still: StampedPose | None = None
        self.task.forces.forget()  # what was measured on the way

    def resting(self) -> bool:
        """Whether the commanded twist is zero and the pose has not moved for `settle_time`."""
        pose = self.task.pose
        assert pose is not None
        if self.still is None or not self._near(pose.T, self.still.T) or not self.task.at_rest:
            self.still = pose
            return False
        return (pose.stamp_ns - self.still.stamp_ns) * NANOSECOND >= self.motion.settle_time

    def rested(self) -> bool:
        """Whether the newest exposure was made after rest had settled, where the sensor rests."""
        assert self.still is not None
        settled = self.exposure.stamp_ns >= self.settled_ns
        return settled and self._near(self.exposure.T_base_sensor, self.still.T)

    @property
    def settled_ns(self) -> int:
        """When it had come to rest."""
        assert self.still is not None
        return self.still.stamp_ns + round(self.motion.settle_time / NANOSECOND)

    def late(self, what: str) -> None:
        """Fail where rest, or an image, takes too long."""
        if self.elapsed > self.motion.capture_timeout + self.motion.settle_time:
            raise PhaseFailed(f"{what} within {self.motion.capture_timeout:g} s")

    def adjust(self, twist: Array, waiting: str) -> tuple[Array, str]:
        if waiting:  # for an input: nobody knows whether the arm rests
            self.still = None
        return twist, waiting

    def _near(self, T: Array, other: Array) -> bool:
        position, rotation = pose_difference(T, other)
        return (
            se3.norm(position) <= self.motion.still_distance and se3.norm(rotation) <= self.motion.still_angle
        )


class Reference(Rest):
    """Off the surface until the image without contact is known."""

    name = REFERENCE

    def begin(self) -> None:
        super().begin()
        self.task.look.forget()

    def over(self) -> bool:
        if self.task.in_contact is not None and self.resting():
            if self.task.in_contact:
                raise PhaseFailed("the image shows contact where there is none: the reference is no good")
            self.keep(self.task.store.keep_reference, self.exposure.image)
            return True
        self.late("no image without contact was taken")
        return False

    def next_phase(self) -> str:
        return TOUCH if self.task.settings.touch.points and not self.task.surface_known else ROTATE


class Touch(CollectionPhase, StraightTo[Collection]):
    """Finds the surface: over each place, down until the image shows contact, up again."""

    def __init__(self, task: Collection) -> None:
        super().__init__(task, TOUCH, ROTATE, goal=self._goal, pace=self._pace)

    def begin(self) -> None:
        super().begin()
        self.places = geometry.places(self.task.settings.touch, self.task.settings.edge)
        self._go(OVER)

    def _go(self, step: str) -> None:
        self.step, self.step_ns = step, self.task.now_ns

    def _goal(self) -> Array:
        touches, search = self.task.touches, self.task.settings.touch.search
        x, y = touches[-1][:2] if self.step == UP else self.places[len(touches)]
        return self.task.in_base(geometry.at(x, y, 2.0 * search if self.step == DOWN else -search))

    def _pace(self) -> TravelSettings:
        if self.step == DOWN:
            return self.motion.in_contact.replaced(speed=self.task.settings.touch.speed)
        return self.motion.in_air

    def over(self) -> bool:
        settings, touches = self.task.settings.touch, self.task.touches
        fresh, depth = self.exposure.stamp_ns >= self.step_ns, self.X_fs[2, 3]
        if self.step == UP and depth <= -settings.search + _NEAR:
            self._go(OVER)
            if len(touches) == len(self.places):
                self._correct(np.array(touches))
                return True
        elif self.step == DOWN and fresh and self.task.in_contact:
            touches.append(self.task.in_contact_frame(self.exposure.T_base_sensor)[:3, 3])
            self._go(UP)
        elif self.step == DOWN and depth > settings.search:
            around = f"{settings.search * 1e3:.1f} mm above and below"
            raise PhaseFailed(f"no contact within {around} where the surface should be")
        elif self.step == OVER and fresh:
            position, _ = pose_difference(self.T_base_sensor, self.goal())
            if se3.norm(position) <= _NEAR:
                if self.task.in_contact:
                    above = f"{settings.search * 1e3:.1f} mm above the surface"
                    raise PhaseFailed(f"the image shows contact {above}")
                self._go(DOWN)
        if self.elapsed > self.motion.motion_timeout * len(self.places):
            raise PhaseFailed(f"{len(touches) + 1} touches took too long")
        return False

    def _correct(self, centers: Array) -> None:
        """Move the contact frame to where touches have found the surface, and keep that."""
        assumed, settings = self.task.T_base_f, self.task.settings
        try:
            self.task.T_base_f = geometry.frame_from_touches(assumed, centers, settings.touch, settings.edge)
        except ValueError as error:
            raise PhaseFailed(str(error)) from error
        self.keep(self.task.store.keep_surface, self.task.T_base_f, assumed, len(centers))


class Rotate(CollectionPhase, StraightTo[Collection]):
    """Back over the point of first touch, turned to the contact angles, in the air."""

    what = "the start of the contact"

    def __init__(self, task: Collection) -> None:
        super().__init__(task, ROTATE, CONTACT, pace=lambda: self.motion.in_air)

    def way(self) -> list[Waypoint]:
        """Turned over the contact, never by more than half a turn at once."""
        gamma, clearance = se3.euler_from_pose(self.X_fs)[5], self.motion.clearance
        turns = geometry.turns_to(self.task.target.pressed, gamma)
        *between, last = [self.task.in_base(geometry.above(pressed, clearance)) for pressed in turns]
        pace = self.pace()
        ways = [Waypoint(T, _NEAR, _NEAR_ANGLE) for T in between]
        return [*ways, Waypoint(last, pace.position_tolerance, pace.angle_tolerance)]

    def over(self) -> bool:
        """Out of contact, too, in an image exposed since it began."""
        self.there = super().over()
        if not self.there:
            return False
        seen = self.task.in_contact
        if seen is not None and not seen and self.exposure.stamp_ns >= self.task.since_ns:
            return True
        if self.elapsed > self.motion.capture_timeout:
            raise PhaseFailed(
                f"the image shows contact {self.motion.clearance * 1e3:.1f} mm off the surface: the surface "
                "is nearer than it is said to be (find it by touch), or the reference image is no good"
            )
        return False

    def next_phase(self) -> str:
        return TARE if self.task.settings.force.labelled else CONTACT

    def twist(self) -> Array:
        return np.zeros(6) if self.there else super().twist()


class Tare(Rest):
    """At rest in the air, turned as in contact: what the force sensor says there is no force."""

    name, leads_to = TARE, CONTACT

    def over(self) -> bool:
        resting = self.resting()
        if resting and self.task.forces.tare(self.settled_ns):
            return True
        self.late("the force sensor said nothing" if resting else "the arm did not rest")
        return False


class TakeImage(Rest):
    """At rest in contact."""

    name, leads_to = CAPTURE, RETREAT

    def over(self) -> bool:
        if not (self.resting() and self.rested()):
            self.late("the arm did not rest, or no image came,")
            return False
        force = self.task.forces.force(self.settled_ns)
        if self.task.settings.force.labelled and force is None:
            self.late("the force sensor said nothing")
            return False
        exposure, target = self.exposure, self.task.target
        X_fs = self.task.in_contact_frame(exposure.T_base_sensor)
        depth = geometry.contact_depth(X_fs, self.task.settings.edge)
        if depth >= self.motion.certain_depth and not self.task.in_contact:
            raise PhaseFailed(
                f"the image shows no contact at a depth of {depth * 1e3:.1f} mm: the surface is "
                "further away than it is said to be (find it by touch)"
            )
        if force is not None and depth >= self.motion.certain_depth and force[2] >= 0.0:
            raise PhaseFailed(
                f"the force sensor says {force[2]:.2f} N along the sensor's z at a depth of "
                f"{depth * 1e3:.1f} mm, where that must be negative: set force.sign = "
                f"{-self.task.settings.force.sign}, or correct the frame of its messages"
            )
        label = se3.euler_from_pose(X_fs)
        pose = exposure.T_base_sensor
        capture = Capture(target.number, exposure.stamp_ns, label, target.sheared, pose, force)
        self.keep(self.task.store.keep, capture, exposure.image)
        self.task.collected += 1
        return True
