"""UrArm: the driver of an arm of Universal Robots, e-Series or CB3, through ur_rtde.

Cartesian velocity with speedL, at the rate of the arm's states; stops with speedStop, and a watchdog on the
controller that ends the arm's program when nothing comes any more. ur_rtde runs in a process of its own
(`tactile_drivers.ur_link`), which is started anew when the connection is lost. Whatever ends the program or
the connection is a fault, which only `recover` leaves.

The scene's tool frame is the controller's TCP, and the arm's base that of the controller ("Base" at the
pendant); the controlled frame stands in the tool as the scene says.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_drivers import ur_link
from tactile_drivers.clock_offset import ClockOffset
from tactile_drivers.rotation_vectors import controlled_twist, pose_of, tool_speed
from tactile_geometry import se3
from tactile_scene.arm import HELD_UP, ArmMode, ArmState, is_at_rest
from tactile_scene.arm_settings import ArmLimits
from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]

E_SERIES, CB3 = "e-series", "cb3"
_RATES = {E_SERIES: 500.0, CB3: 125.0}
_SAME = np.repeat([5e-4, 5e-3], 3)  # m, rad: TCPs that differ by less are the same
_SAME_PAYLOAD = 0.05  # kg
_OF_WATCHDOG = 0.8  # of the watchdog's time, within which a stop has to end
_STOPS_WITHIN = 0.1  # s, from the largest speeds
_ABOVE = 1.2  # times the limits of acceleration, so that the arm does not lag behind commands at their limit
_GRACE = 1.3  # the link stops by itself this much later than the stage should have
_PATIENT = 10.0  # times longer an arm at rest may be silent
_STOPS = 0.05  # s, for a link that says nothing any more to pass on a stop all the same
_RETRY = 1.0  # s, between attempts to connect again
_RECOVERY = 10.0  # s
_LOOK = 0.1  # s, between looks whether the driver is to be closed


@dataclass(frozen=True)
class UrSettings(Settings):
    """How the arm is reached, and what its controller should say of it."""

    host: str = setting("192.168.0.2", doc="address of the controller")
    generation: str = setting(E_SERIES, choices=tuple(_RATES), doc="of the arm")
    model: str = setting("", doc="as the dashboard server tells it, UR5 for instance; empty: any")
    rate: float = setting(
        0.0, lower=0.0, upper=500.0, unit="Hz",
        doc="of states and commands; 0: of the control loop, 500 for an e-Series, 125 for a CB3",
    )  # fmt: skip
    tcp_offset: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=-10.0, upper=10.0, unit="m, rad",
        doc="of the TCP in the flange, position and rotation vector, as the controller has to have it; "
        "the TCP is the scene's tool frame",
    )  # fmt: skip
    payload: float = setting(
        0.0, lower=0.0, upper=50.0, unit="kg", doc="mass at the flange, as the controller has to have it"
    )
    acceleration: float = setting(
        0.0, lower=0.0, upper=200.0, unit="m/s^2, rad/s^2",
        doc="with which speedL goes after each command, translation and rotation; above the limits, which "
        "the commands keep themselves; 0: by a fifth above the larger of both",
    )  # fmt: skip
    deceleration: float = setting(
        0.0, lower=0.0, upper=200.0, unit="m/s^2, rad/s^2",
        doc="of speedStop, translation and rotation; 0: both end within 0.1 s, and before the watchdog",
    )  # fmt: skip
    watchdog: float = setting(
        10.0, lower=2.0, upper=100.0, unit="Hz", doc="the controller stops when it hears less often"
    )
    state_timeout: float = setting(
        0.1,
        lower=0.02,
        upper=1.0,
        unit="s",
        doc="silence or lateness of states that is a lost connection in motion; at rest ten times that",
    )
    connect_timeout: float = setting(
        10.0, lower=1.0, upper=60.0, unit="s", doc="for connection and start of the program"
    )
    upper_registers: bool = setting(
        False, doc="use RTDE registers from 24 on, where a fieldbus has those from 0 on"
    )

    @property
    def loop_rate(self) -> float:
        """Rate of states and commands, Hz."""
        return self.rate or _RATES[self.generation]


class UrState(NamedTuple):
    """What the link tells of the arm: its TCP in its base, its joints (rad), and its modes."""

    now_ns: int
    time: float
    pose: Array
    speed: Array
    joints: Array
    mode: int
    safety: int
    status: int
    runtime: int
    scaling: float
    payload: float


class UrArm:
    """See the module's text; the contract is `tactile_scene.arm.Arm`."""

    settings_class = UrSettings
    keeps_limits = False  # of jerk: it is given twists that do
    prompt = True

    def __init__(self, arm: ArmScene, settings: UrSettings, report: Callable[[ArmState], None]) -> None:
        if wrong := _unfit(settings, arm.limits):
            raise RuntimeError(wrong)
        settings = _with_accelerations(settings, arm.limits)
        self.settings, self.kinematics, self._report = settings, arm.kinematics, report
        self._timeout = _GRACE * arm.limits.command_timeout
        self._T_tcp_controlled = arm.T_tool_controlled
        self._clock = ClockOffset()
        self._twist, self._commanded = np.zeros(6), 0.0
        self._moving, self._reason = False, ""
        self._fault, self._fault_mode = "", ArmMode.FAULT
        self._last: ArmState | None = None
        self._answers: list[str] = []
        self._answered = threading.Condition()
        self._sending = threading.Lock()
        self._open, self._heard = True, time.monotonic()
        self._link: _LinkProcess | None = self._connected()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    # ---- the contract ----

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """Follow a twist (6,) of the controlled frame, in that frame."""
        with self._sending:
            if self._fault:
                return
            self._twist, self._commanded = np.array(twist, dtype=np.float64), time.monotonic()
            self._moving, self._reason = True, ""
            self._send_speed()

    def stop(self, reason: str) -> None:
        """Come to rest with the settings' deceleration; the next command moves the arm again."""
        with self._sending:
            self._twist, self._moving, self._reason = np.zeros(6), False, reason
            if self._link is not None:
                self._link.send(ur_link.STOP.pack(b"s", self.settings.deceleration))

    def recover(self) -> None:
        """Leave a fault: a protective stop is unlocked, and the program started again.

        Raises
        ------
        RuntimeError
            If the arm cannot move, with the reason.
        """
        link = self._link
        if link is None:
            raise RuntimeError(self._fault or "there is no connection to the arm")
        self._answers.clear()
        link.send(ur_link.RECOVER)
        with self._answered:
            if not self._answered.wait_for(lambda: self._answers or self._link is not link, _RECOVERY):
                raise RuntimeError(f"the arm did not answer within {_RECOVERY:g} s")
            answer = self._answers.pop() if self._answers else "the connection to the arm was lost"
        if not answer.startswith("{"):
            raise RuntimeError(answer)
        if wrong := self._wrong(json.loads(answer)):  # at the pendant meanwhile
            raise RuntimeError(wrong)
        with self._sending:
            self._fault, self._moving, self._reason = "", False, "fault cleared"

    def close(self) -> None:
        """Stop the arm, end the program on the controller, and let go of both."""
        self._open = False
        if self._link is not None:
            self._link.send(ur_link.CLOSE)
        self._thread.join()
        if self._link is not None:
            self._link.end()

    @property
    def drift(self) -> float:
        """By how much our clock is faster than the controller's, s/s."""
        return self._clock.drift

    @property
    def watchdog(self) -> float:
        """Silence after which the controller ends the program, s."""
        return 1.0 / self.settings.watchdog

    @property
    def agreed(self) -> str:
        """What the controller says as the scene does, in words."""
        settings = self.settings
        model = f"{settings.model}, " if settings.model else ""
        return f"{model}{settings.generation}, TCP {list(settings.tcp_offset)}, {settings.payload:g} kg"

    # ---- commands ----

    def _send_speed(self) -> None:
        """Send the twist in force as the TCP's speed in the base, as the arm stands now."""
        if self._link is None or self._last is None:
            return
        speed = tool_speed(self._last.T_base_controlled, self._T_tcp_controlled, self._twist)
        self._link.send(ur_link.SPEED.pack(b"v", self._commanded, *speed, self.settings.acceleration))

    # ---- states ----

    def _run(self) -> None:
        """Take what the link says, and have another one when it is lost."""
        while self._open:
            if self._link is None:
                self._reconnect()
                continue
            packet, patience = self._link.receive(self.settings.state_timeout), self._patience
            if packet is None:
                if time.monotonic() - self._heard > patience:
                    self._lose(f"no state of the arm for {patience:g} s")
                continue
            self._heard = time.monotonic()
            if not packet:
                self._lose("the process that holds ur_rtde ended")
            elif packet[:1] == ur_link.ANSWER:
                with self._answered:
                    self._answers.append(packet[1:].decode())
                    self._answered.notify_all()
            elif not self._link.waiting:  # of states only the newest counts
                self._take_state(_unpacked(packet))

    @property
    def _patience(self) -> float:
        """How long (s) the arm may say nothing, or be late: at rest nothing depends on it."""
        return self.settings.state_timeout * (1.0 if self._twist.any() else _PATIENT)

    def _take_state(self, state: UrState) -> None:
        stamp_ns = self._clock.stamp_ns(state.time, state.now_ns)
        last = self._last
        if last is not None and stamp_ns <= last.stamp_ns:
            stamp_ns = last.stamp_ns + 1  # the offset became less between the two
        late = (time.time_ns() - stamp_ns) / SECOND_NS
        fault = self._why_fault(state)
        if not fault and late > self._patience:
            fault = f"states of the arm come {late:.3f} s late (limit {self._patience:g} s): {HELD_UP}"
        T = pose_of(state.pose) @ self._T_tcp_controlled
        twist = controlled_twist(T, self._T_tcp_controlled, state.speed)
        joints = state.joints if self.kinematics is not None else None
        with self._sending:
            if fault and not self._fault:
                self._begin_fault(fault, state.safety)
            silence = time.monotonic() - self._commanded
            if self._moving and silence > self._timeout:  # the link stops the arm by itself
                self._twist, self._moving = np.zeros(6), False
                self._reason = f"no command for {silence:.3f} s (limit of the driver {self._timeout:g} s)"
            self._last = ArmState(
                stamp_ns, T, twist, self._mode(twist), self._words(state), joints, float(state.scaling)
            )
            if self._moving and not self._fault and self._twist[3:].any():
                self._send_speed()  # the frame that the twist is given in has turned
        self._report(self._last)

    def _why_fault(self, state: UrState) -> str:
        """Why the arm does not follow commands in this state; '' if it does."""
        if why := ur_link.why_not(state.safety, state.mode, state.status):
            return why
        if not state.status & ur_link.PROGRAM_RUNNING:
            return "the program on the controller has ended (stopped at the pendant, or by its watchdog)"
        return self._wrong_payload(state.payload)

    def _begin_fault(self, reason: str, safety: int = ur_link.NORMAL) -> None:
        self._fault, self._twist, self._moving = reason, np.zeros(6), False
        emergency = ur_link.SAFETY.get(safety, "").startswith("emergency stop")
        self._fault_mode = ArmMode.ESTOP if emergency else ArmMode.FAULT
        if self._link is not None:
            self._link.send(ur_link.STOP.pack(b"s", self.settings.deceleration))

    def _mode(self, twist: Array) -> ArmMode:
        if self._fault:
            return self._fault_mode
        if self._moving and self._twist.any():
            return ArmMode.MOVING
        if is_at_rest(twist):
            return ArmMode.RESTING
        return ArmMode.MOVING if self._moving else ArmMode.STOPPING

    def _words(self, state: UrState) -> str:
        """Why the arm does what it does."""
        if self._fault or state.scaling > 0.999:
            return self._fault or self._reason
        return f"{self._reason}; " * bool(self._reason) + f"speed scaling {100.0 * state.scaling:.0f} %"

    # ---- the connection ----

    def _connected(self) -> _LinkProcess:
        """A link to a controller that is what the scene says; raises `RuntimeError` if there is none."""
        settings = self.settings
        wanted = asdict(settings) | {"rate": settings.loop_rate, "command_timeout": self._timeout}
        link = _LinkProcess(wanted)
        try:
            packet, until = None, time.monotonic() + settings.connect_timeout
            while packet is None and self._open and time.monotonic() < until:
                packet = link.receive(_LOOK)
            answer = (packet or b"")[1:].decode()
            if not answer.startswith("{"):
                silent = f"it did not answer within {settings.connect_timeout:g} s"
                ended = "the process that holds ur_rtde ended"
                raise RuntimeError(f"{settings.host}: {answer or (silent if packet is None else ended)}")
            if wrong := self._wrong(json.loads(answer)):
                raise RuntimeError(f"{settings.host}: {wrong}")
        except BaseException:
            link.end()
            raise
        return link

    def _wrong(self, facts: dict[str, Any]) -> str:
        """What the controller says otherwise than the scene; '' for nothing."""
        settings = self.settings
        generation = CB3 if int(facts["version"].split(".")[0]) < 5 else E_SERIES
        if generation != settings.generation:
            found = f"a {generation} (PolyScope {facts['version']})"
            return f"the arm is {found}, the scene says {settings.generation}"
        if settings.model and facts["model"] != settings.model:
            return f"the arm is a {facts['model']}, the scene says {settings.model}"
        apart = se3.log(se3.inverse(pose_of(facts["tcp_offset"])) @ pose_of(settings.tcp_offset))
        if (np.abs(apart) > _SAME).any():
            return f"its TCP offset is {facts['tcp_offset']}, the scene says {list(settings.tcp_offset)}"
        return self._wrong_payload(facts["payload"])

    def _wrong_payload(self, payload: float) -> str:
        if abs(payload - self.settings.payload) <= _SAME_PAYLOAD:
            return ""
        return f"its payload is {payload:g} kg, the scene says {self.settings.payload:g} kg"

    def _lose(self, reason: str) -> None:
        """The connection is gone, which the last state that there was tells once more."""
        with self._sending:
            if not self._fault:
                self._begin_fault(f"connection lost: {reason}")
            link, self._link = self._link, None
        with self._answered:
            self._answered.notify_all()
        if self._last is not None and self._open:
            self._report(replace(self._last, mode=self._fault_mode, reason=self._fault))
        if link is not None:
            link.end(_STOPS)

    def _reconnect(self) -> None:
        try:
            link = self._connected()
        except RuntimeError as error:
            with self._sending:
                self._fault = f"no connection to the arm: {error}"
            until = time.monotonic() + _RETRY
            while self._open and time.monotonic() < until:
                time.sleep(_LOOK)
        else:
            with self._sending:
                self._fault = "the connection to the arm was lost, and is back"
                self._link, self._heard = link, time.monotonic()


