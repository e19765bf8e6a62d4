"""UrController: a double of a Universal Robots controller, which speaks its protocols to any client.

RTDE on port 30004, the dashboard server on 29999 and the script interface on 30003 of an address, with a
simulated arm (`UrRobot`). Every controller needs an address of its own, 127.0.0.2 for instance, since clients
know the ports by heart. In a terminal it takes what may go wrong from its input, a line each::

    python -m tactile_doubles.ur_controller 127.0.0.2
    protective_stop
    slow 0.05

Each line is answered with one of JSON: what was asked for, or the controller's time (s) at which it was done.
`UrController.faults` has the names.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import struct
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tactile_doubles import rtde
from tactile_doubles.double_process import answer_to, be_in_time
from tactile_doubles.ur_robot import NORMAL, UrRobot, UrRobotSettings
from tactile_drivers.rotation_vectors import vector_of

DASHBOARD, SCRIPT, RTDE = 29999, 30003, 30004
_GREETING = "Connected: Universal Robots Dashboard Server\n"
_BACKLOG = 65536  # bytes; a client that does not read is left behind, as a controller does
_ENDS = (OSError, EOFError, struct.error, asyncio.CancelledError)  # how a connection ends
_LONGEST_LAG = 0.05  # s; further behind, several cycles are made up for at once


class UrController:
    """Servers and arm of one controller; `run` serves until it is cancelled.

    Attributes
    ----------
    robot : UrRobot
    follow : callable or None
        Called after each cycle of the control loop.
    """

    def __init__(self, host: str, settings: UrRobotSettings | None = None) -> None:
        self.host, self.robot = host, UrRobot(settings)
        self.follow: Callable[[], None] | None = None
        self._sessions: set[_Session] = set()
        self._servers: list[asyncio.Server] = []
        self._protocols: tuple[int, ...] = (1, 2)
        self._in_use = False
        self._scripts = True
        self.delay = 0.0  # s, of all that RTDE sends
        self.loss = 0.0  # part of data packages that are not sent
        self.torn = self.garbled = self.silent = False
        self.rng = np.random.default_rng(1)

    @property
    def faults(self) -> dict[str, Callable[..., Any]]:
        """What may go wrong, by name."""
        robot = self.robot
        return {
            "protective_stop": robot.protective_stop,
            "emergency_stop": robot.emergency_stop,
            "safeguard_stop": robot.safeguard_stop,
            "restore": robot.restore,  # as a person does at the pendant
            "stop_program": robot.stop_program,
            "stuck_program": lambda on=1.0: setattr(robot, "stuck", bool(on)),
            "teach_button": lambda on=1.0: setattr(robot, "teach_button", bool(on)),
            "speed_slider": lambda part: setattr(robot, "speed_slider", part),
            "local_control": lambda on=1.0: setattr(robot, "remote_control", not on),
            "payload": lambda mass: setattr(robot, "payload", mass),
            "tcp_offset": lambda *offset: setattr(robot, "tcp_offset", list(offset)),
            "clock": lambda seconds: setattr(robot, "time", robot.time + seconds),
            "jump": lambda x: robot.T_base_tcp.__setitem__((0, 3), robot.T_base_tcp[0, 3] + x),
            "scripts_ignored": lambda on=1.0: setattr(self, "_scripts", not on),
            "old_protocol": lambda on=1.0: setattr(self, "_protocols", (1,) if on else (1, 2)),
            "registers_in_use": lambda on=1.0: setattr(self, "_in_use", bool(on)),
            "slow": lambda seconds: setattr(self, "delay", seconds),
            "loss": lambda part: setattr(self, "loss", part),
            "torn": lambda on=1.0: setattr(self, "torn", bool(on)),
            "garbled": lambda on=1.0: setattr(self, "garbled", bool(on)),
            "silence": lambda on=1.0: setattr(self, "silent", bool(on)),
            "drop": self.drop,
            "leave": self.leave,
            "come_back": self.come_back,
            "trace": self.trace,
            "now": self.now,
        }

    def trace(self) -> list[list[Any]]:
        """What the arm did since the last time it was asked, see `UrRobot.trace`."""
        taken = [[time, *(row.tolist() for row in rows)] for time, *rows in self.robot.trace]
        self.robot.trace.clear()
        return taken

    def now(self) -> tuple[int, list[float], list[float], bool]:
        """Our time (ns), pose and speed (6,) of the TCP in the base, and whether safety has stopped it."""
        robot = self.robot
        pose, speed = vector_of(robot.T_base_tcp).tolist(), robot.speed.tolist()
        return time.time_ns(), pose, speed, robot.safety_mode != NORMAL

    async def run(self) -> None:
        """Serve, and move the arm in real time."""
        await self.come_back()
        loop = asyncio.get_running_loop()
        due = loop.time()
        try:
            while True:
                due += self.robot.period
                await asyncio.sleep(due - loop.time())
                if (lag := loop.time() - due) > _LONGEST_LAG:
                    self.robot.pass_over(lag)
                    due += lag
                self.robot.step()
                if self.follow is not None:
                    self.follow()
                for session in list(self._sessions):
                    session.tell()
        finally:
            self.leave()

    async def come_back(self) -> None:
        """Listen, if that is not done already."""
        if not self._servers:
            for port, serve in ((RTDE, self._rtde), (DASHBOARD, self._dashboard), (SCRIPT, self._script)):
                self._servers.append(await asyncio.start_server(serve, self.host, port))

    def leave(self) -> None:
        """Close all connections and listen no more, as a controller that is switched off."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        self.drop()

    def drop(self) -> None:
        """Close the connections of RTDE; clients may come again."""
        for session in list(self._sessions):
            session.close()

    async def _rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        session = _Session(self, writer)
        self._sessions.add(session)
        with contextlib.suppress(*_ENDS):
            while True:
                size, kind = rtde.HEADER.unpack(await reader.readexactly(rtde.HEADER.size))
                payload = await reader.readexactly(max(0, size - rtde.HEADER.size))
                if not self.silent:
                    session.take(kind, payload)
        session.close()

    async def _dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(_GREETING.encode())
        with contextlib.suppress(*_ENDS):
            while line := await reader.readline():
                if not self.silent:
                    writer.write(f"{self.robot.answer(line.decode(errors='replace'))}\n".encode())
        writer.close()

    async def _script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """A program that comes is taken for that of ur_rtde, without a look at what it says."""
        with contextlib.suppress(*_ENDS):
            while line := await reader.readline():
                if line.strip() == b"end" and self._scripts and not self.silent:
                    self.robot.start_program()
        writer.close()


