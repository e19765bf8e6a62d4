"""The process that holds ur_rtde for `tactile_drivers.ur`: states of the arm out, speeds and stops in.

ur_rtde waits as long as it likes, keeps Python's lock while it connects, and ends the process when a
connection ends at a bad moment. So it has a process of its own, which its driver can end and start anew,
while the watchdog on the arm's controller brings the arm to rest. Messages pass a socket of whole packets:
the first byte says which, and the formats stand here for both sides.

What is asked for holds for a while only: a speed that has grown old without another one is followed by a
stop, whether the driver hangs or its process is gone.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from typing import Any

# driver -> link
SPEED = struct.Struct("=cd6dd")  # b"v", time of the command (monotonic, s), speed in the base, acceleration
STOP = struct.Struct("=cd")  # b"s", deceleration
RECOVER, CLOSE = b"r", b"q"
# link -> driver
STATE = struct.Struct("=cq d6d6d6d iiII d d")  # b"x", and the fields of `UrState`
ANSWER = b"a"  # and a text; empty: done

VARIABLES = (
    "timestamp", "actual_TCP_pose", "actual_TCP_speed", "actual_q", "robot_mode", "safety_mode",
    "robot_status_bits", "runtime_state", "target_speed_fraction", "speed_scaling", "payload",
)  # fmt: skip
NORMAL, REDUCED, PROTECTIVE_STOP = 1, 2, 3  # safety modes
RUNNING = 7  # robot mode
PROGRAM_RUNNING, TEACH_BUTTON = 2, 4  # bits of the robot's status
SAFETY = {
    3: "protective stop", 4: "recovery mode", 5: "safeguard stop", 6: "emergency stop of the cell",
    7: "emergency stop", 8: "safety violation", 9: "safety fault",
}  # fmt: skip
_DEAF = 0.6  # of the silence of states that is a lost connection
_LATE = 0.8  # of a period: then the next state is looked for
_LOOK = 0.0002  # s, between looks
_HANGS = 10  # s without a look at the driver, after which this process ends itself
_START = 5.0  # s, for the program to start
_LEAVE = 2.0  # s, for the arm to leave a protective stop

#: What ur_rtde says, and what the user should read instead.
_WORDS = (
    ("remote control", "the arm is in local control; switch it to remote control at the pendant"),
    ("already in use", "its registers are in use by a fieldbus; set driver_settings.upper_registers"),
    (
        "start control script",
        "it does not start the program; is the arm powered on, with its brakes released?",
    ),
    (
        "unlock protective stop until",
        "a protective stop can be left 5 s after it at the earliest: look for its cause, then reset again",
    ),
    ("dashboard server", "its dashboard server (port 29999) does not answer"),
    ("Could not connect", "it does not answer on port 30004 (RTDE)"),
)


def main() -> None:
    """Connect as the first message says, then serve until the driver closes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # its driver says when, also where all are asked to end at once
    with socket.socket(fileno=int(sys.argv[1])) as link:
        wanted = json.loads(link.recv(65536))
        signal.alarm(int(wanted["connect_timeout"]) + _HANGS)  # the kernel ends it, whoever holds the lock
        try:
            serving = _Link(link, wanted)
        except (OSError, RuntimeError, ValueError) as error:
            _say(link, ANSWER + in_words(error).encode())
        else:
            _say(link, ANSWER + json.dumps(serving.facts).encode())
            serving.serve()
        sys.stderr.flush()
        os._exit(0)  # the destructors of ur_rtde wait a second, and fail where a connection was lost


def _say(link: socket.socket, packet: bytes) -> None:
    """Send a packet to the driver, if it is there and listens."""
    with contextlib.suppress(OSError):
        link.send(packet, socket.MSG_DONTWAIT)


def in_words(error: Exception) -> str:
    """What an error of ur_rtde means."""
    text = str(error)
    return next((words for part, words in _WORDS if part.lower() in text.lower()), text or repr(error))


