"""How one speaks to the second controller: RTDE, the dashboard, and the ports that programs arrive on.

RTDE and Dashboard in comments are the guides that `ur_second_controller` names.
"""

import contextlib
import multiprocessing
import os
import re
import selectors
import socket
import struct
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from ur_second_controller import STEP, VERSION, Controller

RTDE_PORT, DASHBOARD_PORT = 30004, 29999
SCRIPT_PORTS = 30001, 30002, 30003  # URScript, Remote Control via TCP/IP
BEHIND = 10  # steps that are made up for at once; what is more has not been
PROGRAM = re.compile(rb"\s*(def .*?\nend[ \t]*\n|(?!\s*def )[^\n]+\n)", re.DOTALL)

# RTDE, Data types, and Robot controller inputs and outputs.
FORMATS = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d", "VECTOR3D": "3d",
    "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip
OUTPUTS = {
    **dict.fromkeys(
        ["timestamp", "actual_execution_time", "speed_scaling", "target_speed_fraction", "actual_momentum",
         "actual_main_voltage", "actual_robot_voltage", "actual_robot_current", "standard_analog_input0",
         "standard_analog_input1", "standard_analog_output0", "standard_analog_output1", "payload"],
        "DOUBLE",
    ),
    **dict.fromkeys(
        ["target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd",
         "actual_current", "joint_control_output", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force",
         "target_TCP_pose", "target_TCP_speed", "joint_temperatures", "actual_joint_voltage", "ft_raw_wrench",
         "payload_inertia", "tcp_offset"],
        "VECTOR6D",
    ),
    **dict.fromkeys(
        ["actual_tool_accelerometer", "payload_cog", "elbow_position", "elbow_velocity"], "VECTOR3D"
    ),
    **dict.fromkeys(["robot_mode", "safety_mode", "safety_status"], "INT32"),
    **dict.fromkeys(["runtime_state", "robot_status_bits", "safety_status_bits"], "UINT32"),
    **dict.fromkeys(["actual_digital_input_bits", "actual_digital_output_bits"], "UINT64"),
    "joint_mode": "VECTOR6INT32",
    **{f"output_int_register_{i}": "INT32" for i in range(48)},
    **{f"output_double_register_{i}": "DOUBLE" for i in range(48)},
}  # fmt: skip
INPUTS = {
    **{f"input_int_register_{i}": "INT32" for i in range(48)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(48)},
    "speed_slider_mask": "UINT32", "speed_slider_fraction": "DOUBLE", "external_force_torque": "VECTOR6D",
    **dict.fromkeys(
        ["standard_digital_output_mask", "standard_digital_output", "configurable_digital_output_mask",
         "configurable_digital_output", "tool_digital_output_mask", "tool_digital_output",
         "standard_analog_output_mask", "standard_analog_output_type"],
        "UINT8",
    ),
    "standard_analog_output_0": "DOUBLE", "standard_analog_output_1": "DOUBLE",
}  # fmt: skip


class Link:
    """A connection: bytes that came and are not a whole message yet, and bytes that wait to be sent."""

    def __init__(self, connection: socket.socket):
        self.socket = connection
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.came, self.waiting = b"", b""

    def read(self) -> bool:
        """Take what came; false where the client has gone."""
        try:
            new = self.socket.recv(65536)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self.came += new
        return bool(new)

    def send(self, data: bytes = b"") -> None:
        """Send as much as the client takes, and the rest before anything else."""
        self.waiting += data
        with contextlib.suppress(OSError):
            self.waiting = self.waiting[self.socket.send(self.waiting) :]


