"""`tactile arm check`: is this arm what its scene says, and does it stop?

Looks at the scene, opens the arm's driver without ROS, and says line by line what it finds: "ok", "look"
for what only a person can see, "FAILED". With --move the arm moves by 10 mm at 10 mm/s, away from what it
points at and back, and round trip, stops, the end of commands and a computer that hangs are measured: in
the air, with nothing within 200 mm of it and a hand on its emergency stop.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

from tactile_bringup import arm_check
from tactile_bringup.commands.changes import add_command, add_group
from tactile_bringup.commands.launch import add_rehearse_option
from tactile_bringup.findings import FAILED, LOOK, Finding, show
from tactile_bringup.staged_arm import StagedArm, arm_of
from tactile_doubles.rehearsal import DOUBLES, rehearsed
from tactile_scene.scene import EXTERNAL, SIM
from tactile_scene.scene_file import load_scene

STARTS = 30.0  # s, at most, for a double to take connections


def register(subparsers: Any) -> None:
    actions = add_group(subparsers, "arm", __doc__)
    help = "connection, scene, round trip and stops"
    check = add_command(actions, "check", run, __doc__, help=help, wrong=(RuntimeError,))
    add = check.add_argument
    add("--scene", required=True, metavar="NAME", help="scene, or a scene file")
    add("--arm", default="", metavar="NAME", help="which of its arms (default: the only one)")
    add("--move", action="store_true", help="it may move, by 10 mm at 10 mm/s, in the air")
    add_rehearse_option(check)


def run(arguments: argparse.Namespace) -> int:
    return show(_findings(arguments))


def _findings(arguments: argparse.Namespace) -> Iterator[Finding]:

    scene = load_scene(arguments.scene)
    arm = arm_of(rehearsed(scene) if arguments.rehearse else scene, arguments.arm)
    if arm.driver in (SIM, EXTERNAL):
        raise ValueError(f"{arguments.scene}: '{arm.name}' has no driver of its own, but '{arm.driver}'")
    yield from arm_check.check_scene(arm)
    yield from arm_check.check_start(scene, arm)
    yield from arm_check.check_force(arm)
    with ExitStack() as stack:
        if arguments.rehearse:
            double = DOUBLES.load(arm.driver)
            stack.enter_context(closing(double(arm)))
            double.wait(arm, STARTS)
        with StagedArm(arm) as staged:
            for finding in arm_check.check_connection(staged):
                yield finding
                if arguments.move and finding.verdict == FAILED:
                    raise RuntimeError(f"not moved, since {finding.what} is wrong: {finding.found}")
            if not arguments.move:
                yield Finding(LOOK, "stops", "not measured: that takes --move, in the air")
                return
            home = staged.pose
            yield from arm_check.check_motion(staged)
        command = arm_check.hang_command(str(scene.path), arm.name, arguments.rehearse)
        yield from arm_check.check_hang(lambda: StagedArm(arm), command, home)
