"""FrankaArm: the driver of a Franka Research 3 or a Panda, through franky on libfranka.

A twist becomes a Cartesian velocity motion, which takes over from the one before. franky makes 1000 commands
a second of it, in a thread of its own, by Ruckig within the scene's limits of acceleration and jerk; a scene
whose limits could lead beyond those that Franka documents is refused. Each motion ends by itself, in rest, if
no other follows in time, whatever has become of the driver; where commands stop altogether, the controller
stops the arm after 20 of them. Reflexes, the user stop and a lost connection are faults, which only `recover`
leaves.

The scene's tool frame is the controller's end effector frame EE, and the arm's base that of the controller;
the controlled frame stands in the tool as the scene says.

franky lets go of Python's lock while it waits, so it shares the driver's process. One thread alone calls it:
the one that connects gets a real-time priority, and hands it on to that of the motions.
"""

from __future__ import annotations

import importlib.util
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_drivers.clock_offset import ClockOffset
from tactile_drivers.rotation_vectors import controlled_twist, pose_of, vector_of
from tactile_geometry import se3
from tactile_scene.arm import HELD_UP, ArmMode, ArmState, is_at_rest
from tactile_scene.arm_settings import ArmLimits
from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]

FR3, PANDA = "fr3", "panda"
#: Limits in Cartesian space, as norms of translation and rotation: velocity (m/s, rad/s), acceleration, jerk.
#: Source: "Control Interface Specification and Robot Limits", Franka Control Interface documentation, and
#: rate_limiting.h of libfranka 0.9 (Panda) and 0.21 (FR3). What franky 2.0 lets an FR3 have is the Panda's.
DOCUMENTED = {
    FR3: ((3.0, 2.5), (9.0, 17.0), (4500.0, 8500.0)),
    PANDA: ((1.7, 2.5), (13.0, 25.0), (6500.0, 12500.0)),
}
_PERIOD = 1e-3  # s, between commands
_MISSED = 20  # of these in a row end a motion (FCI documentation, Robot limits and behavior)
#: Of a step in a command what passes libfranka's low-pass filter (100 Hz) in a period: T / (T + 1 / 2 pi f).
_FILTERED = _PERIOD / (_PERIOD + 1.0 / (2.0 * np.pi * 100.0))
_SAME = np.repeat([5e-4, 5e-3], 3)  # m, rad: end effectors that differ by less are the same
_SAME_MASS = 0.05  # kg
_PATIENT = 10.0  # times longer an arm at rest may be silent
_RETRY = 1.0  # s, between attempts to connect again
_RECOVERY = 10.0  # s
#: A motion that takes over begins with the acceleration that the arm tells, some cycles late. So motions that
#: follow one another more closely would hardly change it, and the speed would run away.
_APART = 0.01  # s, between motions
_TURNED = 0.02  # s, after which a twist is sent again where its frame has turned meanwhile
_REST = 100  # ms, through which rest is commanded before a motion ends
_TOO_FAST = 2.0  # times a limit; as norms, twists that give way to another reach 1.73 times
_POOR = 0.95  # of commands that come in time, below which it is told
_ENDS = 1.0  # s, for the last motion to end

#: Errors of the arm, and what the user should read of them.
_WORDS = {
    "joint_reflex": "joint reflex: more torque on a joint than driver_settings.collision_torque",
    "cartesian_reflex": "Cartesian reflex: more force on the tool than driver_settings.collision_force",
    "communication_constraints_violation": "commands came too late or not at all; it takes a real-time "
    "kernel and a cable without anything in between",
}  # fmt: skip
#: What franky says, and what the user should read instead.
_ANSWERS = (
    ("refused", "it does not answer on port 1337; is FCI activated in Desk?"),
    ("timeout", "it does not answer on port 1337; is FCI activated in Desk?"),
    ("realtime|scheduling|priority", "the kernel has no real-time priorities, or grants you none "
     "(docs/own_arm.md#franka); without them: driver_settings.realtime: false"),
    ("manual error recovery", "it has to be recovered by hand, in Desk"),
    ("safety functions", "it is stopped by its safety functions; release the stop"),
)  # fmt: skip
_VERSIONS = re.compile(r"server version: (\d+), library version: (\d+)")