def _unfit(settings: UrSettings, limits: ArmLimits) -> str:
    """Why no arm can be driven with these settings, here; '' if one can."""
    if importlib.util.find_spec("rtde_control") is None:
        return "the Python package ur_rtde is missing: pip install ur-rtde"
    most = _RATES[settings.generation]
    if settings.loop_rate > most:
        return f"rate = {settings.rate:g} Hz: a {settings.generation} has at most {most:g} Hz"
    needed = _fastest(limits) * settings.watchdog / _OF_WATCHDOG
    if 0.0 < settings.deceleration < needed:
        return (
            f"deceleration = {settings.deceleration:g} m/s^2 and rad/s^2 does not stop the arm from "
            f"{limits.linear_velocity:g} m/s and {limits.angular_velocity:g} rad/s before the watchdog "
            f"({settings.watchdog:g} Hz) does; it has to be at least {needed:g}"
        )
    least = max(limits.linear_acceleration, limits.angular_acceleration)
    if 0.0 < settings.acceleration < least:
        return (
            f"acceleration = {settings.acceleration:g} m/s^2 and rad/s^2 is below the limits of the "
            f"commands, {limits.linear_acceleration:g} m/s^2 and {limits.angular_acceleration:g} rad/s^2: "
            f"the arm would lag behind them; it has to be at least {least:g}"
        )
    return ""


