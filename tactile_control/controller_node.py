"""Controller node: beliefs -> twists, as long as a goal of the action `run_task` asks for it.

A step of the task runs at each `contact/state`, so that a command leaves as soon as its belief is there, and
on a timer in between, so that the watchdog works when nothing arrives any more. Every twist comes out of the
task's limiter; without a goal it is zero, and so is the last one when the node is deactivated or shut down.
One goal runs at a time: a second one is refused, a cancelled one decelerates and retreats.
"""

from __future__ import annotations

import functools
import math
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from numpy.typing import NDArray
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.duration import Duration

from tactile_bringup.ros.cdr import HeadedReader, Layout, split_stamp
from tactile_bringup.ros.conversions import MessageError, matrix_from_pose
from tactile_bringup.ros.latency import LatencyPublisher
from tactile_bringup.ros.managed_node import ManagedNode, lost_counter, run
from tactile_bringup.ros.parameters import SettingsParameters
from tactile_bringup.ros.qos import COMMAND, STATE
from tactile_bringup.ros.stamps import SECOND_NS, duration_from_ns
from tactile_bringup.ros.transforms import TransformListener
from tactile_bringup.ros.wire import twist_bytes
from tactile_control.files import TASKS
from tactile_control.task import Command, PathGoal, StampedPose, StampedPresence, SurfaceFollowing, TaskInputs
from tactile_control.task_settings import SurfaceFollowingSettings
from tactile_filter import se3
from tactile_filter.settings import SettingError, Settings, setting, unknown_name
from tactile_filter.transform_buffer import TransformUnavailable
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ContactState, ControllerStatus

IDLE = "idle"
STATE_TOPIC = "contact/state"
ZERO = np.zeros(6)
NOT_A_NUMBER = np.full(6, np.nan)
read_state = HeadedReader(ContactState)
XI, FLAGS = slice(0, 6), 50  # among its numbers: behind xi are covariance, euler, nis and nis_dof


@dataclass(frozen=True)
class ControllerTimingSettings(Settings):
    """When the controller acts without being asked by a belief."""

    watchdog_period: float = setting(
        0.02,
        lower=0.001,
        upper=0.05,
        unit="s",
        doc="a step is made at the latest this long after the last one",
    )
    idle_period: float = setting(
        0.1, lower=0.01, upper=1.0, unit="s", doc="without a task a zero twist is sent this often"
    )
    feedback_period: float = setting(
        0.1, lower=0.01, upper=10.0, unit="s", doc="the action's feedback is sent this often"
    )


@dataclass
class Run:
    """One accepted goal."""

    handle: Any
    task: SurfaceFollowing
    started_ns: int
    overrides: dict[str, dict[str, Any]]
    feedback_ns: int = 0