@dataclass(frozen=True)
class FrankaSettings(Settings):
    """How the arm is reached, and what its controller should say of it."""

    host: str = setting("172.16.0.2", doc="address of the controller")
    model: str = setting(FR3, choices=tuple(DOCUMENTED), doc="of the arm; panda is the Franka Emika Robot")
    rate: float = setting(250.0, lower=20.0, upper=1000.0, unit="Hz", doc="of states")
    end_effector: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=-10.0, upper=10.0, unit="m, rad",
        doc="frame EE in the flange, position and rotation vector, as the controller has to have it; EE is "
        "the scene's tool frame",
    )  # fmt: skip
    mass: float = setting(
        0.0, lower=0.0, upper=50.0, unit="kg",
        doc="of end effector and load together, as the controller has to have it",
    )  # fmt: skip
    collision_torque: tuple[float, ...] = setting(
        (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0), length=7, lower=1.0, upper=100.0, unit="Nm",
        doc="on each joint, above which the arm stops in a reflex",
    )  # fmt: skip
    collision_force: tuple[float, ...] = setting(
        (20.0, 20.0, 20.0, 25.0, 25.0, 25.0), length=6, lower=1.0, upper=100.0, unit="N, Nm",
        doc="on the tool, along and about x y z, above which the arm stops in a reflex",
    )  # fmt: skip
    realtime: bool = setting(True, doc="refuse to drive without a real-time kernel and its priorities")
    state_timeout: float = setting(
        0.1, lower=0.02, upper=1.0, unit="s",
        doc="silence or lateness of states that is a lost connection in motion; at rest ten times that",
    )  # fmt: skip
    connect_timeout: float = setting(10.0, lower=1.0, upper=60.0, unit="s", doc="for connecting")


