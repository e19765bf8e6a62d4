"""Data collection: approach, rotate, contact, shear, image, retreat, again and again.

The paper's Algorithm "Data collection" for an arm that takes twists. Phases: go_to_start -> reference ->
(touch) -> (rotate -> contact -> shear -> capture -> retreat) for each sample -> done, or failed. The label is
where the arm says that the sensor was at the exposure, not where it was sent. An image without contact is
kept as number 0. A goal goes on where the folder ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND
from tactile_control.motion import TravelSettings, Waypoint, pose_difference
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import (
    DONE,
    GO_TO_START,
    RETREAT,
    GoToPose,
    InputRefused,
    LiftOff,
    Phase,
    PhaseFailed,
    StampedImage,
    StampedPose,
    Stopping,
    StraightTo,
    TaskInputs,
    newer,
)
from tactile_geometry import se3
from tactile_perception.estimating.image import Image, ImageError, check_image
from tactile_perception.estimating.preprocessing import Preprocessor
from tactile_perception.estimating.presence import ContactPresence
from tactile_records.collecting import geometry
from tactile_records.collecting.sample_store import SampleStore
from tactile_records.collecting.settings import (
    CAPTURE,
    CONTACT,
    PHASES,
    REFERENCE,
    ROTATE,
    SHEAR,
    TOUCH,
    Capture,
    CollectionGoal,
    CollectionMotionSettings,
    DataCollectionSettings,
    Target,
)
from tactile_scene.sampling import contact_poses

Array = NDArray[np.float64]

OVER, DOWN, UP = "over", "down", "up"  # steps of a touch
NEEDS = ("pose", "image")
_NEAR = 1e-3  # m; a touch need not begin and end more exactly than this
_NEAR_ANGLE = 0.1  # rad; nor a turn go on


class CollectionPhase(Phase["DataCollection"]):
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
        rest = (self.exposure.stamp_ns - self.still.stamp_ns) * NANOSECOND
        return rest >= self.motion.settle_time and self._near(self.exposure.T_base_sensor, self.still.T)

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


class Touch(CollectionPhase, StraightTo["DataCollection"]):
    """Finds the surface: over each place, down until the image shows contact, up again."""

    def __init__(self, task: DataCollection) -> None:
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


class Rotate(CollectionPhase, StraightTo["DataCollection"]):
    """Back over the point of first touch, turned to the contact angles, in the air."""

    what = "the start of the contact"

    def __init__(self, task: DataCollection) -> None:
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

    def twist(self) -> Array:
        return np.zeros(6) if self.there else super().twist()


class TakeImage(Rest):
    """At rest in contact."""

    name, leads_to = CAPTURE, RETREAT

    def over(self) -> bool:
        if not (self.resting() and self.rested()):
            self.late("the arm did not rest, or no image came,")
            return False
        exposure, target = self.exposure, self.task.target
        X_fs = self.task.in_contact_frame(exposure.T_base_sensor)
        depth = geometry.contact_depth(X_fs, self.task.settings.edge)
        if depth >= self.motion.certain_depth and not self.task.in_contact:
            raise PhaseFailed(
                f"the image shows no contact at a depth of {depth * 1e3:.1f} mm: the surface is "
                "further away than it is said to be (find it by touch)"
            )
        label = se3.euler_from_pose(X_fs)
        capture = Capture(target.number, exposure.stamp_ns, label, target.sheared, exposure.T_base_sensor)
        self.keep(self.task.store.keep, capture, exposure.image)
        self.task.collected += 1
        return True


class Look:
    """Whether an image shows contact, by a reference that the first images without contact make."""

    def __init__(self, settings: DataCollectionSettings) -> None:
        # that compares with its own reference: a difference would need one before
        self._preprocessor = Preprocessor(settings.preprocessing.replaced(difference=0.0))
        self._presence = ContactPresence(settings.presence)

    def forget(self) -> None:
        """Forget the reference."""
        self._presence.reset()

    def __call__(self, image: Image, without_contact: bool) -> bool | None:
        """None where there is no reference; only images `without_contact` make one. Raises `ImageError`."""
        settings = self._preprocessor.settings
        check_image(image, settings.raw_shape, "camera image", settings.color)
        if not (without_contact or self._presence.ready):
            return None
        return self._presence.update(self._preprocessor(image)).in_contact


class DataCollection(PhaseMachine):
    """Collects one sample after the other; see the module's text.

    Parameters
    ----------
    settings : DataCollectionSettings
    goal : CollectionGoal
    start : None
        It begins over its contact frame.
    store : SampleStore, optional
        Where samples go; by default a folder as the settings say.
    look : callable, optional
        Whether images show contact; by default `Look`.

    Attributes
    ----------
    T_base_f : ndarray (4, 4)
        Contact frame on the flat surface or edge (see `geometry`); touches correct it.
    touches : list of ndarray (3,)
        Positions of the sensor's centre in {f} at which a touch has found the surface.
    surface_known : whether touches have found it before
    image, in_contact : the newest image; whether it shows contact, None where nobody can say

    Raises
    ------
    ValueError
        With a start, without a folder, or with a contact frame that is no rigid transform.
    DatasetError, OSError
        For a folder that cannot be used.
    """

    settings_class = DataCollectionSettings
    goal_class = CollectionGoal
    phases = PHASES
    work = CAPTURE
    needs_images: ClassVar[bool] = True

    settings: DataCollectionSettings
    goal: CollectionGoal

    def __init__(
        self,
        settings: DataCollectionSettings,
        goal: CollectionGoal,
        start: Array | None = None,
        store: SampleStore | None = None,
        look: Look | None = None,
    ) -> None:
        if start is not None:
            raise ValueError("start must be empty: a collection begins over its contact frame")
        if store is None and not settings.data.folder:
            raise ValueError("data.folder: must name the folder of the data set")
        self.look = look or Look(settings)
        self.T_base_f = se3.pose_from_euler(settings.data.frame)
        self.store = store or SampleStore(settings.data.folder, settings.preprocessing, settings.data.images)
        found = self.store.surface()
        self.surface_known = found is not None
        self.T_base_f = self.T_base_f if found is None else found

        edge = settings.edge if settings.edge.pressed else None

        def planned(number: int) -> tuple[Array, Array]:
            index = goal.first + number - 1
            return contact_poses(settings.sampling, edge, goal.seed, index)

        self.targets = [Target(number, *planned(number)) for number in self.store.missing(goal.samples)]
        self.collected = 0
        self.touches: list[Array] = []
        self.image: StampedImage | None = None
        self.in_contact: bool | None = None
        super().__init__(settings, goal)

    # ---- what a `PhaseMachine` fills in ----

    def make_phases(self) -> Iterable[Phase[Any]]:
        """See `PhaseMachine`."""

        def to(X_fs: Callable[[], Array], pace: str, what: str = "") -> dict[str, Any]:
            """A way to a pose in {f}, at a pace of the settings."""
            goal, travel = lambda: self.in_base(X_fs()), lambda: getattr(self.settings.motion, pace)
            return {"goal": goal, "pace": travel, "what": what}

        start = to(lambda: geometry.at(0.0, 0.0, -self.settings.motion.standoff), "in_air")
        pressed = to(lambda: se3.pose_from_euler(self.target.pressed), "in_contact", "the depth")
        sheared = to(lambda: se3.pose_from_euler(self.target.sheared), "in_contact", "the shear")
        return (
            GoToPose(self, GO_TO_START, REFERENCE, NEEDS, **start),
            Reference(self),
            Touch(self),
            Rotate(self),
            StraightTo(self, CONTACT, SHEAR, NEEDS, **pressed),
            StraightTo(self, SHEAR, CAPTURE, NEEDS, **sheared),
            TakeImage(self),
            LiftOff(self, RETREAT, ROTATE, **to(self._lifted, "in_air")),
            Stopping(self),
        )

    def _lifted(self) -> Array:
        """Straight off the surface in {f}, the last time further."""
        motion = self.settings.motion
        gap = motion.standoff if self.nothing_left else motion.clearance
        return geometry.lifted(self.in_contact_frame(self.T_base_sensor), gap)

    def first_phase(self) -> str:
        return GO_TO_START if self.targets else DONE

    def take(self, inputs: TaskInputs) -> None:
        super().take(inputs)
        image = inputs.image
        if not newer(image, self.image):
            return
        se3.checked_pose("sensor pose at the exposure", image.T_base_sensor)
        try:
            self.in_contact = self.look(image.image, self.phase == REFERENCE)
        except ImageError as error:
            raise InputRefused(str(error)) from error
        self.image = image

    def progress(self) -> float:
        """By the samples that the folder holds."""
        return 1.0 - (len(self.targets) - self.collected) / self.goal.samples

    def contact_pose(self) -> Array | None:
        """By the arm's pose."""
        return None if self.pose is None else self.in_contact_frame(self.pose.T)

    def close(self) -> None:
        """Make the table whole."""
        try:
            self.store.finish()
        except OSError as error:
            raise OSError(f"cannot write to {self.settings.data.folder}: {error}") from error

    # ---- what its phases share ----

    @property
    def target(self) -> Target:
        """The sample under way."""
        return self.targets[self.collected]

    @property
    def nothing_left(self) -> bool:
        """Whether a retreat is the last one."""
        return super().nothing_left or self.collected == len(self.targets)

    def in_base(self, X_fs: Array) -> Array:
        """A pose in {f} (4, 4) in the base."""
        return np.asarray(self.T_base_f @ X_fs)

    def in_contact_frame(self, T_base_sensor: Array) -> Array:
        """A pose in the base (4, 4) in {f}."""
        return np.asarray(se3.inverse(self.T_base_f) @ T_base_sensor)
