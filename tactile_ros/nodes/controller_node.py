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
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting, unknown_name
from tactile_control.phases import StampedPose
from tactile_control.task import Command, PathGoal, StampedPresence, SurfaceFollowing, TaskInputs
from tactile_control.task_file import TASKS
from tactile_control.task_settings import SurfaceFollowingSettings
from tactile_filter import se3
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ContactState, ControllerStatus
from tactile_ros.cdr import HeadedReader, Layout, split_stamp
from tactile_ros.conversions import MessageError, matrix_from_pose
from tactile_ros.latency import LatencyPublisher
from tactile_ros.managed_node import lost_counter, run
from tactile_ros.parameters import SettingsParameters
from tactile_ros.qos import STATE
from tactile_ros.stamps import SECOND_NS
from tactile_ros.task_node import ZERO, Run, TaskNode

IDLE = "idle"
STATE_TOPIC = "contact/state"
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


@dataclass(kw_only=True)
class PathRun(Run):
    """One accepted goal, and what it asks of the parameters."""

    task: SurfaceFollowing
    overrides: dict[str, dict[str, Any]]


class ControllerNode(TaskNode):
    """See the module's text; the arithmetic is `SurfaceFollowing`."""

    run: PathRun | None

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
        self.last: Command | None = None
        self.goals = 0
        self.forget()

    # ---- lifecycle ----

    def configure(self) -> None:
        """Create publishers, subscriptions and the action."""
        limits = self.groups["watchdog"].value
        self.latency = LatencyPublisher(self, "controller", self.sensor_frame)
        self.subscribe(ContactState, STATE_TOPIC, self._take_state, STATE, limits.belief_age, raw=True)
        self.open_task(self.timing.value.watchdog_period)

    def activate(self) -> None:
        """Forget old inputs and be idle."""
        self.forget()
        self.last = None
        self.path_name = ""

    def end(self, reason: str) -> None:
        """Abort what runs, and say so."""
        self._finish(reason, succeeded=False)

    def forget(self) -> None:
        """Forget what has been received."""
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
        self.step()
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

    # ---- steps ----

    def periods(self) -> tuple[float, float]:
        """See `TaskNode`."""
        return self.timing.value.watchdog_period, self.timing.value.idle_period

    def step(self) -> None:
        """One step of the path under way, or a zero twist."""
        now_ns = self.now_ns()
        if self.run is None:
            now_ns = self.send_twist(ZERO)
            self._publish_status(now_ns, self.last, ZERO)
        else:
            pose = self.sensor_pose()
            inputs = TaskInputs(self.belief, self.presence, StampedPose(*pose) if pose else None)
            command = self.run.task.step(now_ns, inputs)
            now_ns = self.send_twist(command.twist)
            self._publish_status(now_ns, command, command.twist)
            self._after(now_ns, command)
        self.last_step_ns = now_ns

    def travelled(self) -> float:
        """See `TaskNode`."""
        return self.last.travelled if self.last else 0.0

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
        elif self.run.feedback_due(now_ns, self.timing.value.feedback_period):
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

    def objection(self, goal: RunTask.Goal) -> str:
        """See `TaskNode`."""
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

    def accept(self, handle: Any) -> PathRun:
        """See `TaskNode`."""
        goal = handle.request
        overrides = goal_overrides(goal)
        task = SurfaceFollowing(self._settings(overrides), path_goal(goal))
        self.path_name = goal.path_name
        self.goals += 1
        self.last = None
        return PathRun(handle=handle, task=task, started_ns=self.now_ns(), overrides=overrides)

    def _finish(self, reason: str, succeeded: bool) -> None:
        self.finish_run(reason, succeeded)
        if not succeeded:
            self.warn("task", f"'{self.path_name}' failed: {reason}", period=0.0)


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