class FrankaArm:
    """See the module's text; the contract is `tactile_scene.arm.Arm`."""

    settings_class = FrankaSettings
    keeps_limits = True
    prompt = True

    def __init__(self, arm: ArmScene, settings: FrankaSettings, report: Callable[[ArmState], None]) -> None:
        if wrong := _unfit(arm, settings):
            raise RuntimeError(wrong)
        self.settings, self.kinematics = settings, arm.kinematics
        self._report, self._limits, self._T_tool_controlled = report, arm.limits, arm.T_tool_controlled
        self._timeout = arm.limits.command_timeout  # a motion ends by itself when the stage should stop it
        self._clock = ClockOffset()
        self._changed = threading.Condition()  # guards what follows
        self._twist, self._commanded, self._news = np.zeros(6), 0.0, False
        self._sent, self._sent_at = np.zeros(6), 0.0
        self._moving, self._reason = False, ""
        self._fault, self._fault_mode = "", ArmMode.FAULT
        self._wants_recovery, self._answer = False, ""
        self._last: ArmState | None = None
        self._robot: Any = None
        self._robot_time, self._heard = -1, time.monotonic()
        self._open, self._failed = True, ""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        with self._changed:
            there = self._changed.wait_for(
                lambda: self._failed or self._last is not None, settings.connect_timeout
            )
        if not there or self._failed:
            self._open = False
            why = self._failed or f"it did not answer within {settings.connect_timeout:g} s"
            raise RuntimeError(f"{settings.host}: {why}")

    # ---- the contract ----

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """Follow a twist (6,) of the controlled frame, in that frame."""
        with self._changed:
            if self._fault:
                return
            self._twist, self._commanded = np.array(twist, dtype=np.float64), time.monotonic()
            self._moving, self._reason, self._news = True, "", True
            self._changed.notify_all()

    def stop(self, reason: str) -> None:
        """Come to rest within the limits; the next command moves the arm again."""
        with self._changed:
            self._twist, self._moving, self._reason, self._news = np.zeros(6), False, reason, True
            self._changed.notify_all()

    def recover(self) -> None:
        """Leave a fault: the arm's errors are cleared, if it agrees.

        Raises
        ------
        RuntimeError
            If the arm cannot move, with the reason.
        """
        with self._changed:
            if self._robot is None:
                raise RuntimeError(self._fault or "there is no connection to the arm")
            self._wants_recovery, self._answer = True, ""
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: not self._wants_recovery, _RECOVERY):
                raise RuntimeError(f"the arm did not answer within {_RECOVERY:g} s")
            if self._answer:
                raise RuntimeError(self._answer)
            self._fault, self._moving, self._reason = "", False, "fault cleared"

    def close(self) -> None:
        """Stop the arm, and let go of it."""
        with self._changed:
            self._open = False
            self._changed.notify_all()
        self._thread.join()

    @property
    def drift(self) -> float:
        """By how much our clock is faster than the controller's, s/s."""
        return self._clock.drift

    @property
    def watchdog(self) -> float:
        """Silence after which the arm stops in a reflex, s."""
        return _MISSED * _PERIOD

    @property
    def agreed(self) -> str:
        """What the controller says as the scene does, in words."""
        settings = self.settings
        return f"end effector {list(settings.end_effector)}, {settings.mass:g} kg"

    # ---- the thread that alone calls franky ----

    def _run(self) -> None:
        import franky

        period, due = 1.0 / self.settings.rate, 0.0
        while self._open:
            try:
                if self._robot is None:
                    self._connect()
                    continue
                self._follow()
                if time.monotonic() >= due:
                    due = max(due + period, time.monotonic())
                    self._look()
            except (franky.Exception, RuntimeError) as error:
                if self._last is None:
                    self._tell_failure(in_words(error))
                    return
                self._lose(in_words(error))
            with self._changed:
                self._changed.wait_for(
                    lambda: self._ready or self._wants_recovery or not self._open,
                    max(0.0, due - time.monotonic()),
                )
        self._let_go()

    def _tell_failure(self, reason: str) -> None:
        with self._changed:
            self._failed, self._robot = reason, None
            self._changed.notify_all()

    def _let_go(self) -> None:
        """Bring the arm to rest, and end the connection."""
        import franky

        robot, self._robot = self._robot, None
        if robot is None:
            return
        try:
            if robot.is_in_control:
                robot.move(self._motion(np.zeros(6), 0.0), asynchronous=True)
                robot.join_motion(_ENDS)
        except franky.Exception:
            pass  # it has stopped already, for a reason of its own
        del robot

    # ---- commands ----

    def _follow(self) -> None:
        """Do what is asked for, if that is news."""
        with self._changed:
            twist, age = self._twist, time.monotonic() - self._commanded
            recover, send = self._wants_recovery, self._ready and self._last is not None
            self._news = self._news and not send
        if recover:
            self._recover()
        elif send and not (self._fault and twist.any()):
            self._guarded(self._send, twist, age)

    def _guarded(self, do: Callable[..., None], *arguments: Any) -> None:
        """Do it; where the arm has ended the motion, its state says why, or else what franky says does."""
        import franky

        try:
            do(*arguments)
        except franky.ControlException as error:
            state = _state_of(self._robot)
            self._take(state, _why_not(state) or in_words(error))

    @property
    def _ready(self) -> bool:
        """Whether there is something to send that may be sent now; a stop always may."""
        apart = time.monotonic() - self._sent_at
        return self._news and (apart >= _APART or not self._twist.any())

    def _send(self, twist: Array, age: float) -> None:
        """Go after the twist in force, commanded `age` seconds ago, as the arm stands now."""
        if not twist.any() and not (self._sent.any() and self._robot.is_in_control):
            return  # it rests, or is on its way to
        self._robot.move(self._motion(twist, max(0.0, self._timeout - age)), asynchronous=True)
        self._sent, self._sent_at = twist, time.monotonic()

    def _motion(self, twist: Array, seconds: float) -> Any:
        """A motion with a twist (6,) of the controlled frame, in it, for some time (s), and then to rest."""
        import franky

        def waypoint(velocity: Array, milliseconds: int, limit: Any = None) -> Any:
            target, hold = franky.Twist(velocity[:3], velocity[3:]), franky.Duration(milliseconds)
            return franky.CartesianVelocityWaypoint(
                target, hold_target_duration=hold, max_total_duration=limit
            )

        waypoints = [waypoint(np.zeros(6), _REST)]
        if twist.any():
            assert self._last is not None
            R, duration = self._last.T_base_controlled[:3, :3], max(1, round(1e3 * seconds))
            in_base = np.concatenate([R @ twist[:3], R @ twist[3:]])
            waypoints.insert(0, waypoint(in_base, duration, franky.Duration(duration)))
        return franky.CartesianVelocityWaypointMotion(
            waypoints, ee_frame=franky.Affine(self._T_tool_controlled)
        )

    def _recover(self) -> None:
        """Clear the arm's errors, where it has any and nobody presses the stop."""
        import franky

        answer = ""
        try:
            state = _state_of(self._robot)
            if _errors(state):
                self._robot.recover_from_errors()
                state = _state_of(self._robot)
            answer = _why_not(state) or self._wrong(state)
        except (franky.CommandException, RuntimeError) as error:
            answer = in_words(error)
        finally:
            with self._changed:
                self._wants_recovery, self._answer = False, answer
                self._changed.notify_all()

    # ---- states ----

    def _look(self) -> None:
        """Take the newest state, where there is a new one, and what has become of the motion."""
        self._guarded(self._robot.poll_motion)
        self._take(_state_of(self._robot), "")

    def _take(self, state: Any, fault: str) -> None:
        """Report a state, if it is a new one, in a fault of that reason if there is one."""
        now_ns, milliseconds = time.time_ns(), state.time.to_msec()
        if milliseconds == self._robot_time and not fault:
            if time.monotonic() - self._heard > self._patience:
                raise RuntimeError(f"no state of the arm for {self._patience:g} s")
            return
        self._robot_time, self._heard = milliseconds, time.monotonic()
        stamp_ns = self._clock.stamp_ns(1e-3 * milliseconds, now_ns)
        if self._last is not None and stamp_ns <= self._last.stamp_ns:
            stamp_ns = self._last.stamp_ns + 1  # the offset became less between the two
        late = (now_ns - stamp_ns) / SECOND_NS
        fault = fault or _why_not(state) or self._too_fast(state)
        if not fault and late > self._patience:
            fault = f"states of the arm come {late:.3f} s late (limit {self._patience:g} s): {HELD_UP}"
        self._report(self._told(state, stamp_ns, fault))

    def _told(self, state: Any, stamp_ns: int, fault: str) -> ArmState:
        """What is reported of a state of franky's."""
        import franky

        T = np.asarray(state.O_T_EE.matrix) @ self._T_tool_controlled
        twist = self._twist_of(state)
        joints = np.array(state.q) if self.kinematics is not None else None
        with self._changed:
            if fault and not self._fault:
                self._begin_fault(fault, state.robot_mode == franky.RobotMode.UserStopped)
            silence = time.monotonic() - self._commanded
            if self._moving and silence > self._timeout:  # the motion ends by itself
                self._twist, self._moving = np.zeros(6), False
                self._reason = f"no command for {silence:.3f} s (limit of the driver {self._timeout:g} s)"
            words = self._words(state.control_command_success_rate)
            self._last = ArmState(stamp_ns, T, twist, self._mode(twist), words, joints)
            turned = bool(self._moving and self._twist[3:].any())  # the frame that the twist is given in
            self._news = self._news or (turned and time.monotonic() - self._sent_at >= _TURNED)
            self._changed.notify_all()
            return self._last

    def _too_fast(self, state: Any) -> str:
        """Whether the arm is faster than it can have been asked to be; '' if it is not."""
        twist = self._twist_of(state)
        for part, most in (
            (twist[:3], self._limits.linear_velocity),
            (twist[3:], self._limits.angular_velocity),
        ):
            if (speed := se3.norm(part)) > _TOO_FAST * most:
                return f"the arm moves at {speed:.3g}, {_TOO_FAST:g} times its limit of {most:g}"
        return ""

    def _twist_of(self, state: Any) -> Array:
        """The twist (6,) of the controlled frame, in it."""
        T = np.asarray(state.O_T_EE.matrix) @ self._T_tool_controlled
        speed = np.concatenate([state.O_dP_EE_d.linear, state.O_dP_EE_d.angular])
        return controlled_twist(T, self._T_tool_controlled, speed)

    @property
    def _patience(self) -> float:
        """How long (s) the arm may say nothing, or be late: at rest nothing depends on it."""
        return self.settings.state_timeout * (1.0 if self._twist.any() else _PATIENT)

    def _begin_fault(self, reason: str, by_a_person: bool = False) -> None:
        self._fault, self._twist, self._moving, self._news = reason, np.zeros(6), False, True
        self._fault_mode = ArmMode.ESTOP if by_a_person else ArmMode.FAULT

    def _mode(self, twist: Array) -> ArmMode:
        if self._fault:
            return self._fault_mode
        if self._moving and self._twist.any():
            return ArmMode.MOVING
        if is_at_rest(twist):
            return ArmMode.RESTING
        return ArmMode.MOVING if self._moving else ArmMode.STOPPING

    def _words(self, success_rate: float) -> str:
        """Why the arm does what it does."""
        if self._fault or not self._moving or success_rate >= _POOR:
            return self._fault or self._reason
        return f"{self._reason}; " * bool(self._reason) + f"control command success rate {success_rate:.0%}"

    # ---- the connection ----

    def _connect(self) -> None:
        """A robot that is what the scene says; raises where there is none."""
        import franky

        settings, limits = self.settings, self._limits
        config = franky.RealtimeConfig.Enforce if settings.realtime else franky.RealtimeConfig.Ignore
        robot = franky.Robot(settings.host, realtime_config=config)
        robot.set_collision_behavior(settings.collision_torque, settings.collision_force)
        for limit, value in (
            (robot.translation_acceleration_limit, limits.linear_acceleration),
            (robot.rotation_acceleration_limit, limits.angular_acceleration),
            (robot.translation_jerk_limit, limits.linear_jerk),
            (robot.rotation_jerk_limit, limits.angular_jerk),
        ):
            limit.set(value)
        state = _state_of(robot)
        left = "" if _errors(state) else _why_not(state)  # errors that somebody left are cleared by `recover`
        if self._last is None and (wrong := left or self._wrong(state)):
            raise RuntimeError(wrong)
        if settings.model == PANDA and hasattr(robot, "model_urdf"):
            raise RuntimeError("the arm is an FR3, the scene says panda")
        with self._changed:
            if self._last is not None:
                self._fault = "the connection to the arm was lost, and is back"
            self._robot, self._robot_time, self._heard = robot, -1, time.monotonic()
            self._sent = np.zeros(6)

    def _wrong(self, state: Any) -> str:
        """What the controller says otherwise than the scene; '' for nothing."""
        wanted = self.settings
        apart = se3.log(se3.inverse(pose_of(wanted.end_effector)) @ state.F_T_EE.matrix)
        if (np.abs(apart) > _SAME).any():
            found = vector_of(np.asarray(state.F_T_EE.matrix)).round(4).tolist()
            said = list(wanted.end_effector)
            return f"its end effector stands at {found} in the flange, the scene says {said}"
        if abs(state.m_total - wanted.mass) > _SAME_MASS:
            return f"its end effector and load weigh {state.m_total:g} kg, the scene says {wanted.mass:g} kg"
        return ""

    def _lose(self, reason: str) -> None:
        """The connection is gone, which the last state that there was tells once more."""
        robot = self._robot
        with self._changed:
            if robot is None:
                self._fault = f"no connection to the arm: {reason}"
            elif not self._fault:
                self._begin_fault(f"connection lost: {reason}")
            self._robot, self._news = None, False
            self._wants_recovery, self._answer = False, "the connection to the arm was lost"
            self._changed.notify_all()
            assert self._last is not None
            last = replace(self._last, mode=self._fault_mode, reason=self._fault)
        if robot is not None and self._open:
            self._report(last)
        del robot  # which may wait for an answer that does not come
        with self._changed:
            self._changed.wait_for(lambda: not self._open, _RETRY)


