"""FrankaController: a double of a Franka's controller, which speaks its control interface to any client.

The protocol is that of franky-sim's server, on port 1337 of an address; behind it is a simulated arm
(`FrankaRobot`). Every controller needs an address of its own, 127.0.0.2 for instance, since clients know the
port by heart. In a terminal it takes what may go wrong from its input, a line each::

    python -m tactile_doubles.franka_controller 127.0.0.2
    joint_reflex
    slow 0.05

Each line is answered with one of JSON: what was asked for, or the controller's time (s) at which it was done.
`FrankaController.faults` has the names.
"""

from __future__ import annotations

import argparse
import json
import select
import struct
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from franky_sim import FrankaRobotServer
from franky_sim.franka_robot_protocol import (
    AutomaticErrorRecoveryCommand,
    AutomaticErrorRecoveryStatus,
    MoveStatus,
    RobotCommand,
    SetCollisionBehaviorCommand,
    UDPCommand,
)
from franky_sim.franka_robot_state import FrankaRobotState
from franky_sim.franka_server import BaseCommand, Command, ConnectCommand, ConnectStatus, MessageHeader

from tactile_doubles.double_process import answer_to, be_in_time
from tactile_doubles.franka_robot import PERIOD, FrankaRobot, FrankaRobotSettings
from tactile_drivers.rotation_vectors import pose_of, vector_of

FCI = 1337  # port
_LONGEST_LAG = 0.01  # s; further behind, nothing moved: nobody could answer states that were not sent
_LOOK = 1e-4  # s, between looks for an answer


