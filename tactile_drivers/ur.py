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
import json
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_drivers import ur_link
from tactile_drivers.commanded_motion import CommandedMotion
from tactile_drivers.rotation_vectors import controlled_twist, pose_of, tool_speed
from tactile_drivers.ur_settings import CB3, E_SERIES, UrSettings, unfit, with_accelerations
from tactile_geometry import se3
from tactile_scene.arm import ArmState
from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]

_SAME = np.repeat([5e-4, 5e-3], 3)  # m, rad: TCPs that differ by less are the same
_SAME_PAYLOAD = 0.05  # kg
_GRACE = 1.3  # the link stops by itself this much later than the stage should have
_STOPS = 0.05  # s, for a link that says nothing any more to pass on a stop all the same
_RETRY = 1.0  # s, between attempts to connect again
_RECOVERY = 10.0  # s
_LOOK = 0.1  # s, between looks whether the driver is to be closed


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
        if wrong := unfit(settings, arm.limits):
            raise RuntimeError(wrong)
        settings = with_accelerations(settings, arm.limits)
        self.settings, self.kinematics, self._report = settings, arm.kinematics, report
        self._timeout = _GRACE * arm.limits.command_timeout
        self._T_tcp_controlled = arm.T_tool_controlled
        self._motion = CommandedMotion(settings.state_timeout)
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
            if self._motion.follow(twist):
                self._send_speed()

    def stop(self, reason: str) -> None:
        """Come to rest with the settings' deceleration; the next command moves the arm again."""
        with self._sending:
            self._motion.rest(reason)
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
            raise RuntimeError(self._motion.fault or "there is no connection to the arm")
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
            self._motion.recover()

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
        return self._motion.clock.drift

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
        motion = self._motion
        speed = tool_speed(self._last.T_base_controlled, self._T_tcp_controlled, motion.twist)
        self._link.send(ur_link.SPEED.pack(b"v", motion.commanded, *speed, self.settings.acceleration))

    # ---- states ----

    def _run(self) -> None:
        """Take what the link says, and have another one when it is lost."""
        while self._open:
            if self._link is None:
                self._reconnect()
                continue
            packet, patience = self._link.receive(self.settings.state_timeout), self._motion.patience
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

    def _take_state(self, state: UrState) -> None:
        motion = self._motion
        stamp_ns = motion.stamp(state.time, state.now_ns)
        fault = self._why_fault(state) or motion.lateness(time.time_ns())
        T = pose_of(state.pose) @ self._T_tcp_controlled
        twist = controlled_twist(T, self._T_tcp_controlled, state.speed)
        joints = state.joints if self.kinematics is not None else None
        with self._sending:
            if fault and not motion.fault:
                self._begin_fault(fault, state.safety)
            motion.expire(self._timeout)  # the link stops the arm by itself
            slow = state.scaling <= 0.999
            words = motion.words(f"speed scaling {100.0 * state.scaling:.0f} %" if slow else "")
            self._last = ArmState(stamp_ns, T, twist, motion.mode(twist), words, joints, float(state.scaling))
            if motion.moving and not motion.fault and motion.twist[3:].any():
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
        emergency = ur_link.SAFETY.get(safety, "").startswith("emergency stop")
        self._motion.begin_fault(reason, by_a_person=emergency)
        if self._link is not None:
            self._link.send(ur_link.STOP.pack(b"s", self.settings.deceleration))

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
            if not self._motion.fault:
                self._begin_fault(f"connection lost: {reason}")
            link, self._link = self._link, None
        with self._answered:
            self._answered.notify_all()
        if self._last is not None and self._open:
            self._report(replace(self._last, mode=self._motion.fault_mode, reason=self._motion.fault))
        if link is not None:
            link.end(_STOPS)

    def _reconnect(self) -> None:
        try:
            link = self._connected()
        except RuntimeError as error:
            with self._sending:
                self._motion.fault = f"no connection to the arm: {error}"
            until = time.monotonic() + _RETRY
            while self._open and time.monotonic() < until:
                time.sleep(_LOOK)
        else:
            with self._sending:
                self._motion.fault = "the connection to the arm was lost, and is back"
                self._link, self._heard = link, time.monotonic()


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
