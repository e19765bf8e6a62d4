"""How fast the driver of a Franka passes commands on and states in, against the double of its controller.

    python bench/drivers/franka_driver.py [--seconds 60] [--rate 250] [--priority 40]

Twist to wire is from `FrankaArm.command` to the cycle of the double, in a process of its own on the same
machine, that takes the first command which changes for it. A stamp's error is its difference from the time
at which the double made the state. Memory, threads, descriptors and drift are those of the driver's process,
at each tenth of the time. With a priority driver and double are scheduled and locked into memory as nodes are
with `priority`; `taskset -c 1` before it keeps both on a core that nothing else should use.
"""

import itertools
import multiprocessing.connection
import sys
import time
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.extend(map(str, Path(__file__).resolve().parents[:2]))

from ur_driver import KEPT, Resources, arm_of, options, quantiles, schedule, show_states, started

from tactile_doubles.franka_controller import FrankaController
from tactile_doubles.franka_robot import PERIOD
from tactile_scene.arm import ArmMode, ArmState, open_arm

HOST = "127.0.0.78"
COMMANDS = 0.05  # s, between commands: each has been reached before the next
SPEEDS = (0.01, 0.012)  # m/s, in turn
START = "{position: [0.4, 0.0, 0.3], rotation_deg: [180, 0, 0]}"
LIMITS = "{linear_acceleration: 1.0, angular_acceleration: 4.0, linear_jerk: 500.0, angular_jerk: 1000.0}"


def serve(pipe: multiprocessing.connection.Connection, priority: int, seconds: float) -> None:
    """The double; when asked it sends when a command changed, when each state was made, its longest pause.

    Its tables are made at the start: one that grows by copying would hold up the cycles of 1 ms.
    """
    controller = FrankaController(HOST)
    robot, first, pause = controller.robot, controller.robot.cycles, 0.0
    made = np.zeros(round((seconds + 60.0) / PERIOD), dtype=np.int64)  # ns, by cycle since the first
    changes: list[float] = []
    take, steady = robot.take, [False]

    def note(cycle: int, command: Sequence[float]) -> None:
        changed = abs(command[0] - robot._commanded[0]) > 1e-9
        if changed and steady[0]:
            changes.append(time.monotonic())
        steady[0] = not changed
        take(cycle, command)

    robot.take = note  # type: ignore[method-assign]
    schedule(min(priority, 1))  # below the driver, which a real controller does not compete with
    pipe.send("ready")
    last = time.monotonic()
    while not pipe.poll():
        wait = controller.cycle()
        made[robot.cycles - first] = time.time_ns()
        now = time.monotonic()
        last, pause = now, max(pause, now - last if robot.moving else 0.0)
        time.sleep(max(0.0, wait))
    pipe.send((changes, first, made, pause))


def main() -> None:
    """Drive for so long, then print."""
    arguments = options(__doc__ or "", 250.0)
    pipe = started(serve, arguments.priority, arguments.seconds)
    settings = f"{{host: {HOST}, rate: {arguments.rate}, realtime: false}}"
    loaded = arm_of("franka", settings, start=START, limits=LIMITS)
    states = array("q")  # three numbers each
    seen = itertools.count()
    faults: list[str] = []

    def take(state: ArmState) -> None:
        if state.mode in (ArmMode.FAULT, ArmMode.ESTOP):
            faults.append(state.reason)
        if next(seen) % KEPT == 0:
            states.extend((time.time_ns(), state.stamp_ns, driver._robot_time))

    schedule(arguments.priority)  # which processes and threads of the driver inherit
    driver = open_arm(loaded, lambda state: None)
    driver._report = take
    sent = array("d")
    held = Resources(arguments.seconds)
    begin = time.monotonic()
    while (elapsed := time.monotonic() - begin) < arguments.seconds and not faults:
        sent.append(time.monotonic())
        driver.command(time.time_ns(), [SPEEDS[len(sent) % 2], 0.0, 0.0, 0.0, 0.0, 0.0])
        held.look(elapsed, driver.drift)
        time.sleep(COMMANDS)
    held.look(elapsed, driver.drift)
    if faults:
        print(f"ended by a fault after {elapsed:.0f} s: {faults[0]}")
    driver.close()
    pipe.send("done")
    changes, first, made, pause = pipe.recv()
    at = np.array(changes)
    wire = [at[i] - t for t in sent[5:] if (i := np.searchsorted(at, t)) < len(at) and at[i] - t < COMMANDS]
    quantiles("twist to wire", np.array(wire))
    kept = np.array(states).reshape(-1, 3)
    known = np.column_stack([kept[:, :2], made[kept[:, 2] - first]])
    show_states(known[known[:, 2] > 0])
    print(f"states: {next(seen)} at {arguments.rate:g} Hz; commands: {len(sent)}, seen {len(wire)}")
    print(f"longest time between two cycles of the double while it moves: {1e3 * pause:.1f} ms")


if __name__ == "__main__":
    main()