def _unfit(arm: ArmScene, settings: FrankaSettings) -> str:
    """Why no arm can be driven with these settings, here; '' if one can."""
    if importlib.util.find_spec("franky") is None:
        return "the Python package franky-control is missing: pip install franky-control"
    lever = float(np.linalg.norm(arm.T_tool_controlled[:3, 3]))
    for name, most in largest_limits(settings.model, arm.limits, lever).items():
        if (value := float(getattr(arm.limits, name))) > most:
            return f"limits.{name} = {value:g}: with a {settings.model} it has to be at most {most:.3g}"
    return ""


def largest_limits(model: str, limits: ArmLimits, lever: float) -> dict[str, float]:
    """What each limit may be, so that no command leaves the model's documented ones.

    Limits are of each axis of the controlled frame, which is `lever` (m) away from the end effector; those of
    Franka are norms at the end effector, which rotation moves too. A motion that takes over from another
    begins with the acceleration that the arm tells, where the last one ended with one of its own: between the
    two lie at most two accelerations, of which the filter passes a part in the first period, besides the jerk
    that is allowed.
    """
    speeds, accelerations, jerks = DOCUMENTED[model]
    axes = np.sqrt(3.0)
    whirl = axes * limits.angular_velocity
    per_jerk = 2.0 * _FILTERED / _PERIOD  # 1/s: jerk for each acceleration
    most = {
        "angular_velocity": speeds[1],
        "linear_velocity": speeds[0] - limits.angular_velocity * lever,
        "angular_acceleration": min(
            accelerations[1] / axes, (jerks[1] / axes - limits.angular_jerk) / per_jerk
        ),
    }
    turning = axes * limits.angular_acceleration * lever
    most["linear_acceleration"] = min(
        (accelerations[0] - turning - whirl**2 * lever) / axes,
        (jerks[0] / axes - limits.linear_jerk) / per_jerk - limits.angular_acceleration * lever,
    )
    return most