class ControllerNode(ManagedNode):
    """See the module's text; the arithmetic is `SurfaceFollowing`."""

    def __init__(self) -> None:
        super().__init__("controller")
        self.timing = SettingsParameters(
            self, ControllerTimingSettings(), prefix="timing", read_only=("watchdog_period",)
        )
        defaults = SurfaceFollowingSettings()
        self.groups = {
            name: SettingsParameters(
                self, getattr(defaults, name), prefix=name, on_change=self._configure_task
            )
            for name in ("task", "servoing", "pid", "limiter", "watchdog", "prediction")
        }
        self.run: Run | None = None
        self.last: Command | None = None
        self.goals = 0
        self._clear()

    # ---- lifecycle ----

    def configure(self) -> None:
        """Create publishers, subscriptions and the action."""
        limits = self.groups["watchdog"].value
        self.twist_out = self.publisher(TwistStamped, "command/twist", COMMAND)
        self.status_out = self.publisher(ControllerStatus, "controller/status", STATE)
        self.latency = LatencyPublisher(self, "controller", self.sensor_frame)
        self.transforms = TransformListener(self, on_jump=self._jumped)
        self.subscribe(ContactState, STATE_TOPIC, self._take_state, STATE, limits.belief_age, raw=True)
        self.timer(self.timing.value.watchdog_period, self._tick)
        action = ActionServer(
            self,
            RunTask,
            "run_task",
            execute_callback=_nothing_to_execute,
            goal_callback=self._consider_goal,
            handle_accepted_callback=self._accept_goal,
            cancel_callback=self._cancel,
        )
        self.release_later(ActionServer.destroy, action)

    def activate(self) -> None:
        """Forget old inputs and be idle."""
        self._clear()
        self.last = None
        self.path_name = ""

    def deactivate(self) -> None:
        """Abort what runs and leave a zero twist as the last word."""
        if self.run is not None:
            self._finish("the controller was deactivated", succeeded=False)
        self.twist_out.publish(twist_bytes(self.now_ns(), self.sensor_frame, ZERO))
        self.twist_out.wait_for_all_acked(Duration(seconds=0.2))

    def _clear(self) -> None:
        self.belief: StampedPose | None = None
        self.presence: StampedPresence | None = None
        self.last_step_ns = 0

    # ---- inputs ----

    def _take_state(self, data: bytes) -> None:
        received_ns = self.now_ns()
        stamp_ns, _, numbers = read_state(data)
        xi, flags = numbers[XI], int(numbers[FLAGS])
        self._update_presence(stamp_ns, not flags & ContactState.NO_CONTACT)
        if not flags & ContactState.INVALID:
            self._take_belief(stamp_ns, np.array(xi))
        self._step()
        self.latency.note(stamp_ns, received_ns, self.last_step_ns, self.counters[lost_counter(STATE_TOPIC)])

    def _take_belief(self, stamp_ns: int, xi: NDArray[np.float64]) -> None:
        """Keep the belief; one that is not finite is as if it had not come, and the watchdog acts on that."""
        if not np.isfinite(xi).all():
            self.count("beliefs refused")
            self.warn("belief", f"contact/state refused: xi is not finite: {xi.tolist()}")
            return
        self.belief = StampedPose(stamp_ns, se3.exp(xi))

    def _update_presence(self, stamp_ns: int, in_contact: bool) -> None:
        if self.presence is None or stamp_ns > self.presence.stamp_ns:
            self.presence = StampedPresence(stamp_ns, in_contact)

    def _sensor_pose(self) -> StampedPose | None:
        """Where the sensor is now, by the newest transform; its age is for the task's watchdog."""
        try:
            return StampedPose(*self.transforms.newest(self.base_frame, self.sensor_frame))
        except TransformUnavailable as error:
            if self.run is not None:
                self.warn("pose", f"no sensor pose: {error}")
            return None

    def _jumped(self, seconds: float) -> None:
        self._clear()
        if self.run is not None:
            self.run.task.stop(f"time jumped back by {seconds:.3f} s")

    # ---- steps ----

    def _tick(self) -> None:
        """The timer: a step if none was made lately."""
        timing = self.timing.value
        period = timing.watchdog_period if self.run is not None else timing.idle_period
        if self.now_ns() - self.last_step_ns > 0.75 * period * SECOND_NS:
            self._step()

    def _step(self) -> None:
        now_ns = self.now_ns()
        if self.run is None:
            self.twist_out.publish(twist_bytes(now_ns, self.sensor_frame, ZERO))
            self._publish_status(now_ns, self.last, ZERO)
        else:
            inputs = TaskInputs(self.belief, self.presence, self._sensor_pose())
            command = self.run.task.step(now_ns, inputs)
            now_ns = self.now_ns()
            self.twist_out.publish(twist_bytes(now_ns, self.sensor_frame, command.twist))
            self._publish_status(now_ns, command, command.twist)
            self._after(now_ns, command)
        self.last_step_ns = now_ns

    def _after(self, now_ns: int, command: Command) -> None:
        """Feedback, complaints, and the end of the run."""
        assert self.run is not None
        if self.last is None or command.phase != self.last.phase:
            self.get_logger().info(f"{self.path_name or 'path'}: {command.phase} {command.reason}".rstrip())
        self.last = command
        if command.reason and not command.done:
            self.report.complain("task", command.reason)
        if command.done:
            self._finish(command.reason, command.succeeded)
        elif now_ns - self.run.feedback_ns >= self.timing.value.feedback_period * SECOND_NS:
            self.run.feedback_ns = now_ns
            self.run.handle.publish_feedback(self._feedback(command))

    def _feedback(self, command: Command) -> RunTask.Feedback:
        depth, normal_error = math.nan, math.nan
        if self.belief is not None:
            T_fs = se3.inverse(self.belief.T)
            depth, normal_error = float(T_fs[2, 3]), math.acos(max(-1.0, min(1.0, T_fs[2, 2])))
        return RunTask.Feedback(
            phase=phase_code(command.phase),
            phase_name=command.phase,
            reason=command.reason,
            progress=command.progress,
            path_length=command.travelled,
            depth=depth,
            normal_error=normal_error,
        )

    def _publish_status(self, now_ns: int, command: Command | None, twist: NDArray[np.float64]) -> None:
        age = (now_ns - self.belief.stamp_ns) / SECOND_NS if self.belief else -1.0
        path = max(self.goals - 1, 0), self.path_name
        self.status_out.publish(
            status_bytes(now_ns, self.sensor_frame, command, self.run is not None, path, twist, age)
        )

    # ---- parameters ----

    def _configure_task(self, changed: Settings) -> None:
        if self.run is not None:
            self.run.task.configure(self._settings(self.run.overrides))

    def _settings(self, overrides: dict[str, dict[str, Any]]) -> SurfaceFollowingSettings:
        """The parameters in force, with what a goal asks for on top."""
        values = {name: group.value for name, group in self.groups.items()}
        return SurfaceFollowingSettings(**values).merged(overrides)

    # ---- the action ----

    def _consider_goal(self, goal: RunTask.Goal) -> GoalResponse:
        reason = self._objection(goal)
        if reason:
            self.count("goals refused")
            self.warn("goal", f"goal refused: {reason}", period=0.0)
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _objection(self, goal: RunTask.Goal) -> str:
        """'' or why the goal cannot be run, with what would be right."""
        if not self.active:
            return "the controller is not active"
        if self.run is not None:
            return f"'{self.path_name}' is running; cancel it first"
        if goal.task not in TASKS:
            return f"task: {unknown_name(goal.task, TASKS)}"
        try:
            path_goal(goal)
            self._settings(goal_overrides(goal))
        except (SettingError, ValueError) as error:
            return str(error)
        return ""

    def _accept_goal(self, handle: Any) -> None:
        goal = handle.request
        overrides = goal_overrides(goal)
        task = SurfaceFollowing(self._settings(overrides), path_goal(goal))
        self.run = Run(handle, task, self.now_ns(), overrides)
        self.path_name = goal.path_name
        self.goals += 1
        self.last = None

    def _cancel(self, handle: Any) -> CancelResponse:
        if self.run is None or handle.goal_id != self.run.handle.goal_id:
            return CancelResponse.REJECT
        self.run.task.stop("cancelled")
        return CancelResponse.ACCEPT

    def _finish(self, reason: str, succeeded: bool) -> None:
        """End the run with the state that its goal is to have."""
        assert self.run is not None
        run, self.run = self.run, None
        result = RunTask.Result(
            success=succeeded,
            reason=reason,
            path_length=self.last.travelled if self.last else 0.0,
            duration=duration_from_ns(self.now_ns() - run.started_ns),
        )
        if not succeeded:
            self.warn("task", f"'{self.path_name}' failed: {reason}", period=0.0)

        def conclude(handle: Any) -> RunTask.Result:
            if handle.is_cancel_requested:
                handle.canceled()
            elif succeeded:
                handle.succeed()
            else:
                handle.abort()
            return result

        run.handle.execute(conclude)


