"""Collector node: a labelled data set from an arm that takes twists, when a goal of `run_task` asks for it.

The arithmetic is `DataCollection`. Inputs are `tactile/image` and TF; `command/twist` is what the controller
would send too. Each sample is an image at rest, labelled with the pose that TF gives at its exposure, in the
public layout (`DatasetWriter`); an image without contact is kept as number 0. A goal goes on where the folder
ends. Without a goal the twist is zero, and so is the last one when the node is deactivated or shut down.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import LARGEST_POSE, SMALLEST_POSE, SettingError, setting
from tactile_control.phases import StampedPose
from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformInFuture, TransformUnavailable
from tactile_msgs.action import RunTask
from tactile_perception.datasets.layout import DatasetError
from tactile_perception.datasets.writer import IMAGE_KINDS
from tactile_perception.estimating.image import ImageError, check_image
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_records.collecting.sample_store import SampleStore
from tactile_records.collecting.settings import (
    REFERENCE,
    ROTATE,
    TASK,
    TOUCH,
    CollectionCommand,
    CollectionGoal,
    CollectionInputs,
    DataCollectionSettings,
    Exposure,
    Target,
)
from tactile_records.collecting.task import DataCollection
from tactile_ros.image_input import ImageTopicSettings, Received, subscribe_images
from tactile_ros.managed_node import ConfigurationError
from tactile_ros.parameters import GroupParameters, SettingsParameters
from tactile_ros.run_nodes import run as run_node
from tactile_ros.task_messages import feedback_message, named_goal, status_bytes
from tactile_ros.task_node import ZERO, Run, TaskNode, conclude
from tactile_scene.sampling import SamplingSettings, pose_of
from tactile_wire.errors import MessageError


@dataclass(frozen=True)
class CollectorSettings(ImageTopicSettings):
    """Where samples go, and over which surface they are taken."""

    folder: str = setting("", doc="data folder, made if it is not there; one with samples is gone on with")
    images: str = setting(
        "both", choices=IMAGE_KINDS, doc="processed (cropped, thresholded), raw (camera images), or both"
    )
    frame: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), length=6, lower=SMALLEST_POSE, upper=LARGEST_POSE, unit="m, rad",
        doc="contact frame {f} in the arm's base, Euler (x, y, z, alpha, beta, gamma): z into the surface, "
        "origin where the sensor's centre is at first touch",
    )  # fmt: skip
    step_period: float = setting(
        0.008, lower=0.001, upper=0.05, unit="s", doc="time between two twists of a running collection"
    )
    idle_period: float = setting(0.1, lower=0.01, upper=1.0, unit="s", doc="and without one")
    feedback_period: float = setting(0.1, lower=0.01, upper=10.0, unit="s", doc="of the action's feedback")


@dataclass(kw_only=True)
class CollectionRun(Run):
    """One accepted goal, with where its samples go and how many were there `before`."""

    task: DataCollection
    store: SampleStore
    before: int
    phase: str = ""
    last: CollectionCommand | None = None


class CollectorNode(TaskNode):
    """See the module's text."""

    run: CollectionRun | None

    def __init__(self) -> None:
        super().__init__("collector")
        names = [item.name for item in dataclasses.fields(CollectorSettings)]
        self.settings = SettingsParameters(self, CollectorSettings(), read_only=names)
        self.sampling = SettingsParameters(self, SamplingSettings(), prefix="sampling")
        self.preprocessing = SettingsParameters(self, PreprocessingSettings(), prefix="preprocessing")
        self.presence_settings = SettingsParameters(self, PresenceSettings(), prefix="presence")
        self.task_settings = GroupParameters(self, DataCollectionSettings(), self._configure_task)
        self.forget()

    # ---- lifecycle ----

    def configure(self) -> None:
        """Create publishers, subscriptions and the action."""
        if not self.settings.value.folder:
            raise ConfigurationError("parameter folder: must name the folder of the data set")
        self.preprocessor = Preprocessor(self.preprocessing.value)
        self.presence = ContactPresence(self.presence_settings.value)
        age = self.task_settings.value.watchdog.image_age
        subscribe_images(self, self.settings.value, self._take_image, age)
        self.open_task(self.settings.value.step_period, on_transform=self._match_image)

    def activate(self) -> None:
        """Forget old inputs and be idle."""
        self.forget()

    def forget(self) -> None:
        """Forget what has been received."""
        self.pending: tuple[int, NDArray[np.uint8]] | None = None
        self.exposure: Exposure | None = None
        self.image: NDArray[np.uint8] | None = None
        self.last_step_ns = 0

    # ---- inputs ----

    def _take_image(self, received: Received) -> None:
        """Keep the newest image until the arm's pose at its exposure is known."""
        try:
            image = received.array().copy()
        except MessageError as error:
            self._refuse_image(str(error))
            return
        if self.pending is not None:
            self.count("images without a pose in time")
        self.pending = received.stamp_ns, image
        self._match_image()

    def _match_image(self) -> None:
        """Make an exposure of the waiting image if the pose at its stamp has come."""
        if self.pending is None:
            return
        stamp_ns, image = self.pending
        try:
            T = self.transforms.lookup(self.base_frame, self.sensor_frame, stamp_ns)
        except TransformInFuture:
            return
        except TransformUnavailable as error:
            self.pending = None
            self.count("images without a pose")
            self.warn("pose", f"image left out: {error}")
            return
        self.pending = None
        try:
            self.exposure = Exposure(stamp_ns, T, self._contact(image))
        except (ImageError, ValueError) as error:
            self._refuse_image(str(error))
            return
        self.image = image
        self.step()

    def _contact(self, image: NDArray[np.uint8]) -> bool | None:
        """Whether the image shows contact; None before the reference is taken, off the surface at rest."""
        check_image(image, self.preprocessing.value.raw_shape, "camera image")
        phase = self.run.phase if self.run is not None else ""
        if phase != REFERENCE and not self.presence.ready:
            return None
        return self.presence.update(self.preprocessor(image)).in_contact

    def _refuse_image(self, reason: str) -> None:
        self.count("images refused")
        self.warn("image", f"tactile/image refused: {reason}")

    # ---- steps ----

    def periods(self) -> tuple[float, float]:
        """See `TaskNode`."""
        return self.settings.value.step_period, self.settings.value.idle_period

    def step(self) -> None:
        """One step of the collection under way, or a zero twist."""
        now_ns = self.now_ns()
        self.last_step_ns = now_ns
        if self.run is None:
            self.send_twist(ZERO)
            self._publish_status(now_ns, None, ZERO)
            return
        pose = self.sensor_pose()
        inputs = CollectionInputs(StampedPose(*pose) if pose else None, self.exposure)
        self.run.task.remark = self.upstream.cause
        command = self.run.task.step(now_ns, inputs)
        assert isinstance(command, CollectionCommand)
        _, sent = self.send_twist(command.twist)
        self._publish_status(now_ns, command, sent)
        self._after(now_ns, command)

    def travelled(self) -> float:
        """See `TaskNode`."""
        return self.run.last.travelled if self.run is not None and self.run.last is not None else 0.0

    def _after(self, now_ns: int, command: CollectionCommand) -> None:
        """What is kept, feedback, complaints, and the end of the run."""
        run = self.run
        assert run is not None
        before, run.phase, run.last = run.phase, command.phase, command
        if before != REFERENCE and command.phase == REFERENCE:
            self.presence.reset()
        self._keep(run, before, command)
        if command.reason and not command.done:
            self.report.complain("collection", command.reason)
        if command.done:
            self.finish_run(command.reason, command.succeeded)
        elif run.feedback_due(now_ns, self.settings.value.feedback_period):
            run.handle.publish_feedback(self._feedback(run, command))

    # ---- what is kept ----

    def _keep(self, run: CollectionRun, before: str, command: CollectionCommand) -> None:
        """Store what this step has given; what cannot be written ends the run, off the surface."""
        image, capture = self.image, command.capture
        try:
            if image is not None and before == REFERENCE and command.phase in (TOUCH, ROTATE):
                run.store.keep_reference(image)
            if before == TOUCH and command.phase == ROTATE:
                touches = len(run.task.touches)
                text = run.store.keep_surface(run.task.T_base_f, self._assumed_frame(), touches)
                self.get_logger().info(text)
            if image is not None and capture is not None:
                run.store.keep(capture, image)
                self.count("samples")
        except (OSError, ImageError) as error:
            run.task.stop(f"cannot write to {run.store.folder}: {error}")

    # ---- messages ----

    def _feedback(self, run: CollectionRun, command: CollectionCommand) -> RunTask.Feedback:
        pose = self.sensor_pose()
        X_fs = None if pose is None else se3.inverse(run.task.T_base_f) @ pose[1]
        progress = (run.before + command.collected) / (run.before + command.total)
        return feedback_message(command, X_fs, progress)

    def _publish_status(
        self, now_ns: int, command: CollectionCommand | None, twist: NDArray[np.float64]
    ) -> None:
        number = command.number if command is not None else 0
        goal = number, f"sample {number}" if number else ""
        running = command is not None
        self.status_out.publish(
            status_bytes(now_ns, self.controlled_frame, TASK, goal, command, twist, running)
        )

    # ---- parameters ----

    def _configure_task(self) -> None:
        if self.run is not None:
            self.run.task.configure(self.task_settings.value)

    # ---- the action ----

    def objection(self, goal: RunTask.Goal) -> str:
        """See `TaskNode`."""
        if self.run is not None:
            return "a collection is running; cancel it first"
        if goal.task != TASK:
            return f"task is '{goal.task}', must be '{TASK}'"
        if goal.start or goal.settings:
            return "start and settings must be empty: set the parameters of the collector"
        try:
            named_goal(goal, DataCollection)
        except SettingError as error:
            return str(error)
        return ""

    def accept(self, handle: Any) -> CollectionRun | None:
        """See `TaskNode`; a folder that cannot be used, or needs nothing, ends the goal at once."""
        try:
            return self._start(handle)
        except (DatasetError, OSError) as error:
            self.warn("collection", str(error), period=0.0)
            conclude(handle, RunTask.Result(success=False, reason=str(error)))
            return None

    def _start(self, handle: Any) -> CollectionRun | None:
        settings = self.settings.value
        goal = named_goal(handle.request, DataCollection).goal
        assert isinstance(goal, CollectionGoal)
        store = SampleStore(settings.folder, self.preprocessing.value, settings.images)
        targets = [
            Target(number, pose_of(self.sampling.value, goal.seed, goal.first + number - 1))
            for number in store.missing(goal.samples)
        ]
        self.get_logger().info(f"{len(targets)} of {goal.samples} samples to collect")
        if not targets:
            store.finish()
            conclude(handle, RunTask.Result(success=True, reason="every sample is there"))
            return None
        self.presence.reset()
        found = store.surface()
        task_settings = self.task_settings.value
        if found is not None:
            task_settings = task_settings.replaced(touch__points=0)
        frame = self._assumed_frame() if found is None else found
        task = DataCollection(task_settings, targets, frame)
        before = goal.samples - len(targets)
        return CollectionRun(handle=handle, task=task, started_ns=self.now_ns(), store=store, before=before)

    def _assumed_frame(self) -> NDArray[np.float64]:
        """T_base_f (4, 4) as the parameter says."""
        return se3.pose_from_euler(self.settings.value.frame)

    def finish_run(self, reason: str, succeeded: bool) -> None:
        """Make the table whole and end the run."""
        assert self.run is not None
        store = self.run.store
        try:
            store.finish()
        except OSError as error:
            reason, succeeded = f"{reason}; cannot write to {store.folder}: {error}".lstrip("; "), False
        if not succeeded:
            self.warn("collection", f"collection failed: {reason}", period=0.0)
        super().finish_run(reason, succeeded)


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run_node(CollectorNode)


if __name__ == "__main__":
    sys.exit(main())