def _fastest(limits: ArmLimits) -> float:
    """The larger number of both speeds: one acceleration has to serve both.

    ur_rtde's program gives speedl and stopl no `aRot`, for which URScript then takes the number of the linear
    acceleration, in rad/s^2 (URScript manual, module motion: speedl, stopl).
    """
    return max(limits.linear_velocity, limits.angular_velocity)


def _with_accelerations(settings: UrSettings, limits: ArmLimits) -> UrSettings:
    """The settings with numbers for 0."""
    largest = max(limits.linear_acceleration, limits.angular_acceleration)
    stops = _fastest(limits) * max(1.0 / _STOPS_WITHIN, settings.watchdog / _OF_WATCHDOG)
    return settings.replaced(
        acceleration=settings.acceleration or _ABOVE * largest, deceleration=settings.deceleration or stops
    )


class _LinkProcess:
    """The process of `tactile_drivers.ur_link`, and the socket to it."""

    def __init__(self, wanted: dict[str, Any]) -> None:
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            command = [sys.executable, "-m", "tactile_drivers.ur_link", str(other.fileno())]
            self._process = subprocess.Popen(
                command, pass_fds=[other.fileno()], stdin=subprocess.DEVNULL, stdout=sys.stderr.fileno()
            )
        self.send(json.dumps(wanted).encode())

    def send(self, packet: bytes) -> None:
        """Send a packet, unless nobody takes them any more, of which its silence tells."""
        with contextlib.suppress(OSError):
            self._socket.send(packet, socket.MSG_DONTWAIT)

    def receive(self, timeout: float) -> bytes | None:
        """The next packet; None if there is none in time (s), b'' if there will be none."""
        if not select.select([self._socket], [], [], timeout)[0]:
            return None
        try:
            return self._socket.recv(65536)
        except OSError:
            return b""

    @property
    def waiting(self) -> bool:
        """Whether there is a packet."""
        return bool(select.select([self._socket], [], [], 0.0)[0])

    def end(self, patience: float = 1.5) -> None:
        """End the process, if it does not end by itself in that time (s)."""
        self._socket.close()
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _unpacked(packet: bytes) -> UrState:
    _, now_ns, stamp, *numbers = ur_link.STATE.unpack(packet)
    pose, speed, joints = np.array(numbers[:18]).reshape(3, 6)
    return UrState(now_ns, stamp, pose, speed, joints, *numbers[18:])