def _nothing_to_execute(handle: Any) -> RunTask.Result:
    """Stands in for the action server's callback: steps execute goals and `_finish` concludes them.

    A coroutine that waited for the end would be polled without pause by the executors and burn a core.
    """
    raise RuntimeError("goals of run_task are concluded by the controller's steps")


def status_bytes(
    now_ns: int,
    frame_id: str,
    command: Command | None,
    running: bool,
    path: tuple[int, str],
    twist: NDArray[np.float64],
    belief_age: float,
) -> bytes:
    """ControllerStatus of the last command, if there is one, and the twist that went out."""
    phase, reason = (command.phase, command.reason) if command else (IDLE, "")
    number, name = path
    unlimited = command.unlimited if command and running else ZERO
    return _status_layout(frame_id, phase, name, reason).pack(
        *split_stamp(now_ns),
        *split_stamp(command.exposure_ns if command and running else 0),
        phase_code(phase),
        number,
        *(command.error if command else NOT_A_NUMBER).tolist(),
        *(command.feedforward if command else ZERO).tolist(),
        *unlimited.tolist(),
        *twist.tolist(),
        *(np.abs(unlimited - twist) > 1e-12).tolist(),
        command.progress if command else 0.0,
        command.travelled if command else 0.0,
        belief_age,
    )


@functools.lru_cache(maxsize=32)
def _status_layout(frame_id: str, phase: str, path: str, reason: str) -> Layout:
    example = ControllerStatus(phase_name=phase, path_name=path, reason=reason)
    example.header.frame_id = frame_id
    return Layout(example)


def phase_code(phase: str) -> int:
    """The constant of ControllerStatus for a phase's name."""
    return int(getattr(ControllerStatus, phase.upper()))


def path_goal(goal: RunTask.Goal) -> PathGoal:
    """The path that a goal message asks for; raises ValueError saying what is wrong with it."""
    x, y = map(float, goal.direction)
    if not math.isfinite(x + y) or math.hypot(x, y) == 0.0:
        raise ValueError(f"direction = ({x}, {y}): must be a finite vector other than zero")
    if len(goal.target) not in (0, 3):
        raise ValueError(f"target: must have 0 or 3 elements, has {len(goal.target)}")
    try:
        start = matrix_from_pose(goal.start[0]) if goal.start else None
    except MessageError as error:
        raise ValueError(f"start: {error}") from error
    return PathGoal(
        direction=math.atan2(y, x),
        length=float(goal.path_length),
        start=start,
        target=np.array(goal.target) if len(goal.target) else None,
        target_radius=float(goal.target_radius) or PathGoal.target_radius,
        name=goal.path_name,
    )


def goal_overrides(goal: RunTask.Goal) -> dict[str, dict[str, Any]]:
    """Settings that a goal message sets in place of the parameters, as {group: {name: value}}."""
    overrides: dict[str, dict[str, Any]] = {}
    if goal.speed != 0.0:
        overrides["task"] = {"speed": float(goal.speed)}
    if len(goal.reference):
        overrides["servoing"] = {"reference": tuple(map(float, goal.reference))}
    return overrides


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(ControllerNode)


if __name__ == "__main__":
    sys.exit(main())
