"""Controller node: what an arm is to do -> twists, as long as a goal of the action `run_task` asks for it.

It runs one kind of task, its parameter `task`; the task's settings are its parameters. A step of the task is
made at each `contact/state`, so that a command leaves as soon as its belief is there, and on a timer in
between, so that the watchdog works when nothing arrives any more. Every twist comes out of the task's
limiter; without a goal it is zero, and so is the last one when the node is deactivated or shut down. One goal
runs at a time: a second one is refused, a cancelled one decelerates and retreats.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray, WrenchStamped
from numpy.typing import NDArray

from tactile_base import topics
from tactile_base.raised import told
from tactile_base.settings import SettingError, unknown_name
from tactile_base.stamps import SECOND_NS
from tactile_control.force_reference import StampedForce
from tactile_control.partners import Partners
from tactile_control.phases import FAILED, Command, StampedPose, StampedPresence, TaskInputs
from tactile_control.task_step import task_step
from tactile_control.tasks import TASKS
from tactile_filter.contact_bounds import ContactBounds
from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformUnavailable
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ContactForce, ContactState
from tactile_records.messages import status_bytes
from tactile_ros.colleagues import listen_to_partners
from tactile_ros.conversions import ns_from_time
from tactile_ros.image_input import ImageTopicSettings, PosedImages, subscribe_images
from tactile_ros.latency import LatencyPublisher
from tactile_ros.managed_node import lost_counter
from tactile_ros.message_bytes import STATE_FLAGS, STATE_XI, force_from_bytes, read_state
from tactile_ros.parameters import GroupParameters, declare_read_only, fixed_settings
from tactile_ros.qos import FORCE, STATE
from tactile_ros.run_nodes import run
from tactile_ros.task_messages import feedback_message, named_goal, path_message, with_settings
from tactile_ros.task_node import ZERO, Run, TaskNode
from tactile_scene.arm_settings import WorkspaceSettings
from tactile_wire.errors import MessageError

PATH_PERIOD = 0.5  # s, between two times that it is told where the task leads


class ControllerNode(TaskNode):
    """See the module's text; the arithmetic is in the tasks of `tactile_control`."""

    def __init__(self) -> None:
        super().__init__("controller")
        self.task = declare_read_only(self, "task_name", "surface_following", "the kind of task that it runs")
        self.task_type = TASKS.load(self.task)
        self.partners = Partners(
            self._arms("awaited", "arms that the task waits for: it rests when one of them does not go on"),
            self._arms("waiting", "arms that wait for the task: the same, once they are at work"),
            self.timing.value.partner_age,
        )
        self.settings = GroupParameters(self, self.task_type.settings_class(), self._configure_task)
        self.bounds = fixed_settings(self, ContactBounds(), "bounds")
        self.space = fixed_settings(self, WorkspaceSettings(), "space")
        self.images: PosedImages | None = None
        if self.task_type.needs_images:
            self.image_topic = fixed_settings(self, ImageTopicSettings(), "images")
            self.images = PosedImages(self, self.step)
        self.goals = self.path_ns = 0
        self.goal_name = ""
        self.forget()

    def _arms(self, name: str, doc: str) -> list[str]:
        """Names of arms that a parameter of that name gives; [""] stands for none."""
        return [arm for arm in declare_read_only(self, name, [""], doc) if arm]

    # ---- lifecycle ----

    def configure(self) -> None:
        """Create publishers, subscriptions and the action."""
        watchdog: Any = self.settings.value.group("watchdog")
        minds = self.task_type.monitors_contact and self.controlled_frame == self.sensor_frame
        if self.images is not None:
            self.images.color = bool(getattr(self.settings.value.group("preprocessing"), "color", False))
            age = getattr(watchdog, "image_age", 0.0)
            subscribe_images(self, self.image_topic, self.images.take, age)
            if getattr(getattr(self.settings.value, "force", None), "labelled", False):
                self.subscribe(WrenchStamped, topics.FORCE_SENSOR.name, self._take_measured, FORCE, age)
        elif self.task_type.needs_sensor or minds:
            age = getattr(watchdog, "belief_age", 0.0)
            self.latency = LatencyPublisher(self, "controller", self.controlled_frame)
            self.subscribe(
                ContactState,
                topics.STATE.name,
                self._take_state,
                STATE,
                age,
                raw=True,
                frame=self.sensor_frame,
            )
            take, frame = self._take_force, self.sensor_frame
            self.subscribe(ContactForce, topics.FORCE_BELIEF.name, take, STATE, raw=True, frame=frame)
        listen_to_partners(self, self.partners)
        self.path_out = self.publisher(PoseArray, topics.PATH.name, STATE)
        self.open_task(self.images.match if self.images else None)
        if self.images is not None:
            self.images.transforms = self.transforms

    def activate(self) -> None:
        """Forget old inputs and be idle."""
        self.forget()
        self.last = None
        self.goal_name = ""

    def forget(self) -> None:
        """Forget what has been received."""
        self.belief: StampedPose | None = None
        self.presence: StampedPresence | None = None
        self.force: StampedForce | None = None
        self.measured: list[StampedForce] = []
        if self.images is not None:
            self.images.forget()
        self.last_step_ns = 0

    # ---- inputs ----

    def _take_state(self, data: bytes) -> None:
        received_ns = self.now_ns()
        stamp_ns, _, numbers = read_state(data)
        if self.belief is not None and stamp_ns < self.belief.stamp_ns:
            behind = (self.belief.stamp_ns - stamp_ns) / SECOND_NS
            raise MessageError(f"its stamp is {behind:.3f} s before that of the last belief")
        xi, flags = numbers[STATE_XI], int(numbers[STATE_FLAGS])
        if self.presence is None or stamp_ns > self.presence.stamp_ns:
            touches, still = not flags & ContactState.NO_CONTACT, bool(flags & ContactState.STILL)
            self.presence = StampedPresence(stamp_ns, touches, still)
        if not flags & (ContactState.INVALID | ContactState.PREDICTED_ONLY):  # as `Belief.measured`
            self._take_belief(stamp_ns, np.array(xi))
        self.step()
        lost = self.counters[lost_counter(topics.STATE.name)]
        self.latency.note(stamp_ns, received_ns, self.last_step_ns, lost)

    def _take_belief(self, stamp_ns: int, xi: NDArray[np.float64]) -> None:
        """Keep the belief; one that cannot be is as if it had not come, and the watchdog acts on that."""
        try:
            self.belief = StampedPose(stamp_ns, self.bounds.pose(xi))
        except se3.PoseError as error:
            self.count("beliefs refused")
            self.warn("belief", f"contact/state refused: {error}")

    def _take_force(self, data: bytes) -> None:
        """Keep the force; a step is made with the belief, which comes by another topic."""
        self.force = StampedForce(*force_from_bytes(data))

    def _take_measured(self, message: WrenchStamped) -> None:
        """Keep what a force sensor says, in {s}, for the next step; while nothing runs nobody asks for it."""
        header, force = message.header, message.wrench.force
        stamp_ns, frame = ns_from_time(header.stamp), header.frame_id.removeprefix("/")
        self.check_stamp(stamp_ns)
        measured = np.array([force.x, force.y, force.z])
        if not np.isfinite(measured).all():
            raise MessageError(f"force is {measured.tolist()}, must be finite numbers")
        if self.run is None:
            return
        if frame != self.sensor_frame:
            try:
                measured = self.transforms.newest(self.sensor_frame, frame)[1][:3, :3] @ measured
            except TransformUnavailable as error:
                raise MessageError(f"frame is '{frame}', must be one that /tf knows: {error}") from error
        self.measured.append(StampedForce(stamp_ns, measured))

    # ---- steps ----

    def step(self) -> None:
        """One step of the goal under way, or a zero twist."""
        now_ns = self.now_ns()
        if self.run is None:
            now_ns, _ = self.send_twist(ZERO)
            self._publish_status(now_ns, self.last, ZERO)
        else:
            pose = self.sensor_pose()
            image = self.images.newest if self.images else None
            posed = StampedPose(*pose) if pose else None
            inputs = TaskInputs(self.belief, self.presence, posed, image, self.force, tuple(self.measured))
            self.measured.clear()
            broken = self.run.task.traceback
            self.run.task.partner = self.partners.trouble(time.monotonic())
            self.run.task.partner_hold = self.partners.hold
            self.run.task.T_world_base = self._place() if self.partners.arms else None
            self.run.task.remark = self.upstream.cause
            command = task_step(self.run.task, now_ns, inputs)
            now_ns, sent = self.send_twist(command.twist)
            if self.run.task.traceback != broken:
                self.get_logger().error(f"{self.goal_name}: {command.reason}\n{self.run.task.traceback}")
            if not (self.run.ends or command.over):
                command = replace(command, progress=math.nan)  # nobody knows
            self._publish_status(now_ns, command, sent)
            self._after(now_ns, command)
        self.last_step_ns = now_ns

    def _place(self) -> NDArray[np.float64] | None:
        """Where the base stands in the world; None where nobody says so."""
        try:
            return self.transforms.lookup(topics.WORLD, self.base_frame, 0)
        except TransformUnavailable:
            return None

    def _after(self, now_ns: int, command: Command) -> None:
        """Feedback, complaints, and the end of the run."""
        assert self.run is not None
        phase_changed = self.last is None or command.phase != self.last.phase
        if phase_changed:
            self.get_logger().info(f"{self.goal_name or 'goal'}: {command.phase} {command.reason}".rstrip())
        self.last = command
        if command.reason and not command.done:
            self.report.complain("task", command.reason)
        if command.done:
            self.finish_run(command.reason, command.succeeded)
        elif phase_changed or self.run.feedback_due(now_ns, self.timing.value.feedback_period):
            self.run.handle.publish_feedback(feedback_message(command, self.run.task.contact_pose()))
        if self.run is not None and (phase_changed or now_ns - self.path_ns >= PATH_PERIOD * SECOND_NS):
            self._publish_path(now_ns, self.run.task.ahead)

    def _publish_path(self, now_ns: int, ahead: Callable[[], list[NDArray[np.float64]]]) -> None:
        """Where the task leads, for people: what goes wrong with it keeps the task from nothing."""
        self.path_ns = now_ns
        try:
            self.path_out.publish(path_message(now_ns, self.base_frame, ahead()))
        except Exception as error:  # a task may be somebody else's
            self.warn("path", f"where the task leads is not told: {told(error, self.task_type)}")

    def _publish_status(self, now_ns: int, command: Command | None, twist: NDArray[np.float64]) -> None:
        goal = max(self.goals - 1, 0), self.goal_name
        belief_ns, running = self.belief.stamp_ns if self.belief else 0, self.run is not None
        said = self.controlled_frame, self.task, goal, command, twist, running, belief_ns
        self.status_out.publish(status_bytes(now_ns, *said))

    # ---- parameters ----

    def _configure_task(self) -> None:
        if self.run is not None:
            self.run.task.configure(with_settings(self.run.handle.request, self.settings.value))

    # ---- the action ----

    def objection(self, goal: RunTask.Goal) -> str:
        """See `TaskNode`."""
        if self.run is not None:
            return f"'{self.goal_name}' is running; cancel it first"
        if goal.task != self.task:
            return f"task: {unknown_name(goal.task, [self.task])}; this controller was started for it"
        try:
            named = named_goal(goal, self.task_type)
            with_settings(goal, self.settings.value)
        except (SettingError, ValueError) as error:
            return str(error)
        outside = "" if named.start is None else self.space.outside(named.start[:3, 3], self.arm)
        return f"start: {outside}" if outside else ""

    def accept(self, handle: Any) -> Run:
        """See `TaskNode`."""
        message = handle.request
        named = named_goal(message, self.task_type)
        make: Any = self.task_type
        task = make(with_settings(message, self.settings.value), named.goal, named.start)
        self.goal_name = named.name
        self.goals += 1
        self.last = None
        self.partners.begin()
        return Run(handle, task, self.now_ns(), named.goal.ends)

    def finish_run(self, reason: str, succeeded: bool) -> None:
        """End the run, and warn of a failure; the status tells also of one that is none of the task's."""
        assert self.run is not None
        try:
            self.run.task.close()
        except Exception as error:  # a task may be somebody else's
            reason, succeeded = "; ".join(filter(None, (reason, told(error)))), False
        super().finish_run(reason, succeeded)
        self._publish_path(self.now_ns(), list)  # nowhere
        if self.last is not None and not self.last.done:
            self.last = replace(self.last, phase=FAILED, reason=reason)
            self._publish_status(self.now_ns(), self.last, ZERO)
        if not succeeded:
            self.warn("task", f"'{self.goal_name}' failed: {reason}", period=0.0)


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(ControllerNode)


if __name__ == "__main__":
    sys.exit(main())
