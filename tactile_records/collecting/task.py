"""Data collection: approach, rotate, contact, shear, image, retreat, again and again.

The paper's Algorithm "Data collection" for an arm that takes twists. Phases: go_to_start -> reference ->
(touch) -> (rotate -> (tare) -> contact -> shear -> capture -> retreat) for each sample -> done, or failed.
The label is where the arm says that the sensor was at the exposure, not where it was sent; where there is a
force sensor, also what it says at that rest less what it said over the surface. An image without contact is
kept as number 0. A goal goes on where the folder ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_control.phases import (
    DONE,
    GO_TO_START,
    RETREAT,
    GoToPose,
    InputRefused,
    LiftOff,
    Phase,
    StampedImage,
    Stopping,
    StraightTo,
    TaskInputs,
    newer,
)
from tactile_geometry import se3
from tactile_perception.estimating.image import ImageError
from tactile_records.collecting import geometry
from tactile_records.collecting.inputs import Look, MeasuredForces
from tactile_records.collecting.phases import NEEDS, Collection, Reference, Rotate, TakeImage, Tare, Touch
from tactile_records.collecting.sample_store import SampleStore
from tactile_records.collecting.settings import (
    CAPTURE,
    CONTACT,
    PHASES,
    REFERENCE,
    ROTATE,
    SHEAR,
    CollectionGoal,
    DataCollectionSettings,
    Target,
)
from tactile_scene.sampling import contact_poses

Array = NDArray[np.float64]


class DataCollection(Collection):
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
        self.forces = MeasuredForces(settings.force)
        self.store = store or SampleStore(
            settings.data.folder, settings.preprocessing, settings.data.images, settings.force.labelled
        )
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
            Tare(self),
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
        if self.settings.force.labelled:
            self.forces.take(inputs.measured)
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

    @property
    def nothing_left(self) -> bool:
        """Whether a retreat is the last one."""
        return super().nothing_left or self.collected == len(self.targets)
