"""False alarms of the safe command stage: honest drivers against doubles of their controllers, under load.

    python bench/drivers/honest_arms.py [ur franka] [--seconds 3600] [--loops 4] [--priority 20] [--loss 0.3]

Each driver moves its double about, behind the stage, as an arm's node would have it: 60 commands a second, of
which a part is lost on the way, of a motion that wanders by 20 mm and 0.1 rad at speeds up to 50 mm/s and
rests for a second in every ten. Beside them so many processes never rest; drivers and doubles have the
priority, as nodes and their launcher give it. Nobody lies, so that each alarm is a false one, after which the
arm is reset and goes on.
"""

from __future__ import annotations

import argparse
import multiprocessing
import multiprocessing.connection
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.extend(map(str, Path(__file__).resolve().parents[:2]))

from franka_driver import LIMITS, START
from shared import busy, parser
from ur_driver import arm_of, schedule

from tactile_drivers.safety import SafeArm
from tactile_scene.arm import ArmMode, open_arm

HOSTS = {"ur": "127.0.0.79", "franka": "127.0.0.80"}
SETTINGS = {"ur": "{host: %s, rate: 125.0}", "franka": "{host: %s, rate: 250.0, realtime: false}"}
PERIOD = 1.0 / 60.0  # s, between commands
FASTEST = np.array([0.03, 0.03, 0.03, 0.15, 0.15, 0.15])  # m/s, rad/s
TURNS = np.array([1.5, 1.9, 2.3, 1.7, 2.1, 2.7])  # rad/s of each axis's own sine
EVERY, REST = 10.0, 1.0  # s


def wanted(elapsed: float) -> NDArray[np.float64]:
    """The twist (6,) after so many seconds."""
    if elapsed % EVERY < REST:
        return np.zeros(6)
    return FASTEST * np.sin(TURNS * elapsed)


def double(driver: str, priority: int) -> subprocess.Popen[str]:
    """The double of one controller, which takes connections, in a process of its own."""
    module = f"tactile_doubles.{driver}_controller"
    command = [sys.executable, "-m", module, HOSTS[driver]]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()  # "ready"
    if priority:
        os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(priority + 1))
    return process


def drive(pipe: multiprocessing.connection.Connection, driver: str, arguments: argparse.Namespace) -> None:
    """One driver behind its stage; it sends what there was to tell."""
    other = double(driver, arguments.priority)
    random = np.random.default_rng(1)
    arm = arm_of(driver, SETTINGS[driver] % HOSTS[driver], start=START, limits=LIMITS)
    safe = SafeArm(arm, time.time_ns, feels=False)
    remarks: Counter[str] = Counter()
    told: Counter[str] = Counter()
    alarms: list[str] = []
    states = [0]

    def take(state) -> None:  # type: ignore[no-untyped-def]
        completed = safe.take_state(state)
        states[0] += 1
        if completed is not None and completed.remark:
            remarks[completed.remark.split(":")[0][:60]] += 1

    schedule(arguments.priority)
    safe.attach_driver(open_arm(arm, take))
    pipe.send("ready")
    begin = time.monotonic()
    count = lost = 0
    while (elapsed := time.monotonic() - begin) < arguments.seconds:
        count += 1
        if random.random() < arguments.loss:
            lost += 1
        elif refusal := safe.command(time.time_ns(), wanted(elapsed), "bench"):
            told[refusal[:80]] += 1
        if safe.alarm or (safe.state is not None and safe.state.mode in (ArmMode.FAULT, ArmMode.ESTOP)):
            alarms.append(f"{elapsed:.1f} s: {safe.alarm or (safe.state and safe.state.reason)}")
            print(f"{driver}: {alarms[-1]}", flush=True)
            time.sleep(1.0)
            safe.reset()
        time.sleep(PERIOD)
    safe.close()
    other.kill()
    print(
        f"{driver}: {elapsed:.0f} s, {count} commands, {lost} lost, {states[0]} states: "
        f"{len(alarms)} alarms; refused: {dict(told)}; states with remarks: {dict(remarks)}",
        flush=True,
    )
    pipe.send("done")


def main() -> None:
    """See the module's text."""
    given = parser(__doc__ or "")
    given.add_argument("drivers", nargs="*", choices=[*HOSTS, []])
    given.add_argument("--seconds", type=float, default=3600.0)
    given.add_argument("--loops", type=int, default=4)
    given.add_argument("--priority", type=int, default=20)
    given.add_argument("--loss", type=float, default=0.0)
    arguments = given.parse_args()
    pipes, processes = [], []
    for driver in arguments.drivers or HOSTS:
        mine, theirs = multiprocessing.Pipe()
        # as daemons: where one fails, the other ends with this process, and its double with it
        spawned = multiprocessing.get_context("spawn")
        processes.append(spawned.Process(target=drive, args=(theirs, driver, arguments), daemon=True))
        processes[-1].start()
        theirs.close()
        pipes.append(mine)
    for pipe in pipes:
        pipe.recv()
    with busy(arguments.loops):
        for process in processes:
            process.join()


if __name__ == "__main__":
    main()
