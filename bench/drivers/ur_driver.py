"""How fast the driver of a UR passes commands on and states in, against the double of its controller.

    python bench/drivers/ur_driver.py [--seconds 60] [--rate 500] [--priority 20]

Twist to wire is from `UrArm.command` to the bytes' arrival at the double, in a process of its own on the same
machine. A stamp's error is its difference from the time at which the double made the state. Memory, threads,
descriptors and drift are those of the driver's process, at each tenth of the time. With a priority driver and
double are scheduled and locked into memory as nodes are with `priority`.
"""

import argparse
import asyncio
import contextlib
import itertools
import multiprocessing
import multiprocessing.connection
import os
import sys
import tempfile
import time
from array import array
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import parser, percentiles

from tactile_doubles.ur_controller import UrController
from tactile_ros.scheduling import freeze_gc, set_priority
from tactile_scene.arm import ArmMode, ArmState, open_arm
from tactile_scene.scene import ArmScene
from tactile_scene.scene_file import load_scene

HOST = "127.0.0.77"
COMMANDS = 1.0 / 60.0  # s, between commands
KEPT = 10  # one in so many states


def serve(pipe: multiprocessing.connection.Connection, priority: int) -> None:
    """The double; when asked it sends when which command came, and when each state was made."""
    schedule(priority and priority + 1)  # on a core with ur_rtde, which spins while it waits for an answer
    controller = UrController(HOST)
    robot, arrived, made = controller.robot, {}, {}
    write = robot.write

    def note(values: dict[str, Any]) -> None:
        arrived.setdefault(values.get("input_double_register_0"), time.monotonic())
        write(values)

    robot.write = note  # type: ignore[method-assign]
    controller.follow = lambda: made.__setitem__(picometres(robot.T_base_tcp), time.time_ns())

    async def run() -> None:
        moving = asyncio.create_task(controller.run())
        await asyncio.sleep(0.1)
        pipe.send("ready")
        while not pipe.poll():
            await asyncio.sleep(0.05)
        pipe.send((arrived, made))
        moving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await moving

    asyncio.run(run())


class Resources:
    """Memory, threads and descriptors of this process and drift of its arm's clock, ten times in a run."""

    def __init__(self, seconds: float) -> None:
        self._every, self._looks = seconds / 10.0, 0

    def look(self, elapsed: float, drift: float) -> None:
        """Print them where a tenth of the time (s) has passed since the last look."""
        if elapsed < (self._looks + 1) * self._every:
            return
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        fds = len(os.listdir("/proc/self/fd"))
        memory = float(status["VmRSS"].split()[0]) / 1e3
        self._looks += 1
        numbers = f"{memory:.1f} MB, {status['Threads'].strip()} threads, {fds} descriptors"
        print(f"{elapsed:5.0f} s: {numbers}, drift {1e6 * drift:.2f} ppm", flush=True)


def picometres(T_base_tcp: np.ndarray) -> int:
    """Where the tool is along x, by which a state is known again."""
    return round(1e12 * float(T_base_tcp[0, 3]))


def numbered(command: int) -> float:
    """The speed (m/s) of a command, by which it is known again."""
    return 0.01 + 1e-9 * command


def schedule(priority: int) -> None:
    """As a node does: a real-time priority with locked memory, and all that is there so far no garbage."""
    if missing := set_priority(priority):
        print(f"this user may not have {missing}")
    freeze_gc()


def quantiles(name: str, seconds: np.ndarray) -> None:
    low, high, most = percentiles(1e3 * seconds, 50, 99, 100)
    print(f"{name}: median {low:.2f} ms, p99 {high:.2f} ms, largest {most:.2f} ms ({len(seconds)})")


def options(text: str, rate: float) -> argparse.Namespace:
    """The command line of a driver's benchmark."""
    arguments = parser(text)
    for name, kind, value in (("seconds", float, 60.0), ("rate", float, rate), ("priority", int, 0)):
        arguments.add_argument(f"--{name}", type=kind, default=value)
    return arguments.parse_args()


def arm_of(driver: str, settings: str, **more: str) -> ArmScene:
    """An arm of a scene that this driver moves; its settings as YAML."""
    fields = {"driver": driver, "driver_settings": settings, **more}
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "bench.yaml"
        scene.write_text(
            "arms:\n  arm:\n" + "".join(f"    {name}: {text}\n" for name, text in fields.items())
        )
        return load_scene(scene).arms["arm"]


def started(serve: Callable[..., None], *arguments: Any) -> Any:
    """The pipe to a double that runs in a process of its own."""
    pipe, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=serve, args=(theirs, *arguments), daemon=True
    )
    process.start()
    assert pipe.recv() == "ready"
    return pipe


def show_states(known: Sequence[tuple[int, int, int]]) -> None:
    """Print what is known of states: when they were told, their stamps, and when they were made (ns)."""
    now, stamp, true = (np.array(column, dtype=np.int64) for column in zip(*known[20:], strict=True))
    quantiles("stamp's error", np.abs(stamp - true) / 1e9)
    quantiles("state made to told", (now - true) / 1e9)


def main() -> None:
    """Drive for so long, then print."""
    arguments = options(__doc__ or "", 500.0)
    pipe = started(serve, arguments.priority)
    start = "{position: [0.4, 0.0, 0.3]}"
    arm = arm_of("ur", f"{{host: {HOST}, rate: {arguments.rate}}}", start=start)
    states = array("q")  # three numbers each, in an eighth of the memory of tuples: it is what is measured
    seen = itertools.count()
    faults: list[str] = []

    def take(state: ArmState) -> None:
        if state.mode in (ArmMode.FAULT, ArmMode.ESTOP):
            faults.append(state.reason)
        if next(seen) % KEPT == 0:
            states.extend((time.time_ns(), state.stamp_ns, picometres(state.T_base_controlled)))

    schedule(arguments.priority)  # which processes and threads of the driver inherit
    driver = open_arm(arm, take)
    sent, held = array("d"), Resources(arguments.seconds)
    begin = time.monotonic()
    while (elapsed := time.monotonic() - begin) < arguments.seconds:
        if faults:
            print(f"ended by a fault after {elapsed:.0f} s: {faults[0]}")
            break
        speed = numbered(len(sent))
        sent.append(time.monotonic())
        driver.command(time.time_ns(), [speed, 0.0, 0.0, 0.0, 0.0, 0.0])
        held.look(elapsed, driver.drift)
        time.sleep(COMMANDS)
    held.look(elapsed, driver.drift)
    driver.close()
    pipe.send("done")
    arrived, made = pipe.recv()
    wire = [arrived[numbered(n)] - at for n, at in enumerate(sent) if numbered(n) in arrived]
    quantiles("twist to wire", np.array(wire))
    kept = np.array(states).reshape(-1, 3).tolist()
    show_states([(now, stamp, made[x]) for now, stamp, x in kept if x in made and abs(x - 0.4e12) > 1e6])
    print(f"states: {next(seen)} at {arguments.rate:g} Hz; commands: {len(sent)}")


if __name__ == "__main__":
    main()