class FrankaController(FrankaRobotServer):
    """Server and arm of one controller; `cycle` is what it does every millisecond.

    Attributes
    ----------
    robot : FrankaRobot
    collision : tuple of float
        The thresholds that a client has set: torques and forces, lower and upper, as for constant speed.
    recoveries : int
        How often a client has asked for its errors to be cleared.
    """

    def __init__(self, host: str, settings: FrankaRobotSettings | None = None) -> None:
        self.collision: tuple[float, ...] = ()
        self.delay = self.loss = 0.0
        self.garbled = self.silent = self.deaf = self.away = self.stays = False
        self.version: int | None = None
        self.recoveries = 0
        self.rng = np.random.default_rng(1)
        self._on_the_way: deque[tuple[int, bytes]] = deque()
        self._due = self._asked = time.monotonic()
        super().__init__(FrankaRobot(settings), [host])
        commands = self._FrankaServer__command_class_map  # which franky-sim has no other way to
        commands[Command.kConnect] = _Connect
        commands[RobotCommand.kSetCollisionBehavior] = _SetCollisionBehavior
        commands[RobotCommand.kAutomaticErrorRecovery] = _Recover
        self.init()

    @property
    def faults(self) -> dict[str, Callable[..., Any]]:
        """What may go wrong, by name."""
        robot = self.robot
        return {
            **{name: lambda name=name: self.reflex(name) for name in ("joint_reflex", "cartesian_reflex")},
            "cartesian_position_limits": lambda: self.reflex("cartesian_position_limits_violation"),
            "user_stop": self.user_stop,
            "restore": self.restore,  # as a person does: stop released, hand off the arm
            "recover": lambda: setattr(robot, "error", ""),  # as in Desk
            "guiding": self.guide,
            "reflex_stays": lambda on=1.0: setattr(self, "stays", bool(on)),
            "success_rate": lambda part: setattr(robot, "success_rate", part),
            "runs_away": lambda speed: setattr(robot, "extra", speed),
            "mass": lambda mass: setattr(robot, "mass", mass),
            "end_effector": lambda *frame: setattr(robot, "T_flange_ee", pose_of(frame)),
            "clock": lambda seconds: setattr(robot, "cycles", robot.cycles + round(seconds / PERIOD)),
            "jump": lambda x: robot.pose.__setitem__((0, 3), robot.pose[0, 3] + x),
            "version": lambda number=5.0: setattr(self, "version", int(number) or None),
            "slow": lambda seconds: setattr(self, "delay", seconds),
            "loss": lambda part: setattr(self, "loss", part),
            "garbled": lambda on=1.0: setattr(self, "garbled", bool(on)),
            "silence": lambda on=1.0: setattr(self, "silent", bool(on)),
            "deaf": lambda on=1.0: setattr(self, "deaf", bool(on)),
            "drop": self.reset_state,
            "leave": self.leave,
            "come_back": self.come_back,
            "collision": lambda: list(self.collision),
            "recoveries": lambda: self.recoveries,
            "trace": self.trace,
            "commands": self.commands,
            "now": self.now,
        }

    def trace(self) -> list[list[Any]]:
        """What the arm did since the last time it was asked, see `FrankaRobot.trace`."""
        taken = [[time, *(row.tolist() for row in rows)] for time, *rows in self.robot.trace]
        self.robot.trace.clear()
        return taken

    def commands(self) -> list[list[float]]:
        """What clients have commanded since the last time it was asked, see `FrankaRobot.commands`."""
        taken = [[cycle, *command.tolist()] for cycle, command in self.robot.commands]
        self.robot.commands.clear()
        return taken

    def now(self) -> tuple[int, list[float], list[float], bool]:
        """Our time (ns), pose and speed (6,) of the tool in the base, and whether safety has stopped it."""
        robot = self.robot
        stopped = bool(robot.error) or robot.user_stopped
        return time.time_ns(), vector_of(robot.pose).tolist(), robot.speed.tolist(), stopped

    # ---- what it does in a cycle ----

    def cycle(self) -> float:
        """What is due; returns the time (s) until there is more to do."""
        if self._waiting:
            self.process_commands()
            if self._waiting:
                return _LOOK
        behind = time.monotonic() - self._due
        patient = self._patient
        if behind > _LONGEST_LAG and not patient:
            self.robot.cycles += round((behind - PERIOD) / PERIOD)
            self._due, behind = self._due + behind - PERIOD, PERIOD
        cycles = min(1, int(behind / PERIOD)) if patient else int(behind / PERIOD)
        if cycles:
            self._due += cycles * PERIOD
            self.process_commands()
            self.robot.step(cycles)
            if self.robot.error and self.current_motion_id:
                self.abort(MoveStatus.kReflexAborted)
            self.send_state()
            self._asked = time.monotonic()
        return self._due + PERIOD - time.monotonic()

    @property
    def _patient(self) -> bool:
        """Whether the arm goes on no sooner than its last state has been answered."""
        wrong = self.delay or self.loss or self.garbled or self.deaf or self.silent
        return bool(self.robot.moving and self.robot.settings.patience and not wrong)

    @property
    def _waiting(self) -> bool:
        """Whether it waits for the answer to its last state."""
        late = time.monotonic() - self._asked > self.robot.settings.patience
        answered = self.robot.answered  # None until the client's first command
        return self._patient and not late and answered is not None and answered < self.robot.cycles

    def process_commands(self) -> None:
        """What a client asks for, where it can be heard."""
        if not (self.silent or self.away):
            super().process_commands()

    def start_motion(self, controller_mode: Any, motion_generator_mode: Any, motion_id: int) -> None:
        """A client's motion begins; it is told that it cannot where this raises."""
        self.robot.begin()
        super().start_motion(controller_mode, motion_generator_mode, motion_id)

    def stop_motion(self, send_preemption_signal: bool = True) -> None:
        """Its motion has ended."""
        self.robot.end()
        super().stop_motion(send_preemption_signal)

    def _reset_state(self) -> None:
        self.robot.end()
        super()._reset_state()

    def _handle_udp_command(self, command_data: bytes) -> None:
        if self.deaf or self.rng.random() < self.loss:
            return
        command = UDPCommand.from_bytes(command_data)
        self.robot.take(command.message_id, command.O_dP_EE_c)
        super()._handle_udp_command(command_data)

    # ---- what it tells ----

    @property
    def robot_state(self) -> FrankaRobotState:
        """State of the arm, with its mode."""
        return super().robot_state.replace(robot_mode=self.robot.mode)

    @property
    def library_version(self) -> int:
        """Of the interface that it speaks."""
        return int(self.version or super().library_version)

    def send_state(self) -> None:
        """Tell the client how the arm is now, or was when it should be late."""
        if not self.udp_connected:
            self._on_the_way.clear()
            return
        self._on_the_way.append((self.robot.cycles, self._get_state_bytes()))
        while self._on_the_way and (self.robot.cycles - self._on_the_way[0][0]) * PERIOD >= self.delay:
            number, data = self._on_the_way.popleft()
            if self.silent or self.rng.random() < self.loss:
                continue
            data = self.rng.bytes(len(data)) if self.garbled else data
            header = struct.pack("<Q", number)
            try:
                self._FrankaServer__udp_socket.sendto(header + data, self._client)
            except OSError:
                self.reset_state()  # nobody there any more

    @property
    def _client(self) -> tuple[str, int]:
        return self._FrankaServer__client_address, self._FrankaServer__client_udp_port

    # ---- what may go wrong ----

    def abort(self, status: MoveStatus) -> None:
        """End the client's motion, and say why."""
        if motion_id := self.current_motion_id:
            self.reset_current_motion_id()
            self.stop_motion(send_preemption_signal=False)
            self.send_state()
            BaseCommand.send_response(self._tcp_socket, RobotCommand.kMove, motion_id, status)

    def reflex(self, error: str) -> None:
        """Stop as on a collision."""
        self.robot.reflex(error)
        self.abort(MoveStatus.kReflexAborted)

    def user_stop(self) -> None:
        """Somebody presses the stop."""
        self.robot.user_stop()
        self.abort(MoveStatus.kPreemptedDueToActivatedSafetyFunctions)

    def guide(self) -> None:
        """Somebody takes the arm by its hand."""
        self.robot.guiding = True
        self.robot.end()
        self.abort(MoveStatus.kPreemptedDueToActivatedSafetyFunctions)

    def restore(self) -> None:
        """What a person does at the arm: stop released, hands off."""
        self.robot.user_stopped = self.robot.guiding = False

    def leave(self) -> None:
        """Close the connection and listen no more, as a controller that is switched off."""
        self.away = True
        self.reset_state()
        self.cleanup()

    def come_back(self) -> None:
        """Listen again."""
        self.init()
        self.away = False


