"""A second controller of a Universal Robots e-Series arm, for tests of what drives one.

It is written from what Universal Robots publish alone, and knows nothing of the driver, nor of the double of
the controller in `tactile_doubles`: a mistake that those two have in common does not pass here. What
happens on the controller stands here, how one speaks to it in `ur_second_server`. Comments name as sources:

- URScript: "The URScript Programming Language", by the name of the function or the section
- RTDE: "Real-Time Data Exchange (RTDE) Guide", protocol version 2
- Dashboard: "Dashboard Server e-Series, port 29999"
- User manual: of the UR5e, PolyScope 5

The arm is a TCP that has its target speed exactly. It has no joints, hence nothing that joints limit. It
moves in steps of 2 ms, in which all times are counted here; clients are told what a machine held up besides.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from urscript import Program

VERSION = (5, 19, 0, 1210631)
STEP = 0.002  # s; RTDE, Key features: 500 Hz on e-Series

# RTDE, Robot controller outputs: runtime_state, robot_mode and safety_mode.
STOPPED, PLAYING, PAUSED = 1, 2, 4
POWER_OFF, IDLE, RUNNING = 3, 5, 7
NORMAL, PROTECTIVE_STOP, ROBOT_EMERGENCY_STOP = 1, 3, 7
SAFETY_BITS = {NORMAL: 1, PROTECTIVE_STOP: 1 << 2 | 1 << 10, ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10}
ROBOT_MODES = {POWER_OFF: "POWER_OFF", IDLE: "IDLE", RUNNING: "RUNNING"}
SAFETY_MODES = {1: "NORMAL", 3: "PROTECTIVE_STOP", 7: "ROBOT_EMERGENCY_STOP"}
UNLOCKED_AFTER = 5.0  # s; Dashboard, unlock protective stop

# No manual says how fast an arm slows down whose program is stopped: this is movel's default acceleration.
PROGRAM_END = 1.2, 1.2  # m/s^2, rad/s^2
# User manual, Safety-related electrical inputs: a joint is never faster than with a constant deceleration
# from its largest speed, 180 deg/s, to 0 in 500 ms; here that of a TCP 0.4 m away from the base's axis.
SAFETY_STOP = 2.5, 6.28  # m/s^2, rad/s^2

JOINTS = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)  # rad, wherever the TCP is


class Tool:
    """The TCP: where it is, how fast, and what speed it goes after.

    Attributes
    ----------
    twist : numpy.ndarray
        Speed (6,) of the TCP along the axes of the base, m/s and rad/s.
    """

    def __init__(self, position: list[float], turn: list[float]):
        self._flange, self._turn = np.array(position), Rotation.from_rotvec(turn)
        self.offset = [0.0] * 6
        self.twist, self._target = np.zeros(6), np.zeros(6)
        self._rates = PROGRAM_END

    def aim(self, target: Any, acceleration: float, turning: float) -> None:
        """Go after a speed (6,), with so many m/s^2 and rad/s^2."""
        self._target, self._rates = np.array(target, dtype=float), (acceleration, turning)

    @property
    def there(self) -> bool:
        """Whether it has the speed that it goes after."""
        return bool((self.twist == self._target).all())

    def advance(self) -> None:
        """Move on by one step.

        Speeds change linearly (URScript, speedl: "accelerate linearly in Cartesian space"), those of position
        and orientation within the same time (release notes of PolyScope 3.2: "the acceleration of the
        orientation and position speed are synchronized").
        """
        change = self._target - self.twist
        lasts = max(np.linalg.norm(change[:3]) / self._rates[0], np.linalg.norm(change[3:]) / self._rates[1])
        before = self.twist
        self.twist = self._target.copy() if lasts <= STEP else before + change * (STEP / lasts)
        way = 0.5 * (before + self.twist) * STEP
        tcp = self._flange + self._turn.apply(self.offset[:3]) + way[:3]
        self._turn = Rotation.from_rotvec(way[3:]) * self._turn
        self._flange = tcp - self._turn.apply(self.offset[:3])

    @property
    def pose(self) -> list[float]:
        """Position and rotation vector (6,) of the TCP in the base, m and rad."""
        turn = self._turn * Rotation.from_rotvec(self.offset[3:])
        return [*(self._flange + self._turn.apply(self.offset[:3])), *turn.as_rotvec()]


class Controller:
    """What is on the controller whoever is connected: registers, program, safety, and the arm."""

    def __init__(self) -> None:
        self.steps = 0
        self.held_up = 0.0  # s, in which this machine let nothing happen
        self.tool = Tool([0.4, 0.0, 0.3], [np.pi, 0.0, 0.0])
        self.robot_mode, self.safety_mode, self.runtime_state = RUNNING, NORMAL, STOPPED
        self.payload = 0.0
        self.inputs: dict[str, Any] = defaultdict(int)
        self.outputs: dict[str, Any] = {}
        self.watchdogs: dict[str, tuple[float, str]] = {}
        self.heard: dict[str, float] = {}  # when each input came last
        self.calls: list[list] = []  # time, name and values of each call of a program that matters
        self.trace: list[list[float]] = []
        self._program: Program | None = None
        self._stopped_at = 0.0
        named = [name for name in dir(self) if name.startswith("script_")]
        self._offered = {name.removeprefix("script_"): getattr(self, name) for name in named}

    @property
    def now(self) -> float:
        """Seconds that the controller has been at work."""
        return self.steps * STEP

    def step(self) -> None:
        """One step of 2 ms."""
        self.steps += 1
        self._watch()
        if self.runtime_state == PLAYING:
            self._run()
        self.tool.advance()
        if self.safety_mode == ROBOT_EMERGENCY_STOP and not self.tool.twist.any():
            self.robot_mode = POWER_OFF  # User manual: a stop of category 1 takes the power away at rest
        self.trace.append([self.now, *self.tool.pose, *self.tool.twist])

    def _run(self) -> None:
        try:
            alive = self._program.step()
        except Exception as error:
            self.note("error", repr(error))
            alive = False
        if not alive:
            self.end_program("its end")

    def _watch(self) -> None:
        """URScript, rtde_set_watchdog: an input that came less often than min_frequency ends the program."""
        for name, (period, action) in list(self.watchdogs.items()):
            if self.runtime_state == PLAYING and self.now - self.heard.get(name, 0.0) > period:
                self.note("watchdog", name, action)
                if action == "stop":
                    self.end_program("watchdog")
                elif action == "pause":
                    self.runtime_state = PAUSED
                    self.tool.aim(np.zeros(6), *PROGRAM_END)

    def note(self, name: str, *values: Any) -> None:
        """Remember what happened, for the test."""
        self.calls.append([self.now, name, *values])

    def take(self, text: str) -> None:
        """Run a program in place of the one that runs; a line by itself is a program, too."""
        self.end_program("another program")
        if self.robot_mode != RUNNING or self.safety_mode != NORMAL:
            self.note("ignored", text[:40])
            return
        if not re.match(r"\s*def ", text):
            text = f"def line():\n{text}\nend"
        try:
            self._program = Program(text, self._offered)
        except ValueError as error:
            self.note("error", str(error))
            return
        self.runtime_state = PLAYING
        self.note("program", text)

    def end_program(self, why: str) -> None:
        """Stop the program, and the arm; URScript, rtde_set_watchdog: watchdogs are removed with it."""
        if self.runtime_state == STOPPED:
            return
        self.runtime_state, self._program = STOPPED, None
        self.watchdogs.clear()
        self.note("ended", why)
        if self.safety_mode == NORMAL:
            self.tool.aim(np.zeros(6), *PROGRAM_END)

    # What can happen at the arm.

    def emergency_stop(self) -> None:
        """The button is pressed: a stop of category 1."""
        self.safety_mode = ROBOT_EMERGENCY_STOP
        self.tool.aim(np.zeros(6), *SAFETY_STOP)
        self.end_program("emergency stop")

    def release(self) -> None:
        """The button is out; the arm stays without power."""
        self.safety_mode = NORMAL

    def switch_on(self) -> None:
        """At the pendant, power on and brakes released."""
        self.robot_mode = RUNNING

    def protective_stop(self) -> None:
        """Stop of category 2; the program pauses."""
        self.safety_mode, self._stopped_at = PROTECTIVE_STOP, self.now
        self.runtime_state = PAUSED if self._program else STOPPED
        self.tool.aim(np.zeros(6), *SAFETY_STOP)
        self.note("protective_stop")

    def unlock(self) -> str:
        """Dashboard, unlock protective stop."""
        if self.now - self._stopped_at < UNLOCKED_AFTER:
            self.note("unlock refused")
            return (
                "Cannot unlock protective stop until 5s after occurrence. "
                "Always inspect cause of protective stop before unlocking"
            )
        if self.safety_mode == PROTECTIVE_STOP:
            self.safety_mode = NORMAL
        self.note("unlocked")
        return "Protective stop releasing"

    def play(self) -> str:
        """Dashboard, play: a program that pauses goes on; none other is loaded."""
        if self.runtime_state != PAUSED or self.safety_mode != NORMAL:
            return "Failed to execute: play"
        self.runtime_state = PLAYING
        return "Starting program"

    def set_tcp(self, offset: list[float]) -> None:
        """Another TCP: the flange stays where it is."""
        self.tool.offset = list(offset)

    # URScript, by name: what programs call.

    def script_speedl(self, xd: list, a: float, t: float = 0.0, aRot: float | None = None) -> Generator:
        """URScript, speedl: goes on at the target speed; returns after t, there or not, else once there.

        aRot: "If not defined, position acceleration value in [rad/s^2] will be used".
        """
        self.note("speedl", list(xd), a, t, aRot)
        self.tool.aim(xd, a, a if aRot is None else aRot)
        returns = self.now + t - 0.5 * STEP
        while True:
            yield
            if self.tool.there if t <= 0.0 else self.now >= returns:
                return

    def script_stopl(self, a: float, aRot: float | None = None) -> Generator:
        """URScript, stopl: returns at rest; aRot is that of speedl."""
        self.note("stopl", a, aRot)
        self.tool.aim(np.zeros(6), a, a if aRot is None else aRot)
        while True:
            yield
            if self.tool.there:
                return

    def script_rtde_set_watchdog(self, variable: str, frequency: float, action: str = "pause") -> None:
        self.note("rtde_set_watchdog", variable, frequency, action)
        self.watchdogs[variable] = 1.0 / frequency, action
        self.heard[variable] = self.now

    def script_sync(self) -> Generator:
        yield

    def script_textmsg(self, *what: Any) -> None:
        pass  # the pendant's log

    def script_read_input_integer_register(self, i: int) -> int:
        return self.inputs[f"input_int_register_{i}"]

    def script_read_input_float_register(self, i: int) -> float:
        return self.inputs[f"input_double_register_{i}"]

    def script_write_output_integer_register(self, i: int, value: int) -> None:
        self.outputs[f"output_int_register_{i}"] = int(value)

    def script_write_output_float_register(self, i: int, value: float) -> None:
        self.outputs[f"output_double_register_{i}"] = float(value)

    def script_get_tcp_offset(self) -> list[float]:
        return list(self.tool.offset)

    def script_set_tcp(self, pose: list[float]) -> None:
        self.set_tcp(pose)

    def script_get_actual_tcp_pose(self) -> list[float]:
        return self.tool.pose

    def script_get_target_payload(self) -> float:
        return self.payload

    def script_get_target_payload_cog(self) -> list[float]:
        return [0.0] * 3

    def script_set_payload(self, mass: float, cog: Any = None) -> None:
        self.payload = mass

    def script_get_steptime(self) -> float:
        return STEP

    def script_is_steady(self) -> bool:
        return not self.tool.twist.any()

    def script_protective_stop(self) -> None:
        self.protective_stop()

    def script_force_mode_set_gain_scaling(self, scaling: float) -> None:
        pass  # there is no force mode here

    def script_force_mode_set_damping(self, damping: float) -> None:
        pass

    # RTDE and Dashboard: what is told.

    def state(self) -> dict[str, Any]:
        """Outputs that are not 0, by name."""
        pose, twist = self.tool.pose, self.tool.twist
        running = self.runtime_state == PLAYING
        return {
            "timestamp": self.now + self.held_up, "speed_scaling": 1.0, "target_speed_fraction": 1.0,
            "payload": self.payload, "actual_q": JOINTS, "target_q": JOINTS,
            "actual_TCP_pose": pose, "target_TCP_pose": pose,
            "actual_TCP_speed": twist, "target_TCP_speed": twist, "tcp_offset": self.tool.offset,
            "robot_mode": self.robot_mode, "safety_mode": self.safety_mode, "safety_status": self.safety_mode,
            "runtime_state": self.runtime_state, "safety_status_bits": SAFETY_BITS[self.safety_mode],
            "robot_status_bits": (self.robot_mode > POWER_OFF) | running << 1, **self.outputs,
        }  # fmt: skip

    def answer(self, command: str) -> str:
        """Dashboard: the reply to a command."""
        playing = self.runtime_state == PLAYING
        answers: dict[str, Callable[[], str]] = {
            "polyscopeversion": lambda: f"URSoftware {'.'.join(map(str, VERSION))} (Jul 08 2024)",
            "version": lambda: ".".join(map(str, VERSION)),
            "get serial number": lambda: "20195500001",
            "get robot model": lambda: "UR5",
            "is in remote control": lambda: "true",
            "robotmode": lambda: f"Robotmode: {ROBOT_MODES[self.robot_mode]}",
            "safetymode": lambda: f"Safetymode: {SAFETY_MODES[self.safety_mode]}",
            "safetystatus": lambda: f"Safetystatus: {SAFETY_MODES[self.safety_mode]}",
            "running": lambda: f"Program running: {str(playing).lower()}",
            "programstate": lambda: f"{'PLAYING' if playing else 'STOPPED'} <unnamed>",
            "play": self.play,
            "stop": lambda: self.end_program("the dashboard") or "Stopped",
            "unlock protective stop": self.unlock,
            "close popup": lambda: "closing popup",
            "close safety popup": lambda: "closing safety popup",
            "quit": lambda: "Disconnected",
        }
        known = answers.get(command.strip().lower())
        return known() if known else f"could not understand: '{command}'"
