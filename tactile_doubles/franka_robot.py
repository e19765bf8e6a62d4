"""FrankaRobot: what a Franka's controller does with its arm, as far as clients of its interface can tell.

In place of franky-sim's own robots, whose physics take longer than a cycle on a busy machine: the arm does at
once what it is commanded, by its kinematics. It watches commands as Franka documents of the real one: they
have to come, and to keep the limits of velocity, acceleration and jerk; what it tells of them is what it was
commanded. All this is simulated, and none of it is a real controller.

Sources: "Control Interface Specification and Robot Limits", Franka Control Interface documentation
(frankarobotics.github.io/docs); errors by their place in what libfranka 0.21 reads.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from franky_sim.franka_robot_protocol import RobotMode
from franky_sim.franka_robot_state import FrankaRobotState
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_drivers.franka_settings import DOCUMENTED, FR3
from tactile_drivers.rotation_vectors import pose_of, vector_of
from tactile_geometry import se3
from tactile_scene.kinematics.arm_file import load_arm

Array = NDArray[np.float64]

PERIOD = 1e-3  # s
ERRORS = {
    "cartesian_position_limits_violation": 1, "joint_reflex": 6, "cartesian_reflex": 7,
    "cartesian_motion_generator_velocity_limits_violation": 18,
    "cartesian_motion_generator_velocity_discontinuity": 19,
    "cartesian_motion_generator_acceleration_discontinuity": 20,
    "communication_constraints_violation": 25,
}  # fmt: skip
_COUNT = 41  # of errors
_REFLEX_DECELERATION = 10.0  # m/s^2
_TOLERATED = 20  # cycles without a command, through which the last acceleration goes on; then it stops
_JOINTS_EVERY = 5  # cycles; joints follow the pose, and take most of the time of a cycle


@dataclass(frozen=True)
class FrankaRobotSettings(Settings):
    """Which arm the double is."""

    model: str = setting(FR3, choices=tuple(DOCUMENTED), doc="whose limits and joints it has")
    start: tuple[float, ...] = setting(
        (0.4, 0.0, 0.3, 3.141592653589793, 0.0, 0.0), length=6, lower=-10.0, upper=10.0, unit="m, rad",
        doc="pose of the end effector at the start: position and rotation vector",
    )  # fmt: skip
    end_effector: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=-10.0, upper=10.0, unit="m, rad", doc="frame EE in the flange"
    )
    mass: float = setting(0.0, lower=0.0, upper=50.0, unit="kg", doc="of end effector and load")
    tolerance: float = setting(
        1.0, lower=1.0, upper=100.0,
        doc="times as many commands may be missing, and they may jump as far, as a real one allows: for a "
        "machine that is no real-time one",
    )  # fmt: skip
    patience: float = setting(
        0.0, lower=0.0, upper=1.0, unit="s",
        doc="how long its time stands still for an answer to a state; 0: not at all, as that of a real one",
    )  # fmt: skip


class FrankaRobot:
    """The arm and its safety; `step` is one cycle, or several that a busy machine has left out.

    Attributes
    ----------
    trace : deque of (time (s), pose (6,), speed (6,), command (6,))
        What the arm did in its last cycles, in the base.
    commands : deque of (cycle, command (6,))
        What clients have commanded, in answer to the state of which cycle.
    moving, answered : bool, int or None
        Whether a client moves it, and the cycle whose state was answered last.
    error : str
        Why it is in a reflex; empty where it is not.
    """

    has_gripper = False

    def __init__(self, settings: FrankaRobotSettings | None = None) -> None:
        self.settings = settings or FrankaRobotSettings()
        self.T_flange_ee = pose_of(self.settings.end_effector)
        self.pose = pose_of(self.settings.start)
        self._chain = load_arm(self.settings.model).with_tool(self.T_flange_ee)
        self._q = self._chain.reach(self.pose, self._chain.ready)
        self.mass = self.settings.mass
        self.speed, self._command, self._acceleration = np.zeros(6), np.zeros(6), np.zeros(6)
        self.cycles = 100_000  # since the controller was started
        self._commanded = self._command  # what came last; the command goes on while nothing comes
        self.moving, self._missed = False, 0
        self.answered: int | None = None  # cycle of the state that the last command answers
        self.error = self.last_error = ""
        self.user_stopped = self.guiding = False
        self.success_rate = 1.0
        self.extra = 0.0  # m/s along x, that it tells besides its speed
        self.commands: deque[tuple[int, Array]] = deque(maxlen=20000)
        self.trace: deque[tuple[float, Array, Array, Array]] = deque(maxlen=20000)

    # ---- one cycle ----

    def step(self, cycles: int = 1) -> None:
        """Go on by a cycle of 1 ms, or by some at once."""
        dt = cycles * PERIOD
        self.cycles += cycles
        before = self.speed.copy()
        if self.moving:
            lost = min(cycles - (self._missed == 0), _TOLERATED - self._missed)
            self._missed += cycles
            if lost > 0:  # the acceleration goes on
                self._command = self.speed = self.speed + self._acceleration * (lost * PERIOD)
            if self._missed > _TOLERATED * self.settings.tolerance:
                self.reflex("communication_constraints_violation")
        if not self.moving and self.speed.any():
            part = _REFLEX_DECELERATION * dt / max(np.linalg.norm(self.speed[:3]), np.abs(self.speed).max())
            self.speed = self.speed * max(0.0, 1.0 - part)
        mean = 0.5 * (before + self.speed)
        if mean.any():
            turn = se3.exp(np.concatenate([np.zeros(3), mean[3:] * dt]))
            self.pose[:3, :3] = turn[:3, :3] @ self.pose[:3, :3]
            self.pose[:3, 3] += mean[:3] * dt
            if self.cycles % _JOINTS_EVERY < cycles:
                self._q = self._chain.follow(self._q, self.pose)
        self.trace.append((self.time, vector_of(self.pose), self.speed.copy(), self._command.copy()))

    @property
    def time(self) -> float:
        """Since the controller was started, s."""
        return self.cycles * PERIOD

    # ---- commands ----

    def begin(self) -> None:
        """A client's motion begins; raises `RuntimeError` where it may not."""
        if self.mode not in (RobotMode.kIdle, RobotMode.kMove):
            raise RuntimeError(f"the arm is in mode {self.mode.name}")
        self.end()
        self.moving, self._missed, self.answered = True, 0, None

    def end(self) -> None:
        """Its motion has ended; the arm comes to rest."""
        self.moving = False
        self._command, self._acceleration = np.zeros(6), np.zeros(6)
        self._commanded = self._command

    def take(self, cycle: int, command: Sequence[float]) -> None:
        """A commanded velocity (6,) of the end effector, in the base, in answer to the state of a cycle.

        It is judged by the cycles that it answers, so that a machine that is late is not taken for a rough
        motion.
        """
        new = np.array(command)
        if not self.moving or (self.answered is not None and cycle <= self.answered):
            return
        dt = PERIOD * (1 if self.answered is None else cycle - self.answered)
        self._missed, self.answered = 0, cycle
        self.commands.append((cycle, new))
        acceleration = (new - self._commanded) / dt
        jerk = (acceleration - self._acceleration) / dt
        for rate, name, limits in zip(
            (new, acceleration, jerk),
            ("velocity_limits_violation", "velocity_discontinuity", "acceleration_discontinuity"),
            DOCUMENTED[self.settings.model],
            strict=True,
        ):
            most = self.settings.tolerance * np.array(limits)
            if any(np.linalg.norm(rate[i : i + 3]) > most[i // 3] for i in (0, 3)):
                self.reflex(f"cartesian_motion_generator_{name}")
                return
        self._command = self._commanded = self.speed = new
        self._acceleration = acceleration

    # ---- safety ----

    def reflex(self, error: str) -> None:
        """Stop, as on a collision or a command that cannot be followed."""
        self.error = self.last_error = error
        self.end()

    def user_stop(self) -> None:
        """Somebody presses the stop."""
        self.user_stopped = True
        self.end()

    @property
    def mode(self) -> RobotMode:
        """What the arm tells of itself."""
        if self.user_stopped:
            return RobotMode.kUserStopped
        if self.guiding:
            return RobotMode.kGuiding
        if self.error:
            return RobotMode.kReflex
        return RobotMode.kMove if self.moving else RobotMode.kIdle

    # ---- what franky-sim's server asks of a robot ----

    @property
    def inner_state(self) -> Any:
        """Itself, for the joints `q`."""
        return self

    @property
    def q(self) -> tuple[float, ...]:
        """Angles of the joints, rad."""
        return tuple(self._q.tolist())

    @property
    def state(self) -> FrankaRobotState:
        """What a client is told."""
        pose, flange = _columns(self.pose), _columns(self.T_flange_ee)
        command = tuple(self._command.tolist())
        told = self.speed + np.array([self.extra, 0.0, 0.0, 0.0, 0.0, 0.0])
        return FrankaRobotState(
            q=self.q, q_d=self.q, O_T_EE=pose, O_T_EE_d=pose, O_T_EE_c=pose, F_T_EE=flange, F_T_NE=flange,
            m_ee=self.mass, elbow=(self._q[2], -1.0), elbow_d=(self._q[2], -1.0), elbow_c=(self._q[2], -1.0),
            O_dP_EE_d=tuple(told.tolist()), O_dP_EE_c=command,
            O_ddP_EE_c=tuple(self._acceleration.tolist()),
            errors=_flags(self.error), reflex_reason=_flags(self.last_error),
            control_command_success_rate=self.success_rate,
        )  # fmt: skip

    def _set_server(self, server: Any) -> None:
        """The server keeps the robot, not the other way round."""

    def joint_position_control(self, q: Any, has_new_command: bool = True) -> None:
        """Held where it is."""

    def cartesian_velocity_control(self, velocity: Any, elbow: Any, has_new_command: bool = True) -> None:
        """In force already, since `take`."""


def _columns(T: Array) -> tuple[float, ...]:
    """A pose (4, 4) as the interface has it, column by column."""
    return tuple(T.flatten(order="F").tolist())


def _flags(error: str) -> tuple[bool, ...]:
    place = ERRORS.get(error, -1)
    return tuple(i == place for i in range(_COUNT))
