"""UrRobot: what a Universal Robots controller does with its arm, as far as its clients can tell.

The arm is a point with an orientation, its TCP, which follows speedl within an acceleration; the joints of an
arm whose kinematics are known follow it. The program that ur_rtde uploads runs here as the reaction to
what it is asked in the registers: `input_int_register_0` holds the command, `output_int_register_0` says
1 (ready for a command) or 2 (done with it). All this is simulated, and none of it is a real controller.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_drivers.rotation_vectors import pose_of, vector_of
from tactile_geometry import se3
from tactile_scene.kinematics.arm_file import load_arm

Array = NDArray[np.float64]

NO_COMMAND, SPEED_L, SPEED_STOP, SET_WATCHDOG, GET_TCP_OFFSET, KICK, STOP_SCRIPT = 0, 10, 15, 35, 40, 99, 255
_CONTINUOUS = (6, 9, SPEED_L, 11, 24, 25, 26, 27, 38)  # commands after which the program is ready at once
_READY, _DONE = 1, 2
_OFFSETS = (0, 24)  # of the registers that the program uses; from 24 on where a fieldbus has the lower ones
NORMAL, PROTECTIVE_STOP, SAFEGUARD_STOP, ROBOT_EMERGENCY_STOP = 1, 3, 5, 7  # safety_mode
POWER_OFF, RUNNING = 3, 7  # robot_mode
STOPPED, PLAYING = 1, 2  # runtime_state
# bits of safety_status_bits in each safety mode
_SAFETY_BITS = {
    NORMAL: 1, PROTECTIVE_STOP: 1 << 2 | 1 << 10, SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}  # fmt: skip
_SAFETY_NAMES = {
    NORMAL: "NORMAL", PROTECTIVE_STOP: "PROTECTIVE_STOP", SAFEGUARD_STOP: "SAFEGUARD_STOP",
    ROBOT_EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP",
}  # fmt: skip
_SAFETY_DECELERATION = 10.0  # m/s^2, rad/s^2, of a stop by safety
_PROGRAM_DECELERATION = 2.0  # m/s^2, rad/s^2, when the program ends
_UNLOCKED_AFTER = 5.0  # s: "unlock protective stop" of the dashboard server, e-Series and CB3
_TOO_EARLY = "Cannot unlock protective stop until 5s after occurrence."
_PASSED_OVER = 0.01  # s, of a step that makes up for several cycles
_JOINTS_EVERY = 0.007  # s; joints follow the pose, and take most of the time of a cycle


@dataclass(frozen=True)
class UrRobotSettings(Settings):
    """Which arm the double is."""

    model: str = setting("UR5", doc="as its dashboard server tells it")
    version: tuple[int, ...] = setting((5, 15, 0, 0), length=4, lower=0, upper=999, doc="of PolyScope")
    start: tuple[float, ...] = setting(
        (0.4, 0.0, 0.3, 3.141592653589793, 0.0, 0.0), length=6, lower=-10.0, upper=10.0, unit="m, rad",
        doc="pose of the TCP at the start: position and rotation vector",
    )  # fmt: skip
    tcp_offset: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=-10.0, upper=10.0, unit="m, rad", doc="of the TCP, in the flange"
    )
    payload: float = setting(0.0, lower=0.0, upper=50.0, unit="kg", doc="as installed")
    kinematics: str = setting("", doc="file of the arm whose joints it tells (config/arms); empty: zeros")
    joints: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=-10.0, upper=10.0, unit="rad", doc="angles at the start"
    )

    @property
    def rate(self) -> float:
        """Of the control loop, Hz: 500 for an e-Series, 125 for a CB3."""
        return 500.0 if self.version[0] >= 5 else 125.0


class UrRobot:
    """The arm, its safety and its program; `step` is one cycle of the control loop.

    Attributes
    ----------
    registers : dict
        What clients have written, by the variables' names.
    trace : deque of (time (s), pose (6,), speed (6,), target (6,))
        What the arm did in its last cycles; target is what speedl was asked for, in the base.
    """

    def __init__(self, settings: UrRobotSettings | None = None) -> None:
        self.settings = settings or UrRobotSettings()
        self.period = 1.0 / self.settings.rate
        self.time = 100.0  # s since the controller was started
        self.T_base_tcp = pose_of(self.settings.start)
        self.joints, self._joints_time = np.array(self.settings.joints), self.time
        self._chain = None
        if self.settings.kinematics:
            self._chain = load_arm(self.settings.kinematics).with_tool(pose_of(self.settings.tcp_offset))
        self.speed, self._target = np.zeros(6), np.zeros(6)
        self._acceleration, self._hold = _PROGRAM_DECELERATION, 0.0
        self.tcp_offset, self.payload = list(self.settings.tcp_offset), self.settings.payload
        self.safety_mode, self.robot_mode = NORMAL, RUNNING
        self.speed_slider, self.teach_button, self.remote_control = 1.0, False, True
        self.stuck = False  # the program does not react any more
        self.registers: dict[str, Any] = {}
        self.trace: deque[tuple[float, Array, Array, Array]] = deque(maxlen=20000)
        self._outputs: dict[str, Any] = {}
        self._offset = 0  # of the registers that the program uses
        self.program_running = self._executing = False
        self._watchdog, self._fed = 0.0, 0.0
        self.protected_at = 0.0  # time of the last protective stop

    # ---- one cycle ----

    def step(self, period: float = 0.0) -> None:
        """Go on by a cycle of the control loop, or by `period` seconds."""
        dt = period or self.period
        self.time += dt
        if self.program_running:
            if self._watchdog and self.time - self._fed > 1.0 / self._watchdog:
                self.stop_program()
            elif not self.stuck:
                self._run_program()
        self._move(dt)
        self.trace.append((self.time, vector_of(self.T_base_tcp), self.speed.copy(), self._target.copy()))

    def pass_over(self, seconds: float) -> None:
        """Make up for time in which a busy machine made no cycles: the arm of a real controller went on.

        What clients sent meanwhile waits to be read, so that nobody has been silent.
        """
        steps = max(1, round(seconds / _PASSED_OVER))
        for _ in range(steps):
            self._fed += seconds / steps
            self.step(seconds / steps)

    def write(self, values: dict[str, Any]) -> None:
        """What a client writes into the registers."""
        self.registers |= values
        for offset in _OFFSETS:
            if f"input_int_register_{offset}" in values:
                self._fed, self._offset = self.time, offset

    def outputs(self) -> dict[str, Any]:
        """The variables that RTDE tells, by their names."""
        pose, speed = tuple(vector_of(self.T_base_tcp)), tuple(self.speed)
        bits = 1 * (self.robot_mode == RUNNING) | 2 * self.program_running | 4 * self.teach_button
        return self._outputs | {
            "timestamp": self.time,
            "actual_TCP_pose": pose, "target_TCP_pose": pose,
            "actual_q": tuple(self.joints), "target_q": tuple(self.joints),
            "actual_TCP_speed": speed, "target_TCP_speed": tuple(self._target),
            "robot_mode": self.robot_mode, "safety_mode": self.safety_mode,
            "safety_status_bits": _SAFETY_BITS[self.safety_mode], "robot_status_bits": bits,
            "runtime_state": PLAYING if self.program_running else STOPPED,
            "speed_scaling": 1.0, "target_speed_fraction": self.speed_slider,
            "payload": self.payload, "tcp_offset": self.tcp_offset,
        }  # fmt: skip

    def _move(self, dt: float) -> None:
        """Towards the target speed, with both parts at their ends at the same time, and on by it.

        Without `aRot`, which ur_rtde's program does not give (`speedl(xd, a=acceleration, t=time)`,
        `stopl(deceleration_rate)`), "position acceleration value in [rad/s^2] will be used" (URScript manual,
        module motion: speedl, stopl).
        """
        change = self._target * self.speed_slider - self.speed
        needed = max(np.linalg.norm(change[:3]), np.linalg.norm(change[3:]))
        before = self.speed.copy()
        self.speed = self.speed + change * min(1.0, self._acceleration * dt / needed if needed else 1.0)
        self._hold = max(0.0, self._hold - dt)
        mean = 0.5 * (before + self.speed)
        if mean.any():
            turn = se3.exp(np.concatenate([np.zeros(3), mean[3:] * dt]))
            self.T_base_tcp[:3, :3] = turn[:3, :3] @ self.T_base_tcp[:3, :3]
            self.T_base_tcp[:3, 3] += mean[:3] * dt
            if self._chain is not None and self.time - self._joints_time > _JOINTS_EVERY:
                self.joints, self._joints_time = self._chain.follow(self.joints, self.T_base_tcp), self.time

    # ---- the program ----

    def start_program(self) -> None:
        """Run the program that a client has uploaded, if the arm can move."""
        if self.robot_mode == RUNNING and self.safety_mode == NORMAL:
            self.program_running, self._executing, self._watchdog = True, False, 0.0
            self._outputs |= {f"output_int_register_{offset}": _READY for offset in _OFFSETS}

    def stop_program(self) -> None:
        """End the program; the arm comes to rest."""
        self.program_running = False
        self._halt(_PROGRAM_DECELERATION)

    def _run_program(self) -> None:
        command = self.registers.get(f"input_int_register_{self._offset}", NO_COMMAND)
        answer = f"output_int_register_{self._offset}"
        if command in (NO_COMMAND, KICK):
            self._executing = False
            self._outputs[answer] = _READY
        elif command in _CONTINUOUS:
            self._execute(command)
            self._outputs[answer] = _READY
        elif not self._executing:
            self._executing = True
            self._execute(command)
            self._outputs[answer] = _DONE

    def _execute(self, command: int) -> None:
        first = self._offset
        values = [self.registers.get(f"input_double_register_{first + i}", 0.0) for i in range(8)]
        if command == SPEED_L:
            if self._hold <= 0.0:  # a speedl under way takes its time
                self._target, self._acceleration, self._hold = np.array(values[:6]), values[6], values[7]
        elif command == SPEED_STOP:
            self._halt(values[0])
        elif command == SET_WATCHDOG:
            self._watchdog, self._fed = values[0], self.time
        elif command == GET_TCP_OFFSET:
            told = {f"output_double_register_{first + i}": x for i, x in enumerate(self.tcp_offset)}
            self._outputs |= told
        elif command == STOP_SCRIPT:
            self.stop_program()

    def _halt(self, deceleration: float) -> None:
        self._target, self._acceleration, self._hold = np.zeros(6), deceleration, 0.0

    # ---- safety ----

    def protective_stop(self) -> None:
        """As after a collision."""
        self._stop_by_safety(PROTECTIVE_STOP)
        self.protected_at = self.time

    def emergency_stop(self) -> None:
        """The arm's own button."""
        self._stop_by_safety(ROBOT_EMERGENCY_STOP)
        self.robot_mode = POWER_OFF

    def safeguard_stop(self) -> None:
        """A light curtain, a door."""
        self._stop_by_safety(SAFEGUARD_STOP)

    def restore(self) -> None:
        """What a person does at the pendant: button out, door shut, power on, brakes released."""
        self.safety_mode, self.robot_mode = NORMAL, RUNNING

    def _stop_by_safety(self, mode: int) -> None:
        self.safety_mode, self.program_running = mode, False
        self._halt(_SAFETY_DECELERATION)

    # ---- the dashboard server ----

    def answer(self, question: str) -> str:
        """What the dashboard server answers to a line."""
        words = question.strip()
        if words.lower() == "polyscopeversion":
            return f"URSoftware {'.'.join(map(str, self.settings.version))} (Jan 01 2024)"
        if words == "unlock protective stop":
            if self.safety_mode != PROTECTIVE_STOP:
                return "Cannot unlock protective stop: there is none"
            if self.time - self.protected_at < _UNLOCKED_AFTER:
                return f"{_TOO_EARLY} Always inspect cause of protective stop before unlocking"
            self.safety_mode = NORMAL
            return "Protective stop releasing"
        if words == "stop":
            self.stop_program()
        fixed = {
            "get robot model": self.settings.model,
            "get serial number": "20245000001",  # ur_rtde refuses one that is no number
            "is in remote control": str(self.remote_control).lower(),
            "robotmode": f"Robotmode: {'RUNNING' if self.robot_mode == RUNNING else 'POWER_OFF'}",
            "safetymode": f"Safetymode: {_SAFETY_NAMES[self.safety_mode]}",
            "safetystatus": f"Safetystatus: {_SAFETY_NAMES[self.safety_mode]}",
            "running": f"Program running: {str(self.program_running).lower()}",
            "programState": f"{'PLAYING' if self.program_running else 'STOPPED'} <unnamed>",
            "close safety popup": "closing safety popup",
            "stop": "Stopped",
        }
        return fixed.get(words, f"could not understand: '{words}'")