class RtdeLink(Link):
    """A client of RTDE."""

    def __init__(self, connection: socket.socket, controller: Controller, others: list["RtdeLink"]):
        super().__init__(connection)
        self._controller, self._others = controller, others
        self._outputs: list[str] = []
        self._layout, self._every, self._started = struct.Struct(">"), 1, False
        self._recipes: dict[int, list[str]] = {}
        self._replies = {
            "V": self._version, "v": lambda _: struct.pack(">4I", *VERSION), "O": self._set_outputs,
            "I": self._set_inputs, "S": partial(self._start, True), "P": partial(self._start, False),
        }  # fmt: skip

    def handle(self) -> None:
        """Answer the packages that have come whole: size with header (uint16), type (uint8), payload."""
        while len(self.came) >= 3 and len(self.came) >= (size := struct.unpack(">H", self.came[:2])[0]):
            kind, payload = chr(self.came[2]), self.came[3:size]
            self.came = self.came[size:]
            if kind == "U":
                self._data(payload)
            elif kind in self._replies:
                self._package(kind, self._replies[kind](payload))

    def publish(self) -> None:
        """RTDE, Key features: packages that a client has no room for are left out."""
        if not self._started or self._controller.steps % self._every:
            return
        if self.waiting:
            self.send()
            return
        state, values = self._controller.state(), []
        for name in self._outputs:
            several = int(FORMATS[OUTPUTS[name]][:-1] or 0)
            value = state.get(name, [0] * several if several else 0)
            values.extend(value if several else [value])
        self._package("U", b"\x01" + self._layout.pack(*values))

    def claimed(self) -> set[str]:
        """Inputs that no other client may write."""
        return {name for names in self._recipes.values() for name in names}

    def _package(self, kind: str, payload: bytes) -> None:
        self.send(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def _version(self, payload: bytes) -> bytes:
        return bytes([payload == b"\x00\x02"])

    def _set_outputs(self, payload: bytes) -> bytes:
        frequency = struct.unpack(">d", payload[:8])[0]
        names = _names(payload[8:])
        kinds = [OUTPUTS.get(name, "NOT_FOUND") for name in names]
        if "NOT_FOUND" in kinds:
            return b"\x00" + ",".join(kinds).encode()
        self._outputs, self._every = names, max(1, round(1.0 / (frequency * STEP)))
        self._layout = struct.Struct(">" + "".join(FORMATS[kind] for kind in kinds))
        return b"\x01" + ",".join(kinds).encode()

    def _set_inputs(self, payload: bytes) -> bytes:
        names = _names(payload)
        taken = set().union(*(other.claimed() for other in self._others if other is not self))
        kinds = ["IN_USE" if name in taken else INPUTS.get(name, "NOT_FOUND") for name in names]
        recipe = 0
        if not {"IN_USE", "NOT_FOUND"} & set(kinds):
            recipe = len(self._recipes) + 1
            self._recipes[recipe] = names
        return bytes([recipe]) + ",".join(kinds).encode()

    def _start(self, started: bool, _: bytes) -> bytes:
        self._started = started
        return b"\x01"

    def _data(self, payload: bytes) -> None:
        offset = 1
        for name in self._recipes.get(payload[0], ()):
            layout = ">" + FORMATS[INPUTS[name]]
            values = struct.unpack_from(layout, payload, offset)
            offset += struct.calcsize(layout)
            self._controller.inputs[name] = values[0] if len(values) == 1 else list(values)
            self._controller.heard[name] = self._controller.now


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode().split(",") if name]


