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

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_drivers.commanded_motion import CommandedMotion
from tactile_drivers.franka_settings import PANDA, WATCHDOG, FrankaSettings, unfit
from tactile_drivers.franka_words import errors_of, in_words, state_of, why_not
from tactile_drivers.rotation_vectors import controlled_twist, pose_of, vector_of
from tactile_geometry import se3
from tactile_scene.arm import ArmState
from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]

_SAME = np.repeat([5e-4, 5e-3], 3)  # m, rad: end effectors that differ by less are the same
_SAME_MASS = 0.05  # kg
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


class FrankaArm:
    """See the module's text; the contract is `tactile_scene.arm.Arm`."""

    settings_class = FrankaSettings
    keeps_limits = True
    prompt = True

    def __init__(self, arm: ArmScene, settings: FrankaSettings, report: Callable[[ArmState], None]) -> None:
        if wrong := unfit(arm, settings):
            raise RuntimeError(wrong)
        self.settings, self.kinematics = settings, arm.kinematics
        self._report, self._limits, self._T_tool_controlled = report, arm.limits, arm.T_tool_controlled
        self._timeout = arm.limits.command_timeout  # a motion ends by itself when the stage should stop it
        self._changed = threading.Condition()  # guards what follows
        self._motion, self._news = CommandedMotion(settings.state_timeout), False
        self._sent, self._sent_at = np.zeros(6), 0.0
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
            if self._motion.follow(twist):
                self._news = True
                self._changed.notify_all()

    def stop(self, reason: str) -> None:
        """Come to rest within the limits; the next command moves the arm again."""
        with self._changed:
            self._motion.rest(reason)
            self._news = True
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
                raise RuntimeError(self._motion.fault or "there is no connection to the arm")
            self._wants_recovery, self._answer = True, ""
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: not self._wants_recovery, _RECOVERY):
                raise RuntimeError(f"the arm did not answer within {_RECOVERY:g} s")
            if self._answer:
                raise RuntimeError(self._answer)
            self._motion.recover()

    def close(self) -> None:
        """Stop the arm, and let go of it."""
        with self._changed:
            self._open = False
            self._changed.notify_all()
        self._thread.join()

    @property
    def drift(self) -> float:
        """By how much our clock is faster than the controller's, s/s."""
        return self._motion.clock.drift

    @property
    def watchdog(self) -> float:
        """Silence after which the arm stops in a reflex, s."""
        return WATCHDOG

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
                    with self._changed:
                        self._failed, self._robot = in_words(error), None
                        self._changed.notify_all()
                    return
                self._lose(in_words(error))
            with self._changed:
                self._changed.wait_for(
                    lambda: self._ready or self._wants_recovery or not self._open,
                    max(0.0, due - time.monotonic()),
                )
        self._disconnect()

    def _disconnect(self) -> None:
        """Bring the arm to rest, and end the connection."""
        import franky

        robot, self._robot = self._robot, None
        if robot is None:
            return
        try:
            if robot.is_in_control:
                robot.move(self._velocity_motion(np.zeros(6), 0.0), asynchronous=True)
                robot.join_motion(_ENDS)
        except franky.Exception:
            pass  # it has stopped already, for a reason of its own
        del robot

    # ---- commands ----

    def _follow(self) -> None:
        """Do what is asked for, if that is news."""
        with self._changed:
            twist, age = self._motion.twist, time.monotonic() - self._motion.commanded
            recover, send = self._wants_recovery, self._ready and self._last is not None
            self._news = self._news and not send
        if recover:
            self._recover()
        elif send and not (self._motion.fault and twist.any()):
            self._guarded(self._send, twist, age)

    def _guarded(self, do: Callable[..., None], *arguments: Any) -> None:
        """Do it; where the arm has ended the motion, its state says why, or else what franky says does."""
        import franky

        try:
            do(*arguments)
        except franky.ControlException as error:
            state = state_of(self._robot)
            self._take(state, why_not(state) or in_words(error))

    @property
    def _ready(self) -> bool:
        """Whether there is something to send that may be sent now; a stop always may."""
        apart = time.monotonic() - self._sent_at
        return self._news and (apart >= _APART or not self._motion.twist.any())

    def _send(self, twist: Array, age: float) -> None:
        """Go after the twist in force, commanded `age` seconds ago, as the arm stands now."""
        if not twist.any() and not (self._sent.any() and self._robot.is_in_control):
            return  # it rests, or is on its way to
        self._robot.move(self._velocity_motion(twist, max(0.0, self._timeout - age)), asynchronous=True)
        self._sent, self._sent_at = twist, time.monotonic()

    def _velocity_motion(self, twist: Array, seconds: float) -> Any:
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
            state = state_of(self._robot)
            if errors_of(state):
                self._robot.recover_from_errors()
                state = state_of(self._robot)
            answer = why_not(state) or self._wrong(state)
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
        self._take(state_of(self._robot), "")

    def _take(self, state: Any, fault: str) -> None:
        """Report a state, if it is a new one, in a fault of that reason if there is one."""
        now_ns, milliseconds = time.time_ns(), state.time.to_msec()
        if milliseconds == self._robot_time and not fault:
            if time.monotonic() - self._heard > (patience := self._motion.patience):
                raise RuntimeError(f"no state of the arm for {patience:g} s")
            return
        self._robot_time, self._heard = milliseconds, time.monotonic()
        stamp_ns = self._motion.stamp(1e-3 * milliseconds, now_ns)
        fault = fault or why_not(state) or self._too_fast(state) or self._motion.lateness(now_ns)
        self._report(self._told(state, stamp_ns, fault))

    def _told(self, state: Any, stamp_ns: int, fault: str) -> ArmState:
        """What is reported of a state of franky's."""
        import franky

        T = np.asarray(state.O_T_EE.matrix) @ self._T_tool_controlled
        twist = self._twist_of(state)
        joints, motion = np.array(state.q) if self.kinematics is not None else None, self._motion
        with self._changed:
            if fault and not motion.fault:
                motion.begin_fault(fault, state.robot_mode == franky.RobotMode.UserStopped)
                self._news = True
            motion.expire(self._timeout)  # it ends by itself
            success = state.control_command_success_rate
            poor = motion.moving and success < _POOR
            words = motion.words(f"control command success rate {success:.0%}" if poor else "")
            self._last = ArmState(stamp_ns, T, twist, motion.mode(twist), words, joints)
            turned = bool(motion.moving and motion.twist[3:].any())  # the frame that the twist is given in
            self._news = self._news or (turned and time.monotonic() - self._sent_at >= _TURNED)
            self._changed.notify_all()
            return self._last

    def _too_fast(self, state: Any) -> str:
        """Whether the arm is faster than it can have been asked to be; '' if it is not."""
        twist, limits = self._twist_of(state), self._limits
        for part, most in (twist[:3], limits.linear_velocity), (twist[3:], limits.angular_velocity):
            if (speed := se3.norm(part)) > _TOO_FAST * most:
                return f"the arm moves at {speed:.3g}, {_TOO_FAST:g} times its limit of {most:g}"
        return ""

    def _twist_of(self, state: Any) -> Array:
        """The twist (6,) of the controlled frame, in it."""
        T = np.asarray(state.O_T_EE.matrix) @ self._T_tool_controlled
        speed = np.concatenate([state.O_dP_EE_d.linear, state.O_dP_EE_d.angular])
        return controlled_twist(T, self._T_tool_controlled, speed)

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
        state = state_of(robot)
        left = "" if errors_of(state) else why_not(state)  # `recover` clears old errors
        if self._last is None and (wrong := left or self._wrong(state)):
            raise RuntimeError(wrong)
        if settings.model == PANDA and hasattr(robot, "model_urdf"):
            raise RuntimeError("the arm is an FR3, the scene says panda")
        with self._changed:
            if self._last is not None:
                self._motion.fault = "the connection to the arm was lost, and is back"
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
                self._motion.fault = f"no connection to the arm: {reason}"
            elif not self._motion.fault:
                self._motion.begin_fault(f"connection lost: {reason}")
            self._robot, self._news = None, False
            self._wants_recovery, self._answer = False, "the connection to the arm was lost"
            self._changed.notify_all()
            assert self._last is not None
            last = replace(self._last, mode=self._motion.fault_mode, reason=self._motion.fault)
        if robot is not None and self._open:
            self._report(last)
        del robot  # which may wait for an answer that does not come
        with self._changed:
            self._changed.wait_for(lambda: not self._open, _RETRY)