class _Session:
    """A client of RTDE."""

    def __init__(self, controller: UrController, writer: asyncio.StreamWriter) -> None:
        self._controller, self._writer = controller, writer
        self._protocol, self._started, self._every, self._cycles = 1, False, 1, 0
        self._rest = b""
        self._output: rtde.Recipe | None = None
        self._inputs: dict[int, rtde.Recipe] = {}

    def take(self, kind: int, payload: bytes) -> None:
        """A package of the client; raises `struct.error` for one that cannot be."""
        if kind == rtde.DATA:
            recipe = self._inputs[payload[0]] if payload and payload[0] in self._inputs else None
            if recipe is not None and recipe.known:
                self._controller.robot.write(recipe.unpack(payload[1:]))
        elif (answer := self._answer(kind, payload)) is not None:
            self._send(rtde.package(kind, answer))

    def _answer(self, kind: int, payload: bytes) -> bytes | None:
        if kind == rtde.VERSION:
            (wanted,) = struct.unpack(">H", payload)
            accepted = wanted in self._controller._protocols
            self._protocol = wanted if accepted else self._protocol
            return bytes([accepted])
        if kind == rtde.CONTROLLER:
            return struct.pack(">4I", *self._controller.robot.settings.version)
        if kind == rtde.OUTPUTS:
            return self._set_outputs(payload)
        if kind == rtde.INPUTS:
            return self._set_inputs(payload)
        if kind in (rtde.START, rtde.PAUSE):
            self._started = kind == rtde.START and self._output is not None and self._output.known
            return bytes([self._started or kind == rtde.PAUSE])
        return None

    def _set_outputs(self, payload: bytes) -> bytes:
        rate, numbered = self._controller.robot.settings.rate, self._protocol >= 2
        wanted = struct.unpack(">d", payload[:8])[0] if numbered else rate
        self._every = max(1, round(rate / wanted)) if wanted > 0 else 1
        self._output = rtde.Recipe(1, _names(payload[8:] if numbered else payload), rtde.OUTPUT_TYPES)
        types = ",".join(self._output.types).encode()
        return bytes([1]) + types if numbered else types

    def _set_inputs(self, payload: bytes) -> bytes:
        recipe = rtde.Recipe(len(self._inputs) + 1, _names(payload), rtde.INPUT_TYPES)
        if self._controller._in_use:
            recipe.types = ["IN_USE"] * len(recipe.names)
            return bytes([0]) + ",".join(recipe.types).encode()
        self._inputs[recipe.number] = recipe
        return bytes([recipe.number * recipe.known]) + ",".join(recipe.types).encode()

    def tell(self) -> None:
        """Send the state of the arm, if it is time."""
        controller = self._controller
        self._cycles += 1
        if not self._started or self._output is None or self._cycles % self._every or controller.silent:
            return
        if controller.loss and controller.rng.random() < controller.loss:
            return
        data = self._output.pack(controller.robot.outputs())
        if controller.garbled:
            data = controller.rng.bytes(len(data))
        self._send(data)

    def _send(self, data: bytes) -> None:
        controller, loop = self._controller, asyncio.get_running_loop()
        if controller.torn:  # in two pieces, the second later than the first
            half = len(data) // 2
            self._flush()
            self._write(data[:half])
            self._rest = data[half:]
            loop.call_later(controller.robot.period / 2, self._flush)
        elif controller.delay:
            loop.call_later(controller.delay, self._write, data)
        else:
            self._flush()
            self._write(data)

    def _flush(self) -> None:
        """Send what is left of a package."""
        self._write(self._rest)
        self._rest = b""

    def _write(self, data: bytes) -> None:
        transport = self._writer.transport
        if transport.is_closing():
            return
        if transport.get_write_buffer_size() > _BACKLOG:
            self.close()
        else:
            self._writer.write(data)

    def close(self) -> None:
        """End the connection at once."""
        self._controller._sessions.discard(self)
        self._writer.transport.abort()


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode("ascii", errors="replace").split(",") if name]


async def _serve(controller: UrController) -> None:
    """The controller, and what is asked of it on standard input, until that ends."""
    await controller.come_back()  # an address that cannot be had ends it before it is ready
    moving = asyncio.create_task(controller.run())
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    print(json.dumps("ready"), flush=True)
    while line := await reader.readline():
        answer = answer_to(line.decode(), controller.faults)
        answer = await answer if asyncio.iscoroutine(answer) else answer
        answer = controller.robot.time if answer is None else answer
        print(json.dumps(answer), flush=True)
    moving.cancel()


def main() -> int:
    """Serve until standard input ends; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("host", help="address to listen at")
    parser.add_argument("settings", nargs="?", default="{}", help="settings of the arm (JSON)")
    arguments = parser.parse_args()
    controller = UrController(arguments.host, UrRobotSettings.from_mapping(json.loads(arguments.settings)))
    be_in_time()
    try:
        asyncio.run(_serve(controller))
    except OSError as error:
        print(f"{arguments.host}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