@dataclass
class _Connect(ConnectCommand):
    """Refuses a client of another version."""

    def handle(self, server: FrankaController, command_type_struct: str = "I") -> None:
        if server.version is None:
            super().handle(server, command_type_struct)
            return
        answer = struct.pack("<BH5x", ConnectStatus.kIncompatibleLibraryVersion.value, server.library_version)
        header = MessageHeader(self.command_type, self.command_id, len(answer))
        self.client_socket.sendall(header.to_bytes(command_type_struct) + answer)


class _SetCollisionBehavior(SetCollisionBehaviorCommand):
    """Keeps what is set, which franky-sim does not."""

    def handle(self, server: FrankaController) -> None:
        server.collision = tuple(
            self.lower_torque_thresholds_nominal
            + self.upper_torque_thresholds_nominal
            + self.lower_force_thresholds_nominal
            + self.upper_force_thresholds_nominal
        )
        super().handle(server)


class _Recover(AutomaticErrorRecoveryCommand):
    """Leaves a reflex, where nobody presses the stop."""

    def handle(self, server: FrankaController) -> None:
        server.recoveries += 1
        status = AutomaticErrorRecoveryStatus.kSuccess
        if server.robot.user_stopped:
            status = AutomaticErrorRecoveryStatus.kCommandRejectedDueToActivatedSafetyFunctions
        elif server.stays:
            status = AutomaticErrorRecoveryStatus.kManualErrorRecoveryRequiredRejected
        else:
            server.robot.error = ""
        self.reply(status)


def main() -> int:
    """Serve until standard input ends; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("host", help="address to listen at")
    parser.add_argument("settings", nargs="?", default="{}", help="settings of the arm (JSON)")
    arguments = parser.parse_args()
    settings = FrankaRobotSettings.from_mapping(json.loads(arguments.settings))
    try:
        controller = FrankaController(arguments.host, settings)
    except OSError as error:
        print(f"{arguments.host}: {error}", file=sys.stderr)
        return 1
    be_in_time()
    print(json.dumps("ready"), flush=True)
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as asked:
        while True:
            if not select.select([asked], [], [], max(0.0, controller.cycle()))[0]:
                continue
            if not (line := asked.readline().decode()):
                return 0
            answer = answer_to(line, controller.faults)
            print(json.dumps(controller.robot.time if answer is None else answer), flush=True)


if __name__ == "__main__":
    sys.exit(main())