def _state_of(robot: Any) -> Any:
    """The newest state of franky's; raises `RuntimeError` for one that cannot be."""
    state = robot.state
    try:
        se3.checked_pose("pose", np.asarray(state.O_T_EE.matrix))
    except se3.PoseError as error:
        raise RuntimeError(f"what the arm tells makes no sense: {error}") from error
    return state


def _why_not(state: Any) -> str:
    """Why an arm in this state does not move; '' if it does."""
    mode = state.robot_mode.name
    if mode == "UserStopped":
        return "the user stop is pressed, or another safety function of the arm is active"
    if mode == "Guiding":
        return "the arm is moved by hand (guiding)"
    if errors := _errors(state):
        return "; ".join(_WORDS.get(name, name.replace("_", " ")) for name in errors)
    if mode not in ("Idle", "Move"):
        return f"the arm is in mode '{mode}'; are its joints unlocked and FCI activated in Desk?"
    return ""


def _errors(state: Any) -> list[str]:
    """Names of the errors that keep the arm from moving."""
    errors = state.current_errors
    return [name for name in dir(errors) if getattr(errors, name) is True]


def in_words(error: Exception) -> str:
    """What an error of franky means."""
    text = str(error)
    if versions := _VERSIONS.search(text):
        return (
            f"it speaks version {versions[1]} of the control interface, and this franky {versions[2]}: "
            "install the one for its version (docs/own_arm.md#franka)"
        )
    known = (words for pattern, words in _ANSWERS if re.search(pattern, text, re.IGNORECASE))
    return next(known, text.removeprefix("libfranka: ") or repr(error))
