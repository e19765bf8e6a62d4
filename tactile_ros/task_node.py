"""TaskNode: a managed node that moves an arm, by twists, as long as a goal of `run_task` asks for it.

One goal runs at a time. A goal that is refused, as a second one is, is aborted at once with the reason in
its result, since a rejection could not tell any. A cancelled goal is told to stop and comes to rest; so is
the one under way when the node is asked to end. Without a goal the twist is zero, and so is the last one when
the node is deactivated or shut down.
"""

from __future__ import annotations

import math
import os
import platform
import secrets
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.duration import Duration

from tactile_base import topics
from tactile_base.raised import told
from tactile_base.settings import SettingError, Settings, setting, unknown_name
from tactile_base.stamps import SECOND_NS
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import Command
from tactile_geometry.transform_buffer import MotionLimits, TransformUnavailable
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmCommand, ArmStatus, ControllerStatus
from tactile_ros.arm_attention import ArmAttention
from tactile_ros.colleagues import Upstream
from tactile_ros.conversions import duration_from_ns
from tactile_ros.managed_node import CONTROLLED_FRAMES, LARGEST, ManagedNode
from tactile_ros.message_bytes import headed_bytes
from tactile_ros.parameters import SettingsParameters, declare_read_only, fixed_settings
from tactile_ros.qos import COMMAND, STATE, writer_profile
from tactile_ros.transforms import TransformListener

ZERO = np.zeros(6)
LAST_WORD = 0.2  # s; how long a node that ends waits until its zero twist, and its last result, have arrived
LATELY = 2.0  # s; a result that was given before is no concern of a node that ends


@dataclass
class Run:
    """One accepted goal: what was asked for, the task that does it, and whether it ends by itself."""

    handle: Any
    task: PhaseMachine
    started_ns: int
    ends: bool
    feedback_ns: int = 0

    def feedback_due(self, now_ns: int, period: float) -> bool:
        """Whether the last feedback is `period` (s) ago; it is then taken to be given now."""
        due = now_ns - self.feedback_ns >= period * SECOND_NS
        if due:
            self.feedback_ns = now_ns
        return due


@dataclass(frozen=True)
class ControllerTimingSettings(Settings):
    """When the controller acts without being asked by a belief."""

    watchdog_period: float = setting(
        0.02, lower=0.001, upper=0.05, unit="s", doc="a step is made at least this often"
    )
    idle_period: float = setting(
        0.1, lower=0.01, upper=1.0, unit="s", doc="without a task a zero twist is sent this often"
    )
    feedback_period: float = setting(
        0.1, lower=0.01, upper=10.0, unit="s", doc="the action's feedback is sent this often"
    )
    partner_age: float = setting(
        0.2, lower=0.03, upper=10.0, unit="s",
        doc="the task rests when the controller of a partner at work has said nothing for this long",
    )  # fmt: skip