class Server:
    """All that a controller listens on, in one thread: between two steps nothing happens."""

    def __init__(self, host: str, orders: Connection):
        self._controller, self._orders = Controller(), orders
        self._selector = selectors.DefaultSelector()
        self._links: list[Link] = []
        self._rtde: list[RtdeLink] = []
        self._heard: dict[socket.socket, Callable[[], None]] = {}
        self._deaf = False
        self._open = True
        self._selector.register(orders, selectors.EVENT_READ, self._order)
        self._listen(host, RTDE_PORT, self._rtde_client)
        self._listen(host, DASHBOARD_PORT, self._dashboard_client)
        for port in SCRIPT_PORTS:
            self._listen(host, port, self._script_client)

    def run(self) -> None:
        """Serve until told to end."""
        due = time.monotonic()
        self._orders.send("ready")
        while self._open:
            for key, _ in self._selector.select(max(0.0, due - time.monotonic())):
                key.data()
            if (late := time.monotonic() - due) < 0.0:
                continue
            self._controller.step()
            if not self._deaf:
                for link in self._rtde:
                    link.publish()
            if late > BEHIND * STEP:
                self._controller.held_up += late
                due += late
            due += STEP

    def _listen(self, host: str, port: int, client: Callable[[socket.socket], None]) -> None:
        listening = socket.create_server((host, port))

        def accept() -> None:
            client(listening.accept()[0])

        self._hear(listening, accept)

    def _hear(self, connection: socket.socket, handle: Callable[[], None]) -> None:
        self._heard[connection] = handle
        self._selector.register(connection, selectors.EVENT_READ, handle)

    def _serve(self, link: Link, handle: Callable[[], None]) -> None:
        self._links.append(link)

        def readable() -> None:
            if link.read():
                handle()
            else:
                self._leave(link)

        self._hear(link.socket, readable)

    def _leave(self, link: Link) -> None:
        self._selector.unregister(link.socket)
        del self._heard[link.socket]
        link.socket.close()
        self._links.remove(link)
        if link in self._rtde:
            self._rtde.remove(link)

    def _rtde_client(self, connection: socket.socket) -> None:
        link = RtdeLink(connection, self._controller, self._rtde)
        self._rtde.append(link)
        self._serve(link, link.handle)

    def _dashboard_client(self, connection: socket.socket) -> None:
        link = Link(connection)
        link.send(b"Connected: Universal Robots Dashboard Server\n")

        def handle() -> None:
            *lines, link.came = link.came.split(b"\n")
            for line in lines:
                link.send(self._controller.answer(line.decode()).encode() + b"\n")

        self._serve(link, handle)

    def _script_client(self, connection: socket.socket) -> None:
        """These ports send the arm's state as well, which nobody who is tested here reads."""
        link = Link(connection)

        def handle() -> None:
            while found := PROGRAM.match(link.came):
                link.came = link.came[found.end() :]
                self._controller.take(found[1].decode())

        self._serve(link, handle)

    # What a test says and asks.

    def _order(self) -> None:
        name, *values = self._orders.recv()
        self._orders.send(getattr(self, f"_do_{name}")(*values))

    def _do_controller(self, name: str, *values: Any) -> None:
        getattr(self._controller, name)(*values)

    def _do_now(self) -> float:
        return self._controller.now

    def _do_log(self) -> tuple[list, list]:
        """What happened since the last time: rows of the trace, and calls."""
        taken = self._controller.trace, self._controller.calls
        self._controller.trace, self._controller.calls = [], []
        return taken

    def _do_deaf(self, deaf: bool) -> None:
        """The cable is out: nothing is heard, nothing said, nobody told."""
        self._deaf = deaf
        for connection, handle in self._heard.items():
            if deaf:
                self._selector.unregister(connection)
            else:
                self._selector.register(connection, selectors.EVENT_READ, handle)

    def _do_hang_up(self) -> None:
        """All connections are closed."""
        for link in list(self._links):
            self._leave(link)

    def _do_end(self) -> None:
        self._open = False


def serve(host: str, orders: Connection) -> None:
    """Be a controller at an address of this machine; what runs in the process of its own."""
    with contextlib.suppress(PermissionError):  # steps that come late are none that a controller has
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    Server(host, orders).run()


class SecondController:
    """The controller in a process of its own, as a test holds it."""

    def __init__(self, host: str):
        self.host = host
        context = multiprocessing.get_context("spawn")
        self._orders, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(host, theirs), daemon=True)
        self._process.start()
        assert self._orders.recv() == "ready"

    def ask(self, name: str, *values: Any) -> Any:
        """Have the server do something."""
        self._orders.send((name, *values))
        return self._orders.recv()

    def work(self, seconds: float) -> None:
        """Wait until the controller has been at work for so long, which a machine can hold up."""
        end = self.ask("now") + seconds
        while self.ask("now") < end:
            time.sleep(0.01)

    def log(self) -> tuple[np.ndarray, list[list]]:
        """Rows of time, pose (6) and twist (6), (n, 13), and calls, since the last time."""
        trace, calls = self.ask("log")
        return np.array(trace).reshape(-1, 13), calls

    def close(self) -> None:
        self.ask("end")
        self._process.join(10)