class _Link:
    """ur_rtde, connected, with its program on the controller and that one's watchdog set."""

    def __init__(self, link: socket.socket, wanted: dict[str, Any]) -> None:
        from dashboard_client import DashboardClient
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface

        self._socket, self._wanted = link, wanted
        host, rate = wanted["host"], wanted["rate"]
        self._dashboard = DashboardClient(host)
        self._dashboard.connect(2000)
        version = self._dashboard.polyscopeVersion()
        if not version[:1].isdigit():
            raise RuntimeError(f"its dashboard server tells no version of PolyScope: {version}")
        upper = wanted["upper_registers"]
        self._receive = RTDEReceiveInterface(host, rate, list(VARIABLES), False, upper)
        self._check_ready()
        flags = RTDEControlInterface.FLAG_UPLOAD_SCRIPT
        if upper:
            flags |= RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
        self._control = RTDEControlInterface(host, rate, flags)
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            # the threads that ur_rtde has by now go before this one, which spins while it waits for them
            ahead = os.sched_getparam(0).sched_priority
            os.sched_setparam(0, os.sched_param(max(1, ahead - 1)))
        self._watch()
        self._version = version
        self.facts = self._facts()
        self._open, self._moving, self._written = True, False, time.monotonic()
        self._commanded, self._heard = 0.0, time.monotonic()

    def _facts(self) -> dict[str, Any]:
        """What the controller says of its arm, which somebody may change at the pendant."""
        return {
            "version": self._version,
            "model": self._dashboard.getRobotModel(),
            "tcp_offset": self._control.getTCPOffset(),
            "payload": self._receive.getPayload(),
        }

    # ---- states ----

    def _tell_states(self) -> None:
        """Send each new state, as soon as ur_rtde has it."""
        period, last, receive = 1.0 / self._wanted["rate"], 0.0, self._receive
        while self._open:
            stamp = receive.getTimestamp()
            if not receive.isConnected():
                os._exit(1)  # before ur_rtde connects anew, and starts a program that no watchdog minds
            if stamp == last:
                time.sleep(_LOOK)
                continue
            now_ns = time.time_ns()
            fields = (
                *receive.getActualTCPPose(), *receive.getActualTCPSpeed(), *receive.getActualQ(),
                receive.getRobotMode(), receive.getSafetyMode(), receive.getRobotStatus(),
                receive.getRuntimeState(), receive.getTargetSpeedFraction() * receive.getSpeedScaling(),
                receive.getPayload(),
            )  # fmt: skip
            if receive.getTimestamp() != stamp:
                continue  # the next one came in between: these may be of both
            last, self._heard = stamp, time.monotonic()
            _say(self._socket, STATE.pack(b"x", now_ns, stamp, *fields))
            time.sleep(_LATE * period)

    # ---- commands ----

    def serve(self) -> None:
        """Follow what is asked for until the driver closes the link."""
        threading.Thread(target=self._tell_states, daemon=True).start()
        rest = 0.25 / self._wanted["watchdog"]
        try:
            while self._open:
                signal.alarm(_HANGS)
                if select.select([self._socket], [], [], rest)[0]:
                    self._take(self._newest())
                if self._moving and time.monotonic() - self._commanded > self._wanted["command_timeout"]:
                    self._halt(self._wanted["deceleration"])
                if time.monotonic() - self._written > rest and not self._deaf:
                    self._control.kickWatchdog()
                    self._written = time.monotonic()
        finally:
            self._halt(self._wanted["deceleration"])
            self._control.stopScript()

    @property
    def _deaf(self) -> bool:
        """Whether states are missing in motion: then the controller's watchdog is left to stop the arm."""
        return self._moving and time.monotonic() - self._heard > _DEAF * float(self._wanted["state_timeout"])

    def _newest(self) -> bytes:
        """The message to follow: of speeds and stops the last, but nothing else is passed over."""
        try:
            message = self._socket.recv(4096)
            while message[:1] in (b"v", b"s") and select.select([self._socket], [], [], 0.0)[0]:
                message = self._socket.recv(4096)
        except OSError:
            return CLOSE  # the driver is gone
        return message

    def _take(self, message: bytes) -> None:
        kind = message[:1]
        if kind == b"v":
            if self._deaf:
                return
            _, self._commanded, *speed, acceleration = SPEED.unpack(message)
            self._control.speedL(speed, acceleration, 1.0 / self._wanted["rate"])
            self._moving, self._written = any(speed), time.monotonic()
        elif kind == b"s":
            self._halt(STOP.unpack(message)[1])
        elif kind == RECOVER:
            try:
                self._recover()
                _say(self._socket, ANSWER + json.dumps(self._facts()).encode())
            except (OSError, RuntimeError, ValueError) as error:
                _say(self._socket, ANSWER + in_words(error).encode())
        else:  # asked to end, or the driver is gone
            self._open = False

    def _halt(self, deceleration: float) -> None:
        self._control.speedStop(deceleration)
        self._moving, self._written = False, time.monotonic()

    def _recover(self) -> None:
        """Leave a protective stop, and have the program run again; `RuntimeError` says why that cannot be."""
        if self._receive.getSafetyMode() == PROTECTIVE_STOP:
            self._dashboard.unlockProtectiveStop()
            until = time.monotonic() + _LEAVE
            while self._receive.getSafetyMode() == PROTECTIVE_STOP and time.monotonic() < until:
                time.sleep(0.02)
        self._check_ready()
        self._control.reuploadScript()
        until = time.monotonic() + _START
        while not (self._control.isProgramRunning() and self._receive.getRobotStatus() & PROGRAM_RUNNING):
            if time.monotonic() > until:
                raise RuntimeError("start control script")
            time.sleep(0.01)
        self._watch()

    def _watch(self) -> None:
        """Have the controller stop the program when it hears nothing any more."""
        if not self._control.setWatchdog(self._wanted["watchdog"]):
            raise RuntimeError("the controller's watchdog cannot be set")

    def _check_ready(self) -> None:
        """Raise `RuntimeError` unless the arm can move."""
        if why := why_not(
            self._receive.getSafetyMode(), self._receive.getRobotMode(), self._receive.getRobotStatus()
        ):
            raise RuntimeError(why)


def why_not(safety: int, mode: int, status: int) -> str:
    """Why an arm in these modes may not move; '' if it may."""
    if safety not in (NORMAL, REDUCED):
        return f"{SAFETY.get(safety, f'safety mode {safety}')} of the arm"
    if mode != RUNNING:
        return "the arm is not running: power it on and release its brakes at the pendant"
    if status & TEACH_BUTTON:
        return "the arm is moved by hand (freedrive)"
    return ""


if __name__ == "__main__":
    main()
