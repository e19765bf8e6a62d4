"""Packages of RTDE, the Real-Time Data Exchange of Universal Robots' controllers, as a controller sees them.

A package is its size (2 bytes, with the header), its type (one letter), and what that type holds; numbers are
big-endian. Source: "Real-Time Data Exchange (RTDE) Guide", Universal Robots, sections "Data types" and
"RTDE packages".
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

HEADER = struct.Struct(">HB")
VERSION, CONTROLLER, OUTPUTS, INPUTS, START, PAUSE, DATA = b"VvOISPU"

#: Formats of the types that variables have.
FORMATS = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip

#: Types of the variables that a controller tells; registers are added below.
OUTPUT_TYPES = {
    "timestamp": "DOUBLE", "actual_execution_time": "DOUBLE",
    **dict.fromkeys(("target_q", "target_qd", "target_qdd", "target_current", "target_moment"), "VECTOR6D"),
    **dict.fromkeys(("actual_q", "actual_qd", "actual_current", "joint_control_output"), "VECTOR6D"),
    **dict.fromkeys(("actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force"), "VECTOR6D"),
    **dict.fromkeys(("target_TCP_pose", "target_TCP_speed", "tcp_offset", "payload_inertia"), "VECTOR6D"),
    **dict.fromkeys(("actual_joint_voltage", "joint_temperatures", "ft_raw_wrench"), "VECTOR6D"),
    **dict.fromkeys(("actual_tool_accelerometer", "payload_cog"), "VECTOR3D"),
    **dict.fromkeys(("actual_digital_input_bits", "actual_digital_output_bits"), "UINT64"),
    **dict.fromkeys(("runtime_state", "robot_status_bits", "safety_status_bits"), "UINT32"),
    **dict.fromkeys(("robot_mode", "safety_mode", "safety_status"), "INT32"),
    "joint_mode": "VECTOR6INT32",
    **dict.fromkeys(("speed_scaling", "target_speed_fraction", "actual_momentum", "payload"), "DOUBLE"),
    **dict.fromkeys(("actual_main_voltage", "actual_robot_voltage", "actual_robot_current"), "DOUBLE"),
    **{f"standard_analog_{way}put{i}": "DOUBLE" for way in ("in", "out") for i in range(2)},
    **{f"output_int_register_{i}": "INT32" for i in range(48)},
    **{f"output_double_register_{i}": "DOUBLE" for i in range(48)},
}  # fmt: skip

#: Types of the variables that a client may write.
INPUT_TYPES = {
    **{f"input_int_register_{i}": "INT32" for i in range(48)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(48)},
    "external_force_torque": "VECTOR6D",
}


def package(kind: int, payload: bytes = b"") -> bytes:
    """A package of a type with its header."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


class Recipe:
    """Which variables a data package holds, in which order.

    Attributes
    ----------
    names, types : list of str
        A variable that is not known has the type "NOT_FOUND".
    """

    def __init__(self, number: int, names: Sequence[str], known: Mapping[str, str]) -> None:
        self.number, self.names = number, list(names)
        self.types = [known.get(name, "NOT_FOUND") for name in names]
        self._layout = struct.Struct(">" + "".join(FORMATS.get(kind, "") for kind in self.types))

    @property
    def known(self) -> bool:
        """Whether all its variables are."""
        return "NOT_FOUND" not in self.types

    def pack(self, values: Mapping[str, Any]) -> bytes:
        """The data package of these values; what is not among them is zero."""
        numbers: list[Any] = []
        for name, kind in zip(self.names, self.types, strict=True):
            count = int(FORMATS[kind][:-1] or 1)
            value = values.get(name, 0 if count == 1 else (0,) * count)
            numbers.extend([value] if count == 1 else value)
        return package(DATA, bytes([self.number]) + self._layout.pack(*numbers))

    def unpack(self, payload: bytes) -> dict[str, Any]:
        """Values by name, from what follows the recipe's number; raises `struct.error` if it does not fit."""
        numbers = iter(self._layout.unpack(payload))
        values = {}
        for name, kind in zip(self.names, self.types, strict=True):
            count = int(FORMATS[kind][:-1] or 1)
            values[name] = next(numbers) if count == 1 else [next(numbers) for _ in range(count)]
        return values