class TaskNode(ManagedNode, ABC):
    """Base of nodes that run tasks; fill in `objection`, `accept` and `step`."""

    patience: ClassVar[float] = 5.0
    run: Run | None = None
    last: Command | None = None  # of the goal that runs, or ran last
    last_step_ns = 0
    ending = ""  # why the node is about to end
    _concluded = -math.inf  # on the steady clock

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        doc = f"frame of the twists, one of {', '.join(CONTROLLED_FRAMES)}"
        frame = declare_read_only(self, "controlled_frame", CONTROLLED_FRAMES[0], doc)
        if frame not in CONTROLLED_FRAMES:
            raise SettingError(f"parameter controlled_frame: {unknown_name(frame, CONTROLLED_FRAMES)}")
        self.controlled_frame = self.frame_of(frame)
        self.source = f"{self.get_fully_qualified_name()}, process {os.getpid()} on {platform.node()}"
        self._session, self._sent = secrets.randbits(63) + 1, 0
        self.attention = ArmAttention(self.source)
        self.limits = fixed_settings(self, MotionLimits(), "transforms")
        self.timing = SettingsParameters(
            self, ControllerTimingSettings(), prefix="timing", read_only=("watchdog_period", "partner_age")
        )

    # What a node fills in.

    @abstractmethod
    def objection(self, goal: RunTask.Goal) -> str:
        """'' or why the goal cannot be run, with what would be right."""

    @abstractmethod
    def accept(self, handle: Any) -> Run:
        """What the goal starts."""

    @abstractmethod
    def step(self) -> None:
        """One step of what runs, or a zero twist; sets `last_step_ns`."""

    def forget(self) -> None:
        """Forget inputs; called when the clock jumps back."""

    # What a node uses.

    def open_task(self, on_transform: Callable[[], None] | None = None) -> None:
        """Create publishers, the action, and a timer that steps if nothing else has."""
        self.upstream = Upstream(self)
        self.twist_out = self.publisher(ArmCommand, topics.COMMAND.name, COMMAND)
        self.status_out = self.publisher(ControllerStatus, topics.CONTROLLER_STATUS.name, STATE)
        self.subscribe(ArmStatus, topics.ARM_STATUS.name, self._on_arm, STATE)
        self.transforms = TransformListener(
            self,
            on_update=on_transform,
            on_jump=self._jumped,
            frames=[(self.base_frame, self.controlled_frame), (self.base_frame, self.sensor_frame)],
            limits=self.limits,
        )
        self.timer(self.timing.value.watchdog_period, self._tick)
        action = ActionServer(
            self,
            RunTask,
            topics.RUN_TASK,
            execute_callback=_nothing_to_execute,
            goal_callback=_sensible,
            handle_accepted_callback=self._accept,
            cancel_callback=self._cancel,
            feedback_pub_qos_profile=writer_profile(STATE),
        )
        self.release_later(self._close_action, action)

    def send_twist(self, twist: ArrayLike) -> tuple[int, NDArray[np.float64]]:
        """Ask for [v, omega] (6,) in the controlled frame; returns when (ns), and the twist that went out.

        Whoever was held up for so long that the arm waits for its rest asks for that, and goes on from there.
        """
        now_ns = self.now_ns()
        sent = np.zeros(6) if self.attention.wants_rest else np.asarray(twist, dtype=np.float64)
        self._sent += 1
        numbers = self._session, self._sent, *sent.tolist()
        command = headed_bytes(ArmCommand, now_ns, self.controlled_frame, *numbers, source=self.source)
        self.twist_out.publish(command)
        return now_ns, sent

    def sensor_pose(self) -> tuple[int, NDArray[np.float64]] | None:
        """The controlled frame in the base by the newest transform, with its stamp for a watchdog."""
        try:
            return self.transforms.newest(self.base_frame, self.controlled_frame)
        except TransformUnavailable as error:
            if self.run is not None:
                self.warn("pose", f"no sensor pose: {error}")
            return None

    def finish_run(self, reason: str, succeeded: bool) -> None:
        """End the run with the state that its goal is to have; override it to end more."""
        assert self.run is not None
        run, self.run = self.run, None
        result = RunTask.Result(success=succeeded, reason=reason)
        result.path_length = self.last.travelled if self.last else 0.0
        result.duration = duration_from_ns(self.now_ns() - run.started_ns)
        self._concluded = time.monotonic()
        conclude(run.handle, result)

    def deactivate(self) -> None:
        """Abort what runs and leave a zero twist as the last word."""
        if self.run is not None:
            self.finish_run(f"the {self.get_name()} was deactivated", succeeded=False)
        self.send_twist(ZERO)
        self.twist_out.wait_for_all_acked(Duration(seconds=LAST_WORD))

    def _on_arm(self, status: ArmStatus) -> None:
        """Fail what runs as soon as the arm does not follow it any more; a new goal has to be asked for."""
        self.attention.see(status, commands=self.run is not None)
        if self.run is not None and self.attention.trouble:
            self.run.task.abort(self.attention.trouble)
            self.step()

    def prepare_to_end(self, reason: str) -> None:
        """Have the task that runs stop and leave the surface; goals are refused from now on."""
        self.ending = f"the {self.get_name()} was {reason}"
        if self.run is not None:
            self.run.task.stop(self.ending)

    def needed(self) -> bool:
        """Until the task has come to its end."""
        return self.run is not None

    @property
    def linger_time(self) -> float:
        """Time for the result of a goal that ended lately: it is sent, and reaches who asked for it."""
        return LAST_WORD if time.monotonic() - self._concluded < LATELY else 0.0

    def _close_action(self, action: ActionServer) -> None:
        """Destroy the action, but not before the last result has left: sending it would crash."""
        if not self.linger_time:
            action.destroy()
            return

        def destroy() -> None:
            timer.cancel()
            action.destroy()

        timer = self.create_timer(self.linger_time, destroy, clock=self.steady)

    def _tick(self) -> None:
        """The timer: a step if none was made lately, and a look whether the arm still says something."""
        silence = self.attention.silence()
        if self.run is not None and silence:
            self.run.task.abort(silence)
            self.step()
        timing = self.timing.value
        period = timing.watchdog_period if self.run is not None else timing.idle_period
        if self.now_ns() - self.last_step_ns > 0.75 * period * SECOND_NS:
            self.step()

    def _jumped(self, reason: str) -> None:
        self.forget()
        if self.run is not None:
            self.run.task.stop(reason)

    def _accept(self, handle: Any) -> None:
        refusal = self._refusal(handle.request)
        if not refusal:
            try:
                self.run = self.accept(handle)
                return
            except Exception as error:  # a task may be somebody else's
                refusal = told(error)
                self.get_logger().error(f"{refusal}\n{traceback.format_exc()}")
        self.count("goals refused")
        self.warn("goal", f"goal refused: {refusal}", period=0.0)
        conclude(handle, RunTask.Result(success=False, reason=f"goal refused: {refusal}"))

    def _refusal(self, goal: RunTask.Goal) -> str:
        if not self.active:
            return f"the {self.get_name()} is not active"
        return self.ending or self.attention.trouble or self.objection(goal)

    def _cancel(self, handle: Any) -> CancelResponse:
        if self.run is None or handle.goal_id != self.run.handle.goal_id:
            return CancelResponse.REJECT
        if self.run.task.endless:  # there is no other way to end it
            self.run.task.finish()
        else:
            self.run.task.stop("cancelled")
        return CancelResponse.ACCEPT


def conclude(handle: Any, result: RunTask.Result) -> None:
    """End a goal with the state that the result says, or as cancelled if that was asked for."""

    def execute(handle: Any) -> RunTask.Result:
        if handle.is_cancel_requested:
            handle.canceled()
        elif result.success:
            handle.succeed()
        else:
            handle.abort()
        return result

    handle.execute(execute)


def _sensible(request: RunTask.Goal) -> GoalResponse:
    """Whether a goal is looked at: what is not is forgotten at once, a goal's reason is kept for a while."""
    texts = (request.task, request.name, request.goal, request.settings)
    return GoalResponse.REJECT if sum(map(len, texts)) > LARGEST else GoalResponse.ACCEPT


def _nothing_to_execute(handle: Any) -> RunTask.Result:
    """Stands in for the action server's callback: steps execute goals, and `finish_run` concludes them.

    A coroutine that waited for the end would be polled without pause by the executors and burn a core.
    """
    raise RuntimeError("goals of run_task are concluded by the node's steps")
